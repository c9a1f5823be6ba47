"""Why configurations differ: questions to side studies; templates/study.md answers them.

A question is data: rows to show, and contrasts that answer it. To add one, add it to `QUESTIONS` and its
configurations to uavnav/studies/why.yaml. Letters: S seeds of a configuration.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from uavnav import stats
from uavnav.report.claims import COMPARED, PAIR, Evidence
from uavnav.report.frames import NUMBERS, Rows, columns

Place = tuple[str, str, str]
"""Study, algorithm and activation, as `Evidence` takes them."""
PPO, DQN = COMPARED
SHORT, LONG = "baseline", "vectorised"
"""Studies that change nothing, of fewer and of as many frames as the paper's."""


class Contrast(NamedTuple):
    """The mean of some configurations minus that of others; `templates/study.md` quotes it by its name."""

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
    contrasts: list[Contrast]


Answers = tuple[dict[str, Place], list[Contrast]]


def _sweep(
    metric: str, setting: str, values: Sequence[str], usual: str, *algorithms: str, low: int = 0
) -> Answers:
    """A row for each value of a setting, with tanh; the lowest (at place `low`) against the highest."""
    rows: dict[str, Place] = {}
    contrasts = []
    for one in algorithms:
        places = {value: (SHORT if value == usual else f"{setting}={value}", one, "tanh") for value in values}
        rows |= {f"{one.upper()} {setting}={value}": place for value, place in places.items()}
        first, second = values[low], values[-1]
        name = f"{one.upper()} with {setting}={first} minus with {setting}={second}"
        contrasts.append(Contrast(metric, name, (places[first],), (places[second],)))
    return rows, contrasts


def _activations() -> Answers:
    plain = ("tanh", "hardtanh", "sigmoid_centred", "sigmoid", "relu6", "relu", "leaky_relu")
    changed = {"layer_norm=True": "LayerNorm", "init=unit": "one scale"}
    rows: dict[str, Place] = {}
    contrasts = []
    for one in COMPARED:
        rows |= {f"{one.upper()} {activation}": (SHORT, one, activation) for activation in plain}
        for study, label in changed.items():
            rows |= {
                f"{one.upper()} {name}, {label}": (study, one, name) for name in ("tanh", "sigmoid", "relu")
            }
        alone = (("tanh", "relu"), ("relu6", "relu"), ("sigmoid_centred", "sigmoid"))
        pairs = [(*pair, SHORT, "") for pair in alone]
        pairs += [("tanh", "relu", study, f", both with {label}") for study, label in changed.items()]
        for a, b, study, how in pairs:
            name = f"{one.upper()} with {a} minus with {b}{how}"
            contrasts.append(Contrast("reward", name, ((study, one, a),), ((study, one, b),)))
    return rows, contrasts


def _of_pair(study: str, how: str, metrics: Sequence[str], labels: Mapping[str, str]) -> Answers:
    """A row for each algorithm, activation of the pair and study; a study against `LONG`."""
    rows = {
        f"{one.upper()} {activation}, {label}": (which, one, activation)
        for one, activation in itertools.product(COMPARED, PAIR)
        for which, label in labels.items()
    }
    contrasts = []
    for metric, one in itertools.product(metrics, COMPARED):
        first, second = (tuple((which, one, activation) for activation in PAIR) for which in (study, LONG))
        contrasts.append(Contrast(metric, f"{one.upper()} {how}", first, second))
    return rows, contrasts


def _question(name: str, text: str, metrics: tuple[str, ...], *answers: Answers) -> Question:
    rows = {label: place for of, _ in answers for label, place in of.items()}
    return Question(name, text, metrics, rows, [one for _, contrasts in answers for one in contrasts])


CURED = ("full_stops", "turns", "reversals")
QUESTIONS = (
    _question("activations", "Is it boundedness, centring or scale?", ("reward",), _activations()),
    _question(
        "caution",
        "Do gradual updates make PPO cautious?",
        ("clearance", "reward"),
        _sweep("clearance", "clip_epsilon", ("0.05", "0.1", "0.2", "0.4", "None"), "0.2", PPO),
        _sweep("clearance", "epochs", ("1", "3", "10", "20"), "10", PPO),
    ),
    _question(
        "horizon",
        "Do immediate rewards make DQN take corridors?",
        ("corridor", "reward"),
        _sweep("corridor", "gamma", ("0.9", "0.95", "0.99", "0.999"), "0.99", DQN, PPO),
    ),
    _question(
        "exploration",
        "Does exploration keep them apart?",
        ("reward", "clearance"),
        _sweep("reward", "epsilon_end", ("0.0", "0.01", "0.05", "0.2"), "0.05", DQN),
        _sweep("reward", "entropy_coeff", ("0.0", "0.001", "0.01", "0.03"), "0.0", PPO, low=1),
    ),
    _question(
        "rewards",
        "What do the penalties cure?",
        CURED,
        _of_pair(
            "reward=initial",
            "under the first reward minus under eq. (14)",
            CURED,
            {"reward=initial": "first reward", "reward=additive": "added penalties", LONG: "eq. (14)"},
        ),
    ),
    _question(
        "memory",
        "Does remembering help?",
        ("reward",),
        _of_pair(
            "stack=4",
            "with the last four observations minus with one",
            ("reward",),
            {LONG: "one", "stack=4": "the last four"},
        ),
    ),
)


@columns("question", "row", "metric", *NUMBERS)
def table(evidence: Evidence) -> Rows:
    """All that is drawn and said.

    Rows without a seed are left out, and so are questions without a contrast.
    """

    def of(places: Sequence[Place], metric: str) -> list[stats.Array]:
        return [evidence(which, activation, metric, study=study) for study, which, activation in places]

    for one in QUESTIONS:
        answers = [
            [one.name, name, metric, *stats.difference(of(first, metric), of(second, metric))]
            for metric, name, first, second in one.contrasts
        ]
        drawn = [
            [one.name, label, metric, *stats.difference(of([place], metric))]
            for (label, place), metric in itertools.product(one.rows.items(), one.metrics)
        ]
        if any(answer[-1] for answer in answers):
            yield from (row for row in (*drawn, *answers) if row[-1])
