"""A run's seeds spread over processes: each trains its share of them as a run of its own.

The shares lie in `checkpoint/` below the run's folder, every one with its own snapshots, and are put together when all
have finished. What happens in the process of a share is in `cli.worker`.

A share may be given to another machine. Its folder then gets the next name, `seeds-0-9.2` after `seeds-0-9.1`: the
former owner, if it lives on, finds its folder gone and can no longer write.
"""

from __future__ import annotations

import contextlib
import json
import math
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from uavnav import files, plugins
from uavnav.runs import POLICY, PROGRESS, STOP, Run
from uavnav.runs.tables import LOCK, RunError
from uavnav.training import weights
from uavnav.training.config import TrainConfig, plain
from uavnav.training.recorder import Interrupted, Recorder

SILENT = "{}: its process ended without a word; the same command goes on from the last snapshot"
NOT_SAVED = "{}: not saved, its process ended before it could be; the same command begins these seeds anew"
POLL_SECONDS = 0.2
CHILD = "from uavnav.cli.worker import main; main([])"


def split(config: TrainConfig, folder: Path, n: int) -> dict[Path, TrainConfig]:
    """Each share's folder, by its newest name, and configuration: n runs of consecutive seeds, as even as can be."""
    sizes = [len(range(share, config.n_seeds, n)) for share in range(n)]
    firsts = [config.seed + sum(sizes[:share]) for share in range(n)]
    return {
        _newest(folder / "checkpoint" / f"seeds-{first}-{first + size - 1}"): replace(config, seed=first, n_seeds=size)
        for first, size in zip(firsts, sizes, strict=True)
    }


def _newest(path: Path) -> Path:
    """The folder of a share, under whichever name it was given last."""
    names = {
        int(other.suffix[1:]): other for other in path.parent.glob(f"{path.name}.*") if other.suffix[1:].isdecimal()
    }
    return names[max(names)] if names else path


def take(path: Path) -> Path:
    """Give a share's folder the next name, or make it, so that nobody but its next owner can write there."""
    given = int(path.suffix[1:] or 0)
    taken = path.with_suffix(f".{given + 1}")
    if path.is_dir():
        path.rename(taken)
    else:
        taken.mkdir(parents=True)
    for name in (LOCK, STOP, PROGRESS):
        (taken / name).unlink(missing_ok=True)
    return taken


def snapshot_tables(folder: Path, config: TrainConfig) -> tuple[int, dict[str, pd.DataFrame]]:
    """The newest snapshot of an unfinished run, of all its shares: frames per seed, rows of episodes and of progress.

    Raises:
        RunError: there is none.
    """
    recorder = Recorder(folder, config)
    n = recorder.processes(1)
    if n == 1:
        return recorder.snapshot_tables()
    found = [Recorder(path, share).snapshot_tables() for path, share in split(config, folder, n).items()]
    put = {"episodes": _in_order, "progress": _by_frame}
    tables = {name: together([tables[name] for _, tables in found]) for name, together in put.items()}
    return min(frames for frames, _ in found), tables


def described(
    path: Path, config: TrainConfig, checkpoint_seconds: float, until: int | None = None, threads: int = 1
) -> dict[str, Any]:
    """A run as the process that trains it is told of it, in JSON."""
    return {
        "out": str(path),
        "plugins": list(plugins.LOADED),
        "algorithm": config.algorithm,
        "kind": [type(config).__module__, type(config).__name__],
        "config": plain(config),
        "threads": threads,
        "how": {"checkpoint_seconds": checkpoint_seconds, "until": until},
    }


class Shares:
    """The processes of a run that is being recorded.

    Args:
        recorder: of the whole run, already entered; its log is told every row of progress, of whichever share.
        n: how many processes.
    """

    def __init__(self, recorder: Recorder, n: int) -> None:
        self.recorder, self.log = recorder, recorder.log
        self.shares = split(recorder.config, recorder.path, n)
        for path in self.shares:
            files.remove(path / STOP)  # of a study that was stopped

    def progress(self) -> Generator[tuple[int, list[float]]]:
        """Train all shares, and yield where the whole run is: what `Tell` is told.

        Raises:
            Interrupted: by a signal or as `until` says, and saved.
            RunError: a share cannot go on; the others were stopped and saved.
        """
        said: queue.SimpleQueue[tuple[Path, dict[str, Any] | None]] = queue.SimpleQueue()
        latest: dict[Path, tuple[int, list[float]]] = dict.fromkeys(self.shares, (0, []))
        ended: dict[Path, dict[str, Any]] = {}
        if self.log is not None:
            self.log({"seed": np.empty(0), "frame": np.empty(0)})  # that what cannot be opened is known now
        with self._running(said) as processes:
            stopping = False
            while len(ended) < len(self.shares):
                stopping = stopping or self.recorder.stop is not None
                if stopping:
                    _stop(processes)
                try:
                    path, message = said.get(timeout=POLL_SECONDS)
                except queue.Empty:
                    continue
                if message is not None and "frames" in message:
                    latest[path] = message["frames"], message["rewards"]
                    rewards = [reward for _, part in latest.values() for reward in part]
                    yield min(frames for frames, _ in latest.values()), rewards
                elif message is not None and "rows" in message:
                    assert self.log is not None
                    self.log({name: np.array(column) for name, column in message["rows"].items()})
                elif path not in ended:
                    if message is not None and "finished" in message:
                        latest[path] = message["finished"], latest[path][1]
                    ended[path] = message or (self._left_behind(path) if stopping else {"error": SILENT.format(path)})
                    stopping = stopping or "error" in ended[path] or not ended[path].get("wanted", True)
        errors = [message["error"] for message in ended.values() if "error" in message]
        if errors:
            raise RunError(errors[0])
        stops = {path: message for path, message in ended.items() if "stopped" in message}
        for path, message in stops.items():
            if not message["stopped"]:
                raise Interrupted(NOT_SAVED.format(path), self.recorder.stop or signal.SIGTERM, 0, wanted=False)
        if stops:
            frames = min(message["stopped"] for message in stops.values())
            raise self.recorder.interrupted(frames, wanted=all(message["wanted"] for message in stops.values()))

    def _left_behind(self, path: Path) -> dict[str, Any]:
        """How far the newest snapshot of a share is that was stopped and did not say so; 0 where there is none."""
        try:
            frames, _ = Recorder(path, self.shares[path]).snapshot_tables()
        except RunError:
            frames = 0
        return {"stopped": frames, "wanted": False}

    @contextlib.contextmanager
    def _running(self, said: queue.SimpleQueue[Any]) -> Iterator[list[subprocess.Popen[str]]]:
        processes = []
        try:
            for path, config in self.shares.items():
                process = subprocess.Popen(
                    [sys.executable, "-c", f"import sys; sys.path[:] = {sys.path!r}; {CHILD}"],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    text=True,
                    process_group=0,  # signals of the terminal come to this process alone, and go on from here
                )
                processes.append(process)
                assert process.stdin is not None
                told = described(path, config, self.recorder.checkpoint_seconds, self.recorder.until)
                told["log"] = self.log is not None
                with contextlib.suppress(BrokenPipeError):  # it has ended without a word, as is heard below
                    process.stdin.write(json.dumps(told) + "\n")
                    process.stdin.flush()
                threading.Thread(target=_listen, args=(process, path, said), daemon=True).start()
            yield processes
        finally:
            _stop(processes)
            for process in processes:
                process.wait()


def join(recorder: Recorder, folders: Iterable[Path]) -> Run:
    """Put the finished shares of a run that is being recorded together into the whole run."""
    runs = [Run(path) for path in folders]
    recorder.add_rows(_in_order([run.episodes for run in runs]), _by_frame([run.progress for run in runs]))
    policy = weights.join([run.path / POLICY for run in runs])
    return recorder.finish(policy, runs[0].frames, wall_seconds([run.meta for run in runs]))


def wall_seconds(shares: Iterable[Mapping[str, Any]]) -> float:
    """What shares took together [s], by the facts of each: time in which several of them trained counts once."""
    ends = [(datetime.fromisoformat(facts["ended"]).timestamp(), facts["wall_seconds"]) for facts in shares]
    total, reached = 0.0, -math.inf
    for began, ended in sorted((end - took, end) for end, took in ends):
        total += max(0.0, ended - max(began, reached))
        reached = max(reached, ended)
    return total


def _listen(process: subprocess.Popen[str], path: Path, said: queue.SimpleQueue[Any]) -> None:
    assert process.stdout is not None
    try:
        with process.stdout:
            for line in process.stdout:
                said.put((path, json.loads(line)))
    finally:
        said.put((path, None))


def _stop(processes: Sequence[subprocess.Popen[str]]) -> None:
    """Ask all to save and end, by closing what they listen to: however often it is said, they hear it once."""
    for process in processes:
        if process.stdin is not None:
            with contextlib.suppress(BrokenPipeError):  # of what it was told and never read
                process.stdin.close()


def _in_order(episodes: list[pd.DataFrame]) -> pd.DataFrame:
    """Episodes as one process would have noted them: in the order of their ends, then those cut off, seed by seed."""
    there = [table for table in episodes if len(table)]
    if not there:
        return episodes[0]
    table = pd.concat(there, ignore_index=True)
    open_at_the_end = ~(table["terminated"] | table["truncated"])
    ended = table[~open_at_the_end].sort_values(["frame", "env", "seed"], kind="stable")
    return pd.concat([ended, table[open_at_the_end].sort_values(["seed", "env"])], ignore_index=True)


def _by_frame(progress: list[pd.DataFrame]) -> pd.DataFrame:
    there = [table for table in progress if len(table)]
    if not there:
        return progress[0]
    return pd.concat(there, ignore_index=True).sort_values(["frame", "seed"], kind="stable", ignore_index=True)
