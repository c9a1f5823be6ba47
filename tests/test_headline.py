"""The tables behind the findings, on made-up cells: gaps to the rule, effects, peaks, fits, sizes of studies."""

from types import SimpleNamespace

import matplotlib
import numpy as np
import pandas as pd
import pytest

from uavnav import stats, style
from uavnav.report import charts, curves, figures, headline
from uavnav.report.cells import EMPTY, Cell
from uavnav.report.studies import Studies
from uavnav.runs.metrics import EPISODE_COLUMNS
from uavnav.runs.readings import SAMPLED

KEY = ("dqn", "sigmoid")
NONE = Studies({}, {}, {}, {}, {}, {}, {}, [])


def test_the_first_figure_shows_the_means_and_intervals_of_the_table_of_gaps():
    gaps = pd.DataFrame(
        [("PPO tanh", "sampled", 10_000, 2, 4.0, -1.5, 9.5), ("PPO relu", "greedy", 10_000, 2, 9.0, 8.0, 10.0)],
        columns=["who", "mode", "cap", "n", "reward", "low", "high"],
    )
    seeds = pd.DataFrame({"algorithm": "ppo", "activation": ["tanh"] * 2, "value": [3.0, 5.0]})
    (figure,) = figures._first(seeds.assign(reading=SAMPLED, metric="reward"), gaps, style.WIDTH)
    assert figure.drawn.alt == "reward a flight, new obstacles: PPO tanh 4.00 (95 % interval -1.50 to 9.50; n = 2)."
    assert "after 10,000 steps" in figure.caption


def flights(*rows):
    """From (seed, layout, steps, reward, cut off)."""
    full = [(seed, 0, 0, layout, steps, 0, 0, 0, 0, reward, not cut, cut) for seed, layout, steps, reward, cut in rows]
    return pd.DataFrame(full, columns=list(EPISODE_COLUMNS)).astype(EPISODE_COLUMNS)


def cell(*seeds, frames=1_000_000, flown=EMPTY, key=KEY):
    """A cell from the rewards of each seed's ten stretches of 100,000 frames, each one flight."""
    rows = [
        (seed, (place + 1) * 100_000, 0, 0, 100_000, 0, 0, 0, 0, reward - 10, True, False)
        for seed, rewards in enumerate(seeds)
        for place, reward in enumerate(rewards)
    ]
    episodes = pd.DataFrame(rows, columns=list(EPISODE_COLUMNS)).astype(EPISODE_COLUMNS)
    runs = [SimpleNamespace(seeds=list(range(len(seeds))))]
    return Cell(*key, {"frames": frames, "n_envs": 1}, runs, episodes, flown)


RULE = flights((0, 0, 100, 40.0, True), (0, 1, 100, 60.0, True))


def test_the_gap_is_each_seeds_mean_over_the_sets_that_the_rule_flew_with_students_interval():
    """Seed 0 is 10 and 30 below the rule, seed 1 20 above and 0: gaps of -20 and 10, which differ by 30."""
    mine = [(0, 0, 100, 30.0, True), (0, 1, 50, 30.0, False), (1, 0, 100, 60.0, True), (1, 1, 100, 60.0, True)]
    greedy = [(0, 0, 100, 40.0, True)]
    flown = pd.concat([flights(*mine).assign(mode="sampled"), flights(*greedy).assign(mode="greedy")])
    rule, first, second = headline.gaps({KEY: cell([0.0], flown=flown)}, {"reactive": RULE}).to_dict("records")
    assert (rule["who"], rule["reward"], rule["up"], rule["per_frame"], rule["cap"]) == ("reactive", 50, 1, 0.5, 100)
    assert np.isnan([rule["gap"], rule["above"], rule["low"]]).all()
    assert (first["mode"], first["gap"], first["n"], first["above"]) == ("greedy", 0, 1, 0)
    assert np.isnan(first["gap_low"])
    assert (second["who"], second["mode"], second["n"], second["flights"]) == ("DQN sigmoid", "sampled", 2, 4)
    assert (second["reward"], second["up"], second["gap"], second["above"]) == (45, 0.75, -5, 0.5)
    half = 12.706 * 15  # t with one degree of freedom, times 30 / 2
    assert (second["gap_low"], second["gap_high"]) == pytest.approx((-5 - half, -5 + half), rel=1e-4)
    assert second["per_frame"] == pytest.approx((60 / 150 + 120 / 200) / 2)


@pytest.mark.parametrize(
    "mine",
    [
        [(0, 0, 40, 30.0, True)],  # below another cap
        [(0, 2, 100, 30.0, True)],  # on a set that the rule did not fly
    ],
)
def test_flights_of_another_test_have_no_gap(mine):
    own = cell([0.0], flown=flights(*mine).assign(mode="sampled"))
    found = headline.gaps({KEY: own}, {"reactive": RULE})
    assert found["gap"].isna().all()
    assert found["reward"].tolist() == [50, 30]
    assert headline.gaps({KEY: own}, {})["gap"].isna().all()
    assert headline.gaps({}, {}).empty


def test_an_effect_is_the_setting_minus_as_decided_over_the_activations_of_both():
    def of(*rewards, activation="tanh"):
        return cell(*([reward] * 10 for reward in rewards), key=("dqn", activation))

    usual = {("dqn", "tanh"): of(0.0, 200.0), ("dqn", "relu"): of(50.0, 150.0, activation="relu")}
    switch = {("dqn", "tanh"): of(600.0, 1000.0), ("ppo", "tanh"): of(9.0, 9.0)}
    found = headline.effects(NONE._replace(baseline=usual, switches={"n_steps=5": switch}))
    (row,) = found.to_dict("records")
    expected = stats.difference([np.array([0.006, 0.01])], [np.array([0.0, 0.002])])
    assert (row["switch"], row["algorithm"], row["frames"], row["n"]) == ("n_steps=5", "dqn", 1_000_000, 2)
    assert (row["value"], row["low"], row["high"]) == pytest.approx(expected[:3])
    assert row["value"] == pytest.approx(0.007)
    both = headline.effects(NONE._replace(main=usual, vectorised={("dqn", "tanh"): of(0.0, 0.0)}))
    assert both[["switch", "algorithm", "value"]].to_numpy().tolist() == [
        ["many environments", "dqn", pytest.approx(-0.001)]
    ]
    assert headline.effects(NONE).empty


def test_a_cell_that_rises_by_100_and_falls_by_75_loses_three_quarters_and_peaks_where_it_is_best():
    """Rewards of 0 a stretch of 100,000 frames, 100 in the next three, 25 at the end; others up to 1.4 times it."""
    seed = np.array([0, 0, 0, 100, 100, 101, 25, 25, 25, 25.0])
    found = headline.peaks({KEY: cell(*(seed * times for times in (1, 1.1, 1.2, 1.3, 1.4)))}).set_index("measure")
    assert found.loc["lost", "value"] == pytest.approx((301 / 3 - 25) / (301 / 3))
    assert found.loc["lost", "low"] == pytest.approx(found.loc["lost", "high"])  # the share is the same in both
    assert found.loc["peak", "value"] == pytest.approx(540_000)  # the first of the stretches of 40,000 frames within
    assert headline.peaks({KEY: cell(seed, frames=600_000)}).empty


def test_numbers_within_are_counted_for_all_cells_and_for_each_and_those_without_seeds_are_left_out():
    """A number of 10 in an interval of 4 scores 4 / 10; one 3 beside an interval of 6 scores (6 + 40 x 3) / 10."""
    rows = [
        ("ppo", "tanh", 10.0, 8.0, 12.0, True, 8),
        ("ppo", "tanh", -10.0, -7.0, -1.0, False, 8),
        ("dqn", "relu", 10.0, 7.0, 13.0, True, 8),
        ("dqn", "tanh", 10.0, np.nan, np.nan, False, 0),
    ]
    columns = ["algorithm", "activation", "paper", "low", "high", "within", "n"]
    table = pd.DataFrame(rows, columns=columns).assign(reading="per frame")
    found = headline.fits(table).set_index("cell")
    assert found[["within", "numbers"]].T.to_dict("list") == {
        "all cells": [2, 3],
        "DQN relu": [1, 1],
        "PPO tanh": [1, 2],
    }
    assert found["score"].round(9).to_dict() == {"all cells": 4.533333333, "DQN relu": 0.6, "PPO tanh": 6.5}
    assert headline.fits(table[:0]).empty


def test_each_study_has_a_row_a_cell_and_the_main_one_those_of_the_papers_activations():
    key, other = ("ppo", "tanh"), ("ppo", "mish")
    main = {key: cell([0.0], [0.0], key=key), other: cell([0.0], key=other)}
    found = headline.cells(NONE._replace(main=main, switches={"k=4": {other: cell([0.0], key=other, frames=300_000)}}))
    assert found.to_numpy().tolist() == [["main", *key, 2, 1_000_000, 1], ["k=4", *other, 1, 300_000, 1]]


def test_the_rule_is_a_dashed_line_beside_cells_and_among_flights_and_cells_without_it_have_none():
    rows = {"PPO tanh": np.array([1.0, 2.0]), "DQN tanh": np.array([0.0, 1.0])}
    drawn = charts.intervals(rows, {}, "reward", 428.0)
    for axes in drawn.figure.axes:
        assert [line.get_xdata()[0] for line in axes.lines if line.get_linestyle() == "--"] == [428.0]
    assert drawn.alt.endswith("; hand-written rule 428.0.")
    assert "the paper" not in words(drawn.figure)  # of which there is no number
    assert style.RULE in words(drawn.figure)
    assert style.RULE not in words(charts.intervals(rows, {}, "reward").figure)
    up = pd.Series([1.0, 1.0], index=[0.0, 100.0])
    (axes,) = curves.survival({"PPO tanh": pd.Series([1.0, 0.5], index=[0.0, 10.0]), style.RULE: up}, 100).figure.axes
    mine, rule, _ = axes.lines
    assert (mine.get_linestyle(), rule.get_linestyle(), rule.get_label()) == ("-", "--", style.RULE)
    assert rule.get_ydata().tolist() == [1.0, 1.0]


def words(figure):
    return {text.get_text() for text in figure.findobj(matplotlib.text.Text)}
