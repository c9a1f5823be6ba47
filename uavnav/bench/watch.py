"""A run under watch: how many frames it has at which time, and how long a whole run would take.

Frames are per seed, times in seconds since the process was launched.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

Result = dict[str, Any]
"""What a job finds: JSON by name."""
WHOLE = 1_000_000
"""Frames of a whole run."""
WARM = 2
"""Marks until the work is steady: everything is compiled."""


class Mark(NamedTuple):
    """How far a run was at some time."""

    frames: int
    at: float  # [s]


class Clock:
    """Notes how far a run is, and says when the run was watched for long enough.

    Args:
        launched: when the process was started [s since the epoch].
        config: our settings of the algorithm, which say how many frames come before it learns.
        seconds: how long to watch it learn, once it is warm.
    """

    def __init__(self, launched: float, config: Any, seconds: float) -> None:
        self.launched, self.seconds = launched, seconds
        self.starts = getattr(config, "learning_starts", 0)
        self.marks: list[Mark] = []

    def __call__(self, frames: int) -> bool:
        """Note the frames so far; whether to go on."""
        if frames > self.starts:
            self.marks.append(Mark(frames, time.time() - self.launched))
        steady = len(self.marks) - WARM
        return steady < 3 or self.marks[-1].at - self.marks[WARM].at < self.seconds

    def result(self) -> Result:
        """Start-up until it learns, the steady rate, and the time of a run of `WHOLE` frames.

        The first quarter of the marks is left out of the rate: things are compiled and grow warm.
        """
        first, last = self.marks[max(WARM, len(self.marks) // 4)], self.marks[-1]
        rate = (last.frames - first.frames) / (last.at - first.at)
        startup = last.at - (last.frames - self.starts) / rate
        whole = startup + (WHOLE - self.starts) / rate
        return {"startup": startup, "rate": rate, "whole": whole, "frames": last.frames}
