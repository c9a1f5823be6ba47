"""One drone in plain numbers: the same oracle, the same places bit for bit, the same rewards."""

import numpy as np
import oracle
import pytest
import test_sensing as poses
import torch

import uavnav
from uavnav.envs import scalar
from uavnav.tasks.rewards import BY_ACTION, KNOWN
from uavnav.tasks.simulator import make_task

GROUPS = {
    "random": lambda n, generator: poses.random_poses(n, 1),
    "near walls": poses.near_walls,
    "near corners": poses.near_corners,
    "in contact": poses.in_contact,
    "at the edge of view": poses.at_the_edge_of_view,
    "axis headings": poses.axis_headings,
    "inside a square": poses.inside_a_square,
    "on a circle's centre": poses.on_a_circles_centre,
}


@pytest.mark.parametrize("switches", [{}, {"slots": "listed", "padding": "zeros"}])
@pytest.mark.parametrize("group", GROUPS)
def test_1000_poses_of_each_group_equal_a_loop_over_136_squares(group, switches):
    world, compared = uavnav.World(**switches), 0
    chosen = GROUPS[group](1000, torch.Generator().manual_seed(2))
    for x, y, heading, circles in zip(*(part.tolist() for part in chosen), strict=True):
        found = oracle.look(x, y, heading, circles)
        slots, clearance = scalar.sense(x, y, heading, circles, world)
        assert clearance == pytest.approx(oracle.clearance_of(found), abs=1e-9)
        if not oracle.doubtful(found):
            np.testing.assert_allclose(slots, sum(oracle.slots_of(found, **switches), ()), rtol=0, atol=1e-6)
            compared += 1
    assert compared > 900


@pytest.mark.parametrize(("fields", "arena"), poses.OTHERS)
def test_200_poses_in_each_of_7_other_worlds_equal_a_loop_over_all_their_squares(fields, arena):
    world, arena, compared = uavnav.World(**fields), oracle.Arena(**arena), 0
    for x, y, heading, circles in zip(*(part.tolist() for part in poses.poses_in(world, 200)), strict=True):
        found = oracle.look(x, y, heading, circles, arena)
        slots, clearance = scalar.sense(x, y, heading, circles, world)
        assert clearance == pytest.approx(oracle.clearance_of(found), abs=1e-9)
        if not oracle.doubtful(found, arena):
            np.testing.assert_allclose(slots, sum(oracle.slots_of(found, arena=arena), ()), rtol=0, atol=1e-6)
            compared += 1
    assert compared > 180


@pytest.mark.parametrize("variant", [name for name, reward in KNOWN.items() if reward in BY_ACTION])
@pytest.mark.parametrize("max_steps", [None, 40])
def test_1000_steps_are_at_the_batchs_places_bit_for_bit_with_its_rewards_and_ends(variant, max_steps):
    task = make_task("test", reward=variant, max_steps=max_steps)
    flight = scalar.fly(task)
    assert type(flight) is scalar.Flight
    flight.start(5, 90)
    state = task.start(torch.tensor(5), torch.tensor(90))
    ends = 0
    for action in np.random.default_rng(3).integers(100, size=1000).tolist():
        observation, reward, terminated, truncated = flight.step(action)
        state, outcome = task.step(state, torch.tensor(action))
        assert (flight.x, flight.y, flight.heading) == (state.x.item(), state.y.item(), state.heading.item())
        assert (reward, terminated, truncated) == (
            outcome.reward.item(),
            outcome.terminated.item(),
            outcome.truncated.item(),
        )
        assert observation.dtype == np.float32
        if not oracle.doubtful(oracle.look(flight.x, flight.y, flight.heading, task.bank[flight.layout].tolist())):
            np.testing.assert_allclose(observation, outcome.observation.numpy(), rtol=0, atol=1e-5)
        if terminated or truncated:
            ends += 1
            flight.start(5 + ends, 90)
            state = task.start(torch.tensor(5 + ends), torch.tensor(90))
    assert ends >= 10


def test_an_empty_arena_seen_from_its_centre_is_ten_empty_slots_and_280_px_to_the_nearest_wall():
    slots, clearance = scalar.sense(400.0, 300.0, 90, [], uavnav.World())
    assert slots == [0.0, 0.0, 1.0] * 10
    assert clearance == 280
