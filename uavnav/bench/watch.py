"""A run under watch: how many frames it has at which time, where its time goes, and how long a whole run would take.

Frames are per seed, times in seconds since the process was launched.
"""

from __future__ import annotations

import functools
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from itertools import pairwise
from typing import Any, NamedTuple

from uavnav.bench.results import Result

WHOLE = 1_000_000
"""Frames of a whole run."""


class Mark(NamedTuple):
    """How far a run was at some time."""

    frames: int
    at: float  # [s]


class Stages:
    """Where the time goes: the seconds in some functions, without the seconds of other such functions inside them.

    Args:
        table: owner, name and stage of each function; the owner is a class or a module. Once wrapped, it stays so.
    """

    def __init__(self, table: Iterable[tuple[Any, str, str]]) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._inside: list[str] = []
        self.restart()
        for owner, name, stage in table:
            setattr(owner, name, self._timed(getattr(owner, name), stage))

    def restart(self) -> None:
        """Forget what was timed so far."""
        self.seconds.clear()
        self._began = self._last = time.perf_counter()

    def _timed(self, function: Callable[..., Any], stage: str) -> Callable[..., Any]:
        @functools.wraps(function)
        def timed(*args: Any, **kwargs: Any) -> Any:
            self._charge()
            self._inside.append(stage)
            try:
                return function(*args, **kwargs)
            finally:
                self._charge()
                self._inside.pop()

        return timed

    def _charge(self) -> None:
        now = time.perf_counter()
        if self._inside:
            self.seconds[self._inside[-1]] += now - self._last
        self._last = now

    def shares(self) -> dict[str, float]:
        """Each stage's share of the time since the last restart."""
        self._charge()
        total = self._last - self._began
        shares = {stage: seconds / total for stage, seconds in self.seconds.items()}
        return shares | {"other": 1 - sum(shares.values())}


class Clock:
    """Notes how far a run is, and says when the run was watched for long enough.

    Args:
        launched: when the process was started [s since the epoch].
        warm: frames from which the work is steady: everything is compiled, and learning has started.
        frames: stop there at the latest.
        seconds: stop after so many seconds of steady work.
        stages: timed from the first steady mark on.
    """

    def __init__(self, launched: float, warm: int, frames: int, seconds: float, stages: Stages | None = None) -> None:
        self.launched, self.warm, self.frames, self.seconds, self.stages = launched, warm, frames, seconds, stages
        self.marks: list[Mark] = []
        self._steady: list[Mark] = []

    def __call__(self, frames: int) -> bool:
        """Note the frames so far; whether to go on."""
        now = Mark(frames, time.time() - self.launched)
        self.marks.append(now)
        if frames < self.warm:
            return True
        if not self._steady and self.stages is not None:
            self.stages.restart()
        self._steady.append(now)
        watched = now.at - self._steady[0].at >= self.seconds
        return len(self._steady) < 3 or (frames < self.frames and not watched)

    def result(self, starts: int, whole_starts: int) -> Result:
        """Times as of `whole_run`, and the shares of stages where they were timed."""
        shares = {} if self.stages is None else {"shares": self.stages.shares()}
        return whole_run(self.marks, starts, whole_starts) | shares


def usual(marks: list[Mark]) -> float:
    """Frames/s of the median interval between marks: of few marks, one may hold a compilation."""
    return statistics.median((then.frames - now.frames) / (then.at - now.at) for now, then in pairwise(marks))


def rate(marks: list[Mark]) -> float:
    """Frames/s over marks; the first quarter is left out, in which things are compiled and grow warm."""
    steady = marks[len(marks) // 4 :]
    return (steady[-1].frames - steady[0].frames) / (steady[-1].at - steady[0].at)


def whole_run(marks: list[Mark], starts: int, whole_starts: int) -> Result:
    """The time and the rates of a run of `WHOLE` frames, from the marks of a shorter one.

    starts: frames before learning in the run that was watched, 0 if it learns at once; whole_starts: in the whole run.
    """
    after = rate([mark for mark in marks if mark.frames > starts] or marks)
    before = usual([mark for mark in marks if mark.frames <= starts]) if starts else after
    last = marks[-1]
    startup = last.at - min(last.frames, starts) / before - max(last.frames - starts, 0) / after
    whole = startup + whole_starts / before + (WHOLE - whole_starts) / after
    found = {"startup": startup, "rate": after, "whole": whole, "frames": last.frames}
    return found | ({"rate_before": before} if starts else {})
