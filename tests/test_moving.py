"""Moving obstacles: a closed function of the step, against slow loops and closed forms."""

import functools
import re
from fractions import Fraction

import gymnasium
import numpy as np
import oracle
import pytest
import torch
from policies_by_hand import untrained
from scipy import stats

import uavnav
from uavnav import evaluation
from uavnav.cli import commands
from uavnav.envs.gym import DroneGymEnv, DroneVectorEnv
from uavnav.tasks import layouts, moving
from uavnav.tasks.baselines import BASELINES, dodge, suited
from uavnav.tasks.moving import MovingWorld
from uavnav.tasks.table import make_task

write_layouts = functools.partial(commands.run, "layouts")

SENSED = {"sense_velocity": True}


@pytest.fixture(scope="module")
def all_layouts():
    return layouts.load("test", MovingWorld())


def rows_of(all_layouts, n):
    return all_layouts[:n].double().tolist()


def actions(n, steps, seed=0):
    return torch.randint(100, (steps, n), generator=torch.Generator().manual_seed(seed))


# -- where they are ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("steps", [0, 1, 7, 400, 3001])
def test_200_circles_are_after_so_many_steps_where_a_loop_that_bounces_them_has_them(all_layouts, steps):
    where, how = moving.motion(all_layouts[:25], torch.full((25,), steps), MovingWorld())
    expected = [oracle.drift(row, steps) for row in rows_of(all_layouts, 25)]
    places = torch.tensor([[circle for circle, _ in row] for row in expected])
    velocities = torch.tensor([[velocity for _, velocity in row] for row in expected])
    torch.testing.assert_close(where, places, rtol=0, atol=1e-4)
    torch.testing.assert_close(how, velocities, rtol=0, atol=1e-6)
    assert steps < 400 or (how != all_layouts[:25, :, 3:]).any()


def test_after_a_million_steps_no_place_errs_by_a_ten_thousandth_of_a_pixel(all_layouts):
    steps = 1_000_000
    where, _ = moving.motion(all_layouts[:5], torch.full((5,), steps), MovingWorld())
    for row, found in zip(rows_of(all_layouts, 5), where.tolist(), strict=True):
        for circle, place in zip(row, found, strict=True):
            for start, velocity, size, there in zip(
                circle[:2], circle[3:], (800, 600), place[:2], strict=True
            ):
                way = (Fraction(start) + Fraction(velocity) * steps) % (2 * size)
                assert there == pytest.approx(float(min(way, 2 * size - way)), abs=1e-4)


def test_at_an_edge_a_velocity_points_inwards():
    rows = torch.tensor(
        [[[0.0, 10.0, 30.0, -2.0, 0.0], [798.0, 600.0, 30.0, 2.0, 1.0], [2.0, 0.0, 30.0, -2.0, -1.0]]]
    )
    _, now = moving.motion(rows, torch.tensor([0]), MovingWorld())
    assert now.tolist() == [[[2.0, 0.0], [2.0, -1.0], [-2.0, 1.0]]]
    _, later = moving.motion(rows, torch.tensor([1]), MovingWorld())
    assert later[0, 1:, 0].tolist() == [-2.0, 2.0]


# -- the task ------------------------------------------------------------------------------------------------


def test_at_speed_0_200_episodes_of_100_steps_equal_the_papers_world_bit_for_bit():
    still, paper = make_task("test", {"speed_max": 0.0}, task="moving"), make_task("test")
    states = [task.start(torch.arange(200), torch.full((200,), 90)) for task in (still, paper)]
    for action in actions(200, 100):
        (ours, found), (theirs, expected) = (
            task.step(state, action) for task, state in zip((still, paper), states, strict=True)
        )
        states = [ours, theirs]
        assert all(torch.equal(a, b) for a, b in zip((*ours, *found), (*theirs, *expected), strict=True))
    assert not torch.equal(still.layouts[..., :3], make_task("train").layouts[:1000])


def test_who_stands_still_is_hit_by_what_comes_at_2_px_a_step_from_120_px_after_60_steps():
    task = make_task(torch.tensor([[[400.0, 500.0, 50.0, 0.0, -2.0]]]), task="moving")
    state = task.start(torch.tensor([0]), torch.tensor([90]))
    for t in range(1, 61):
        state, outcome = task.step(state, torch.tensor([0]))
        assert outcome.clearance.item() == 150 - 2 * t
        assert outcome.terminated.item() == (t == 60)
    assert outcome.reward.item() == -10


# -- layouts -------------------------------------------------------------------------------------------------


def test_the_three_splits_have_the_papers_circles_and_speeds_uniform_from_0_to_2_px_a_step():
    found = []
    for split in layouts.SPLITS:
        all_layouts, header = layouts.read(split, MovingWorld())
        assert all_layouts.shape == (layouts.SPLITS[split].n, 8, 5)
        assert torch.equal(all_layouts[..., :3], layouts.load(split))
        assert (header["task"], header["speed_min"], header["speed_max"]) == ("moving", "0.0", "2.0")
        assert header["generator_seed"] == str(layouts.SPLITS[split].seed)
        found.append(all_layouts.reshape(-1, 5))
    vx, vy = torch.cat(found)[:, 3:].double().T.numpy()
    assert stats.kstest(np.hypot(vx, vy), stats.uniform(0, 2).cdf).pvalue > 0.01
    assert stats.kstest(np.arctan2(vy, vx), stats.uniform(-np.pi, 2 * np.pi).cdf).pvalue > 0.01


def test_a_layout_file_of_speed_3_is_the_split_of_speed_2_half_as_fast_again():
    slow, fast = (layouts.load("test", MovingWorld(speed_max=speed)) for speed in (2.0, 3.0))
    torch.testing.assert_close(fast[..., 3:], 1.5 * slow[..., 3:])


def test_files_of_moving_obstacles_say_how_they_were_drawn_and_fly_in_their_world_alone(tmp_path, capsys):
    assert write_layouts(["--task", "moving", "--n", "20", "--out", str(tmp_path)]) == 0
    path = tmp_path / "moving-validation.safetensors"
    assert write_layouts(["--check", str(path)]) == 0
    assert "20 layouts of 8 obstacles" in capsys.readouterr().out
    task = make_task(path, task="moving")
    assert torch.equal(task.layouts, moving.generate(20, 8, 2))
    with pytest.raises(
        uavnav.LayoutError, match=r"a layout file of task=moving, not of task=drone; give one of those"
    ):
        make_task(path)
    circles_alone = tmp_path / "circles.safetensors"
    layouts.save(layouts.generate(3), circles_alone, seed=0, split="own")
    with pytest.raises(uavnav.LayoutError, match=r"a layout file of task=drone, not of task=moving"):
        make_task(circles_alone, task="moving")


# -- the shells ----------------------------------------------------------------------------------------------


def test_fields_are_keywords_of_an_environment_and_wrong_ones_are_answered():
    env = gymnasium.make("uavnav/Moving-v0", speed_max=5.0, sense_velocity=True, max_steps=9)
    assert (env.unwrapped.world, env.unwrapped.task.max_steps) == (
        MovingWorld(speed_max=5.0, sense_velocity=True),
        9,
    )
    assert DroneGymEnv(sensor_arc=90.0).world == uavnav.World(sensor_arc=90.0)
    assert DroneVectorEnv(world=uavnav.World(padding="zeros"), sensor_arc=90.0).task.world == uavnav.World(
        padding="zeros", sensor_arc=90.0
    )
    with pytest.raises(ValueError, match=re.escape("did you mean world.speed_max? choose from ")):
        DroneGymEnv(task="moving", speed_maks=3.0)
    with pytest.raises(ValueError, match=re.escape("sensor_arc=...: a whole task has a world")):
        DroneGymEnv(task=make_task("test"), sensor_arc=90.0)


def test_a_picture_shows_obstacles_where_they_are_now():
    env = gymnasium.make("uavnav/Moving-v0", layouts="test", render_mode="rgb_array")
    env.reset(options={"layout": 0})
    before = env.render()
    for _ in range(5):
        env.step(0)
    assert (env.render() != before).any()


def test_obstacles_that_move_are_never_counted_as_going_round():
    policy = untrained(task=make_task(task="moving"))
    assert not evaluation._repeatable(policy, policy.task)


def test_among_moving_obstacles_reactive_dodges_and_lives_500_steps_of_2000_and_half_as_long_again(
    all_layouts,
):
    """Whatever comes after step 800 can only add to its 500."""
    task = make_task(all_layouts[:40], max_steps=800, task="moving")
    rule = suited(BASELINES["reactive"], task)
    assert rule.func is dodge
    assert suited(BASELINES["reactive"], make_task("test")).func is BASELINES["reactive"]
    assert suited(BASELINES["random"], task) is BASELINES["random"]
    steps = [
        evaluation.fly({0: policy}, task).episodes["steps"].mean() for policy in (rule, BASELINES["reactive"])
    ]
    assert steps[0] > max(500, 1.5 * steps[1])


def test_the_policy_that_dodges_turns_away_from_what_is_straight_ahead_and_flies_on_where_nothing_is():
    nothing = torch.tensor([0.0, 0.0, 1.0]).repeat(10)
    wall = torch.cat([torch.tensor([0.0, 1.0, 0.3]), nothing[3:]])
    straight, away = dodge(torch.stack([nothing, wall])).tolist()
    assert straight == 9
    assert away in (50, 60)  # as far as it can, on the spot
    with_velocities = torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0]).repeat(10)
    assert dodge(with_velocities).item() == 9


def test_with_velocities_and_a_stack_reactive_sees_the_newest_observation_alone():
    # 150 numbers, which five observations of 30 have too
    task = make_task("test", SENSED, task="moving", stack=3)
    sensed = torch.rand(200, 150, generator=torch.Generator().manual_seed(0))
    rule = suited(BASELINES["reactive"], task)
    assert torch.equal(rule(sensed, None), dodge(sensed[:, :50]))
    assert not torch.equal(rule(sensed, None), dodge(sensed))
