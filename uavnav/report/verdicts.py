"""The rule of the audit: bootstrap intervals over training seeds, Holm's adjustment, verdicts.

templates/prose.md says it in words, and when it was fixed. Letters: S seeds of a cell.
"""

from __future__ import annotations

import functools
import math
import zlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import stats as distributions

from uavnav import stats
from uavnav.report.claims import CLAIMS, Claim, Evidence, Part
from uavnav.stats import Array

SEEDS = 8
"""A verdict needs so many seeds in every cell."""
ALPHA = 0.05
POWER = 0.8
DRAWS = 20_000
"""Bootstrap draws; the adjusted intervals reach far into the tails."""
DIGITS = 12
"""Significant digits of a mean; the places after them differ from processor to processor."""
BY_TEST = f"p < {ALPHA}"
"""What stands for the region of a part that a test decides."""
KINDS = SUPPORTED, CONTRADICTED, UNDECIDED = "supported", "contradicted", "undecided"


class Finding(NamedTuple):
    """What the seeds say of a part."""

    claim: int
    text: str
    paper: float  # the same estimand of the printed tables; NaN where they do not have it
    value: float
    low: float  # of the interval adjusted by Holm
    high: float
    confidence: float  # of that interval
    region: str
    p_holm: float
    p_is_bound: bool  # more draws might give a smaller one
    n: int
    needed: float  # seeds a cell with which an estimate like this one would be decided; NaN where it is, or not known
    verdict: str
    against_itself: bool  # the paper's own tables say otherwise
    digits: int

    @property
    def by_test(self) -> bool:
        """Whether a test decides it, and no interval."""
        return self.region == BY_TEST


def audit(evidence: Evidence, paper: Evidence, claims: Sequence[Claim] = CLAIMS, seed: int = 0) -> list[Finding]:
    """Every part of every claim, in order, by the rule.

    evidence: of our runs; paper: of the printed tables, one number a cell; seed: of the bootstrap.
    """
    parts = [(claim.number, part) for claim in claims for part in claim.parts(evidence)]
    printed = [part for claim in claims for part in claim.parts(paper)]
    drawn = [_draw(part, seed) for _, part in parts]
    p_values = [_p_value(part, draws) for (_, part), draws in zip(parts, drawn, strict=True)]
    judged = zip(parts, printed, drawn, p_values, stats.holm(p_values), _levels(p_values), strict=True)
    return [
        _finding(number, part, own, draws, p, float(p_holm), level)
        for (number, part), own, draws, p, p_holm, level in judged
    ]


def of_claim(findings: Sequence[Finding], number: int) -> list[Finding]:
    """The parts of one claim."""
    return [one for one in findings if one.claim == number]


def verdict(findings: Sequence[Finding]) -> str:
    """The verdict of a claim from its parts."""
    verdicts = {finding.verdict for finding in findings}
    if CONTRADICTED in verdicts:
        return CONTRADICTED
    return SUPPORTED if verdicts == {SUPPORTED} else UNDECIDED


def p_shown(finding: Finding) -> str:
    """Holm's p for people: a dash where there is none, `≤` where more draws might give a smaller one."""
    if math.isnan(finding.p_holm):
        return "–"
    if finding.p_holm < 0.001:
        return "< 0.001"
    if finding.p_is_bound:
        return f"≤ {math.ceil(1000 * finding.p_holm) / 1000:.3f}"
    return f"{finding.p_holm:.3f}"


def p_in_words(finding: Finding) -> str:
    p = p_shown(finding)
    return f"p {p}" if p[0] in "<≤" else f"p = {p}"


def _value(part: Part) -> float:
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(part.statistic(*(_rounded(sample.mean()) for sample in part.samples))) if part.n else math.nan


def _rounded(means: Any) -> Array:
    """Means [...] to `DIGITS` significant digits of the largest."""
    largest = float(np.max(np.abs(means)))
    return np.round(means, DIGITS - math.ceil(math.log10(largest))) if largest > 0 else np.asarray(means)


def _draw(part: Part, seed: int) -> Array:
    """Bootstrap draws of the statistic, each cell's seeds resampled by themselves: [DRAWS]; none below 2 seeds.

    NaN where the statistic is undefined.
    """
    if min(len(sample) for sample in part.samples) < 2:
        return np.empty(0)
    cells = [sample.tobytes() for sample in part.samples]
    # nine digits: the last places of a cell's values differ from processor to processor
    keys = [zlib.crc32(" ".join(f"{value:.9g}" for value in sample).encode()) for sample in part.samples]
    streams = [(key, keys[:place].count(key)) for place, key in enumerate(keys)]
    if part.paired and len({len(cell) for cell in cells}) == 1:
        streams = [streams[0]] * len(streams)
    means = [_drawn_means(cell, (seed, *stream)) for cell, stream in zip(cells, streams, strict=True)]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(part.statistic(*means), dtype=np.float64)


@functools.lru_cache(maxsize=1024)
def _drawn_means(seeds: bytes, stream: tuple[int, ...]) -> Array:
    """Means of a cell's seeds, float64 [S] as bytes, drawn anew with replacement: [DRAWS].

    stream: names the draws; each cell of a part has one of its own, also where two hold the same values.
    """
    values = np.frombuffer(seeds)
    rng = np.random.default_rng(stream)
    return _rounded(values[rng.integers(len(values), size=(DRAWS, len(values)))].mean(1))


def _p_value(part: Part, draws: Array) -> float:
    """The smallest alpha at which the interval of 1 - alpha lies wholly inside or wholly outside the region.

    Undefined draws speak against either.
    """
    if not len(draws):
        return math.nan
    if part.test is not None:
        return part.test(part.samples)
    below, above = (draws <= part.region.low).sum(), (draws >= part.region.high).sum()
    undefined = np.isnan(draws).sum()
    inside = 2 * (max(below, above) + undefined + 1) / (len(draws) + 1)
    outside = 2 * (len(draws) - max(below, above) + 1) / (len(draws) + 1)
    return float(min(inside, outside, 1.0))


def _interval(draws: Array, level: float) -> tuple[float, float]:
    """The interval of 1 - level: it excludes a region's edge if and only if `_p_value` is below the level.

    An undefined draw may lie anywhere.
    """
    place = math.ceil(level * (len(draws) + 1) / 2) - 2
    if place < 0:
        return -math.inf, math.inf
    undefined = np.isnan(draws)
    low = np.sort(np.where(undefined, -np.inf, draws))[place]
    high = np.sort(np.where(undefined, np.inf, draws))[len(draws) - 1 - place]
    return float(low), float(high)


def _levels(p_values: Sequence[float]) -> list[float]:
    """Holm's alpha for each: the smallest p value is held against ALPHA / m, the next against ALPHA / (m - 1), ...

    The first that fails and all after it are held against the same.
    """
    order = sorted((p, place) for place, p in enumerate(p_values) if not math.isnan(p))
    levels, failed = [math.nan] * len(p_values), math.nan
    for rank, (p, place) in enumerate(order):
        levels[place] = ALPHA / (len(order) - rank) if math.isnan(failed) else failed
        if not p < levels[place]:
            failed = levels[place]
    return levels


def _finding(number: int, part: Part, printed: Part, draws: Array, p: float, p_holm: float, level: float) -> Finding:
    value, own = _value(part), _value(printed)
    if part.test is None:
        region, least_p = str(part.region), 2 / (DRAWS + 1)
        low, high = _interval(draws, level) if len(draws) else (math.nan, math.nan)
        holds = part.region.low < low and high < part.region.high
        against = not math.isnan(own) and not part.region.low < own < part.region.high
    else:
        region, least_p, low, high, holds, against = BY_TEST, part.least_p, math.nan, math.nan, True, False
    answer = UNDECIDED
    if part.n >= SEEDS and p_holm < ALPHA:
        answer = SUPPORTED if holds else CONTRADICTED
    needed = _needed(part, value, draws, level) if answer == UNDECIDED and part.n else math.nan
    interval, bound = (low, high, 1 - level), p <= least_p
    return Finding(
        number, part.text, own, value, *interval, region, p_holm, bound, part.n, needed, answer, against, part.digits
    )


def _needed(part: Part, value: float, draws: Array, level: float) -> float:
    """Seeds a cell that would decide a part, by the normal approximation: at least `SEEDS`.

    NaN where no interval tells; `SEEDS` where there are fewer.
    """
    least = SEEDS if part.n < SEEDS else math.nan
    if part.test is not None or not len(draws) or not np.isfinite(draws).all() or not math.isfinite(value):
        return least
    gap = min(abs(value - edge) for edge in part.region if math.isfinite(edge))
    if gap == 0:
        return math.inf
    quantiles = distributions.norm.ppf([1 - level / 2, POWER]).sum()
    return float(max(math.ceil(part.n * (quantiles * draws.std() / gap) ** 2), SEEDS))
