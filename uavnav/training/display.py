"""What a run shows on the terminal while it trains: what it will do, and its progress."""

from __future__ import annotations

import contextlib
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from uavnav.training.config import TrainConfig

Tell = Callable[[int, list[float]], None]
"""Is told the frames per seed so far, and each seed's mean reward over its last 100 episodes."""

RATE_SECONDS = 5.0
"""Of training, after which a run that was not measured says how long it still takes."""
TOLD_LATER = "the bar tells how long"


class Display:
    """A progress bar: frames per seed, frames/s per seed, time left, reward of the last 100 episodes.

    tell: is told as well what the bar shows: frames per seed, and each seed's reward.
    """

    def __init__(self, config: TrainConfig, quiet: bool, tell: Tell | None = None) -> None:
        self._config, self._quiet, self._tell = config, quiet, tell
        self._progress = Progress(
            TextColumn(f"{config.algorithm} {config.activation}"),
            BarColumn(bar_width=12),
            TextColumn("{task.fields[done]} {task.fields[rate]} frames/s"),
            TimeRemainingColumn(),
            TextColumn("left, reward {task.fields[reward]}"),
            disable=quiet,
            console=_console(),
        )
        self._task = self._progress.add_task("", total=config.frames, done="-", rate="-", reward="-")
        self._unknown = False
        self._since: tuple[float, int] | None = None

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        if kind is None or self._progress.tasks[0].completed:
            self._progress.stop()
        else:  # nothing was done: leave no empty bar
            self._progress.live.transient = True
            self._progress.live.stop()

    def begin(self, path: Path, facts: Mapping[str, Any], until: int | None = None) -> None:
        """Say, before the first frame, what the run does, how, and about how long that takes.

        path: of its folder; facts: what its meta.json says of `compiled`, `processes` and `threads`; until:
            stop there.
        """
        if not self._quiet:
            frames = self._config.frames
            lines = opening(self._config, min(frames, until or frames), path, facts)
            self._unknown = lines[-1].endswith(TOLD_LATER)
            for line in lines:
                self._say(line)

    def update(self, frames: int, rewards: list[float]) -> None:
        """frames: per seed so far; rewards: each seed's mean over its last 100 episodes."""
        task = self._progress.tasks[0]
        rate = f"{task.speed / 1000:,.1f}k" if task.speed else "-"
        done = f"{frames // 1000:,}k/{self._config.frames // 1000:,}k"
        self._progress.update(
            self._task, completed=frames, done=done, rate=rate, reward=with_spread(rewards, 1)
        )
        if self._unknown and frames >= self._config.frames_before_learning:
            self._tell_how_long(frames)
        if self._tell is not None:
            self._tell(frames, rewards)

    def _tell_how_long(self, frames: int) -> None:
        """Once, from the rate since learning began, which leaves out what was compiled before."""
        now = time.monotonic()
        first, done = self._since = self._since or (now, frames)
        if now - first >= RATE_SECONDS and frames > done:
            self._unknown = False
            left = (now - first) / (frames - done) * (self._config.frames - frames)
            self._say(f"about {_rounded(left)} more at this rate")

    def _say(self, line: str) -> None:
        self._progress.console.print(line, highlight=False, markup=False, soft_wrap=True)


@contextlib.contextmanager
def episodes(what: str, n: int, max_steps: int, quiet: bool = False) -> Iterator[Callable[[int, int], None]]:
    """A bar for an evaluation of n episodes, on a terminal alone, that goes when they have ended.

    Yields:
        What is to be told each step's number and how many episodes go on after it.
    """
    console = _console()
    bar = Progress(
        TextColumn(what),
        BarColumn(bar_width=12),
        TextColumn("step {task.completed:,.0f} of at most {task.total:,.0f}, {task.fields[up]:,} of"),
        TextColumn(f"{n:,} episodes go on"),
        console=console,
        transient=True,
        disable=quiet or not console.is_terminal,
    )
    task = bar.add_task("", total=max_steps, up=n)
    with bar:
        yield lambda step, up: bar.update(task, completed=step, up=up)


def opening(config: TrainConfig, frames: int, path: Path, facts: Mapping[str, Any]) -> tuple[str, str]:
    """What a run does and where it goes; how, and about how long it takes. Arguments as of
    `Display.begin`.
    """
    first, last = config.seeds[0], config.seeds[-1]
    seeds, each = (
        (f"seed {first}", "") if first == last else (f"{config.n_seeds} seeds ({first} to {last})", " each")
    )
    worlds = f"{config.n_envs} parallel environment{'' if config.n_envs == 1 else 's'}"
    who = f"{config.algorithm} {config.activation}, preset {config.preset}"
    what = f"{who}: {seeds}, {frames:,} frames{each} in {worlds}"
    if config.frames <= (before := config.frames_before_learning):
        what += f", too few to learn (updates begin after {before:,})"
    n, threads = facts.get("processes", 1), facts["threads"]
    spread = f"{n} process{'' if n == 1 else 'es'} of {threads} thread{'' if threads == 1 else 's'}"
    how = "compiled (takes 3 s, or 15 to 30 s the first time)" if facts["compiled"] else "not compiled"
    took = seconds(config, frames, n, facts["compiled"])
    long = TOLD_LATER if took is None else f"about {_rounded(took)} on the two cores of docs/benchmarks.md"
    return f"{what}, into {path}", f"{how}, {spread}: {long}"


def seconds(config: TrainConfig, frames: int, processes: int, compiled: bool) -> float | None:
    """How long training takes, as measured with these presets on two cores; None for what was not
    measured.
    """
    usual = type(config)(preset=config.preset, n_seeds=config.n_seeds)
    known = config.MICROSECONDS.get((config.preset, compiled))
    other = (config.n_envs, config.device) != (usual.n_envs, usual.device)
    if known is None or other or config.beyond_preset():
        return None
    shared, each = known
    return 1e-6 * frames * (shared + each * -(-config.n_seeds // processes))


def _rounded(took: float) -> str:
    if took < 90:
        return f"{max(10, round(took, -1)):.0f} s"
    return f"{took / 60:.0f} min" if took < 90 * 60 else f"{took / 3600:.0f} h"


class _Terminal(Console):
    """One that falls silent where nobody reads on: the run goes on, where rich would end the process."""

    def on_broken_pipe(self) -> None:
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _console() -> Console:
    """The terminal; in a notebook without ipywidgets plain text, where rich would warn at every step of a
    bar.
    """
    return _Terminal(force_jupyter=None if find_spec("ipywidgets") else False)


def with_spread(values: list[float], digits: int) -> str:
    """A mean, and the standard deviation of several."""
    if not values:
        return "-"
    mean = f"{statistics.mean(values):,.{digits}f}"
    return mean if len(values) == 1 else f"{mean} ± {statistics.stdev(values):,.{digits}f}"
