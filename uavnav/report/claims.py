"""The paper's claims as data: each is a list of parts, which `verdicts` judges by one rule.

A part asks whether linear contrasts of cells' means over training seeds are above zero. To add a claim, add a line to
`CLAIMS`. The paper's own effect is the same function of its printed tables. Letters: S seeds of a cell, C terms of a
part, J its contrasts.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import pandas as pd

from uavnav.runs import paper
from uavnav.runs.metrics import METRICS
from uavnav.runs.readings import PER_FRAME
from uavnav.stats import Array

PRIMARY = PER_FRAME
"""The reading that decides a verdict."""
ALGORITHMS = ("ppo", "dqn")
"""Those that the claims compare: the first is said to be better."""
BOUNDED, UNBOUNDED = ("tanh", "sigmoid"), ("relu", "leaky_relu")
ACTIVATIONS = (*BOUNDED, *UNBOUNDED)
CELLS = tuple(itertools.product(ALGORITHMS, ACTIVATIONS))
SIX = {name: METRICS[name] for name in paper.COLUMNS}
"""The metrics of the paper's tables."""
SURGE = (300_000, 600_000)
"""Frames between which the paper sees DQN with sigmoid surge."""
TIMES = 1.5
"""What counts as "about twice" and "nearly double": at least so many times each other cell."""
NAMES = {"tanh": "tanh", "sigmoid": "sigmoid", "relu": "ReLU", "leaky_relu": "leaky ReLU"}


class Evidence(Protocol):
    """A metric of a cell: one number a seed [S]; none where it is not known.

    Beside the six metrics there are

    - `stops`, and `hours` (one number a run);
    - `reward_before`, `reward_surge`, `reward_after`: reward in 0-300,000, 300,000-600,000 and the last 100,000 frames,
      in the same order of seeds;
    - what `behaviour.measures` gives; the same in the empty arena as `empty_clearance` and so on;
    - `corridor_early` and `clearance_early`: the same without the last 40 steps before a crash (`behaviour.early`);
    - `corridor_by_layout` and `clearance_by_layout`: one number a layout, the mean over seeds, in the same order of
      layouts in every cell (`behaviour.by_layout`).

    study: `main`, `initial` (the first reward) or `baseline` (the same frames without it).
    """

    def __call__(self, algorithm: str, activation: str, metric: str, study: str = "main") -> Array: ...


class Term(NamedTuple):
    """The arguments of an `Evidence`."""

    algorithm: str
    activation: str
    metric: str
    study: str = "main"

    def __str__(self) -> str:
        return f"{self.algorithm.upper()} {NAMES[self.activation]}"


@dataclass(frozen=True)
class Part:
    """One question: are these contrasts of the terms' means above zero, every one or at least one?

    weights: [J][C]. A metric of which less is better enters with a minus, so that the claimed direction is up.
    """

    text: str
    terms: tuple[Term, ...]
    weights: tuple[tuple[float, ...], ...]
    every: bool = True
    paired: bool = False  # the terms are the same seeds (or layouts), in the same order
    beside: bool = False  # it stands beside the claim and is no part of its grade

    def sides(self, contrast: int) -> str:
        """Which cells a contrast compares, in words."""
        weighed = list(zip(self.weights[contrast], self.terms, strict=True))
        return " against ".join(
            ", ".join(dict.fromkeys(str(term) for weight, term in weighed if sign * weight > 0)) or "0"
            for sign in (1, -1)
        )


class Claim(NamedTuple):
    """A sentence of the paper and what it comes to."""

    number: int
    sentence: str
    parts: tuple[Part, ...]
    shown: int = 0  # the part that the claim's sentence is about (templates/study.md)
    equal: tuple[str, ...] = ("algorithm", "metric")
    """If nothing that the claim compares differed, terms that agree in these fields would have the same mean."""
    note: str = ""  # what else its own tables say


def _cells(algorithm: str, activations: Sequence[str] = ACTIVATIONS) -> list[tuple[str, str]]:
    return list(itertools.product([algorithm], activations))


def _others(activation: str) -> list[str]:
    return [one for one in ACTIVATIONS if one != activation]


def _terms(cells: Sequence[tuple[str, ...]], metric: str) -> tuple[Term, ...]:
    return tuple(Term(algorithm, activation, metric, *study) for algorithm, activation, *study in cells)


def _means(
    text: str, metric: str, up: Sequence[tuple[str, ...]], down: Sequence[tuple[str, ...]], sign: int = 1, **more: bool
) -> Part:
    """The mean of some cells is above that of others (sign -1: below)."""
    weights = (*[sign / len(up)] * len(up), *[-sign / len(down)] * len(down))
    return Part(text, _terms([*up, *down], metric), (weights,), **more)


def _pairs(
    text: str,
    metric: str,
    up: Sequence[tuple[str, str]],
    down: Sequence[tuple[str, str]],
    sign: int = 1,
    every: bool = True,
) -> Part:
    """Each cell is above each of the others (sign -1: below); or else at least one of these pairs is in that order."""
    count = len(up) + len(down)
    rows = []
    for first, second in itertools.product(range(len(up)), range(len(up), count)):
        row = [0.0] * count
        row[first], row[second] = sign, -sign
        rows.append(tuple(row))
    return Part(text, _terms([*up, *down], metric), tuple(rows), every)


def _times(text: str, metric: str, up: tuple[str, str], down: Sequence[tuple[str, str]]) -> Part:
    """A cell is above zero and above `TIMES` each of the others: nothing is twice a loss."""
    rows = [(1.0, *(-TIMES * (other == one) for one in down)) for other in (None, *down)]
    return Part(text, _terms([up, *down], metric), tuple(rows))


def _label(metric: str) -> str:
    """A metric's name in any reading."""
    return METRICS[metric].label


def _best(algorithm: str, activation: str) -> list[Part]:
    mine, others = _cells(algorithm, [activation]), _cells(algorithm, _others(activation))
    text = f"{algorithm.upper()} with {NAMES[activation]} better than each other activation"
    return [_pairs(f"{_label(name)}: {text}", name, mine, others, metric.better) for name, metric in SIX.items()]


def _ppo_outperforms_dqn() -> list[Part]:
    ppo, dqn = map(_cells, ALGORITHMS)
    means, each = "PPO better than DQN, means of four activations", "each PPO cell better than each DQN cell"
    return [
        *(_means(f"{_label(name)}: {means}", name, ppo, dqn, metric.better) for name, metric in SIX.items()),
        *(_pairs(f"{_label(name)}: {each}", name, ppo, dqn, metric.better) for name, metric in SIX.items()),
    ]


def _ppo_tanh_is_best() -> list[Part]:
    text = f"PPO with tanh at least {TIMES} times each other activation"
    mine, others = ("ppo", "tanh"), _cells("ppo", _others("tanh"))
    twice = [_times(f"{_label(metric)}: {text}", metric, mine, others) for metric in ("reward", "steps", "distance")]
    return [*_best("ppo", "tanh"), *twice]


def _dqn_sigmoid_surges() -> list[Part]:
    terms = tuple(Term("dqn", "sigmoid", f"reward_{when}") for when in ("before", "surge", "after"))
    above = "reward of DQN with sigmoid: 300,000 to 600,000 frames above"
    lost = "reward of DQN with sigmoid: more than half of the rise by 600,000 frames is lost in the last 100,000"
    return [
        Part(f"{above} those before", terms[:2], ((-1.0, 1.0),), paired=True),
        Part(f"{above} the last 100,000", terms[1:], ((1.0, -1.0),), paired=True),
        Part(lost, terms, ((0.5, 0.5, -1.0),), paired=True),
    ]


def _ppo_sigmoid_is_weakest() -> list[Part]:
    mine, others = _cells("ppo", ["sigmoid"]), _cells("ppo", _others("sigmoid"))
    parts = [
        _pairs(f"{_label(name)}: PPO with sigmoid worse than each other activation", name, mine, others, -metric.better)
        for name, metric in SIX.items()
        if name != "steps"
    ]
    return [
        *parts,
        _pairs("steps: PPO with sigmoid above at least one other activation", "steps", mine, others, 1, False),
    ]


def _bounded(algorithm: str, metric: str, beside: bool = False) -> Part:
    text = f"{_label(metric)}: {algorithm.upper()}'s tanh and sigmoid above its ReLU and leaky ReLU"
    return _means(text, metric, _cells(algorithm, BOUNDED), _cells(algorithm, UNBOUNDED), beside=beside)


def _bounded_beat_unbounded() -> list[Part]:
    text = "reward: PPO's sigmoid below its ReLU and leaky ReLU"
    return [
        *(_bounded(algorithm, metric) for algorithm in ALGORITHMS for metric in ("reward", "steps", "distance")),
        _means(text, "reward", _cells("ppo", ["sigmoid"]), _cells("ppo", UNBOUNDED), -1),
    ]


def _activations_interact() -> list[Part]:
    words = {"dqn": ("above", 1), "ppo": ("below", -1)}
    sigmoid = [
        _means(
            f"reward: {algorithm.upper()}'s sigmoid {word} the mean of its three others",
            "reward",
            _cells(algorithm, ["sigmoid"]),
            _cells(algorithm, _others("sigmoid")),
            sign,
        )
        for algorithm, (word, sign) in words.items()
    ]
    return [*sigmoid, *(_bounded(algorithm, "reward", beside=True) for algorithm in words)]


def _dqn_takes_corridors() -> list[Part]:
    ppo, dqn = map(_cells, ALGORITHMS)
    steps, space = "share of steps between two close obstacles", "distance to the nearest obstacle or wall"
    more, wider = "DQN above PPO", "PPO above DQN"
    early, layouts = ", without the last 40 steps before a crash", ", layouts resampled"
    questions = {
        "corridor": (f"{steps}: {more}", -1),
        "corridor_flown": (f"share of the distance flown between two close obstacles: {more}", -1),
        "clearance": (f"{space}: {wider}", 1),
        "empty_clearance": (f"distance to the nearest wall in the empty arena: {wider}", 1),
        "corridor_early": (f"{steps}{early}: {more}", -1),
        "clearance_early": (f"{space}{early}: {wider}", 1),
        "corridor_by_layout": (f"{steps}{layouts}: {more}", -1),
        "clearance_by_layout": (f"{space}{layouts}: {wider}", 1),
    }
    return [
        _means(text, metric, ppo, dqn, sign, paired=metric.endswith("_by_layout"))
        for metric, (text, sign) in questions.items()
    ]


def _penalties_cure() -> list[Part]:
    questions = {"full_stops": "full stops", "turns": "turning", "reversals": "reversals of turning per step"}
    first, second = (
        {algorithm: [(algorithm, one, study) for one in ("tanh", "relu")] for algorithm in ALGORITHMS}
        for study in ("initial", "baseline")
    )
    return [
        _means(f"{text}: {algorithm.upper()} more under the first reward", metric, first[algorithm], second[algorithm])
        for algorithm in ALGORITHMS
        for metric, text in questions.items()
    ]


def _ten_hours() -> list[Part]:
    text = "hours for 1,000,000 steps: a seed's share of a run of several side by side, mean of the eight cells"
    return [Part(text, _terms(CELLS, "hours"), ((1 / len(CELLS),) * len(CELLS),), beside=True)]


CLAIMS = (
    Claim(
        1,
        "PPO outperforms DQN in all six metrics, and PPO's weakest result surpasses DQN's best.",
        tuple(_ppo_outperforms_dqn()),
        5,
        ("metric",),
    ),
    Claim(
        2,
        "PPO with tanh is best: its reward is nearly double the next, its steps and distance about twice the others'.",
        tuple(_ppo_tanh_is_best()),
        5,
        note="In its own table the steps are 1.58 and the distance 1.59 times the runner-up's.",
    ),
    Claim(
        3,
        "DQN with sigmoid is best in all six columns of its table.",
        tuple(_best("dqn", "sigmoid")),
        5,
        note="The six columns are the bold type of the table; the text says best overall.",
    ),
    Claim(
        4,
        "DQN with sigmoid surges between 300,000 and 600,000 steps and then falls steeply.",
        tuple(_dqn_sigmoid_surges()),
        1,
        ("algorithm", "activation"),
    ),
    Claim(
        5,
        "With PPO, ReLU and leaky ReLU stop least.",
        (
            _pairs(
                "full stops: PPO's ReLU and leaky ReLU each below its tanh and its sigmoid",
                "full_stops",
                _cells("ppo", UNBOUNDED),
                _cells("ppo", BOUNDED),
                -1,
            ),
        ),
        0,
    ),
    Claim(
        6,
        "With PPO, sigmoid is weakest except in steps.",
        tuple(_ppo_sigmoid_is_weakest()),
        4,
    ),
    Claim(
        7,
        "Bounded activations (sigmoid, tanh) generally beat unbounded ones (ReLU, leaky ReLU), though sigmoid is behind"
        " in PPO.",
        tuple(_bounded_beat_unbounded()),
        0,
    ),
    Claim(
        8,
        "No single family of activations is universally superior: algorithm and activation interact.",
        tuple(_activations_interact()),
        1,
        note="In its own tables bounded activations are ahead in both algorithms; what changes sides is sigmoid.",
    ),
    Claim(
        9,
        "DQN steers through corridors between obstacles; PPO keeps to open space.",
        tuple(_dqn_takes_corridors()),
        0,
        ("metric",),
        "Two parts leave out the last 40 steps before a crash. In two, the unit is the set of obstacles and not the"
        " seed, so that the answer holds for other sets; their n counts sets.",
    ),
    Claim(
        10,
        "The first reward led to standing still and to trembling; the penalties of eq. (14) cure both.",
        tuple(_penalties_cure()),
        2,
        ("algorithm", "activation", "metric"),
        "The runs are the shorter ones of the studies initial and baseline, tanh and ReLU; the reversals are of the"
        " watched flights on test sets.",
    ),
    Claim(
        11,
        "A million steps take about ten hours.",
        tuple(_ten_hours()),
        0,
        note="It is another machine, and no claim about learning.",
    ),
)


def long(samples: Mapping[tuple[str, str], Array]) -> pd.DataFrame:
    """One row a seed, as `stats.interaction` takes it: columns algorithm, activation, value."""
    rows = [(*cell, value) for cell, values in samples.items() for value in values]
    return pd.DataFrame(rows, columns=["algorithm", "activation", "value"])
