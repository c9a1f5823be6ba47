"""What an evaluation keeps beside its rows: episodes in the empty arena, and what seeds expect against what
they get.

The networks are made by hand; their numbers are known in closed form.
"""

import math

import numpy as np
import pandas as pd
import pytest
import torch
from runs_by_hand import policy_bytes, write_policies

from uavnav import evaluation
from uavnav.algorithms import dqn
from uavnav.evaluation import Protocol, evaluate_run, fly, in_empty_arena, on
from uavnav.evaluation.values import overestimation
from uavnav.networks import mlp
from uavnav.runs import ARENA, VALUES, Run
from uavnav.runs.policies import by_mode, load_policies
from uavnav.runs.tables import write_table
from uavnav.studies import Configuration
from uavnav.studies.run import _join_episodes
from uavnav.tasks.baselines import BASELINES
from uavnav.tasks.table import make_task

STOP, FULL_SPEED = 0, 9  # straight ahead, 0 and 9 px


def population(path, seeds=(0,), algorithm="dqn", mode="greedy", constant=None):
    """Policies whose networks are random, each by its seed, or else say the same of every state.

    constant: for each seed, the best action and what it is worth; all others are worth 0.
    """
    network = mlp([30, 8, 100], "tanh", [torch.Generator().manual_seed(seed) for seed in seeds], "default")
    if constant:
        with torch.no_grad():
            for parameter in network.parameters():
                parameter.zero_()
            for agent, (action, value) in enumerate(constant):
                network[-1].bias[agent, 0, action] = value
    file = path / "some.safetensors"
    settings = {"activation": "tanh", "seed": seeds[0], "n_seeds": len(seeds), "hidden": (8,)}
    file.write_bytes(policy_bytes(network, algorithm, **settings))
    return load_policies(file, seeds, greedy=mode == "greedy")


# -- the empty arena -----------------------------------------------------------------------------------------


def test_who_stands_still_in_the_empty_arena_does_so_for_500_steps_from_each_of_4_headings(tmp_path):
    flown = in_empty_arena({"greedy": population(tmp_path, (4, 5), constant=[(STOP, 1.0)] * 2)})
    assert flown.groupby(["seed", "layout"]).size().to_dict() == {
        (s, h): 500 for s in (4, 5) for h in range(4)
    }
    assert {*flown["action"]} == {STOP}


def test_straight_episodes_from_the_centre_end_at_the_four_walls(tmp_path):
    flown = in_empty_arena({"greedy": population(tmp_path, constant=[(FULL_SPEED, 1.0)])})
    assert flown.groupby("layout").size().tolist() == [39, 28, 39, 28]  # ceil(350 / 9), ceil(250 / 9)


# -- values against returns ----------------------------------------------------------------------------------


def test_overestimation_of_a_drone_that_stands_still_for_ever(tmp_path):
    """Each step earns -0.01, from each of 300 states for 459 steps or more: 0.99^459 < 1 % is cut off."""
    steps_left = 300 + 459 - np.arange(300)
    realised = np.mean(-0.01 * (1 - 0.99**steps_left) / (1 - 0.99))
    assert -1 < realised < -0.99
    expected = [[2, 5, realised, 5 - realised], [3, 0, realised, -realised]]
    found = overestimation(
        population(tmp_path, (2, 3), constant=[(STOP, 5.0), (STOP, 0.0)]), 0.99, n_layouts=2
    )
    assert list(found.columns) == ["seed", "q", "realised", "overestimation"]
    assert np.allclose(found.to_numpy(), expected, atol=1e-6)


@pytest.mark.parametrize("steps", [300, 5])
def test_overestimation_of_a_drone_that_flies_straight_into_what_comes(tmp_path, steps):
    """Nine pixels a step earn 0.09, and the last step -10: all states of the first steps count."""
    lengths = fly({0: BASELINES["straight"]}, on(make_task(), "test", 6)).episodes["steps"]
    returns = [
        sum(0.09 * 0.9**i for i in range(left - 1)) - 10 * 0.9 ** (left - 1)
        for length in lengths
        for left in range(length, max(length - steps, 0), -1)
    ]
    found = overestimation(population(tmp_path, constant=[(FULL_SPEED, 2.0)]), 0.9, steps=steps, n_layouts=6)
    (row,) = found.to_dict("records")
    assert row["realised"] == pytest.approx(np.mean(returns))
    assert row["overestimation"] == pytest.approx(2 - np.mean(returns))


def test_states_without_enough_future_count_only_before_a_collision(tmp_path):
    """Of the 459 steps that an episode without a collision would need there are 60."""
    both = population(tmp_path, (0, 1), constant=[(STOP, 1.0), (FULL_SPEED, 1.0)])
    found = overestimation(both, 0.99, n_layouts=3, max_steps=60)["overestimation"]
    assert math.isnan(found[0])
    assert found[1] > 1


def test_overestimation_of_a_seed_does_not_depend_on_the_others(tmp_path):
    both = overestimation(population(tmp_path, (4, 5)), 0.99, steps=20, n_layouts=3)
    alone = overestimation(population(tmp_path, (5,)), 0.99, steps=20, n_layouts=3)
    pd.testing.assert_frame_equal(both[both["seed"] == 5].reset_index(drop=True), alone)
    assert both["q"].nunique() == 2


@pytest.mark.parametrize(
    ("gamma", "n_layouts", "message"),
    [(None, 3, "gamma=None; give a discount"), (0.9, 1001, "give 1 to 1000 layouts")],
)
def test_what_has_no_overestimation_is_refused(tmp_path, gamma, n_layouts, message):
    with pytest.raises(ValueError, match=message):
        overestimation(population(tmp_path), gamma, n_layouts=n_layouts)


# -- their files ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_the_runs_own_protocol_leaves_them_and_another_does_not(algorithm, tmp_path, monkeypatch):
    monkeypatch.setattr(Protocol.__new__, "__defaults__", ("test", 3, 40, None, "drone", None, False))
    monkeypatch.setattr(evaluation, "WATCHED_STEPS", 60)
    monkeypatch.setattr(overestimation, "__defaults__", (20, 3, 10_000))
    run = Run(write_policies(tmp_path / "run", algorithm, seed=4, n_seeds=2, gamma=0.9))
    evaluate_run(run, 2, 40)
    assert [name for name in (ARENA, VALUES) if (run.path / name).exists()] == []
    evaluate_run(run, 3, 40)
    empty = pd.read_parquet(run.path / ARENA)
    modes = by_mode(load_policies(run.path))
    pd.testing.assert_frame_equal(empty, in_empty_arena(modes))
    if run.algorithm == "dqn":
        pd.testing.assert_frame_equal(
            pd.read_parquet(run.path / VALUES), overestimation(modes["greedy"], 0.9)
        )
    assert (run.path / VALUES).exists() == (run.algorithm == "dqn")


def test_what_the_workers_of_a_configuration_leave_is_joined_to_what_one_evaluation_of_all_seeds_leaves(
    tmp_path,
):
    whole = {
        ARENA: pd.DataFrame(
            {"seed": [4, 4, 5, 4, 5], "action": range(5), "mode": ["greedy"] * 3 + ["sampled"] * 2}
        ),
        VALUES: pd.DataFrame({"seed": [4, 5], "q": [1.5, 2.5]}),
    }
    folders = [tmp_path / str(seed) for seed in (4, 5)]
    for name, table in whole.items():
        for seed, part in table.groupby("seed"):
            (tmp_path / str(seed)).mkdir(exist_ok=True)
            write_table(tmp_path / str(seed) / name, part)
    (tmp_path / "configuration").mkdir()
    _join_episodes(Configuration(dqn.DQNConfig(), tmp_path / "configuration"), folders)
    for name, table in whole.items():
        pd.testing.assert_frame_equal(pd.read_parquet(tmp_path / "configuration" / name), table)
    (folders[1] / VALUES).unlink()
    (tmp_path / "configuration" / VALUES).unlink()
    _join_episodes(Configuration(dqn.DQNConfig(), tmp_path / "configuration"), folders)
    assert not (tmp_path / "configuration" / VALUES).exists()  # of seed 4 alone
