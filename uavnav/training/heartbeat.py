"""A run's sign of life: `progress.json`, written every few seconds by a thread of whoever works on it."""

from __future__ import annotations

import json
import select
import threading
import time
from pathlib import Path

from uavnav import files
from uavnav.runs import PROGRESS, STOP
from uavnav.runs.lately import NOTHING, Lately

SECONDS = 5.0  # the time between two beats
WATCHED_SECONDS = 0.5  # the same of a worker that another process of this machine watches


class Heartbeat:
    """While it is open, says in a run's folder that this process lives, and how far the run is.

    Args:
        folder: of the run.
        total: frames per seed in the end.
        frames: per seed so far.
        watched: whether the process that started this one has the other end of the standard input. When it
            is gone, the run shall stop.
    """

    def __init__(self, folder: Path, total: int, frames: int = 0, watched: bool = False) -> None:
        self.folder, self.total, self.watched = folder, total, watched
        self.gone = False  # the folder was taken away, as when another process has taken the run over
        self.asked = False  # somebody has written the file `stop`
        self.lately = NOTHING
        self._frames, self._rate = frames, 0.0
        self._first = 0.0, 0  # when frames were known first, and how many
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
        # a worker's frames of before a resume come with its first word
        if not self._first[1]:
            self._first = now, frames
        since, before = self._first
        self._frames, self._rate = frames, (frames - before) / (now - since) if now > since else 0.0

    def beat(self) -> None:
        """Write once, and look whether the run shall stop."""
        try:
            tell(self.folder, self._frames, self.total, self._rate or None, self.lately)
            self.asked = self.asked or (self.folder / STOP).exists()
        except FileNotFoundError:
            self.gone = True
        except OSError:  # a full disk: the next snapshot says more
            pass
        if self.watched and select.select([0], [], [], 0)[0]:  # nobody writes there: it is the end
            self.asked = True

    def _run(self) -> None:
        while not self._over.wait(WATCHED_SECONDS if self.watched else SECONDS):
            self.beat()


def tell(folder: Path, frames: int, total: int, rate: float | None, lately: Lately = NOTHING) -> None:
    """Write how far a run is: frames per seed, of how many, at so many a second if known; raises OSError."""
    facts = {"frames": frames, "total": total, "rate": rate, "lately": lately.model_dump(), "at": time.time()}
    files.write(folder / PROGRESS, json.dumps(facts).encode())
