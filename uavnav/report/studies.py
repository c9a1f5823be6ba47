"""Which cells belong to which study, and what each reading of their rows says, as one number a seed.

Studies are told apart by their settings, whatever their folders are called: the *main* study is that with the paper's
reward and its million frames, then with most of its activations, frames and seeds; the others are named by how they
differ from it.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from uavnav.report.cells import Cell, Key, order, readings, show
from uavnav.report.claims import PRIMARY, SURGE
from uavnav.runs import Run, paper
from uavnav.runs.metrics import finished, per_seed
from uavnav.stats import Array

Cells = dict[Key, Cell]

FOLLOWING = {"frames", "total_frames", "exploration_fraction", "bank", "compile"}
"""Settings that a shorter study or another bank changes along with what it is named after."""
TUNED = "fast"
"""The preset of the study `tuned`."""


class Studies(NamedTuple):
    """All cells of a report."""

    main: Cells  # the paper's comparison, and further activations at the same settings
    baseline: Cells  # the same for fewer frames, what the next two are held against
    initial: Cells  # under the first reward
    switches: dict[str, Cells]  # one setting otherwise, by `name=value`
    tuned: Cells  # with the preset `fast`
    others: list[Cell]

    def of(self, name: str) -> Cells:
        """One of the first three by its name."""
        return {"main": self.main, "baseline": self.baseline, "initial": self.initial}[name]


def sort(cells: Sequence[Cell]) -> Studies:
    """Deal cells out to the studies; where two fit the same place, the later one is among the others."""
    studies = Studies({}, {}, {}, {}, {}, [])
    for algorithm in dict.fromkeys(cell.algorithm for cell in cells):
        mine = [cell for cell in cells if cell.algorithm == algorithm]
        usual = _main(mine)
        for cell in mine:
            place = _place(studies, cell, usual)
            if place is None or (algorithm, cell.activation) in place:
                studies.others.append(cell)
            else:
                place[algorithm, cell.activation] = cell
    for cells_of in (studies.main, studies.baseline, studies.initial, studies.tuned, *studies.switches.values()):
        in_order = sorted(cells_of.items(), key=lambda item: order(item[0]))
        cells_of.clear()
        cells_of.update(in_order)
    return studies


def _main(cells: Sequence[Cell]) -> dict[str, Any]:
    """The settings of an algorithm's main study."""
    groups: dict[str, list[Cell]] = {}
    for cell in cells:
        groups.setdefault(str(sorted(cell.settings.items(), key=str)), []).append(cell)

    def rank(group: list[Cell]) -> tuple[bool, bool, int, int, int]:
        own = group[0].settings
        of_paper = sum(cell.activation in paper.ACTIVATIONS for cell in group)
        as_long = own.get("total_frames", own["frames"]) == paper.FRAMES
        return own.get("reward") == "eq14", as_long, of_paper, own["frames"], sum(map(seeds, group))

    return max(groups.values(), key=rank)[0].settings


def _place(studies: Studies, cell: Cell, usual: Mapping[str, Any]) -> Cells | None:
    own = cell.settings
    changed = _changed(own, usual)
    if not changed:
        return studies.main
    named = changed - FOLLOWING
    if own.get("preset") == TUNED != usual.get("preset"):
        return studies.tuned
    if changed <= FOLLOWING - {"bank"} and own["frames"] < usual["frames"]:
        return studies.baseline
    if named == {"reward"} and own["reward"] == "initial":
        return studies.initial
    if len(named) == 1:
        (name,) = named
        return studies.switches.setdefault(f"{name}={show(own.get(name))}", {})
    return None


def _changed(own: Mapping[str, Any], usual: Mapping[str, Any]) -> set[str]:
    return {key for key in {*usual, *own} if usual.get(key) != own.get(key)}


def in_none(studies: Studies) -> list[str]:
    """One line for each run that is in no study, with how its settings differ from the main study's."""
    lines = []
    for cell in studies.others:
        usual = next(one.settings for key, one in studies.main.items() if key[0] == cell.algorithm)
        changes = sorted(_changed(cell.settings, usual))
        how = ", ".join(f"{key}={show(cell.settings.get(key)):.20}" for key in changes)
        lines += [f"{run.path}: in no study; it differs from the main one in {how}" for run in cell.runs]
    return lines


def paper_cells(cells: Cells) -> Cells:
    """Those of the paper's activations, of whatever algorithm."""
    return {key: cell for key, cell in cells.items() if key[1] in paper.ACTIVATIONS}


def wide(studies: Studies) -> Cells:
    """All cells of the study that has activations beyond the paper's: the main one, or else the shorter baseline."""
    return next((cells for cells in (studies.main, studies.baseline) if len(paper_cells(cells)) < len(cells)), {})


def seeds(cell: Cell) -> int:
    """How many seeds a cell has."""
    return sum(len(run.seeds) for run in cell.runs)


@dataclass(eq=False)
class Rows:
    """Each metric of the studies' cells in one reading: an `Evidence`.

    flights: rows of `seed`, `mode` and measures by study, algorithm and activation.
    """

    studies: Studies
    reading: str  # a name that `cells.readings` gives
    flights: Mapping[tuple[str, str, str], pd.DataFrame]
    ratio_of_means: bool = False  # of stops, turns and speed (decision 13)

    def __post_init__(self) -> None:
        self._table = functools.cache(self._per_seed)

    def _per_seed(self, study: str, algorithm: str, activation: str) -> pd.DataFrame:
        cell = self.studies.of(study)[algorithm, activation]
        table = per_seed(readings(cell)[self.reading], self.ratio_of_means)
        if self.reading == PRIMARY:
            ended, (begin, end) = finished(cell.episodes), SURGE
            when = {"before": (0, begin), "surge": (begin, end), "after": (end, np.inf)}
            for name, (low, high) in when.items():
                part = ended[(ended["frame"] > low) & (ended["frame"] <= high)]
                table[f"reward_{name}"] = part.groupby("seed")["reward"].mean()
        return table

    def __call__(self, algorithm: str, activation: str, metric: str, study: str = "main") -> Array:
        cell = self.studies.of(study).get((algorithm, activation))
        if cell is None:
            return np.empty(0)
        if metric == "hours":
            return hours(cell)
        flown = self.flights.get((study, algorithm, activation))
        if flown is not None and metric in flown:
            table = flown[flown["mode"] == ("greedy" if self.reading.startswith("greedy") else "sampled")]
        else:
            table = self._table(study, algorithm, activation)
        return np.asarray(table[metric].dropna(), dtype=np.float64) if metric in table else np.empty(0)


def timed(cell: Cell) -> list[Run]:
    """The runs of a cell whose wall time is known."""
    return [run for run in cell.runs if isinstance(run.meta.get("wall_seconds"), (int, float))]


def hours(cell: Cell) -> Array:
    """Wall time of a million frames of one seed [h], a run: its wall time over its seeds and frames."""
    return np.array([run.meta["wall_seconds"] / 3600 / len(run.seeds) / (run.frames / 1e6) for run in timed(cell)])


def of_paper(algorithm: str, activation: str, metric: str, study: str = "main") -> Array:
    """The paper's printed tables, and its ten hours, as an `Evidence` of one number a cell."""
    if metric == "hours":
        return np.array([paper.HOURS])
    value = paper.printed(algorithm, activation, metric) if study == "main" else np.nan
    return np.array([value])[np.isfinite([value])]
