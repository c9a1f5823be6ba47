"""One drone in plain numbers: the same oracle, the same places bit for bit, the same rewards."""

import itertools

import numpy as np
import oracle
import posed as poses
import pytest
import torch

import uavnav
from uavnav.envs import scalar
from uavnav.envs.gym import DroneGymEnv, DroneVectorEnv
from uavnav.tasks.ladders import LADDERS
from uavnav.tasks.rewards import BY_ACTION, KNOWN
from uavnav.tasks.table import make_task

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


VARIANTS = [("drone", name) for name, reward in KNOWN.items() if reward in BY_ACTION]
VARIANTS += [("moving", "eq14"), ("moving", "additive"), ("goal", "goal"), ("goal", "eq14")]


@pytest.mark.parametrize(("name", "variant"), VARIANTS)
def test_1000_steps_are_at_the_batchs_places_bit_for_bit_with_its_rewards_and_ends(name, variant):
    task = make_task("test", reward=variant, max_steps=40, task=name)
    episode, batch = scalar.fly(task), scalar.BatchOfOne(task)
    assert type(episode) in (scalar.Episode, scalar.AmongMoving, scalar.ToGoal)
    starts, ends = itertools.count(5), set()
    observation, expected = (one.start(5, 90) for one in (episode, batch))
    for action in np.random.default_rng(3).choice([5, 49, *range(100)], size=1000).tolist():
        circles = task.obstacles(batch.state).tolist()
        if not oracle.doubtful(oracle.look(episode.x, episode.y, episode.heading, circles)):
            np.testing.assert_allclose(observation, expected, rtol=0, atol=1e-5)
        assert observation.dtype == np.float32
        assert episode.info() == batch.info()
        (observation, *judged), (expected, *as_judged) = (one.step(action) for one in (episode, batch))
        assert judged == as_judged
        ends.add((judged[1], judged[2]))
        if judged[1] or judged[2]:
            layout = next(starts)
            observation, expected = (one.start(layout, 90) for one in (episode, batch))
    assert next(starts) >= 15
    assert ends >= {(True, False), (False, True)}


@pytest.mark.parametrize("fields", [{"task": "space"}, {"task": "moving", "world": {"sense_velocity": True}}])
def test_what_has_no_plain_numbers_flies_as_a_batch_of_one(fields):
    assert type(scalar.fly(make_task("test", **fields))) is scalar.BatchOfOne


def test_a_policy_of_another_reach_sees_the_same_in_gymnasium_as_in_a_batch():
    task = LADDERS["reach"].task(make_task("test"), 60, "test")
    single, batch = DroneGymEnv(task=task), DroneVectorEnv(1, task=task)
    seen = [(env.reset(seed=4), env.step(env.action_space.sample() * 0 + 49)) for env in (single, batch)]
    for one, other in zip(*seen, strict=True):
        np.testing.assert_allclose(one[0], other[0][0], atol=1e-6)


def test_an_empty_arena_seen_from_its_centre_is_ten_empty_slots_and_280_px_to_the_nearest_wall():
    slots, clearance = scalar.sense(400.0, 300.0, 90, [], uavnav.World())
    assert slots == [0.0, 0.0, 1.0] * 10
    assert clearance == 280
