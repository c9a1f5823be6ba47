"""A study that draws settings: many draws are screened, and the study's configurations are trained in those
nearest to the paper's tables (approximate Bayesian computation by rejection).

    draw:
      draws: 40                         # the first has the first value of each choice, the others any, all
                                        # values as probable
      nearest: 5                        # of them, in which the configurations are trained
      screen: {algorithm: dqn, ...}     # what is trained in each draw
      choices: {init: [null, orthogonal], ...}  # null: as it is; what an algorithm does not have is left out

`uavnav.runs.draws` says what is near.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from uavnav import studies
from uavnav.algorithms import ALGORITHMS
from uavnav.errors import ConfigError, choose_from, unknown, unknown_key
from uavnav.runs import draws, paper
from uavnav.runs.tables import RunError
from uavnav.studies import Configuration, Study
from uavnav.studies.run import trained
from uavnav.studies.search import check_keys

KEYS = {"draws": int, "nearest": int, "screen": dict, "choices": dict}


class Plan(NamedTuple):
    """What is drawn, and where it is trained."""

    study: Study
    out: Path
    said: Mapping[str, Any]  # the file's `draw`
    draws: int

    def drawn(self) -> list[dict[str, Any]]:
        """The settings of each draw; the same for the same choices, and as many more for more draws."""
        rng, choices = np.random.default_rng(0), self.said["choices"]
        first = {name: values[0] for name, values in choices.items()}
        others = [
            {name: values[rng.integers(len(values))] for name, values in choices.items()}
            for _ in range(self.draws - 1)
        ]
        return [first, *others]

    def screened(self) -> list[Configuration]:
        return [
            one
            for number, settings in enumerate(self.drawn())
            for one in self._in_draw(self.said["screen"], draws.SCREEN, number, settings, {})
        ]

    def nearest(self) -> list[Configuration]:
        """The study's configurations in the nearest draws; none until all draws are trained."""
        if not all(trained(one) for one in self.screened()):
            return []
        folder = self.out / self.study.name / draws.SCREEN
        runs, damaged = draws.runs_of(folder)
        if damaged:
            raise RunError(damaged[0])
        found = draws.distances(draws.by_draw(runs))
        drawn = self.drawn()
        numbers = [number for number in found.index if number < len(drawn)]
        return [
            one
            for number in numbers[: self.said["nearest"]]
            for entry in self.study.configurations
            for one in self._in_draw(entry, draws.NEAREST, number, drawn[number], self.study.settings)
        ]

    def _in_draw(
        self,
        entry: Mapping[str, Any],
        folder: str,
        number: int,
        drawn: Mapping[str, Any],
        usual: Mapping[str, Any],
    ) -> list[Configuration]:
        """The configurations of an entry of the study's file with the settings of a draw."""
        entries = []
        for algorithm in studies.algorithms(entry):
            names = ALGORITHMS[algorithm].config.names()
            own = {name: value for name, value in drawn.items() if name in names and value is not None}
            place = {"folder": f"{self.study.name}/{folder}/{number:02}", "algorithm": algorithm}
            entries.append({**entry, **own, **place})
        study = self.study._replace(settings=usual, configurations=entries)
        return studies.configurations(study, self.out)


def plan(study: Study, out: Path, n: int | None = None) -> Plan | None:
    """What a study's file says of draws, another number of them where given; None where it draws nothing.

    Raises:
        ConfigError: a key or a setting is not right, the paper has no row of what is screened, or draws share
            seeds with what they choose.
    """
    if (said := study.draw) is None:
        return None
    try:
        _check(study, said)
    except ConfigError as error:
        raise ConfigError(f"study {study.name}: draw: {error}") from error
    found = Plan(study, out, said, n or said["draws"])
    judged = [seed for one in studies.configurations(study, out) for seed in one.config.seeds]
    screened = [one.config for one in found.screened()]
    for one in screened:
        if (one.algorithm, one.activation) not in paper.TABLES:
            row = f"study {study.name}: draw: screen: {one.algorithm} {one.activation}"
            known = choose_from(one.activation, paper.ACTIVATIONS)
            raise ConfigError(f"{row}: the paper has no such row; {known}")
    if shared := {seed for one in screened for seed in one.seeds}.intersection(judged):
        seed = f"study {study.name}: draw: seed={min(shared)}"
        raise ConfigError(f"{seed} is of draws and of what they choose; give fewer seeds")
    return found


def _check(study: Study, said: Mapping[str, Any]) -> None:
    check_keys(said, KEYS, "ambiguities")
    studies.check_settings("screen", said["screen"])
    known: set[str] = set()
    for entry in ({"algorithm": ""} | said["screen"], *study.configurations):
        for name in studies.algorithms(entry):
            if name not in ALGORITHMS:
                raise unknown("algorithm", name, ALGORITHMS)
            known |= {*ALGORITHMS[name].config.names()}
    for name, values in said["choices"].items():
        if name not in known:
            raise unknown_key(str(name), known)
        if not isinstance(values, list) or not values:
            raise ConfigError(f"{name}={values}; give a list of values")
