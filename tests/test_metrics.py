"""The six metrics in each metric definition, by hand on three episodes."""

import pandas as pd
import pytest
from runs_by_hand import rows

from uavnav.runs import paper
from uavnav.runs.metrics import METRICS, Metric, finished, in_order, last_episodes, per_seed


@pytest.fixture
def episodes():
    first = rows(
        0,
        (100, 100, 10, 1, 90, 450, -10.0),
        (400, 300, 0, 0, 150, 2700, 5.0),
        (500, 999, 999, 999, 0, 0, -9.99, False, False),  # still open: in no mean
    )
    second = rows(1, (50, 50, 5, 5, 45, 0, -10.0, False, True))
    return pd.concat([first, second], ignore_index=True)


def test_counts_are_means_over_each_seeds_episodes(episodes):
    result = per_seed(episodes)
    assert result.loc[0, ["steps", "distance", "reward"]].tolist() == [200, 1575, -2.5]
    assert result.loc[1, ["steps", "distance", "reward"]].tolist() == [50, 0, -10]


def test_a_mean_of_ratios_weighs_episodes_and_a_ratio_of_means_weighs_steps(episodes):
    names = ["stops", "full_stops", "turns", "speed"]
    assert per_seed(episodes).loc[0, names].tolist() == pytest.approx([5.0, 0.5, 70.0, 6.75])
    assert per_seed(episodes, ratio_of_means=True).loc[0, names].tolist() == pytest.approx(
        [2.5, 0.25, 60.0, 7.875]
    )


def test_open_episodes_are_in_no_reading(episodes):
    assert len(finished(episodes)) == 3


def test_episodes_in_order_are_those_of_each_seed_by_their_frame_and_world(episodes):
    found = in_order(episodes.iloc[[3, 1, 2, 0]])
    assert found.index.tolist() == [0, 1, 3]
    assert in_order(found) is found  # as it is


def test_the_last_episodes_are_each_seeds_own(episodes):
    assert last_episodes(episodes, 1).frame.tolist() == [400, 50]
    assert len(last_episodes(episodes, 100)) == 3


@pytest.mark.parametrize("ratio_of_means", [False, True])
def test_a_metric_of_a_column_that_a_run_lacks_is_nan_and_the_others_are_as_before(
    episodes, monkeypatch, ratio_of_means
):
    before = per_seed(episodes, ratio_of_means)
    monkeypatch.setitem(METRICS, "near", Metric("near misses", "near", 100.0, unit="%"))
    monkeypatch.setitem(METRICS, "nears", Metric("near misses", "near"))
    result = per_seed(episodes, ratio_of_means)
    assert result[["near", "nears"]].isna().all(axis=None)
    pd.testing.assert_frame_equal(result[before.columns], before)
    joined = pd.concat([episodes[episodes["seed"] == 0], episodes[episodes["seed"] == 1].assign(near=5)])
    assert per_seed(joined, ratio_of_means)["near"].tolist() == [pytest.approx(float("nan"), nan_ok=True), 10]


def test_a_metric_in_words_has_its_unit_and_the_direction_that_is_better():
    assert [str(metric) for metric in METRICS.values()] == [
        *("steps per episode", "stops [%]", "full stops [%]", "turning [%]", "distance per episode [px]"),
        *("speed [px a step]", "reward per episode"),
    ]
    assert [name for name, metric in METRICS.items() if metric.better < 0] == ["stops", "full_stops", "turns"]


def test_the_papers_tables_hold_8_configurations_of_6_metrics_that_we_have_too():
    assert len(paper.TABLES) == 8
    assert all(set(row) == set(paper.COLUMNS) <= set(METRICS) for row in paper.TABLES.values())
    assert paper.TABLES["ppo", "tanh"]["reward"] == 88.527
    assert paper.TABLES["dqn", "sigmoid"]["speed"] == 4.984
