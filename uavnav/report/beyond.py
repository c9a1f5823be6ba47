"""More algorithms: each tuned with the same budget, and whether what is said of activations holds for others.

What a study that tunes has left (`uavnav.studies.tuning`) is read from its folder, beside the other studies: its cells
are in no other table. Letters: S seeds of a cell.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import MaxNLocator

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
    HOW,
    IMPORTANCE,
    OF_IMPORTANCE,
    TABLE,
    TUNED,
    best,
    folders,
    read,
    winner,
)
from uavnav.tasks.protocol import DRAWS

Table = pd.DataFrame
TextRows = list[list[str]]
NAMED = {"tuning", "carried"}
"""Tables of a report that has this section."""
COLOURS = ("#0072B2", "#009E73", "#D55E00", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Of algorithms."""
BOUNDED, UNBOUNDED = ("tanh", "sigmoid"), ("relu", "leaky_relu")
CONCLUSIONS = {
    "tanh − relu": (("tanh",), ("relu",)),
    "bounded − unbounded": (BOUNDED, UNBOUNDED),
    "tanh − sigmoid": (("tanh",), ("sigmoid",)),
    "relu − leaky_relu": (("relu",), ("leaky_relu",)),
}
"""What is said of activations, as differences of the mean reward per frame of some and of others."""
AHEAD = {
    "tanh − relu": ("tanh is ahead of ReLU", "tanh trails ReLU"),
    "bounded − unbounded": (
        "bounded activations are ahead of unbounded ones",
        "bounded activations trail unbounded ones",
    ),
    "tanh − sigmoid": ("tanh is ahead of sigmoid", "tanh trails sigmoid"),
    "relu − leaky_relu": ("ReLU is ahead of leaky ReLU", "ReLU trails leaky ReLU"),
}
"""The same in words, above zero and below."""
WAYS = ("holds under", "turns round under", "is open under")
"""What may become of such a difference under another algorithm."""


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


def conclusion(found: Table) -> str:
    """What follows from default against tuned; found: as `tuning` gives it."""
    tuned = found[found["settings"] == TUNED].sort_values("value", ascending=False)
    if tuned.empty:
        return "No winner has flown yet."
    said = []
    for which, how in HOW.items():
        ranked = found[found["settings"] == which].sort_values("value", ascending=False)
        each = ", ".join(f"{one['algorithm'].upper()} {_number(one)}" for one in ranked.to_dict("records"))
        said += [f"{how}: {each}."] * bool(each)
    changed = found[(found["settings"] == DIFFERENCE)].to_dict("records")
    better = [f"{one['algorithm'].upper()} by {_number(one)}" for one in changed if one["low"] > 0]
    worse = [f"{one['algorithm'].upper()} by {_number(one)}" for one in changed if one["high"] < 0]
    if changed:
        said.append(
            f"Tuning raises the reward of {_listed(better)}"
            + (f", and lowers that of {_listed(worse)}." * bool(worse) or ".")
        )
    best = tuned.sort_values("gap", ascending=False).iloc[0]
    if np.isnan(best["gap"]):
        return " ".join([*said, "No flights of the hand-written rule lie beside them."])
    gap = with_interval(best["gap"], best["gap_low"], best["gap_high"], 1)
    who = str(best["algorithm"]).upper()
    if best["gap_low"] > 0:
        said.append(f"{who} passes the hand-written rule: {gap} a flight.")
    elif best["gap_high"] < 0:
        said.append(f"None passes the hand-written rule; {who} comes nearest: {gap} a flight.")
    else:
        said.append(f"Whether {who}, the best, passes the hand-written rule is open: {gap} a flight.")
    return " ".join(said)


def told_apart(pairs: Table) -> str:
    """Which algorithms are told apart, with default and with tuned settings; pairs: as `tuning_pairs` is kept.

    The fewer are named: those that are told apart, with the greater first, or those that are not.
    """
    said = []
    for which, how in HOW.items():
        apart, alike = [], []
        for one in pairs[pairs["settings"] == which].to_dict("records"):
            first, second = one["pair"].upper().split(" − ")
            if one["low"] <= 0 <= one["high"]:
                alike.append(f"{first} − {second} {_number(one)}")
            elif one["low"] > 0:
                apart.append(f"{first} above {second} by {_number(one)}")
            else:
                turned: dict[Hashable, Any] = {"value": -one["value"], "low": -one["high"], "high": -one["low"]}
                apart.append(f"{second} above {first} by {_number(turned)}")
        n = len(apart) + len(alike)
        named = f": {'; '.join(apart)}" if len(apart) <= len(alike) else f", all but {'; '.join(alike)}" * bool(alike)
        said += [f"{how}, {len(apart)} of {n} pairs are told apart{named * bool(apart)}."] * bool(n)
    return " ".join(said)


def matters(importance: Table) -> str:
    """Which setting explains most of the variation among trials; importance: as `tuning` gives it."""
    each = []
    for algorithm, part in importance.groupby("algorithm", sort=False):
        top = part.sort_values("importance", ascending=False).head(2).to_dict("records")
        shown = " and ".join(f"{one['setting']} ({one['importance']:.0%})" for one in top)
        each.append(f"{shown} for {str(algorithm).upper()}")
    told = f"What matters most among the trials (fANOVA): {'; '.join(each)}."
    return f"{told} Each share is one estimate from few trials, so near ones tell no order." if each else ""


def _number(one: Mapping[Hashable, Any]) -> str:
    return with_interval(one["value"], one["low"], one["high"], 1)


def _listed(names: Sequence[str]) -> str:
    return (
        " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names) or "none, as far as can be told"
    )


def figures(numbers: Mapping[str, Table], baselines: Mapping[str, Table], width: float = style.WIDTH) -> list[Figure]:
    """What a study that tuned shows; none without one. numbers: as `tuning` gives them; width [inches]."""
    if "tuning" not in numbers:
        return []
    rule = finished(baselines[headline.RULE])["reward"].mean() if headline.RULE in baselines else np.nan
    trials, importance, found = (numbers[key] for key in ("tuning_trials", "tuning_importance", "tuning"))
    drawn = [
        Figure(
            "tuning-trials",
            "algorithms",
            progress(trials, width),
            "Best mean reward on validation sets so far, by trial; the first is the default. Dots are single trials.",
        )
    ]
    if len(found):
        caption = "Reward of a test flight, sampled: mean over seeds and 95 % interval. Dashed: the hand-written rule."
        drawn.insert(0, Figure("tuning", "algorithms", pairs(found, float(rule), width), caption))
    if len(importance):
        caption = "How much of the variation among an algorithm's trials a setting explains (fANOVA)."
        drawn.append(Figure("tuning-importance", "algorithms", shares(importance, width), caption))
    return drawn


@matplotlib.rc_context(style.STYLE)
def progress(trials: Table, width: float = style.WIDTH) -> style.Drawn:
    """Best so far against trials, a line an algorithm, single trials as dots."""
    figure, axes = style.panel("", 4.2, width)
    said = []
    for colour, (algorithm, part) in zip(
        itertools.cycle(COLOURS), trials.groupby("algorithm", sort=False), strict=False
    ):
        axes.step(part["trial"], part["best"], where="post", color=colour, linewidth=2.2, label=str(algorithm).upper())
        axes.plot(part["trial"], part["value"], "o", color=colour, markersize=4, alpha=0.5, markeredgewidth=0)
        axes.plot(part["trial"].iloc[-1:], part["best"].iloc[-1:], "o", color=colour, markersize=8)
        known = part["best"].dropna()
        if len(known):
            ends = style.number(known.iloc[0]), style.number(known.iloc[-1])
            said.append(f"{str(algorithm).upper()} from {ends[0]} to {ends[1]} in {len(part)} trials")
    axes.set_xlabel("trial")
    axes.set_ylabel("mean reward, validation")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    figure.legend(loc="outside lower center", ncols=5 if width >= style.WIDTH else 3)
    return style.Drawn(figure, f"Best mean reward so far: {'; '.join(said)}.")


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


@matplotlib.rc_context(style.STYLE)
def shares(importance: Table, width: float = style.WIDTH) -> style.Drawn:
    """A panel an algorithm, a bar a setting."""
    groups = list(importance.groupby("algorithm", sort=False))
    columns = min(len(groups), 2 if width >= style.WIDTH else 1)
    lines = -(-len(groups) // columns)
    height = 0.34 * int(importance["algorithm"].value_counts().max()) + 0.9
    figure = Canvas(figsize=(width, lines * height + 0.3), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    said = []
    for axes, (algorithm, part) in zip(panels, groups, strict=False):
        part = part.sort_values("importance", ascending=False)
        axes.barh(range(len(part)), part["importance"], color=style.CLEAR, height=0.6)
        style.name_rows(axes, list(part["setting"]))
        axes.set_xlim(0, 1)
        axes.set_title(str(algorithm).upper())
        top = part.iloc[0]
        said.append(f"{str(algorithm).upper()} {top['setting']} {style.number(top['importance'])}")
    for axes in panels[len(groups) :]:
        axes.set_axis_off()
    return style.Drawn(figure, f"The setting that matters most, and its share: {'; '.join(said)}.")


# -- activations -------------------------------------------------------------------------------------------------------


def further(studies: Studies) -> Cells:
    """The cells in many worlds of algorithms beyond the paper's."""
    return {key: cell for key, cell in studies.of("many_worlds").items() if key[0] not in paper.TABLE_OF}


def carried(evidence: Rows) -> Table:
    """What is said of activations, algorithm by algorithm, in many worlds: columns conclusion, algorithm, value, ...

    None unless an algorithm beyond the paper's has runs with the activations that some conclusion asks for.
    """
    study = "many_worlds"
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


def conclusions(found: Table) -> TextRows:
    """A row a conclusion, a column an algorithm."""
    algorithms = list(dict.fromkeys(found["algorithm"]))
    rows = [["reward per frame", *map(str.upper, algorithms)]]
    for label, part in found.groupby("conclusion", sort=False):
        by = part.set_index("algorithm")
        shown = [_shown(by, one, digits=3) for one in algorithms]
        rows.append([str(label), *shown])
    return rows


def carries(found: Table) -> str:
    """Which conclusion of the paper's algorithms holds, turns round or stays open under the others."""
    said, everywhere = [], False
    for label, part in found.groupby("conclusion", sort=False):
        sign = {one["algorithm"]: (one["low"] > 0) - (one["high"] < 0) for one in part.to_dict("records")}
        everywhere |= len({*sign.values()}) == 1 and 0 not in sign.values()
        decided = {algorithm: sign[algorithm] for algorithm in paper.TABLE_OF if sign.get(algorithm)}
        others = [algorithm for algorithm in sign if algorithm not in paper.TABLE_OF]
        for way in dict.fromkeys(decided.values()):
            own = _listed([algorithm.upper() for algorithm in decided if decided[algorithm] == way])
            of = [[other.upper() for other in others if sign[other] == one] for one in (way, -way, 0)]
            parts = [f"{what} {_listed(names)}" for what, names in zip(WAYS, of, strict=True) if names]
            said.append(f"Under {own}, {AHEAD[str(label)][way < 0]}; this {_listed(parts)}.")
    if not said:
        return "No difference of activations is told from zero under the paper's algorithms."
    return " ".join(
        said if everywhere else ["No conclusion about activations is seen to hold under every algorithm.", *said]
    )


def no_better(flown: Table) -> str:
    """Which algorithms no cell of which earns more than random flight; flown: as `headline.gaps` gives it."""
    drawn = flown.loc[flown["who"] == DRAWS, "reward"]
    sampled = flown[flown["mode"] == "sampled"]
    if drawn.empty or sampled.empty:
        return ""
    above = (sampled["low"] > drawn.iloc[0]).groupby(sampled["algorithm"], sort=False).any()
    return " ".join(
        f"With default settings, no cell of {algorithm.upper()} earns more in test flights than random flight: its "
        "differences say little."
        for algorithm in above.index[~above]
    )
