"""Jobs as processes of this machine."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from uavnav.settings import Count
from uavnav.training import machine, workers


@dataclass
class Local:
    """The cores of this machine; jobs: at once, by default one a core."""

    SEEDS_PER_WORKER: ClassVar[int | None] = None

    jobs: Count | None = None

    def __post_init__(self) -> None:
        self._running: list[subprocess.Popen[bytes]] = []

    def slots(self) -> int:
        return self.jobs or machine.cores()

    def check(self, folder: Path) -> None:
        """This machine sees its folders."""

    def start(self, jobs: Sequence[list[str]]) -> list[subprocess.Popen[bytes]]:
        # signals of the terminal come only to the study
        started = [
            subprocess.Popen(words, stdin=subprocess.DEVNULL, start_new_session=True) for words in jobs
        ]
        self._running += started
        return started

    def ended(self, job: subprocess.Popen[bytes]) -> bool:
        return job.poll() is not None

    def queued(self, job: subprocess.Popen[bytes]) -> bool:
        return False

    def cancel(self, job: subprocess.Popen[bytes]) -> None:
        with contextlib.suppress(ProcessLookupError):  # its forks too
            os.killpg(job.pid, signal.SIGKILL)

    def close(self) -> None:
        running = [job for job in self._running if job.poll() is None]  # others' numbers may be given again
        workers.end(running)
        for job in running:  # what a process has started may outlive it
            self.cancel(job)
