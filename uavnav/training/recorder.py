"""A run while it trains: its rows, its snapshots, its folder, and the signals that stop it."""

from __future__ import annotations

import contextlib
import datetime
import importlib.metadata
import json
import os
import platform
import shutil
import signal
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import pandas as pd
import torch
import yaml
from filelock import FileLock, Timeout
from tensordict import TensorDictBase
from torch import Tensor

from uavnav.algorithms import ALGORITHMS
from uavnav.runs import (
    BEHAVIOUR,
    EVALUATION,
    FILES,
    FINISHED,
    LOG_FOLDERS,
    POLICY,
    Run,
    came_later,
    read_json,
    read_yaml,
)
from uavnav.runs.metrics import EPISODE_COLUMNS, LAST
from uavnav.runs.tables import LOCK, Columns, RunError, parquet, with_reward, write
from uavnav.tasks import layouts
from uavnav.tasks.simulator import COUNTS, State
from uavnav.tasks.world import VERSION
from uavnav.training.checkpoints import CheckpointError, Checkpoints, Snapshot, Stateful, collect, restore
from uavnav.training.config import TrainConfig, plain

if TYPE_CHECKING:
    from torchrl.data import ReplayBuffer

Log = Callable[[Columns], None]
"""Is told rows of progress with a column more: `reward`, as of `with_reward`."""

STOPS = (signal.SIGINT, signal.SIGTERM)
SNAPSHOT_FORMAT = 3
"""Raised when what a snapshot holds of a learner changes."""
CHECKPOINT_SECONDS = 60.0
"""The time between two snapshots."""
CHECKPOINT_SHARE = 0.04
"""What snapshots may take of a run's time: where writing one takes long, the next comes later."""
BANK_FACTS = ("n", "k", "split", "generator_seed", "sha256")


class Interrupted(RunError):
    """SIGINT, SIGTERM or `until` stopped a run; it was saved and can go on, or the message says that it was not."""

    def __init__(self, message: str, signum: int, frames: int, wanted: bool) -> None:
        super().__init__(message)
        self.signum = signum
        self.frames = frames  # per seed, as saved; 0 if nothing was
        self.wanted = wanted  # by `until`


def default_folder(algorithm: str, config: TrainConfig) -> Path:
    """runs/<algorithm>[-<preset>]/<activation>, below the current directory."""
    suffix = "" if config.preset == "paper" else f"-{config.preset}"
    return Path("runs") / f"{algorithm}{suffix}" / config.activation


class Recorder:
    """Collects a run's rows while it trains, saves snapshots, and writes its folder. Nothing is written before `with`.

    Args:
        path: the run's folder.
        algorithm: `ppo` or `dqn`.
        config: of the run.
        overwrite: start anew where the folder holds a run.
        checkpoint_seconds: the least time between two snapshots.
        until: stop after so many frames per seed, as if by a signal.
        log: is told every row of progress, first those of the snapshot from which the run goes on.

    Raises:
        LayoutError: the bank that the run trains on cannot be read.
        RunError: the folder belongs to something else, is in use, or cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        algorithm: str,
        config: TrainConfig,
        overwrite: bool = False,
        checkpoint_seconds: float = CHECKPOINT_SECONDS,
        until: int | None = None,
        log: Log | None = None,
    ) -> None:
        self.path = Path(path)
        self.algorithm = algorithm
        self.config = config
        self._overwrite = overwrite
        self._checkpoint_seconds = checkpoint_seconds
        self._until = until
        self._log = log
        self._episodes: list[Columns] = []
        self._progress: list[Columns] = []
        self._before: dict[str, Any] = {}
        self._recent = [deque[float](maxlen=LAST) for _ in config.seeds]
        _, bank = layouts.read(config.layouts)
        self.meta = _facts() | {"bank": {name: bank.get(name) for name in BANK_FACTS}}
        self._lock = FileLock(self.path / LOCK)
        identity = {**self._described, **{f"version of {name}": v for name, v in self.meta["versions"].items()}}
        identity["bank"] = self.meta["bank"]["sha256"]
        identity["format"] = SNAPSHOT_FORMAT
        self._checkpoints = Checkpoints(self.path / "checkpoint", identity)
        try:
            self.finished = self._check_folder()
        except OSError as error:
            raise self._unwritable(error) from error

    @property
    def _tables(self) -> dict[str, list[Columns]]:
        return {"episodes": self._episodes, "progress": self._progress}

    @property
    def _described(self) -> dict[str, Any]:
        return {"algorithm": self.algorithm, **plain(self.config)}

    def _unwritable(self, error: OSError) -> RunError:
        return RunError(f"out={self.path}: cannot be written ({error}); give a folder that can be written")

    def _check_folder(self) -> bool:
        """Whether the very same run is already there and finished."""
        path = self.path
        for parent in path.parents:
            if parent.exists():
                if not parent.is_dir() or not os.access(parent, os.W_OK):
                    raise RunError(f"out={path}: {parent} is not a folder that can be written; give one that is")
                break
        if path.exists() and not path.is_dir():
            raise RunError(f"out={path}: is a file; give a folder")
        if not path.exists() or all(entry.name == LOCK for entry in path.iterdir()):
            return False
        if not os.access(path, os.W_OK):
            raise RunError(f"out={path}: is not a folder that can be written; give one that is")
        if not (path / "config.yaml").is_file():
            raise RunError(f"out={path}: holds other files and no run; give a new or empty folder")
        there = read_yaml(path / "config.yaml")
        if there.get("algorithm") not in ALGORITHMS:
            raise RunError(f"out={path}: its config.yaml is not a run's; give a new or empty folder")
        there = came_later(self.algorithm) | there
        if self._overwrite:
            return False
        keys = sorted({*there, *self._described}, key=str)
        differing = [key for key in keys if there.get(key) != self._described.get(key)]
        if differing:
            key = differing[0]
            raise RunError(
                f"out={path}: holds a run with {key}={there.get(key)}, not {self._described.get(key)};"
                " give another folder, or overwrite=true"
            )
        if not (path / "meta.json").is_file():
            return False
        meta = read_json(path / "meta.json")
        if meta.get("bank", self.meta["bank"]) != self.meta["bank"]:
            raise RunError(
                f"out={path}: the bank layouts={self.config.layouts} has changed since this run began; give another"
                " folder, or overwrite=true"
            )
        if meta.get("status") != FINISHED:
            self._before = meta if (path / "checkpoint").is_dir() else {}
            return False
        for name in FILES:
            if not (path / name).is_file():
                raise RunError(f"{path / name}: missing; give another folder, or overwrite=true to run again")
        return True

    def __enter__(self) -> Self:
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            self._lock.acquire(blocking=False)
        except Timeout:
            raise RunError(
                f"out={self.path}: another process is writing this run; wait for it, or give another folder"
            ) from None
        except OSError as error:
            raise self._unwritable(error) from error
        try:
            if self._check_folder():
                raise RunError(f"out={self.path}: was finished by another process meanwhile; give the command again")
            self._begin()
        except BaseException:
            self._release()
            raise
        self.stop: int | None = None
        self._handlers: dict[int, Any] = {}
        if threading.current_thread() is threading.main_thread():
            self._handlers = {number: signal.signal(number, self._note_stop) for number in STOPS}
        return self

    def _begin(self) -> None:
        if self._overwrite:
            self._checkpoints.remove()
            for name in (*FILES, EVALUATION, BEHAVIOUR):
                (self.path / name).unlink(missing_ok=True)
        for name in LOG_FOLDERS:  # of an earlier part of the run; every log is whole
            shutil.rmtree(self.path / name, ignore_errors=True)
        self._began = self._saved = time.perf_counter()
        self.meta = self._before | self.meta | {"status": "running", "started": _now()}
        self._write("config.yaml", yaml.safe_dump(self._described, sort_keys=False).encode())
        self._write_meta()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        if kind is not None:
            self.meta |= {"status": "interrupted" if issubclass(kind, (Interrupted, KeyboardInterrupt)) else "failed"}
            with contextlib.suppress(RunError):  # on a full disk the error under way says more
                self._write_meta()
        self._release()

    def _release(self) -> None:
        Path(self._lock.lock_file).unlink(missing_ok=True)
        self._lock.release()

    def _note_stop(self, number: int, frame: object) -> None:
        """The first signal waits for the end of the iteration, a second one does what it would have done."""
        self.stop = number
        signal.signal(number, self._handlers[number])

    def resume(self, parts: Mapping[str, Stateful], replay: ReplayBuffer | None = None) -> int:
        """Go on as `_resume` says, and tell the log what lies behind the run."""
        frames = self._resume(parts, replay)
        if self._log is not None:
            tables = {name: pd.DataFrame(_joined(rows, ["seed", "frame"])) for name, rows in self._tables.items()}
            self._log(with_reward(**tables))
        return frames

    def _resume(self, parts: Mapping[str, Stateful], replay: ReplayBuffer | None) -> int:
        """Set the parts to the newest usable snapshot, where there is one; the frames per seed that it has behind it.

        Raises:
            RunError: there are snapshots and none can be used.
        """
        try:
            snapshot = self._checkpoints.load(replay)
        except CheckpointError as error:
            raise RunError(str(error)) from error
        if snapshot is None:
            return 0
        restore(parts, {name.removeprefix("parts/"): v for name, v in snapshot.tensors.items() if "parts/" in name})
        for table, columns in _snapshot_columns(snapshot).items():
            if columns:
                self._tables[table].append(columns)
        for part in self._episodes:
            for seed, reward in zip(part["seed"].tolist(), part["reward"].tolist(), strict=True):
                self._recent[seed - self.config.seed].append(reward)
        self._began -= snapshot.facts["wall_seconds"]
        return int(snapshot.facts["frames"])

    def checkpoint(self, frames: int, parts: Mapping[str, Stateful], replay: ReplayBuffer | None = None) -> None:
        """Save a snapshot if one is due, or if a signal asks to stop.

        Raises:
            Interrupted: after SIGINT or SIGTERM, and saved.
        """
        now = time.perf_counter()
        wanted = self.stop is None and self._until is not None and frames >= self._until
        if wanted:
            self.stop = signal.SIGTERM
        if self.stop is None and now - self._saved < self._checkpoint_seconds:
            return
        joined = {table: _joined(rows, []) for table, rows in self._tables.items()}
        tables = {
            table: {name: torch.from_numpy(values) for name, values in columns.items()}
            for table, columns in joined.items()
        }
        facts = {
            "frames": frames,
            "wall_seconds": now - self._began,
            "columns": {table: list(columns) for table, columns in joined.items()},
        }
        try:
            self._checkpoints.save(frames, {"parts": collect(parts), **tables}, facts, replay)
        except OSError as error:
            raise RunError(f"{self._checkpoints.folder}: cannot be written ({error})") from error
        self._saved = time.perf_counter()
        self._checkpoint_seconds = max(self._checkpoint_seconds, (self._saved - now) / CHECKPOINT_SHARE)
        if self.stop is not None:
            raise self.interrupted(frames, wanted)

    def interrupted(self, frames: int, wanted: bool) -> Interrupted:
        """What to raise when the run was saved after so many frames per seed; wanted: by `until`."""
        number = self.stop or signal.SIGTERM
        return Interrupted(
            f"{self.path}: stopped by {signal.Signals(number).name} and saved at {frames:,} of"
            f" {self.config.total_frames:,} frames; the same command goes on from there",
            number,
            frames,
            wanted,
        )

    def snapshot_tables(self) -> tuple[int, dict[str, pd.DataFrame]]:
        """The newest snapshot of an unfinished run: its frames per seed, and the rows of episodes and of progress.

        Raises:
            RunError: there is none.
        """
        snapshot = self._checkpoints.load()
        if snapshot is None:
            raise RunError(f"{self.path}: has no snapshot")
        tables = {table: pd.DataFrame(columns) for table, columns in _snapshot_columns(snapshot).items()}
        return int(snapshot.facts["frames"]), tables

    def read(self) -> Run:
        """The finished run that is already there."""
        return Run(self.path)

    def repeat(self, compile: bool) -> bool:
        """Whether to compile, and in how many threads torch works: as the unfinished run began, where there is one.

        Raises:
            RunError: it was compiled, and here that cannot be done.
        """
        before = self._before
        if isinstance(before.get("threads"), int):
            torch.set_num_threads(before["threads"])
        if before.get("compiled") and not compile:
            raise RunError(f"out={self.path}: the run began compiled, and nothing can be compiled here; install g++")
        return bool(before.get("compiled", compile))

    def processes(self, number: int) -> int:
        """In how many processes to train: as the unfinished run began, where there is one."""
        return int(self._before.get("processes", 1)) if self._before else number

    def note(self, **facts: Any) -> None:
        """Add how the run is carried out to meta.json, and to what a snapshot must share with the run that resumes."""
        self.meta |= facts
        self._checkpoints.identity |= facts
        self._write_meta()

    def add_episodes(self, following: TensorDictBase, frame: int) -> None:
        """Keep the episodes that end in a batch.

        following: the ("next", ...) part of collected steps [A, W, T]; frame: per seed, before the batch.
        """
        done = following["done"].squeeze(-1)
        agent, world, time_step = (index.cpu() for index in done.nonzero(as_tuple=True))
        if not len(agent):
            return
        n_worlds = done.shape[1]
        order = torch.argsort(time_step * n_worlds + world, stable=True)
        agent, world, time_step = agent[order], world[order], time_step[order]
        ended = following[agent, world, time_step]
        self._append_episodes(
            agent,
            world,
            frame + (time_step + 1) * n_worlds,
            {name: ended["episode", name] for name in ("layout", *COUNTS)},
            ended["terminated"].squeeze(-1),
            ended["truncated"].squeeze(-1),
        )
        for seed_index, reward in zip(agent.tolist(), ended["episode", "reward"].tolist(), strict=True):
            self._recent[seed_index].append(reward)

    def add_open_episodes(self, state: State, frame: int) -> None:
        """Keep the episodes that the end of training cut off: rows with neither flag."""
        agent, world = (index.cpu() for index in (state.steps > 0).nonzero(as_tuple=True))
        neither = torch.zeros(len(agent), dtype=torch.bool)
        counts = {name: getattr(state, name)[agent, world] for name in ("layout", *COUNTS)}
        self._append_episodes(agent, world, torch.full_like(agent, frame), counts, neither, neither)

    def _append_episodes(
        self,
        agent: Tensor,
        world: Tensor,
        frame: Tensor,
        counts: dict[str, Tensor],
        terminated: Tensor,
        truncated: Tensor,
    ) -> None:
        columns = {
            "seed": agent + self.config.seed,
            "frame": frame,
            "world": world,
            **counts,
            "terminated": terminated,
            "truncated": truncated,
        }
        self._episodes.append({name: columns[name].cpu().numpy() for name in EPISODE_COLUMNS})

    def add_rows(self, episodes: pd.DataFrame, progress: pd.DataFrame) -> None:
        """Keep whole tables of another run's rows."""
        self._episodes.append({str(name): column.to_numpy() for name, column in episodes.items()})
        self._progress.append({str(name): column.to_numpy() for name, column in progress.items()})

    def add_progress(self, frame: int, **values: Tensor | float) -> None:
        """Keep one row a seed: the frame per seed, and values that are [A] or one number for all."""
        n = self.config.n_seeds
        row = {"seed": np.array(self.config.seeds), "frame": np.full(n, frame)}
        for name, value in values.items():
            row[name] = value.detach().cpu().numpy() if isinstance(value, Tensor) else np.full(n, value)
        self._progress.append(row)
        if self._log is not None:
            self._log({**row, "reward": np.array([np.mean(recent) if recent else np.nan for recent in self._recent])})

    def recent_rewards(self) -> list[float]:
        """Each seed's mean reward over its last 100 episodes; seeds without any are left out."""
        return [sum(recent) / len(recent) for recent in self._recent if recent]

    def finish(self, policy: bytes, frames: int, wall_seconds: float | None = None) -> Run:
        """Write everything, the status last, and read it back; wall_seconds: that it took, if others took it."""
        episodes = pd.DataFrame(_joined(self._episodes, list(EPISODE_COLUMNS))).astype(EPISODE_COLUMNS)
        self._write("episodes.parquet", parquet(episodes))
        self._write("progress.parquet", parquet(pd.DataFrame(_joined(self._progress, ["seed", "frame"]))))
        self._write(POLICY, policy)
        wall = time.perf_counter() - self._began if wall_seconds is None else wall_seconds
        self.meta |= {"status": FINISHED, "frames": frames, "wall_seconds": round(wall, 3), "ended": _now()}
        self._write_meta()
        self._checkpoints.remove()
        return Run(self.path, fresh=True)

    def _write_meta(self) -> None:
        self._write("meta.json", json.dumps(self.meta, indent=2).encode())

    def _write(self, name: str, content: bytes) -> None:
        """Write aside, then rename: the file is whole or not there."""
        write(self.path / name, content)


def _snapshot_columns(snapshot: Snapshot) -> dict[str, Columns]:
    return {
        table: {name: snapshot.tensors[f"{table}/{name}"].numpy() for name in names}
        for table, names in snapshot.facts["columns"].items()
    }


def _joined(parts: list[Columns], columns: list[str]) -> Columns:
    if not parts:
        return {name: np.empty(0) for name in columns}
    return {
        name: np.concatenate([part.get(name, np.full(len(part["seed"]), np.nan)) for part in parts])
        for name in dict.fromkeys(name for part in parts for name in part)
    }


def _facts() -> dict[str, Any]:
    """What a repeat on another machine or version would have to know."""
    return {
        "versions": {
            "python": platform.python_version(),
            "world": VERSION,
            **{
                name: importlib.metadata.version(name) for name in ("uavnav", "torch", "torchrl", "tensordict", "numpy")
            },
        },
        "git_commit": _git_commit(),
        "machine": {"system": platform.platform(), "processor": _processor(), "cores": os.cpu_count()},
    }


def _git_commit() -> str | None:
    """The commit of the code that runs, with `+` where the tree differs from it; None outside a checkout."""
    if shutil.which("git") is None:
        return None
    here = Path(__file__).parent
    commands = ["rev-parse", "HEAD"], ["status", "--porcelain", "--untracked-files=no"]
    results = [
        subprocess.run(["git", "-C", str(here), *command], capture_output=True, text=True, check=False)
        for command in commands
    ]
    if any(result.returncode for result in results):
        return None
    return results[0].stdout.strip() + ("+" if results[1].stdout.strip() else "")


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
