"""How time and memory grow with seeds, parallel worlds and hidden width: what is run, the figure and its table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from uavnav.bench.jobs import WHOLE, Result
from uavnav.tasks.world import World

AXES = {
    "seeds": [1, 2, 5, 10, 20, 40],
    "worlds": [4, 16, 64, 256],
    "width": [16, 64, 256, 1024],
}
"""What is varied; all else stays as in the preset `paper` with one seed."""
BASE = {"seeds": 1, "worlds": 16, "width": 64}
LABELS = {"seeds": "seeds", "worlds": "parallel worlds a seed", "width": "parameters a seed"}
LINEAR = 1.05
"""The largest exponent that is taken for linear growth: figures of one round are that noisy."""
BUFFER = 20_000
"""Frames a seed of DQN's buffer here, which is full when it begins to learn."""
SECONDS = 12.0
OBSERVATION, N_ACTIONS = World().observation_size, World().n_actions
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

    @property
    def size(self) -> int:
        """What is plotted: x, and of a hidden width the weights and biases of a seed's networks."""
        return parameters(self.algorithm, self.x) if self.axis == "width" else self.x


def parameters(algorithm: str, width: int) -> int:
    """Of a seed: networks of two hidden layers, the policy and the value of PPO, or Q."""
    outputs = [N_ACTIONS, 1] if algorithm == "ppo" else [N_ACTIONS]
    layers = [(OBSERVATION, width), (width, width)]
    return sum((inputs + 1) * units for last in outputs for inputs, units in (*layers, (width, last)))


def points() -> list[Point]:
    """Every point of both algorithms; what is common to the axes is run for each."""
    return [Point(algorithm, axis, x) for algorithm in STYLES for axis, xs in AXES.items() for x in xs]


def series(rows: dict[Point, Result], algorithm: str, axis: str) -> list[tuple[int, float, float]]:
    """Size, minutes for 1 M frames a seed at the steady rate, and peak memory [GB], along an axis."""
    own = [(point.size, rows[point]) for point in sorted(rows) if (point.algorithm, point.axis) == (algorithm, axis)]
    return [(x, WHOLE / found["rate"] / 60, max(found["peak"], found.get("tree", 0.0))) for x, found in own]


def exponent(pairs: Sequence[tuple[float, float]]) -> float:
    """Of the power of x that fits best on logarithmic axes: 1 is linear growth."""
    if len(pairs) < 2:
        return math.nan
    x, y = np.log(np.array(pairs)).T
    return float(np.polyfit(x, y, 1)[0])


def steepest(pairs: Sequence[tuple[float, float]]) -> float:
    """The largest exponent between two neighbours."""
    return max((exponent(pair) for pair in pairwise(pairs)), default=math.nan)


def line(pairs: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """The fixed part and the slope of the straight line that fits best, each point weighted by its own size."""
    x, y = np.array(pairs).T
    slope, fixed = np.polyfit(x, y, 1, w=1 / y)
    return float(fixed), float(slope)


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
                panel.set_xscale("log", base=10 if axis == "width" else 2)
                panel.set_yscale("log")
        if axis != "width":
            panel.set_xticks(AXES[axis], [str(x) for x in AXES[axis]])
        if row:
            panel.set_xlabel(LABELS[axis])
        if not column:
            panel.set_ylabel(unit)
    panels[0][0].legend()
    return figure


def section(rows: dict[Point, Result], figure: str) -> list[str]:
    """The figure, its numbers in Markdown, and what they say of growth."""
    lines = [
        "Time for 1,000,000 frames a seed at the steady rate, and peak memory, against seeds, parallel worlds and the"
        f" parameters of networks with {', '.join(map(str, AXES['width']))} units in each hidden layer; all else as in"
        f" the preset `paper` with one seed and {BASE['worlds']} parallel worlds, DQN with a full buffer of {BUFFER:,}"
        " frames a seed. Dotted: linear growth. `growth` is the exponent of the power law that fits best (1 is linear),"
        " and, in brackets, the largest between two neighbours.",
        "",
        f"![Time and memory against seeds, parallel worlds and parameters]({figure})",
        "",
        "| | | minutes | growth | GB | growth |",
        "|---|---|---|---|---|---|",
    ]
    faster, costs = [], []
    for algorithm, axis in ((algorithm, axis) for axis in AXES for algorithm in STYLES):
        found = series(rows, algorithm, axis)
        if not found:
            continue
        cells = []
        for index, what, digits in ((1, "time", 1), (2, "memory", 2)):
            pairs = [(one[0], one[index]) for one in found]
            cells.append(", ".join(f"{y:.{digits}f}" for _, y in pairs))
            cells.append(f"{exponent(pairs):.2f} ({steepest(pairs):.2f})")
            faster += _faster(f"{algorithm.upper()}'s {what}", axis, pairs)
        xs = ", ".join(f"{one[0]:,}" for one in found)
        lines.append(f"| {algorithm.upper()} | {LABELS[axis]}: {xs} | {' | '.join(cells)} |")
        if axis == "seeds" and len(found) > 1:
            time, memory = (line([(one[0], one[index]) for one in found]) for index in (1, 2))
            costs.append(
                f"{algorithm.upper()}: {time[0]:.2g} min and {time[1]:.2g} min a seed; {memory[0]:.2g} GB and"
                f" {memory[1]:.2g} GB a seed."
            )
    verdict = "By the fits nothing grows faster than linearly."
    if faster:
        verdict = f"Faster than linearly grow: {'; '.join(faster)}."
    return [*lines, "", "Fixed, and for each seed: " + " ".join(costs), "", verdict] if costs else [*lines, "", verdict]


def _faster(what: str, axis: str, pairs: Sequence[tuple[float, float]]) -> list[str]:
    """What grows faster than linearly by the fit, and between which neighbours, in words; often nothing."""
    if not exponent(pairs) > LINEAR:
        return []
    steps = [f"{a[0]:,} to {b[0]:,}" for a, b in pairwise(pairs) if exponent([a, b]) > LINEAR]
    return [f"{what} with {LABELS[axis]}, exponent {exponent(pairs):.2f} (between {', '.join(steps)})"]
