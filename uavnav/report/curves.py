"""Figures of lines: learning curves, diagnostics of networks over training, flights still up over steps.

Every function takes plain data and returns a figure with its words. Letters: S seeds of a cell, B bins of frames.
"""

from __future__ import annotations

import functools
import textwrap
from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, PercentFormatter, StrMethodFormatter

from uavnav import stats, style
from uavnav.report.cells import Cell, curve
from uavnav.runs import paper
from uavnav.runs.readings import PER_FRAME, words
from uavnav.stats import Array, Interval

RESAMPLES = 1_000
"""Bootstrap draws of the band of a curve."""
LINES = {"reward": "mean over seeds", "steps": "all seeds' frames over all their collisions"}
"""What a learning curve shows, by its column."""


@matplotlib.rc_context(style.STYLE)
def curves(cells: Sequence[Cell], column: str, width: float = style.WIDTH) -> style.Drawn:
    """Learning curves of one algorithm, as the paper's figures 4 and 5: a line a cell, a band, the paper's mean dashed.

    cells: labelled ones of one algorithm; column: one of `LINES`; width: of the figure [inches].
    """
    title = ": ".join([*{cell.algorithm.upper(): cell for cell in cells}, f"{words(column, PER_FRAME)} in training"])
    if not any(len(cell.episodes) for cell in cells):
        return style.nothing(title)
    figure, axes = style.panel(title, width=width)
    lines = plot(axes, cells, column)
    _name_dashes(axes, cells, column)
    _over_training(figure, axes, [Line2D([], [], color=style.PALE, linestyle="--", label="the paper's mean")])
    ends = []
    for cell, line in zip(cells, lines, strict=True):
        printed = paper.printed(cell.algorithm, cell.activation, column, per_frame=True)
        beside = "" if np.isnan(printed) else f"the paper's mean {style.number(printed)}"
        ends.append(f"{cell.label or cell.activation} {_end(line, beside)}")
    return style.Drawn(figure, f"{title} against frames per seed; in the last bin: {'; '.join(ends)}.")


def plot(axes: Axes, cells: Sequence[Cell], column: str) -> list[pd.DataFrame]:
    """One panel: a metric's curves in their activations' colours, and the paper's means; returns what `band` gives."""
    lines: list[pd.DataFrame] = []
    seen: set[str] = set()
    for cell, (colour, dashes) in zip(cells, style.looks(cell.activation for cell in cells), strict=True):
        lines.append(learning(cell, column))
        n = sum(len(run.seeds) for run in cell.runs)
        _line(axes, lines[-1], colour, dashes, f"{cell.label or cell.activation}, n = {n}")
        printed = paper.printed(cell.algorithm, cell.activation, column, per_frame=True)
        if np.isfinite(printed) and cell.activation not in seen:
            axes.axhline(printed, color=colour, linestyle="--", linewidth=1)
        seen.add(cell.activation)
    axes.set_ylabel(words(column, PER_FRAME))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:,g}"))
    return lines


@matplotlib.rc_context(style.STYLE)
def together(cells: Mapping[str, Cell], column: str) -> style.Drawn:
    """Learning curves of any cells, by name, without a word of the paper's; column: one of `LINES`."""
    title = f"{words(column, PER_FRAME)} in training"
    figure, axes = style.panel(title)
    ends = []
    for name, (colour, dashes) in style.coloured(cells):
        line = learning(cells[name], column)
        _line(axes, line, colour, dashes, f"{name}, n = {sum(len(run.seeds) for run in cells[name].runs)}")
        ends.append(f"{name} {_end(line)}")
    axes.set_ylabel(title.removesuffix(" in training"))
    _over_training(figure, axes)
    return style.Drawn(figure, f"{title} against frames per seed; in the last bin: {'; '.join(ends)}.")


def learning(cell: Cell, column: str) -> pd.DataFrame:
    """A cell's learning curve, as `band` gives it: one of `LINES`, in the reading *per frame*.

    Steps per collision are frames over collisions, of all seeds together: a seed that never collides counts too.
    """
    if column != "steps":
        return band(curve(cell, column))
    line = band(curve(cell, "terminated"))
    upside_down = 1 / line[["mean", "high", "low"]].where(lambda rate: rate > 0)  # NaN where nobody collided
    return line.assign(**dict(zip(("mean", "low", "high"), upside_down.to_numpy().T, strict=True)))


def _over_training(figure: Figure, axes: Axes, more: Sequence[Line2D] = ()) -> None:
    """The axis of frames, and a legend of the lines, their bands, and more."""
    axes.set_xlabel("frames per seed")
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.xaxis.set_major_locator(MaxNLocator(6 if figure.get_figwidth() >= style.WIDTH else 3))
    shade = Line2D([], [], color=style.PALE, linewidth=8, alpha=0.4, label="95 % interval over seeds")
    style.legend(figure, [*axes.get_legend_handles_labels()[0], shade, *more], 3)


def _name_dashes(axes: Axes, cells: Sequence[Cell], column: str) -> None:
    """The paper's means at the right end of their lines, in their colours, none over another."""
    named = {cell.activation: paper.printed(cell.algorithm, cell.activation, column, per_frame=True) for cell in cells}
    means = sorted((mean, activation) for activation, mean in named.items() if np.isfinite(mean))
    if not means:
        return
    low, high = axes.get_ylim()
    axes.set_ylim(low, high)
    places = _apart([(mean - low) / (high - low) for mean, _ in means], 0.055)
    colours = dict(zip(named, (colour for colour, _ in style.looks(named)), strict=True))
    for (mean, activation), place in zip(means, places, strict=True):
        axes.annotate(
            f"{activation} {style.number(mean)}",
            (1, mean),
            (1.06, place),
            xycoords=axes.get_yaxis_transform(),
            textcoords="axes fraction",
            color=colours[activation],
            fontsize=11,
            va="center",
            annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": colours[activation], "linewidth": 0.8, "shrinkA": 1, "shrinkB": 0},
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
    """Mean, low, high and n a bin [B] of values [B, S], by the percentile bootstrap over seeds.

    A bin leaves out the seeds without a value, and has no interval (NaN) from fewer than two.
    """
    values = seeds.to_numpy(dtype=np.float64)
    there = np.isfinite(values)
    filled, n = np.where(there, values, 0.0), values.shape[1]
    tail = (1 - stats.CONFIDENCE) / 2
    found = np.full((len(values), 3), np.nan)
    sums, counts = _draws(n) @ np.stack([filled, there]).transpose(0, 2, 1) if n else np.empty((2, 0, len(values)))
    for row, (own, known) in enumerate(zip(filled, there, strict=True)):
        if known.any():
            found[row, 0] = own[known].mean()
        if known.sum() > 1:
            drawn = counts[:, row] > 0
            means = sums[drawn, row] / counts[drawn, row]
            found[row, 1:] = np.quantile(means, [tail, 1 - tail])
    return pd.DataFrame(found, seeds.index, ["mean", "low", "high"]).assign(n=there.sum(1))


@functools.lru_cache(maxsize=2)
def _draws(n: int) -> Array:
    """How often each of n seeds is drawn: [RESAMPLES, n]."""
    drawn = np.random.default_rng(0).multinomial(n, np.full(n, 1 / n), size=RESAMPLES)
    return drawn.astype(np.float64)


def _line(axes: Axes, line: pd.DataFrame, colour: str, dashes: str, legend: str, width: float = 1.8) -> None:
    words = textwrap.fill(legend, 50)
    axes.plot(line.index, line["mean"], dashes, marker=".", color=colour, linewidth=width, label=words)
    known = line["low"].notna()
    if known.any():
        axes.fill_between(line.index.to_numpy(), line["low"], line["high"], color=colour, alpha=0.2, linewidth=0)
    alone = line[known & ~known.shift(fill_value=False) & ~known.shift(-1, fill_value=False)]
    if len(alone):  # a band has no width there
        axes.vlines(alone.index.to_numpy(), alone["low"], alone["high"], color=colour, alpha=0.2, linewidth=6)


def _end(line: pd.DataFrame, beside: str = "") -> str:
    if not len(line):
        return "no data"
    mean, low, high, n = line.iloc[-1]
    return style.said(Interval(mean, low, high, int(n)), beside)


@matplotlib.rc_context(style.STYLE)
def survival(curves: Mapping[str, pd.Series[float]], cap: int, width: float = style.WIDTH) -> style.Drawn:
    """Kaplan and Meier's share of test flights that are still up, against steps: a line a cell.

    curves: label -> shares, indexed by steps, as of `stats.survival`; cap: where flights were cut off [steps];
    width: of the figure [inches].
    """
    title = "Test flights that are still up"
    curves = {name: shares for name, shares in curves.items() if len(shares)}
    if not curves:
        return style.nothing(title)
    figure, axes = style.panel(title, width=width)
    most, said = max(float(shares.index.max()) for shares in curves.values()), []
    for name, (colour, dashes) in style.coloured(curves):
        shares = curves[name]
        seen = (shares * 500).round().diff().ne(0)  # finer steps are less than a pixel high
        seen.iloc[[0, -1]] = True
        look = {"color": colour, "linestyle": dashes, "linewidth": 1.8} if name != style.RULE else style.DASHED
        axes.step(seen.index[seen], shares[seen], where="post", label=name, **look)
        over = shares.index[shares <= 0.5]
        half = f"half of them after {over[0]:,.0f} steps" if len(over) else "half of them never"
        said.append(f"{name} {half}, {100 * shares.iloc[-1]:.0f} % up at {shares.index[-1]:,.0f}")
    axes.axvline(cap, **style.DASHED)
    words, corner = f"cap: {cap:,} steps ", axes.get_xaxis_transform()
    axes.annotate(words, (cap, 0.98), xycoords=corner, color=style.INK, fontsize=11, rotation=90, va="top", ha="right")
    axes.set_xscale("log")
    first = [float(shares.index[(shares < 1) & (shares.index > 0)].min()) for shares in curves.values()]
    axes.set_xlim(max(np.nanmin([*first, most]) * 0.8, 1.0), max(most, cap) * 1.1)
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set(xlabel="steps", ylabel="flights still up [%]", ylim=(0, 1.02))
    style.legend(figure, axes.get_legend_handles_labels()[0])
    return style.Drawn(figure, f"{title}, against steps: {'; '.join(said)}.")
