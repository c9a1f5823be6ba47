"""One loop steps all episodes: evaluations and films show the same ones, compiled or not."""

import dataclasses

import pandas as pd
import policies_by_hand
import pytest
import torch

from uavnav import evaluation
from uavnav.evaluation import episodes, evaluate_policy, on
from uavnav.tasks import layouts
from uavnav.tasks.baselines import BASELINES, straight_ahead
from uavnav.tasks.state import COUNTS
from uavnav.tasks.table import EMPTY, make_task
from uavnav.tasks.world import World
from uavnav.training import machine
from uavnav.views import render
from uavnav.views.render import Pilot

ACTS = {"ppo": ("categorical", 0.0), "dqn": ("epsilon-greedy", 0.05)}
WORLDS = {
    "up, eq14": make_task(EMPTY),
    "random, additive": make_task(EMPTY, World(start_heading="random"), "additive"),
}


def untrained(algorithm="ppo", greedy=True, task=None, seed=5):
    return policies_by_hand.untrained(seed, greedy, task, *ACTS[algorithm], algorithm)


@pytest.fixture
def compiled_steps(monkeypatch):
    """Compile the world's step after 5 steps; how often the graph ran."""
    ran, advance = [], episodes._advance

    def counted(*how):
        ran.append(1)
        return advance(*how)

    monkeypatch.setattr(machine, "EPISODES_PAY_FROM", 1)
    monkeypatch.setattr(machine, "EAGER_STEPS", 5)
    monkeypatch.setattr(episodes, "_advance", counted)
    return ran


# -- a film is a row -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", WORLDS.values(), ids=WORLDS)
@pytest.mark.parametrize("greedy", [True, False])
@pytest.mark.parametrize("algorithm", ACTS)
def test_a_films_numbers_are_the_row_of_the_evaluation_to_the_last_bit(algorithm, greedy, task):
    policy, all_layouts = untrained(algorithm, greedy, task), layouts.load("test")
    rows = evaluate_policy(policy, max_steps=300, seed=policy.seed)
    assert (len(rows), rows.steps.nunique() > 20) == (200, True)
    assert rows.terminated.sum() > 0
    for layout in (0, 3, 40, 199):
        flown = render.fly(Pilot("", policy, policy.task, policy.seed), all_layouts, layout, 300)
        row, last = rows.iloc[layout], flown.states[-1]
        assert row.layout == layout
        assert len(flown.states) == row.steps + 1
        assert (flown.ended == "collided") == row.terminated
        assert {name: getattr(last, name).item() for name in COUNTS} == {name: row[name] for name in COUNTS}


def test_a_film_of_set_260_is_the_row_of_an_evaluation_of_261_sets():
    policy = untrained(greedy=False)
    row = evaluate_policy(policy, episodes=261, max_steps=100, seed=5).iloc[260]
    flown = render.fly(Pilot("", policy, policy.task, 5), layouts.load("test"), 260, 100)
    assert (len(flown.states) - 1, float(flown.states[-1].reward)) == (row.steps, row.reward)


def test_random_headings_belong_to_the_layout_whoever_flies_and_however_many_there_are():
    task = on(WORLDS["random, additive"], episodes=200)
    headings = episodes.headings(task, 200)
    assert ((headings >= 0) & (headings < 360)).all()
    assert headings.unique().numel() > 100
    for n in (1, 2, 17, 100):
        assert torch.equal(episodes.headings(task, n), headings[:n])
    both = episodes.start(task, seeds=[0, 1])
    assert torch.equal(both.heading, headings.repeat(2))
    assert torch.equal(episodes.headings(on(WORLDS["up, eq14"]), 3), torch.tensor([90, 90, 90]))


# -- steps ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("greedy", [True, False])
@pytest.mark.parametrize("algorithm", ACTS)
def test_each_action_comes_with_the_numbers_behind_it(algorithm, greedy):
    policies = [(seed, untrained(algorithm, greedy, seed=seed)) for seed in (5, 6)]
    task, best, actions = on(make_task(EMPTY), episodes=10, max_steps=60), 0, 0
    for step in episodes.steps(policies, task):
        assert step.values.shape == (len(step.episode), 100)
        best += int((step.values.argmax(-1) == step.action).sum())
        actions += len(step.action)
    assert actions > 300
    assert (best == actions) == greedy


def test_an_episode_that_has_ended_is_not_there_any_more_and_steps_count_from_1():
    task = on(make_task(EMPTY), layouts.generate(3, k=0), 3, 100)
    slow = torch.tensor([9, 3, 1])

    def policy(observation, generator):
        return slow[-len(observation) :]  # the first is over first

    steps = list(episodes.steps([(0, policy)], task))
    assert [step.number for step in steps] == list(range(1, 101))
    # ceil(250 / 9), / 3
    assert [len(step.episode) for step in steps] == [3] * 28 + [2] * (84 - 28) + [1] * (100 - 84)
    assert steps[28].episode.tolist() == [1, 2]
    assert steps[99].episode.tolist() == [2]
    assert steps[99].ended.tolist() == [True]
    assert steps[99].outcome.truncated.tolist() == [True]
    assert steps[99].state.distance.tolist() == [100]


def test_a_heading_that_is_given_is_that_of_the_start():
    task = on(make_task(EMPTY), layouts.generate(2, k=0), 2, 100)
    steps = list(episodes.steps([(0, straight_ahead)], task, heading=torch.tensor([0, 90])))
    ends = {int(one): step.number for step in steps for one in step.episode[step.ended]}
    assert ends == {0: 39, 1: 28}  # ceil(350 / 9) to the right, ceil(250 / 9) upwards


# -- compiled ------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.compiled
def test_compiled_episodes_give_the_rows_of_eager_ones(monkeypatch, compiled_steps):
    """Scripted policies, which do not depend on the last bit of what they see; episodes end at many
    different steps.
    """
    population = {0: BASELINES["random"], 1: BASELINES["reactive"], 2: BASELINES["straight"]}
    task = on(make_task(EMPTY), episodes=40, max_steps=300)
    compiled = evaluation.fly(population, task)
    assert len(compiled_steps) == 300 - 5 + 1
    monkeypatch.setattr(machine, "EPISODES_PAY_FROM", 301)
    eager = evaluation.fly(population, task)
    assert len(compiled_steps) == 300 - 5 + 1
    assert compiled.episodes.steps.nunique() > 20
    pd.testing.assert_frame_equal(compiled.episodes, eager.episodes)
    pd.testing.assert_frame_equal(compiled.behaviour, eager.behaviour, rtol=1e-5)


def test_many_episodes_are_stepped_in_chunks_of_256_and_only_as_many_as_still_fly(monkeypatch):
    """The graph itself is left out, so that rows are the same to the last bit."""
    population = {seed: untrained(greedy=False, seed=seed) for seed in range(4)}
    task, calls = on(make_task(EMPTY), episodes=200, max_steps=120), []
    eager = evaluation.fly(population, task)

    def graph(function):
        def counted(action, *rest):
            calls.append(len(action))
            return function(action, *rest)

        return counted

    monkeypatch.setattr(machine, "EAGER_STEPS", 1)
    monkeypatch.setattr(machine, "episodes", lambda max_steps: True)
    monkeypatch.setattr(episodes.graph, "Graph", graph)
    episodes._graph.cache_clear()
    chunked = evaluation.fly(population, task)
    episodes._graph.cache_clear()
    up = [int((eager.episodes.steps > step).sum()) for step in range(int(eager.episodes.steps.max()))]
    assert {*calls} == {256}
    assert len(calls) == sum(-(-flying // 256) for flying in up)
    assert (up[0], up[-1] <= 256) == (800, True)
    pd.testing.assert_frame_equal(chunked.episodes, eager.episodes, check_exact=True)
    pd.testing.assert_frame_equal(chunked.behaviour, eager.behaviour, check_exact=True)


@pytest.mark.slow
@pytest.mark.compiled
def test_a_compiled_film_is_the_row_of_a_compiled_evaluation(compiled_steps):
    policy = dataclasses.replace(untrained(greedy=False), task=make_task(EMPTY, reward="additive"))
    rows = evaluate_policy(policy, max_steps=80, seed=5)
    flown = render.fly(Pilot("", policy, policy.task, 5), layouts.load("test"), 11, 80)
    assert compiled_steps
    assert {name: getattr(flown.states[-1], name).item() for name in COUNTS} == {
        name: rows.iloc[11][name] for name in COUNTS
    }


def test_episodes_of_fewer_than_2000_steps_or_without_a_limit_or_a_compiler_are_not_compiled(monkeypatch):
    monkeypatch.setattr(machine.graph, "problem", lambda device: None)
    assert (machine.episodes(1_999), machine.episodes(None)) == (False, False)
    assert machine.episodes(2_000)
    monkeypatch.setattr(machine.graph, "problem", lambda device: "no compiler")
    assert not machine.episodes(10_000)


def test_episodes_that_have_ended_before_are_not_compiled(monkeypatch):
    monkeypatch.setattr(episodes.graph, "Graph", None)
    rows = evaluate_policy(straight_ahead, max_steps=10_000)
    assert rows.steps.max() < machine.EAGER_STEPS
