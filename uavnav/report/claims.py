"""The audit: each claim of the paper as questions to the training seeds, and one rule that answers them.

A claim is a function of `Evidence`, which gives a metric of a cell as one number a seed, and returns its parts: an
estimand and the region in which the claim says that it lies. To add a claim, write such a function and name it in
`CLAIMS`. The paper's own figure of a part is the same function of its printed tables.

The rule (fixed when: `conclusions.FIXED`): a part is *supported* or *contradicted* if the 95 % bootstrap interval
of its estimand over seeds, adjusted by Holm for all parts of all claims, lies wholly inside or outside its region, and
every cell that it rests on has at least 8 seeds; else it is *undecided*. A claim is contradicted if one of its parts
is, supported if all are, and else undecided. Letters: S seeds of a cell.
"""

from __future__ import annotations

import functools
import itertools
import math
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import pandas as pd
from scipy import stats as distributions

from uavnav import stats
from uavnav.evaluate import WATCHED_LAYOUTS, WATCHED_STEPS
from uavnav.runs import paper
from uavnav.runs.metrics import METRICS
from uavnav.stats import Array

SEEDS = 8
"""In every cell, for a verdict."""
ALPHA = 0.05
POWER = 0.8
DRAWS = 20_000
"""Bootstrap draws: the adjusted intervals reach far into the tails."""
PRIMARY = "all training episodes"
ALGORITHMS = ("ppo", "dqn")
BOUNDED, UNBOUNDED = ("tanh", "sigmoid"), ("relu", "leaky_relu")
ACTIVATIONS = (*BOUNDED, *UNBOUNDED)
SIX = {name: METRICS[name] for name in paper.COLUMNS}
"""The metrics of the paper's tables."""
SURGE = (300_000, 600_000)
"""Frames between which the paper sees DQN with sigmoid surge."""

SUPPORTED, CONTRADICTED, UNDECIDED = "supported", "contradicted", "undecided"


class Evidence(Protocol):
    """A metric of a cell: one number a seed [S]; none where it is not known.

    Beside the six metrics there are `reward_before`, `reward_surge` and `reward_after` (of the episodes that ended
    before, in and after `SURGE`), `stops`, `hours` (one number a run), what `behaviour.measures` gives, and the same in
    the empty arena as `empty_clearance` and so on. study: `main`, `initial` (the first reward) or `baseline` (the same
    without it).
    """

    def __call__(self, algorithm: str, activation: str, metric: str, study: str = "main") -> Array: ...


class Region(NamedTuple):
    """Where a claim says that an estimand lies."""

    low: float
    high: float

    def __str__(self) -> str:
        if self.high == math.inf:
            return f"> {self.low:g}"
        return f"{self.low:g} to {self.high:g}"


POSITIVE = Region(0, math.inf)
ABOUT_TWICE = Region(1.5, 2.5)


@dataclass(frozen=True)
class Part:
    """One question: does this function of some cells' means over seeds lie in this region?

    samples: the cells' seeds, each [S]; statistic: of their means [...], one argument a cell, -> [...]. With `test`, a
    p value of the samples decides instead, and it can support only: that no difference was found is no evidence that
    there is none. With `seeds`, the samples are of runs, each of several seeds.
    """

    text: str
    samples: Sequence[Array]
    statistic: Callable[..., Any]
    region: Region = POSITIVE
    digits: int = 2
    test: Callable[[Sequence[Array]], float] | None = None
    least_p: float = 0.0  # that `test` can give
    seeds: int | None = None  # of the smallest cell
    paired: bool = False  # the samples are the same seeds at different times, and are resampled together

    @property
    def n(self) -> int:
        """Seeds of the smallest cell; 0 where a sample is empty."""
        smallest = min(len(sample) for sample in self.samples)
        return smallest if self.seeds is None or not smallest else self.seeds


class Claim(NamedTuple):
    """A sentence of the paper and what it comes to."""

    number: int
    sentence: str
    parts: Callable[[Evidence], list[Part]]
    note: str = ""  # what else its own tables say


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


# -- the claims -------------------------------------------------------------------------------------------------------


def ppo_outperforms_dqn(evidence: Evidence) -> list[Part]:
    """1. Means over the four activations; and PPO's worst cell against DQN's best."""
    gaps = {
        "PPO better than DQN, means of four activations": _gap,
        "PPO's worst activation better than DQN's best": _worst_best,
    }
    parts = []
    for text, gap in gaps.items():
        for name, metric in SIX.items():
            samples = [evidence(one, activation, name) for one in ALGORITHMS for activation in ACTIVATIONS]
            parts.append(Part(f"{metric}: {text}", samples, gap(metric.better)))
    return parts


def ppo_tanh_is_best(evidence: Evidence) -> list[Part]:
    """2. In each metric, and by how much in three."""
    parts = _best(evidence, "ppo", "tanh")
    for metric in ("reward", "steps", "distance"):
        samples = [evidence("ppo", activation, metric) for activation in _first("tanh")]
        text = f"{METRICS[metric]}: PPO with tanh about twice the next best"
        parts.append(Part(text, samples, _times_next, ABOUT_TWICE))
    return parts


def dqn_sigmoid_is_best(evidence: Evidence) -> list[Part]:
    """3. In all six columns."""
    return _best(evidence, "dqn", "sigmoid")


def dqn_sigmoid_surges(evidence: Evidence) -> list[Part]:
    """4. Up between 300,000 and 600,000 frames, and down by half of that or more afterwards."""
    before, surge, after = (evidence("dqn", "sigmoid", f"reward_{when}") for when in ("before", "surge", "after"))
    return [
        Part(
            "DQN with sigmoid: reward from 300,000 to 600,000 frames above that before",
            [surge, before],
            _difference,
            paired=True,
        ),
        Part(
            "DQN with sigmoid: reward from 300,000 to 600,000 frames above that after",
            [surge, after],
            _difference,
            paired=True,
        ),
        Part(
            "DQN with sigmoid: share of the rise in reward by 600,000 frames that is lost afterwards",
            [before, surge, after],
            _loss,
            Region(0.5, math.inf),
            paired=True,
        ),
    ]


def relu_and_leaky_relu_stop_least(evidence: Evidence) -> list[Part]:
    """5. The worse of the two against the better of the others."""
    samples = [evidence("ppo", activation, "full_stops") for activation in (*BOUNDED, *UNBOUNDED)]

    def statistic(tanh: Array, sigmoid: Array, relu: Array, leaky_relu: Array) -> Array:
        return np.asarray(np.minimum(tanh, sigmoid) - np.maximum(relu, leaky_relu))

    return [Part("full stops [%]: PPO's ReLU and leaky ReLU both below tanh and sigmoid", samples, statistic, digits=3)]


def ppo_sigmoid_is_weakest(evidence: Evidence) -> list[Part]:
    """6. In all metrics but steps."""
    parts = []
    for name, metric in SIX.items():
        samples = [evidence("ppo", activation, name) for activation in _first("sigmoid")]
        if name == "steps":
            parts.append(
                Part("steps per episode: PPO with sigmoid above the worst of the others", samples, _over_worst)
            )
        else:
            parts.append(Part(f"{metric}: PPO with sigmoid the worst", samples, _below_worst(metric.better)))
    return parts


def bounded_beat_unbounded(evidence: Evidence) -> list[Part]:
    """7. In reward; sigmoid alone is behind in PPO."""
    parts = []
    for algorithm in ALGORITHMS:
        samples = [evidence(algorithm, activation, "reward") for activation in (*BOUNDED, *UNBOUNDED)]
        text = f"reward per episode: {algorithm.upper()}'s tanh and sigmoid above its ReLU and leaky ReLU"
        parts.append(Part(text, samples, _halves))
    samples = [evidence("ppo", activation, "reward") for activation in (*UNBOUNDED, "sigmoid")]
    parts.append(Part("reward per episode: PPO's sigmoid below its ReLU and leaky ReLU", samples, _above_last))
    return parts


def activations_interact_with_algorithms(evidence: Evidence) -> list[Part]:
    """8. Whether two activations change places between the algorithms (`stats.interaction`, permuting seeds)."""
    cells = [(algorithm, activation) for algorithm in ALGORITHMS for activation in ACTIVATIONS]
    samples = [evidence(*cell, "reward") for cell in cells]

    def test(drawn: Sequence[Array]) -> float:
        return stats.interaction(long(dict(zip(cells, drawn, strict=True)))).p_ranks

    orders = math.perm(len(ACTIVATIONS), 2)
    text = f"reward per episode: of {orders // 2} pairs of activations, those in another order under PPO than under DQN"
    return [Part(text, samples, _reversed_pairs, digits=0, test=test, least_p=orders / (1 + stats.PERMUTATIONS))]


def dqn_takes_corridors(evidence: Evidence) -> list[Part]:
    """9. Flights on the same sets of obstacles, and in the arena without any."""
    questions = {
        "corridor": ("share of steps between two close obstacles: DQN above PPO", -1),
        "corridor_flown": ("share of the distance flown between two close obstacles: DQN above PPO", -1),
        "clearance": ("distance to the nearest obstacle or wall [px]: PPO above DQN", 1),
        "empty_clearance": ("distance to the nearest wall in the empty arena [px]: PPO above DQN", 1),
    }
    parts = []
    for metric, (text, sign) in questions.items():
        samples = [evidence(one, activation, metric) for one in ALGORITHMS for activation in ACTIVATIONS]
        parts.append(Part(text, samples, _gap(sign), digits=1 if sign > 0 else 3))
    return parts


def penalties_cure(evidence: Evidence) -> list[Part]:
    """10. Tanh and ReLU under the first reward and under eq. (14), all else equal."""
    parts = []
    for algorithm in ALGORITHMS:
        for metric, text in (("stops", "steps without motion [%]"), ("reversals", "reversals of turning per step")):
            samples = [
                evidence(algorithm, activation, metric, study=study)
                for study in ("initial", "baseline")
                for activation in ("tanh", "relu")
            ]
            parts.append(Part(f"{text}: {algorithm.upper()} more under the first reward", samples, _halves, digits=3))
    return parts


def a_million_steps_take_ten_hours(evidence: Evidence) -> list[Part]:
    """11. Wall time of a seed on the machine that the methods name; half to twice the paper's is about the same."""
    cells = [(algorithm, activation) for algorithm in ALGORITHMS for activation in ACTIVATIONS]
    hours = np.concatenate([evidence(*cell, "hours") for cell in cells])
    seeds = min(len(evidence(*cell, "reward")) for cell in cells)
    text = "hours for 1,000,000 steps: a seed's share of a run of several side by side"
    return [Part(text, [hours], _mean, Region(5, 20), digits=4, seeds=seeds)]


CLAIMS = (
    Claim(
        1,
        "PPO outperforms DQN in all six metrics, and PPO's weakest result surpasses DQN's best.",
        ppo_outperforms_dqn,
    ),
    Claim(
        2,
        "PPO with tanh is best: its reward is nearly double the next, its steps and distance about twice the others'.",
        ppo_tanh_is_best,
        "In its own table the steps are 1.58 and the distance 1.59 times the runner-up's.",
    ),
    Claim(3, "DQN with sigmoid is best in all six columns of its table.", dqn_sigmoid_is_best),
    Claim(4, "DQN with sigmoid surges between 300,000 and 600,000 steps and then falls steeply.", dqn_sigmoid_surges),
    Claim(5, "With PPO, ReLU and leaky ReLU stop least.", relu_and_leaky_relu_stop_least),
    Claim(
        6,
        "With PPO, sigmoid is weakest except in steps.",
        ppo_sigmoid_is_weakest,
        "By simulation, of four equal cells of 20 seeds the first is contradicted as the worst at Holm's level 0.0023"
        " in 1.9 % of studies, where 0.1 % is nominal (a difference of means: 0.15 %): the interval of an extreme is"
        " not centred. One contradicted part of that kind is weak evidence, also in claims 1 to 3 and 5.",
    ),
    Claim(
        7,
        "Bounded activations (sigmoid, tanh) generally beat unbounded ones (ReLU, leaky ReLU), though sigmoid is behind"
        " in PPO.",
        bounded_beat_unbounded,
    ),
    Claim(
        8,
        "No single family of activations is universally superior: algorithm and activation interact.",
        activations_interact_with_algorithms,
    ),
    Claim(9, "DQN steers through corridors between obstacles; PPO keeps to open space.", dqn_takes_corridors),
    Claim(
        10,
        "The first reward led to standing still and to trembling; the penalties of eq. (14) cure both.",
        penalties_cure,
        "It is of the shorter runs of the studies initial and baseline, tanh and ReLU; the reversals are of flights of"
        f" at most {WATCHED_STEPS} steps on {WATCHED_LAYOUTS} test sets.",
    ),
    Claim(
        11,
        "A million steps take about ten hours.",
        a_million_steps_take_ten_hours,
        "Its interval is over runs, one a cell, whose seeds share their time.",
    ),
)


# -- the rule ---------------------------------------------------------------------------------------------------------


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
        _finding(number, part, own, draws, p <= _least_p(part), float(p_holm), level)
        for (number, part), own, draws, p, p_holm, level in judged
    ]


def verdict(findings: Sequence[Finding]) -> str:
    """Of a claim, from its parts."""
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


def long(samples: dict[tuple[str, str], Array]) -> pd.DataFrame:
    """One row a seed, as `stats.interaction` takes it: columns algorithm, activation, value."""
    rows = [(*cell, value) for cell, values in samples.items() for value in values]
    return pd.DataFrame(rows, columns=["algorithm", "activation", "value"])


def _value(part: Part) -> float:
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(part.statistic(*(sample.mean() for sample in part.samples))) if part.n else math.nan


def _draw(part: Part, seed: int) -> Array:
    """Bootstrap draws of the statistic, each cell's seeds resampled by themselves: [DRAWS]; none below 2 seeds.

    NaN where the statistic is undefined.
    """
    if min(len(sample) for sample in part.samples) < 2:
        return np.empty(0)
    cells = [sample.tobytes() for sample in part.samples]
    # of a cell's values to nine digits: sums of the last places differ from processor to processor
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

    stream: of the draws; one of its own for each cell of a part, also where two hold the same values.
    """
    values = np.frombuffer(seeds)
    rng = np.random.default_rng(stream)
    return np.asarray(values[rng.integers(len(values), size=(DRAWS, len(values)))].mean(1))


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


def _least_p(part: Part) -> float:
    """The smallest p value that so many draws can give."""
    return 2 / (DRAWS + 1) if part.test is None else part.least_p


def _interval(draws: Array, level: float) -> tuple[float, float]:
    """Of 1 - level: the draws between which it excludes a region's edge if and only if `_p_value` is below the level.

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


def _finding(
    number: int, part: Part, printed: Part, draws: Array, p_is_bound: bool, p_holm: float, level: float
) -> Finding:
    value, low, high = _value(part), math.nan, math.nan
    if len(draws) and part.test is None:
        low, high = _interval(draws, level)
    inside = part.region.low < low and high < part.region.high
    answer = UNDECIDED
    if part.n >= SEEDS and p_holm < ALPHA:
        answer = SUPPORTED if inside or part.test is not None else CONTRADICTED
    needed = _needed(part, value, draws, level) if answer == UNDECIDED and part.n else math.nan
    own = _value(printed)
    against_itself = part.test is None and not math.isnan(own) and not part.region.low < own < part.region.high
    region = "p < 0.05" if part.test is not None else str(part.region)
    return Finding(
        number,
        part.text,
        own,
        value,
        low,
        high,
        1 - level,
        region,
        p_holm,
        p_is_bound,
        part.n,
        needed,
        answer,
        against_itself,
        part.digits,
    )


def _needed(part: Part, value: float, draws: Array, level: float) -> float:
    """Seeds a cell, by the normal approximation: n times the squared ratio of what would do to what there is.

    At least `SEEDS`; of fewer, all that is said where there is no interval.
    """
    least = SEEDS if part.n < SEEDS else math.nan
    if part.test is not None or not len(draws) or not np.isfinite(draws).all() or not math.isfinite(value):
        return least
    gap = min(abs(value - edge) for edge in part.region if math.isfinite(edge))
    if gap == 0:
        return math.inf
    quantiles = distributions.norm.ppf([1 - level / 2, POWER]).sum()
    return float(max(math.ceil(part.n * (quantiles * draws.std() / gap) ** 2), SEEDS))


# -- estimands: cells' means [...] -> [...] ---------------------------------------------------------------------------


def _mean(a: Array) -> Array:
    return a


def _difference(a: Array, b: Array) -> Array:
    return a - b


def _halves(*means: Array) -> Array:
    """The mean of the first half of the cells minus that of the second."""
    half = len(means) // 2
    return np.asarray(np.mean(means[:half], axis=0) - np.mean(means[half:], axis=0))


def _gap(sign: int) -> Callable[..., Array]:
    """The same, in the direction that is better."""
    return lambda *means: np.asarray(sign * _halves(*means))


def _worst_best(sign: int) -> Callable[..., Array]:
    """The worst of the first half of the cells minus the best of the second."""

    def statistic(*means: Array) -> Array:
        signed, half = sign * np.array(means), len(means) // 2
        return np.asarray(signed[:half].min(0) - signed[half:].max(0))

    return statistic


def _over_best(sign: int) -> Callable[..., Array]:
    """The first cell minus the best of the others."""

    def statistic(*means: Array) -> Array:
        signed = sign * np.array(means)
        return np.asarray(signed[0] - signed[1:].max(0))

    return statistic


def _below_worst(sign: int) -> Callable[..., Array]:
    """The worst of the others minus the first cell."""

    def statistic(*means: Array) -> Array:
        signed = sign * np.array(means)
        return np.asarray(signed[1:].min(0) - signed[0])

    return statistic


def _over_worst(first: Array, *others: Array) -> Array:
    return np.asarray(first - np.min(others, axis=0))


def _above_last(*means: Array) -> Array:
    return np.asarray(np.mean(means[:-1], axis=0) - means[-1])


def _times_next(first: Array, *others: Array) -> Array:
    next_best = np.max(others, axis=0)
    return np.asarray(first / np.where(next_best > 0, next_best, np.nan))  # nothing is twice a loss


def _loss(before: Array, surge: Array, after: Array) -> Array:
    return np.asarray((surge - after) / (surge - before))


def _reversed_pairs(*means: Array) -> Array:
    """How many pairs of the first half of the cells stand in another order in the second."""
    half = len(means) // 2
    pairs = itertools.combinations(range(half), 2)
    products = [(means[a] - means[b]) * (means[half + a] - means[half + b]) for a, b in pairs]
    return np.asarray(np.sum(np.array(products) < 0, axis=0))


def _best(evidence: Evidence, algorithm: str, activation: str) -> list[Part]:
    parts = []
    for name, metric in SIX.items():
        samples = [evidence(algorithm, one, name) for one in _first(activation)]
        text = f"{metric}: {algorithm.upper()} with {activation} the best"
        parts.append(Part(text, samples, _over_best(metric.better), digits=3 if name == "full_stops" else 2))
    return parts


def _first(activation: str) -> list[str]:
    """The activations, this one first."""
    return [activation, *(one for one in ACTIVATIONS if one != activation)]
