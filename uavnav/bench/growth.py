"""How time and memory grow with seeds, parallel worlds and hidden width: what is run, the table and its figure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from uavnav.algorithms import ALGORITHMS
from uavnav.bench import ours
from uavnav.bench.plan import CORES, Measurement
from uavnav.bench.results import Result, Results, table
from uavnav.bench.watch import WHOLE
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
"""Frames a seed of a replay buffer here, which is full when learning starts."""
SECONDS = 12.0
COLOURS, MARKERS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7"), "os^D"

Pairs = Sequence[tuple[float, float]]


class Point(NamedTuple):
    """A run whose time and memory are measured."""

    algorithm: str
    axis: str
    x: int

    @property
    def name(self) -> str:
        return f"growth/{self.algorithm}/{self.axis}/{self.x}"

    @property
    def arguments(self) -> Result:
        """The arguments of the job `ours.watched`."""
        at = BASE | {self.axis: self.x}
        settings = {"n_seeds": at["seeds"], "n_worlds": at["worlds"], "hidden": [at["width"]] * 2}
        if ours.has_buffer(self.algorithm):
            settings |= {"buffer_size": BUFFER, "learning_starts": BUFFER}
        return {"algorithm": self.algorithm, "frames": WHOLE, "seconds": SECONDS, **settings}

    @property
    def size(self) -> int:
        """What is plotted: x, or for a hidden width the parameters of a seed's networks."""
        return parameters(self.algorithm, self.x) if self.axis == "width" else self.x


def parameters(algorithm: str, width: int) -> int:
    """Weights and biases of a seed: a network over all actions, and one where there is a critic, or SAC's two."""
    world, config = World(), ours.settings(algorithm)
    critics = [1] if hasattr(config, "critic_coeff") else [world.n_actions] * 2 * hasattr(config, "target_entropy")
    outputs = [config.n_outputs, *critics]  # C51 has atoms
    hidden = (world.observation_size + 1) * width + (width + 1) * width
    return sum(hidden + (width + 1) * last for last in outputs)


def points() -> list[Point]:
    """Every point of each algorithm; what is common to the axes is run for each."""
    return [Point(algorithm, axis, x) for algorithm in ALGORITHMS for axis, xs in AXES.items() for x in xs]


def plan(quick: bool) -> list[Measurement]:
    return [Measurement(point.name, "ours.watched", [point.arguments], threads=CORES, rounds=1) for point in points()]


def series(results: Results, algorithm: str, axis: str) -> tuple[Pairs, Pairs]:
    """Along an axis: size and minutes for 1 M frames a seed at the steady rate, and size and peak memory [GB]."""
    times, memory = [], []
    for point in points():
        rate, peak = results.median(point.name, "rate"), results.median(point.name, "peak")
        if (point.algorithm, point.axis) == (algorithm, axis) and rate and peak:
            times.append((float(point.size), WHOLE / rate / 60))
            memory.append((float(point.size), peak))
    return times, memory


def exponent(pairs: Pairs) -> float:
    """The power of x that fits best on logarithmic axes: 1 is linear growth."""
    if len(pairs) < 2:
        return math.nan
    x, y = np.log(np.array(pairs)).T
    return float(np.polyfit(x, y, 1)[0])


def steepest(pairs: Pairs) -> float:
    """The largest exponent between two neighbours."""
    return max((exponent(pair) for pair in pairwise(pairs)), default=math.nan)


def line(pairs: Pairs) -> tuple[float, float]:
    """The fixed part and the slope of the straight line that fits best, each point weighted by its own size."""
    x, y = np.array(pairs).T
    slope, fixed = np.polyfit(x, y, 1, w=1 / y)
    return float(fixed), float(slope)


def draw(results: Results) -> Figure:
    """Time above, memory below, against each axis; a dotted line is linear growth."""
    figure = Figure(figsize=(11, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, len(AXES), sharex="col", squeeze=False)
    for column, axis in enumerate(AXES):
        for algorithm, colour, marker in zip(ALGORITHMS, COLOURS, MARKERS, strict=False):
            for panel, pairs in zip(panels[:, column], series(results, algorithm, axis), strict=True):
                if not pairs:
                    continue
                xs, ys = zip(*pairs, strict=True)
                panel.plot(xs, ys, color=colour, marker=marker, label=algorithm.upper())
                panel.plot(xs, [ys[0] * x / xs[0] for x in xs], ":", color=colour, lw=1)
                panel.set_xscale("log", base=10 if axis == "width" else 2)
                panel.set_yscale("log")
        if axis != "width":
            panels[1][column].set_xticks(AXES[axis], [str(x) for x in AXES[axis]])
        panels[1][column].set_xlabel(LABELS[axis])
    panels[0][0].set_ylabel("time for 1 M frames a seed [min]")
    panels[1][0].set_ylabel("peak memory [GB]")
    panels[0][0].legend()
    return figure


def section(results: Results) -> list[str]:
    """The numbers of the figure in Markdown, and what they say of growth."""
    rows, faster, costs = [], [], []
    for axis in AXES:
        for algorithm in ALGORITHMS:
            times, memory = series(results, algorithm, axis)
            if not times:
                continue
            name, xs = algorithm.upper(), ", ".join(f"{x:,.0f}" for x, _ in times)
            rows.append([name, f"{LABELS[axis]}: {xs}", *_grown(times, 1), *_grown(memory, 2)])
            faster += _faster(f"{name}'s time", axis, times) + _faster(f"{name}'s memory", axis, memory)
            if axis == "seeds" and len(times) > 1:
                costs.append(
                    "{}: {:.2g} min and {:.2g} min a seed; {:.2g} GB and {:.2g} GB a seed.".format(
                        name, *line(times), *line(memory)
                    )
                )
    verdict = f"faster than linearly grow {'; '.join(faster)}" if faster else "nothing grows faster than linearly"
    return [
        f"Time for {WHOLE:,} frames a seed at the steady rate, and peak memory, against seeds, parallel worlds and the"
        f" parameters of networks with {', '.join(map(str, AXES['width']))} units in each hidden layer. All else is as"
        f" in the preset `paper` with one seed and {BASE['worlds']} parallel worlds; replay buffers hold {BUFFER:,}"
        " frames a seed and are full. `growth` is the exponent of the power law that fits best (1 is linear), and in"
        " brackets the largest exponent between two neighbours. Dotted lines in the figure are linear growth.",
        "",
        *table(["", "", "minutes", "growth", "GB", "growth"], rows, left=6),
        "",
        *(["Fixed, and for each seed: " + " ".join(costs), ""] if costs else []),
        f"By the fits {verdict}.",
    ]


def _grown(pairs: Pairs, digits: int) -> tuple[str, str]:
    """The values of y, and their growth."""
    return ", ".join(f"{y:.{digits}f}" for _, y in pairs), f"{exponent(pairs):.2f} ({steepest(pairs):.2f})"


def _faster(what: str, axis: str, pairs: Pairs) -> list[str]:
    """What grows faster than linearly by the fit, and between which neighbours, in words; often nothing."""
    if not exponent(pairs) > LINEAR:
        return []
    steps = [f"{a[0]:,.0f} to {b[0]:,.0f}" for a, b in pairwise(pairs) if exponent([a, b]) > LINEAR]
    return [f"{what} with {LABELS[axis]}, exponent {exponent(pairs):.2f} (between {', '.join(steps)})"]
