"""Is the learning the same? Learning curves of uavnav and of Stable-Baselines3 at the same settings, compared.

A learning curve is the reward per frame, by stretch of training. Every flight counts in the frames in which it flew,
also a flight that is still open at the end. The mean reward of the episodes that end in a stretch would depend on a few
long flights: seeds of one algorithm differ in it by up to two thirds, too much to tell two libraries apart.

Each seed's flights are kept in a Parquet file (frame at the end, steps, reward), so that a run that was stopped goes on
with the missing seeds. Letters: S seeds, B bins of frames, E flights.
"""

from __future__ import annotations

from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy import stats

from uavnav.bench import ours
from uavnav.bench.plan import CORES, SB3, Measurement
from uavnav.bench.results import Result, table

Array = np.ndarray[Any, np.dtype[np.float64]]

FRAMES = 200_000
BINS = 20
FLOOR = -0.23
"""Reward per frame of random actions on the train split, where learning begins; areas are above it."""
CONFIDENCE = 0.9
SAME = (0.8, 1.25)
"""Two areas are equal if the interval of their ratio lies within these."""
LABELS = {"uavnav": "uavnav", "sb3": "SB3"}
COLOURS = {"uavnav": "#0072B2", "sb3": "#D55E00"}
SEEDS = {"uavnav": (16, 8), "sb3": (4, 4)}
"""Seeds of each library with the preset's number of parallel worlds, and with one world."""


class Arm(NamedTuple):
    """What is compared: a library, and the number of parallel worlds a seed."""

    library: str
    n_worlds: int

    @property
    def label(self) -> str:
        return f"{LABELS[self.library]}, {self.n_worlds} world{'' if self.n_worlds == 1 else 's'}"


class Cell(NamedTuple):
    """One learning problem."""

    algorithm: str
    activation: str

    @property
    def label(self) -> str:
        return f"{self.algorithm.upper()} {self.activation}"


CELLS = [Cell(algorithm, activation) for algorithm in ("ppo", "dqn") for activation in ("tanh", "relu")]


@cache
def preset_worlds(algorithm: str) -> int:
    return int(ours.settings(algorithm).n_worlds)


def arms(algorithm: str) -> list[Arm]:
    """Both libraries with the preset's number of parallel worlds, and with one, Stable-Baselines3's default."""
    counts = dict.fromkeys((preset_worlds(algorithm), 1))
    return [Arm(library, n_worlds) for n_worlds in counts for library in LABELS]


# -- the rows ---------------------------------------------------------------------------------------------------------


class Store:
    """The folder in which the flights of every seed are kept."""

    def __init__(self, folder: Path = Path("results/bench"), frames: int = FRAMES) -> None:
        self.folder = folder
        self.frames = frames

    def path(self, cell: Cell, arm: Arm, seed: int | str) -> Path:
        name = f"flights-{self.frames}-{cell.algorithm}-{cell.activation}-{arm.library}-{arm.n_worlds}-{seed}"
        return self.folder / f"{name}.parquet"

    def tables(self, cell: Cell, arm: Arm) -> list[pd.DataFrame]:
        """The flights of every seed that is there."""
        return [pd.read_parquet(path) for path in sorted(self.folder.glob(self.path(cell, arm, "*").name))]

    def curves(self, cell: Cell, arm: Arm) -> Array:
        """The learning curves of the seeds that are there: [S, B]."""
        found = [curve(table, self.frames, arm.n_worlds) for table in self.tables(cell, arm)]
        return np.array(found).reshape(len(found), BINS)

    def origins(self) -> str:
        """How many seeds were run, when and with which commits."""
        found = [
            table.attrs["when"] for cell in CELLS for arm in arms(cell.algorithm) for table in self.tables(cell, arm)
        ]
        return "; ".join(f"{count} on {when}" for when, count in sorted(Counter(found).items()))

    def plan(self, quick: bool = False) -> list[Measurement]:
        """The missing seeds; uavnav's first, because they take the least time."""
        pairs = [(cell, arm) for cell in CELLS for arm in arms(cell.algorithm)]
        pairs.sort(key=lambda pair: list(LABELS).index(pair[1].library))
        return [one for cell, arm in pairs for one in self._measurements(cell, arm)]

    def _measurements(self, cell: Cell, arm: Arm) -> list[Measurement]:
        """All seeds of uavnav from the first missing one in one run; Stable-Baselines3's side by side, one a core."""
        wanted = range(SEEDS[arm.library][arm.n_worlds == 1])
        missing = [seed for seed in wanted if not self.path(cell, arm, seed).is_file()]
        if not missing:
            return []
        name = f"parity/{cell.label}, {arm.label}, seeds"
        run = cell._asdict() | {"n_worlds": arm.n_worlds, "total_frames": self.frames}
        if arm.library == "uavnav":
            paths = [str(self.path(cell, arm, seed)) for seed in wanted[missing[0] :]]
            run |= {"seed": missing[0], "paths": paths}
            return [Measurement(f"{name} from {missing[0]}", "ours.curves", [run], CORES, rounds=1)]
        runs: list[Result] = [run | {"seed": seed, "path": str(self.path(cell, arm, seed))} for seed in missing]
        return [
            Measurement(f"{name} from {missing[n]}", "peers.curves", runs[n : n + CORES], rounds=1, needs=SB3)
            for n in range(0, len(runs), CORES)
        ]


# -- the comparison ---------------------------------------------------------------------------------------------------


def curve(flights: pd.DataFrame, frames: int, n_worlds: int, bins: int = BINS) -> Array:
    """Reward per frame in each of so many equal stretches of a seed's frames: [B].

    A flight's reward is spread evenly over its frames; each of its steps is `n_worlds` frames long.
    """
    end, steps, reward = (flights[name].to_numpy(float)[:, None] for name in ("frame", "steps", "reward"))
    edges = np.linspace(0, frames, bins + 1)
    flown = np.clip((edges - end) / (steps * n_worlds) + 1, 0, 1)  # [E, B + 1], the part of a flight before each edge
    result: Array = np.diff((reward * flown).sum(0)) / np.diff(edges)
    return result


def areas(curves: Array) -> Array:
    """The area per frame between each curve and the reward of random actions: curves [S, B] -> [S]."""
    result: Array = (curves - FLOOR).mean(1)
    return result


class Ratio(NamedTuple):
    """The ratio of two geometric means, with its interval."""

    value: float
    low: float
    high: float

    @property
    def verdict(self) -> str:
        """Whether two areas are equal or different; `open` if so few seeds can show neither."""
        if SAME[0] <= self.low and self.high <= SAME[1]:
            return "equal"
        return "different" if self.low > 1 or self.high < 1 else "open"


def ratio(mine: Array, theirs: Array) -> Ratio:
    """Geometric mean of mine [S] over that of theirs [S'], all above zero, with Welch's 90 % interval.

    A bootstrap's interval would be too narrow with so few seeds.
    """
    a, b = np.log(mine), np.log(theirs)
    low, high = stats.ttest_ind(a, b, equal_var=False).confidence_interval(CONFIDENCE)
    return Ratio(*(float(np.exp(one)) for one in (a.mean() - b.mean(), low, high)))


def section(store: Store) -> list[str]:
    """The comparison in Markdown: a row for each cell and number of worlds, then what the number of worlds does."""
    found = {(cell, arm): areas(store.curves(cell, arm)) for cell in CELLS for arm in arms(cell.algorithm)}
    rows, effects = [], []
    for cell in CELLS:
        many, one = ({library: Arm(library, n) for library in LABELS} for n in (preset_worlds(cell.algorithm), 1))
        for both in (many, one):
            mine, theirs = (found[cell, both[library]] for library in LABELS)
            rows.append(
                [cell.label, str(both["sb3"].n_worlds), _spread(mine), _spread(theirs), *_compared(mine, theirs)]
            )
        for a, b in ((many["uavnav"], one["sb3"]), *((many[library], one[library]) for library in LABELS)):
            effects.append([cell.label, a.label, b.label, *_compared(found[cell, a], found[cell, b])])
    for activation in dict.fromkeys(cell.activation for cell in CELLS):
        *_, last, first = (cell for cell in CELLS if cell.activation == activation)
        pair = [(cell, Arm("uavnav", preset_worlds(cell.algorithm))) for cell in (first, last)]
        labels = [f"{cell.algorithm.upper()}, {arm.label}" for cell, arm in pair]
        effects.append([activation, *labels, *_compared(*(found[one] for one in pair))])
    return [
        f"A learning curve is the reward per frame in each of {BINS} stretches of {store.frames:,} frames. Each flight"
        " counts in the frames in which it flew, whether it ended or not. The area is the mean of reward per frame +"
        f" {-FLOOR:g}: random actions earn {FLOOR:g}. It is given as mean ± standard deviation over seeds (number of"
        " seeds). The ratio is of geometric means, ours to SB3's, at the same number of parallel worlds and of updates"
        f" per frame, with Welch's {CONFIDENCE:.0%} interval over seeds. Two areas are equal if that interval lies"
        f" within {SAME[0]} ... {SAME[1]}, and different if it does not and excludes 1. *Equal* is said of these"
        f" {store.frames:,} frames: longer runs were not compared.",
        "",
        *table(["", "parallel worlds", "uavnav", "SB3", "ratio, like for like", "verdict"], rows),
        "",
        "The number of parallel worlds changes the same measure as follows: the preset against SB3 with one world, and"
        " many worlds against one in either library. The last rows compare two algorithms, for scale:",
        "",
        *table(["", "", "against", "ratio of areas", "verdict"], effects, left=3),
        "",
        f"Seeds run: {store.origins()}.",
        "",
        "In the figure, lines are means over seeds, and bands their range.",
    ]


def _compared(mine: Array, theirs: Array) -> tuple[str, str]:
    """The ratio of two cells and the verdict."""
    if min(len(mine), len(theirs)) < 2:
        return "-", "not enough seeds yet"
    found = ratio(mine, theirs)
    return f"{found.value:.2f} ({found.low:.2f} ... {found.high:.2f})", found.verdict


def _spread(values: Array) -> str:
    if len(values) < 2:
        return f"- ({len(values)})"
    return f"{values.mean():.3f} ± {values.std(ddof=1):.3f} ({len(values)})"


def draw(store: Store) -> Figure:
    """The learning curves: mean and range over seeds, one panel a cell."""
    figure = Figure(figsize=(9, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(-(-len(CELLS) // 2), 2, sharex=True, squeeze=False).flat
    at = (np.arange(BINS) + 0.5) * store.frames / BINS / 1000
    for panel, cell in zip(panels, CELLS, strict=False):
        for arm in arms(cell.algorithm):
            curves = store.curves(cell, arm)
            if len(curves):
                style = "--" if arm.n_worlds == 1 else "-"
                label = f"{arm.label} ({len(curves)} seeds)"
                panel.plot(at, curves.mean(0), style, color=COLOURS[arm.library], label=label)
                panel.fill_between(at, curves.min(0), curves.max(0), color=COLOURS[arm.library], alpha=0.15, lw=0)
        panel.set_title(cell.label)
        panel.set_xlabel("frames per seed [thousand]")
        if panel.lines:
            panel.legend(fontsize=8, loc="center right")
        panel.axhline(FLOOR, color="0.6", lw=0.8, ls=":")
        panel.annotate("random actions", (at[-1], FLOOR), ha="right", va="bottom", fontsize=8, color="0.4")
        panel.set_ylabel("reward per frame")
    return figure
