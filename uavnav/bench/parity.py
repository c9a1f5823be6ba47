"""Is the learning the same? Learning curves of this code and of Stable-Baselines3 at the same settings, compared.

A learning curve is the reward that a frame earns, by stretch of training: every flight counts in the frames in which it
flew, those still open at the end too. The mean reward of the episodes that end in a stretch, which one reads off a
training log, hangs on a few long flights, which end late, and seeds of one algorithm differ by up to two thirds in it,
so that no affordable number of them tells two libraries apart. Each seed's flights are kept as a Parquet file of their
frame (at its end, of its seed), steps and reward, so that a run that was stopped goes on with what is missing.
Letters: S seeds, B bins of frames, E flights.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy import stats

from uavnav.bench.jobs import Job, JobError, Result

Array = np.ndarray[Any, np.dtype[np.float64]]
Worlds = dict[str, int]
"""How many parallel worlds a seed has in the preset, by algorithm."""

FRAMES = 200_000
BINS = 20
FLOOR = -0.23
"""What a frame of random actions earns on the train split, where learning begins: areas are above this line."""
CONFIDENCE = 0.9
SAME = (0.8, 1.25)
"""Where the interval of the ratio of two areas lies if they are taken for equal."""
LABELS = {"uavnav": "uavnav", "sb3": "SB3"}
COLOURS = {"uavnav": "#0072B2", "sb3": "#D55E00"}
HOURS = 3.0
"""After which a run is given up."""


class Arm(NamedTuple):
    """What is compared: who trains, and in how many parallel worlds a seed."""

    library: str
    n_worlds: int

    @property
    def label(self) -> str:
        return f"{LABELS[self.library]}, {self.n_worlds} world{'' if self.n_worlds == 1 else 's'}"


class Cell(NamedTuple):
    """One learning problem."""

    algorithm: str
    activation: str


Seeds = dict[Cell, tuple[int, int, int, int]]
"""How many are wanted of each of a cell's `arms`: uavnav and SB3 with the preset's worlds, uavnav and SB3 with one."""

CELLS = [Cell(algorithm, activation) for algorithm in ("ppo", "dqn") for activation in ("tanh", "relu")]
SEEDS: Seeds = dict.fromkeys(CELLS, (16, 4, 8, 4))
AT_ONCE = 12
"""Seeds of ours in a process at most: a run that is stopped loses no more than those."""


def arms(n_worlds: int) -> list[Arm]:
    """Both libraries with as many parallel worlds as the preset has, and with one, as Stable-Baselines3 has."""
    return list(dict.fromkeys(Arm(library, worlds) for worlds in (n_worlds, 1) for library in ("uavnav", "sb3")))


class Store:
    """The folder in which the flights of every seed are kept."""

    def __init__(self, folder: Path, frames: int) -> None:
        self.folder = folder / f"flights-{frames}"
        self.frames = frames

    def path(self, cell: Cell, arm: Arm, seed: int) -> Path:
        return self.folder / f"{cell.algorithm}-{cell.activation}-{arm.library}-{arm.n_worlds}-{seed}.parquet"

    def missing(self, cell: Cell, arm: Arm, seeds: int) -> list[int]:
        """The seeds that are still to be run."""
        return [seed for seed in range(seeds) if not self.path(cell, arm, seed).is_file()]

    def tables(self, cell: Cell, arm: Arm) -> list[pd.DataFrame]:
        """The flights of every seed that is there."""
        stem = self.path(cell, arm, 0).stem.removesuffix("0")
        found = [path for path in self.folder.glob(f"{stem}*.parquet") if path.stem.removeprefix(stem).isdigit()]
        return [pd.read_parquet(path) for path in sorted(found)]

    def curves(self, cell: Cell, arm: Arm) -> Array:
        """The learning curves of the seeds that are there: [S, B]."""
        found = [curve(table, self.frames, arm.n_worlds) for table in self.tables(cell, arm)]
        return np.array(found).reshape(len(found), BINS)

    def origins(self, worlds: Worlds, cells: Sequence[Cell]) -> str:
        """When and with which commits the seeds were run, and how many of them."""
        found = [
            table.attrs["when"]
            for cell in cells
            for arm in arms(worlds[cell.algorithm])
            for table in self.tables(cell, arm)
        ]
        return "; ".join(f"{count} on {when}" for when, count in sorted(Counter(found).items()))

    def jobs(self, cells: Sequence[Cell], worlds: Worlds, seeds: Seeds) -> list[tuple[str, str, Result]]:
        """What is still to be done: what to call it, the job, and its arguments; what is done soonest comes first."""
        found: list[tuple[str, str, Result]] = []
        wanted = [
            (cell, arm, count)
            for cell in cells
            for arm, count in zip(arms(worlds[cell.algorithm]), seeds[cell], strict=False)
        ]
        order = sorted(
            wanted, key=lambda one: (one[1].library == "sb3", one[0].algorithm == "ppo", one[1].n_worlds == 1)
        )
        for cell, arm, count in order:
            missing = self.missing(cell, arm, count)
            title = f"{cell.algorithm} {cell.activation}, {arm.label}"
            common: Result = {"algorithm": cell.algorithm, "activation": cell.activation}
            if arm.library == "uavnav":
                for run in consecutive(missing):
                    paths = [str(self.path(cell, arm, seed)) for seed in run]
                    settings = {"seeds": run, "paths": paths, "total_frames": self.frames, "n_worlds": arm.n_worlds}
                    found.append((f"{title}, seeds {run[0]} to {run[-1]}", "curves_ours", common | settings))
            else:
                for seed in missing:
                    how = {"seed": seed, "n_envs": arm.n_worlds, "frames": self.frames}
                    path = str(self.path(cell, arm, seed))
                    found.append((f"{title}, seed {seed}", "curves_sb3", common | how | {"path": path}))
        return found


def consecutive(numbers: Sequence[int], most: int = AT_ONCE) -> list[list[int]]:
    """Rising numbers as runs without a gap, each of so many at most."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1 and len(runs[-1]) < most:
            runs[-1].append(number)
        else:
            runs.append([number])
    return runs


def train(
    store: Store,
    worlds: Worlds,
    cache: Path,
    say: Callable[[str], None],
    seeds: Seeds = SEEDS,
    at_once: int = 2,
) -> list[str]:
    """Run what is missing, so many processes at once; what failed, and why."""
    todo, failed = store.jobs(list(seeds), worlds, seeds), []
    running: set[Job] = set()

    def run(job: str, arguments: Result) -> Result:
        process = Job(job, arguments, 1, cache)
        running.add(process)
        try:
            return process.result(3600 * HOURS)
        finally:
            running.discard(process)
            process.stop()

    with ThreadPoolExecutor(at_once) as pool:
        titles = {pool.submit(run, job, arguments): title for title, job, arguments in todo}
        try:
            for count, future in enumerate(as_completed(titles), 1):
                title = titles[future]
                try:
                    took = f"{future.result()['seconds']:.0f} s"
                except JobError as error:
                    took = f"failed: {error}"
                    failed.append(f"{title}: {error}")
                say(f"{count}/{len(todo)} {title}: {took}")
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in list(running):
                process.stop()
            raise
    return failed


def curve(flights: pd.DataFrame, frames: int, n_worlds: int, bins: int = BINS) -> Array:
    """Reward a frame in each of so many equal stretches of a seed's frames: [B].

    A flight's reward is spread evenly over the frames that it took, of which each of its steps is `n_worlds`.
    """
    end, steps, reward = (flights[name].to_numpy(float)[:, None] for name in ("frame", "steps", "reward"))
    edges = np.linspace(0, frames, bins + 1)
    flown = np.clip((edges - end) / (steps * n_worlds) + 1, 0, 1)  # [E, B + 1], the part of a flight before each edge
    result: Array = np.diff((reward * flown).sum(0)) / np.diff(edges)
    return result


def areas(curves: Array) -> Array:
    """The area between each curve and what random actions earn, a frame: curves [S, B] -> [S]."""
    result: Array = (curves - FLOOR).mean(1)
    return result


class Ratio(NamedTuple):
    """Of two geometric means, with its interval."""

    value: float
    low: float
    high: float

    @property
    def verdict(self) -> str:
        """Whether two areas are equal, different, or neither can be said from so many seeds."""
        if SAME[0] <= self.low and self.high <= SAME[1]:
            return "equal"
        return "different" if self.low > 1 or self.high < 1 else "open"

    def __str__(self) -> str:
        return f"{self.value:.2f} ({self.low:.2f} ... {self.high:.2f})"


def ratio(mine: Array, theirs: Array) -> Ratio:
    """Geometric mean of mine [S] over that of theirs [S'], all above zero, with Welch's 90 % interval.

    Of so few seeds a bootstrap's intervals are too narrow.
    """
    a, b = np.log(mine), np.log(theirs)
    low, high = stats.ttest_ind(a, b, equal_var=False).confidence_interval(CONFIDENCE)
    return Ratio(*(float(np.exp(one)) for one in (a.mean() - b.mean(), low, high)))


def section(store: Store, worlds: Worlds, figure: str, cells: Sequence[Cell] = CELLS) -> list[str]:
    """The comparison in Markdown: one row a cell and number of worlds; `figure` is the name of its picture."""
    rows, effects = [], []
    for cell in cells:
        name, n_worlds = f"{cell.algorithm.upper()} {cell.activation}", worlds[cell.algorithm]
        found = {arm: areas(store.curves(cell, arm)) for arm in arms(n_worlds)}
        for count in dict.fromkeys((n_worlds, 1)):
            mine, theirs = (found[Arm(library, count)] for library in ("uavnav", "sb3"))
            rows.append(f"| {name} | {count} | {_spread(mine)} | {_spread(theirs)} | {_compared(mine, theirs)} |")
        for ours, other in _pairs(n_worlds):
            label = f"{name} | {ours.label} | {other.label}"
            effects.append(f"| {label} | {_compared(found[ours], found[other])} |")
    for activation in dict.fromkeys(cell.activation for cell in cells):
        pair = [(Cell(name, activation), Arm("uavnav", worlds[name])) for name in ("dqn", "ppo")]
        label = " | ".join(f"{cell.algorithm.upper()}, {arm.label}" for cell, arm in pair)
        first, second = (areas(store.curves(cell, arm)) for cell, arm in pair)
        effects.append(f"| {activation} | {label} | {_compared(first, second)} |")
    return [
        f"Learning curves over {store.frames:,} frames: the reward a frame earns, in each of {BINS} stretches; each"
        " flight counts in the frames in which it flew, whether it ended or not. The area is that between the curve and"
        f" {FLOOR:g}, which random actions earn, divided by the frames: the mean of reward a frame + {-FLOOR:g} (mean ±"
        " standard deviation over seeds, their number). The ratio is of geometric means, ours to SB3's, at the same"
        f" number of parallel worlds and of updates a frame, with Welch's {CONFIDENCE:.0%} interval over seeds. The"
        f" areas are taken for equal if that interval lies within {SAME[0]} ... {SAME[1]}, for different if it does not"
        " and excludes 1.",
        "",
        "| | parallel worlds | uavnav | SB3 | ratio, like for like | verdict |",
        "|---|--:|--:|--:|--:|---|",
        *rows,
        "",
        "What the number of parallel worlds does to the same measure: the preset as it is against SB3 with one world,"
        " and many worlds against one in either library. The last rows, for scale, set DQN against PPO:",
        "",
        "| | | against | ratio of areas | verdict |",
        "|---|---|---|--:|---|",
        *effects,
        "",
        f"Seeds run: {store.origins(worlds, cells)}.",
        "",
        f"![Learning curves of uavnav and Stable-Baselines3]({figure})",
        "",
        "Lines are means over seeds, bands their range.",
    ]


def _pairs(n_worlds: int) -> list[tuple[Arm, Arm]]:
    """What shows the effect of the number of worlds; nothing, where the preset has one."""
    many, one = ({library: Arm(library, count) for library in LABELS} for count in (n_worlds, 1))
    pairs = [(many["uavnav"], one["sb3"]), (many["uavnav"], one["uavnav"]), (many["sb3"], one["sb3"])]
    return pairs if n_worlds > 1 else []


def _compared(mine: Array, theirs: Array) -> str:
    """Two cells: the ratio and the verdict."""
    if min(len(mine), len(theirs)) < 2:
        return "- | not enough seeds yet"
    found = ratio(mine, theirs)
    return f"{found} | {found.verdict}"


def _spread(values: Array) -> str:
    if len(values) < 2:
        return f"- ({len(values)})"
    return f"{values.mean():.3f} ± {values.std(ddof=1):.3f} ({len(values)})"


def draw(store: Store, worlds: Worlds, cells: Sequence[Cell] = CELLS) -> Figure:
    """The learning curves: mean and range over seeds, one panel a cell."""
    figure = Figure(figsize=(9, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    columns = 2 if len(cells) > 1 else 1
    panels = figure.subplots(-(-len(cells) // columns), columns, sharex=True, squeeze=False).flat
    at = (np.arange(BINS) + 0.5) * store.frames / BINS / 1000
    for panel, cell in zip(panels, cells, strict=False):
        for arm in arms(worlds[cell.algorithm]):
            curves = store.curves(cell, arm)
            if len(curves):
                style = "--" if arm.n_worlds == 1 else "-"
                label = f"{arm.label} ({len(curves)} seeds)"
                panel.plot(at, curves.mean(0), style, color=COLOURS[arm.library], label=label)
                panel.fill_between(at, curves.min(0), curves.max(0), color=COLOURS[arm.library], alpha=0.15, lw=0)
        panel.set_title(f"{cell.algorithm.upper()} {cell.activation}")
        panel.set_xlabel("frames per seed [thousand]")
        if panel.lines:
            panel.legend(fontsize=8, loc="center right")
        panel.axhline(FLOOR, color="0.6", lw=0.8, ls=":")
        panel.annotate("random actions", (at[-1], FLOOR), ha="right", va="bottom", fontsize=8, color="0.4")
        panel.set_ylabel("reward per frame")
    return figure
