"""Which cells belong to which part of a report, and what each reading of their rows says, as one number a seed.

A run's meta.json names its study, and `PLACES` says what each study answers. The study `vectorised` has the paper's
reward and its million frames. The *main* study answers for the paper: it is the same in one environment a seed, as
Stable-Baselines3 runs by default, once all the paper's cells have flown it, or else that in many. Runs of no study that
the report knows are compared with each other: those of an algorithm's most frequent settings.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from uavnav.report.cells import UNSAID, Cell, Key, flat, order, read_as, show, windowed
from uavnav.report.claims import PRIMARY, SURGE
from uavnav.runs import POLICY, Run, paper
from uavnav.runs.readings import ALL, PER_FRAME
from uavnav.stats import Array

Cells = dict[Key, Cell]

PLACES = {
    "paper": "main",
    "vectorised": "vectorised",
    "algorithms": "vectorised",
    "wide": "baseline",
    "initial": "initial",
    "sensitivity": "switches",
    "why": "why",
    "tuned": "tuned",
}
"""What a study of the package answers: a field of `Studies`."""
FOLLOWING = {"preset", "frames", "total_frames", "exploration_fraction", "bank", "compile"}
"""Settings that a shorter study or another bank changes along with what it is about."""
TUNED = "fast"
"""The preset of the study `tuned`."""
AFTER = 100_000
"""Frames at the end of training, which tell what is left of a surge."""


class Studies(NamedTuple):
    """All cells of a report."""

    main: Cells  # the paper's comparison, and further activations at the same settings
    vectorised: Cells  # the same in more environments a seed, where the main study is in one; else none
    baseline: Cells  # in many environments for fewer frames, what the next two are held against
    initial: Cells  # under the first reward
    switches: dict[str, Cells]  # one setting that the paper leaves open otherwise, by `name=value`
    why: dict[str, Cells]  # one setting otherwise that may tell why cells differ (`whys`), by `name=value`
    tuned: Cells  # with the preset `fast`
    others: list[Cell]

    def of(self, name: str) -> Cells:
        """One of those that claims and questions ask, by its name; none where there is no such."""
        many = self.vectorised or self.main
        named = {"main": self.main, "vectorised": many, "baseline": self.baseline, "initial": self.initial}
        return named.get(name) or self.why.get(name, {})


def sort(cells: Sequence[Cell]) -> Studies:
    """Deal cells out to the studies; where two fit the same place, the later one is among the others."""
    studies = Studies({}, {}, {}, {}, {}, {}, {}, [])
    for algorithm in dict.fromkeys(cell.algorithm for cell in cells):
        mine = [cell for cell in cells if cell.algorithm == algorithm]
        usual = _usual(mine)
        for cell in mine:
            place = _place(studies, cell, usual)
            if place is None or (algorithm, cell.activation) in place:
                studies.others.append(cell)
            else:
                place[algorithm, cell.activation] = cell
    missing = studies.vectorised.keys() - studies.main.keys()
    if missing & paper.TABLES.keys():
        studies.others.extend(studies.main.values())
        studies = studies._replace(main=studies.vectorised, vectorised={})
    for cells_of in (*studies[:4], studies.tuned, *studies.switches.values(), *studies.why.values()):
        in_order = sorted(cells_of.items(), key=lambda item: order(item[0]))
        cells_of.clear()
        cells_of.update(in_order)
    return studies


def _usual(cells: Sequence[Cell]) -> Mapping[str, Any]:
    """An algorithm's settings in the study `vectorised`, or else those of most of its cells, then of most seeds."""
    named = [cell for cell in cells if PLACES.get(cell.study) == "vectorised"]
    groups = [[one for one in named or cells if one.settings == cell.settings] for cell in named or cells]
    return max(groups, key=lambda group: (len(group), sum(map(seeds, group)), str(group[0].settings)))[0].settings


def _place(studies: Studies, cell: Cell, usual: Mapping[str, Any]) -> Cells | None:
    place, changed = PLACES.get(cell.study), _changed(cell.settings, usual)
    if place in ("main", "vectorised", "tuned"):
        cells: Cells = getattr(studies, place)
        return cells
    if place is None:
        return studies.vectorised if not changed else None
    named = changed - FOLLOWING
    if not named:
        return studies.baseline
    if place == "initial":
        return studies.initial
    (name, *more) = sorted(named)
    apart: dict[str, Cells] = studies.why if place == "why" else studies.switches
    return None if more else apart.setdefault(f"{name}={show(cell.settings.get(name))}", {})


def _changed(own: Mapping[str, Any], usual: Mapping[str, Any]) -> set[str]:
    return {key for key in {*usual, *own} if usual.get(key) != own.get(key)}


def in_none(studies: Studies) -> list[str]:
    """One line for each run that is in no study, with how its settings differ from the main study's."""
    lines, usual = [], studies.main | studies.vectorised
    for cell in studies.others:
        nearest = next(one.settings for key, one in usual.items() if key[0] == cell.algorithm)
        changes = sorted(_changed(cell.settings, nearest))
        how = ", ".join(f"{key}={show(cell.settings.get(key)):.20}" for key in changes)
        lines += [f"{run.path}: in no study; it differs from the main one in {how}" for run in cell.runs]
    return lines


def paper_cells(cells: Cells) -> Cells:
    """Those of the paper's activations, of whatever algorithm."""
    return {key: cell for key, cell in cells.items() if key[1] in paper.ACTIVATIONS}


def elsewhere(cells: Sequence[Cell]) -> list[Cell]:
    """Those that have their policies, and another world than the paper's, faults, or a stack of observations."""
    other = [
        cell for cell in cells if any(cell.settings.get(key, value) != value for key, value in flat(UNSAID).items())
    ]
    return [cell for cell in other if any((run.path / POLICY).exists() for run in cell.runs)]


def wide(studies: Studies) -> Cells:
    """All cells of the first study with activations beyond the paper's: the main one, `vectorised`, or the baseline."""
    return next((cells for cells in studies[:3] if len(paper_cells(cells)) < len(cells)), {})


def further(studies: Studies) -> Cells:
    """The cells in many environments of algorithms beyond the paper's."""
    return {key: cell for key, cell in studies.of("vectorised").items() if key[0] not in paper.TABLE_OF}


def seeds(cell: Cell) -> int:
    """How many seeds a cell has."""
    return sum(len(run.seeds) for run in cell.runs)


@dataclass(eq=False)
class Rows:
    """Each metric of the studies' cells in one reading: an `Evidence`.

    flights: rows of `seed`, `mode` and measures by study, algorithm and activation; by_layout: the same with `layout`
    instead of `seed`.
    """

    studies: Studies
    reading: str  # one of `readings.READINGS`
    flights: Mapping[tuple[str, str, str], pd.DataFrame]
    by_layout: Mapping[tuple[str, str, str], pd.DataFrame] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._table = functools.cache(self._per_seed)

    def _per_seed(self, study: str, algorithm: str, activation: str) -> pd.DataFrame:
        cell = self.studies.of(study)[algorithm, activation]
        table, frames = read_as(cell, self.reading), cell.settings["frames"]
        if self.reading == PRIMARY and frames >= SURGE[1] + AFTER:
            windows = [(0, SURGE[0]), SURGE, (frames - AFTER, frames)]
            times = [f"reward_{when}" for when in ("before", "surge", "after")]
            table = table.join(windowed(cell, "reward", windows).set_axis(times, axis=1))
        return table

    def __call__(self, algorithm: str, activation: str, metric: str, study: str = "main") -> Array:
        cell = self.studies.of(study).get((algorithm, activation))
        if cell is None:
            return np.empty(0)
        if metric == "hours":
            return hours(cell)
        of_flights = self.by_layout if metric.endswith("_by_layout") else self.flights
        flown = of_flights.get((study, algorithm, activation))
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


def of_paper(algorithm: str, activation: str, metric: str, study: str = "main", reading: str = ALL) -> Array:
    """The paper's printed tables as a reading takes them, and its ten hours: an `Evidence` of one number a cell."""
    if metric == "hours":
        return np.array([paper.HOURS])
    value = paper.printed(algorithm, activation, metric, reading == PER_FRAME) if study == "main" else np.nan
    return np.array([value])[np.isfinite([value])]
