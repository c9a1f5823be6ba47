"""What a report says, before it is a page: studies, verdicts, numbers, figures, replays."""

from __future__ import annotations

import functools
from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from uavnav import style
from uavnav.evaluation.empty_arena import EMPTY_ARENA
from uavnav.report import behaviour, beyond, figures, frames, headline, replays, studies, tables, whys, worlds
from uavnav.report.cells import Cell, algorithms, collect, one_line, read_as
from uavnav.report.claims import CLAIMS, PRIMARY
from uavnav.report.figures import Figure
from uavnav.report.operating import characteristics
from uavnav.report.studies import Rows, Studies
from uavnav.report.verdicts import Finding, audit
from uavnav.report.worlds import Worlds
from uavnav.runs import VALUES, paper
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
    left_out: list[str] = field(default_factory=list)
    worlds: Worlds | None = None  # the study of that name, where there is one

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

    @property
    def findings(self) -> list[Finding]:
        """The findings of the primary reading."""
        return self.audits[PRIMARY]


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
        tuned, untuned = beyond.tuning(folders, baselines)
        survival, survived = frames.survival(sorted_cells.main, baselines)
        numbers = _tables(sorted_cells, flights) | {"whys": whys.table(evidence[PRIMARY])}
        overestimated, unvalued = _overestimation(of_paper)
        predictions = frames.predictions(evidence)
        numbers |= {"behaviour_by_layout": frames.flown(by_layout)}
        numbers |= {"overestimation": overestimated, "survival": survived, "predictions": predictions}
        numbers |= {
            "verdicts": frames.verdicts(audits),
            "operating": characteristics(evidence[PRIMARY], printed[PRIMARY]),
        }
        of_worlds = worlds.gather(folders)
        if of_worlds:
            numbers |= worlds.numbers(of_worlds) | {"verdicts": frames.verdicts(audits, of_worlds.findings)}
            numbers["operating"] = pd.concat([numbers["operating"], of_worlds.operating], ignore_index=True)
            left_out += of_worlds.left_out
        numbers |= {"gaps": headline.gaps(of_paper, baselines), "fits": headline.fits(predictions)}
        if sorted_cells.tuned:
            numbers |= {"fast": headline.gaps(sorted_cells.tuned, baselines)}
        carried = beyond.carried(evidence[PRIMARY])
        if len(carried):
            numbers |= {"carried": carried, "further": headline.gaps(beyond.further(sorted_cells), baselines)}
        numbers |= tuned
        drawn = [*figures.draw(of_paper, numbers, watched, survival), *beyond.figures(numbers, baselines)]
        drawn += _of_worlds(of_worlds)
        narrow = figures.draw(of_paper, numbers, watched, survival, style.NARROW)
        narrow += beyond.figures(numbers, baselines, style.NARROW)
        narrow += _of_worlds(of_worlds, style.NARROW)
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


def _of_worlds(found: Worlds | None, width: float = style.WIDTH) -> list[Figure]:
    drawn = worlds.figures(found, width) if found else []
    return [Figure(name, "worlds", figure, caption) for name, figure, caption in drawn]


def watch(all_cells: Studies) -> tuple[Flights, Flights, Flights, list[str]]:
    """Measures of flights by mode and seed, by mode and layout, the flights, and a line for what could not be read.

    Those of the main study are also taken early and by layout (`behaviour.early`, `by_layout`), and in the empty arena:
    the measures there are `empty_...`, the `layout` is -1.
    """
    parts: dict[Place, list[pd.DataFrame]] = defaultdict(list)
    empty: dict[Place, list[pd.DataFrame]] = defaultdict(list)
    problems = []
    for study in (*WATCHED, *all_cells.why):
        for key, cell in studies.paper_cells(all_cells.of(study)).items():
            for run in cell.runs:
                try:
                    table = behaviour.read(run)
                    if table is None:
                        continue
                    parts[study, *key].append(table)
                    if study == "main" and (table := behaviour.read_arena(run)) is not None:
                        empty[study, *key].append(table)
                except RunError as error:
                    problems.append(one_line(error))
    tables = {place: pd.concat(found, ignore_index=True) for place, found in parts.items()}
    world, bank = World(), layouts.load("test")
    measured, by_layout = {}, {}
    for place, table in tables.items():
        steps = behaviour.of_steps(table, bank, world)
        measured[place] = behaviour.of_seeds(steps)
        if place[0] == "main":
            measured[place] = measured[place].join(behaviour.early(steps), on=["mode", "seed"])
            by_layout[place] = behaviour.by_layout(steps)
    for place, found in empty.items():
        steps = pd.concat(found, ignore_index=True)
        own = behaviour.measures(steps, EMPTY_ARENA, world).set_index(["mode", "seed"]).add_prefix("empty_")
        measured[place] = measured[place].join(own, on=["mode", "seed"])
        tables[place] = pd.concat([tables[place], steps.assign(layout=-1)], ignore_index=True)
    return measured, by_layout, tables, problems


def _overestimation(cells: studies.Cells) -> tuple[pd.DataFrame, list[str]]:
    """What seeds expect and get (`evaluate.values`), and a line for each table that could not be read."""
    columns = {"seed": "int64"} | dict.fromkeys(frames.OVERESTIMATION, "float64")
    parts, problems = [pd.DataFrame(columns=["cell", *columns])], []
    for key, run in ((key, run) for key, cell in cells.items() for run in cell.runs):
        if (run.path / VALUES).exists():
            try:
                parts.append(read_table(run.path / VALUES, columns, behaviour.AGAIN).assign(cell=frames.name(*key)))
            except RunError as error:
                problems.append(one_line(error))
    return pd.concat(parts[1:] or parts, ignore_index=True)[["cell", *columns]], problems


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
        "cells": headline.cells(all_cells),
        "effects": headline.effects(all_cells),
        "worlds": headline.worlds(all_cells),
        "peaks": headline.peaks(of_paper),
        "by_default": frames.by_default(all_cells),
        "vectorised": frames.estimates(frames.per_seed_values(studies.paper_cells(all_cells.vectorised))),
        "wide": frames.estimates(frames.per_seed_values(studies.wide(all_cells))),
        "speed": frames.speed(of_paper),
    }
