"""Intervals and tests over training seeds, never over single episodes; every number has its n.

scipy, statsmodels and lifelines compute; this module chooses the question and the rows. Letters: S seeds of a
configuration, E episodes of a seed.
"""

from __future__ import annotations

import bisect
import itertools
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from lifelines import KaplanMeierFitter
from lifelines.utils import restricted_mean_survival_time
from scipy import special, stats
from statsmodels.regression.linear_model import OLS
from statsmodels.stats.power import TTestIndPower

Array = np.ndarray[Any, np.dtype[np.float64]]
Flags = np.ndarray[Any, np.dtype[np.bool_]]

CONFIDENCE = 0.95
TAILS = (1 - CONFIDENCE) / 2, 1 - (1 - CONFIDENCE) / 2
RESAMPLES = 2_000
PERMUTATIONS = 19_999
"""Permutations per test; the smallest p value after Holm over 12 ordered pairs is 0.0006."""
FEW = 20
"""Seeds below which a mean has Student's interval; a bootstrap's covers 83 % with five seeds."""
_AT_ONCE = 1 << 18
"""Numbers that are drawn or permuted in one table, which then stays in a processor's cache."""


class Interval(NamedTuple):
    """An estimate with its interval; the interval of a single seed is NaN."""

    value: float
    low: float
    high: float
    n: int


NONE = Interval(np.nan, np.nan, np.nan, 0)
"""Of no seeds."""


def interquartile_mean(values: Array, axis: int = -1) -> Any:
    """The mean of the middle half."""
    return stats.trim_mean(values, 0.25, axis)


def interval(
    values: Sequence[float] | Array, statistic: Callable[..., Any] = np.mean, seed: int = 0
) -> Interval:
    """A statistic of one number per seed [S], with its 95 % interval over seeds.

    A mean of fewer than `FEW` seeds has Student's interval. Any other is a BCa bootstrap, or of percentiles
    where BCa is undefined (few or equal seeds). Seeds with NaN (no episode) are left out. The interval of
    fewer than two seeds is NaN.
    """
    return intervals([values], [statistic], seed)[0][0]


def intervals(
    rows: Sequence[Sequence[float] | Array], statistics: Sequence[Callable[..., Any]], seed: int = 0
) -> list[list[Interval]]:
    """`interval` of each statistic of each row; rows of as many seeds share their draws."""
    known = [np.asarray(row, dtype=np.float64) for row in rows]
    known = [row[~np.isnan(row)] for row in known]
    found: list[list[Interval]] = [[] for _ in rows]
    for n in {len(row) for row in known}:
        places = [place for place, row in enumerate(known) if len(row) == n]
        table = np.stack([known[place] for place in places])
        value = _each(table, statistics) if n else np.full((len(statistics), len(table)), np.nan)
        low, high = _ends(table, statistics, value, seed) if n > 1 else np.full((2, *value.shape), np.nan)
        for column, place in enumerate(places):
            ends = zip(value[:, column], low[:, column], high[:, column], strict=True)
            found[place] = [Interval(float(one), float(least), float(most), n) for one, least, most in ends]
    return found


def _each(table: Array, statistics: Sequence[Callable[..., Any]], axis: int = -1) -> Array:
    """All statistics of a table's rows [..., S]: [statistics, ...], the same bits for any layout."""
    table = np.ascontiguousarray(np.moveaxis(table, axis, -1))
    return np.stack([statistic(table, axis=-1) for statistic in statistics])


def _ends(
    table: Array, statistics: Sequence[Callable[..., Any]], value: Array, seed: int
) -> tuple[Array, Array]:
    """Both ends of the intervals of a table [R, S]: [statistics, R] each."""
    low, high = value.copy(), value.copy()
    n, varies = table.shape[-1], np.ptp(table, axis=-1) > 0
    of_student = np.array([n < FEW and statistic is np.mean for statistic in statistics])
    with np.errstate(invalid="ignore"):  # infinite seeds
        half = special.stdtrit(n - 1, TAILS[1]) * table.std(-1, ddof=1) / np.sqrt(n) * varies
        low[of_student], high[of_student] = value[of_student] - half, value[of_student] + half
    drawn = [statistic for statistic, one in zip(statistics, of_student, strict=True) if not one]
    if drawn and varies.any():
        places = np.ix_(~of_student, varies)
        low[places] = np.nan
        with warnings.catch_warnings(action="ignore"):  # scipy warns when BCa is undefined, and returns NaN
            for method in ("BCa", "percentile"):
                found = stats.bootstrap(
                    (table[varies],),
                    lambda rows, axis: _each(rows, drawn, axis),
                    n_resamples=RESAMPLES,
                    batch=max(1, _AT_ONCE // table.size),
                    confidence_level=CONFIDENCE,
                    method=method,
                    rng=seed,
                    axis=-1,
                ).confidence_interval
                lacks = np.isnan(low[places])
                low[places] = np.where(lacks, found.low, low[places])
                high[places] = np.where(lacks, found.high, high[places])
                if not np.isnan(low[places]).any():
                    break
    return low, high


class Contrasts(NamedTuple):
    """Linear contrasts of means over seeds: estimates, standard errors, degrees of freedom, each [..., J].

    The error is exactly 0, and df is 1, where one side of a contrast never varies.
    """

    value: Array
    error: Array
    df: Array

    def upper(self, level: float | Array) -> Array:
        """The upper end of the one-sided interval of 1 - level: value + t_(1 - level) error."""
        return np.asarray(self.value + special.stdtrit(self.df, 1 - np.asarray(level)) * self.error)

    def lower(self, level: float | Array) -> Array:
        """The lower end, as `upper`."""
        return np.asarray(self.value - special.stdtrit(self.df, 1 - np.asarray(level)) * self.error)

    def above(self) -> Array:
        """One-sided p values of the contrasts being above zero; NaN without an error."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(
                special.stdtr(self.df, -self.value / np.where(self.error > 0, self.error, np.nan))
            )

    def power(self, effect: Array, level: float | Array) -> Array:
        """How probably a one-sided test at this level finds effects [J]: by the noncentral t."""
        shift = np.minimum(effect / np.where(self.error > 0, self.error, np.nan), _FAR)
        bound = special.stdtrit(self.df, 1 - np.asarray(level))
        missed = np.zeros(np.broadcast_shapes(np.shape(self.df), shift.shape, bound.shape))
        return np.asarray(1 - special.nctdtr(self.df, shift, bound, out=missed, where=shift != _FAR))


_FAR = 30.0
"""Standard errors from which a t test of three seeds and more finds an effect at any level in use."""
_DIGITS = 12
"""Significant digits of a mean; the places after them differ from processor to processor."""


def welch(samples: Sequence[Array], weights: Array, paired: bool = False) -> Contrasts:
    """Contrasts of configurations' means by Welch and Satterthwaite; paired: of each seed's own contrast.

    samples: C configurations, each [..., S], if paired of equal S (else independent); weights [J, C]:

        error^2 = sum w^2 s^2 / S,    df = error^4 / sum (w^2 s^2 / S)^2 / (S - 1)

    Raises a ValueError where a configuration has fewer than two seeds.
    """
    if min(sample.shape[-1] for sample in samples) < 2:
        raise ValueError("a configuration has fewer than two seeds; an error needs at least two")
    weights = np.asarray(weights, dtype=np.float64)
    means = rounded(np.stack([sample.mean(-1) for sample in samples], -1))
    value = means @ weights.T
    if paired and len({sample.shape[-1] for sample in samples}) == 1:
        each = np.moveaxis(np.stack(samples, -1) @ weights.T, -1, -2)  # [..., J, S]
        seeds = each.shape[-1]
        error = np.where(np.ptp(each, -1) > 0, each.std(-1, ddof=1) / np.sqrt(seeds), 0.0)
        return Contrasts(value, error, np.full(error.shape, seeds - 1.0))
    sizes = np.array([sample.shape[-1] for sample in samples])
    variances = (
        np.stack([np.where(np.ptp(one, -1) > 0, one.var(-1, ddof=1), 0.0) for one in samples], -1) / sizes
    )
    parts = variances[..., None, :] * weights**2  # [..., J, C]
    sides = [sign * weights > 0 for sign in (1, -1)]  # a side without configurations needs none that vary
    varies = np.all([((parts * side).sum(-1) > 0) | ~side.any(-1) for side in sides], axis=0)
    squared = np.where(varies, parts.sum(-1), 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        df = np.where(varies, squared**2 / (parts**2 / (sizes - 1)).sum(-1), 1.0)
    return Contrasts(value, np.sqrt(squared), df)


def rounded(means: Array) -> Array:
    """Means [..., C] to `_DIGITS` significant digits of the largest of a row."""
    largest = np.abs(means).max(-1, keepdims=True)
    scale = 10.0 ** (_DIGITS - np.ceil(np.log10(np.where(largest > 0, largest, 1.0))))
    return np.asarray(np.round(means * scale) / scale)


def difference(first: Sequence[Array], second: Sequence[Array] = ()) -> Interval:
    """The mean of some configurations' means minus that of others, with Welch's interval; n is the smallest.

    Without a second it is Student's interval of the mean. first, second: [S] per configuration.
    """
    weights = [1 / max(len(first), 1)] * len(first) + [-1 / max(len(second), 1)] * len(second)
    return contrast([*first, *second], np.array(weights))


def contrast(samples: Sequence[Array], weights: Array) -> Interval:
    """A weighted sum of configurations' means, with Welch's interval; n is the smallest.

    samples: [S] per configuration; weights [C]. With five seeds it covers 95 % (a percentile bootstrap 83 %).
    The interval of equal seeds is their value; NaN where a configuration has fewer than two.
    """
    n = min(map(len, samples), default=0)
    if n < 2:
        value = (
            float(sum(w * sample.mean() for w, sample in zip(weights, samples, strict=True))) if n else np.nan
        )
        return Interval(value, np.nan, np.nan, n)
    found = welch(samples, weights[None])
    low, high = (float(end[0]) for end in (found.lower(TAILS[0]), found.upper(TAILS[0])))
    return Interval(float(found.value[0]), low, high, n)


def ratio(above: Array, below: Array) -> Interval:
    """The mean of one number a seed over that of another, with Fieller's 95 % interval.

    above, below: [S], of the same seeds in the same order. With variances v of the means and t of S - 1
    degrees of freedom, the ends are where (a - r b)^2 = t^2 (v_aa - 2 r v_ab + r^2 v_bb). They are NaN with
    fewer than two seeds, or where the mean below may be 0.
    """
    n = len(above)
    value = float(above.mean() / below.mean()) if n and below.mean() else np.nan
    if n < 2:
        return Interval(value, np.nan, np.nan, n)
    (aa, ab), (_, bb) = special.stdtrit(n - 1, TAILS[1]) ** 2 * np.cov(above, below) / n
    a, b = above.mean(), below.mean()
    square, middle, rest = b * b - bb, a * b - ab, a * a - aa
    if not square > 0:
        return Interval(value, np.nan, np.nan, n)
    half = np.sqrt(max(middle * middle - square * rest, 0.0))
    return Interval(value, float((middle - half) / square), float((middle + half) / square), n)


def deviations(seeds: Array) -> Array:
    """The standard deviation of seeds [S] as one number a seed [S], so that `welch` has its interval.

    The jackknife's pseudo-values S s - (S - 1) s_i, where s_i leaves seed i out; NaN with fewer than three.
    """
    n = len(seeds)
    if n < 3:
        return np.full(n, np.nan)
    without = np.array([np.delete(seeds, seed).std(ddof=1) for seed in range(n)])
    return np.asarray(n * seeds.std(ddof=1) - (n - 1) * without)


def concordance(first: Sequence[Array], second: Sequence[Array]) -> Interval:
    """Kendall's tau of configurations' means in two studies: pairs in one order minus pairs turned round.

    Both are shares of all pairs, and equal means are neither. The ends of the 95 % interval take each pair
    that is not told apart in both studies as turned round, and as in order: Welch's tests of all pairs of
    a study hold together (Bonferroni). One of both must be wrong where a pair is wrongly told apart. A pair
    with a configuration whose seeds never vary is never told apart. Percentiles of resampled ranks would
    cover too rarely where means are near each other.

    first, second: the same configurations in order, [S] each. NaN with fewer than two configurations or two
    seeds in one, or with a NaN.
    """
    n = min(map(len, [*first, *second]), default=0)
    if n < 2 or len(first) < 2 or np.isnan(np.concatenate([*first, *second])).any():
        return Interval(np.nan, np.nan, np.nan, n)
    one, other = np.triu_indices(len(first), 1)
    units = np.eye(len(first))
    found = [welch(samples, units[one] - units[other]) for samples in (first, second)]
    level = TAILS[0] / len(one)
    above = np.stack([contrasts.above() for contrasts in found])
    shown = np.prod((above < level) * 1.0 - (above > 1 - level), 0)
    value = np.prod([np.sign(contrasts.value) for contrasts in found], 0).mean()
    low, high = (float(np.where(shown == 0, end, shown).mean()) for end in (-1, 1))
    return Interval(float(value), low, high, n)


class Prediction(NamedTuple):
    """Where a number is among seeds, and the interval that contains 95 % of single new seeds."""

    percentile: float
    low: float
    high: float
    within: bool
    n: int


def prediction(seeds: Array, number: float) -> Prediction:
    """Whether a number may be one more seed; seeds [S].

    The interval is Student's, mean -+ t_0.975 s sqrt(1 + 1/S). The percentile is the share of seeds below the
    number, of equal ones half, in %. All is NaN, and the number not within, with fewer than two seeds.
    """
    n = len(seeds)
    if n < 2 or np.isnan(number):
        return Prediction(np.nan, np.nan, np.nan, False, n)
    half = special.stdtrit(n - 1, TAILS[1]) * seeds.std(ddof=1) * np.sqrt(1 + 1 / n)
    low, high = float(seeds.mean() - half), float(seeds.mean() + half)
    percentile = 100 * float(np.mean(seeds < number) + np.mean(seeds == number) / 2)
    return Prediction(percentile, low, high, low <= number <= high, n)


def joint(seeds: Array, number: Array) -> tuple[float, float]:
    """Whether numbers [M] together may be one more seed; seeds [S, M].

    First the p value of Hotelling's T^2 for a new observation, (S - M) / (M (S - 1)) S / (S + 1) D^2 by F
    with M and S - M degrees of freedom, D Mahalanobis' distance from the mean. Then the share of seeds that
    are nearer: each seed's distance is from the others. NaN unless S > M + 2, or where metrics vary as one.
    """
    n, count = seeds.shape
    if n <= count + 2 or np.linalg.matrix_rank(np.atleast_2d(np.cov(seeds.T))) < count:
        return np.nan, np.nan

    def distance(of: Array, one: Array) -> float:
        apart = one - of.mean(0)
        return float(apart @ np.linalg.pinv(np.atleast_2d(np.cov(of.T)), hermitian=True) @ apart)

    own = distance(seeds, number)
    p = stats.f.sf((n - count) / (count * (n - 1)) * n / (n + 1) * own, count, n - count)
    others = [distance(np.delete(seeds, place, 0), seeds[place]) for place in range(n)]
    return float(p), float(np.mean(np.array(others) < own))


def mahalanobis(groups: Sequence[Array], number: Array) -> Array:
    """How far numbers [M] are from each group of seeds [S, M], as if they were one more seed of it.

    A distance a group. The covariance is that of seeds within groups, pooled over all. It counts 1 + 1/S
    times, as the mean of S seeds scatters too. NaN for a group without seeds.
    """
    found = np.full(len(groups), np.nan)
    there = [place for place, own in enumerate(groups) if len(own)]
    within = [groups[place] - groups[place].mean(0) for place in there]
    freedom = max(sum(len(own) - 1 for own in within), 1)
    inverse = np.linalg.pinv(sum(own.T @ own for own in within) / freedom, hermitian=True)
    for place in there:
        apart = groups[place].mean(0) - number
        found[place] = np.sqrt(apart @ inverse @ apart / (1 + 1 / len(groups[place])))
    return found


def chance_of_best(samples: Mapping[str, Array], name: str) -> float:
    """How often one seed of this configuration would be above one of each other; samples: [S] each."""
    others = [own for other, own in samples.items() if other != name]
    return float(np.prod([(samples[name][:, None] > own).mean(1) for own in others], 0).mean())


def chance_of_order(samples: Sequence[Array]) -> float:
    """How often one seed of each configuration would stand in this order, the largest first; [S] each."""
    *before, last = samples
    chance = np.ones(len(last))  # that what follows a seed is in order
    for own in reversed(before):
        chance = ((own[:, None] > last) * chance).mean(1)
        last = own
    return float(chance.mean())


def holm(p_values: Sequence[float] | Array) -> Array:
    """P values [..., P] adjusted by Holm along the last axis; NaN stays NaN and does not count as a test."""
    p = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(p, axis=-1, kind="stable")  # NaN comes last
    tests = np.sum(~np.isnan(p), axis=-1, keepdims=True)
    raised = np.take_along_axis(p, order, -1) * np.maximum(tests - np.arange(p.shape[-1]), 1)
    adjusted = np.empty_like(p)
    np.put_along_axis(adjusted, order, np.minimum(np.maximum.accumulate(raised, axis=-1), 1.0), -1)
    return np.where(np.isnan(p), np.nan, adjusted)


def improvement(configurations: Mapping[str, Array]) -> pd.DataFrame:
    """For every pair, the probability that a seed of `a` beats a seed of `b`, and a test against 1/2.

    Columns a, b, n_a, n_b, probability (Mann and Whitney's U / (n_a n_b); a tie counts half), p, p_holm.
    """
    rows = []
    for (a, mine), (b, theirs) in itertools.combinations(configurations.items(), 2):
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


def _above_and_below(pairs: Sequence[tuple[Array, Array]], rng: np.random.Generator) -> Array:
    """One-sided p values of a's mean above b's mean and below it, by permuting seeds: [S], [S] -> [pairs, 2].

    Pairs of the same sizes share their permutations.
    """
    p_values = np.empty((len(pairs), 2))
    sizes = [(len(a), len(b)) for a, b in pairs]
    for n, m in dict.fromkeys(sizes):
        places = [place for place, size in enumerate(sizes) if size == (n, m)]
        pooled = np.stack([np.concatenate(pairs[place]) for place in places], 1)
        share = np.repeat([1 / n, -1 / m], [n, m])  # a permutation of it weighs another choice of n seeds
        observed, rounding = share @ pooled, 1e-12 * np.abs(pooled).max(0)
        as_far = np.zeros((2, len(places)))
        for rows in np.diff([*range(0, PERMUTATIONS, max(1, _AT_ONCE // len(share))), PERMUTATIONS]):
            differences = rng.permuted(np.tile(share, (rows, 1)), axis=1) @ pooled
            as_far += (differences >= observed - rounding).sum(0), (differences <= observed + rounding).sum(0)
        p_values[places] = (1 + as_far.T) / (1 + PERMUTATIONS)
    return p_values


def _crossover(first: Sequence[Array], second: Sequence[Array], rng: np.random.Generator) -> float:
    """P value of a crossover: two configurations change places between the lists; [S] each."""
    pairs = [*itertools.combinations(range(len(first)), 2)]
    here, there = (
        _above_and_below([(configurations[a], configurations[b]) for a, b in pairs], rng)
        for configurations in (first, second)
    )
    p_values = np.maximum(here, there[:, ::-1])
    return float(min(1.0, p_values.size * p_values.min()))  # the smallest after Holm


def interaction(table: pd.DataFrame) -> Interaction:
    """Test the interaction of algorithm and activation; table: columns algorithm, activation, value.

    p_ranks tests for a crossover: a is above b under the first algorithm, and b is above a under the second.
    Equal orders are no crossover, whatever their scale and noise. An ordered pair has the larger of its two
    one-sided p values (seeds permuted), and p_ranks is the smallest of these by Holm. p_raw is Wald's test of
    the interaction by least squares on the values, with HC3 errors.
    """
    configurations = {
        key: part.to_numpy() for key, part in table.groupby(["algorithm", "activation"])["value"]
    }
    n = min(map(len, configurations.values()), default=0)
    algorithms = sorted(table["algorithm"].unique())
    activations = sorted(table["activation"].unique())
    if len(algorithms) != 2 or len(activations) < 2 or len(configurations) != 2 * len(activations) or n < 2:
        return Interaction(np.nan, np.nan, n)
    first, second = (
        [configurations[algorithm, activation] for activation in activations] for algorithm in algorithms
    )
    p_ranks = _crossover(first, second, np.random.default_rng(0))
    fit = OLS.from_formula("value ~ C(algorithm) * C(activation)", table).fit(cov_type="HC3")
    interact = np.eye(len(fit.params))[fit.params.index.str.contains(":")]
    return Interaction(p_ranks, float(fit.f_test(interact).pvalue), n)


def survival(steps: Array, ended: Array) -> pd.Series[float]:
    """Kaplan and Meier's estimate of the share of episodes that last longer, indexed by steps.

    steps [E], ended [E]: false if a time limit or the end of training cut the episode off.
    """
    curve: pd.Series[float] = (
        KaplanMeierFitter().fit(steps, event_observed=ended).survival_function_.iloc[:, 0]
    )
    return curve


def restricted_mean(steps: Array, ended: Array, limit: float) -> float:
    """Mean steps up to a limit, corrected for censoring: the area below the survival curve.

    Where nothing was censored before the limit, that is the mean of min(steps, limit).
    """
    if np.all(ended.astype(bool) | (steps >= limit)):
        return float(np.minimum(steps, limit).mean())
    fitted = KaplanMeierFitter().fit(steps, event_observed=ended)
    return float(restricted_mean_survival_time(fitted, t=limit))


def seeds_needed(mine: Array, theirs: Array, effect: float, power: float = 0.8) -> float:
    """Seeds per configuration with which a t test at 5 % finds an effect; mine, theirs: [S], for the scatter.

    NaN with fewer than two seeds or an effect that is not known; infinite if a billion seeds are too few.
    """
    if min(len(mine), len(theirs)) < 2 or np.isnan(effect):
        return float("nan")
    spread = np.sqrt((np.var(mine, ddof=1) + np.var(theirs, ddof=1)) / 2)
    if spread == 0:
        return 2.0
    t_test = TTestIndPower()
    # NaN where scipy cannot tell it from 1; the solver of statsmodels fails for large differences
    return fewest(lambda n: not t_test.power(abs(effect) / spread, n, 0.05) < power)


def fewest(enough: Callable[[int], bool], least: int = 2) -> float:
    """The smallest number of seeds, from `least` on, that is enough; infinite if a billion are too few."""
    most = least
    while not enough(most):
        if (most := 2 * most) > 1e9:
            return float("inf")
    return float(bisect.bisect_left(range(most + 1), True, lo=least, key=enough))
