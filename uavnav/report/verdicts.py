"""The rule that grades claims: Welch's intervals over training seeds, equivalence, Holm within a claim.

templates/prose.md says it in words. Where seeds scatter as ours do (per frame, two configurations of an
algorithm), Welch's 95 % intervals cover 94.9, 94.3, 94.1 and 94.5 % with 5, 10, 20 and 40 seeds, and
bootstrap-t 95.1, 93.7, 93.4 and 94.1 %; the worst pair, with a configuration of which one seed in twenty
learns late, 84 and 81 %. Letters: S seeds of a configuration, P parts of a claim, J contrasts of a part.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from uavnav import stats
from uavnav.report.claims import CLAIMS, Claim, Evidence, Part
from uavnav.stats import Array, Contrasts, Flags

Names = np.ndarray[Any, np.dtype[np.str_]]

SEEDS = 5
"""A verdict needs so many seeds in every configuration: the fewest of which the coverage was measured."""
ALPHA = 0.05
POWER = 0.8
"""A part counts if the paper's own effect would be found with this probability."""
HALF = 0.5
"""An effect is absent if it is within plus and minus this share of the paper's, and smaller if below it."""
REPLICATES, REVERSES, ABSENT = "replicates", "reverses", "absent"
SMALLER, OPEN, DEGENERATE = "smaller", "open", "degenerate"
COUNTS, NO_RUNS, TOO_FEW = "counts", "no runs", "too few seeds"
WAITING = NO_RUNS, TOO_FEW  # for runs, and so does a claim of which all other parts replicate
AGAINST_ITSELF, BESIDE = "the paper contradicts itself", "no part of the grade"
TOO_SMALL = "the paper's effect is too small"  # for as many seeds as there are
"""Whether a part counts for its claim's grade, and why not (`DEGENERATE` is a reason too)."""
IN_PART, DOES_NOT, CONTEXT = "in part", "does not", "context"
GRADES = (REPLICATES, IN_PART, SMALLER, DOES_NOT, OPEN, CONTEXT)


class Finding(NamedTuple):
    """What the seeds say of a part; effects are in the claimed direction."""

    claim: int
    text: str
    paper: float  # the same effect of the printed tables; NaN where they do not have it
    value: float
    low: float  # of the interval adjusted by Holm within the claim, for parts that count
    high: float
    confidence: float  # of that interval
    ratio: float  # ours to the paper's effect, where it has one
    ratio_low: float
    ratio_high: float
    nearest: str  # of several contrasts, the one that decides
    p_holm: float
    n: int
    verdict: str
    less_than_half: bool  # of the paper's effect, also where the direction is clear
    standing: str  # whether it counts for the grade, and why not
    power: float  # to find the paper's effect
    to_detect: float  # seeds a configuration that find the paper's effect with `POWER`
    to_equal: float  # seeds a configuration that show its absence with `POWER`, where nothing differs


class Judgement(NamedTuple):
    """The parts of a claim in one study or many: each [..., P], and the claim's grade [...]."""

    verdicts: Names
    standings: Names
    less_than_half: Flags
    p_holm: Array
    levels: Array  # of the parts' intervals
    power: Array
    grades: Names


def audit(evidence: Evidence, paper: Evidence, claims: Sequence[Claim] = CLAIMS) -> list[Finding]:
    """Every part of every claim, by the rule; evidence: of our runs; paper: of the printed tables."""
    found = []
    for claim in claims:
        samples = [[evidence(*term) for term in part.terms] for part in claim.parts]
        printed = [effects(part, paper) for part in claim.parts]
        judged = judge(claim.parts, samples, printed)
        each = enumerate(zip(samples, printed, strict=True))
        found += [_finding(claim, place, *own, judged) for place, own in each]
    return found


def effects(part: Part, paper: Evidence) -> Array:
    """The paper's own effects: the contrasts [J] of its numbers; NaN where it has none."""
    numbers = [paper(*term) for term in part.terms]
    means = np.array([one.mean() if len(one) else np.nan for one in numbers])
    return np.asarray(np.array(part.weights) @ means)


def judge(parts: Sequence[Part], samples: Sequence[Sequence[Array]], printed: Sequence[Array]) -> Judgement:
    """Judge a claim. samples: of each part its terms, each [..., S]; printed: of each part the paper's
    effects [J].

    A part is candidate for the grade if the paper's tables show it or say nothing, its configurations have
    `SEEDS` seeds, and its measure varies. A candidate counts if the paper's effect is found with `POWER` at
    the level `ALPHA` / candidates (Bonferroni's, Holm's first). Holm's family are the m parts that count; the
    others are judged by themselves. His levels are `ALPHA` / m for the smallest p, `ALPHA` / (m - 1) for the
    next, and so on; the first that fails and all after it have the same level.
    """
    found = [_contrasts(part, of) for part, of in zip(parts, samples, strict=True)]
    sizes = [_extreme(part, own) for part, own in zip(parts, printed, strict=True)]
    shape = np.broadcast_shapes(*(one.value.shape[:-1] for one in found if one is not None), ())
    standings = np.full((*shape, len(parts)), COUNTS, dtype="<U31")
    p, power, smaller = np.full((3, *standings.shape), np.nan)
    toward, within = np.zeros((2, *standings.shape), dtype=bool)
    for place, (part, one, size) in enumerate(zip(parts, found, sizes, strict=True)):
        if part.beside:
            standings[..., place] = BESIDE
        elif one is None:
            standings[..., place] = TOO_FEW if _seeds(samples[place]) else NO_RUNS
        if one is None:
            continue
        p_for, p_against = _p_values(part, one)
        p[..., place] = np.minimum(1.0, 2 * np.minimum(p_for, p_against))
        toward[..., place] = p_for < p_against
        low, high = _interval(part, one, 2 * ALPHA)
        # never of an unknown or negative effect
        within[..., place] = (-HALF * size < low) & (high < HALF * size)
        varies = (one.error > 0).all(-1)
        if not part.beside:
            standings[..., place] = AGAINST_ITSELF if size <= 0 else np.where(varies, COUNTS, DEGENERATE)
    candidates = (standings == COUNTS).sum(-1)
    for place, (part, one, own) in enumerate(zip(parts, found, printed, strict=True)):
        if one is not None and sizes[place] > 0:
            power[..., place] = _power(part, one, own, ALPHA / np.maximum(candidates, 1))
    standings[(standings == COUNTS) & (power < POWER)] = TOO_SMALL
    counting = standings == COUNTS
    p_holm = np.where(counting, stats.holm(np.where(counting, p, np.nan)), p)
    rank = np.where(counting, p, np.nan).argsort(-1, kind="stable").argsort(-1)  # of p; NaN comes last
    passed = (counting & (p_holm < ALPHA)).sum(-1, keepdims=True)
    left = counting.sum(-1, keepdims=True) - np.minimum(rank, passed)
    levels = ALPHA / np.where(counting, left, 1)
    for place, (part, one, size) in enumerate(zip(parts, found, sizes, strict=True)):
        if one is not None and size > 0:
            smaller[..., place] = _interval(part, one, levels[..., place, None])[1] < HALF * size
    unclear = np.select([within, smaller == 1], [ABSENT, SMALLER], OPEN)
    verdicts = np.select([p_holm >= ALPHA, toward], [unclear, REPLICATES], REVERSES)
    verdicts = np.where(np.isnan(p), [OPEN if one is None else DEGENERATE for one in found], verdicts)
    return Judgement(verdicts, standings, within, p_holm, levels, power, _grades(verdicts, standings))


def _grades(verdicts: Names, standings: Names) -> Names:
    """The grades [...] of claims from their parts' verdicts and standings, each [..., P].

    Of the parts that count: all replicate -> replicates (in part while others wait for runs or seeds);
    some -> in part; none, and one reverses or is absent -> does not; none, and one is smaller -> smaller;
    none, and nothing is shown -> open. A claim all of whose parts are only shown is context.
    """
    counting, waits = standings == COUNTS, np.isin(standings, WAITING).any(-1)
    do, against, less = (
        (np.isin(verdicts, kinds) & counting).sum(-1)
        for kinds in ((REPLICATES,), (REVERSES, ABSENT), (SMALLER,))
    )
    none = np.select([against > 0, less > 0], [DOES_NOT, SMALLER], OPEN)
    grades = np.select([do == 0, waits | (do < counting.sum(-1))], [none, IN_PART], REPLICATES)
    return np.where((standings == BESIDE).all(-1), CONTEXT, grades)


def of_claim(findings: Sequence[Finding], number: int) -> list[Finding]:
    """The parts of one claim."""
    return [one for one in findings if one.claim == number]


class Grade(NamedTuple):
    """What a claim comes to: so many replicate of the parts that count, or would with runs."""

    name: str
    replicating: int
    counting: int

    def __str__(self) -> str:
        return f"{self.name} ({self.replicating} of {self.counting})" if self.name == IN_PART else self.name


def grade(findings: Sequence[Finding]) -> Grade:
    """The grade of a claim from its parts."""
    verdicts, standings = (
        np.array([getattr(one, field) for one in findings]) for field in ("verdict", "standing")
    )
    replicating = int(((standings == COUNTS) & (verdicts == REPLICATES)).sum())
    counting = int(np.isin(standings, (COUNTS, *WAITING)).sum())
    return Grade(str(_grades(verdicts, standings)), replicating, counting)


def _seeds(samples: Sequence[Array]) -> int:
    """The fewest of a configuration."""
    return min(int(sample.shape[-1]) for sample in samples)


def _contrasts(part: Part, samples: Sequence[Array]) -> Contrasts | None:
    """A part's contrasts [..., J]; None where a configuration has too few seeds."""
    if _seeds(samples) < SEEDS:
        return None
    return stats.welch(samples, np.array(part.weights), part.paired)


def _extreme(part: Part, effects_: Array) -> float:
    """A part's effect: the smallest contrast where every one has to be above zero, else the largest."""
    return float(np.min(effects_) if part.every else np.max(effects_))


def _p_values(part: Part, found: Contrasts) -> tuple[Array, Array]:
    """One-sided p values for the part and against it: [...] each.

    Every contrast is above zero: an intersection-union test, the largest p counts. One is below: Holm over
    the J. Where at least one has to be above, the two change places.
    """
    above = found.above()
    count = above.shape[-1]
    if part.every:
        return above.max(-1), np.minimum(1.0, count * (1 - above).min(-1))
    return np.minimum(1.0, count * above.min(-1)), (1 - above).max(-1)


def _interval(part: Part, found: Contrasts, level: float | Array) -> tuple[Array, Array]:
    """The interval of 1 - level [..., 1] of a part's effect: it excludes 0 exactly where `_p_values` say so.

    The smallest of J contrasts is above the smallest of their lower ends, each at level / 2, and below the
    smallest of their upper ends, each at level / 2J.
    """
    count = found.value.shape[-1]
    if part.every:
        return found.lower(level / 2).min(-1), found.upper(level / 2 / count).min(-1)
    return found.lower(level / 2 / count).max(-1), found.upper(level / 2).max(-1)


def _power(part: Part, found: Contrasts, effects_: Array, level: float | Array) -> Array:
    """How probably the paper's effects [J] are found, at least (Slepian): [...]; level: two-sided [...]."""
    one_sided = np.asarray(level)[..., None] / 2
    if part.every:
        return np.asarray(found.power(effects_, one_sided).prod(-1))
    return np.asarray(found.power(effects_, one_sided / len(effects_)).max(-1))


def _finding(
    claim: Claim, place: int, samples: Sequence[Array], printed: Array, judged: Judgement
) -> Finding:
    part, found = claim.parts[place], _contrasts(claim.parts[place], samples)
    own, n, level = _extreme(part, printed), _seeds(samples), float(judged.levels[place])
    low = high = to_detect = to_equal = math.nan
    nearest, value = "", math.nan
    if n:
        means = stats.rounded(np.array([sample.mean() for sample in samples]))
        value = _extreme(part, np.array(part.weights) @ means)
    if found is not None:
        low, high = map(float, _interval(part, found, level))
        if len(part.weights) > 1:
            p = found.above()
            p = np.where(np.isnan(p), 0.5 - np.sign(found.value), p)  # by the sign where nothing varies
            nearest = part.sides(int(np.argmax(p if part.every else -p)))
        if own > 0 and (found.error > 0).all():
            candidates = np.isin(judged.standings, (COUNTS, TOO_SMALL)).sum()
            to_detect, to_equal = _needed(part, found, printed, ALPHA / max(int(candidates), 1), n)
    ratio, ratio_low, ratio_high = (one / own if own > 0 else math.nan for one in (value, low, high))
    verdict = str(judged.verdicts[place])
    return Finding(
        claim=claim.number,
        text=part.text,
        paper=own,
        value=value,
        low=low,
        high=high,
        confidence=1 - level if found is not None else math.nan,
        ratio=ratio,
        ratio_low=ratio_low,
        ratio_high=ratio_high,
        nearest=nearest,
        p_holm=float(judged.p_holm[place]),
        n=n,
        verdict=verdict,
        less_than_half=bool(judged.less_than_half[place]) and verdict in (REPLICATES, REVERSES),
        standing=str(judged.standings[place]),
        power=float(judged.power[place]),
        to_detect=to_detect,
        to_equal=to_equal,
    )


def _needed(part: Part, found: Contrasts, effects_: Array, level: float, n: int) -> tuple[float, float]:
    """Seeds a configuration that find the paper's effects [J], and that show absence by two one-sided tests.

    Both with `POWER`, the second where all configurations are equal; seeds scatter as ours, and none of our
    effects enters. The errors of n seeds a configuration are those of ours times sqrt(n / seeds).
    """

    def of(seeds: int) -> Contrasts:
        return found._replace(error=found.error * math.sqrt(n / seeds), df=found.df * (seeds - 1) / (n - 1))

    def equals(seeds: int) -> bool:
        margin, count = HALF * np.full(len(effects_), _extreme(part, effects_)), len(effects_)
        alone, adjusted = (of(seeds).power(margin, one) for one in (ALPHA, ALPHA / count))
        return bool(alone.prod() + adjusted.max() - 1 >= POWER)

    detects = stats.fewest(lambda seeds: bool(_power(part, of(seeds), effects_, level) >= POWER), SEEDS)
    return detects, stats.fewest(equals, SEEDS)
