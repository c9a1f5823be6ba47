"""How time and memory grow with seeds, parallel worlds and hidden width: what is run, the figure and its table."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from uavnav.bench.jobs import WHOLE, Result

AXES = {
    "seeds": [1, 2, 5, 10, 20, 40],
    "worlds": [4, 16, 64, 256],
    "width": [16, 64, 256, 1024],
}
"""What is varied; all else stays as in the preset `paper` with one seed."""
BASE = {"seeds": 1, "worlds": 16, "width": 64}
LABELS = {"seeds": "seeds", "worlds": "parallel worlds a seed", "width": "units in each hidden layer"}
BUFFER = 20_000
"""Frames a seed of DQN's buffer here, which is full when it begins to learn."""
SECONDS = 12.0
STYLES = {"ppo": ("#0072B2", "o"), "dqn": ("#D55E00", "s")}


class Point(NamedTuple):
    """A run whose time and memory are measured."""

    algorithm: str
    axis: str
    x: int

    @property
    def name(self) -> str:
        return f"{self.algorithm}/{self.axis}/{self.x}"

    @property
    def arguments(self) -> Result:
        """Of the job `ours`."""
        at = BASE | {self.axis: self.x}
        settings = {"n_seeds": at["seeds"], "n_worlds": at["worlds"], "hidden": [at["width"]] * 2}
        if self.algorithm == "dqn":
            settings |= {"buffer_size": BUFFER, "learning_starts": BUFFER}
        return {"algorithm": self.algorithm, "frames": WHOLE, "seconds": SECONDS, **settings}


def points() -> list[Point]:
    """Every point of both algorithms; what is common to the axes is run for each."""
    return [Point(algorithm, axis, x) for algorithm in STYLES for axis, xs in AXES.items() for x in xs]


def series(rows: dict[Point, Result], algorithm: str, axis: str) -> list[tuple[int, float, float]]:
    """x, minutes for 1 M frames a seed at the steady rate, and peak memory [GB], along an axis."""
    own = sorted(
        (point.x, found) for point, found in rows.items() if (point.algorithm, point.axis) == (algorithm, axis)
    )
    return [(x, WHOLE / found["rate"] / 60, max(found["peak"], found.get("tree", 0.0))) for x, found in own]


def steepest(pairs: list[tuple[float, float]]) -> float:
    """The largest exponent between neighbours on logarithmic axes: 1 is linear growth."""
    return max((math.log(b[1] / a[1]) / math.log(b[0] / a[0]) for a, b in pairwise(pairs)), default=math.nan)


def draw(rows: dict[Point, Result]) -> Figure:
    """Time above, memory below, against each axis; a dotted line is linear growth."""
    figure = Figure(figsize=(11, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, len(AXES), sharex="col", squeeze=False)
    units = ("time for 1 M frames a seed [min]", "peak memory [GB]")
    for (row, unit), (column, axis) in ((a, b) for a in enumerate(units) for b in enumerate(AXES)):
        panel = panels[row][column]
        for algorithm, (colour, marker) in STYLES.items():
            found = series(rows, algorithm, axis)
            xs, ys = [one[0] for one in found], [one[1 + row] for one in found]
            panel.plot(xs, ys, color=colour, marker=marker, label=algorithm.upper())
            if found:
                panel.plot(xs, [ys[0] * x / xs[0] for x in xs], ":", color=colour, lw=1)
        panel.set_xscale("log", base=2)
        panel.set_yscale("log")
        panel.set_xticks(AXES[axis], [str(x) for x in AXES[axis]])
        if row:
            panel.set_xlabel(LABELS[axis])
        if not column:
            panel.set_ylabel(unit)
    panels[0][0].legend()
    return figure


def section(rows: dict[Point, Result], figure: str) -> list[str]:
    """The figure, and its numbers in Markdown."""
    lines = [
        "Time for 1,000,000 frames a seed at the steady rate, and peak memory, against seeds, parallel worlds and"
        " hidden width; all else as in the preset `paper` with one seed, DQN with a full buffer of"
        f" {BUFFER:,} frames a seed. Dotted: linear growth. `growth` is the largest exponent between two neighbours"
        " (1 is linear).",
        "",
        f"![Time and memory against seeds, parallel worlds and hidden width]({figure})",
        "",
        "| | | minutes | growth | GB | growth |",
        "|---|---|---|---|---|---|",
    ]
    for axis in AXES:
        for algorithm in STYLES:
            found = series(rows, algorithm, axis)
            if not found:
                continue
            xs = ", ".join(str(x) for x, _, _ in found)
            cells = []
            for index, digits in ((1, 1), (2, 2)):
                cells.append(", ".join(f"{one[index]:.{digits}f}" for one in found))
                cells.append(f"{steepest([(one[0], one[index]) for one in found]):.2f}")
            lines.append(f"| {algorithm.upper()} | {LABELS[axis]}: {xs} | {' | '.join(cells)} |")
    return lines
