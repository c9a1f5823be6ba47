"""Figures of configurations: metrics with their seeds, effects and the paper's, learning curves, survival.

Every function takes plain data and returns a figure with its words. Letters: S seeds of a configuration, B
bins of frames.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, PercentFormatter, StrMethodFormatter
from scipy import special

from uavnav import stats, style
from uavnav.report.configurations import Configuration
from uavnav.runs.definitions import LOG_CURVE, PER_FRAME, words
from uavnav.stats import Array, Interval


@matplotlib.rc_context(style.STYLE)
def intervals(
    rows: Mapping[str, Array],
    printed: Mapping[str, float],
    axis: str,
    scripted: float = np.nan,
    width: float = style.WIDTH,
) -> style.Drawn:
    """A metric's seeds, mean, 95 % interval, interquartile mean and the paper's value: a row a configuration.

    rows: label -> [S]; printed: label -> the paper's value; axis: the metric with its unit; scripted: what
    the scripted policy reaches; width: [inches]. The algorithms share a scale unless one would have less than
    a fifth of it.
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
        for row, (name, (colour, _)) in enumerate(style.of_activations(members).items()):
            seeds = rows[name]
            found = style.row_of_seeds(axes, row, seeds, colour)
            middle = stats.interquartile_mean(np.sort(seeds[np.isfinite(seeds)])) if found.n else np.nan
            axes.plot(middle, row, "|", color=style.INK, markersize=16, markeredgewidth=2, zorder=4)
            theirs = printed.get(name, np.nan)
            axes.plot(theirs, row, "D", color="white", markeredgecolor=style.INK, markersize=8, zorder=5)
            beside = f"the paper's {style.number(theirs)}" if name in printed else ""
            said.append(f"{name} {style.said(found, beside)}")
        style.name_rows(axes, [f"{name.split(' ', 1)[-1]}, n = {len(rows[name])}" for name in members])
        if np.isfinite(scripted):
            axes.axvline(scripted, **style.SCRIPTED_LINE)
        axes.set_title(group + ("" if share else ", on its own scale"))
    panels[-1].set_xlabel(axis)
    handles = [
        Line2D([], [], marker="o", markersize=9, color=style.INK, label="mean, 95 % interval"),
        style.mark("|", "interquartile mean", markersize=14, markeredgewidth=2),
        style.mark("o", "a seed", markersize=5, alpha=0.5),
        *[style.mark("D", "the paper", markersize=8, markerfacecolor="white")] * bool(printed),
        *[style.scripted_mark()] * bool(np.isfinite(scripted)),
    ]
    style.legend(figure, handles, 3)
    beside = f"; {style.SCRIPTED_NAME} {style.number(scripted)}" if np.isfinite(scripted) else ""
    return style.Drawn(figure, f"{axis}, mean over seeds: {'; '.join(said)}{beside}.")


@matplotlib.rc_context(style.STYLE)
def episodes(
    rows: Mapping[str, tuple[Array, Interval]],
    looks: Mapping[str, tuple[str, str]],
    scripted: float,
    axis: str,
    width: float = style.WIDTH,
) -> style.Drawn:
    """What the scripted policy and others reach on test episodes: a row each, the best first.

    rows: label -> one number a seed, or an episode, [S], and their mean; looks: label -> a colour and a line;
    scripted: what the scripted policy reaches; axis: the metric in words; width: [inches].
    """
    if not rows:
        return style.nothing(axis)
    values = {name: found.value for name, (_, found) in rows.items()}
    values |= {style.SCRIPTED_NAME: scripted} if np.isfinite(scripted) else {}
    order = sorted(values, key=lambda name: -values[name])
    small = max(map(abs, values.values())) < 100
    numbers = [style.number(values[name]) if small else f"{values[name]:,.0f}" for name in order]
    spelled = [style.spelled(name) for name in order]
    named = [style.wrapped(f"{name}  {number}") for name, number in zip(spelled, numbers, strict=True)]
    lines = 1 + max(name.count("\n") for name in named)
    figure = Figure(figsize=(width, 0.24 * lines * len(order) + 0.55), layout="constrained")
    axes, said = figure.subplots(), []
    for row, name in enumerate(order):
        if name == style.SCRIPTED_NAME:
            axes.axvline(scripted, **style.SCRIPTED_LINE)
            axes.plot(scripted, row, "D", color=style.SCRIPTED, markersize=8)
            said.append(f"{style.SCRIPTED_NAME} {style.number(scripted)}")
        else:
            found = style.row_of_seeds(axes, row, rows[name][0], looks[name][0], rows[name][1])
            said.append(f"{name} {style.said(found)}")
    style.name_rows(axes, named)
    axes.set_xlabel(axis)
    places = np.concatenate([list(values.values()), *(seeds for seeds, _ in rows.values())])
    axes.set_xlim(style.legible(places, axes.get_xlim()))  # the seeds, not the intervals of a few
    return style.Drawn(figure, f"{axis}: {'; '.join(said)}.")


def panels(
    count: int, columns: int, height: float, width: float, sharex: bool = False, sharey: bool = False
) -> tuple[Figure, list[Axes]]:
    """A figure of so many panels, in rows of some columns; height: of a panel; width: of all [inches]."""
    rows = -(-count // columns)
    figure = Figure(figsize=(width, height * rows + 0.6), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharex=sharex, sharey=sharey).ravel()
    for axes in grid[count:]:
        axes.set_visible(False)
    return figure, list(grid[:count])


def errors(rows: pd.DataFrame) -> Array:
    """The lengths of the intervals of a table's `value` below and above it: [2, rows]; 0 without one."""
    lengths = np.abs(rows[["low", "high"]].to_numpy().T - rows["value"].to_numpy())
    return np.asarray(np.nan_to_num(lengths))


SWITCHED = ("o", style.INK), ("D", style.CLEAR)
"""Marks and colours of what is off and on."""


def switched(
    figure: Figure,
    grid: Sequence[Axes],
    panels: Mapping[str, pd.DataFrame],
    row: str,
    switch: str,
    words: Mapping[bool, str],
    axis: str,
    names: Sequence[str] = (),
) -> None:
    """Values with their intervals: a row a value of one column, off and on of another column side by side.

    panels: by title, in the order of grid; words: for off and on; axis: the value in words; names: the
    rows of all panels, by default those of each.
    """
    for axes, (title, table) in zip(grid, panels.items(), strict=True):
        rows = [*(names or dict.fromkeys(table[row]))]
        for on, part in table.groupby(switch):
            marker, colour = SWITCHED[bool(on)]
            at = part[row].map(rows.index) + (0.15 if on else -0.15)
            axes.errorbar(part["value"], at, xerr=errors(part), fmt=marker, color=colour, capsize=3)
        style.name_rows(axes, [style.spelled(name).replace("_", " ") for name in rows])
        axes.set(title=title, xlabel=axis)
    looks = [(*SWITCHED[bool(on)], label) for on, label in words.items()]
    style.legend(figure, [style.mark(mark, label, markerfacecolor=one) for mark, one, label in looks])


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
            look["markerfacecolor"] = "white" if place else None
            axes.plot(ratio, row, "o", markersize=8, markeredgewidth=1.8, zorder=4, **look)
        said.append(f"{name}, {column}: {style.said(Interval(ratio, low, high, 1)).replace('; n = 1', '')}")
    axes.set_xlim(-FARTHEST, FARTHEST)
    style.name_rows(axes, names)
    if width < style.WIDTH:
        axes.set_yticks(range(len(names)), [textwrap.fill(name, 17) for name in names])
    axes.set_xlabel("our effect ÷ the paper's")
    handles = [
        style.mark("o", column, markersize=8, markeredgewidth=1.8, markerfacecolor="white" if place else None)
        for place, column in enumerate(columns)
    ]
    handles.append(Line2D([], [], color=style.PALE, linewidth=2.2, label="does not count"))
    style.legend(figure, handles, 3)
    return style.Drawn(figure, f"{title}: {'; '.join(said)}.")


@matplotlib.rc_context(style.STYLE)
def curves(
    configurations: Mapping[str, Configuration],
    printed: Mapping[str, float],
    title: str = "",
    width: float = style.WIDTH,
    looks: Mapping[str, tuple[str, str]] | None = None,
    scripted: float = np.nan,
    definition: str = PER_FRAME,
) -> style.Drawn:
    """Learning curves: a line and a band each, the paper's mean dashed; its figures 4 and 5 by `LOG_CURVE`.

    configurations: by label; printed: the paper's mean by label; width: [inches]; looks: a colour and a line
    by label, or else by activation; scripted: what the scripted policy earns per frame.
    """
    metric = words("reward", definition)
    title = f"{title}{metric} in training"
    if not any(len(one.episodes) for one in configurations.values()):
        return style.nothing(title)
    figure, axes = style.panel(title, width=width)
    ends, several = [], False
    looks = looks or style.of_activations(configurations)
    for name, configuration in configurations.items():
        seeds = configuration.logged if definition == LOG_CURVE else configuration.curve
        line, (colour, dashes) = band(seeds), looks[name]
        legend = textwrap.fill(f"{name}, n = {len(seeds.columns)}", 50)
        axes.plot(line.index, line["mean"], dashes, marker=".", color=colour, linewidth=1.8, label=legend)
        _shade(axes, line, colour)
        several |= len(seeds.columns) > 1
        if name in printed:
            axes.axhline(printed[name], color=colour, linestyle="--", linewidth=1)
        beside = f"the paper's mean {style.number(printed[name])}" if name in printed else ""
        end = Interval(*line.iloc[-1]) if len(line) else Interval(np.nan, np.nan, np.nan, 0)
        ends.append(f"{name} {style.said(end._replace(n=int(end.n)), beside)}")
    if np.isfinite(scripted):
        axes.axhline(scripted, label=style.SCRIPTED_NAME, **style.SCRIPTED_LINE)
    style.keep_lines_legible(axes)
    axes.set_ylabel(metric)
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:,g}"))
    _name_dashes(axes, printed, looks)
    axes.set_xlabel("frames per seed")
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.xaxis.set_major_locator(MaxNLocator(6 if width >= style.WIDTH else 3))
    handles = [
        *axes.get_legend_handles_labels()[0],
        *[Line2D([], [], color=style.PALE, linewidth=8, alpha=0.4, label="95 % interval over seeds")]
        * several,
        *[Line2D([], [], color=style.PALE, linestyle="--", label="the paper's mean")] * bool(printed),
    ]
    style.legend(figure, handles, 3)
    return style.Drawn(figure, f"{title} against frames per seed; in the last bin: {'; '.join(ends)}.")


def _name_dashes(axes: Axes, printed: Mapping[str, float], looks: Mapping[str, tuple[str, str]]) -> None:
    """The paper's means at the right end of their lines, in their colours, none over another."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high)
    means = sorted((mean, name) for name, mean in printed.items())
    for (mean, name), place in zip(
        means, _apart([(mean - low) / (high - low) for mean, _ in means], 0.055), strict=True
    ):
        axes.annotate(
            f"{style.spelled(name)} {style.number(mean)}",
            (1, mean),
            (1.06, place),
            xycoords=axes.get_yaxis_transform(),
            textcoords="axes fraction",
            color=looks[name][0],
            fontsize=11,
            va="center",
            annotation_clip=False,
            arrowprops={
                "arrowstyle": "-",
                "color": looks[name][0],
                "linewidth": 0.8,
                "shrinkA": 1,
                "shrinkB": 0,
            },
        )


def _apart(places: Sequence[float], gap: float) -> list[float]:
    """Ascending places, moved as little as may be until each is a gap from the next."""
    moved = list(places)
    for _ in range(100):
        for below in range(len(moved) - 1):
            lack = gap - (moved[below + 1] - moved[below])
            if lack > 0:
                moved[below] -= lack / 2
                moved[below + 1] += lack / 2
    return moved


def band(seeds: pd.DataFrame) -> pd.DataFrame:
    """Mean, low, high and n a bin [B] of values [B, S]: Student's interval; NaN without two seeds."""
    known = seeds.where(np.isfinite(seeds))
    mean, n = known.mean(axis=1), known.count(axis=1)
    half = special.stdtrit((n - 1).clip(1), stats.TAILS[1]) * known.sem(axis=1)
    return pd.DataFrame({"mean": mean, "low": mean - half, "high": mean + half, "n": n})


def _shade(axes: Axes, line: pd.DataFrame, colour: str) -> None:
    """The interval of a curve, where it is known."""
    known = line["low"].notna()
    if known.any():
        axes.fill_between(
            line.index.to_numpy(), line["low"], line["high"], color=colour, alpha=0.2, linewidth=0
        )
    alone = line[known & ~known.shift(fill_value=False) & ~known.shift(-1, fill_value=False)]
    if len(alone):  # a band has no width there
        axes.vlines(alone.index.to_numpy(), alone["low"], alone["high"], color=colour, alpha=0.2, linewidth=6)


@matplotlib.rc_context(style.STYLE)
def survival(
    curves: Mapping[str, pd.Series[float]],
    limit: int,
    width: float = style.WIDTH,
    looks: Mapping[str, tuple[str, str]] | None = None,
) -> style.Drawn:
    """Kaplan and Meier's share of test episodes that last longer, against steps: a line a configuration.

    curves: label -> shares by steps, as of `stats.survival`; limit: where episodes end [steps]; width:
    [inches]; looks: a colour and a line by label, or else by activation.
    """
    title = "Test episodes that last longer"
    curves = {name: shares for name, shares in curves.items() if len(shares)}
    if not curves:
        return style.nothing(title)
    figure, axes = style.panel(title, width=width)
    most, said = max(float(shares.index.max()) for shares in curves.values()), []
    looks = looks or style.of_activations(curves)
    for name, shares in curves.items():
        colour, dashes = looks[name]
        seen = (shares * 500).round().diff().ne(0)  # finer steps are less than a pixel high
        seen.iloc[[0, -1]] = True
        look = (
            {"color": colour, "linestyle": dashes, "linewidth": 1.8}
            if name != style.SCRIPTED_NAME
            else style.SCRIPTED_LINE
        )
        axes.step(seen.index[seen], shares[seen], where="post", label=name, **look)
        over = shares.index[shares <= 0.5]
        half = f"half of them after {over[0]:,.0f} steps" if len(over) else "half of them never"
        said.append(f"{name} {half}, {100 * shares.iloc[-1]:.0f} % open at {shares.index[-1]:,.0f}")
    axes.axvline(limit, **style.DASHED)
    words, corner = f"time limit{f': {limit:,} steps' * (width >= style.WIDTH)} ", axes.get_xaxis_transform()
    axes.annotate(
        words, (limit, 0.98), xycoords=corner, color=style.INK, fontsize=11, rotation=90, va="top", ha="right"
    )
    axes.set_xscale("log")
    first = [float(shares.index[(shares < 1) & (shares.index > 0)].min()) for shares in curves.values()]
    axes.set_xlim(max(np.nanmin([*first, most]) * 0.8, 1.0), max(most, limit) * 1.1)
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set(xlabel="steps", ylabel="episodes that last longer [%]", ylim=(0, 1.02))
    style.legend(figure, axes.get_legend_handles_labels()[0])
    return style.Drawn(figure, f"{title}, against steps: {'; '.join(said)}.")
