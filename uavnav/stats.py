"""Intervals and tests over training seeds. Seeds are resampled, never episodes alone; every number has its n.

scipy, statsmodels and lifelines compute; this module chooses the question and the rows. Letters: S seeds of a cell,
E episodes of a seed.
"""

from __future__ import annotations

import bisect
import itertools
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import statsmodels.formula.api as smf
from lifelines import KaplanMeierFitter
from lifelines.utils import restricted_mean_survival_time
from scipy import stats
from statsmodels.stats.multitest import multipletests
from statsmodels.stats.power import TTestIndPower

Array = np.ndarray[Any, np.dtype[np.float64]]

CONFIDENCE = 0.95
TAILS = (1 - CONFIDENCE) / 2, 1 - (1 - CONFIDENCE) / 2
RESAMPLES = 2_000
PERMUTATIONS = 19_999
"""Permutations per test; the smallest p value after Holm over 12 ordered pairs is 0.0006."""


class Interval(NamedTuple):
    """An estimate with its interval; the interval of a single seed is NaN."""

    value: float
    low: float
    high: float
    n: int


def interquartile_mean(values: Array, axis: int = -1) -> Any:
    """The mean of the middle half."""
    return stats.trim_mean(values, 0.25, axis=axis)


def interval(values: Sequence[float] | Array, statistic: Callable[..., Any] = np.mean, seed: int = 0) -> Interval:
    """A statistic of one number per seed [S], with its bootstrap interval over seeds.

    The interval is BCa, or of percentiles if BCa is undefined (few or equal seeds). Seeds with NaN (no episode) are
    left out. The interval of fewer than two seeds is NaN.
    """
    seeds = np.asarray(values, dtype=np.float64)
    seeds = seeds[~np.isnan(seeds)]
    value = float(statistic(seeds, axis=-1)) if len(seeds) else np.nan
    if len(seeds) < 2:
        return Interval(value, np.nan, np.nan, len(seeds))
    if np.ptp(seeds) == 0:
        return Interval(value, value, value, len(seeds))
    with warnings.catch_warnings(action="ignore"):  # scipy warns when BCa is undefined, and returns NaN
        for method in ("BCa", "percentile"):
            found = stats.bootstrap(
                (seeds,), statistic, n_resamples=RESAMPLES, confidence_level=CONFIDENCE, method=method, rng=seed
            ).confidence_interval
            if not np.isnan(found.low):
                break
    return Interval(value, float(found.low), float(found.high), len(seeds))


def contrast(values: Sequence[Array], statistic: Callable[..., Any], seed: int = 0) -> Interval:
    """A statistic of several cells, `statistic(a, b, ..., axis=-1)`, with its percentile bootstrap interval.

    values: [S] per cell. Each cell's seeds are resampled separately; n is the smallest cell's number of seeds.
    """
    samples = [np.asarray(one, dtype=np.float64) for one in values]
    n = min(len(one) for one in samples)
    value = float(statistic(*samples, axis=-1)) if n else np.nan
    if n < 2:
        return Interval(value, np.nan, np.nan, n)
    rng = np.random.default_rng(seed)
    drawn = [one[rng.integers(len(one), size=(RESAMPLES, len(one)))] for one in samples]
    low, high = np.quantile(statistic(*drawn, axis=-1), TAILS)
    return Interval(value, float(low), float(high), n)


def nested_interval(episodes: Mapping[int, Array], seed: int = 0) -> Interval:
    """The mean over seeds of each seed's mean over episodes: seeds are resampled, then episodes within each seed.

    episodes: seed -> [E].
    """
    rng = np.random.default_rng(seed)
    means = [float(np.mean(values)) for values in episodes.values()]
    if len(means) < 2:
        return Interval(means[0] if means else np.nan, np.nan, np.nan, len(means))
    drawn = np.stack(
        [values[rng.integers(len(values), size=(RESAMPLES, len(values)))].mean(1) for values in episodes.values()], 1
    )  # each seed's mean over its resampled episodes
    picked = np.take_along_axis(drawn, rng.integers(len(means), size=drawn.shape), 1).mean(1)
    low, high = np.quantile(picked, TAILS)
    return Interval(float(np.mean(means)), float(low), float(high), len(means))


def holm(p_values: Sequence[float]) -> Array:
    """P values adjusted by Holm; NaN stays NaN and does not count as a test."""
    adjusted = np.array(p_values, dtype=np.float64)
    known = ~np.isnan(adjusted)
    if known.any():
        adjusted[known] = multipletests(adjusted[known], method="holm")[1]
    return adjusted


def improvement(cells: Mapping[str, Array]) -> pd.DataFrame:
    """For every pair of cells, the probability that a seed of `a` beats a seed of `b`, and a test against 1/2.

    cells: [S] per cell. Columns: a, b, n_a, n_b, probability (Mann and Whitney's U divided by n_a n_b; a tie counts
    half), p, p_holm.
    """
    rows = []
    for (a, mine), (b, theirs) in itertools.combinations(cells.items(), 2):
        probability = p = np.nan
        if len(mine) and len(theirs):
            found = stats.mannwhitneyu(mine, theirs, alternative="two-sided")
            probability = found.statistic / (len(mine) * len(theirs))
            p = found.pvalue if min(len(mine), len(theirs)) > 1 else np.nan
        rows.append((a, b, len(mine), len(theirs), probability, p))
    table = pd.DataFrame(rows, columns=["a", "b", "n_a", "n_b", "probability", "p"])
    return table.assign(p_holm=holm(table["p"].tolist()))


class Interaction(NamedTuple):
    """P values of two tests: activations change places between algorithms; both interact on the raw scale."""

    p_ranks: float
    p_raw: float
    n: int


def _above_and_below(a: Array, b: Array, rng: np.random.Generator) -> Array:
    """One-sided p values, by permuting seeds, of a's mean above b's mean and below it: [S], [S] -> [2]."""
    pooled = np.concatenate([a, b])
    dealt = rng.permuted(np.tile(pooled, (PERMUTATIONS, 1)), axis=1)
    differences = dealt[:, : len(a)].mean(1) - dealt[:, len(a) :].mean(1)
    observed, rounding = a.mean() - b.mean(), 1e-12 * np.abs(pooled).max()
    as_far = [(differences >= observed - rounding).sum(), (differences <= observed + rounding).sum()]
    return (1 + np.array(as_far)) / (1 + PERMUTATIONS)


def _crossover(first: Sequence[Array], second: Sequence[Array], rng: np.random.Generator) -> float:
    """P value of a crossover: two cells of one order in the first list and the other order in the second; [S] each."""
    p_values: list[float] = []
    for a, b in itertools.combinations(range(len(first)), 2):
        here, there = (_above_and_below(cells[a], cells[b], rng) for cells in (first, second))
        p_values.extend(np.maximum(here, there[::-1]))
    return float(min(1.0, len(p_values) * min(p_values)))  # the smallest after Holm


def interaction(table: pd.DataFrame, seed: int = 0) -> Interaction:
    """Test the interaction of algorithm and activation; table: one row per seed; columns algorithm, activation, value.

    p_ranks tests for a crossover: a is above b under the first algorithm, and b is above a under the second. Equal
    orders are no crossover, whatever their scale, spacing and noise. The test is an intersection-union test: an ordered
    pair has the larger of its two one-sided p values (seeds permuted), and p_ranks is the smallest of these by Holm.
    p_raw is Wald's test of the interaction by least squares on the values, with HC3 errors.
    """
    cells = {key: part.to_numpy() for key, part in table.groupby(["algorithm", "activation"])["value"]}
    n = min(map(len, cells.values()), default=0)
    algorithms = sorted(table["algorithm"].unique())
    activations = sorted(table["activation"].unique())
    if len(algorithms) != 2 or len(activations) < 2 or len(cells) != 2 * len(activations) or n < 2:
        return Interaction(np.nan, np.nan, n)
    first, second = ([cells[algorithm, activation] for activation in activations] for algorithm in algorithms)
    p_ranks = _crossover(first, second, np.random.default_rng(seed))
    fit = smf.ols("value ~ C(algorithm) * C(activation)", table).fit(cov_type="HC3")
    terms = [name for name in fit.params.index if ":" in name]
    p_raw = float(fit.f_test(np.eye(len(fit.params))[[fit.params.index.get_loc(name) for name in terms]]).pvalue)
    return Interaction(p_ranks, p_raw, n)


def survival(steps: Array, ended: Array) -> pd.Series[float]:
    """Kaplan and Meier's estimate of the share of flights still in the air, indexed by steps.

    steps [E], ended [E]: false if a cap on steps or the end of training cut the flight off.
    """
    curve: pd.Series[float] = KaplanMeierFitter().fit(steps, event_observed=ended).survival_function_.iloc[:, 0]
    return curve


def restricted_mean(steps: Array, ended: Array, limit: float) -> float:
    """Mean steps up to a limit, corrected for censoring: the area below the survival curve."""
    fitted = KaplanMeierFitter().fit(steps, event_observed=ended)
    return float(restricted_mean_survival_time(fitted, t=limit))


def seeds_needed(mine: Array, theirs: Array, power: float = 0.8, alpha: float = 0.05) -> float:
    """Seeds per cell with which a t test finds a difference as large as this one; mine, theirs: [S].

    NaN with fewer than two seeds in a cell; infinite if a billion seeds are too few.
    """
    if min(len(mine), len(theirs)) < 2:
        return float("nan")
    spread = np.sqrt((np.var(mine, ddof=1) + np.var(theirs, ddof=1)) / 2)
    difference = abs(np.mean(mine) - np.mean(theirs))
    if difference == 0:
        return float("inf")
    if spread == 0:
        return 2.0
    t_test = TTestIndPower()

    def enough(n: int) -> bool:
        return not t_test.power(difference / spread, n, alpha) < power  # NaN where scipy cannot tell it from 1

    most = 2
    while not enough(most):  # the solver of statsmodels fails for large differences
        if (most := 2 * most) > 1e9:
            return float("inf")
    return float(bisect.bisect_left(range(most + 1), True, lo=2, key=enough))
