"""Figures, each saying one thing: axes with units, n, the paper's value, colours for colour-blind readers too."""

from __future__ import annotations

import io
import textwrap
from collections import Counter

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from uavnav import paper
from uavnav.report.cells import Cell, curve

CURVES = {"reward": "reward per episode", "steps": "steps per episode"}
COLOURS = {"tanh": "#0072B2", "sigmoid": "#D55E00", "relu": "#009E73", "leaky_relu": "#CC79A7"}
OTHER_COLOURS = ("#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's, without the yellow."""
LINES = ("-", ":", "-.")
"""Of the cells of one activation; dashes are the paper's."""


def draw(cells: list[Cell]) -> bytes:
    """A PNG of one algorithm's learning curves: a line a cell, a band from the lowest to the highest seed."""
    figure = Figure(figsize=(8, 7), dpi=120, layout="constrained")
    panels = figure.subplots(len(CURVES), 1, sharex=True)
    for axes, column in zip(panels, CURVES, strict=True):
        plot(axes, cells, column)
    panels[-1].set_xlabel("frames per seed")
    panels[-1].xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    panels[-1].xaxis.set_major_locator(MaxNLocator(6))
    dashed = Line2D([], [], color="grey", linestyle="--", linewidth=1, label="the paper's mean, in each colour")
    handles = [*panels[0].get_legend_handles_labels()[0], dashed]
    figure.legend(handles=handles, loc="outside upper center", ncols=2, frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def plot(axes: Axes, cells: list[Cell], column: str) -> None:
    """One panel: a metric's curves in their activations' colours, and the paper's means."""
    others = sorted({cell.activation for cell in cells}.difference(COLOURS))
    colours = COLOURS | {name: OTHER_COLOURS[place % len(OTHER_COLOURS)] for place, name in enumerate(others)}
    drawn: Counter[str] = Counter()
    for cell in cells:
        seeds, colour, style = curve(cell, column), colours[cell.activation], LINES[drawn[cell.activation] % len(LINES)]
        legend = textwrap.fill(f"{cell.label}, n = {sum(len(run.seeds) for run in cell.runs)}", 50)
        axes.plot(seeds.index, seeds.mean(axis=1), style, marker=".", color=colour, linewidth=1.5, label=legend)
        axes.fill_between(seeds.index, seeds.min(axis=1), seeds.max(axis=1), color=colour, alpha=0.2, linewidth=0)
        printed = paper.TABLES.get((cell.algorithm, cell.activation))
        if printed and not drawn[cell.activation]:
            axes.axhline(printed[column], color=colour, linestyle="--", linewidth=1)
        drawn[cell.activation] += 1
    axes.set_ylabel(CURVES[column])
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:,g}"))
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)


def describe(cells: list[Cell]) -> str:
    """The figure in words: where each line ends."""
    ends = []
    for cell in cells:
        last = {column: curve(cell, column).mean(axis=1).tail(1) for column in CURVES}
        ends.append(f"{cell.label} " + ", ".join(f"{name} {value:,.1f}" for name, end in last.items() for value in end))
    return f"{' and '.join(CURVES.values())} in training against frames per seed, in the last bin: {'; '.join(ends)}"
