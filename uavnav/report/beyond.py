"""More algorithms: each tuned with the same budget, and whether what is said of activations holds for others.

What a study that tunes has left (`uavnav.studies.tuning`) is read from its folder, beside the other studies: its cells
are in no other table. Letters: S seeds of a cell.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd

from uavnav import stats, style
from uavnav.report import frames, headline
from uavnav.report.cells import Cell, collect, episodes_of, one_line, order
from uavnav.report.figures import Figure
from uavnav.report.studies import Cells, Rows, Studies
from uavnav.report.tables import number, with_interval
from uavnav.runs import paper
from uavnav.runs.metrics import finished
from uavnav.runs.readings import SAMPLED, words
from uavnav.runs.tables import RunError
from uavnav.runs.trials import (
    COLUMNS,
    DEFAULT,
    DIFFERENCE,
    IMPORTANCE,
    OF_IMPORTANCE,
    TABLE,
    TUNED,
    best,
    folders,
    read,
    winner,
)

Table = pd.DataFrame
TextRows = list[list[str]]
NAMED = {"tuning", "carried"}
"""Tables of a report that has this section."""
BOUNDED, UNBOUNDED = ("tanh", "sigmoid"), ("relu", "leaky_relu")
CONCLUSIONS = {
    "tanh − relu": (("tanh",), ("relu",)),
    "bounded − unbounded": (BOUNDED, UNBOUNDED),
    "tanh − sigmoid": (("tanh",), ("sigmoid",)),
    "relu − leaky_relu": (("relu",), ("leaky_relu",)),
}
"""What is said of activations, as differences of the mean reward per frame of some and of others."""


def tuning(of: Sequence[Path], baselines: Mapping[str, Table]) -> tuple[dict[str, Table], list[str]]:
    """The tables of the first study that tuned in some folders, by name, and a line for what is of no use.

    tuning: columns algorithm, settings (default, tuned, their difference), value, low, high, n, and the gap to the
    hand-written rule; tuning_pairs: differences of two algorithms; tuning_trials: what was tried, with the `best` so
    far; tuning_importance: shares of settings.
    """
    found = folders(of)
    if not found:
        return {}, []
    folder, *others = found
    left_out = [f"{other}: tuned too; the report shows {folder}" for other in others]
    try:
        trials, importance = read(folder / TABLE, COLUMNS), read(folder / IMPORTANCE, OF_IMPORTANCE)
        trials = trials.assign(best=so_far(trials))
        algorithms = list(dict.fromkeys(trials["algorithm"]))
        won = {name: row["trial"] for name in algorithms if (row := best(trials, name))}
    except RunError as error:
        return {}, [str(error), *left_out]
    cells: dict[str, Cells] = {DEFAULT: {}, TUNED: {}}
    places = [(DEFAULT, folder / DEFAULT)]
    places += [(TUNED, folder / winner(trial) / name) for name, trial in won.items()]
    for which, place in places:
        own, lines = _cells(place)
        cells[which] |= own
        left_out += lines
    compared = _compared(cells, baselines, algorithms)
    tables = {"tuning": compared, "tuning_pairs": _pairs(cells, algorithms)}
    return tables | {"tuning_trials": trials, "tuning_importance": importance}, left_out


def so_far(trials: Table) -> pd.Series[float]:
    """The best value of an algorithm's trials until each; a trial that diverged changes nothing."""
    of_each = trials["algorithm"]
    best: pd.Series[float] = trials.groupby(of_each)["value"].cummax().groupby(of_each).ffill()
    return best


def _cells(folder: Path) -> tuple[Cells, list[str]]:
    if not folder.is_dir():
        return {}, []
    try:
        found, left_out = collect([folder])
    except RunError as error:
        return {}, [one_line(error)]
    return {(cell.algorithm, cell.activation): cell for cell in found}, left_out


def _compared(cells: Mapping[str, Cells], baselines: Mapping[str, Table], algorithms: Sequence[str]) -> Table:
    gaps = {which: headline.gaps(found, baselines) for which, found in cells.items()}
    rows = []
    for algorithm in algorithms:
        seeds: dict[str, list[stats.Array]] = {}
        for which, found in cells.items():
            mine = [(key, cell) for key, cell in found.items() if key[0] == algorithm]
            seeds[which] = [one for _, cell in mine if len(one := rewards(cell))]
            gap = gaps[which].query("mode == 'sampled' and algorithm == @algorithm")
            own = gap[["gap", "gap_low", "gap_high"]].to_numpy()[0] if len(gap) else [np.nan] * 3
            if seeds[which]:
                rows.append([algorithm, which, *stats.difference(seeds[which], []), *own])
        if all(seeds.values()):
            rows.append([algorithm, DIFFERENCE, *stats.difference(seeds[TUNED], seeds[DEFAULT]), *[np.nan] * 3])
    columns = ["algorithm", "settings", "value", "low", "high", "n", "gap", "gap_low", "gap_high"]
    return pd.DataFrame(rows, columns=columns)


def _pairs(cells: Mapping[str, Cells], algorithms: Sequence[str]) -> Table:
    rows = []
    for which, found in cells.items():
        of = {key[0]: [one] for key, cell in found.items() if len(one := rewards(cell))}
        for first, second in itertools.combinations([algorithm for algorithm in algorithms if algorithm in of], 2):
            rows.append([f"{first} − {second}", which, *stats.difference(of[first], of[second])])
    return pd.DataFrame(rows, columns=["pair", "settings", "value", "low", "high", "n"])


def rewards(cell: Cell) -> stats.Array:
    """The mean reward of each seed's sampled test flights [S]."""
    flown = finished(episodes_of(cell, SAMPLED))
    return np.asarray(flown.groupby("seed")["reward"].mean(), dtype=np.float64)


# -- tuning, for people ------------------------------------------------------------------------------------------------


def compared(found: Table) -> TextRows:
    """Default against tuned, a row an algorithm."""
    rows = [["algorithm", "seeds", DEFAULT, TUNED, DIFFERENCE, "tuned, gap to the rule"]]
    for algorithm, part in found.groupby("algorithm", sort=False):
        by = part.set_index("settings")
        shown = [_shown(by, which) for which in (DEFAULT, TUNED, DIFFERENCE)]
        gap = _shown(by, TUNED, ("gap", "gap_low", "gap_high"))
        rows.append([str(algorithm).upper(), str(by["n"].max()), *shown, gap])
    return rows


def reward(numbers: Mapping[str, Table], algorithm: str, which: str) -> str:
    """Of an algorithm's test flights with some settings; by default those of tanh, where it was not tuned."""
    tuned = numbers["tuning"].query("algorithm == @algorithm") if "tuning" in numbers else pd.DataFrame()
    if len(tuned):
        return _shown(tuned.set_index("settings"), which)
    if which != DEFAULT or "further" not in numbers:
        return "–"
    sampled = numbers["further"].query("mode == 'sampled'").set_index("who")
    return _shown(sampled, frames.name(algorithm, "tanh"), ("reward", "low", "high"))


def _shown(by: Table, which: str, columns: Sequence[str] = ("value", "low", "high"), digits: int = 1) -> str:
    if which not in by.index:
        return "–"
    value, low, high = map(float, by[list(columns)].T[which])
    return with_interval(value, low, high, digits)


def winners(trials: Table) -> TextRows:
    """The best trial's settings, a row an algorithm."""
    rows = [["algorithm", "trials", "diverged", "first (default)", "best", "its trial", "settings"]]
    for algorithm, part in trials.groupby("algorithm", sort=False):
        known = part.dropna(subset=["value"])
        first = part.loc[part["trial"] == 0, "value"].to_numpy()
        top = best(trials, str(algorithm))
        told = ["–"] * 3
        if top is not None:
            settings = json.loads(top["settings"])
            shown_ = (
                f"{key}={f'{value:.3g}' if isinstance(value, float) else value}" for key, value in settings.items()
            )
            told = [number(top["value"], 1), str(top["trial"]), ", ".join(shown_)]
        diverged = str(len(part) - len(known))
        shown = number(float(first[0]), 1) if len(first) else "–"
        rows.append([str(algorithm).upper(), str(len(part)), diverged, shown, *told])
    return rows


def figures(numbers: Mapping[str, Table], baselines: Mapping[str, Table], width: float = style.WIDTH) -> list[Figure]:
    """Default against tuned; none without flights of both. numbers: as `tuning` gives them; width [inches]."""
    if "tuning" not in numbers or numbers["tuning"].empty:
        return []
    rule = finished(baselines[headline.RULE])["reward"].mean() if headline.RULE in baselines else np.nan
    caption = "Reward of a test flight, sampled: mean over seeds and 95 % interval. Dashed: the hand-written rule."
    return [Figure("tuning", "algorithms", pairs(numbers["tuning"], float(rule), width), caption)]


@matplotlib.rc_context(style.STYLE)
def pairs(found: Table, rule: float, width: float = style.WIDTH) -> style.Drawn:
    """Default and tuned, a row each; found: as `tuning` gives it."""
    shown = found[found["settings"] != DIFFERENCE]
    rows = [f"{one['algorithm'].upper()} {one['settings']}, n = {one['n']}" for one in shown.to_dict("records")]
    figure, axes = style.panel("", 0.42 * len(rows) + 1.3, width)
    said = []
    for row, one in enumerate(shown.to_dict("records")):
        colour = style.CLEAR if one["settings"] == TUNED else style.PALE
        axes.plot([one["low"], one["high"]], [row, row], color=colour, linewidth=3, solid_capstyle="butt")
        axes.plot(one["value"], row, "o", color=colour, markersize=9)
        interval = style.said(stats.Interval(one["value"], one["low"], one["high"], one["n"]))
        said.append(f"{one['algorithm'].upper()} {one['settings']} {interval}")
    style.name_rows(axes, rows)
    axes.set_xlabel(words("reward", SAMPLED))
    if np.isfinite(rule):
        axes.axvline(rule, **style.DASHED)
        said.append(f"{style.RULE} {style.number(rule)}")
    return style.Drawn(figure, f"Reward of a test flight: {'; '.join(said)}.")


# -- activations -------------------------------------------------------------------------------------------------------


def further(studies: Studies) -> Cells:
    """The cells in many environments of algorithms beyond the paper's."""
    return {key: cell for key, cell in studies.of("vectorised").items() if key[0] not in paper.TABLE_OF}


def carried(evidence: Rows) -> Table:
    """What is said of activations, by algorithm, in many environments: columns conclusion, algorithm, value, ...

    None unless an algorithm beyond the paper's has runs with the activations that some conclusion asks for.
    """
    study = "vectorised"
    there = sorted(evidence.studies.of(study), key=order)
    algorithms = list(dict.fromkeys(algorithm for algorithm, _ in there))
    rows = []
    for (label, sides), algorithm in itertools.product(CONCLUSIONS.items(), algorithms):
        first, second = (
            [evidence(algorithm, activation, "reward", study=study) for activation in side] for side in sides
        )
        if all(len(one) for one in (*first, *second)):
            rows.append([label, algorithm, *stats.difference(first, second)])
    found = pd.DataFrame(rows, columns=["conclusion", "algorithm", "value", "low", "high", "n"])
    return found if {*found["algorithm"]} - {*paper.TABLE_OF} else found[:0]
