"""Figures of cells side by side: metrics and measures with their seeds, comparisons, and what they cost.

Every function takes plain data and returns a figure with its words. Letters: S seeds of a cell.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, StrMethodFormatter

from uavnav import stats, style
from uavnav.report.frames import MEASURES
from uavnav.runs import paper
from uavnav.stats import Array, Interval


@matplotlib.rc_context(style.STYLE)
def intervals(
    rows: Mapping[str, Array],
    printed: Mapping[str, float],
    axis: str,
    rule: float = np.nan,
    width: float = style.WIDTH,
) -> style.Drawn:
    """A metric's mean with its 95 % interval, its interquartile mean, its seeds and the paper's value: a row a cell.

    rows: label of the cell -> [S]; printed: label -> the paper's value; axis: the metric with its unit; rule: what the
    hand-written rule reaches; width: of the figure [inches]. The algorithms share a scale unless that would squeeze one
    of them into a fifth of it.
    """
    if not any(np.isfinite(values).any() for values in rows.values()):
        return style.nothing(axis)
    groups: dict[str, list[str]] = {}
    for name in rows:
        groups.setdefault(style.parts(name)[0], []).append(name)
    drawn = {name: np.asarray([*rows[name], printed.get(name, np.nan)], dtype=np.float64) for name in rows}
    spans = [np.concatenate([drawn[name] for name in members]) for members in groups.values()]
    spans = [span[np.isfinite(span)] for span in spans]
    widths = [float(np.ptp(span)) for span in spans if len(span)]
    share = len(groups) == 1 or min(widths) * 5 >= float(np.ptp(np.concatenate(spans)))
    heights = [len(members) for members in groups.values()]
    figure = Figure(figsize=(width, 0.5 * sum(heights) + 0.6 * len(groups) + 1.3), layout="constrained")
    panels = figure.subplots(len(groups), 1, sharex=share, squeeze=False, height_ratios=heights)[:, 0]
    said = []
    for axes, (group, members) in zip(panels, groups.items(), strict=True):
        for row, (name, (colour, _)) in enumerate(style.coloured(members)):
            seeds = rows[name]
            found = style.row_of_seeds(axes, row, seeds, colour)
            middle = stats.interquartile_mean(np.sort(seeds[np.isfinite(seeds)])) if found.n else np.nan
            axes.plot(middle, row, "|", color=style.INK, markersize=16, markeredgewidth=2, zorder=4)
            theirs = printed.get(name, np.nan)
            axes.plot(theirs, row, "D", color="white", markeredgecolor=style.INK, markersize=8, zorder=5)
            beside = f"the paper's {style.number(theirs)}" if name in printed else ""
            said.append(f"{name} {style.said(found, beside)}")
        style.name_rows(axes, [f"{name.split(' ', 1)[-1]}, n = {len(rows[name])}" for name in members])
        if np.isfinite(rule):
            axes.axvline(rule, **style.DASHED)
        axes.set_title(group + ("" if share else ", on its own scale"))
    panels[-1].set_xlabel(axis)
    handles = [
        Line2D([], [], marker="o", markersize=9, color=style.INK, label="mean, 95 % interval"),
        style.mark("|", "interquartile mean", markersize=14, markeredgewidth=2),
        style.mark("o", "a seed", markersize=5, alpha=0.5),
        *[style.mark("D", "the paper", markersize=8, markerfacecolor="white")] * bool(printed),
        *[Line2D([], [], label=style.RULE, **style.DASHED)] * bool(np.isfinite(rule)),
    ]
    style.legend(figure, handles, 3)
    beside = f"; {style.RULE} {style.number(rule)}" if np.isfinite(rule) else ""
    return style.Drawn(figure, f"{axis}, mean over seeds: {'; '.join(said)}{beside}.")


@matplotlib.rc_context(style.STYLE)
def flights(
    rows: Mapping[str, tuple[Array, Interval]], rule: float, axis: str, width: float = style.WIDTH
) -> style.Drawn:
    """What the rule and the cells reach on test flights: a row each, the best first, with its number.

    rows: label -> seeds [S] and their mean; rule: what the hand-written rule reaches; axis: the metric in words;
    width: [inches].
    """
    if not rows:
        return style.nothing(axis)
    order = sorted(rows, key=lambda name: -rows[name][1].value)
    groups = list(dict.fromkeys(style.parts(name)[0] for name in order))
    figure = Figure(figsize=(width, 0.24 * (len(order) + 1) + 0.55), layout="constrained")
    axes, named, said = figure.subplots(), [], []
    if np.isfinite(rule):
        axes.axvline(rule, **style.DASHED | {"color": style.FIRST[-1]})
        axes.plot(rule, 0, "D", color=style.FIRST[-1], markersize=8)
        named.append(f"{style.RULE}  {rule:,.0f}")
        said.append(f"{style.RULE} {style.number(rule)}")
    for name in order:
        colour = style.FIRST[groups.index(style.parts(name)[0]) % 2]
        found = style.row_of_seeds(axes, len(named), rows[name][0], colour, rows[name][1])
        named.append(f"{name.replace('_', ' ')}  {found.value:,.0f}")
        said.append(f"{name} {style.said(found)}")
    style.name_rows(axes, named)
    axes.set_xlabel(axis)
    return style.Drawn(figure, f"{axis}: {'; '.join(said)}.")


@matplotlib.rc_context(style.STYLE)
def rows_of(table: pd.DataFrame, panels: Mapping[str, str], width: float = style.WIDTH) -> style.Drawn:
    """Means with their intervals: a row each, a panel a metric.

    table: columns row, metric, value, low, high, n; panels: metric -> its axis; width: of the figure [inches].
    """
    rows, said = list(dict.fromkeys(table["row"])), []
    figure, drawn = _side_by_side(len(panels), 0.34 * len(rows) + 1.3, width)
    for axes, (metric, label) in zip(drawn, panels.items(), strict=True):
        for one in table[table["metric"] == metric].to_dict("records"):
            place, colour = rows.index(one["row"]), style.FIRST[not one["row"].startswith("PPO")]
            axes.plot([one["low"], one["high"]], [place, place], color=colour, linewidth=3, solid_capstyle="butt")
            axes.plot(one["value"], place, "o", color=colour, markersize=8)
            found = Interval(one["value"], one["low"], one["high"], one["n"])
            said.append(f"{one['row']}, {label} {style.said(found)}")
        axes.set_xlabel("\n".join(textwrap.wrap(label, 60 // len(panels))))
        axes.xaxis.set_major_locator(MaxNLocator(5 if len(panels) == 1 else 3))
        style.name_rows(axes, rows)
    return style.Drawn(figure, f"Mean over seeds and 95 % interval: {'; '.join(said)}.")


def _side_by_side(n: int, height: float, width: float) -> tuple[Figure, list[Axes]]:
    """Panels with the same rows, of such a height [inches]; in a narrow figure they stand one below the other."""
    lines = 1 if width >= style.WIDTH else n
    figure = Figure(figsize=(width, lines * height), layout="constrained")
    return figure, [*figure.subplots(lines, n // lines, sharey=True, squeeze=False).ravel()]


@matplotlib.rc_context(style.STYLE)
def behaviours(table: pd.DataFrame, width: float = style.WIDTH) -> style.Drawn:
    """How the cells fly: a panel a measure, in it a row a cell: mean, 95 % interval and seeds.

    table: a row a seed; columns cell, algorithm, activation, seed, and the measures, of which `MEASURES` names some;
    width: of the figure [inches].
    """
    measures = [name for name in table.columns if name not in ("cell", "algorithm", "activation", "seed")]
    measures = [name for name in measures if table[name].notna().any()]
    if not measures:
        return style.nothing("how the cells fly")
    names = list(dict.fromkeys(table["cell"]))
    columns = min(len(measures), 2) if width >= style.WIDTH else 1
    lines = -(-len(measures) // columns)
    figure = Figure(figsize=(width, lines * (0.3 * len(names) + 0.9) + 0.5), layout="constrained")
    panels = figure.subplots(lines, columns, sharey=True, squeeze=False).ravel()
    said = []
    for axes, measure in zip(panels, measures, strict=False):
        parts = []
        for row, (name, (colour, _)) in enumerate(style.coloured(names)):
            seeds = table.loc[table["cell"] == name, measure].to_numpy(dtype=np.float64)
            found = style.row_of_seeds(axes, row, seeds, colour)
            parts.append(f"{name} {style.number(found.value)}")
        label = MEASURES.get(measure, measure.replace("_", " "))
        axes.set_xlabel(label)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        said.append(f"{label}: {', '.join(parts)}")
    for axes in panels[len(measures) :]:
        axes.set_axis_off()
    counts = table["cell"].value_counts()
    style.name_rows(figure.axes[0], [f"{name}, n = {counts[name]}" for name in names])
    handles = [
        Line2D([], [], marker="o", markersize=8, color=style.INK, label="mean, 95 % interval over seeds"),
        style.mark("o", "a seed", markersize=5, alpha=0.5),
    ]
    style.legend(figure, handles)
    return style.Drawn(figure, f"How the cells fly, means over seeds: {'; '.join(said)}.")


@matplotlib.rc_context(style.STYLE)
def improvement_matrix(table: pd.DataFrame, what: str, width: float = style.WIDTH) -> style.Drawn:
    """The probability that a seed of the row's cell beats one of the column's, starred where Holm's p is below 0.05.

    table: of `stats.improvement`, the larger the better; what: the metric in words; width: of the figure [inches].
    """
    names = list(dict.fromkeys([*table["a"], *table["b"]]))
    title = f"Probability that a seed of the row beats\none of the column in {what}"
    if not names or table["probability"].isna().all():
        return style.nothing(title.replace("\n", " "))
    place = {name: index for index, name in enumerate(names)}
    counts = {**dict(zip(table["b"], table["n_b"], strict=True)), **dict(zip(table["a"], table["n_a"], strict=True))}
    matrix = np.full((len(names), len(names)), np.nan)
    starred = np.zeros(matrix.shape, dtype=bool)
    for pair in table.to_dict("records"):
        row, column, beats = place[pair["a"]], place[pair["b"]], float(pair["probability"])
        matrix[row, column], matrix[column, row] = beats, 1 - beats
        starred[row, column] = starred[column, row] = pair["p_holm"] < 0.05
    figure, axes = style.panel(title, min(0.62 * len(names) + 2.4, 8.0), width)
    image, letters = axes.imshow(matrix, cmap="PuOr", vmin=0, vmax=1, aspect="auto"), 12 if width >= style.WIDTH else 9
    for (row, column), value in np.ndenumerate(matrix):
        if np.isfinite(value):
            dark = image.to_rgba(value)[:3] @ np.array([0.3, 0.6, 0.1]) < 0.5
            text = f"{value:.2f}{'*' if starred[row, column] else ''}"
            weight = "bold" if starred[row, column] else "normal"
            look: dict[str, Any] = {"color": "white" if dark else style.INK, "weight": weight}
            axes.text(column, row, text, ha="center", va="center", fontsize=letters, **look)
    axes.set_xticks(range(len(names)), names, rotation=40, ha="right", rotation_mode="anchor")
    beside = "\n" if width < style.WIDTH else ", "
    axes.set_yticks(range(len(names)), [f"{name}{beside}n = {counts[name]}" for name in names])
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    side = "right" if width >= style.WIDTH else "bottom"
    figure.colorbar(image, ax=axes, label="probability (* Holm's p < 0.05)", fraction=0.05, location=side)
    found = int((table["p_holm"] < 0.05).sum())
    known = [(row[np.isfinite(row)], name) for row, name in zip(matrix, names, strict=True)]
    means = sorted(((round(float(row.mean()), 9), name) for row, name in known if len(row)), reverse=True)
    ranked = ", ".join(f"{name} {mean:.2f}" for mean, name in means)
    pairs = f"{found} of {len(table)} pairs differ with Holm's p below 0.05"
    return style.Drawn(figure, f"{title} (mean over the columns): {ranked}; {pairs}.".replace("\n", " "))


@matplotlib.rc_context(style.STYLE)
def sensitivity(table: pd.DataFrame, width: float = style.WIDTH) -> style.Drawn:
    """Whether conclusions hold under other choices: a panel a conclusion, in it a row a switch; the default shaded.

    table: columns switch (one is `default`), conclusion, value, low, high (a difference in mean reward), n;
    width: of the figure [inches].
    """
    title = "Differences in mean reward under other choices"
    if not len(table) or table["value"].isna().all():
        return style.nothing(title)
    names, conclusions = list(dict.fromkeys(table["switch"])), list(dict.fromkeys(table["conclusion"]))
    names.sort(key=lambda name: name != "default")
    figure, panels = _side_by_side(len(conclusions), 0.42 * len(names) + 2.0, width)
    said = []
    for axes, conclusion in zip(panels, conclusions, strict=True):
        rows = table[table["conclusion"] == conclusion].set_index("switch")
        usual = rows.loc["default"] if "default" in rows.index else None
        if usual is not None and np.isfinite(usual["low"]):
            axes.axvspan(usual["low"], usual["high"], color=style.CLEAR, alpha=0.15, linewidth=0)
        axes.axvline(0, color=style.INK, linewidth=1.2)
        for name, row in rows.iterrows():
            clear = row["low"] > 0 or row["high"] < 0
            look: dict[str, Any] = {"color": style.CLEAR if clear else style.PALE, "linewidth": 2.2}
            axes.plot([row["low"], row["high"]], [names.index(str(name))] * 2, **look)
            axes.plot(row["value"], names.index(str(name)), "o", color=look["color"], markersize=7)
        axes.set_title(textwrap.fill(conclusion, 14 if width >= style.WIDTH else 18))
        axes.set_xlabel("difference\nin mean reward")
        axes.xaxis.set_major_locator(MaxNLocator(3))
        if usual is not None:
            others = rows.drop(index="default")
            same = int((np.sign(others["value"]) == np.sign(usual["value"])).sum())
            found = Interval(usual["value"], usual["low"], usual["high"], int(usual["n"]))
            count = f"of the same sign under {same} of {len(others)} other choices"
            said.append(f"{conclusion} {style.said(found)} by default, {count}")
    least = table.groupby("switch")["n"].min()
    for axes in panels:
        style.name_rows(axes, [f"{name}, n = {least[name]:.0f}" for name in names])
    handles = [
        Line2D([], [], marker="o", color=style.CLEAR, linewidth=2, label="95 % interval without 0"),
        Line2D([], [], marker="o", color=style.PALE, linewidth=2, label="with 0"),
        Patch(color=style.CLEAR, alpha=0.15, label="the default's"),
    ]
    style.legend(figure, handles, 3)
    return style.Drawn(figure, f"{title}: {'; '.join(said) or f'{len(names)} choices, none of them the default'}.")


@matplotlib.rc_context(style.STYLE)
def power(table: pd.DataFrame, n: int, most: int = 10_000, width: float = style.WIDTH) -> style.Drawn:
    """Seeds a cell that find the paper's difference of two cells in 80 % of studies: a row a pair, the easiest first.

    table: columns pair and seeds (infinite: there is no difference; NaN: not known); n: seeds that there are; most:
    beyond it a number is drawn as an arrow; width: of the figure [inches].
    """
    title = "Seeds a cell to find the paper's difference\n(80 % power, t test at 5 %)"
    if not len(table):
        return style.nothing(title.replace("\n", " "))
    table = table.sort_values("seeds", kind="stable", na_position="last", ignore_index=True)
    seeds = table["seeds"].to_numpy(dtype=np.float64)
    finite, endless, unknown = np.isfinite(seeds), np.isposinf(seeds), np.isnan(seeds)
    figure, axes = style.panel(title, 0.27 * len(table) + 1.7, width)
    drawn, rows = np.minimum(seeds, most), np.arange(len(table))
    words_look: dict[str, Any] = {"va": "center", "fontsize": 11, "zorder": 4}
    words_look["bbox"] = {"facecolor": "white", "linewidth": 0, "pad": 1}
    within = finite & (seeds <= n)
    for some, colour in ((within, style.CLEAR), (finite & ~within, style.OPEN)):
        axes.hlines(rows[some], 1, drawn[some], color=colour, linewidth=1.2, alpha=0.5)
        for marker, beyond in (("o", seeds <= most), (">", seeds > most)):
            axes.plot(drawn[some & beyond], rows[some & beyond], marker, color=colour, markersize=6)
        for row in rows[some]:
            words = f"{seeds[row]:,.0f}" if seeds[row] <= most else f"> {most:,}"
            place = (drawn[row], row)
            axes.annotate(words, place, (8, 0), textcoords="offset points", color=style.INK, **words_look)
    for some, words in ((endless, "no difference seen: no number would do"), (unknown, "not known")):
        for row in rows[some]:
            axes.text(1.12, row, words, color=style.PALE, style="italic", **words_look)
    axes.set(xscale="log", xlim=(1, 4 * max([*drawn[finite], n, 10])), xlabel="seeds a cell")
    axes.xaxis.set_major_locator(LogLocator(10))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    style.name_rows(axes, list(table["pair"]), fontsize=11)
    axes.axvline(n, **style.DASHED, label=f"seeds that there are: {n}")
    style.legend(figure, axes.get_legend_handles_labels()[0])
    said = [f"no difference seen in {int(endless.sum())}"] * bool(endless.any())
    said += [f"not known of {int(unknown.sum())}"] * bool(unknown.any())
    if finite.any():
        told = [f"{one:,.0f}" if one <= most else f"more than {most:,}" for one in (*seeds, np.median(seeds[finite]))]
        first, last = (f"{table['pair'][row]} {told[row]}" for row in (0, int(finite.sum()) - 1))
        said = [f"from {first} to {last}, median {told[-1]}", *said]
    said.append(f"of {len(table)} pairs {int(within.sum())} need no more than the {n} that there are")
    return style.Drawn(figure, f"{title}: {'; '.join(said)}.".replace("\n", " "))


@matplotlib.rc_context(style.STYLE)
def speed(table: pd.DataFrame, width: float = style.WIDTH) -> style.Drawn:
    """Wall time of a million frames of one seed, a row a cell, and the distance to the paper's ten hours.

    table: columns cell, seconds and seeds (side by side in that run, which share its time alike), a row a run;
    width: of the figure [inches].
    """
    title = "Wall time of a million frames of one seed"
    known = table[np.isfinite(table["seconds"]) & (table["seconds"] > 0)] if len(table) else table
    if not len(known):
        return style.nothing(title)
    beside = " to ".join(f"{n}" for n in dict.fromkeys([known["seeds"].min(), known["seeds"].max()]))
    title += f":\nits share of a run of {beside} side by side"
    groups = known.groupby("cell", sort=False)["seconds"]
    hours = groups.mean() / 3600
    figure, axes = style.panel(title, 0.42 * len(hours) + 1.6, width)
    said = []
    for row, (name, value) in enumerate(hours.items()):
        ((colour, _),) = style.looks([style.parts(str(name))[1]])
        axes.plot([value, paper.HOURS], [row, row], color=colour, linewidth=6, alpha=0.3, solid_capstyle="butt")
        axes.plot(groups.get_group(name) / 3600, [row] * len(groups.get_group(name)), "o", color=colour, markersize=4)
        axes.plot(value, row, "o", color=colour, markersize=9)
        ratio = paper.HOURS / value
        times = f"{_plain(ratio)} × faster" if ratio >= 1 else f"{_plain(1 / ratio)} × slower"
        behind = {"facecolor": "white", "linewidth": 0, "pad": 1.5}
        axes.text(np.sqrt(value * paper.HOURS), row, f"{_time(value)}: {times}", ha="center", va="center", bbox=behind)
        said.append(f"{name} {_time(value)}")
    axes.axvline(paper.HOURS, **style.DASHED, label=f"the paper: about {paper.HOURS:g} hours")
    axes.set(xscale="log", xlim=(min(hours.min(), paper.HOURS) / 1.6, max(hours.max(), paper.HOURS) * 1.6))
    ticks = {1 / 60: "1 min", 1 / 20: "3 min", 1 / 6: "10 min", 0.5: "30 min", 1.0: "1 h", 3.0: "3 h", 10.0: "10 h"}
    low, high = axes.get_xlim()
    few = 1 if width >= style.WIDTH else 2
    shown = {place: words for place, words in [*ticks.items()][::few] if low <= place <= high}
    axes.set_xticks(list(shown), list(shown.values()))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("wall time (logarithmic)")
    style.name_rows(axes, list(hours.index))
    style.legend(figure, axes.get_legend_handles_labels()[0])
    alt = f"{title}: {', '.join(said)}; the paper took about {paper.HOURS:g} hours."
    return style.Drawn(figure, alt.replace("\n", " "))


def _plain(ratio: float) -> str:
    return f"{ratio:,.0f}" if ratio >= 10 else f"{ratio:.2g}"


def _time(hours: float) -> str:
    if hours * 60 < 1:
        return f"{3600 * hours:.0f} s"
    return f"{60 * hours:.3g} min" if hours < 1 else f"{hours:.3g} h"
