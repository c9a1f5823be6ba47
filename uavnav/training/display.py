"""What a run shows on the terminal while it trains: what it will do, and its progress."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from uavnav.runs.lately import Lately, line, span
from uavnav.training.config import TrainConfig

if TYPE_CHECKING:
    from uavnav.training.recorder import Recorder

Tell = Callable[[int, list[float]], None]
"""Is told the frames per seed so far, and each seed's reward per 1,000 frames (`uavnav.runs.lately`)."""
Update = Callable[[int, Lately], None]  # is told the frames per seed so far, and what the seeds do

RATE_SECONDS = 5.0  # of learning, after which a run that no terminal shows says how long it still takes


class Display:
    """A line that grows: the curve, the share of frames that are done, the pace, the time left, the reward.

    tell: is told as well what the line shows: frames per seed, and each seed's reward.
    """

    def __init__(self, config: TrainConfig, quiet: bool, tell: Tell | None = None) -> None:
        self._config, self._quiet, self._tell = config, quiet, tell
        self._progress = Progress(
            TextColumn("{task.fields[line]}", markup=False), disable=quiet, console=_console()
        )
        self._task = self._progress.add_task("", total=config.frames, line="")
        self._since = 0.0, 0  # from when the pace is measured, and frames per seed by then
        self._told_how_long = False

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        if kind is None or self._progress.tasks[0].completed:
            self._progress.stop()
        else:  # nothing was done: leave no empty line
            self._progress.live.transient = True
            self._progress.live.stop()

    def begin(self, recorder: Recorder, done: int) -> None:
        """Say, before the first frame, what the run does and how; done: frames per seed of its snapshot."""
        if not self._quiet:
            frames = min(self._config.frames, recorder.until or self._config.frames)
            for line in opening(self._config, frames, recorder.path, recorder.meta, done):
                self._say(line)

    def update(self, frames: int, lately: Lately) -> None:
        """frames: per seed so far; lately: what the seeds do."""
        now, total = time.monotonic(), self._config.frames
        # the first row leaves out what was compiled before; a worker's frames come with its first word
        if not self._since[1] or frames <= self._config.frames_before_learning:
            self._since = now, frames
        seconds, done = now - self._since[0], frames - self._since[1]
        rate = done / seconds if seconds and done > 0 else None
        self._progress.update(self._task, completed=frames, line=line(frames, total, rate, lately))
        if rate and seconds >= RATE_SECONDS and not self._told_how_long:
            self._told_how_long = True
            left = (total - frames) / rate
            if left > RATE_SECONDS and not (self._quiet or self._progress.console.is_terminal):
                self._say(f"about {span(left)} more at this rate")
        if self._tell is not None:
            self._tell(frames, lately.rewards)

    def _say(self, line: str) -> None:
        self._progress.console.print(line, highlight=False, markup=False, soft_wrap=True)


@contextlib.contextmanager
def episodes(what: str, n: int, max_steps: int, quiet: bool = False) -> Iterator[Callable[[int, int], None]]:
    """A bar for an evaluation of n episodes, only on a terminal, that goes when they have ended.

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


def opening(
    config: TrainConfig, frames: int, path: Path, facts: Mapping[str, Any], done: int
) -> Iterator[str]:
    """What a run does and where it goes, how, and from where it goes on.

    frames: per seed, until it stops; facts: what its meta.json says of `compiled`, `processes` and `threads`;
    done: as of `Display.begin`.
    """
    first, last = config.seeds[0], config.seeds[-1]
    seeds, each = (
        (f"seed {first}", "") if first == last else (f"{config.n_seeds} seeds ({first} to {last})", " each")
    )
    envs = f"{config.n_envs} parallel environment{'' if config.n_envs == 1 else 's'}"
    who = f"{config.algorithm} {config.activation}, preset {config.preset}"
    what = f"{who}: {seeds}, {frames:,} frames{each} in {envs}"
    if config.frames <= (before := config.frames_before_learning):
        what += f", too few to learn (updates begin after {before:,})"
    yield f"{what}, into {path}"
    n, threads = facts.get("processes", 1), facts["threads"]
    spread = f"{n} process{'' if n == 1 else 'es'} of {threads} thread{'' if threads == 1 else 's'}"
    compiled = "compiled, which takes a while the first time" if facts["compiled"] else "not compiled"
    yield f"{spread}, {compiled}"
    if done:
        yield f"resumed at {done:,} of {config.frames:,}"


class _Terminal(Console):
    """One that falls silent where nobody reads on: the run goes on, where rich would end the process."""

    def on_broken_pipe(self) -> None:
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _console() -> Console:
    """The terminal; in a notebook without ipywidgets plain text, where rich would warn at every step."""
    return _Terminal(force_jupyter=None if find_spec("ipywidgets") else False)
