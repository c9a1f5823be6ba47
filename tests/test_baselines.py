"""Scripted policies, whose episodes are known: by chance, by arithmetic, or by a proof that they never
collide.
"""

import math
from pathlib import Path

import pandas as pd
import pytest
import torch

import uavnav
from uavnav.evaluation import evaluate_policy, fly
from uavnav.tasks.baselines import BASELINES, reactive, straight_ahead, suited, uniform_random
from uavnav.tasks.table import make_task

EMPTY = uavnav.layouts.generate(3, k=0)
COMMITTED = Path(__file__).parent.parent / "results" / "baselines" / "reactive.parquet"
LEFT_IN_PLACE = 50  # 5 degrees, 0 px


def test_uniform_policy_turns_in_90_stops_in_10_and_fully_stops_in_1_percent_of_its_steps_at_4_5_px_each():
    rows = evaluate_policy(uniform_random, episodes=200)
    total = rows[["steps", "stops", "full_stops", "turns", "distance"]].sum()
    n = total.steps
    assert n > 5_000
    for count, share in ((total.turns, 0.9), (total.stops, 0.1), (total.full_stops, 0.01)):
        assert count / n == pytest.approx(share, abs=4 * math.sqrt(share * (1 - share) / n))
    # (10^2 - 1) / 12 px^2 a step
    assert total.distance / n == pytest.approx(4.5, abs=4 * math.sqrt(8.25 / n))
    assert rows.terminated.all()


def test_the_uniform_policy_takes_all_100_actions_by_its_generator_alone():
    draws = [uniform_random(torch.zeros(2000, 30), torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)]
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])
    assert set(draws[0].tolist()) == set(range(100))


def test_straight_ahead_in_an_empty_arena_earns_27_times_0_09_less_10():
    # contact at 580 - 30 px: ceil(250 / 9) = 28 steps
    rows = evaluate_policy(straight_ahead, EMPTY, episodes=3)
    assert (
        rows[["steps", "distance", "turns", "stops", "full_stops"]].to_numpy().tolist()
        == [[28, 252, 0, 0, 0]] * 3
    )
    assert rows.reward.tolist() == pytest.approx([27 * 0.09 - 10] * 3, abs=1e-9)
    assert rows.terminated.all()


@pytest.mark.parametrize(("edge", "steps"), [(50, 3), (57, 3), (57.5, 4), (150, 14)])
def test_straight_ahead_hits_a_circle_above_it_after_its_edges_distance_less_30_px_in_steps_of_9(edge, steps):
    rows = evaluate_policy(straight_ahead, torch.tensor([[[400, 300 + edge + 40, 40.0]]]), episodes=1)
    assert rows.steps.item() == steps == math.ceil((edge - 30) / 9)
    assert rows.reward.item() == pytest.approx(0.09 * (steps - 1) - 10, abs=1e-9)


@pytest.mark.slow
def test_reactive_flies_the_committed_rows_10000_steps_and_3000_px_on_200_test_layouts_without_a_collision():
    rows = evaluate_policy(reactive, episodes=200, max_steps=10_000)
    pd.testing.assert_frame_equal(pd.read_parquet(COMMITTED)[rows.columns], rows)
    assert rows.truncated.all()
    assert rows.steps.mean() == 10_000
    assert rows.distance.mean() > 3_000
    assert rows.distance.min() > 3_000
    assert rows.full_stops.sum() == 0  # where it stops it turns
    assert (rows.distance == 9 * (rows.steps - rows.turns)).all()
    assert rows.reward.tolist() == pytest.approx(
        (0.01 * rows.distance - 0.01 * rows.turns).tolist(), abs=1e-8
    )


def observation(right, forward, distance):
    """One obstacle `distance` px away, and nine empty slots."""
    slots = torch.tensor([[0.0, 0.0, 1.0]] * 10)
    slots[0] = torch.tensor([right, forward, (distance - 30) / 90])
    return slots.flatten()


@pytest.mark.parametrize(
    ("right", "forward", "distance", "action"),
    [
        (0.0, 1.0, 39.1, 9),  # ahead: 0.1 px are left after a step
        (0.0, 1.0, 38.9, LEFT_IN_PLACE),
        (1.0, 0.0, 30.1, 9),  # beside: comes no nearer
        (0.8, 0.6, 35.5, 9),  # 9 x 0.6 = 5.4 px nearer at the most
        (0.8, 0.6, 35.3, LEFT_IN_PLACE),
    ],
)
def test_reactive_goes_straight_as_long_as_9_px_towards_the_obstacle_leave_30(
    right, forward, distance, action
):
    assert reactive(observation(right, forward, distance)).item() == action


@pytest.mark.parametrize("name", BASELINES)
@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
def test_each_scripted_policy_answers_every_batch_shape_with_whole_numbers_below_100(name, shape):
    action = BASELINES[name](
        torch.rand(*shape, 50 if name == "orca" else 30), torch.Generator().manual_seed(0)
    )
    assert action.shape == shape
    assert action.dtype == torch.int64
    assert ((action >= 0) & (action < 100)).all()


FREE = {
    "drone": torch.empty(1, 0, 3),
    "moving": torch.empty(1, 0, 5),
    "goal": torch.tensor([[[600.0, 300.0, 160.0]]]),
    "space": torch.empty(1, 0, 4),
    "space-moving": torch.empty(1, 0, 7),
}
"""Sets without an obstacle."""


@pytest.mark.parametrize("task", FREE)
@pytest.mark.parametrize(
    "world",
    [
        {"n_slots": 12},
        {"padding": "zeros"},
        {"drone_radius": 40.0},
        {"sensor_radius": 70.0},
        {"sensor_radius": 130.0},
    ],
    ids=str,
)
def test_in_a_world_of_other_fields_reactive_flies_on_and_touches_no_wall(task, world):
    whole = make_task(FREE[task], world, task=task, max_steps=150)
    rows = fly({0: suited(BASELINES["reactive"], whole)}, whole).episodes
    assert rows["distance"].item() > 100
    assert rows["reward"].item() > 0


@pytest.mark.parametrize("name", BASELINES)
@pytest.mark.parametrize(
    ("task", "chosen"), [("drone", "10 turns and 10"), ("space-moving", "5 turns and 4")]
)
def test_a_scripted_policy_refuses_a_world_of_other_actions_in_one_line(name, task, chosen):
    whole = make_task("test", {"n_distances": 3}, task=task)
    with pytest.raises(
        ValueError, match=f"n_distances=3: scripted policies choose among {chosen} distances; leave them out"
    ):
        suited(BASELINES[name], whole)
