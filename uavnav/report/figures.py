"""Which figures a report has: each with the section that it belongs to and a caption."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pandas as pd

from uavnav import style
from uavnav.evaluation import WATCHED_LAYOUTS, WATCHED_STEPS
from uavnav.report import arena, behaviour, charts, curves, findings, frames, studies, tables, whys
from uavnav.report.cells import algorithms
from uavnav.report.claims import PRIMARY
from uavnav.report.frames import DIAGNOSTICS, name
from uavnav.report.headline import RULE
from uavnav.report.studies import Cells
from uavnav.runs import paper
from uavnav.runs.metrics import MODES
from uavnav.runs.readings import PER_FRAME, SAMPLED, words
from uavnav.stats import Array, Interval
from uavnav.style import Drawn
from uavnav.tasks import layouts
from uavnav.tasks.world import World

SHOWN_LAYOUTS = (0, 1, 2)
SHOWN_ACTIVATION = "tanh"
"""Trajectories show these; the replays show all."""
LOOKED_AT = {name: label for name, label in frames.MEASURES.items() if name not in ("trembling", "border")}
"""Measures of flights that have a panel."""


class Figure(NamedTuple):
    """A figure, where it belongs, and what the reader should see in it."""

    name: str  # of its files
    section: str
    drawn: Drawn
    caption: str


def draw(
    cells: Cells,
    numbers: Mapping[str, pd.DataFrame],
    flights: Mapping[tuple[str, str, str], pd.DataFrame],
    survival: Mapping[str, pd.Series],
    width: float = style.WIDTH,
) -> list[Figure]:
    """All figures on the main study, in the order of the page.

    cells: of the paper's activations; numbers: the report's tables by name; flights: steps by study, algorithm and
    activation; survival: curves by cell; width: of the figures [inches].
    """
    flown = {key[1:]: table for key, table in flights.items() if key[0] == "main"}
    found = [*_first(numbers["seeds"], numbers["gaps"], width), *_curves(cells, width)]
    found += [*_metrics(numbers["seeds"], numbers["gaps"], width), *_paths(flown, width), *_places(flown, width)]
    found += _statistics(cells, numbers, survival, width)
    if len(numbers["behaviour"]):
        sampled = numbers["behaviour"].query("mode == 'sampled'")
        drawn = charts.behaviours(sampled[["cell", "algorithm", "activation", "seed", *LOOKED_AT]], width)
        caption = "Each small dot is a seed, the bar its cell's 95 % interval; sampled flights on test sets."
        found.append(Figure("behaviour", "behaviour", drawn, caption))
    found += [*_whys(numbers, width), *_why(cells, width)]
    if len(numbers["sensitivity"]):
        caption = "The band is the interval as decided; an interval that lies across zero from it flips a conclusion."
        found.append(Figure("sensitivity", "sensitivity", charts.sensitivity(numbers["sensitivity"], width), caption))
    caption = (
        f"The dashed line is the paper's {paper.HOURS:g} hours, on a machine that it does not name. The seeds of a run"
        " train side by side and share its time alike."
    )
    return [*found, Figure("speed", "speed", charts.speed(numbers["speed"], width), caption)]


def _curves(cells: Cells, width: float) -> list[Figure]:
    found = []
    for algorithm in dict.fromkeys([*paper.TABLE_OF, *algorithms(cells)]):
        mine = [cell for key, cell in cells.items() if key[0] == algorithm]
        number = paper.CURVES_OF.get(algorithm)
        beside = f", as the paper's Figure {number}" if number else ""
        dashed = "; dashed: the paper's mean" if number else ""
        for column in ("reward", "steps"):
            caption = (
                f"{algorithm.upper()}{beside}: {words(column, PER_FRAME)} in each stretch of training, of all seeds and"
                f" flights, open ones too. Line: {curves.LINES[column]}; band: its 95 % interval over seeds{dashed}."
            )
            found.append(Figure(f"curves-{algorithm}-{column}", "curves", curves.curves(mine, column, width), caption))
    return found


def _metrics(values: pd.DataFrame, gaps: pd.DataFrame, width: float) -> list[Figure]:
    """Cells side by side in two metrics of training."""
    rule = gaps[gaps["who"] == RULE]
    found = []
    for metric, own in (("reward", rule["per_frame"]), ("steps", rule["per_frame"][:0])):
        printed = {name(*key): paper.printed(*key, metric, PRIMARY == PER_FRAME) for key in paper.TABLES}
        caption = f"{PRIMARY.capitalize()}: seeds, their mean with its 95 % interval, and the paper's run."
        caption += f" Dashed: the hand-written rule `{RULE}` on the test sets." if len(own) else ""
        dashed = float(own.sum()) if len(own) else np.nan
        drawn = charts.intervals(_seeds(values, PRIMARY, metric), printed, words(metric, PRIMARY), dashed, width)
        found.append(Figure(f"cells-{metric}", "tables", drawn, caption))
    return found


def _first(values: pd.DataFrame, gaps: pd.DataFrame, width: float) -> list[Figure]:
    """The figure of the first screen, as wide as the page: the reward of test flights, with the rule's."""
    rule, width = gaps.loc[gaps["who"] == RULE, "reward"], style.FULL if width >= style.WIDTH else width
    dashed = float(rule.sum()) if len(rule) else np.nan
    seeds = _seeds(values, SAMPLED, "reward")
    rows = {
        row["who"]: (seeds[row["who"]], Interval(row["reward"], row["low"], row["high"], row["n"]))
        for row in gaps[gaps["mode"] == MODES[1]].to_dict("records")
        if row["who"] in seeds
    }
    drawn = charts.flights(rows, dashed, "reward a flight, new obstacles", width)
    caps = gaps.loc[gaps["mode"] == MODES[1], "cap"].dropna()
    limit = f" Flights end at a collision, or after {caps.max():,.0f} steps." if len(caps) else ""
    caption = "A small dot is a training run, a large one the mean of its row with its 95 % interval."
    caption += f"{limit} The paper: {paper.TITLE}."
    return [Figure("cells-flights", "first", drawn, caption)]


def _seeds(values: pd.DataFrame, reading: str, metric: str) -> dict[str, Array]:
    """Each of the paper's cells: one number a seed [S]."""
    shown = values[(values["reading"] == reading) & (values["metric"] == metric)]
    return {
        name(*(str(one) for one in key)): part["value"].dropna().to_numpy()
        for key, part in shown.groupby(["algorithm", "activation"], sort=False)
        if key[1] in paper.ACTIVATIONS
    }


def _paths(flown: Mapping[tuple[str, str], pd.DataFrame], width: float) -> list[Figure]:
    shown = {name(*key): table[table["layout"] >= 0] for key, table in flown.items() if key[1] == SHOWN_ACTIVATION}
    if not shown:
        return []
    drawn = arena.trajectories(shown, layouts.load("test").numpy(), SHOWN_LAYOUTS, World(), mode="sampled", width=width)
    caption = (
        f"As the paper's Figures {' and '.join(map(str, paper.PATHS))}: the first seed's flights on"
        f" {len(SHOWN_LAYOUTS)} test sets, at most {WATCHED_STEPS} steps, as in training (sampled), with"
        f" {SHOWN_ACTIVATION}. The replays below show the others."
    )
    return [Figure("trajectories", "flights", drawn, caption)]


def _places(flown: Mapping[tuple[str, str], pd.DataFrame], width: float) -> list[Figure]:
    """Heat maps, a panel an algorithm."""
    found = []
    for stem, where, is_empty in (
        ("heat", f"on {WATCHED_LAYOUTS} test sets", False),
        ("heat-empty", "in the empty arena", True),
    ):
        chosen = f"mode == 'sampled' and (layout < 0) == {is_empty}"
        sampled = {key: part for key, table in flown.items() if len(part := table.query(chosen))}
        maps = {}
        for algorithm in algorithms(sampled):
            mine = [behaviour.heat(table, World()) for (which, _), table in sampled.items() if which == algorithm]
            maps[algorithm.upper()] = np.mean(mine, axis=0)
        if maps:
            activations = len({activation for _, activation in flown})
            n = frames.least_to_most((table["seed"].nunique() for table in sampled.values()), "seed")
            caption = (
                f"Where the drones are {where}: share of steps in each square, of every seed and activation alike"
                f" ({activations} activations, {n} each)."
            )
            found.append(Figure(stem, "behaviour", arena.heat_maps(maps, World(), width), caption))
    return found


def _statistics(
    cells: Cells, numbers: Mapping[str, pd.DataFrame], survival: Mapping[str, pd.Series], width: float
) -> list[Figure]:
    counted = numbers["survival"].set_index("cell")["n"]
    shown = [label for label in (name(*key) for key in cells) if label in survival]
    flights = {f"{label} (n = {counted[label]})": survival[label] for label in shown}
    flights |= {style.RULE: survival[RULE]} if RULE in survival else {}
    n = min((studies.seeds(cell) for cell in cells.values()), default=0)
    matrix = charts.improvement_matrix(numbers["improvement"], words("reward", PRIMARY), width)
    beats = "How probably a seed of the row's cell beats one of the column's; Mann-Whitney, Holm's correction."
    pooled = (
        "Kaplan-Meier, all seeds of a cell pooled, n of them: a cap on steps censors a flight, and is no collision."
    )
    needed = (
        "What it takes to find the paper's difference in reward of two activations, where seeds scatter as ours; the"
        " line is what this study has."
    )
    return [
        Figure("improvement", "statistics", matrix, beats),
        Figure("survival", "statistics", curves.survival(flights, frames.CAP, width), f"{pooled} Sampled."),
        Figure("power", "statistics", charts.power(numbers["power"], n, tables.MANY, width), needed),
    ]


def _whys(numbers: Mapping[str, pd.DataFrame], width: float) -> list[Figure]:
    """A figure for each question that there are cells for."""
    found, table = [], numbers["whys"]
    for question in whys.QUESTIONS:
        part = table[(table["question"] == question.name) & table["row"].isin([*question.rows])]
        if len(part):
            drawn = charts.rows_of(part, {metric: whys.in_words(metric) for metric in question.metrics}, width)
            said = " ".join([question.text, *map(str, findings.why(numbers, question))])
            found.append(Figure(f"whys-{question.name}", "why", drawn, said))
    return found


def _why(cells: Cells, width: float) -> list[Figure]:
    found = []
    for algorithm in algorithms(cells):
        mine = {activation: cell for (which, activation), cell in cells.items() if which == algorithm}
        progress = {
            activation: pd.concat([run.progress for run in cell.runs], ignore_index=True)
            for activation, cell in mine.items()
        }
        for column, label in DIAGNOSTICS.items():
            if not any(column in one for one in progress.values()):
                continue
            caption = f"{algorithm.upper()}: {label}; line: mean over seeds, band: 95 % interval."
            gammas = {cell.settings.get("gamma") for cell in mine.values()} if column == "q_value" else set()
            bound = _most_return(*gammas) if len(gammas) == 1 else None
            if bound is not None:
                caption += " No reward above the dashed line can follow: it is that of flying straight on for ever."
            drawn = curves.why(progress, column, f"{algorithm.upper()}: {label}", bound, width)
            found.append(Figure(f"why-{algorithm}-{column.replace('_', '-')}", "why", drawn, caption))
    return found


def _most_return(gamma: float | None) -> float | None:
    """The largest discounted return of the world: full speed for ever, r / (1 - gamma)."""
    world = World()
    return None if gamma is None else world.reward_per_pixel * (world.n_distances - 1) / (1 - gamma)
