"""What a study tunes, as its file says it: trials, ranges, and the space of each algorithm; and what was
tried.

    tune:
      trials: 40                                    # of each algorithm, the first with the default settings
      at_once: 4                                    # of each algorithm in a round
      settings: {n_seeds: 2, evaluate: {...}}       # of every trial; its value is the mean sampled reward
      ranges: {rate: {low: 1.0e-5, high: 1.0e-2, log: true}, width: [32, 64]}
      space: {ppo: {lr: rate, hidden: width}}       # setting: range; of `hidden` the width of each layer

`uavnav.studies.tuning` carries it out. Nothing here needs Optuna.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from uavnav import studies
from uavnav.algorithms import ALGORITHMS
from uavnav.errors import ConfigError, unknown, unknown_key
from uavnav.runs.trials import COLUMNS, TABLE, TRIALS, TUNED, TUNING, best, read, winner
from uavnav.studies import Configuration, Study

KEYS = {"trials": int, "at_once": int, "settings": dict, "ranges": dict, "space": dict}

MOST_VALUES = 1_000  # of a range that is a list
Settings = dict[str, Any]


class Plan(NamedTuple):
    """What is searched, and where."""

    study: Study
    out: Path
    said: Mapping[str, Any]  # the file's `tune`
    trials: int

    @property
    def folder(self) -> Path:
        return self.out / TUNING

    @property
    def algorithms(self) -> list[str]:
        """Those that the study has configurations of."""
        there = {name for one in self.study.configurations for name in studies.algorithms(one)}
        return [name for name in self.said["space"] if name in there]

    def range(self, algorithm: str, setting: str) -> Any:
        """Of a setting: a list of values, or `low`, `high` and perhaps `log`."""
        return self.said["ranges"][self.said["space"][algorithm][setting]]

    def defaults(self, algorithm: str) -> Settings:
        """What the searched settings are in the preset `vectorised`."""
        usual = ALGORITHMS[algorithm].presets["vectorised"]
        found: Settings = {name: getattr(usual, name, None) for name in self.said["space"][algorithm]}
        if found.get("hidden"):  # all layers have the same width
            found["hidden"] = found["hidden"][0]
        return found

    def configuration(
        self, algorithm: str, settings: Mapping[str, Any], folder: str, usual: Mapping[str, Any]
    ) -> Configuration:
        """A configuration with some settings of the search space."""
        own = {name: [value] * 2 if name == "hidden" else value for name, value in settings.items()}
        entry = {"algorithm": algorithm, "folder": f"{TUNING}/{folder}", **own}
        study = self.study._replace(settings=usual, configurations=[entry])
        found = studies.configurations(study, self.out)
        if len(found) != 1:
            raise ConfigError(
                f"{algorithm}: a trial is one configuration, not {len(found)}; give one value of each setting"
            )
        return found[0]

    def trial(self, algorithm: str, number: int, settings: Mapping[str, Any]) -> Configuration:
        return self.configuration(algorithm, settings, f"{TRIALS}/{number:03}", self.said["settings"])

    def winner(self, algorithm: str) -> Configuration | None:
        """The best trial's settings, trained as the others; None without a trial that finished.

        Its folder has the trial's number, so that another winner after more trials is a run of its own.
        """
        if (found := best(trials(self), algorithm)) is None:
            return None
        return self.configuration(
            algorithm, json.loads(found["settings"]), winner(found["trial"]), self.study.settings
        )


def plan(study: Study, out: Path, trials: int | None = None) -> Plan | None:
    """What a study's file says of tuning, another number of trials where given; None where it tunes nothing.

    Raises a ConfigError, also where trials share seeds with the configurations that are compared in the end.
    """
    if (said := study.tune) is None:
        return None
    try:
        check_keys(said, KEYS, "tuning")
        found = Plan(study, out, said, trials or said["trials"])
        if found.trials * len(found.said["space"]) > studies.MOST_CONFIGURATIONS:
            raise ConfigError(f"trials={found.trials}; give at most {studies.MOST_CONFIGURATIONS:,} in all")
        studies.check_settings("settings", said["settings"])
        for algorithm in dict.fromkeys(
            name for one in study.configurations for name in studies.algorithms(one)
        ):
            if algorithm not in said["space"]:
                raise unknown("algorithm", algorithm, said["space"])
        for algorithm in said["space"]:
            if algorithm not in ALGORITHMS:
                raise unknown("algorithm", algorithm, ALGORITHMS)
            _check(found, algorithm)
        _check_seeds(found)
    except ConfigError as error:
        raise ConfigError(f"study {study.name}: tune: {error}") from error
    return found


def check_keys(said: Mapping[str, Any], kinds: Mapping[str, type], example: str) -> None:
    """Raise a ConfigError unless a part of a study's file has just these keys, of their kinds."""
    for key in said:
        if key not in kinds:
            raise unknown_key(str(key), kinds)
    for key, kind in kinds.items():
        if type(said.get(key)) is not kind or not said[key] or (kind is int and said[key] < 1):
            raise ConfigError(f"{key}={said.get(key)}; give it as uavnav/studies/{example}.yaml does")


def _check(found: Plan, algorithm: str) -> None:
    space = found.said["space"][algorithm]
    if not isinstance(space, dict) or not space:
        raise ConfigError(
            f"space: {algorithm}={space}; give settings with the names of their ranges, as lr: rate"
        )
    for setting in space:
        if not isinstance(setting, str) or setting in studies.OF_CONFIGURATIONS:
            raise unknown_key(str(setting), ALGORITHMS[algorithm].config.names())
    for setting, name in space.items():
        if not isinstance(name, str) or name not in found.said["ranges"]:
            raise unknown("range", name, found.said["ranges"])
        values = found.range(algorithm, setting)
        bounds = isinstance(values, dict) and {"low", "high"} <= values.keys() <= {"low", "high", "log"}
        if not bounds and (not isinstance(values, list) or not 2 <= len(values) <= MOST_VALUES):
            raise ConfigError(
                f"{name}={values}; give a list of values, or low and high, and log: true if you like"
            )
        if bounds and not _in_order(**values):
            raise ConfigError(
                f"{name}={values}; give numbers, low below high, and low above 0 with log: true"
            )
        for value in [values["low"], values["high"]] if bounds else values:
            if not found.trial(algorithm, 0, {setting: value}).episodes:
                raise ConfigError("settings: evaluate=false; a trial is judged by its episodes, leave it out")
        usual = found.defaults(algorithm)[setting]
        number = type(usual) in (int, float)
        if not (number and values["low"] <= usual <= values["high"] if bounds else usual in values):
            raise ConfigError(f"{name}={values}; the default of {algorithm}, {setting}={usual}, is not in it")


def _in_order(low: Any, high: Any, log: Any = False) -> bool:
    numbers = all(type(end) in (int, float) for end in (low, high)) and type(log) is bool
    return numbers and low < high and (not log or low > 0)


def _check_seeds(found: Plan) -> None:
    """A winner is judged on seeds that did not choose it."""
    compared = studies.configurations(found.study, found.out)
    for algorithm in found.algorithms:
        seen = {*found.trial(algorithm, 0, {}).config.seeds}
        own = [one for one in compared if one.config.algorithm == algorithm]
        for configuration in (found.configuration(algorithm, {}, TUNED, found.study.settings), *own):
            if shared := seen.intersection(configuration.config.seeds):
                raise ConfigError(
                    f"{algorithm}: seed={min(shared)} is of trials and of what they are compared in; "
                    "give fewer seeds, or another seed in settings"
                )


def trials(found: Plan) -> pd.DataFrame:
    """The trials that were told so far: columns algorithm, trial, state, value, settings (JSON)."""
    return read(found.folder / TABLE, COLUMNS)


def winners(found: Plan) -> list[Configuration]:
    """The configurations that train the best trial's settings of each algorithm that has a finished one."""
    return [one for one in map(found.winner, found.algorithms) if one is not None]


def planned(found: Plan) -> list[tuple[Configuration, str | None]]:
    """All configurations of a tuning besides the study's own, a trial's with its state."""
    there = trials(found).set_index(["algorithm", "trial"])["state"].to_dict()
    wanted = [(name, number) for name in found.algorithms for number in range(found.trials)]
    own = [(found.trial(*key, found.defaults(key[0])), there.get(key)) for key in wanted]
    for name in found.algorithms:
        one = found.winner(name) or found.configuration(name, {}, TUNED, found.study.settings)
        own.append((one, None))
    return own
