"""What a report says, before it is a page: studies, verdicts, numbers, figures, replays."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from uavnav import style
from uavnav.evaluation import EMPTY_ARENA
from uavnav.report import behaviour, figures, frames, replays, studies, tables, tuning, whys, worlds
from uavnav.report.cells import Cell, algorithms, collect, one_line, read_as
from uavnav.report.claims import CLAIMS, DISCUSSION, PRIMARY
from uavnav.report.figures import Figure
from uavnav.report.operating import characteristics
from uavnav.report.studies import Rows, Studies
from uavnav.report.verdicts import Finding, audit
from uavnav.report.worlds import Worlds
from uavnav.runs import VALUES, Run, paper
from uavnav.runs.readings import READINGS, SAMPLED
from uavnav.runs.tables import RunError, read_table
from uavnav.tasks import layouts
from uavnav.tasks.world import World
from uavnav.training import machine

Place = tuple[str, str, str]
"""Study, algorithm and activation."""
Flights = dict[Place, pd.DataFrame]
WATCHED = ("main", "baseline", "initial")
"""Studies whose flights are measured."""


@dataclass
class Content:
    """All that a report says."""

    cells: list[Cell]
    studies: Studies
    audits: dict[str, list[Finding]]  # by reading
    tables: dict[str, pd.DataFrame]  # by the name of their CSV
    figures: list[Figure]
    narrow: list[Figure]  # the same, for a phone
    replays: dict[str, Any] | None
    baselines: dict[str, pd.DataFrame]
    first_rule: pd.DataFrame  # its verdicts, as history
    left_out: list[str]
    worlds: Worlds | None  # the study of that name, where there is one

    @property
    def missing(self) -> list[str]:
        """The paper's cells that have no finished run in the main study."""
        return [" ".join(key) for key in paper.TABLES if key not in self.studies.main]

    @property
    def of_the_study(self) -> bool:
        """Whether the main study is the one that answers for the paper, and all of it."""
        named = [studies.PLACES.get(cell.study) == "main" for cell in studies.paper_cells(self.studies.main).values()]
        return not self.missing and all(named)

    @property
    def unasked(self) -> list[int]:
        """The claims of which no run says anything."""
        found = [finding for findings in self.audits.values() for finding in findings]
        return [claim.number for claim in CLAIMS if not any(one.n for one in found if one.claim == claim.number)]

    @property
    def flown(self) -> dict[str, pd.DataFrame]:
        """Each cell's test flights as a row a seed, sampled, by the folder of its first run."""
        read = {str(cell.runs[0].path): read_as(cell, SAMPLED) for cell in self.cells}
        return {name: seeds for name, seeds in read.items() if len(seeds)}

    @functools.cached_property
    def baseline_rows(self) -> list[list[str]]:
        """Scripts and people beside the study's cells, as a table."""
        return tables.baselines(self.baselines, studies.paper_cells(self.studies.main))

    @functools.cached_property
    def paper_tables(self) -> dict[str, list[list[str]]]:
        """The main study as in the paper's tables, by algorithm: the paper's, and whatever else has runs."""
        of_paper = studies.paper_cells(self.studies.main)
        others = algorithms((cell.algorithm, cell.activation) for cell in self.cells)
        return {
            algorithm: tables.table([cell for (which, _), cell in of_paper.items() if which == algorithm], algorithm)
            for algorithm in dict.fromkeys([*paper.TABLE_OF, *others])
        }


def gather(folders: Sequence[Path], fly: Callable[[Sequence[Cell]], dict[str, Any]] = replays.record) -> Content:
    """Read all runs in some folders, let their policies fly a little, and work out what the report says.

    fly: what gives the replays of some cells.

    Raises:
        RunError: a folder is missing or holds no run, or no run can be used.
    """
    cells, left_out = collect(folders)
    sorted_cells = studies.sort(cells)
    left_out += studies.in_none(sorted_cells)
    of_paper = studies.paper_cells(sorted_cells.main)
    with machine.use_threads(1), ThreadPoolExecutor(1) as beside:  # what nothing else waits for flies meanwhile
        replayed = beside.submit(fly, list(dict.fromkeys([*of_paper.values(), *studies.elsewhere(cells)])))
        flights, by_layout, watched, problems = watch(sorted_cells)
        evidence = {reading: Rows(sorted_cells, reading, flights, by_layout) for reading in READINGS}
        printed = {reading: functools.partial(studies.of_paper, reading=reading) for reading in READINGS}
        audits = {reading: audit(evidence[reading], printed[reading]) for reading in READINGS}
        baselines, unread = frames.baselines(folders)
        tuned, untuned = tuning.read(folders, baselines)
        survival, survived = frames.survival(sorted_cells.main, baselines)
        overestimated, unvalued = _overestimation(of_paper)
        predictions = frames.predictions(evidence)
        carried = frames.carried(sorted_cells, evidence[PRIMARY])
        numbers = _tables(sorted_cells, flights) | {
            "whys": whys.table(evidence[PRIMARY]),
            "overestimation": overestimated,
            "survival": survived,
            "predictions": predictions,
            "operating": characteristics(evidence[PRIMARY], printed[PRIMARY]),
            "gaps": frames.gaps(of_paper, baselines),
            "fits": frames.fits(predictions),
            **tuned,
        }
        if sorted_cells.tuned:
            numbers["fast"] = frames.gaps(sorted_cells.tuned, baselines)
        if len(carried):
            numbers |= {"carried": carried, "further": frames.gaps(studies.further(sorted_cells), baselines)}
        if of_worlds := worlds.gather(folders):
            elsewhere = worlds.Evidence(of_worlds.seeds)
            audits[SAMPLED] += audit(elsewhere, studies.of_paper, DISCUSSION)
            errs = numbers["operating"], characteristics(elsewhere, studies.of_paper, DISCUSSION)
            numbers |= worlds.numbers(of_worlds) | {"operating": pd.concat(errs, ignore_index=True)}
            left_out += of_worlds.left_out
        numbers["verdicts"] = frames.verdicts(audits)
        drawn, narrow = (
            figures.draw(of_paper, numbers, watched, survival, of_worlds, width)
            for width in (style.WIDTH, style.NARROW)
        )
        flown = replayed.result()
    return Content(
        cells,
        sorted_cells,
        audits,
        numbers,
        drawn,
        narrow,
        flown if flown["cells"] else None,
        baselines,
        frames.first_rule(folders[0]),
        list(dict.fromkeys([*left_out, *problems, *unvalued, *unread, *untuned, *flown["left_out"]])),
        of_worlds,
    )


def watch(all_cells: Studies) -> tuple[Flights, Flights, Flights, list[str]]:
    """Measures of flights by mode and seed, by mode and layout, the flights, and a line for what could not be read.

    Those of the main study are also taken early and by layout (`behaviour.early`, `by_layout`), and in the empty arena:
    the measures there are `empty_...`, the `layout` is -1.
    """
    tables: Flights = {}
    empty: Flights = {}
    problems = []
    for study in (*WATCHED, *all_cells.why):
        for key, cell in studies.paper_cells(all_cells.of(study)).items():
            for found, read in ((tables, behaviour.read), (empty, behaviour.read_arena)):
                if found is tables or (study == "main" and (study, *key) in tables):
                    rows, lines = _of_runs(cell, read)
                    problems += lines
                    found |= {(study, *key): pd.concat(rows, ignore_index=True)} if rows else {}
    world, bank = World(), layouts.load("test")
    measured, by_layout = {}, {}
    for place, table in tables.items():
        steps = behaviour.of_steps(table, bank, world)
        measured[place] = behaviour.of_seeds(steps)
        if place[0] == "main":
            measured[place] = measured[place].join(behaviour.early(steps), on=["mode", "seed"])
            by_layout[place] = behaviour.by_layout(steps)
    for place, steps in empty.items():
        own = behaviour.measures(steps, EMPTY_ARENA, world).set_index(["mode", "seed"]).add_prefix("empty_")
        measured[place] = measured[place].join(own, on=["mode", "seed"])
        tables[place] = pd.concat([tables[place], steps.assign(layout=-1)], ignore_index=True)
    return measured, by_layout, tables, problems


def _of_runs(cell: Cell, read: Callable[[Run], pd.DataFrame | None]) -> tuple[list[pd.DataFrame], list[str]]:
    """What the runs of a cell have of a table, and a line for each that could not be read."""
    found, problems = [], []
    for run in cell.runs:
        try:
            found.append(read(run))
        except RunError as error:
            problems.append(one_line(error))
    return [table for table in found if table is not None], problems


def _overestimation(cells: studies.Cells) -> tuple[pd.DataFrame, list[str]]:
    """What seeds expect and get (`evaluate.values`), and a line for each table that could not be read."""
    columns = {"seed": "int64"} | dict.fromkeys(frames.OVERESTIMATION, "float64")

    def read(run: Run) -> pd.DataFrame | None:
        path = run.path / VALUES
        return read_table(path, columns, behaviour.AGAIN) if path.exists() else None

    parts, problems = [], []
    for key, cell in cells.items():
        found, lines = _of_runs(cell, read)
        parts += [table.assign(cell=frames.name(*key)) for table in found]
        problems += lines
    return pd.concat(parts or [pd.DataFrame(columns=["cell", *columns])], ignore_index=True)[
        ["cell", *columns]
    ], problems


def _tables(all_cells: Studies, flights: Flights) -> dict[str, pd.DataFrame]:
    values, of_paper = frames.per_seed_values(all_cells.main), studies.paper_cells(all_cells.main)
    return {
        "seeds": values,
        "metrics": frames.estimates(values),
        "tuned": frames.estimates(frames.per_seed_values(all_cells.tuned)),
        "improvement": frames.improvement(of_paper),
        "interaction": frames.interactions(all_cells.main),
        "power": frames.power(all_cells.main),
        "behaviour": frames.flown(flights),
        "diagnostics": frames.diagnostics(of_paper),
        "sensitivity": frames.sensitivity(all_cells),
        "cells": frames.sizes(all_cells),
        "effects": frames.effects(all_cells),
        "worlds": frames.one_against_many(all_cells),
        "peaks": frames.peaks(of_paper),
        "by_default": frames.by_default(all_cells),
        "vectorised": frames.estimates(frames.per_seed_values(studies.paper_cells(all_cells.vectorised))),
        "wide": frames.estimates(frames.per_seed_values(studies.wide(all_cells))),
        "speed": frames.speed(of_paper),
    }
