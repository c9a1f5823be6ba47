"""Evaluation: one row a set of obstacles, repeatable, censored where it was cut off."""

import pytest
import torch

import uavnav
from uavnav.baselines import straight_ahead, uniform_random
from uavnav.evaluate import evaluate_policy
from uavnav.metrics import EPISODE_COLUMNS


def test_straight_ahead_in_an_empty_arena_hits_the_wall_at_step_28():
    rows = evaluate_policy(straight_ahead, uavnav.layouts.generate(5, k=0), episodes=5)
    assert dict(rows.dtypes.astype(str)) == EPISODE_COLUMNS
    assert rows.layout.tolist() == [0, 1, 2, 3, 4]
    assert rows.terminated.all()
    assert (rows.steps == 28).all()  # contact at 300 + 250 px: ceil(250 / 9)
    assert rows.reward.tolist() == pytest.approx([0.09 * 27 - 10] * 5, abs=1e-9)


def test_a_flight_that_never_hits_is_truncated_at_the_cap_and_no_collision():
    rows = evaluate_policy(
        lambda observation, generator: torch.zeros(len(observation), dtype=torch.int64), episodes=3, max_steps=7
    )
    assert rows.truncated.all()
    assert not rows.terminated.any()
    assert (rows.full_stops == 7).all()
    assert rows.reward.tolist() == pytest.approx([-0.07] * 3, abs=1e-9)


def test_evaluating_twice_gives_the_same_rows_and_another_seed_others():
    first, second = (evaluate_policy(uniform_random, episodes=50) for _ in range(2))
    assert first.equals(second)
    assert not first.equals(evaluate_policy(uniform_random, episodes=50, seed=1))


def test_the_uniform_policy_turns_in_90_stops_in_10_and_fully_stops_in_1_percent_of_its_steps():
    rows = evaluate_policy(uniform_random, episodes=1000)
    total = rows[["steps", "stops", "full_stops", "turns", "distance"]].sum()
    n = total.steps
    assert n > 30_000
    for share, expected in ((total.turns / n, 0.9), (total.stops / n, 0.1), (total.full_stops / n, 0.01)):
        assert abs(share - expected) < 4 * (expected * (1 - expected) / n) ** 0.5
    assert abs(total.distance / n - 4.5) < 4 * (8.25 / n) ** 0.5


@pytest.mark.parametrize("wrong", [{"episodes": 0}, {"episodes": 1001}, {"max_steps": 0}])
def test_counts_out_of_range_are_refused(wrong):
    with pytest.raises(ValueError, match="give 1 to 1000 episodes of at least 1 step"):
        evaluate_policy(straight_ahead, **wrong)
