"""A study that tunes each algorithm with the same budget: what it has left, default against tuned.

It is read from its folder, beside the other studies (`uavnav.studies.tuning`): its configurations are in no
other table.
Letters: S seeds of a configuration.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from uavnav import stats
from uavnav.report import frames
from uavnav.report.configurations import collect, one_line
from uavnav.report.studies import Configurations
from uavnav.runs import trials
from uavnav.runs.definitions import SAMPLED
from uavnav.runs.tables import RunError
from uavnav.runs.trials import COLUMNS, DEFAULT, DIFFERENCE, IMPORTANCE, OF_IMPORTANCE, TABLE, TUNED

Table = pd.DataFrame


def read(
    of: Sequence[Path], baselines: Mapping[str, Table]
) -> tuple[dict[str, Table], Configurations, list[str]]:
    """The tables of the first study that tuned in some folders, by name, the winners' configurations, and a
    line for what is of no use.

    tuning: columns algorithm, settings (default, tuned, their difference), value, low, high, n, and the gap
    to the scripted policy; tuning_pairs: differences of two algorithms; tuning_trials: what was tried, with
    the `best` so far; tuning_importance: shares of settings.
    """
    found = trials.folders(of)
    if not found:
        return {}, {}, []
    folder, *others = found
    left_out = [f"{other}: tuned too; the report shows {folder}" for other in others]
    try:
        tried = trials.read(folder / TABLE, COLUMNS)
        importance = trials.read(folder / IMPORTANCE, OF_IMPORTANCE)
        tried = tried.assign(best=so_far(tried))
        algorithms = list(dict.fromkeys(tried["algorithm"]))
        won = {name: row["trial"] for name in algorithms if (row := trials.best(tried, name))}
    except RunError as error:
        return {}, {}, [str(error), *left_out]
    configurations: dict[str, Configurations] = {DEFAULT: {}, TUNED: {}}
    places = [(DEFAULT, folder / DEFAULT)]
    places += [(TUNED, folder / trials.winner(trial) / name) for name, trial in won.items()]
    for which, place in places:
        own, lines = _configurations(place)
        configurations[which] |= own
        left_out += lines
    compared = _compared(configurations, baselines, algorithms)
    tables = {"tuning": compared, "tuning_pairs": _pairs(configurations, algorithms)}
    tables |= {"tuning_trials": tried, "tuning_importance": importance}
    return tables, configurations[TUNED], left_out


def so_far(trials: Table) -> pd.Series[float]:
    """The best value of an algorithm's trials until each; a trial that diverged changes nothing."""
    of_each = trials["algorithm"]
    best: pd.Series[float] = trials.groupby(of_each)["value"].cummax().groupby(of_each).ffill()
    return best


def _configurations(folder: Path) -> tuple[Configurations, list[str]]:
    if not folder.is_dir():
        return {}, []
    try:
        found, left_out = collect([folder])
    except RunError as error:
        return {}, [one_line(error)]
    return {(one.algorithm, one.activation): one for one in found}, left_out


def _compared(
    configurations: Mapping[str, Configurations], baselines: Mapping[str, Table], algorithms: Sequence[str]
) -> Table:
    gaps = {which: frames.gaps(found, baselines) for which, found in configurations.items()}
    rows = []
    for algorithm in algorithms:
        seeds: dict[str, list[stats.Array]] = {}
        for which, found in configurations.items():
            mine = [(key, one) for key, one in found.items() if key[0] == algorithm]
            seeds[which] = [
                one for _, configuration in mine if len(one := frames.of_seeds(configuration, SAMPLED))
            ]
            gap = gaps[which].query("mode == 'sampled' and algorithm == @algorithm")
            own = gap[["gap", "gap_low", "gap_high"]].to_numpy()[0] if len(gap) else [np.nan] * 3
            if seeds[which]:
                rows.append([algorithm, which, *stats.difference(seeds[which], []), *own])
        if all(seeds.values()):
            rows.append(
                [algorithm, DIFFERENCE, *stats.difference(seeds[TUNED], seeds[DEFAULT]), *[np.nan] * 3]
            )
    columns = ["algorithm", "settings", "value", "low", "high", "n", "gap", "gap_low", "gap_high"]
    return pd.DataFrame(rows, columns=columns)


def _pairs(configurations: Mapping[str, Configurations], algorithms: Sequence[str]) -> Table:
    rows = []
    for which, found in configurations.items():
        of = {
            key[0]: [one]
            for key, configuration in found.items()
            if len(one := frames.of_seeds(configuration, SAMPLED))
        }
        for first, second in itertools.combinations(
            [algorithm for algorithm in algorithms if algorithm in of], 2
        ):
            rows.append([f"{first} − {second}", which, *stats.difference(of[first], of[second])])
    return pd.DataFrame(rows, columns=["pair", "settings", "value", "low", "high", "n"])
