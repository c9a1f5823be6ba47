"""A run's seeds spread over processes: each trains its share of them as a run of its own.

The shares lie in `checkpoint/` below the run's folder, every one with its own snapshots, and are put together when all
have finished. A process gets its settings as JSON and tells its progress as lines of JSON; it saves and ends when the
one that started it is gone.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import inspect
import json
import os
import queue
import select
import signal
import subprocess
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd

from uavnav.choices import ConfigError
from uavnav.runs import POLICY, Run
from uavnav.runs.tables import Columns, RunError, with_reward
from uavnav.tasks.layouts import LayoutError
from uavnav.training import loggers, machine, weights
from uavnav.training.config import TrainConfig, plain
from uavnav.training.display import Display
from uavnav.training.recorder import CHECKPOINT_SECONDS, STOPS, Interrupted, Log, Recorder, default_folder

C = TypeVar("C", bound=TrainConfig)

Tell = Callable[[int, list[float]], None]
"""Is told the frames per seed so far, and each seed's mean reward over its last 100 episodes."""

EXPECTED = (ConfigError, LayoutError, RunError)
SILENT = "{}: its process ended without a word; the same command goes on from the last snapshot"
NOT_SAVED = "{}: not saved, its process ended before it could be; the same command begins these seeds anew"
POLL_SECONDS = 0.2
STOP_SECONDS = 1.0
"""Between two askings of a share to stop: before its run has begun it does not hear."""


def spread(check: Callable[[Any], None] | None = None) -> Callable[[Callable[..., Run]], Callable[..., Run]]:
    """Let a training function of an algorithm's module use as many processes as pay, and its caller's threads be.

    check: of the configuration of all seeds, before anything is written.
    """

    def decorate(train: Callable[..., Run]) -> Callable[..., Run]:
        def spread_train(
            config: C,
            out: str | Path | None = None,
            overwrite: bool = False,
            quiet: bool = False,
            checkpoint_seconds: float = CHECKPOINT_SECONDS,
            until: int | None = None,
            tell: Tell | None = None,
            processes: int | None = None,
            logger: str | Sequence[str] = loggers.NONE,
        ) -> Run:
            names = loggers.chosen(logger)
            module = importlib.import_module(train.__module__)
            folder = Path(out or default_folder(module.ALGORITHM, config))
            recorder = Recorder(folder, module.ALGORITHM, config, overwrite, checkpoint_seconds, until)
            if recorder.finished:
                run = recorder.read()
                loggers.log_finished(run, names)
                return run
            if check is not None:
                check(config)
            n = recorder.processes(machine.processes(config) if processes is None else _checked(processes, config))
            if n > 1 and (own := machine.own_parts(config)):
                raise ConfigError(f"processes={n}: {own} is known to this process alone; give processes=1")
            logs = loggers.Logs(names, folder, module.ALGORITHM, plain(config))
            log = logs if names else None
            if n > 1:
                with contextlib.closing(logs), machine.use_threads(1):
                    compile = recorder.repeat(machine.decide(config))
                    beyond = config.beyond(module.PRESETS[config.preset])
                    with recorder, Display(module.ALGORITHM, config, config.total_frames, quiet, tell) as display:
                        recorder.note(compiled=compile, threads=1, processes=n, beyond_preset=beyond)
                        display.begin(folder, recorder.meta, until)
                        shares = Shares(recorder, config, n, checkpoint_seconds, until, log)
                        with contextlib.closing(shares.progress()) as steps:
                            for frames, rewards in steps:
                                display.update(frames, rewards)
                        return shares.join()
            machine.keep_memory_flat()
            with contextlib.closing(logs), machine.use_threads(machine.threads(config)):
                return train(config, folder, overwrite, quiet, checkpoint_seconds, until, tell, log)

        signature = _signature(spread_train, train)
        functools.update_wrapper(spread_train, train)
        spread_train.__signature__ = signature  # type: ignore[attr-defined]
        return spread_train

    return decorate


def _signature(outer: Callable[..., Run], inner: Callable[..., Run]) -> inspect.Signature:
    """The outer function's, on the inner one's kind of configuration."""
    signature = inspect.signature(outer)
    own = {**signature.parameters, "config": inspect.signature(inner).parameters["config"]}
    return signature.replace(parameters=list(own.values()))


def _checked(processes: int, config: TrainConfig) -> int:
    if type(processes) is not int or not 1 <= processes <= config.n_seeds:
        raise ConfigError(f"processes={processes}; give a whole number from 1 to n_seeds={config.n_seeds}")
    return processes


def split(config: C, folder: Path, n: int) -> dict[Path, C]:
    """Each share's folder and configuration: n runs of consecutive seeds, as even as can be."""
    sizes = [len(range(share, config.n_seeds, n)) for share in range(n)]
    firsts = [config.seed + sum(sizes[:share]) for share in range(n)]
    return {
        folder / "checkpoint" / f"seeds-{first}-{first + size - 1}": replace(config, seed=first, n_seeds=size)
        for first, size in zip(firsts, sizes, strict=True)
    }


def snapshot_tables(folder: Path, algorithm: str, config: TrainConfig) -> tuple[int, dict[str, pd.DataFrame]]:
    """The newest snapshot of an unfinished run, of all its shares: frames per seed, rows of episodes and of progress.

    Raises:
        RunError: there is none.
    """
    recorder = Recorder(folder, algorithm, config)
    n = recorder.processes(1)
    if n == 1:
        return recorder.snapshot_tables()
    found = [Recorder(path, algorithm, share).snapshot_tables() for path, share in split(config, folder, n).items()]
    tables = {name: [tables[name] for _, tables in found] for name in ("episodes", "progress")}
    return min(frames for frames, _ in found), {
        "episodes": _in_order(tables["episodes"]),
        "progress": _by_frame(tables["progress"]),
    }


class Shares:
    """The processes of a run that is being recorded.

    Args:
        recorder: of the whole run, already entered.
        config: of the whole run.
        n: how many processes.
        checkpoint_seconds, until: as for training.
        log: is told every row of progress, of whichever share.
    """

    def __init__(
        self,
        recorder: Recorder,
        config: TrainConfig,
        n: int,
        checkpoint_seconds: float,
        until: int | None,
        log: Log | None = None,
    ) -> None:
        self.recorder, self.config, self.log = recorder, config, log
        self.shares = split(config, recorder.path, n)
        self.how = {
            "algorithm": recorder.algorithm,
            "checkpoint_seconds": checkpoint_seconds,
            "until": until,
            "log": log is not None,
        }

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
                if self.recorder.stop is not None and not stopping:
                    stopping = True
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
                    if "error" in ended[path] or not ended[path].get("wanted", True):
                        stopping = True
                        _stop(processes)
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
            frames, _ = Recorder(path, self.recorder.algorithm, self.shares[path]).snapshot_tables()
        except RunError:
            frames = 0
        return {"stopped": frames, "wanted": False}

    @contextlib.contextmanager
    def _running(self, said: queue.SimpleQueue[Any]) -> Iterator[list[subprocess.Popen[str]]]:
        processes = []
        try:
            for path, config in self.shares.items():
                process = subprocess.Popen(
                    [
                        sys.executable,
                        "-c",
                        f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import main; main()",
                    ],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    text=True,
                    process_group=0,  # signals of the terminal come to this process alone, and go on from here
                )
                processes.append(process)
                assert process.stdin is not None
                process.stdin.write(json.dumps({**self.how, "out": str(path), "config": plain(config)}) + "\n")
                process.stdin.flush()
                threading.Thread(target=_listen, args=(process, path, said), daemon=True).start()
            yield processes
        finally:
            _stop(processes)
            for process in processes:
                process.wait()

    def join(self) -> Run:
        """Put the finished shares together into the whole run."""
        runs = [Run(path) for path in self.shares]
        self.recorder.add_rows(_in_order([run.episodes for run in runs]), _by_frame([run.progress for run in runs]))
        policy = weights.join([run.path / POLICY for run in runs])
        return self.recorder.finish(policy, runs[0].frames, max(run.meta["wall_seconds"] for run in runs))


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
            process.stdin.close()


def _in_order(episodes: list[pd.DataFrame]) -> pd.DataFrame:
    """Episodes as one process would have noted them: in the order of their ends, then those cut off, seed by seed."""
    there = [table for table in episodes if len(table)]
    if not there:
        return episodes[0]
    table = pd.concat(there, ignore_index=True)
    open_at_the_end = ~(table["terminated"] | table["truncated"])
    ended = table[~open_at_the_end].sort_values(["frame", "world", "seed"], kind="stable")
    return pd.concat([ended, table[open_at_the_end].sort_values(["seed", "world"])], ignore_index=True)


def _by_frame(progress: list[pd.DataFrame]) -> pd.DataFrame:
    there = [table for table in progress if len(table)]
    if not there:
        return progress[0]
    return pd.concat(there, ignore_index=True).sort_values(["frame", "seed"], kind="stable", ignore_index=True)


# -- in the process of a share ----------------------------------------------------------------------------------------


def _say(channel: int, **message: Any) -> None:
    line = (json.dumps(message) + "\n").encode()
    with contextlib.suppress(BrokenPipeError):  # the one that listened is gone: a stop is on its way
        while line:
            line = line[os.write(channel, line) :]  # a signal may cut a long one


def _say_rows(channel: int, rows: Columns) -> None:
    _say(channel, rows={name: column.tolist() for name, column in rows.items()})


def _end_with_parent(over: threading.Event) -> None:
    """Once the one that holds the other end of the standard input is gone, ask for a stop until the run is over."""
    channel = sys.stdin.fileno()
    while not over.is_set():
        said, _, _ = select.select([channel], [], [], POLL_SECONDS)
        if said and not os.read(channel, 1):
            os.kill(os.getpid(), signal.SIGTERM)
            over.wait(STOP_SECONDS)


def _hear_nothing(number: int, frame: object) -> None:
    """Let a signal pass, as `signal.SIG_IGN` does, which a compiler that is started would inherit."""


def main() -> None:
    """Train the share that is described on the standard input."""
    channel = os.dup(sys.stdout.fileno())
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what a library prints is no message
    warnings.formatwarning = lambda message, *where, **more: f"{message}\n"
    warnings.filterwarnings("ignore", machine.EAGER)  # the one that started this process has said it
    for number in STOPS:
        signal.signal(number, _hear_nothing)  # a run hears the first signal, and then this is there again
    described = json.loads(sys.stdin.readline())
    over = threading.Event()
    watch = threading.Thread(target=_end_with_parent, args=[over], daemon=True)
    watch.start()
    module = importlib.import_module(f"uavnav.{described['algorithm']}")
    kind = type(next(iter(module.PRESETS.values())))
    log = functools.partial(_say_rows, channel) if described["log"] else None
    machine.keep_memory_flat()
    try:
        with machine.use_threads(1):
            run = module.train.__wrapped__(
                kind.from_mapping(described["config"]),
                Path(described["out"]),
                quiet=True,
                checkpoint_seconds=described["checkpoint_seconds"],
                until=described["until"],
                tell=lambda frames, rewards: _say(channel, frames=frames, rewards=rewards),
                log=log,
            )
        if log is not None and not run.fresh:  # this share had already finished
            log(with_reward(run.progress, run.episodes))
        last = {"finished": run.frames}
    except Interrupted as stop:
        last = {"stopped": stop.frames, "wanted": stop.wanted}
    except EXPECTED as error:
        last = {"error": str(error)}
    except Exception as error:
        traceback.print_exc()
        last = {"error": f"{described['out']}: {type(error).__name__}, see above"}
    for number in STOPS:
        signal.signal(number, signal.SIG_IGN)  # there is nothing left to save
    _say(channel, **last)
    over.set()
    watch.join()  # a thread that woke while the interpreter ends would end the process loudly
