"""What a report says, before it is a page: studies, verdicts, numbers, figures, replays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from uavnav.evaluate import WATCHED_LAYOUTS, WATCHED_STEPS
from uavnav.policies import PolicyError
from uavnav.report import behaviour, claims, figures, frames, replays, studies, tables
from uavnav.report.cells import Cell, collect, one_line, readings
from uavnav.report.claims import PRIMARY, Finding
from uavnav.report.figures import DIAGNOSTICS, Drawn
from uavnav.report.frames import name
from uavnav.report.studies import Rows, Studies
from uavnav.runs import paper
from uavnav.runs.metrics import METRICS, MODES
from uavnav.runs.tables import RunError
from uavnav.tasks import layouts
from uavnav.tasks.world import World
from uavnav.training import machine

ALGORITHMS = tuple(dict.fromkeys(algorithm for algorithm, _ in paper.TABLES))
"""In the order of the paper's tables and figures."""
WATCHED = ("main", "baseline", "initial")
"""Studies whose flights are looked at."""
SHOWN_LAYOUTS = (0, 1, 2)
SHOWN_ACTIVATION = "tanh"
"""Of the trajectories; the replays show all."""
LOOKED_AT = ("clearance", "corridor", "corridor_flown", "reversals", "straight_speed", "turning_speed")
"""Measures of flights that have a panel."""
OF_ALGORITHM = {"entropy": "ppo", "q_value": "dqn"}
"""Diagnostics that one algorithm alone has."""


class Figure(NamedTuple):
    """A figure, where it belongs, and what the reader should see in it."""

    name: str  # of its files
    section: str
    drawn: Drawn
    caption: str


@dataclass
class Content:
    """All of it."""

    cells: list[Cell]
    studies: Studies
    audits: dict[str, list[Finding]]  # by reading
    tables: dict[str, pd.DataFrame]  # by the name of their CSV
    figures: list[Figure]
    replays: dict[str, Any] | None
    baselines: dict[str, pd.DataFrame]
    left_out: list[str] = field(default_factory=list)

    @property
    def missing(self) -> list[str]:
        """The paper's cells that have no finished run in the main study."""
        return [" ".join(key) for key in paper.TABLES if key not in self.studies.main]

    @property
    def findings(self) -> list[Finding]:
        """Of the primary reading."""
        return self.audits[PRIMARY]


def gather(folders: Sequence[Path]) -> Content:
    """Read all runs in some folders, let their policies fly a little, and work out what the report says.

    Raises:
        RunError: a folder is missing or holds no run, or no run can be used.
    """
    cells, left_out = collect(folders)
    sorted_cells = studies.sort(cells)
    left_out += studies.in_none(sorted_cells)
    of_paper = studies.paper_cells(sorted_cells.main)
    with machine.use_threads(1), ThreadPoolExecutor(1) as beside:  # what nothing else waits for flies meanwhile
        valued = beside.submit(_overestimation, of_paper)
        replayed = beside.submit(replays.record, [*of_paper.values()])
        flights, watched, problems = watch(sorted_cells)
        audits = {
            reading: claims.audit(Rows(sorted_cells, reading, flights), studies.of_paper)
            for reading in (PRIMARY, *_other_readings(cells[0]))
        }
        ratio = Rows(sorted_cells, PRIMARY, flights, ratio_of_means=True)
        audits[f"{PRIMARY}, ratios of means"] = claims.audit(ratio, studies.of_paper)
        baselines, unread = frames.baselines(folders)
        survival, survived = frames.survival(sorted_cells.main)
        numbers = _tables(sorted_cells, audits, flights)
        (overestimated, unvalued), flown = valued.result(), replayed.result()
    numbers |= {"overestimation": overestimated, "survival": survived}
    return Content(
        cells,
        sorted_cells,
        audits,
        numbers,
        _figures(sorted_cells, numbers, watched, survival),
        flown if flown["cells"] else None,
        baselines,
        list(dict.fromkeys([*left_out, *problems, *unvalued, *unread, *flown["left_out"]])),
    )


def _other_readings(cell: Cell) -> list[str]:
    return [reading for reading in readings(cell) if reading != PRIMARY]


Flights = dict[tuple[str, str, str], pd.DataFrame]
"""By study, algorithm and activation."""


def watch(all_cells: Studies) -> tuple[Flights, Flights, list[str]]:
    """Measures of flights, one row a mode and seed; the flights themselves; and what could not be read or flown.

    The main study's drones also fly where there is no obstacle: measures `empty_...`, and `layout` -1 of the flights.
    """
    tables: Flights = {}
    crews: dict[tuple[str, str, str], list[behaviour.Crew]] = {}
    problems = []
    for study in WATCHED:
        for key, cell in studies.paper_cells(all_cells.of(study)).items():
            parts: list[pd.DataFrame] = []
            loaded: list[behaviour.Crew] = []
            for run in cell.runs:
                try:
                    table = behaviour.read(run)
                    if table is None:
                        continue
                    if study == "main":
                        loaded += [behaviour.crew(run, mode) for mode in MODES]
                    parts.append(table)
                except (RunError, PolicyError) as error:
                    problems.append(one_line(error))
            if parts:
                tables[study, *key], crews[study, *key] = pd.concat(parts, ignore_index=True), loaded
    world, bank = World(), layouts.load("test")
    measured = {key: behaviour.measures(table, bank, world) for key, table in tables.items()}
    flown = iter(behaviour.empty_arena([one for loaded in crews.values() for one in loaded]))
    for place, loaded in crews.items():
        if loaded:
            empty = pd.concat([next(flown) for _ in loaded], ignore_index=True)
            own = behaviour.measures(empty, behaviour.EMPTY_ARENA, world).set_index(["mode", "seed"])
            measured[place] = measured[place].join(own.add_prefix("empty_"), on=["mode", "seed"])
            tables[place] = pd.concat([tables[place], empty.assign(layout=-1)], ignore_index=True)
    return measured, tables, problems


def _overestimation(cells: studies.Cells) -> tuple[pd.DataFrame, list[str]]:
    """What DQN's seeds expect and get, and what could not be flown."""
    parts, problems = [], []
    for key, cell in cells.items():
        if key[0] == "dqn":
            for run in cell.runs:
                try:
                    parts.append(behaviour.overestimation(run).assign(cell=name(*key)))
                except (PolicyError, RunError) as error:
                    problems.append(one_line(error))
    columns = ["cell", "seed", "q", "realised", "overestimation"]
    table = pd.concat(parts, ignore_index=True)[columns] if parts else pd.DataFrame(columns=columns)
    return table, problems


def _tables(all_cells: Studies, audits: Mapping[str, Sequence[Finding]], flights: Flights) -> dict[str, pd.DataFrame]:
    values, of_paper = frames.per_seed_values(all_cells.main), studies.paper_cells(all_cells.main)
    return {
        "verdicts": frames.verdicts(audits),
        "seeds": values,
        "metrics": frames.estimates(values),
        "tuned": frames.estimates(frames.per_seed_values(all_cells.tuned)),
        "improvement": frames.improvement(of_paper),
        "interaction": frames.interactions(all_cells.main),
        "power": frames.power(all_cells.main),
        "behaviour": frames.flown(flights),
        "diagnostics": frames.diagnostics(of_paper),
        "sensitivity": frames.sensitivity(all_cells),
        "by_default": frames.by_default(all_cells),
        "wide": frames.estimates(frames.per_seed_values(studies.wide(all_cells))),
        "speed": frames.speed(of_paper),
    }


# -- figures ----------------------------------------------------------------------------------------------------------


def _figures(
    all_cells: Studies, numbers: Mapping[str, pd.DataFrame], flights: Flights, survival: Mapping[str, pd.Series]
) -> list[Figure]:
    of_paper = studies.paper_cells(all_cells.main)
    found = [*_curves(of_paper), *_metrics(numbers["seeds"])]
    main = {name(*key[1:]): table for key, table in flights.items() if key[0] == "main"}
    found += _flights(main)
    found += _statistics(of_paper, numbers, survival)
    if len(numbers["behaviour"]):
        sampled = numbers["behaviour"].query("mode == 'sampled'")[
            ["cell", "algorithm", "activation", "seed", *LOOKED_AT]
        ]
        caption = "Each small dot is a seed, the bar its cells' 95 % interval; sampled flights on test sets."
        found.append(Figure("behaviour", "behaviour", figures.behaviours(sampled), caption))
    found += _why(of_paper)
    if len(numbers["sensitivity"]):
        caption = (
            "The band is the interval as decided; a switch whose interval lies across zero from it flips a conclusion."
        )
        found.append(Figure("sensitivity", "sensitivity", figures.sensitivity(numbers["sensitivity"]), caption))
    caption = (
        f"The dashed line is the paper's {paper.HOURS:g} hours, on a machine that it does not name. The seeds of a run"
        " train side by side and share its time alike."
    )
    found.append(Figure("speed", "speed", figures.speed(numbers["speed"]), caption))
    return found


def _curves(cells: studies.Cells) -> list[Figure]:
    found = []
    for algorithm in ALGORITHMS:
        mine = [cell for key, cell in cells.items() if key[0] == algorithm]
        for column in ("reward", "steps"):
            drawn = figures.curves(mine, column)
            number = 4 if algorithm == "dqn" else 5
            caption = (
                f"{algorithm.upper()}, as the paper's Figure {number}: {column} of the episodes that ended in"
                " each stretch of training. Line: mean over seeds; band: its 95 % interval; dashed: the paper's mean."
            )
            found.append(Figure(f"curves-{algorithm}-{column}", "curves", drawn, caption))
    return found


def _metrics(values: pd.DataFrame) -> list[Figure]:
    found = []
    for metric in ("reward", "steps"):
        mine = values[(values["metric"] == metric) & (values["reading"] == PRIMARY)]
        mine = mine[mine["ratio"] == "mean of ratios"]
        rows = {
            name(*(str(one) for one in key)): part["value"].dropna().to_numpy()
            for key, part in mine.groupby(["algorithm", "activation"], sort=False)
            if key in paper.TABLES
        }
        printed = {name(*key): paper.TABLES[key][metric] for key in paper.TABLES}
        caption = f"{PRIMARY.capitalize()}: seeds, their mean with its 95 % interval, and the paper's run."
        found.append(
            Figure(f"cells-{metric}", "tables", figures.intervals(rows, printed, str(METRICS[metric])), caption)
        )
    return found


def _flights(tables: Mapping[str, pd.DataFrame]) -> list[Figure]:
    if not tables:
        return []
    world, bank = World(), layouts.load("test")
    obstacles = {label: table[table["layout"] >= 0] for label, table in tables.items()}
    shown = {label: table for label, table in obstacles.items() if label.endswith(f" {SHOWN_ACTIVATION}")}
    found = []
    if shown:
        drawn = figures.trajectories(shown, bank, SHOWN_LAYOUTS, world, mode="sampled")
        caption = (
            f"As the paper's Figures 6 and 7: the first seed's flights on {len(SHOWN_LAYOUTS)} test sets, at most"
            f" {WATCHED_STEPS} steps, as in training (sampled), with {SHOWN_ACTIVATION}. The replays below show the"
            " others."
        )
        found.append(Figure("trajectories", "flights", drawn, caption))
    for stem, where, low, high in (
        ("heat", f"on {WATCHED_LAYOUTS} test sets", 0, np.inf),
        ("heat-empty", "in the empty arena", -1, -1),
    ):
        maps: dict[str, behaviour.Array] = {}
        counts: set[int] = set()
        for algorithm in ALGORITHMS:
            mine = [table for label, table in tables.items() if label.startswith(f"{algorithm.upper()} ")]
            mine = [table[(table["mode"] == "sampled") & table["layout"].between(low, high)] for table in mine]
            if any(len(table) for table in mine):
                maps[algorithm.upper()] = np.mean([behaviour.heat(table, world) for table in mine], axis=0)
                counts |= {table["seed"].nunique() for table in mine}
        if maps:
            activations = len({label.split()[-1] for label in tables})
            caption = (
                f"Where the drones are {where}: share of steps in each square, of every seed and activation alike"
                f" ({activations} activations, n = {frames.least_to_most(counts)} seeds each)."
            )
            found.append(Figure(stem, "behaviour", figures.heat_maps(maps, world), caption))
    return found


def _statistics(
    cells: studies.Cells, numbers: Mapping[str, pd.DataFrame], survival: Mapping[str, pd.Series]
) -> list[Figure]:
    matrix = figures.improvement_matrix(numbers["improvement"], f"{METRICS['reward']}, {PRIMARY}")
    counted = numbers["survival"].set_index("cell")["n"]
    shown = [label for label in (name(*key) for key in cells) if label in survival]
    curves = {f"{label} (n = {counted[label]})": survival[label] for label in shown}
    n = min((studies.seeds(cell) for cell in cells.values()), default=0)
    return [
        Figure(
            "improvement",
            "statistics",
            matrix,
            "How probably a seed of the row's cell beats one of the column's; Mann-Whitney, Holm's correction.",
        ),
        Figure(
            "survival",
            "statistics",
            figures.survival(curves, frames.CAP),
            "Kaplan-Meier, all seeds of a cell pooled, n of them: a cap on steps censors a flight, and is no collision."
            " Sampled.",
        ),
        Figure(
            "power",
            "statistics",
            figures.power(numbers["power"], n, tables.MANY),
            "What it would take to tell two activations apart by their reward; the line is what this study has.",
        ),
    ]


def _why(cells: studies.Cells) -> list[Figure]:
    found = []
    for algorithm in ALGORITHMS:
        progress = {
            activation: pd.concat([run.progress for run in cell.runs], ignore_index=True)
            for (which, activation), cell in cells.items()
            if which == algorithm
        }
        for column, label in DIAGNOSTICS.items():
            if OF_ALGORITHM.get(column, algorithm) != algorithm or not any(column in one for one in progress.values()):
                continue
            bound = _most_return(cells) if column == "q_value" else None
            drawn = figures.why(progress, column, f"{algorithm.upper()}: {label}", bound)
            caption = f"{algorithm.upper()}: {label}; line: mean over seeds, band: 95 % interval."
            if bound is not None:
                caption += (
                    " Above the dashed line no reward can follow: flying straight at full speed for ever earns that."
                )
            found.append(Figure(f"why-{algorithm}-{column.replace('_', '-')}", "why", drawn, caption))
    return found


def _most_return(cells: studies.Cells) -> float | None:
    """The largest discounted return of the world: full speed for ever, r / (1 - gamma)."""
    world = World()
    gammas = {cell.settings["gamma"] for key, cell in cells.items() if key[0] == "dqn" and "gamma" in cell.settings}
    most = world.reward_per_pixel * (world.n_distances - 1)
    return most / (1 - gammas.pop()) if len(gammas) == 1 else None
