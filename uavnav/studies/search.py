"""What a study tunes, as its file says it: trials, ranges, and the space of each algorithm; and what was tried.

    tune:
      trials: 40                                    # of each algorithm, the first with the default settings
      at_once: 4                                    # of each algorithm in a round
      settings: {n_seeds: 2, evaluate: {...}}       # of every trial; the objective is the mean reward, sampled
      ranges: {rate: {low: 1.0e-5, high: 1.0e-2, log: true}, width: [32, 64]}
      space: {ppo: {lr: rate, hidden: width}}       # setting: range; `hidden` is the width of each of its layers

`uavnav.studies.tuning` carries it out. Nothing here needs Optuna.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from uavnav import studies
from uavnav.algorithms import ALGORITHMS
from uavnav.choices import ConfigError, unknown, unknown_key
from uavnav.runs.trials import COLUMNS, TABLE, TRIALS, TUNED, TUNING, best, read, winner
from uavnav.studies import Cell, Study

KEYS = {"trials": int, "at_once": int, "settings": dict, "ranges": dict, "space": dict}

Settings = dict[str, Any]


class Plan(NamedTuple):
    """What is searched, and where."""

    study: Study
    out: Path
    trials: int
    seeds: int | None  # instead of those of the file
    frames: int | None

    @property
    def folder(self) -> Path:
        return self.out / TUNING

    @property
    def said(self) -> Mapping[str, Any]:
        """The file's `tune`."""
        return self.study.tune or {}

    @property
    def algorithms(self) -> list[str]:
        """Those that the study has cells of."""
        there = {name for cell in self.study.cells for name in studies.algorithms(cell)}
        return [name for name in self.said["space"] if name in there]

    def range(self, algorithm: str, setting: str) -> Any:
        """Of a setting: a list of values, or `low`, `high` and perhaps `log`."""
        return self.said["ranges"][self.said["space"][algorithm][setting]]

    def defaults(self, algorithm: str) -> Settings:
        """What the searched settings are in the preset `paper`."""
        usual = importlib.import_module(ALGORITHMS[algorithm].module).PRESETS["paper"]
        return {name: _short(name, getattr(usual, name, None)) for name in self.said["space"][algorithm]}

    def cell(self, algorithm: str, settings: Mapping[str, Any], folder: str, usual: Mapping[str, Any]) -> Cell:
        """A cell with some settings of the search space."""
        own = {name: [value] * 2 if name == "hidden" else value for name, value in settings.items()}
        entry = {"algorithm": algorithm, "folder": f"{TUNING}/{folder}", **own}
        (found,) = studies.cells(self.study._replace(settings=usual, cells=[entry]), self.out, self.seeds, self.frames)
        return found

    def trial(self, algorithm: str, number: int, settings: Mapping[str, Any]) -> Cell:
        return self.cell(algorithm, settings, f"{TRIALS}/{number:03}", self.said["settings"])

    def winner(self, algorithm: str, trials: pd.DataFrame) -> Cell | None:
        """The best trial's settings, trained as the study's other cells are; None where no trial has finished.

        Its folder has the trial's number, so that another winner after more trials is a run of its own.
        """
        if (found := best(trials, algorithm)) is None:
            return None
        return self.cell(algorithm, json.loads(found["settings"]), winner(found["trial"]), self.study.settings)


def _short(name: str, value: Any) -> Any:
    """The width alone of hidden layers that have the same."""
    return value[0] if name == "hidden" and value else value


def plan(
    study: Study, out: Path, trials: int | None = None, seeds: int | None = None, frames: int | None = None
) -> Plan:
    """What a study's file says of tuning, and other numbers where they are given.

    Raises:
        ConfigError: a key, a range or a setting is not right, or a default lies outside of its range.
    """
    said = study.tune or {}
    try:
        for key in said:
            if key not in KEYS:
                raise unknown_key(str(key), KEYS)
        for key, kind in KEYS.items():
            if type(said.get(key)) is not kind or not said[key]:
                raise ConfigError(f"{key}={said.get(key)}; give it as uavnav/studies/tuning.yaml does")
        found = Plan(study, out, trials or said["trials"], seeds, frames)
        for algorithm in {name for cell in study.cells for name in studies.algorithms(cell)} | {*said["space"]}:
            if algorithm not in said["space"]:
                raise unknown("algorithm", algorithm, said["space"])
        for algorithm in found.algorithms:
            _check(found, algorithm)
    except ConfigError as error:
        raise ConfigError(f"study {study.name}: tune: {error}") from error
    return found


def _check(found: Plan, algorithm: str) -> None:
    usual = found.defaults(algorithm)
    for setting, name in found.said["space"][algorithm].items():
        if name not in found.said["ranges"]:
            raise unknown("range", name, found.said["ranges"])
        values = found.range(algorithm, setting)
        bounds = isinstance(values, dict) and {"low", "high"} <= values.keys() <= {"low", "high", "log"}
        if not bounds and (not isinstance(values, list) or len(values) < 2):
            raise ConfigError(f"{name}={values}; give a list of values, or low and high, and log: true if you like")
        for value in [values["low"], values["high"]] if bounds else values:
            found.trial(algorithm, 0, {setting: value})
        if not (values["low"] <= usual[setting] <= values["high"] if bounds else usual[setting] in values):
            raise ConfigError(f"{name}={values}; the default of {algorithm}, {setting}={usual[setting]}, is not in it")


def trials(found: Plan) -> pd.DataFrame:
    """The trials that were told so far: columns algorithm, trial, state, value, settings (JSON)."""
    return read(found.folder / TABLE, COLUMNS)


def winners(found: Plan) -> list[Cell]:
    """The cells that train the best trial's settings of each algorithm that has a finished one."""
    cells = [found.winner(name, trials(found)) for name in found.algorithms]
    return [cell for cell in cells if cell is not None]


def planned(found: Plan) -> list[tuple[Cell, str | None]]:
    """All cells of a tuning beside the study's own, a told trial's with its state; settings not known are defaults."""
    there = trials(found).set_index(["algorithm", "trial"])["state"].to_dict()
    wanted = [(name, number) for name in found.algorithms for number in range(found.trials)]
    own = [(found.trial(*key, found.defaults(key[0])), there.get(key)) for key in wanted]
    cells = {name: found.winner(name, trials(found)) for name in found.algorithms}
    usual = found.study.settings
    return own + [(cell or found.cell(name, {}, TUNED, usual), None) for name, cell in cells.items()]


def space(study: Study) -> list[list[str]]:
    """The search space as a table, its header first: a row a range, with the settings that it is for."""
    rows, said = [["range", "settings", "values"]], study.tune or {}
    for name, values in said["ranges"].items():
        of: dict[str, list[str]] = {}
        for algorithm, own in said["space"].items():
            for setting in (setting for setting, its in own.items() if its == name):
                of.setdefault(setting, []).append(algorithm.upper())
        settings = "; ".join(f"`{setting}` of {', '.join(found)}" for setting, found in of.items())
        rows.append([name, settings, _shown(values)])
    return rows


def _shown(values: Any) -> str:
    if isinstance(values, list):
        return ", ".join(f"{value:g}" for value in values)
    return f"{values['low']:g} to {values['high']:g}{', by its logarithm' if values.get('log') else ''}"
