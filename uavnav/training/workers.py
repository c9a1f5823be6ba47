"""A run's seeds spread over processes: each worker is an ordinary run of some seeds, below the run's folder.

    workers/0        a run's folder: settings, snapshots and lock; its tables once it has finished
    workers/0.job    what its process is told, in JSON
    workers/0.ended  how its process ended, in JSON
    workers/0.log    what its process prints, where a study has given it to an engine

Whoever starts a worker reads its `progress.json`. Closing its standard input, or the file `stop`, has it save
and end. When all have finished, their rows and weights are put together, and `workers` goes.

A worker may be given to another process. Its folder then gets the next name, `0.2` after `0.1`: the former
process, if it lives on, finds its folder gone and can no longer write.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from uavnav import files, plugins
from uavnav.runs import POLICY, PROGRESS, STOP, WORKERS, Run, kept, progress
from uavnav.runs.lately import NOTHING, Lately, all_seeds
from uavnav.runs.metrics import has_ended
from uavnav.runs.tables import LOCK, RunError, joined, with_reward, write
from uavnav.training import heartbeat, weights
from uavnav.training.config import TrainConfig, plain
from uavnav.training.display import Update
from uavnav.training.recorder import Interrupted, Log, Recorder

POLL_SECONDS = 0.2
STOP_SECONDS = 60.0  # given to workers to save themselves
END_SECONDS = 10.0  # given to processes to end after SIGTERM

Process = subprocess.Popen[bytes]


@dataclass
class Worker:
    """Some seeds of a run, which a process of their own trains."""

    folder: Path  # theirs, by the name that it was given last
    config: TrainConfig  # the run's, with only these seeds
    frames: int = 0  # per seed so far
    rate: float = 0.0  # frames a second of each seed, while it runs
    lately: Lately = NOTHING
    logged: int = 0  # frames per seed of which a log was told
    attempts: int = 0  # since it last got further
    done: bool = False

    def file(self, end: str) -> Path:
        """One of the files next to its folder."""
        return self.folder.with_name(f"{self.folder.name}.{end}")

    def take(self) -> None:
        """Give its folder the next name, or make it, so that only the process that is started next can
        write there.
        """
        if self.folder.is_dir():
            taken = self.folder.with_suffix(f".{int(self.folder.suffix[1:] or 0) + 1}")
            self.folder = self.folder.rename(taken)
        else:
            self.folder.mkdir(parents=True)
        for name in (LOCK, STOP, PROGRESS):
            (self.folder / name).unlink(missing_ok=True)
        for end in ("ended", "log"):
            self.file(end).unlink(missing_ok=True)

    def prepare(self, threads: int, evaluation: dict[str, Any] | None = None, **how: Any) -> list[str]:
        """Take its folder, and describe its work there; returns the words of `uavnav.cli.worker`.

        threads: of its process; evaluation: how it is evaluated in the end, if it is; how: further arguments
        of its `Recorder`.
        """
        try:
            self.take()
        except OSError as error:
            raise RunError(f"{self.folder}: cannot be written ({error})") from error
        told: dict[str, Any] = {
            "out": str(self.folder),
            "folder": str(Path.cwd()),
            "config": plain(self.config),
            "threads": threads,
            "evaluation": evaluation,
            "how": how,
        }
        write(self.file("job"), json.dumps(told).encode())
        kind = type(self.config)
        return [*plugins.LOADED, f"{kind.__module__}:{kind.__name__}", str(self.file("job"))]

    def look(self) -> None:
        """See how far it is."""
        told = progress(self.folder)
        self.frames, self.lately = told.get("frames", self.frames), told.get("lately", self.lately)

    def problem(self, status: int | None) -> str:
        """What its process said was wrong; status: of the process, if it has ended."""
        unwritten = "cannot be written; make room there, and the same command goes on from the last snapshot"
        usual = f"{self.folder}: {unwritten}" if status == os.EX_IOERR else ""
        return str(last_words(self.file("ended")).get("error", usual))

    def saved(self) -> int:
        """The frames per seed behind its newest snapshot, or all where it has finished; 0: none is saved."""
        try:
            recorder = Recorder(self.folder, self.config)
            return self.config.frames if recorder.finished else recorder.snapshot_tables()[0]
        except RunError:
            return 0


def last_words(file: Path) -> dict[str, Any]:
    """What a process wrote into a file when it ended; empty where it has not, or died."""
    try:
        found = files.read_json(file)
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def split(config: TrainConfig, folder: Path, n: int) -> list[Worker]:
    """The workers of a run in a folder: n runs of consecutive seeds, as even as can be."""
    sizes = [len(range(worker, config.n_seeds, n)) for worker in range(n)]
    firsts = [config.seed + sum(sizes[:worker]) for worker in range(n)]
    return [
        Worker(_newest(folder / WORKERS / str(number)), config.replace(seed=first, n_seeds=size))
        for number, (first, size) in enumerate(zip(firsts, sizes, strict=True))
    ]


def _newest(path: Path) -> Path:
    """The folder of a worker, by the name that it was given last."""
    names = {
        int(one.suffix[1:]): one for one in path.parent.glob(f"{path.name}.*") if one.suffix[1:].isdecimal()
    }
    return names[max(names)] if names else path


def train(recorder: Recorder, n: int, threads: int, tell: Update) -> Run:
    """Train the seeds of a run in n workers of this machine, and put them together.

    Args:
        recorder: of the whole run, already entered; its log is told every row of progress, of whichever
            worker.
        n: how many workers.
        threads: of each.
        tell: is told where the whole run is.

    Raises:
        Interrupted: by a signal or as `until` says, and saved.
        RunError: a worker cannot go on; the others were stopped and saved.
    """
    workers = split(recorder.config, recorder.path, n)
    if recorder.log is not None:
        recorder.log({"seed": np.empty(0), "frame": np.empty(0)})  # that what cannot be opened is known now
    _log(recorder.log, workers)
    with _started(recorder, workers, threads) as processes:
        problem = _watch(recorder, workers, processes, tell)
    ended = zip(workers, processes, strict=True)
    problems = [problem, *(worker.problem(process.returncode) for worker, process in ended)]
    if any(problems):
        raise RunError(next(filter(None, problems)))
    saved = [worker.saved() for worker in workers]
    if not all(saved):
        folder = workers[saved.index(0)].folder
        again = "its process ended before it could be; the same command begins these seeds anew"
        raise Interrupted(f"{folder}: not saved, {again}", recorder.stop or signal.SIGTERM, 0, wanted=False)
    # all frames may be saved and no run written
    if not all(Recorder(worker.folder, worker.config).finished for worker in workers):
        frames, wanted = min(saved), recorder.stop is None
        raise recorder.interrupted(frames, wanted and frames >= (recorder.until or math.inf))
    _log(recorder.log, workers)
    run = join(recorder, workers)
    tell(run.frames, recorder.heartbeat.lately)
    return run


def _watch(recorder: Recorder, workers: Sequence[Worker], processes: Sequence[Process], tell: Update) -> str:
    """Wait until all workers have ended, or all shall stop: because of a signal, or as one of them ended too
    early. Returns what is wrong with that one, if anything is.
    """
    running = list(zip(workers, processes, strict=True))
    goal = min(recorder.until or math.inf, recorder.config.frames)
    before, logged = (0, NOTHING), time.monotonic()
    while running and recorder.stop is None:
        time.sleep(POLL_SECONDS)
        for worker, process in [*running]:
            worker.look()
            status, words = process.poll(), last_words(worker.file("ended"))
            if status is not None or words:
                running.remove((worker, process))
                if worker.saved() < goal:
                    goes_on = "the same command goes on from the last snapshot"
                    silent = f"{worker.folder}: its process ended without a word; {goes_on}"
                    return worker.problem(status) or ("" if words else silent)
        lately = all_seeds([worker.lately for worker in workers])
        now = min(worker.frames for worker in workers), lately
        recorder.heartbeat.lately = lately
        recorder.tell(now[0])
        if now != before:
            tell(*now)
        before = now
        if time.monotonic() - logged > max(heartbeat.SECONDS, recorder.checkpoint_seconds):
            _log(recorder.log, workers)
            logged = time.monotonic()
    return ""


@contextlib.contextmanager
def _started(recorder: Recorder, workers: Sequence[Worker], threads: int) -> Iterator[list[Process]]:
    """The processes of workers; those that run in the end are stopped."""
    processes: list[Process] = []
    how: dict[str, Any] = {
        "checkpoint_seconds": recorder.checkpoint_seconds,
        "until": recorder.until,
        "watched": True,
    }
    begin = f"import sys; sys.path[:] = {sys.path!r}; from uavnav.cli.worker import main; main(sys.argv[1:])"
    try:
        for worker in workers:
            command = [sys.executable, "-c", begin, *worker.prepare(threads, **how)]
            # what is printed goes to stderr; signals of the terminal come only to this process
            process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=2, process_group=0)
            processes.append(process)
        yield processes
    finally:
        for process in processes:
            assert process.stdin is not None
            process.stdin.close()  # it is watched: a worker then saves and ends
        end(processes, STOP_SECONDS)


def end(processes: Sequence[Process], seconds: float = 0.0) -> None:
    """Wait for processes to end; then they get a SIGTERM, and after `END_SECONDS` more a SIGKILL."""
    for limit, insist in ((seconds, Process.terminate), (END_SECONDS, Process.kill)):
        since = time.monotonic()
        while any(process.poll() is None for process in processes) and time.monotonic() < since + limit:
            time.sleep(POLL_SECONDS)
        for process in processes:
            insist(process)
    for process in processes:
        process.wait()


def _log(log: Log | None, workers: Sequence[Worker]) -> None:
    """Tell a run's log, where there is one, those rows of its workers that it was not told yet."""
    if log is None:
        return
    for worker in workers:
        try:
            own = Recorder(worker.folder, worker.config)
            run = Run(worker.folder) if own.finished else None
            tables = {"episodes": run.episodes, "progress": run.progress} if run else own.snapshot_tables()[1]
        except RunError:  # it has no snapshot yet
            continue
        if len(tables["progress"]):
            rows = with_reward(**tables)
            new = rows["frame"] > worker.logged
            worker.logged = int(rows["frame"].max())
            log({name: column[new] for name, column in rows.items()})


def snapshot_tables(folder: Path, config: TrainConfig) -> tuple[int, dict[str, pd.DataFrame]]:
    """`Recorder.snapshot_tables` of an unfinished run, of all its workers."""
    recorder = Recorder(folder, config)
    n = recorder.processes(1)
    if n == 1:
        return recorder.snapshot_tables()
    found = [Recorder(worker.folder, worker.config).snapshot_tables() for worker in split(config, folder, n)]
    episodes = _in_order([tables["episodes"] for _, tables in found])
    progress = _by_frame([tables["progress"] for _, tables in found])
    return min(frames for frames, _ in found), {"episodes": episodes, "progress": progress}


def join(recorder: Recorder, workers: Sequence[Worker]) -> Run:
    """Put the finished workers of a run under way together; it took as long as the slowest of them."""
    runs = [Run(worker.folder) for worker in workers]
    recorder.add_rows(_in_order([run.episodes for run in runs]), _by_frame([run.progress for run in runs]))
    recorder.heartbeat.lately = all_seeds([Lately(**run.meta.get("lately", {})) for run in runs])
    for name in map(kept, recorder.config.keep_at):
        write(recorder.path / name, weights.join([run.path / name for run in runs]))
    policy = weights.join([run.path / POLICY for run in runs])
    return recorder.finish(policy, runs[0].frames, max(run.meta["wall_seconds"] for run in runs))


def _in_order(episodes: list[pd.DataFrame]) -> pd.DataFrame:
    """Episodes as one process would have noted them: in the order of their ends, then those cut off."""
    table = joined(episodes)
    if table.empty:  # it may have no columns
        return table
    open_at_the_end = ~has_ended(table)
    ended = table[~open_at_the_end].sort_values(["frame", "env", "seed"], kind="stable")
    return pd.concat([ended, table[open_at_the_end].sort_values(["seed", "env"])], ignore_index=True)


def _by_frame(progress: list[pd.DataFrame]) -> pd.DataFrame:
    table = joined(progress)
    return table if table.empty else table.sort_values(["frame", "seed"], kind="stable", ignore_index=True)
