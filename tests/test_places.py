"""Where drones fly without the steps before a crash, and by layout (claim 9): closed forms, a slow loop."""

import numpy as np
import pandas as pd
import pytest
import torch

from uavnav.evaluation import fly, on
from uavnav.report.behaviour import BEFORE_CRASH, COLUMNS, by_layout, early, measures, of_steps, retrace
from uavnav.report.claims import ACTIVATIONS, CLAIMS, COMPARED
from uavnav.report.studies import Studies, evidence_of
from uavnav.report.verdicts import REPLICATES, audit
from uavnav.tasks import layouts
from uavnav.tasks.baselines import BASELINES
from uavnav.tasks.table import make_task
from uavnav.tasks.world import World

WORLD = World()
# a corridor at (400, 300), on two layouts
TWO_CIRCLES = torch.tensor([[(300.0, 300.0, 40.0), (500.0, 300.0, 40.0)]] * 2)
INSIDE, OUTSIDE = (400, 300), (400, 120)


def episode(*stretches, seed=0, layout=0):
    """From (steps, pose, clearance), one after the other."""
    rows = [(*pose, clearance) for steps, pose, clearance in stretches for _ in range(steps)]
    table = pd.DataFrame(rows, columns=["x", "y", "clearance"])
    return table.assign(
        seed=seed, layout=layout, step=range(1, len(rows) + 1), heading=90, action=0, mode="sampled"
    )


def steps_of(*episodes):
    table = pd.concat(episodes, ignore_index=True)
    return of_steps(
        table.astype({name: kind for name, kind in COLUMNS.items() if name in table}), TWO_CIRCLES, WORLD
    )


def test_the_40_steps_before_a_crash_do_not_count_and_those_before_the_limit_do():
    crash = episode((10, OUTSIDE, 100.0), (39, INSIDE, 60.0), (1, INSIDE, 30.0), seed=0)
    truncated = episode((10, OUTSIDE, 100.0), (40, INSIDE, 60.0), seed=1)
    short = episode((39, OUTSIDE, 60.0), (1, OUTSIDE, 29.0), seed=2)
    steps = steps_of(crash, truncated, short)
    assert BEFORE_CRASH == 40
    assert steps.groupby("seed")["late"].sum().tolist() == [40, 0, 40]
    found = early(steps).loc["sampled"].dropna()
    assert found.index.tolist() == [0, 1]  # of seed 2 nothing is left
    assert found["corridor_early"].tolist() == [0.0, 0.8]
    assert found["clearance_early"].tolist() == [100.0, 68.0]


def test_on_a_layout_each_seed_weighs_the_same_however_long_it_flew():
    first = [episode((90, OUTSIDE, 100.0), seed=0), episode((10, INSIDE, 60.0), seed=1)]
    second = [
        episode((2, OUTSIDE, 50.0), (6, INSIDE, 70.0), seed=0, layout=1),
        episode((1, INSIDE, 45.0), seed=1, layout=1),
    ]
    found = by_layout(steps_of(*first, *second))
    assert found["layout"].tolist() == [0, 1]
    assert found["corridor_by_layout"].tolist() == [0.5, 0.875]
    assert found["clearance_by_layout"].tolist() == [80.0, 55.0]


def test_episodes_on_test_layouts_agree_with_a_slow_loop():
    n, all_layouts = 6, layouts.load("test")
    flown = fly({3: BASELINES["random"], 4: BASELINES["straight"]}, on(make_task(), "test", n, 150))
    table = retrace(flown.behaviour.assign(mode="sampled"), all_layouts[:n], torch.full((n,), 90), WORLD)
    kept, first, means = [], [], {}
    for (_, layout), one in table.groupby(["seed", "layout"]):
        crashed = one["clearance"].iloc[-1] <= WORLD.drone_radius
        assert crashed == (len(one) < 150)
        first.append(one[:50])
        kept.append(one[: max(len(one) - 40, 0)] if crashed else one)
        means.setdefault(layout, []).append(
            measures(one, all_layouts, WORLD)[["corridor", "clearance"]].iloc[0]
        )
    slow, of_first = (
        measures(pd.concat(own), all_layouts, WORLD).set_index("seed")[["corridor", "clearance"]]
        for own in (kept, first)
    )
    steps = of_steps(table, all_layouts, WORLD)
    assert 0 < steps["late"].sum() < len(steps)
    fast = early(steps).loc["sampled"]
    assert fast["corridor_early"].notna().sum() == len(slow)  # of the others all steps are late
    assert fast.filter(like="_early").dropna().to_numpy() == pytest.approx(slow.to_numpy())
    assert fast.filter(like="_first").to_numpy() == pytest.approx(of_first.loc[fast.index].to_numpy())
    slow_by_layout = np.array([np.mean(own, axis=0) for own in means.values()])
    assert by_layout(steps).iloc[:, 2:].to_numpy() == pytest.approx(slow_by_layout)


def test_claim_9_is_judged_by_layout_with_one_number_a_set_of_obstacles():
    """Sets differ far more than algorithms do; DQN is one hundredth above PPO on each, give or take a
    little.
    """
    places = np.array([0.1, 0.9, 0.4, 0.2, 0.7, 0.3])
    little = np.array([1.0, -1.0, 0.5, -0.5, 0.2, -0.2]) / 1000
    configurations = {("main", one, other): None for one in COMPARED for other in ACTIVATIONS}
    tables = {}
    for place in configurations:
        values = places + (0.01 + little if place[1] == "dqn" else 0.0)
        rows = pd.DataFrame({"mode": "sampled", "layout": range(6), "corridor_by_layout": values})
        tables[place] = pd.concat([rows.assign(mode="greedy", corridor_by_layout=0.0), rows])
    studies = Studies({key[1:]: "a configuration" for key in configurations}, {}, {}, {}, {}, {}, {}, [])
    evidence = evidence_of(studies, "per frame", {}, tables)
    assert evidence("ppo", "tanh", "corridor_by_layout") == pytest.approx(places)

    def known(algorithm, activation, metric, study="main"):
        return evidence(algorithm, activation, metric) if metric == "corridor_by_layout" else np.empty(0)

    findings = audit(known, lambda *term: np.empty(0), [claim for claim in CLAIMS if claim.number == 9])
    (found,) = [one for one in findings if one.n]
    assert "between two close obstacles, layouts resampled" in found.text
    assert (found.n, found.verdict) == (6, REPLICATES)
    assert found.value == pytest.approx(0.01)
