"""Figures of configurations side by side: metrics with their seeds, and effects beside the paper's.

Every function takes plain data and returns a figure with its words. Letters: S seeds of a configuration.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from uavnav import stats, style
from uavnav.stats import Array, Interval


@matplotlib.rc_context(style.STYLE)
def intervals(
    rows: Mapping[str, Array],
    printed: Mapping[str, float],
    axis: str,
    rule: float = np.nan,
    width: float = style.WIDTH,
) -> style.Drawn:
    """A metric's seeds, mean, 95 % interval, interquartile mean and the paper's value: a row a configuration.

    rows: label -> [S]; printed: label -> the paper's value; axis: the metric with its unit; rule: what the
    scripted policy reaches; width: [inches]. The algorithms share a scale unless one would have less than a
    fifth of it.
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
            axes.axvline(rule, **style.RULED)
        axes.set_title(group + ("" if share else ", on its own scale"))
    panels[-1].set_xlabel(axis)
    handles = [
        Line2D([], [], marker="o", markersize=9, color=style.INK, label="mean, 95 % interval"),
        style.mark("|", "interquartile mean", markersize=14, markeredgewidth=2),
        style.mark("o", "a seed", markersize=5, alpha=0.5),
        *[style.mark("D", "the paper", markersize=8, markerfacecolor="white")] * bool(printed),
        *[Line2D([], [], label=style.RULE, **style.RULED)] * bool(np.isfinite(rule)),
    ]
    style.legend(figure, handles, 3)
    beside = f"; {style.RULE} {style.number(rule)}" if np.isfinite(rule) else ""
    return style.Drawn(figure, f"{axis}, mean over seeds: {'; '.join(said)}{beside}.")


@matplotlib.rc_context(style.STYLE)
def episodes(
    rows: Mapping[str, tuple[Array, Interval]],
    looks: Mapping[str, tuple[str, str]],
    rule: float,
    axis: str,
    width: float = style.WIDTH,
) -> style.Drawn:
    """What the scripted policy and others reach on test episodes: a row each, the best first.

    rows: label -> one number a seed, or an episode, [S], and their mean; looks: label -> a colour and a line;
    rule: what the scripted policy reaches; axis: the metric in words; width: [inches].
    """
    if not rows:
        return style.nothing(axis)
    values = {name: found.value for name, (_, found) in rows.items()}
    values |= {style.RULE: rule} if np.isfinite(rule) else {}
    order = sorted(values, key=lambda name: -values[name])
    small = max(map(abs, values.values())) < 100
    numbers = [style.number(values[name]) if small else f"{values[name]:,.0f}" for name in order]
    shown = [name.replace("leaky_relu", "leaky relu") for name in order]
    named = [style.wrapped(f"{name}  {number}") for name, number in zip(shown, numbers, strict=True)]
    lines = 1 + max(name.count("\n") for name in named)
    figure = Figure(figsize=(width, 0.24 * lines * len(order) + 0.55), layout="constrained")
    axes, said = figure.subplots(), []
    for row, name in enumerate(order):
        if name == style.RULE:
            axes.axvline(rule, **style.RULED)
            axes.plot(rule, row, "D", color=style.SCRIPTED, markersize=8)
            said.append(f"{style.RULE} {style.number(rule)}")
        else:
            found = style.row_of_seeds(axes, row, rows[name][0], looks[name][0], rows[name][1])
            said.append(f"{name} {style.said(found)}")
    style.name_rows(axes, named)
    axes.set_xlabel(axis)
    return style.Drawn(figure, f"{axis}: {'; '.join(said)}.")


FARTHEST = 2.0
"""A forest plot ends at so many times the paper's effect, on both sides."""


@matplotlib.rc_context(style.STYLE)
def forest(table: pd.DataFrame, width: float = style.WIDTH) -> style.Drawn:
    """Our effects ÷ the paper's: a row each, in it a mark for each column of evidence, the first one filled.

    table: columns row, column, ratio, low, high, counts (else grey); an arrow leads beyond `FARTHEST`.
    """
    title = "Our effect ÷ the paper's"
    if not table["ratio"].notna().any():
        return style.nothing(title)
    names, columns = list(dict.fromkeys(table["row"])), list(dict.fromkeys(table["column"]))
    figure = Figure(figsize=(width, 0.55 * len(names) + 1.5), layout="constrained")
    axes, said = figure.subplots(), []
    axes.axvline(0, color=style.INK, linewidth=1.2)
    axes.axvline(1, **style.DASHED)
    for name, column, ratio, low, high, counts in table.itertuples(index=False):
        place = columns.index(column)
        row = names.index(name) + 0.36 * (place - (len(columns) - 1) / 2)
        look: dict[str, Any] = {"color": style.CLEAR if counts else style.PALE}
        ends = np.clip([low, high], -FARTHEST, FARTHEST)
        axes.plot(ends, [row, row], linewidth=2.2, solid_capstyle="butt", **look)
        for side, end, marker in ((-1, low, "<"), (1, high, ">")):
            if side * end > FARTHEST:
                axes.plot(side * FARTHEST, row, marker, markersize=8, clip_on=False, **look)
        if abs(ratio) <= FARTHEST:
            inside: dict[str, Any] = {"markerfacecolor": "white"} if place else {}
            axes.plot(ratio, row, "o", markersize=8, markeredgewidth=1.8, zorder=4, **look, **inside)
        said.append(f"{name}, {column}: {style.said(Interval(ratio, low, high, 1)).replace('; n = 1', '')}")
    axes.set_xlim(-FARTHEST, FARTHEST)
    style.name_rows(axes, names)
    if width < style.WIDTH:
        axes.set_yticks(range(len(names)), [textwrap.fill(name, 17) for name in names])
    axes.set_xlabel("our effect ÷ the paper's")
    handles = [
        style.mark(
            "o", column, markersize=8, markeredgewidth=1.8, **({"markerfacecolor": "white"} if place else {})
        )
        for place, column in enumerate(columns)
    ]
    handles.append(Line2D([], [], color=style.PALE, linewidth=2.2, label="does not count"))
    style.legend(figure, handles, 3)
    return style.Drawn(figure, f"{title}: {'; '.join(said)}.")
