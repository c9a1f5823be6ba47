"""A goal to fly to: layouts, shortest ways, what is sensed and earned, against slow loops and closed
forms.
"""

import heapq
import json
import math
import re

import gymnasium
import numpy as np
import pandas as pd
import pytest
import torch
from safetensors import safe_open

import uavnav
from uavnav import evaluation
from uavnav.algorithms import c51, dqn, ppo, sac
from uavnav.errors import ConfigError
from uavnav.runs import metrics
from uavnav.tasks import goal, layouts
from uavnav.tasks.baselines import BASELINES
from uavnav.tasks.goal import GoalWorld
from uavnav.tasks.sensed import MARGIN, SCALE
from uavnav.tasks.table import make_task


@pytest.fixture(scope="module")
def all_layouts():
    return layouts.load("test", GoalWorld())


def one(x=600.0, y=300.0, shortest=160.0, circles=()):
    """A layout file of one set."""
    return torch.tensor([[*circles, (x, y, shortest)]], dtype=torch.float32)


def room(x, y, circles):
    """From a place to the nearest edge of the circles and of the border [px]."""
    walls = min(x - 20, 780 - x, y - 20, 580 - y)
    return min([walls, *(math.hypot(cx - x, cy - y) - radius for cx, cy, radius in circles)])


def way_to(target, circles, radius=40):
    """Length of the shortest way from the start, found place by place; None where there is none."""
    free = {
        (i, j) for i in range(161) for j in range(121) if room(5 * i, 5 * j, circles) > 30
    }  # fmt: skip
    moves = [(a, b) for a in range(-2, 3) for b in range(-2, 3) if math.gcd(a, b) == 1]
    assert len(moves) == 16
    best, waiting = {(80, 60): 0.0}, [(0.0, (80, 60))]
    while waiting:
        length, place = heapq.heappop(waiting)
        if length > best[place]:
            continue
        if math.hypot(5 * place[0] - target[0], 5 * place[1] - target[1]) <= radius:
            return length
        for a, b in moves:
            beside = place[0] + a, place[1] + b
            longer = length + 5 * math.hypot(a, b)
            if beside in free and longer < best.get(beside, math.inf):
                best[beside] = longer
                heapq.heappush(waiting, (longer, beside))
    return None


# -- layouts -------------------------------------------------------------------------------------------------


def test_where_no_goal_can_be_reached_other_circles_are_drawn_and_after_100_layouts_none(monkeypatch):
    draw, tried = goal._draw_goal, []

    def once(standing, rng, world):
        tried.append(standing)
        return None if len(tried) == 1 else draw(standing, rng, world)

    monkeypatch.setattr(goal, "_draw_goal", once)
    found = goal.generate(1, 8, 3)
    assert len(tried) == 2
    assert not np.isin(tried[0], tried[1]).any()
    np.testing.assert_array_equal(found[0, :8], tried[1])
    goal.validate(found)
    monkeypatch.setattr(goal, "_draw_goal", lambda *anything: tried.append(0))
    with pytest.raises(uavnav.LayoutError, match="no goal could be reached in 100 layouts"):
        goal.generate(1, 8, 3)
    assert len(tried) == 102


@pytest.mark.parametrize("split", layouts.SPLITS)
def test_each_split_has_a_goal_a_set_and_its_first_30_are_what_the_seed_generates(split):
    n, seed = layouts.SPLITS[split]
    found, header = layouts.read(split, GoalWorld())
    assert found.shape == (n, 9, 3)
    assert (header["task"], header["n"], header["k"], header["goal_radius"]) == ("goal", str(n), "8", "40.0")
    assert header["generator_seed"] == str(seed)
    assert torch.equal(found[:30, :8], layouts.generate(n, 8, seed)[:30])
    streams = [np.random.Generator(np.random.PCG64([seed, 2, index])) for index in range(30)]
    again = [
        goal._draw_goal(one[:8].numpy(), rng, GoalWorld()) for one, rng in zip(found, streams, strict=False)
    ]
    assert np.array_equal(np.stack(again).astype(np.float32), found[:30, 8].numpy())
    assert layouts.checksum(found) == header["sha256"]


def test_a_drone_of_another_radius_has_goals_of_its_own(monkeypatch):
    monkeypatch.setitem(layouts.SPLITS, "test", layouts.SPLITS["test"]._replace(n=2))
    world = GoalWorld(drone_radius=45.0)
    found, header = layouts.read("test", world)
    assert (len(found), header["drone_radius"]) == (2, "45.0")
    assert not torch.equal(found[:, 8], layouts.load("test", GoalWorld(sensor_radius=90.0))[:2, 8])


def test_there_is_no_way_from_a_start_without_room_for_the_drone():
    assert np.isinf(goal.shortest_ways(np.array([[420.0, 300.0, 30.0]]), GoalWorld())).all()
    assert np.isfinite(goal.shortest_ways(np.array([[470.0, 300.0, 30.0]]), GoalWorld())).any()


def test_goals_are_the_same_whatever_follows_them():
    assert torch.equal(goal.generate(4, 0, 7)[:2], goal.generate(2, 0, 7))


def test_1000_goals_have_60_px_of_room_are_200_px_away_and_no_shorter_way_than_a_straight_one(all_layouts):
    for *circles, (x, y, shortest) in all_layouts.double().tolist():
        away = math.hypot(x - 400, y - 300)
        assert room(x, y, circles) >= 60 - 1e-3
        assert away >= 200 - 1e-3
        assert away - 40 - 1e-3 <= shortest < 2000


@pytest.mark.parametrize("index", [0, 1, 517])
def test_the_shortest_way_is_that_of_a_search_place_by_place(all_layouts, index):
    *circles, (x, y, shortest) = all_layouts[index].double().tolist()
    assert way_to((x, y), circles) == pytest.approx(shortest, abs=1e-3)


def test_in_an_empty_arena_the_way_to_a_goal_straight_ahead_is_its_distance_less_the_radius():
    lengths = goal.shortest_ways(np.empty((0, 3)), GoalWorld())
    assert lengths.shape == (161, 121)
    assert lengths[80 + 40, 60] == 200
    assert lengths[80 + 10, 60 + 20] == pytest.approx(50 * math.sqrt(5))
    assert np.isinf(lengths[9]).all()  # 45 px: 25 from the border, and the drone has 30
    assert np.isfinite(lengths[11, 11:110]).all()


def test_a_goal_behind_a_closed_ring_of_circles_is_never_drawn():
    ring = [
        [400 + 160 * math.cos(a), 300 + 160 * math.sin(a), 60] for a in np.linspace(0, 2 * math.pi, 13)[:-1]
    ]
    assert goal._draw_goal(np.array(ring), np.random.default_rng(0), GoalWorld()) is None


@pytest.mark.parametrize(
    ("all_layouts", "says"),
    [
        (one(x=790.0), "the goal of layout 0 is nearer than 60 px to an edge"),
        (one(x=450.0), "the goal of layout 0 is nearer than 200 px to the start"),
        (one(circles=[(600.0, 400.0, 50.0)]), "the goal of layout 0 is nearer than 60 px to an edge"),
        (one(shortest=-1.0), "the goal of layout 0 has a way of less than 0 px"),
        (one(y=math.nan), "the goal of layout 0 is not finite"),
        (one(circles=[(400.0, 300.0, 50.0)]), "obstacle 0 of layout 0 is nearer than 50 px to the start"),
        (torch.zeros(1, 0, 3), "layouts have the shape [n > 0, k + 1, 3], not [1, 0, 3]"),
    ],
)
def test_each_wrong_split_is_refused_in_one_line(all_layouts, says):
    with pytest.raises(uavnav.LayoutError, match=re.escape(says)):
        make_task(all_layouts, task="goal")


# -- the task ------------------------------------------------------------------------------------------------


def test_a_collision_at_the_goal_earns_minus_10_and_is_no_success():
    task = make_task(one(x=400.0, y=500.0), task="goal")
    blocked = torch.cat([one(400.0, 500.0, circles=[(400.0, 520.0, 30.0)])])
    task = task.replace(layouts=blocked)
    state = task.start(torch.tensor([0]), torch.tensor([90]))._replace(y=torch.tensor([459.0]))
    state, outcome = task.step(state, torch.tensor([3]))
    assert outcome.terminated.item()
    assert outcome.reward.item() == -10
    assert not task.succeeded(state).item()


def test_its_own_reward_and_a_limit_of_1000_steps_are_what_is_not_given(all_layouts):
    assert (make_task(all_layouts, task="goal").reward, make_task(all_layouts, task="goal").max_steps) == (
        "goal",
        1000,
    )
    assert (
        make_task(all_layouts, task="goal", reward="eq14").reward
        == make_task(all_layouts[:, :8]).reward
        == "eq14"
    )
    assert make_task(all_layouts, reward="eq14", max_steps=7, task="goal").max_steps == 7
    with pytest.raises(ValueError, match="reward=goal: this task has no goal; choose task=goal"):
        make_task("test", reward="goal")
    with pytest.raises(ConfigError, match="reward=goal: this task has no goal; choose task=goal"):
        ppo.PPOConfig(task="moving", reward="goal")
    assert ppo.PPOConfig(task="goal").reward == "goal"
    assert ppo.PPOConfig(task="goal", reward="eq14").reward == "eq14"
    assert ppo.PPOConfig().reward == "eq14"
    assert ppo.PPOConfig(task="goal", preset="fast").reward == "goal"
    assert ppo.PPOConfig(preset="fast").reward == "eq14"


# -- the shells ----------------------------------------------------------------------------------------------


def test_gymnasium_tells_where_a_goal_200_px_away_is_which_18_steps_reach_and_that_they_earn_11_point_62():
    env = gymnasium.make("uavnav/Goal-v0", layouts=one(x=400.0, y=500.0))
    seen, info = env.reset()
    assert env.observation_space.contains(seen)
    np.testing.assert_allclose(seen[30:], [0, 1, 0.2], atol=1e-6)
    assert (info["goal_x"], info["goal_y"], info["succeeded"]) == (400.0, 500.0, False)
    assert env.unwrapped.obstacles.shape == (0, 3)
    steps = [env.step(9) for _ in range(18)]
    assert [terminated for _, _, terminated, _, _ in steps] == [False] * 17 + [True]
    assert not any(info["succeeded"] for *_, info in steps[:-1])
    assert steps[-1][-1]["succeeded"] is True
    assert sum(reward for _, reward, _, _, _ in steps) == pytest.approx(10 + 0.01 * 162)
    many = gymnasium.make_vec("uavnav/Goal-v0", num_envs=2, layouts=one(x=400.0, y=500.0))
    _, infos = many.reset()
    assert infos["goal_y"].tolist() == [500.0, 500.0]
    for _ in range(18):
        _, _, ended, _, infos = many.step(np.array([9, 0]))
    assert ended.tolist() == [True, False]
    assert infos["final_info"]["succeeded"].tolist() == [True, False]


def test_a_picture_shows_the_goal_in_its_colour():
    env = gymnasium.make("uavnav/Goal-v0", layouts=one(x=600.0, y=300.0), render_mode="rgb_array")
    env.reset()
    picture = env.render()
    assert (abs(picture[300, 638:642].astype(int) - [0, 158, 115]).sum(-1) < 60).any()


def test_a_run_trains_and_is_evaluated_with_four_metrics_more(tmp_path, all_layouts):
    config = ppo.PPOConfig(task="goal", layouts="validation", total_frames=64, n_envs=1, frames_per_batch=64,
                           hidden=(8,), epochs=1)  # fmt: skip
    run = ppo.train(config, out=tmp_path / "run", quiet=True)
    with safe_open(run.path / "policy.safetensors", framework="pt") as file:
        header = json.loads(file.metadata()["uavnav"])
    assert (header["task"], header["reward"], header["max_steps"]) == ("goal", "goal", 1000)
    rows = evaluation.evaluate_run(run, episodes=3, quiet=True)
    assert (run.path / "evaluation-test-3-1000.parquet").exists()
    assert rows["steps"].max() <= 1000
    # of both versions
    for name, limit in (
        ("evaluation.parquet", 10_000),
        ("evaluation-test-200-1000.parquet", 1000),
    ):
        rows.attrs["max_steps"] = limit
        rows.to_parquet(run.path / name)
        assert run.evaluation().attrs["max_steps"] == limit
    assert run.behaviour_file().name == "behaviour-test-200-1000.parquet"
    assert set(metrics.own(rows).columns) == {"success", "collision", "time_out", "spl"}
    np.testing.assert_allclose(rows["shortest"], np.tile(all_layouts[:3, 8, 2].numpy(), 2))


def test_success_collision_and_time_out_add_up_and_spl_weighs_success_by_the_path():
    rows = pd.DataFrame({"seed": 0, "succeeded": [1, 1, 0, 0], "terminated": [True, True, True, False],
                         "truncated": [False, False, False, True], "distance": [200, 400, 50, 900],
                         "shortest": [250.0, 300.0, 200.0, 200.0]})  # fmt: skip
    own = metrics.own(rows).loc[0]
    assert own.to_dict() == {"success": 50, "collision": 25, "time_out": 25, "spl": (1 + 0.75) / 4}


def test_reactive_reaches_at_least_60_percent_of_60_goals(all_layouts):
    rows = evaluation.fly(
        {0: BASELINES["reactive"]}, make_task(all_layouts[:60], task="goal", max_steps=300)
    ).episodes
    assert rows["succeeded"].mean() > 0.6
    assert (
        rows["distance"][rows["succeeded"] == 1] + 9 >= rows["shortest"][rows["succeeded"] == 1] * 0.98
    ).all()


def chosen_by_hand(slots, goal, away):
    """What `reactive` does with slots (right, forward, distance [px]): (turn, speed), or None where rounding
    decides.

    Segments of the next 60 px, or of the way to a nearer goal, in directions 5 degrees apart; free is one
    from which all that is in front stays more than 32 px away.
    """
    free, close = [], False
    for bearing in range(-90, 91, 5):
        sine, cosine = math.sin(math.radians(bearing)), math.cos(math.radians(bearing))
        apart = []
        for right, forward, distance in slots:
            along = right * sine + forward * cosine
            if along <= 0:
                continue
            end = min(distance * along, 60, away)
            apart.append(math.hypot(distance * right - end * sine, distance * forward - end * cosine))
        close |= any(abs(one - 32) < 1e-3 for one in apart)
        if all(one > 32 for one in apart):
            free.append(bearing)
    wanted = min(free, key=lambda bearing: abs(bearing - math.degrees(math.atan2(*goal))), default=-90)
    turn = min(max(-wanted, -4), 5)
    ahead = -math.sin(math.radians(turn)), math.cos(math.radians(turn))
    rooms = [9.0]
    for right, forward, distance in slots:
        closing = right * ahead[0] + forward * ahead[1]
        if closing > 0:
            rooms.append((distance - 30 - MARGIN) / closing)
    close |= abs(min(rooms) - round(min(rooms))) < 1e-3 and min(rooms) < 9
    return None if close else (turn, 0 if abs(wanted) >= 45 else max(int(min(rooms)), 0))


def test_reactive_takes_the_free_direction_nearest_to_the_goal_at_2000_poses(all_layouts):
    task, n, generator = make_task(all_layouts, task="goal"), 2000, torch.Generator().manual_seed(4)
    layout, heading = (torch.randint(most, (n,), generator=generator) for most in (len(all_layouts), 360))
    x, y = (torch.rand(2, n, generator=generator) * torch.tensor([[700.0], [500.0]]) + 50).unbind()
    state = task.start(layout, heading)._replace(x=x, y=y)
    observation, clearance = task.observe(state)
    observation = observation[clearance > 30]
    chosen = BASELINES["reactive"](observation, None)
    slots = observation[:, :30].reshape(-1, 10, 3).double()
    compared = 0
    for action, own, (right, forward, away) in zip(chosen, slots, observation[:, 30:].tolist(), strict=True):
        there = [(r, f, 30 + p * 90) for r, f, p in own.tolist() if (r, f) != (0, 0)]
        expected = chosen_by_hand(there, (right, forward), away * SCALE)
        if expected is not None:
            turn, speed = action.item() // 10, action.item() % 10
            assert ((turn + 4) % 10 - 4, speed) == expected
            compared += 1
    assert compared > 1000


@pytest.mark.parametrize(
    ("kind", "more"), [(dqn.DQNConfig, {}), (c51.C51Config, {"v_min": -10, "v_max": 10}), (sac.SACConfig, {})]
)
def test_what_learns_from_replay_bootstraps_at_the_limit_that_the_task_has_by_default(kind, more):
    config = kind(task="goal", **more)
    assert config.max_steps == config.make_task().max_steps == 1000
    assert config.keeps_next_observations  # no other row has what is seen at the time limit
    assert kind(task="goal", max_steps=70, **more).max_steps == 70
