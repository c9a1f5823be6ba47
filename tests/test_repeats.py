"""Episodes that go round for ever are counted to their time limit, and their rows are those of flying it
all, bit for bit.
"""

import dataclasses
import itertools
from pathlib import Path

import pandas as pd
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from policies_by_hand import always, untrained

import uavnav
from uavnav import evaluation
from uavnav.evaluation import WATCHED_STEPS, episodes, evaluate_policy, on
from uavnav.evaluation.repeats import counted
from uavnav.runs.policies import load_policies
from uavnav.tasks import layouts, rewards
from uavnav.tasks.state import COUNTS, State
from uavnav.tasks.table import EMPTY, TASKS, make_task
from uavnav.tasks.task import Task
from uavnav.training import machine

RESULTS = Path(uavnav.__file__).parent.parent / "results"
OPEN = layouts.generate(3, k=0)


@pytest.fixture(autouse=True)
def eager(monkeypatch, request):
    """Compile nothing, unless a test is marked as compiled."""
    if not request.node.get_closest_marker("compiled"):
        monkeypatch.setattr(machine, "EPISODES_PAY_FROM", 10**9)


@pytest.fixture
def flown(monkeypatch):
    """The steps that are flown, one entry each."""
    steps, fly = [], episodes.steps

    def counting(*what, **how):
        for step in fly(*what, **how):
            steps.append(step.number)
            yield step

    monkeypatch.setattr(episodes, "steps", counting)
    return steps


def both(population, task, monkeypatch):
    """What is left when rounds are counted, and when all is flown."""
    counted = evaluation.fly(population, task)
    with monkeypatch.context() as patch:
        patch.setattr(evaluation, "_repeatable", lambda policy, task: False)
        return counted, evaluation.fly(population, task)


def assert_same(first, second):
    for mine, other in zip(first, second, strict=True):
        pd.testing.assert_frame_equal(mine, other, check_exact=True)


# -- counted instead of flown --------------------------------------------------------------------------------

ROUNDS = {
    "standing": 0,
    "1 degree left on the spot": 10,
    "5 degrees left on the spot": 50,
    "1 degree right on the spot": 90,
    "a circle of 1 px a step, 5 degrees left": 51,
    "a circle of 3 px a step, 5 degrees left": 53,
    "a circle of 2 px a step, 4 degrees right": 62,
}
"""The action that is taken in every step."""


def test_who_goes_round_is_flown_for_a_few_rounds_and_has_the_row_of_flying_on(flown, monkeypatch):
    """Seven drones that go round in their own ways, each over the same three sets."""
    limit = 1_800
    population = {seed: always(action) for seed, action in enumerate(ROUNDS.values())}
    one, other = both(population, on(make_task(EMPTY), OPEN, 3, limit), monkeypatch)
    most = len(flown) - limit  # the second evaluation flew all
    assert WATCHED_STEPS < most < 1_500
    assert one.episodes.truncated.all()
    assert (one.episodes.steps == limit).all()
    rewards = one.episodes.groupby("seed").reward.first().tolist()
    assert rewards == [sum(itertools.repeat(-0.01, limit))] * len(ROUNDS)  # one by one, and not 1,800 x -0.01
    assert rewards[0] != limit * -0.01
    assert_same(one, other)


def test_who_goes_round_for_a_million_steps_is_counted_in_the_time_of_a_thousand(flown):
    (row,) = evaluate_policy(always(50), OPEN[:1], 1, 1_000_000).to_dict("records")
    assert len(flown) < 1_000
    assert (row["steps"], row["turns"], row["stops"], row["full_stops"]) == (
        1_000_000,
        1_000_000,
        1_000_000,
        0,
    )
    assert row["reward"] == pytest.approx(-10_000)


@pytest.mark.parametrize("limit", [499, 500, 501, 871, 872, 873, 1_231])
def test_any_limit_gives_the_rows_of_flying_it_all(limit, monkeypatch):
    population = {0: always(11), 1: always(50)}
    assert_same(*both(population, on(make_task(EMPTY), OPEN, 2, limit), monkeypatch))


@pytest.mark.parametrize("reward", ["eq14", "initial"])
def test_among_episodes_that_collide_the_one_that_goes_round_is_counted_and_no_row_changes(
    reward, flown, monkeypatch
):
    population = {0: untrained(), 1: always(50), 2: always(9)}
    one, other = both(population, on(make_task(EMPTY, reward=reward), "test", 20, 1_500), monkeypatch)
    assert len(flown) - 1_500 < 1_200
    assert one.episodes.groupby("seed").truncated.sum().tolist() == [1, 20, 0]
    assert (one.episodes[one.episodes.seed == 0].terminated.sum(), one.episodes.steps.nunique() > 10) == (
        19,
        True,
    )
    assert_same(one, other)


@pytest.mark.slow
@pytest.mark.compiled
def test_trained_policies_that_circle_have_the_rows_of_flying_it_all(monkeypatch):
    population = load_policies(RESULTS / "vectorised" / "ppo" / "relu", [1, 2])
    one, other = both(population, on(make_task(EMPTY), "test", 20, 2_000), monkeypatch)
    assert one.episodes.truncated.sum() >= 1
    assert_same(one, other)


def test_all_500_watched_steps_of_ten_layouts_are_there():
    left = evaluation.fly({0: always(50), 1: always(0)}, on(make_task(EMPTY), "test", 12, 10_000))
    assert left.behaviour.groupby(["seed", "layout"]).size().tolist() == [WATCHED_STEPS] * 20
    assert WATCHED_STEPS == 500
    assert (left.episodes.steps == 10_000).all()


# -- flown all the same --------------------------------------------------------------------------------------


def test_a_sampled_policy_is_flown(flown):
    certain = always(50, greedy=False, worth=1e4)  # sampled, it is the same action each time
    rows = evaluate_policy(certain, OPEN, 3, 1_500)
    assert len(flown) == 1_500
    assert (rows.steps == 1_500).all()


def test_who_goes_round_leaves_the_episode_of_those_that_never_do_and_a_scripted_policy_is_flown(monkeypatch):
    up, task = [], on(make_task(EMPTY), OPEN, 3, 1_300)

    def stands(observation, generator):
        return torch.zeros(len(observation), dtype=torch.int64)

    population = {0: always(0), 1: always(50), 2: stands}
    rows = evaluation.fly_modes({"": population}, task, lambda step, episodes: up.append(episodes)).episodes
    assert (len(up), up[499], up[700:]) == (1_300, 9, [3] * 599 + [0])
    assert (rows.steps == 1_300).all()
    assert_same(*both(population, task, monkeypatch))


def test_two_modes_at_once_leave_what_each_leaves_alone():
    task = on(make_task(EMPTY), "test", 20, 1_500)
    modes = {
        "greedy": {0: untrained(), 1: always(50)},
        "sampled": {seed: dataclasses.replace(untrained(seed), greedy=False) for seed in (0, 1)},
    }
    up = []
    together = evaluation.fly_modes(modes, task, lambda step, episodes: up.append(episodes))
    assert len(up) < 1_200  # the others were counted
    for mode, population in modes.items():
        own = [rows[rows["mode"] == mode].drop(columns="mode").reset_index(drop=True) for rows in together]
        assert_same(own, evaluation.fly(population, task))
    assert together.episodes.query("mode == 'greedy'").truncated.sum() == 21


def test_with_a_reward_of_a_plugin_it_is_flown(flown, monkeypatch):
    monkeypatch.setitem(
        rewards.REWARDS, "patience", lambda step: {"patience": 1e-3 * step.after.steps.double()}
    )
    rows = evaluate_policy(always(0), OPEN, 2, 600, reward="patience")
    assert len(flown) == 600
    assert rows.reward.tolist() == pytest.approx([1e-3 * 600 * 601 / 2] * 2)


def test_a_reward_that_replaces_a_built_in_one_is_flown_too(flown, monkeypatch):
    monkeypatch.setitem(rewards.REWARDS, "eq14", lambda step: {"patience": 1e-3 * step.after.steps.double()})
    evaluate_policy(always(0), OPEN, 1, 700)
    assert len(flown) == 700


def test_in_a_task_in_which_something_moves_it_is_flown(flown, monkeypatch):
    class Wind(Task):
        """Every 120th step the drone is blown 60 px upwards."""

        def move(self, state, action):
            moved, angle, distance = super().move(state, action)
            gust = torch.where((state.steps + 1) % 120 == 0, 60.0, 0.0)
            return moved._replace(y=moved.y + gust), angle, distance

    monkeypatch.setitem(TASKS, "wind", Wind)
    task = on(make_task(EMPTY, task="wind"), OPEN, 2, 2_000)
    rows = evaluation.fly({0: always(0)}, task).episodes
    assert len(flown) == 600
    assert (rows.steps == 600).all()  # 300 + 5 x 60 px: beyond the wall's 250
    assert rows.terminated.all()


# -- the arithmetic ------------------------------------------------------------------------------------------


def slowly(episode, rewards_of, increments, start, steps):
    """A loop over the steps of one made-up episode: its counts and reward after so many."""
    counts, reward = dict(start), 0.0
    for step in range(steps):
        at = step % len(rewards_of)
        for name in COUNTS[:-1]:
            counts[name] += increments[at][name]
        reward += rewards_of[at]
    return counts, reward


def state_of(made, after):
    """Where made-up episodes are after so many steps; a pose belongs to a place of the round."""
    found = [slowly(one, one["rewards"], one["increments"], one["start"], after) for one in made]
    at = torch.tensor([after % len(one["rewards"]) for one in made])
    return State(
        x=(at * 3).float(),
        y=(at * 5).float() + 0.1,
        heading=at,
        layout=torch.arange(len(made)),
        **{name: torch.tensor([counts[name] for counts, _ in found]) for name in COUNTS[:-1]},
        reward=torch.tensor([reward for _, reward in found], dtype=torch.float64),
    )


COUNT = st.integers(0, 9)
INCREMENT = st.fixed_dictionaries(dict.fromkeys(COUNTS[:-1], COUNT))


@st.composite
def episodes_that_go_round(draw):
    length = draw(st.integers(1, 6))
    return {
        "start": draw(st.fixed_dictionaries({name: st.integers(0, 1_000) for name in COUNTS[:-1]})),
        "rewards": draw(st.lists(st.floats(-10, 10), min_size=length, max_size=length)),
        "increments": draw(st.lists(INCREMENT, min_size=length, max_size=length)),
    }


@given(st.lists(episodes_that_go_round(), min_size=1, max_size=4), st.integers(0, 7), st.integers(0, 60))
@settings(max_examples=60, deadline=None)
def test_counting_is_a_slow_loop_bit_for_bit(made, before, steps):
    rounds = torch.tensor([len(one["rewards"]) for one in made])
    longest = int(rounds.max())
    states = [state_of(made, before + step) for step in range(longest + 1)]
    earned = [
        torch.tensor(
            [one["rewards"][(before + step) % len(one["rewards"])] for one in made], dtype=torch.float64
        )
        for step in range(longest)
    ]
    found = counted(states, earned, rounds, steps)
    expected = state_of(made, before + longest + steps)
    for name in COUNTS:
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
        assert getattr(found, name).dtype == getattr(expected, name).dtype


def test_an_episode_that_has_not_come_back_to_its_pose_is_not_counted():
    made = [
        {
            "start": dict.fromkeys(COUNTS[:-1], 0),
            "rewards": [0.1] * 3,
            "increments": [dict.fromkeys(COUNTS, 1)] * 3,
        }
    ]
    states, earned = (
        [state_of(made, step) for step in range(4)],
        [torch.full((1,), 0.1, dtype=torch.float64)] * 3,
    )
    assert counted(states, earned, torch.tensor([3]), 5).steps.tolist() == [8]
    states[-1] = states[-1]._replace(x=states[-1].x + 1e-5)
    assert counted(states, earned, torch.tensor([3]), 5) is None
