"""A study that tunes each algorithm with the same budget: what it has left, default against tuned.

Its configurations are in no other table. Letters: S seeds of a configuration.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from uavnav import stats
from uavnav.report import frames
from uavnav.report.configurations import collect
from uavnav.report.studies import Configurations
from uavnav.runs import trials
from uavnav.runs.definitions import SAMPLED
from uavnav.runs.tables import RunError
from uavnav.runs.trials import COLUMNS, DEFAULT, DIFFERENCE, IMPORTANCE, OF_IMPORTANCE, TABLE, TUNED

ENDS = ["gap", "gap_low", "gap_high"]


def read(
    of: Sequence[Path], baselines: Mapping[str, pd.DataFrame]
) -> tuple[dict[str, pd.DataFrame], Configurations, list[str]]:
    """The tables of the first study that tuned, the winners' configurations, and lines for the unread.

    tuning: default, tuned and their difference, and the gap to the scripted policy; tuning_pairs: differences
    of two algorithms; tuning_trials: what was tried; tuning_importance: shares of settings.
    """
    found = trials.folders(of)
    if not found:
        return {}, {}, []
    folder, *others = found
    left_out = [f"{other}: tuned too; the report shows {folder}" for other in others]
    try:
        tried = trials.read(folder / TABLE, COLUMNS)
        importance = trials.read(folder / IMPORTANCE, OF_IMPORTANCE)
        algorithms = list(dict.fromkeys(tried["algorithm"]))
        won = {name: row["trial"] for name in algorithms if (row := trials.best(tried, name))}
    except RunError as error:
        return {}, {}, [str(error), *left_out]
    configurations: dict[str, Configurations] = {DEFAULT: {}, TUNED: {}}
    places = [(DEFAULT, folder / DEFAULT)]
    places += [(TUNED, folder / trials.winner(trial) / name) for name, trial in won.items()]
    for which, place in places:
        try:
            own, lines = collect([place]) if place.is_dir() else ([], [])
        except RunError as error:
            own, lines = [], [str(error)]
        configurations[which] |= {(one.algorithm, one.activation): one for one in own}
        left_out += lines
    tables = {
        "tuning": _compared(configurations, baselines, algorithms),
        "tuning_pairs": _pairs(configurations, algorithms),
        "tuning_trials": tried,
        "tuning_importance": importance,
    }
    return tables, configurations[TUNED], left_out


def _seeds(found: Configurations, algorithm: str) -> list[stats.Array]:
    """The rewards of an algorithm's configurations that were evaluated: [S] each."""
    own = [frames.of_seeds(one, SAMPLED) for key, one in found.items() if key[0] == algorithm]
    return [one for one in own if len(one)]


@frames.columns("algorithm", "settings", *frames.NUMBERS, *ENDS)
def _compared(
    configurations: Mapping[str, Configurations],
    baselines: Mapping[str, pd.DataFrame],
    algorithms: Sequence[str],
) -> frames.Rows:
    gaps = {which: frames.gaps(found, baselines) for which, found in configurations.items()}
    for algorithm in algorithms:
        seeds = {which: _seeds(found, algorithm) for which, found in configurations.items()}
        for which, own in seeds.items():
            gap = gaps[which].query("mode == 'sampled' and algorithm == @algorithm")[ENDS].to_numpy()
            if own:
                yield [algorithm, which, *stats.difference(own), *(*gap, [np.nan] * 3)[0]]
        if all(seeds.values()):
            difference = stats.difference(seeds[TUNED], seeds[DEFAULT])
            yield [algorithm, DIFFERENCE, *difference, *[np.nan] * 3]


@frames.columns("pair", "settings", *frames.NUMBERS)
def _pairs(configurations: Mapping[str, Configurations], algorithms: Sequence[str]) -> frames.Rows:
    for which, found in configurations.items():
        of = {one: own[-1:] for one in algorithms if (own := _seeds(found, one))}
        for first, second in itertools.combinations(of, 2):
            yield [f"{first} − {second}", which, *stats.difference(of[first], of[second])]
