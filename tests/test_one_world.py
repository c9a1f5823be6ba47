"""What one environment a seed changes beside the mean, on made-up studies of known scatter, open flights, order."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy.stats import spearmanr

from uavnav import stats
from uavnav.report import headline
from uavnav.report.cells import EMPTY, Cell
from uavnav.report.studies import Studies
from uavnav.runs.metrics import EPISODE_COLUMNS

FRAMES = 1_000_000
NONE = Studies({}, {}, {}, {}, {}, {}, {}, [])


def study(n_envs=1, **cells):
    """Cells of DQN, an activation each, from (reward in the last 100,000 frames, steps of each open flight) a seed.

    Whatever is not open is one flight of all frames until then; each open flight earns nothing.
    """
    made = {}
    for activation, seeds in cells.items():
        rows = []
        for seed, (reward, *flights) in enumerate(seeds):
            rows.append((seed, FRAMES - 100_000, 0, 0, 800_000, 0, 0, 0, 0, -10.0, True, False))
            rows.append((seed, FRAMES, 0, 0, 100_000 // n_envs, 0, 0, 0, 0, reward - 10, True, False))
            rows += [(seed, FRAMES, 0, 0, steps, 0, 0, 0, 0, 0.0, False, False) for steps in flights]
        episodes = pd.DataFrame(rows, columns=list(EPISODE_COLUMNS)).astype(EPISODE_COLUMNS)
        runs = [SimpleNamespace(seeds=list(range(len(seeds))))]
        settings = {"frames": FRAMES, "n_envs": n_envs}
        made["dqn", activation] = Cell("dqn", activation, settings, runs, episodes, EMPTY)
    return made


def worlds(one, many):
    return headline.worlds(NONE._replace(main=one, vectorised=many)).set_index("measure")


def spread(middle, half):
    """Five seeds whose standard deviation is `half`."""
    return [(middle + half * one,) for one in (-1.0, -1.0, 0.0, 1.0, 1.0)]


def test_scatter_is_the_difference_of_standard_deviations_late_in_training_mean_over_activations():
    one = study(tanh=spread(5e3, 1000.0), relu=spread(9e3, 3000.0))
    many = study(16, tanh=spread(0.0, 500.0), relu=spread(3e3, 500.0), sigmoid=spread(0.0, 9e9))
    row = worlds(one, many).loc["scatter"]
    scale = stats.deviations(np.array([-1.0, -1.0, 0.0, 1.0, 1.0])).mean()  # the jackknife's, of a deviation of 1
    assert scale == pytest.approx(1, abs=0.1)
    assert row["value"] == pytest.approx(scale * (0.01 + 0.03 - 0.005 - 0.005) / 2)
    assert (row["algorithm"], row["n"]) == ("dqn", 5)
    assert row["low"] < row["value"] < row["high"]


def test_open_flights_are_those_of_each_seed_that_no_crash_ended():
    one = study(tanh=[(0.0, 600_000), (0.0, 200_000), (0.0,)])
    many = study(16, tanh=[(0.0, 30_000, 10_000), (0.0, 20_000, 20_000), (0.0, 40_000)])
    found = worlds(one, many)
    assert found.loc["longest", "value"] == pytest.approx((600_000 + 200_000 + 0 - 30_000 - 20_000 - 40_000) / 3)
    assert found.loc["open", "value"] == pytest.approx((0.6 + 0.2 + 0 - 3 * 0.04) / 3)


def test_the_order_is_spearmans_correlation_of_the_activations_means():
    rewards = {"tanh": 4e4, "sigmoid": 1e4, "relu": 3e4, "leaky_relu": 2e4}
    one = study(**{name: spread(own, 1.0) for name, own in rewards.items()})
    row = worlds(one, one).loc["order"]
    assert row[["value", "low", "high"]].tolist() == pytest.approx([1, 1, 1])
    turned = study(16, **{name: spread(-own, 1.0) for name, own in rewards.items()})
    assert worlds(one, turned).loc["order", ["value", "low", "high"]].tolist() == pytest.approx([-1, -1, -1])


def test_without_a_study_in_one_world_there_is_nothing_to_compare():
    main = study(16, tanh=spread(0.0, 1.0))
    assert headline.worlds(NONE._replace(main=main)).empty
    assert [*headline.worlds(NONE)] == ["measure", "algorithm", "value", "low", "high", "n"]


def test_the_jackknifes_deviations_are_a_slow_loops_and_their_mean_is_nearly_the_standard_deviation():
    seeds = np.random.default_rng(0).normal(3, 2, size=12)
    slow = [12 * np.std(seeds, ddof=1) - 11 * np.std([*seeds[:i], *seeds[i + 1 :]], ddof=1) for i in range(12)]
    assert stats.deviations(seeds) == pytest.approx(slow)
    assert stats.deviations(seeds).mean() == pytest.approx(seeds.std(ddof=1), rel=0.05)
    assert np.isnan(stats.deviations(np.array([1.0, 2.0]))).all()
    assert stats.deviations(np.full(5, 7.0)).tolist() == [0.0] * 5


@pytest.mark.parametrize("n", [20, 40])
def test_the_interval_of_a_difference_of_deviations_covers_it_in_about_95_percent_of_400_draws(n):
    rng, covered = np.random.default_rng(n), 0
    for _ in range(400):
        first, second = rng.normal(0, 5, size=(4, n)), rng.normal(0, 2, size=(4, 20))
        found = stats.difference([*map(stats.deviations, first)], [*map(stats.deviations, second)])
        covered += found.low <= 3 <= found.high
    assert 0.91 <= covered / 400 <= 0.98


def test_ranks_correlate_as_scipys_do_and_their_interval_widens_with_scatter():
    rng = np.random.default_rng(2)
    first = [rng.normal(mean, 0.1, size=20) for mean in (0, 3, 1, 2)]
    second = [rng.normal(mean, 0.1, size=40) for mean in (0, 3, 2, 1)]
    found = stats.rank_correlation(first, second)
    expected = spearmanr([own.mean() for own in first], [own.mean() for own in second]).statistic
    assert (found.value, found.n) == (pytest.approx(expected), 20)
    assert (found.low, found.high) == (pytest.approx(0.8), pytest.approx(0.8))  # no draw changes places
    wide = stats.rank_correlation([10 * rng.normal(size=20) + own for own in first], second)
    assert wide.high - wide.low > 0.5


def test_ranks_of_one_cell_of_one_seed_or_of_equal_means_have_no_correlation():
    two = [np.array([1.0, 2.0]), np.array([3.0, 4.0])]
    for first in (two[:1], [np.array([1.0]), two[1]], [two[0], two[0]]):
        assert np.isnan(stats.rank_correlation(first, two[: len(first)])[:3]).all()
