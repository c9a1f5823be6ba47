"""The worlds in 3D: sensing, motion, collision and reward against slow loops and closed forms."""

import dataclasses
import functools
import json
import math
import re
from pathlib import Path
from typing import NamedTuple

import gymnasium
import numpy as np
import pytest
import space_by_hand as by_hand
import torch
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors import safe_open
from scipy import stats
from torchrl.envs.utils import check_env_specs

import uavnav
from uavnav import DroneEnv, evaluate, load_policy, render, verify
from uavnav.algorithms import a2c, c51, dqn, ppo, sac
from uavnav.commands.layouts import main as write_banks
from uavnav.envs import drawing
from uavnav.flights.repeats import pose_of
from uavnav.tasks import baselines, layouts, moving, space
from uavnav.tasks.baselines import BASELINES, suited
from uavnav.tasks.rewards import bounds_of_returns
from uavnav.tasks.simulator import Space, make_task
from uavnav.tasks.space import SpaceMovingWorld, SpaceWorld
from uavnav.train import __main__ as train
from uavnav.training import probes
from uavnav.window import play

SENSED = {"sense_velocity": True}
SWITCHES = [("space", {}), ("space-moving", {}), ("space-moving", SENSED)]


@pytest.fixture(scope="module")
def banks():
    return {"space": layouts.load("test", SpaceWorld()), "space-moving": layouts.load("test", SpaceMovingWorld())}


def at(task, place, yaw, pitch, layout=0, steps=0):
    """A state without a batch."""
    state = task.place(torch.tensor(layout), torch.tensor(yaw))
    x, y, z = (torch.tensor(float(one)) for one in place)
    return state._replace(x=x, y=y, z=z, pitch=torch.tensor(pitch), steps=torch.tensor(steps))


def pose(state, row):
    place = state.x[row].item(), state.y[row].item(), state.z[row].item()
    return place, state.heading[row].item(), state.pitch[row].item()


def random_states(task, n, seed=5):
    """Poses over the box and a little beyond, all headings and pitches, at any moment."""
    generator = torch.Generator().manual_seed(seed)
    layout, yaw = (torch.randint(most, (n,), generator=generator) for most in (len(task.bank), 360))
    x, y, z = (size * torch.rand(n, generator=generator) for size in task.world.size)
    pitch, steps = torch.randint(-45, 46, (n,), generator=generator), torch.randint(300, (n,), generator=generator)
    return task.place(layout, yaw)._replace(x=x, y=y, z=z, pitch=pitch, steps=steps)


# -- what is sensed --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "fields"), SWITCHES)
def test_what_is_sensed_at_5000_poses_and_moments_equals_a_slow_loop(banks, name, fields):
    n = 5000 if name == "space" or fields else 300
    task = make_task(banks[name], fields, task=name)
    state = random_states(task, n)
    observation, clearance = task.observe(state)
    spheres, velocities = task.obstacles(state).tolist(), task.velocities(state).tolist()
    compared = 0
    for row in range(n):
        found = by_hand.look(*pose(state, row), spheres[row])
        assert clearance[row].item() == pytest.approx(by_hand.clearance_of(found), abs=3e-4)
        if by_hand.doubtful(found):
            continue
        _, yaw, pitch = pose(state, row)
        slots = by_hand.slots_of(found, velocities[row] if fields else None, yaw, pitch)
        np.testing.assert_allclose(observation[row].numpy(), np.ravel(slots), atol=3e-5)
        compared += 1
    assert compared > 0.9 * n
    assert observation.shape == (n, 70 if fields else 40)
    low = torch.tensor(task.world.observation_low)
    assert ((observation >= low) & (observation <= 1)).all()


def test_a_sphere_ahead_above_and_to_the_right_fills_the_numbers_that_say_so():
    spheres = [[400.0, 400.0, 300.0, 40.0], [400.0, 300.0, 400.0, 30.0], [500.0, 300.0, 300.0, 50.0]]
    task = make_task(torch.tensor([spheres]), task="space")
    slots = task.observe(at(task, (400, 300, 300), 90, 0))[0].reshape(10, 4)
    expected = [[1, 0, 0, 20 / 90], [0, 0, 1, 30 / 90], [0, 1, 0, 40 / 90], [0, 0, 0, 1]]
    torch.testing.assert_close(slots[:4], torch.tensor(expected))
    climbing = task.observe(at(task, (400, 300, 300), 90, 45))[0].reshape(10, 4)
    half = math.sqrt(0.5)
    torch.testing.assert_close(climbing[1:3, :3], torch.tensor([[0, -half, half], [0, half, half]]))


@pytest.mark.parametrize(
    ("place", "yaw", "pitch", "slot"),
    [
        ((100, 300, 300), 180, 0, (0, 0, 1, 50 / 90)),
        ((760, 300, 300), 0, 0, (0, 0, 1, 0)),
        ((400, 550, 300), 0, 0, (-1, 0, 0, 0)),
        ((400, 300, 570), 0, 0, (0, 1, 0, 0)),
        ((400, 300, 10), 0, 0, (0, -1, 0, 0)),
        ((400, 300, 95), 90, -45, (0, -math.sqrt(0.5), math.sqrt(0.5), 0.5)),
    ],
)
def test_a_wall_is_its_nearest_point_and_beyond_it_at_distance_0_outwards(place, yaw, pitch, slot):
    task = make_task(torch.empty(1, 0, 4), task="space")
    seen, clearance = task.observe(at(task, place, yaw, pitch))
    torch.testing.assert_close(seen[:4], torch.tensor([float(one) for one in slot]))
    assert torch.equal(seen[4:].reshape(9, 4), torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(9, 4))
    gaps = [min(p - 20, size - 20 - p) for p, size in zip(place, by_hand.BOX, strict=True)]
    assert clearance.item() == max(min(gaps), 0)


def test_at_a_height_of_its_own_and_level_a_slot_is_that_of_the_papers_world_bit_for_bit():
    n, generator = 200, torch.Generator().manual_seed(3)
    circles = layouts.load("test")[:n]
    flat = torch.cat([circles[..., :2], torch.full((n, 8, 1), 300.0), circles[..., 2:]], -1)
    ours, paper = make_task(flat, task="space"), make_task(circles)
    yaw, layout = torch.randint(360, (n,), generator=generator), torch.arange(n)
    x, y = 200 + 400 * torch.rand(n, generator=generator), 200 + 200 * torch.rand(n, generator=generator)
    seen = ours.observe(ours.place(layout, yaw)._replace(x=x, y=y))[0].reshape(n, 10, 4)
    expected = paper.observe(paper.place(layout, yaw)._replace(x=x, y=y))[0].reshape(n, 10, 3)
    assert torch.equal(seen[..., [0, 2, 3]], expected)  # where no wall is in reach
    assert not seen[..., 1].any()


@pytest.mark.parametrize(("name", "fields"), SWITCHES)
def test_what_faults_make_of_it_is_said_of_true_slots(banks, name, fields):
    given = {"noise": 4.0, "lost": 0.3}
    task = make_task(banks[name], fields, task=name, faults=given)
    state, draws = random_states(task, 300), task.draw(300, torch.Generator().manual_seed(1))
    true, near = task.sense(state)
    found, clearance = task.sense(state, draws)
    true, found = (one.reshape(300, 10, -1) for one in (true, found))
    assert torch.equal(near, clearance)
    lost = (draws[:, 10:20] < 0.3) | (true[..., :3] == 0).all(-1)
    assert (found[lost] == torch.eye(found.shape[-1])[3]).all()
    others = [index for index in range(found.shape[-1]) if index != 3]
    assert torch.equal(found[~lost][:, others], true[~lost][:, others])
    inside = ~lost & (true[..., 3] > 0.3) & (true[..., 3] < 0.7)
    noisy = true[..., 3] + 4 * draws[:, :10] / 90
    torch.testing.assert_close(found[..., 3][inside], noisy[inside], rtol=0, atol=1e-5)


# -- how it flies ----------------------------------------------------------------------------------------------------


def test_the_100_actions_ask_for_five_yaws_five_pitches_and_four_distances():
    action = torch.arange(100)
    found = torch.stack(space.decode(action, SpaceWorld()), -1).tolist()
    assert found == [[*by_hand.decode(one)] for one in range(100)]
    assert len({*map(tuple, found)}) == SpaceWorld().n_actions == 100


def test_pitch_stops_at_45_degrees_and_what_asks_for_more_is_a_turn_that_is_penalised():
    task = make_task(torch.empty(1, 0, 4), task="space")
    state = task.start(torch.tensor(0), torch.tensor(90))
    for n in range(1, 15):
        state, outcome = task.step(state, torch.tensor(2 * 4))
        assert (state.pitch.item(), state.turns.item()) == (min(4 * n, 45), n)
        assert outcome.reward.item() == -0.01
    state, outcome = task.step(state, torch.tensor(3))
    assert (state.pitch.item(), state.turns.item()) == (45, 14)
    assert outcome.reward.item() == pytest.approx(0.09)
    assert (state.y.item(), state.z.item()) == pytest.approx((300 + 9 * math.sqrt(0.5),) * 2)


def test_28_steps_straight_ahead_from_the_start_of_an_empty_box_and_the_wall_is_hit():
    task = make_task(torch.empty(1, 0, 4), task="space")
    state = task.start(torch.tensor(0), torch.tensor(90))
    assert (state.x, state.y, state.z, state.heading, state.pitch) == (400, 300, 300, 90, 0)
    for n in range(1, 29):
        state, outcome = task.step(state, torch.tensor(3))
        assert outcome.clearance.item() == 280 - 9 * n
        assert outcome.terminated.item() == (n == 28)
    assert state.reward.item() == pytest.approx(27 * 0.09 - 10)


@pytest.mark.parametrize(("name", "fields"), [*SWITCHES, ("space-moving", {"speed_min": 3.0, "speed_max": 5.0})])
def test_whole_flights_of_40_rows_equal_a_loop_that_turns_moves_lets_spheres_move_and_judges(name, fields):
    task = make_task("validation", fields, max_steps=120, task=name)
    n, sets = 40, task.bank[:40].double().tolist()
    generator = torch.Generator().manual_seed(2)
    state = task.start(torch.arange(n), torch.full((n,), 90))
    up, collisions = set(range(n)), 0
    for t in range(1, 121):
        flies = torch.randint(4, (n,), generator=generator) > 0  # mostly straight ahead, or few would hit anything
        action = torch.where(flies, 3, torch.randint(100, (n,), generator=generator))
        before, (state, outcome) = state, task.step(state, action)
        for row in sorted(up):
            chosen = action[row].item()
            place, yaw, pitch = by_hand.move(*pose(before, row), chosen)
            assert pose(state, row)[1:] == (yaw, pitch)
            assert pose(state, row)[0] == pytest.approx(place, abs=1e-4)
            now = by_hand.drift(sets[row], t) if name == "space-moving" else [(one, ()) for one in sets[row]]
            found = by_hand.look(place, yaw, pitch, [sphere for sphere, _ in now])
            if not by_hand.doubtful(found):
                hit = by_hand.clearance_of(found) <= 30
                assert outcome.terminated[row] == hit
                assert outcome.truncated[row] == (t == 120 and not hit)
                assert outcome.reward[row].item() == pytest.approx(by_hand.reward(chosen, hit))
                velocities = [one for _, one in now] if "sense_velocity" in fields else None
                slots = by_hand.slots_of(found, velocities, yaw, pitch)
                np.testing.assert_allclose(outcome.observation[row].numpy(), np.ravel(slots), atol=5e-5)
            if outcome.terminated[row]:
                up.remove(row)
                collisions += 1
    assert collisions > 20


def test_a_late_observation_and_an_action_that_sticks_are_those_of_a_loop(banks):
    task = make_task(banks["space"], task="space", faults={"late": 2, "sticky": 0.5}, stack=2)
    clear = make_task(banks["space"], task="space")
    generator = torch.Generator().manual_seed(4)
    layout = torch.arange(30)
    state = task.start(layout, 0 * layout + 90, task.draw(30, generator))
    mine = clear.start(layout, 0 * layout + 90)
    seen, last = [clear.observe(mine)[0]] * 4, None
    for t in range(25):
        action, draws = torch.randint(100, (30,), generator=generator), task.draw(30, generator)
        executed = action if last is None else torch.where(draws[:, -1] < 0.5, last, action)
        state, outcome = task.step(state, action, draws)
        mine, expected = clear.step(mine, executed)
        seen, last = [expected.observation, *seen], executed
        assert torch.equal(outcome.observation, torch.cat([seen[2], seen[3]], -1)), t
        assert all(torch.equal(getattr(state, name), getattr(mine, name)) for name in mine._fields)


@pytest.mark.parametrize(("name", "fields"), SWITCHES)
def test_rows_do_not_see_each_other(banks, name, fields):
    task = make_task(banks[name], fields, task=name)
    states = random_states(task, 6)
    together, outcomes = task.step(states, torch.arange(6) * 13)
    for row in range(6):
        alone, outcome = task.step(type(states)(*(part[row] for part in states)), torch.tensor(row * 13))
        for a, b in zip((*together, *outcomes), (*alone, *outcome), strict=True):
            assert torch.equal(a[row], b)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.just(3) | st.integers(0, 99), st.integers(1, 20)), min_size=1, max_size=6), st.data())
def test_no_step_leads_through_a_sphere_or_a_wall_and_counts_add_up(stretches, data):
    task = make_task("test", task="space")
    layout = data.draw(st.integers(0, 999))
    before = task.start(torch.tensor(layout), torch.tensor(90))
    counts = dict.fromkeys(("steps", "stops", "full_stops", "turns", "distance"), 0)
    for action in [action for action, times in stretches for _ in range(times)]:
        state, outcome = task.step(before, torch.tensor(action))
        yaw, pitch, distance = by_hand.decode(action)
        turned = yaw != 0 or pitch != 0
        for name, more in {
            "steps": 1,
            "stops": distance == 0,
            "full_stops": distance == 0 and not turned,
            "turns": turned,
            "distance": distance,
        }.items():
            counts[name] += more
            assert getattr(state, name).item() == counts[name]
        assert task.observe(before)[1].item() - outcome.clearance.item() <= distance + 1e-3
        ways = (state.x - before.x, state.y - before.y, state.z - before.z)
        assert math.hypot(*(way.item() for way in ways)) == pytest.approx(distance, abs=1e-3)
        assert -45 <= state.pitch.item() <= 45
        if outcome.terminated:
            assert outcome.clearance.item() > 30 - 9 - 1e-3  # a sphere has 30 px: nothing is jumped over
            return
        before = state


# -- banks -----------------------------------------------------------------------------------------------------------


def test_the_three_splits_have_40_spheres_a_set_uniform_in_the_box_and_velocities_uniform_over_directions():
    found = []
    for split, (n, seed) in layouts.SPLITS.items():
        bank, header = layouts.read(split, SpaceWorld())
        moved, told = layouts.read(split, SpaceMovingWorld())
        assert (bank.shape, moved.shape) == ((n, 40, 4), (n, 40, 7))
        assert torch.equal(moved[..., :4], bank)
        assert (header["task"], header["k"], header["generator_seed"]) == ("space", "40", str(seed))
        assert (told["task"], told["speed_max"]) == ("space-moving", "2.0")
        found.append(moved[:1000].reshape(-1, 7))
    x, y, z, radius, *velocity = torch.cat(found).double().T.numpy()
    away = np.sqrt((x - 400) ** 2 + (y - 300) ** 2 + (z - 300) ** 2)
    assert (away - radius).min() >= 50
    far = (y < 100) | (y > 500)  # where the safe zone takes nothing away
    assert stats.kstest(x[far], stats.uniform(0, 800).cdf).pvalue > 0.01
    assert stats.kstest(z[(x < 200) | (x > 600)], stats.uniform(0, 600).cdf).pvalue > 0.01
    speed = np.linalg.norm(velocity, axis=0)
    assert stats.kstest(speed, stats.uniform(0, 2).cdf).pvalue > 0.01
    for part in velocity:  # Archimedes: each coordinate of a uniform direction is uniform
        assert stats.kstest(part / speed, stats.uniform(-1, 2).cdf).pvalue > 0.01


def test_spheres_fill_about_as_much_of_the_box_as_the_papers_circles_of_the_window():
    generator = torch.Generator().manual_seed(0)
    task, paper = make_task("validation", task="space"), make_task("validation")
    state = random_states(task, 20_000)
    x, y = (torch.rand(20_000, generator=generator) * size for size in (800, 600))
    flat = paper.place(torch.arange(20_000) % 1000, torch.zeros(20_000, dtype=torch.int64))._replace(x=x, y=y)

    def filled(obstacles, place):
        away = (obstacles[..., :-1] - torch.stack(place, -1)[:, None]).norm(dim=-1)
        return (away < obstacles[..., -1]).any(-1).double().mean().item()

    spheres = filled(task.obstacles(state), (state.x, state.y, state.z))
    assert spheres == pytest.approx(filled(paper.obstacles(flat), (x, y)), abs=0.05)


def test_after_a_thousand_steps_100_spheres_are_where_a_loop_that_bounces_them_has_them(banks):
    where, how = moving.motion(banks["space-moving"][:3], torch.full((3,), 1000), SpaceMovingWorld())
    expected = [by_hand.drift(rows, 1000) for rows in banks["space-moving"][:3].double().tolist()]
    places, velocities = (torch.tensor([[one[part] for one in row] for row in expected]) for part in (0, 1))
    torch.testing.assert_close(where, places, rtol=0, atol=1e-4)
    torch.testing.assert_close(how, velocities, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["space", "space-moving"])
def test_files_of_spheres_are_what_their_seed_generates_and_fly_in_their_world_alone(name, tmp_path, capsys):
    assert write_banks(["--task", name, "--n", "5", "--split", "test", "--out", str(tmp_path)]) == 0
    path = tmp_path / f"{name}-test.safetensors"
    assert write_banks(["--check", str(path)]) == 0
    assert "5 sets of 40 obstacles" in capsys.readouterr().out
    assert make_task(path, task=name).bank.shape[:2] == (5, 40)
    with pytest.raises(uavnav.LayoutError, match=f"a bank of task={name}, not of task=drone; give one of those"):
        make_task(path)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"world": {"depth": 280}}, "depth=280; give above 280 px, or two opposite walls are in reach at once"),
        ({"world": {"speed_max": 1.0}}, "there is no key 'world.speed_max'; choose from "),
        ({"layouts": torch.ones(2, 3, 3)}, "a bank has the shape [n > 0, k, 4], not [2, 3, 3]"),
        ({"layouts": torch.tensor([[[400.0, 300, 340, 30]]])}, "obstacle 0 of set 0 is nearer than 50 px to the start"),
        ({"layouts": torch.tensor([[[0.0, 0, 0, 29]]])}, "obstacle 0 of set 0 has a radius outside 30 ... 100 px"),
        (
            {"layouts": torch.tensor([[[0.0, 0, 601, 30, 0, 0, 0]]]), "task": "space-moving"},
            "obstacle 0 of set 0 has its centre outside the window",
        ),
    ],
)
def test_each_wrong_part_is_refused_in_one_line(arguments, says):
    with pytest.raises(ValueError, match=re.escape(says)) as refused:
        make_task(**{"layouts": "test", "task": "space", **arguments})
    assert "\n" not in str(refused.value)


# -- what learns in it -----------------------------------------------------------------------------------------------


def test_a_return_lies_between_the_worst_collision_and_9_px_a_step():
    assert SpaceWorld().distances == (0, 3, 6, 9)
    assert bounds_of_returns("eq14", SpaceWorld(), 0.99) == pytest.approx((-10, 9))


def test_a_pose_that_comes_again_has_the_same_place_yaw_and_pitch():
    task = make_task("test", task="space")
    assert pose_of(task.place(torch.tensor(0), torch.tensor(90))) == ["x", "y", "heading", "z", "pitch"]
    assert pose_of(make_task("test").place(torch.tensor(0), torch.tensor(90))) == ["x", "y", "heading"]
    assert probes.poses(task).shape == (512, 40)


def test_a_flight_that_goes_round_in_pitch_too_is_counted_to_its_cap_as_if_it_were_flown(tmp_path):
    config = ppo.PPOConfig(task="space", total_frames=64, n_worlds=1, frames_per_batch=64, hidden=(8,), epochs=1)
    run = ppo.train(config, out=tmp_path / "run", quiet=True)
    greedy = load_policy(run.path, greedy=True)
    task = evaluate.on(greedy.task, "test", 10, 2000)
    assert evaluate._repeatable({0: greedy}, task)
    counted = evaluate.fly({0: greedy}, task).episodes
    flown = evaluate.fly({0: lambda observation, generator: greedy(observation)}, task).episodes
    assert counted.equals(flown)


@pytest.mark.parametrize(
    ("module", "kind", "settings"),
    [
        (a2c, a2c.A2CConfig, {}),
        (dqn, dqn.DQNConfig, {"learning_starts": 32, "batch_size": 8}),
        (c51, c51.C51Config, {"learning_starts": 32, "batch_size": 8}),
        (sac, sac.SACConfig, {"learning_starts": 32, "batch_size": 8}),
    ],
)
def test_each_kind_of_algorithm_takes_the_size_of_the_observation_from_the_task(module, kind, settings, tmp_path):
    given = {
        "task": "space-moving",
        "world": SENSED,
        "total_frames": 128,
        "n_worlds": 4,
        "hidden": (8,),
        "max_steps": 9,
    }
    run = module.train(kind(**given, **settings), out=tmp_path / "run", quiet=True)
    assert load_policy(run.path)(torch.zeros(3, 70)).shape == (3,)


def test_a_run_trains_stops_goes_on_is_evaluated_and_verified_in_a_deeper_box(tmp_path):
    given = {"task": "space", "world": {"depth": 700}, "total_frames": 128}
    config = ppo.PPOConfig(**given, n_worlds=2, frames_per_batch=64, hidden=(8,), epochs=1)
    with pytest.raises(uavnav.RunError):
        ppo.train(config, out=tmp_path / "run", quiet=True, until=64)
    run = ppo.train(config, out=tmp_path / "run", quiet=True)
    whole = ppo.train(config, out=tmp_path / "whole", quiet=True)
    assert run.episodes.equals(whole.episodes)
    with safe_open(run.path / "policy.safetensors", framework="pt") as file:
        header = json.loads(file.metadata()["uavnav"])
    assert (header["task"], header["world"]["depth"]) == ("space", 700)
    assert type(load_policy(run.path).task) is Space
    rows = evaluate.evaluate_run(run, episodes=3, max_steps=40, quiet=True)
    assert len(rows) == 6
    assert verify.verify(run, quiet=True).same


def test_after_training_in_3d_the_command_that_shows_it_is_render(tmp_path, monkeypatch):
    monkeypatch.setattr("uavnav.train.__main__.find_spec", lambda name: True)
    told = {task: train._next(FakeRun(tmp_path, {"task": task}), []) for task in ("drone", "space")}
    assert told["drone"].startswith("watch it:    uavnav play ")
    assert told["space"].startswith("watch it:    uavnav render ")


class FakeRun(NamedTuple):
    path: Path
    config: dict


def test_fields_are_the_boxs_and_those_of_moving_obstacles_where_they_move():
    names = [{field.name for field in dataclasses.fields(kind)} for kind in (SpaceWorld, SpaceMovingWorld)]
    assert names[1] - names[0] == {"speed_min", "speed_max", "sense_velocity"}
    assert (SpaceMovingWorld().n_actions, SpaceMovingWorld(**SENSED).observation_size) == (100, 70)


# -- the shells ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "fields"), SWITCHES)
def test_torchrl_finds_nothing_wrong_with_its_environment_and_resets_go_on(name, fields):
    env = DroneEnv([2, 3], "test", task=name, world=fields, seeds=[0, 1], max_steps=20)
    check_env_specs(env)
    torch.manual_seed(0)
    rows = env.rollout(50, break_when_any_done=False)
    assert rows["next", "done"].any()
    assert rows["observation"].shape == (2, 3, 50, 70 if fields else 40)


@pytest.mark.parametrize(("name", "fields"), SWITCHES)
def test_single_and_vector_environments_fly_the_same_steps_and_say_where_they_are(name, fields):
    known = {"space": "uavnav/Space-v0", "space-moving": "uavnav/SpaceMoving-v0"}[name]
    one = gymnasium.make(known, layouts="test", **fields)
    many = gymnasium.make_vec(known, num_envs=2, layouts="test", **fields)
    sets = one.unwrapped.bank.double().tolist()
    seen, info = one.reset(options={"layout": 3})
    both, infos = many.reset(options={"layout": [3, 3]})
    place, yaw, pitch = by_hand.START, 90, 0
    for t, action in enumerate(torch.randint(100, (30,), generator=torch.Generator().manual_seed(1)).tolist()):
        np.testing.assert_array_equal(seen, both[1])
        assert one.observation_space.contains(seen)
        assert (info["x"], info["y"], info["z"]) == pytest.approx(place, abs=1e-3)
        assert (info["yaw"], info["pitch"], info["layout"]) == (yaw, pitch, 3)
        assert {key: infos[key][1] for key in info} == info
        now = by_hand.drift(sets[3], t) if name == "space-moving" else [(one, (0, 0, 0)) for one in sets[3]]
        assert info.get("steps", t) == t
        np.testing.assert_allclose(one.unwrapped.obstacles, [sphere for sphere, _ in now], atol=1e-4)
        np.testing.assert_allclose(many.unwrapped.velocities[1], [velocity for _, velocity in now], atol=1e-6)
        place, yaw, pitch = by_hand.move(place, yaw, pitch, action)
        seen, reward, terminated, _, info = one.step(action)
        both, rewards, ended, _, infos = many.step(np.array([action, action]))
        assert (reward, terminated) == (rewards[1], ended[1])
        if terminated:
            break
    assert t > 5


@pytest.mark.parametrize("known", ["uavnav/Space-v0", "uavnav/SpaceMoving-v0"])
def test_the_checkers_of_gymnasium_and_stable_baselines3_pass(known):
    check_env(gymnasium.make(known, layouts="test").unwrapped, skip_render_check=True)
    pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.env_checker import check_env as check_by_sb3

    from uavnav.envs.sb3 import DroneVecEnv

    check_by_sb3(gymnasium.make(known, layouts="test").unwrapped)
    many = DroneVecEnv(2, layouts="test", task="space-moving", sense_velocity=True)
    assert many.reset().shape == (2, 70)
    observation, reward, _, infos = many.step(np.array([3, 7]))
    assert (observation.shape, reward.shape, infos[1]["pitch"]) == ((2, 70), (2,), 2)


# -- scripted rules --------------------------------------------------------------------------------------------------


def test_names_of_scripted_policies_stand_for_rules_of_the_box():
    still, moving_, paper = make_task("test", task="space"), make_task("test", SENSED, task="space-moving"), make_task()
    assert suited(BASELINES["random"], still) is BASELINES["random"]
    assert suited(BASELINES["straight"], still)(torch.zeros(2, 40), None).tolist() == [3, 3]
    assert suited(BASELINES["straight"], paper) is BASELINES["straight"]
    assert suited(BASELINES["reactive"], still).func is baselines.reactive_in_the_box
    rule = suited(BASELINES["reactive"], moving_)
    assert (rule.func, rule.keywords) == (baselines.dodge_in_the_box, {"width": 7})


def test_among_spheres_that_stand_still_the_reactive_rule_never_collides_and_flies_on():
    task = evaluate.on(make_task("test", task="space"), "test", 30, 400)
    rows = evaluate.fly({0: suited(BASELINES["reactive"], task)}, task).episodes
    assert rows["truncated"].all()
    assert rows["distance"].mean() > 1000
    assert rows["reward"].tolist() == pytest.approx((0.01 * rows["distance"] - 0.01 * rows["turns"]).tolist())


@pytest.mark.parametrize("fields", [{}, SENSED])
def test_among_moving_spheres_the_rule_that_dodges_lasts_twice_as_long_as_the_one_for_a_still_box(fields):
    task = evaluate.on(make_task("test", fields, task="space-moving"), "test", 30, 300)
    width = len(task.world.slot_low)
    still = functools.partial(baselines.reactive_in_the_box, width=width)
    rules = suited(BASELINES["reactive"], task), still, BASELINES["random"]
    dodges, stands, random = (evaluate.fly({0: rule}, task).episodes["steps"].mean() for rule in rules)
    assert dodges > 1.7 * stands > 1.7 * random


@pytest.mark.parametrize(
    ("slot", "turns"), [((0, 0, 1, 0.3), True), ((0, 0.8, 0.6, 0.06), True), ((0, 0, 1, 0.9), False)]
)
def test_both_rules_turn_from_what_is_close_ahead_and_fly_on_where_it_is_far(slot, turns):
    seen = torch.tensor([0.0, 0.0, 0.0, 1.0]).repeat(10)
    seen[:4] = torch.tensor(slot)
    yaw, pitch, _ = space.decode(baselines.dodge_in_the_box(seen), SpaceWorld())
    assert bool(yaw or pitch) == turns
    near = slot[3] * 90 - 9 * slot[2] <= 0
    assert baselines.reactive_in_the_box(seen).item() == (40 if near else 3)


# -- pictures --------------------------------------------------------------------------------------------------------


def test_a_picture_shows_the_slice_through_the_drone_from_above_and_from_the_side():
    task = make_task(torch.tensor([[[600.0, 300.0, 300.0, 50.0], [150.0, 450.0, 500.0, 60.0]]]), task="space")
    picture = drawing.draw_state(at(task, (400, 200, 350), 0, 0), task)
    assert picture.shape == (600, 800 + 8 + 800, 3)

    def colour(x, up, view):
        return tuple(int(part) for part in picture[599 - up, x + 808 * view])

    assert colour(410, 190, 0) == colour(410, 340, 1) == drawing.DRONE
    for view in (0, 1):
        assert colour(5, 300, view) == colour(795, 300, view) == colour(300, 5, view) == drawing.BORDER
    assert drawing.GROUND != colour(600, 300, 0) != drawing.OBSTACLE  # 50 px above it: no slice, a pale silhouette ...
    assert drawing.GROUND != colour(600, 300, 1) != drawing.OBSTACLE  # ... and so 100 px beside it
    assert colour(700, 100, 0) == drawing.GROUND
    cut = drawing.draw_state(at(task, (400, 300, 330), 90, 0), task)
    for view, up in ((0, 300 + 39), (1, 300 + 49)):  # sqrt(50^2 - 30^2) = 40 px, and 50 px
        assert tuple(cut[599 - up, 600 + 808 * view]) == drawing.OBSTACLE
    assert tuple(cut[599 - 342, 600]) != drawing.OBSTACLE


def test_a_film_of_a_flight_in_3d_has_both_views_and_a_trail_in_each():
    task = make_task(torch.empty(1, 0, 4), task="space")
    climb = functools.partial(_always, action=4 + 3)
    flown = render.fly(render.Pilot("climbs", climb, task), task.bank, 0, 12)
    film = render.Film([flown], task.bank[0], 320)
    assert film[0].shape[1] == 320
    assert (film[0] != film[-1]).any()
    left, right = np.hsplit(np.abs(film[0].astype(int) - film[-1]).sum(-1) > 0, [160])
    assert left.any()
    assert right.any()


def test_the_window_says_in_one_line_that_render_shows_a_world_in_3d(capsys):
    assert play.main(["reactive", "--task", "space"]) == 2
    told = "reactive: the window shows no world in 3D; uavnav render draws it from above and from the side"
    assert capsys.readouterr().err == f"uavnav play: {told}\n"


def _always(observation, generator=None, action=0):
    return torch.full((len(observation),), action)
