"""A run while it trains: its rows, its snapshots, its folder, and the signals that stop it."""

from __future__ import annotations

import contextlib
import datetime
import hashlib
import json
import os
import shutil
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

import numpy as np
import pandas as pd
import torch
import yaml
from filelock import FileLock, Timeout
from pydantic import Field
from tensordict import TensorDictBase
from torch import Tensor

from uavnav import files, plugins
from uavnav.runs import (
    FILES,
    FINISHED,
    KEPT,
    LOG_FOLDERS,
    POLICY,
    PROGRESS,
    STOP,
    WORKERS,
    Run,
    kept,
    read_settings,
)
from uavnav.runs.lately import Lately, Watch
from uavnav.runs.metrics import EPISODE_COLUMNS, LAST
from uavnav.runs.tables import LOCK, Columns, RunError, with_reward, write, write_table
from uavnav.tasks import layouts
from uavnav.tasks.state import COUNTS, State
from uavnav.tasks.table import TASKS
from uavnav.training import provenance, weights
from uavnav.training.checkpoints import Checkpoints, Snapshot, Stateful
from uavnav.training.config import TrainConfig, plain
from uavnav.training.heartbeat import Heartbeat

if TYPE_CHECKING:
    from torchrl.data import ReplayBuffer

Log = Callable[[Columns], None]  # is told rows of progress with a column more: `reward`, as of `with_reward`

STOPS = (signal.SIGINT, signal.SIGTERM)
HEARD = b"\nstopping: the run is saved after this iteration; a second Ctrl-C ends it at once, unsaved\n"
"""Said on a terminal at the first of them."""
SNAPSHOT_FORMAT = 8  # raised when what a snapshot contains of a learner changes
CHECKPOINT_SECONDS = 60.0  # the time between two snapshots
CHECKPOINT_SHARE = 0.04
"""What snapshots may take of a run's time: where writing one takes long, the next comes later."""
UNFINISHED = ("checkpoint", WORKERS)  # folders of a run that is not finished
LAYOUT_FACTS = ("n", "k", "split", "generator_seed", "sha256")


class Tables(files.Facts):
    """The columns of a snapshot's tables, in order; none where there were no rows."""

    episodes: list[str]
    progress: list[str]


class Rows(files.Facts):
    """What a run notes in a snapshot, besides its frames."""

    wall_seconds: Annotated[float, Field(ge=0)]
    columns: Tables
    curve: list[float] = Field(default_factory=list)


class Interrupted(RunError):
    """SIGINT, SIGTERM or `until` stopped a run, which was saved and can go on, or its message says not."""

    def __init__(self, message: str, signum: int, frames: int, wanted: bool) -> None:
        super().__init__(message)
        self.status = 128 + signum
        self.frames = frames  # per seed, as saved; 0 if nothing was
        self.wanted = wanted  # by `until`


class OtherRun(RunError):
    """A folder contains a run of another configuration."""


def free_folder(config: TrainConfig) -> Path:
    """Where a run goes for which no folder is given; a hash is behind it where another run is there."""
    folder = config.folder
    if os.path.lexists(folder / "config.yaml"):
        try:
            Recorder(folder, config)
        except OtherRun:
            _, about = layouts.read(config.layouts, config.world)
            told = json.dumps([plain(config), about.get("sha256")]).encode()
            return folder.with_name(f"{folder.name}-{hashlib.sha256(told).hexdigest()[:8]}")
        except RunError:
            pass  # training in the folder raises it
    return folder


class Recorder:
    """Collects a run's rows while it trains, saves snapshots, and writes its folder. Nothing is written
    before `with`.

    Args:
        path: the run's folder.
        config, overwrite, checkpoint_seconds, until: as of `uavnav.training.loop.train`.
        log: is told every row of progress, first those of the snapshot from which the run goes on.
        watched: whether another process watches the run as a worker of its own (see `Heartbeat`).

    Raises:
        LayoutError: the split that the run trains on cannot be read.
        RunError: the folder belongs to something else, is in use, or cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        config: TrainConfig,
        overwrite: bool = False,
        checkpoint_seconds: float = CHECKPOINT_SECONDS,
        until: int | None = None,
        log: Log | None = None,
        watched: bool = False,
    ) -> None:
        self.path, self.config, self._overwrite = Path(path), config, overwrite
        self.checkpoint_seconds, self.until, self.log, self.watched = checkpoint_seconds, until, log, watched
        self._tables: dict[str, list[Columns]] = {"episodes": [], "progress": []}
        self._before: dict[str, Any] = {}
        self._recent: list[deque[float]] = []
        _, all_layouts = layouts.read(config.layouts, config.world)
        self.meta = provenance.facts() | {"layouts": {name: all_layouts.get(name) for name in LAYOUT_FACTS}}
        self._lock = FileLock(self.path / LOCK)
        self._described = {"algorithm": config.algorithm, **plain(config)}
        noted = self.meta.get("plugins", {})
        identity = {
            **self._described,
            **{f"version of {name}": v for name, v in self.meta["versions"].items()},
            "layouts": self.meta["layouts"]["sha256"],  # whatever path leads to it
            "format": SNAPSHOT_FORMAT,
            "plugins": sorted(noted),
            **{f"version of {name}.py": sha[:12] for name, sha in noted.items()},
        }
        self._checkpoints = Checkpoints(self.path / "checkpoint", identity)
        try:
            self.finished = self._check_folder()
        except OSError as error:
            raise self._unwritable(error) from error

    def _unwritable(self, error: OSError) -> RunError:
        return RunError(f"out={self.path}: cannot be written ({error}); give a folder that can be written")

    @staticmethod
    def _no_run_yet(file: Path) -> bool:
        """Whether a file may be where a run begins: a lock, a word to a worker, or what a kill left half."""
        return file.name in (LOCK, STOP, PROGRESS) or file.suffix == files.ASIDE

    def _check_folder(self) -> bool:
        """Whether the very same run is already there and finished; without its policy it starts anew."""
        path = self.path
        try:
            named = b"\0" not in os.fsencode(path)
        except UnicodeEncodeError:
            named = False
        if not named:
            raise RunError(f"out={path}: no folder can have such a name; give another")
        if path.exists() and not path.is_dir():
            raise RunError(f"out={path}: is a file; give a folder")
        nearest = files.nearest(path)
        if not nearest.is_dir() or not os.access(nearest, os.W_OK):
            raise RunError(f"out={path}: {nearest} is not a folder that can be written; give one that is")
        if not path.exists() or all(map(self._no_run_yet, path.iterdir())):
            return False
        if not os.path.lexists(path / "config.yaml"):
            raise RunError(f"out={path}: contains other files and no run; give a new or empty folder")
        there = read_settings(path / "config.yaml", "give a new or empty folder")
        if self._overwrite:
            return False
        meta = read_settings(path / "meta.json") if os.path.lexists(path / "meta.json") else {}
        if there.get("task", self.config.task) not in TASKS:
            needed = plugins.missing(meta.get("plugins", {}))
            raise OtherRun(
                f"out={path}: contains a run with task={there['task']}; give another folder{needed}"
            )
        if there["algorithm"] == self.config.algorithm:
            there = {"algorithm": there["algorithm"], **self.config.as_run(there)}
        same_layouts = meta.get("layouts", self.meta["layouts"]) == self.meta["layouts"]
        for key in sorted({*there, *self._described}, key=lambda key: (key != "algorithm", str(key))):
            if there.get(key) != self._described.get(key) and not (
                key == "layouts" and meta and same_layouts
            ):
                raise OtherRun(
                    f"out={path}: contains a run with {key}={there.get(key)}, not {self._described.get(key)};"
                    " give another folder, or overwrite=true"
                )
        if not same_layouts:
            raise OtherRun(
                f"out={path}: the split layouts={self.config.layouts} has changed since this run began; "
                "give another folder, or overwrite=true"
            )
        if meta.get("status") != FINISHED:
            self._before = meta if any((path / name).is_dir() for name in UNFINISHED) else {}
            return False
        self._overwrite = not os.path.lexists(path / POLICY)  # a repository may keep only a run's rows
        return not self._overwrite

    def __enter__(self) -> Self:
        self._recent = [deque[float](maxlen=LAST) for _ in self.config.seeds]
        self._watch = Watch(self.config.seeds, self.config.n_envs, self.config.frames)
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            self._lock.acquire(blocking=False)
            try:
                if self._check_folder():
                    raise RunError(
                        f"out={self.path}: was finished by another process meanwhile; give the command again"
                    )
                self._begin()
            except BaseException:
                self._release()
                raise
        except Timeout:
            raise RunError(
                f"out={self.path}: another process is writing this run; wait for it, or give another folder"
            ) from None
        except OSError as error:
            raise self._unwritable(error) from error
        self.stop: int | None = None
        self._handlers: dict[int, Any] = {}
        # Ctrl-C is noted: the next `checkpoint` saves and raises `Interrupted`; a second one ends at once
        if threading.current_thread() is threading.main_thread():
            self._handlers = {number: signal.signal(number, self._note_stop) for number in STOPS}
        self.heartbeat = Heartbeat(self.path, self.config.frames, watched=self.watched)
        self.heartbeat.__enter__()
        return self

    def _begin(self) -> None:
        if self._overwrite:
            there = (
                *(self.path / name for name in (*FILES, STOP)),
                *self.path.glob("*.parquet"),
                *self.path.glob(f"{KEPT}*"),
                *(one for what in ("across", "transfer") for one in self.path.glob(f"{what}-*.[ps][nv]g")),
            )
            if folder := next((path for path in there if path.is_dir() and not path.is_symlink()), None):
                raise RunError(f"out={self.path}: {folder.name} is a folder; give another folder")
            self._remove_unfinished()
            for path in there:
                path.unlink(missing_ok=True)
        for name in LOG_FOLDERS:  # of an earlier part of the run; every log is whole
            shutil.rmtree(self.path / name, ignore_errors=True)
        self._began = self._saved = time.perf_counter()
        self._saving = 0.0  # how long the last snapshot took [s]
        self.meta = (
            self._before | self.meta | {"status": "running", "started": self._before.get("started", _now())}
        )
        write(self.path / "config.yaml", yaml.safe_dump(self._described, sort_keys=False).encode())
        self._write_meta()

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        gone = self.heartbeat.gone  # what is there now is another run's
        if kind is not None and self.meta.get("status") != FINISHED and not gone:
            stopped = issubclass(kind, (Interrupted, KeyboardInterrupt))
            self.meta["status"] = "interrupted" if stopped else "failed"
            with contextlib.suppress(RunError):  # on a full disk the error under way says more
                self._write_meta()
        self.heartbeat.__exit__(kind, *error)
        if (self.stop is not None or self.meta.get("status") == FINISHED) and not gone:
            files.remove(self.path / STOP)  # it was obeyed, or came too late, and counts once
        self._release(gone)

    def _release(self, gone: bool = False) -> None:
        if not gone:
            files.remove(self.path / LOCK)
        self._lock.release()

    def _note_stop(self, number: int, frame: object) -> None:
        """The first signal waits for the iteration's end. A second signal gets its previous handler."""
        self.stop = number
        signal.signal(number, self._handlers[number])
        if sys.stderr.isatty():
            os.write(sys.stderr.fileno(), HEARD)

    def resume(self, parts: Mapping[str, Stateful], replay: ReplayBuffer | None = None) -> int:
        """Set the parts to the newest usable snapshot, where there is one, and tell the log its rows.

        Returns:
            The frames per seed that the snapshot has behind it.

        Raises:
            RunError: there are snapshots and none can be used.
        """
        snapshot = self._checkpoints.load(replay, lambda snapshot: self._take(snapshot, parts))
        frames = 0 if snapshot is None else snapshot.frames
        if snapshot is not None:
            for table, columns in self._columns(snapshot).items():
                if columns:
                    self._tables[table].append(columns)
            for rows in self._tables["episodes"]:
                self._see_ended(rows)
            open_now = snapshot.state["parts"]["env"]["state"]["reward"]
            curve = snapshot.facts.get("curve", [])
            self._watch.resume(open_now, frames, curve)
            self.heartbeat.lately = Lately(curve=curve)  # which the next snapshot keeps
            self._began -= snapshot.facts["wall_seconds"]
        if self.log is not None:
            tables = {
                name: pd.DataFrame(_joined(rows, ["seed", "frame"])) for name, rows in self._tables.items()
            }
            self.log(with_reward(**tables))
        return frames

    def _take(self, snapshot: Snapshot, parts: Mapping[str, Stateful]) -> None:
        """Set the parts to a snapshot; a RunError says where one does not take it, and all are as before."""
        self._columns(snapshot)
        before = {name: part.state_dict() for name, part in parts.items()}
        saved = snapshot.state.get("parts", {})
        for name in parts:
            if _kinds(saved.get(name)) != _kinds(before[name]):
                raise RunError(f"{snapshot.path}: its {name} is of another version")
        for name, part in parts.items():
            try:
                part.load_state_dict(saved[name])
            except (RuntimeError, TypeError, ValueError) as error:  # of generators, whose states are bytes
                for other in parts:
                    parts[other].load_state_dict(before[other])
                raise RunError(f"{snapshot.path}: its {name} cannot be taken ({error})") from error

    def _columns(self, snapshot: Snapshot) -> dict[str, Columns]:
        """The rows in a snapshot; raises a RunError where they are not this run's."""
        try:
            facts = files.facts(Rows, snapshot.facts)
            if snapshot.frames > self.config.frames:
                raise ValueError(f"frames={snapshot.frames}")
            found = {
                table: {name: snapshot.state[table][name].numpy() for name in getattr(facts.columns, table)}
                for table in self._tables
            }
            for table, needed in {"episodes": EPISODE_COLUMNS, "progress": ("seed", "frame")}.items():
                rows = found[table]
                if rows and not {*needed} <= {*rows}:
                    raise ValueError(f"{table} lack columns")
                if len({column.shape for column in rows.values()}) > 1 or any(
                    one.ndim != 1 for one in rows.values()
                ):
                    raise ValueError(f"{table} are no table")
                if rows and not np.isin(rows["seed"], self.config.seeds).all():
                    raise ValueError(f"{table} have other seeds")
        except (ValueError, KeyError, TypeError) as error:
            raise RunError(f"{snapshot.path}: its rows are not this run's ({error})") from error
        return found

    def tell(self, frames: int) -> None:
        """Note how far the run is, for whoever looks at the folder, and see whether it shall stop.

        Raises:
            RunError: the folder is gone, as when another process has taken the run over.
        """
        self.heartbeat.tell(frames)
        if self.heartbeat.gone:
            raise RunError(f"{self.path}: is gone: removed, renamed, or taken over by another process")
        if self.heartbeat.asked:
            self.stop = self.stop or signal.SIGTERM

    def checkpoint(
        self, frames: int, parts: Mapping[str, Stateful], replay: ReplayBuffer | None = None
    ) -> None:
        """Save a snapshot if one is due, or if a signal asks to stop.

        Raises:
            Interrupted: after SIGINT or SIGTERM, and saved.
        """
        self._keep_policies(frames, parts)
        now = time.perf_counter()
        wanted = self.stop is None and self.until is not None and frames >= self.until
        if wanted:
            self.stop = signal.SIGTERM
        pause = max(self.checkpoint_seconds, self._saving / CHECKPOINT_SHARE)
        if self.stop is None and now - self._saved < pause:
            return
        joined = {table: _joined(rows, []) for table, rows in self._tables.items()}
        state: dict[str, Any] = {"parts": {name: part.state_dict() for name, part in parts.items()}}
        for table, columns in joined.items():
            state[table] = {name: torch.from_numpy(values) for name, values in columns.items()}
        facts = {
            "frames": frames,
            "wall_seconds": now - self._began,
            "columns": {table: list(columns) for table, columns in joined.items()},
            "curve": self.heartbeat.lately.curve,
        }
        try:
            self._checkpoints.save(frames, state, facts, replay)
        except OSError as error:
            raise RunError(f"{self._checkpoints.folder}: cannot be written ({error})") from error
        self._saved = time.perf_counter()
        self._saving = self._saved - now
        if self.stop is not None:
            raise self.interrupted(frames, wanted)

    def _keep_policies(self, frames: int, parts: Mapping[str, Any]) -> None:
        """Keep the policies at the end of the iteration in which a share of training is reached."""
        for at in self.config.shares_reached(frames):
            actor = parts["actions"]
            write(self.path / kept(at), weights.serialize({"policy": actor.network}, self.config, actor))

    def interrupted(self, frames: int, wanted: bool) -> Interrupted:
        """What to raise when the run was saved after so many frames per seed; wanted: by `until`."""
        number = self.stop or signal.SIGTERM
        why = f"until={self.until}" if wanted else signal.Signals(number).name
        return Interrupted(
            f"{self.path}: stopped by {why} and saved at {frames:,} of"
            f" {self.config.frames:,} frames; the same command goes on from there",
            number,
            frames,
            wanted,
        )

    def snapshot_tables(self) -> tuple[int, dict[str, pd.DataFrame]]:
        """The newest snapshot of an unfinished run: its frames per seed, and the rows of episodes and of
        progress.

        Raises:
            RunError: there is none.
        """
        snapshot = self._checkpoints.newest()
        return snapshot.frames, {table: pd.DataFrame(rows) for table, rows in self._columns(snapshot).items()}

    def repeat(self, compile: bool) -> bool:
        """Whether to compile, and in how many threads torch works: as the unfinished run began, where there
        is one.

        Raises:
            RunError: it was compiled, and here that cannot be done.
        """
        before = self._before
        if isinstance(before.get("threads"), int):
            torch.set_num_threads(before["threads"])
        if before.get("compiled") and not compile:
            raise RunError(
                f"out={self.path}: the run began compiled, and nothing can be compiled here; install g++"
            )
        return bool(before.get("compiled", compile))

    def processes(self, number: int) -> int:
        """In how many processes to train: as the unfinished run began, where there is one."""
        return int(self._before.get("processes", 1)) if self._before else number

    def note(self, **facts: Any) -> None:
        """Add how the run is carried out to meta.json, and to what a snapshot shares with whoever resumes."""
        facts = facts | {"threads": torch.get_num_threads()}
        self.meta |= facts | {"beyond_preset": self.config.beyond_preset()}
        self._checkpoints.identity |= facts
        self._write_meta()

    def add_episodes(self, following: TensorDictBase, frame: int) -> None:
        """Keep the episodes that end in a batch.

        following: the ("next", ...) part of collected steps [A, W, T]; frame: per seed, before the batch.
        """
        done = following["done"].squeeze(-1).permute(2, 1, 0)  # in order of time
        time_step, env, agent = (index.cpu() for index in done.nonzero(as_tuple=True))
        if not len(agent):
            return
        ended = following[agent, env, time_step]
        flags = {name: ended[name].squeeze(-1) for name in ("terminated", "truncated")}
        counts = {name: ended["episode", name] for name in ("layout", *COUNTS)}
        ends = frame + (time_step + 1) * done.shape[1]
        self._append_episodes(agent, frame=ends, env=env, **counts, **flags)
        self._see_ended(self._tables["episodes"][-1])

    def add_open_episodes(self, state: State, frame: int) -> None:
        """Keep the episodes that the end of training cut off: rows with neither flag."""
        agent, env = (index.cpu() for index in (state.steps > 0).nonzero(as_tuple=True))
        flags = dict.fromkeys(("terminated", "truncated"), torch.zeros(len(agent), dtype=torch.bool))
        counts = {name: getattr(state, name)[agent, env] for name in ("layout", *COUNTS)}
        self._append_episodes(agent, frame=torch.full_like(agent, frame), env=env, **counts, **flags)

    def _append_episodes(self, agent: Tensor, **columns: Tensor) -> None:
        columns["seed"] = agent + self.config.seed
        self._tables["episodes"].append({name: columns[name].cpu().numpy() for name in EPISODE_COLUMNS})

    def _see_ended(self, rows: Columns) -> None:
        """Take episodes that ended into what the seeds did lately."""
        self._watch.add(rows)
        for seed, reward in zip(rows["seed"].tolist(), rows["reward"].tolist(), strict=True):
            self._recent[seed - self.config.seed].append(reward)

    def add_rows(self, episodes: pd.DataFrame, progress: pd.DataFrame) -> None:
        """Keep whole tables of another run's rows."""
        for name, table in (("episodes", episodes), ("progress", progress)):
            self._tables[name].append({str(column): values.to_numpy() for column, values in table.items()})

    def add_progress(self, frame: int, **values: Tensor | float) -> None:
        """Keep one row a seed: the frame per seed, and values that are [A] or one number for all."""
        n = self.config.n_seeds
        row = {"seed": np.array(self.config.seeds), "frame": np.full(n, frame)}
        for name, value in values.items():
            row[name] = value.detach().cpu().numpy() if isinstance(value, Tensor) else np.full(n, value)
        self._tables["progress"].append(row)
        if self.log is not None:
            reward = np.array([np.mean(recent) if recent else np.nan for recent in self._recent])
            self.log({**row, "reward": reward})

    def look(self, state: State, frames: int) -> Lately:
        """What the seeds do after so many frames per seed, also told in the folder; state: of now."""
        self.heartbeat.lately = self._watch.look(state, frames)
        return self.heartbeat.lately

    def finish(self, policy: bytes, frames: int, wall_seconds: float | None = None) -> Run:
        """Write everything, the status last, and read it back; wall_seconds: if others took the time."""
        episodes = pd.DataFrame(_joined(self._tables["episodes"], list(EPISODE_COLUMNS))).astype(
            EPISODE_COLUMNS
        )
        progress = pd.DataFrame(_joined(self._tables["progress"], ["seed", "frame"]))
        write_table(self.path / "episodes.parquet", episodes)
        write_table(self.path / "progress.parquet", progress)
        write(self.path / POLICY, policy)
        wall = time.perf_counter() - self._began if wall_seconds is None else wall_seconds
        self.meta |= {"status": FINISHED, "frames": frames, "wall_seconds": round(wall, 3), "ended": _now()}
        self.meta["lately"] = self.heartbeat.lately.model_dump()
        self._write_meta()
        try:
            self._remove_unfinished()
        except OSError as error:
            raise RunError(f"{self.path}: cannot be tidied ({error}); the run is finished") from error
        return Run(self.path, fresh=True)

    def _remove_unfinished(self) -> None:
        """Delete all snapshots and workers: the run is finished, or starts anew."""
        for name in UNFINISHED:
            if (self.path / name).is_dir():
                shutil.rmtree(self.path / name)

    def _write_meta(self) -> None:
        write(self.path / "meta.json", json.dumps(self.meta, indent=2).encode())


def _kinds(state: Any) -> Any:
    """Type and shape of each tensor of a part's state, by its names."""
    if isinstance(state, Mapping):
        return {name: _kinds(value) for name, value in state.items()}
    return (state.dtype, state.shape) if isinstance(state, Tensor) else type(state)


def _joined(parts: list[Columns], columns: list[str]) -> Columns:
    if not parts:
        return {name: np.empty(0) for name in columns}
    return {
        name: np.concatenate([part.get(name, np.full(len(part["seed"]), np.nan)) for part in parts])
        for name in dict.fromkeys(name for part in parts for name in part)
    }


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
