"""What a study that draws settings leaves for others to read: how far draws are from the paper's tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from uavnav import stats
from uavnav.runs import Run, paper
from uavnav.runs.definitions import as_logged
from uavnav.runs.tables import RunError
from uavnav.stats import Array

SCREEN, NEAREST = "screen", "nearest"
"""Folders of a study: its draws, a number each, and those that are trained further."""
DISTANCE = "distance"  # column of `distances`: joint, of all configurations of a draw
NOTHING = np.empty((0, len(paper.COLUMNS)))
Seeds = Mapping[tuple[str, str], Array]
"""By algorithm and activation: the paper's metrics as Stable-Baselines3 logs them, [S, 6]."""


def logged(run: Run) -> Array:
    """The paper's metrics of each seed that has a log, as Stable-Baselines3 logs them: [S, 6]."""
    table = as_logged(run.algorithm, run.config, run.episodes, run.frames)
    assert table is not None, run.algorithm
    return table[list(paper.COLUMNS)].dropna().to_numpy()


def runs_of(folder: Path) -> tuple[dict[int, list[Run]], list[str]]:
    """The finished runs of each draw, by its number, its folder's name; and a line for each other run."""
    found: dict[int, list[Run]] = {}
    left_out = []
    for path in sorted(folder.glob("*/*/*/config.yaml")):
        if (number := path.parents[2].name).isdecimal():
            try:
                run = Run(path.parent)
                found.setdefault(int(number), []).append(run)
            except RunError as error:
                left_out.append(str(error))
    return found, left_out


def by_draw(runs: Mapping[int, Iterable[Run]]) -> dict[int, Seeds]:
    """What each draw's runs log."""
    return {
        number: {(run.algorithm, run.config["activation"]): logged(run) for run in own}
        for number, own in runs.items()
    }


def distances(draws: Mapping[int, Seeds]) -> pd.DataFrame:
    """How far the paper's printed rows are from the draws, the nearest first: index draw, a column a
    configuration, and `distance`.

    Of a configuration it is Mahalanobis' over the six metrics (`stats.mahalanobis`); seeds of different
    configurations are independent, so that the squares of these add up.
    """
    columns = {}
    for algorithm, activation in dict.fromkeys(key for own in draws.values() for key in own):
        seeds = [own.get((algorithm, activation), NOTHING) for own in draws.values()]
        printed = np.array([*paper.TABLES[algorithm, activation].values()])
        columns[f"{algorithm.upper()} {activation}"] = stats.mahalanobis(seeds, printed)
    table = pd.DataFrame(columns, pd.Index([*draws], name="draw"))
    table[DISTANCE] = np.sqrt((table**2).sum(axis=1, skipna=False))
    return table.sort_values(DISTANCE, kind="stable")
