"""A run's sign of life: `progress.json`, written every few seconds by a thread of the process that works on the run."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path

from uavnav import files
from uavnav.runs import PROGRESS, STOP

SECONDS = 5.0
"""The time between two beats."""


class Heartbeat:
    """While it is open, says in a run's folder that this process lives, and how far the run is.

    Args:
        folder: of the run.
        total: frames per seed in the end.
        frames: per seed so far.
    """

    def __init__(self, folder: Path, total: int, frames: int = 0) -> None:
        self.folder, self.total = folder, total
        self.gone = False  # the folder was taken away, as when another process has taken the run over
        self.asked = False  # somebody has written the file `stop`
        self._frames, self._rate = frames, 0.0
        self._first: tuple[float, int] | None = None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Heartbeat:
        self.beat()
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._thread.join()
        if not self.gone:
            files.remove(self.folder / PROGRESS)

    def tell(self, frames: int) -> None:
        """Note how many frames per seed there are now, for the next beat."""
        now = time.perf_counter()
        if self._first is None or not self._first[1]:  # the frames of before a resume come with a share's first word
            self._first = now, frames
        since, before = self._first
        self._frames, self._rate = frames, (frames - before) / (now - since) if now > since else 0.0

    def beat(self) -> None:
        """Write once, and look whether the run shall stop."""
        try:
            tell(self.folder, self._frames, self.total, self._rate or None)
            self.asked = self.asked or (self.folder / STOP).exists()
        except FileNotFoundError:
            self.gone = True
        except OSError:  # a full disk: the next snapshot says more
            pass

    def _run(self) -> None:
        while not self._over.wait(SECONDS):
            self.beat()


def tell(folder: Path, frames: int, total: int, rate: float | None) -> None:
    """Write how far a run is: frames per seed, of how many, at so many a second, if that is known; raises OSError."""
    facts = {"frames": frames, "total": total, "rate": rate, "at": time.time()}
    files.write(folder / PROGRESS, json.dumps(facts).encode())
