"""Why cells differ: questions to side studies that each change one setting; templates/study.md answers them.

A question is data: rows to show, and contrasts that answer it. To add one, add it to `QUESTIONS` and its cells to
uavnav/studies/why.yaml. Letters: S seeds of a cell.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from typing import NamedTuple

import pandas as pd

from uavnav import stats
from uavnav.report.claims import ALGORITHMS, PRIMARY, Evidence
from uavnav.report.frames import MEASURES
from uavnav.runs.metrics import METRICS
from uavnav.runs.readings import words

Place = tuple[str, str, str]
"""Study, algorithm and activation, as `Evidence` takes them."""
PPO, DQN = ALGORITHMS
SHORT, LONG = "baseline", "vectorised"
"""Studies that change nothing, of fewer and of as many frames as the paper's."""
PAIR = ("tanh", "relu")
"""Activations of the studies that are as long as the paper's."""


class Contrast(NamedTuple):
    """The mean of some cells minus that of others; `templates/study.md` quotes it by its name."""

    metric: str
    name: str
    first: tuple[Place, ...]
    second: tuple[Place, ...]


class Question(NamedTuple):
    """What is asked, what is drawn, and what answers."""

    name: str
    text: str
    metrics: tuple[str, ...]  # a panel each
    rows: dict[str, Place]
    contrasts: tuple[Contrast, ...]


def _settings(setting: str, values: Iterable[str], usual: str, algorithms: Iterable[str]) -> dict[str, Place]:
    """A row for each value of a setting, with tanh."""
    return {
        f"{algorithm.upper()} {setting}={value}": (SHORT if value == usual else f"{setting}={value}", algorithm, "tanh")
        for algorithm in algorithms
        for value in values
    }


def _ends(metric: str, setting: str, low: str, high: str, algorithm: str) -> Contrast:
    """The lowest value of a setting against the highest."""
    first, second = ((f"{setting}={value}", algorithm, "tanh") for value in (low, high))
    name = f"{algorithm.upper()} with {setting}={low} minus with {setting}={high}"
    return Contrast(metric, name, (first,), (second,))


def _activations() -> Question:
    plain = ("tanh", "hardtanh", "sigmoid_centred", "sigmoid", "relu6", "relu", "leaky_relu")
    changed = {"layer_norm=True": "LayerNorm", "init=unit": "one scale"}
    rows: dict[str, Place] = {}
    contrasts: list[Contrast] = []
    for one in ALGORITHMS:
        rows |= {f"{one.upper()} {activation}": (SHORT, one, activation) for activation in plain}
        for study, label in changed.items():
            rows |= {f"{one.upper()} {name}, {label}": (study, one, name) for name in ("tanh", "sigmoid", "relu")}
        pairs = [("tanh", "relu", SHORT, ""), ("relu6", "relu", SHORT, ""), ("sigmoid_centred", "sigmoid", SHORT, "")]
        pairs += [("tanh", "relu", study, f", both with {label}") for study, label in changed.items()]
        for a, b, study, how in pairs:
            name = f"{one.upper()} with {a} minus with {b}{how}"
            contrasts.append(Contrast("reward", name, ((study, one, a),), ((study, one, b),)))
    return Question("activations", "Is it boundedness, centring or scale?", ("reward",), rows, tuple(contrasts))


def _of_pair(labels: dict[str, str]) -> dict[str, Place]:
    """A row for each algorithm, activation of the pair and study, as long as the paper's."""
    return {
        f"{one.upper()} {activation}, {label}": (study, one, activation)
        for one, activation in itertools.product(ALGORITHMS, PAIR)
        for study, label in labels.items()
    }


def _against_long(study: str, algorithm: str, metric: str, how: str) -> Contrast:
    """A study against the one that changes nothing, means of the pair."""
    first, second = (tuple((one, algorithm, activation) for activation in PAIR) for one in (study, LONG))
    return Contrast(metric, f"{algorithm.upper()} {how}", first, second)


def _rewards() -> Question:
    metrics, initial = ("full_stops", "turns", "reversals"), "reward=initial"
    labels = {initial: "first reward", "reward=additive": "added penalties", LONG: "eq. (14)"}
    how = "under the first reward minus under eq. (14)"
    contrasts = tuple(
        _against_long(initial, one, metric, how) for metric, one in itertools.product(metrics, ALGORITHMS)
    )
    return Question("rewards", "What do the penalties cure?", metrics, _of_pair(labels), contrasts)


def _memory() -> Question:
    labels = {LONG: "one", "stack=4": "the last four"}
    how = "with the last four observations minus with one"
    contrasts = tuple(_against_long("stack=4", one, "reward", how) for one in ALGORITHMS)
    return Question("memory", "Does remembering help?", ("reward",), _of_pair(labels), contrasts)


CLIPS, EPOCHS = ("0.05", "0.1", "0.2", "0.4", "None"), ("1", "3", "10", "20")
GAMMAS, EPSILONS, ENTROPIES = (
    ("0.9", "0.95", "0.99", "0.999"),
    ("0.0", "0.01", "0.05", "0.2"),
    ("0.0", "0.001", "0.01", "0.03"),
)
QUESTIONS = (
    _activations(),
    Question(
        "caution",
        "Do gradual updates make PPO cautious?",
        ("clearance", "reward"),
        _settings("clip_epsilon", CLIPS, "0.2", [PPO]) | _settings("epochs", EPOCHS, "10", [PPO]),
        (
            _ends("clearance", "clip_epsilon", "0.05", "None", PPO),
            _ends("clearance", "epochs", "1", "20", PPO),
        ),
    ),
    Question(
        "horizon",
        "Do immediate rewards make DQN take corridors?",
        ("corridor", "reward"),
        _settings("gamma", GAMMAS, "0.99", [DQN, PPO]),
        tuple(_ends("corridor", "gamma", "0.9", "0.999", one) for one in (DQN, PPO)),
    ),
    Question(
        "exploration",
        "Does exploration keep them apart?",
        ("reward", "clearance"),
        _settings("epsilon_end", EPSILONS, "0.05", [DQN]) | _settings("entropy_coeff", ENTROPIES, "0.0", [PPO]),
        (
            _ends("reward", "epsilon_end", "0.0", "0.2", DQN),
            _ends("reward", "entropy_coeff", "0.001", "0.03", PPO),
        ),
    ),
    _rewards(),
    _memory(),
)


def table(evidence: Evidence) -> pd.DataFrame:
    """All that is drawn and said: columns question, row, metric, value, low, high, n.

    A row's interval is of Student's t over its seeds, a contrast's is Welch's. Rows without a seed are left
    out, and so are questions without a contrast.
    """
    rows: list[list[object]] = []
    for one in QUESTIONS:
        answers = []
        for contrast in one.contrasts:
            seeds = _seeds(evidence, contrast.metric)
            first, second = ([seeds(place) for place in places] for places in (contrast.first, contrast.second))
            answers.append([one.name, contrast.name, contrast.metric, *stats.difference(first, second)])
        drawn = [
            [one.name, label, metric, *stats.difference([_seeds(evidence, metric)(place)], [])]
            for (label, place), metric in itertools.product(one.rows.items(), one.metrics)
        ]
        if any(answer[-1] for answer in answers):
            rows += [row for row in (*drawn, *answers) if row[-1]]
    return pd.DataFrame(rows, columns=["question", "row", "metric", "value", "low", "high", "n"])


def _seeds(evidence: Evidence, metric: str) -> Callable[[Place], stats.Array]:
    return lambda place: evidence(place[1], place[2], metric, study=place[0])


def in_words(metric: str) -> str:
    """A metric or measure as people call it."""
    return words(metric, PRIMARY) if metric in METRICS else MEASURES[metric]
