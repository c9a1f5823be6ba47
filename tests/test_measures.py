"""Danger, separation, curvature, jerk and BARN's score, held to arithmetic and to a loop over poses."""

import numpy as np
import pandas as pd
import pytest
import torch

from uavnav.evaluation import episodes, fly_modes, on
from uavnav.report.tables import side_by_side
from uavnav.runs import metrics
from uavnav.runs.policies import load_policy
from uavnav.tasks.baselines import straight_ahead, uniform_random
from uavnav.tasks.table import EMPTY, make_task


def flown(policy, task, measures=True):
    return fly_modes({"": {0: policy}}, task, measures=measures).episodes


def test_straight_to_the_wall_is_28_steps_of_9_px_of_which_4_end_within_30_px_of_it():
    task = on(make_task(EMPTY), torch.empty(1, 0, 3), 1, 100)
    (row,) = flown(straight_ahead, task).to_dict("records")
    # the wall's edge is 250 px from the drone's: after n steps 250 - 9 n are left
    assert row["danger"] == sum(250 - 9 * n < 30 for n in range(1, 29)) == 4
    assert row["separation"] == 250 - 9 * 28 == -2
    assert row["turned"] == 0
    assert row["jerk"] == pytest.approx(9 + 9)  # 0 to 9 px a step at once, and then no more


@pytest.mark.parametrize("name", ["drone", "space"])
def test_of_random_actions_they_are_those_of_a_loop_over_its_poses(name):
    task = on(make_task(EMPTY, task=name), "validation", 3, 60)
    rows = flown(uniform_random, task)
    poses = {place: [] for place in range(3)}
    for step in episodes.steps([(0, uniform_random)], task):
        for at, place in enumerate(step.episode.tolist()):
            state = [float(getattr(step.state, one)[at]) for one in step.state._fields if one in "xyz"]
            angles = [
                int(getattr(step.state, one)[at]) for one in ("heading", "pitch") if hasattr(step.state, one)
            ]
            poses[place].append((state, angles, float(step.outcome.clearance[at]) - 30))
    for place, own in poses.items():
        row, start = rows.iloc[place], [*task.world.start]
        places = np.array([start, start, start, *(one for one, _, _ in own)])
        angles = np.array([[90, 0][: len(own[0][1])], *(one for _, one, _ in own)])
        jerk = np.linalg.norm(np.diff(places, 3, axis=0), axis=1).sum()
        turned = np.abs((np.diff(angles, axis=0) + 180) % 360 - 180).sum()
        assert row["jerk"] == pytest.approx(jerk, rel=1e-4)
        assert (row["turned"], row["danger"]) == (turned, sum(gap < 30 for _, _, gap in own))
        assert row["separation"] == pytest.approx(min(gap for _, _, gap in own), abs=1e-4)


def test_all_other_columns_stay_as_they_are_also_where_a_greedy_policy_goes_round():
    task, policy = on(make_task(EMPTY), "test", 10, 1_500), load_policy("ppo-tanh")
    without, with_ = flown(policy, task, measures=False), flown(policy, task)
    assert without.truncated.any()
    assert without.equals(with_[[*without]])
    assert {*with_} - {*without} == {"danger", "separation", "turned", "jerk"}


def test_danger_is_a_share_of_time_curvature_a_turn_in_100_px_and_jerk_a_mean_of_steps():
    rows = pd.DataFrame({"seed": 0, "steps": [8, 12], "distance": [50, 150], "danger": [3, 1],
                         "separation": [5.0, 25.0], "turned": [30, 10], "jerk": [6.0, 4.0]})  # fmt: skip
    own = metrics.own(rows).loc[0].to_dict()
    assert own == {"danger": 20, "separation": 15, "curvature": 20, "jerk": 0.5}


def test_barns_score_is_a_quarter_at_best_and_counts_only_successes():
    goal = {"seed": 0, "succeeded": [1, 1, 1, 0], "shortest": 90.0, "steps": [20, 50, 200, 20], "danger": 1}
    rows = pd.DataFrame(goal | {"terminated": True, "truncated": False, "distance": 100})
    # optimal: 10 steps; clipped to 40 and 80
    assert metrics.barn(rows).mean() == pytest.approx((10 / 40 + 10 / 50 + 10 / 80 + 0) / 4)
    assert metrics.own(rows.drop(columns="danger")).columns.tolist() == [
        "success",
        "collision",
        "time_out",
        "spl",
    ]


def test_beside_each_other_who_was_evaluated_without_them_shows_a_dash():
    task = on(make_task(EMPTY), "validation", 4, 50)
    tables = {
        name: metrics.per_seed(rows).join(metrics.own(rows))
        for name, rows in {
            "with": flown(straight_ahead, task),
            "without": flown(straight_ahead, task, measures=False),
        }.items()
    }
    (row,) = [row for row in side_by_side(tables) if row[0] == "time in danger [%]"]
    assert row[2] == "–"
    assert float(row[1].split()[0]) > 5
