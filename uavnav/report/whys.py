"""Why cells differ: questions to side studies that each change one setting, with a figure and a sentence for each.

A question is data: rows to draw, and contrasts of which the first answers it. To add one, add it to `QUESTIONS` and its
cells to the target `why` of the Makefile. Letters: S seeds of a cell.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from typing import NamedTuple

import pandas as pd

from uavnav import stats
from uavnav.report.claims import ALGORITHMS, PRIMARY, Evidence
from uavnav.report.frames import MEASURES
from uavnav.report.tables import with_interval
from uavnav.runs.metrics import METRICS
from uavnav.runs.readings import words

Place = tuple[str, str, str]
"""Study, algorithm and activation, as `Evidence` takes them."""
PPO, DQN = ALGORITHMS
SHORT, LONG = "baseline", "many_worlds"
"""Studies that change nothing, of fewer and of as many frames as the paper's."""


class Contrast(NamedTuple):
    """The mean of some cells minus that of others, in words: `what` against `other`."""

    metric: str
    what: str
    other: str
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
    return Contrast(metric, f"{algorithm.upper()} with {setting}={low}", f"with {setting}={high}", (first,), (second,))


def _activations() -> Question:
    plain = ("tanh", "hardtanh", "sigmoid_centred", "sigmoid", "relu6", "relu", "leaky_relu")
    changed = {"layer_norm=True": "LayerNorm", "init=unit": "one scale"}
    rows: dict[str, Place] = {}
    contrasts: list[Contrast] = []
    for one in ALGORITHMS:
        rows |= {f"{one.upper()} {activation}": (SHORT, one, activation) for activation in plain}
        for study, label in changed.items():
            rows |= {f"{one.upper()} {name}, {label}": (study, one, name) for name in ("tanh", "sigmoid", "relu")}
        pairs = [("relu6", "relu", SHORT, ""), ("sigmoid_centred", "sigmoid", SHORT, ""), ("tanh", "relu", SHORT, "")]
        pairs += [("tanh", "relu", study, f", both with {label}") for study, label in changed.items()]
        contrasts += [
            Contrast("reward", f"{one.upper()} with {a}", f"with {b}{how}", ((study, one, a),), ((study, one, b),))
            for a, b, study, how in pairs
        ]
    return Question("activations", "Is it boundedness, centring or scale?", ("reward",), rows, tuple(contrasts))


def _rewards() -> Question:
    metrics, pair = ("full_stops", "turns", "reversals"), ("tanh", "relu")
    studies = {"reward=initial": "first reward", "reward=additive": "added penalties", LONG: "eq. (14)"}
    rows = {
        f"{one.upper()} {activation}, {label}": (study, one, activation)
        for one, activation in itertools.product(ALGORITHMS, pair)
        for study, label in studies.items()
    }
    contrasts = tuple(
        Contrast(
            metric,
            f"{one.upper()} under the first reward",
            "under eq. (14)",
            tuple(("reward=initial", one, activation) for activation in pair),
            tuple((LONG, one, activation) for activation in pair),
        )
        for metric, one in itertools.product(metrics, ALGORITHMS)
    )
    return Question("rewards", "What do the penalties cure?", metrics, rows, contrasts)


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
        (_ends("clearance", "clip_epsilon", "0.05", "None", PPO), _ends("clearance", "epochs", "1", "20", PPO)),
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
        (_ends("reward", "epsilon_end", "0.0", "0.2", DQN), _ends("reward", "entropy_coeff", "0.001", "0.03", PPO)),
    ),
    _rewards(),
)


def table(evidence: Evidence) -> pd.DataFrame:
    """All that is drawn and said: columns question, row, metric, value, low, high, n.

    A row's interval is of Student's t over its seeds, a contrast's is Welch's. What no seed tells is left out, and a
    question that no contrast answers.
    """
    rows: list[list[object]] = []
    for one in QUESTIONS:
        answers = []
        for contrast in one.contrasts:
            seeds = _seeds(evidence, contrast.metric)
            first, second = ([seeds(place) for place in places] for places in (contrast.first, contrast.second))
            answers.append([one.name, _label(contrast), contrast.metric, *stats.difference(first, second)])
        drawn = [
            [one.name, label, metric, *stats.difference([_seeds(evidence, metric)(place)], [])]
            for (label, place), metric in itertools.product(one.rows.items(), one.metrics)
        ]
        if any(answer[-1] for answer in answers):
            rows += [row for row in (*drawn, *answers) if row[-1]]
    return pd.DataFrame(rows, columns=["question", "row", "metric", "value", "low", "high", "n"])


def _seeds(evidence: Evidence, metric: str) -> Callable[[Place], stats.Array]:
    return lambda place: evidence(place[1], place[2], metric, study=place[0])


def _label(contrast: Contrast) -> str:
    return f"{contrast.what} minus {contrast.other}"


def in_words(metric: str) -> str:
    """A metric or measure as people call it."""
    return words(metric, PRIMARY) if metric in METRICS else MEASURES[metric]


def answers(found: pd.DataFrame, question: Question) -> list[str]:
    """A sentence for each contrast that there are seeds for, the one that answers first; found: as `table` gives it."""
    known = found[found["question"] == question.name].set_index(["row", "metric"])[["value", "low", "high"]].T
    said = []
    for contrast in question.contrasts:
        if (key := (_label(contrast), contrast.metric)) in known:
            value, low, high = map(float, known[key])
            apart = "" if low * high > 0 else "not told apart: "
            number = with_interval(value, low, high, 4 if contrast.metric in ("reward", "corridor", "reversals") else 2)
            said.append(f"{contrast.what} against {contrast.other}, {in_words(contrast.metric)}: {apart}{number}.")
    return said
