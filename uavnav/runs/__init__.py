"""A run's folder: its files and how they are read.

    config.yaml         every setting needed to repeat the run
    meta.json           versions, git commit, machine, threads, wall time, status, frames per seed
    episodes.parquet    one row per training episode, the columns of `metrics.EPISODE_COLUMNS`
    progress.parquet    losses and diagnostics: a row per seed and iteration, or every few thousand frames
    policy.safetensors  the networks of all seeds; where it was left out, the run's command trains it again
    policy-at-0.1.safetensors  the policies after a tenth of training, where `keep_at` asks for them
    evaluation.parquet  one row per test episode: the same columns, and `mode` (greedy or sampled); see
                        `runs.evaluations`
    behaviour.parquet   the actions of some test episodes, one row per step (see `uavnav.report.behaviour`)
    arena.parquet       the same of episodes in the empty arena (see `uavnav.evaluation.in_empty_arena`)
    values.parquet      what each seed expects and gets, where outputs are values (see
                        `uavnav.evaluation.values`)
    checkpoint/         the snapshots of an unfinished run (see `uavnav.training.checkpoints`)
    workers/            an unfinished run whose seeds are spread over processes: a run's folder for each
    progress.json       while it trains: its frames per seed, of how many, at how many a second, what its
                        seeds do (see `uavnav.runs.lately`), and when
    stop                while it trains: whoever writes this file asks it to save and stop
    tensorboard/ wandb/ logs, if the run has them (see `uavnav.training.loggers`)

Files appear whole or not at all. A folder is locked while a run writes to it.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
from pydantic import Field

from uavnav import files
from uavnav.errors import LONG, did_you_mean
from uavnav.files import Facts
from uavnav.runs.evaluations import usual
from uavnav.runs.lately import NOTHING, Lately
from uavnav.runs.metrics import EVALUATED, TRAINED
from uavnav.runs.tables import RunError, read_table
from uavnav.runs.trials import TRIALS, TUNING
from uavnav.tasks.faults import Faults

FINISHED = "finished"
EVALUATION = "evaluation.parquet"
BEHAVIOUR = "behaviour.parquet"
ARENA = "arena.parquet"
VALUES = "values.parquet"
POLICY = "policy.safetensors"
KEPT = "policy-at-"
"""Begins the names of policies that were kept on the way."""
FILES = ("config.yaml", "meta.json", "episodes.parquet", "progress.parquet", POLICY)
PROGRESS = "progress.json"
STOP = "stop"
LOG_FOLDERS = ("tensorboard", "wandb")
WORKERS = "workers"
NO_RUNS = ("checkpoint", WORKERS, *LOG_FOLDERS)  # folders without runs
OF_REPORTS = ("baselines", "bench", "tables", "figures")  # folders that a report reads or writes itself
DEPTHS = ("*", "*/*", "*/*/*", "*/*/*/*")  # where a folder of runs may have them
SILENCE = 60.0  # seconds after which a run that has written no progress no longer runs
LONGEST_NAME = 80  # of what differs from a preset, in a folder's name
MOST_SEEDS = 2**20
"""Of a run, and of a file of policies."""
Name = Annotated[str, Field(pattern=r"^[^\x00-\x1f/]+$", max_length=100)]
"""Of a line in a table, also a user's: it may be part of a path."""
Count = Annotated[int, Field(ge=0, lt=2**53)]
Threads = Annotated[int, Field(ge=1, le=2**12)]


class Config(Facts):
    """What every config.yaml contains, as far as somebody reads it; older ones have no faults."""

    algorithm: Name
    activation: Name
    seed: Annotated[int, Field(ge=0, lt=2**31)]
    n_seeds: Annotated[int, Field(ge=1, le=MOST_SEEDS)]
    total_frames: Annotated[Count, Field(ge=1)]
    n_envs: Annotated[Count, Field(ge=1)]
    preset: Name
    task: Name
    reward: Name
    layouts: str
    gamma: Annotated[float, Field(ge=0, le=1)]
    world: dict[str, Any]
    faults: dict[str, Any] = Field(default_factory=dict)


class Meta(Facts):
    """What meta.json contains, as far as somebody reads it."""

    status: str = ""
    frames: Annotated[Count, Field(ge=1)] | None = None
    started: str = ""
    ended: str = ""
    wall_seconds: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    compiled: bool = False
    threads: Threads = 1
    processes: Annotated[int, Field(ge=1, le=MOST_SEEDS)] = 1
    versions: dict[str, str | None] = Field(default_factory=dict)
    layouts: dict[str, str | int | None] = Field(default_factory=dict)
    machine: dict[str, Any] = Field(default_factory=dict)
    plugins: dict[str, str] = Field(default_factory=dict)
    beyond_preset: dict[str, Any] = Field(default_factory=dict)
    lately: Lately = NOTHING


class Progress(Facts):
    """What progress.json contains."""

    frames: Count
    total: Count
    rate: Annotated[float, Field(ge=0)] | None
    at: float
    lately: Lately = NOTHING


class Run:
    """A finished run, read from its folder.

    fresh: true if this call trained it; rows: whether its training episodes are read.

    Raises:
        RunError: the folder is missing or is no run's, or the run is not finished or damaged.
    """

    def __init__(self, path: str | Path, fresh: bool = False, rows: bool = True) -> None:
        self.path = Path(path)
        self.fresh = fresh
        if not os.path.isdir(path):  # Path.is_dir would raise for a name that is too long
            raise RunError(f"{path}: no such run folder; give a run's folder")
        if runs := runs_below(self.path):
            raise RunError(f"{path}: {runs}")
        self.config: dict[str, Any] = read_settings(self.path / "config.yaml")
        self.meta: dict[str, Any] = read_settings(self.path / "meta.json")
        if self.meta.get("status") != FINISHED:
            raise RunError(f"{path}: the run is not finished; give the command that trained it again")
        if self.meta.get("frames") is None:
            raise RunError(f"{self.path / 'meta.json'}: not a run's, its frames=None; give a run's folder")
        self.algorithm: str = self.config.pop("algorithm")
        if rows:
            self.episodes = self._table("episodes.parquet", TRAINED)
        self.progress = self._table("progress.parquet", {"seed": "int64", "frame": "int64"})

    def __repr__(self) -> str:
        return f"Run({self.path}: {', '.join(f'{name} {said}' for name, said in self._facts().items())})"

    def _repr_html_(self) -> str:
        return pd.Series({"run": str(self.path), **self._facts()}).to_frame().to_html(header=False)

    def _facts(self) -> dict[str, str]:
        """What it is, for people; rewards are means over the episodes of `evaluation`."""
        facts = {
            "algorithm": self.algorithm,
            "activation": str(self.config["activation"]),
            "seeds": " to ".join(map(str, dict.fromkeys([self.seeds[0], self.seeds[-1]]))),
            "frames": f"{self.frames:,}",
            "status": FINISHED,
        }
        with contextlib.suppress(RunError):  # a damaged file has no rewards
            rows = self.evaluation()
            if rows is not None:
                means = rows.groupby("mode")["reward"].mean()
                facts |= {f"{mode} reward": f"{mean:.1f}" for mode, mean in means.items()}
        return facts

    @property
    def frames(self) -> int:
        """Frames per seed, in whole iterations: at least `total_frames`."""
        return int(self.meta["frames"])

    @property
    def seeds(self) -> list[int]:
        """The training seeds."""
        return list(range(self.config["seed"], self.config["seed"] + self.config["n_seeds"]))

    @property
    def faults(self) -> Faults:
        """Those of training."""
        return Faults(**self.config.get("faults", {}))

    def evaluations(self) -> list[Path]:
        """The files of its evaluations, the run's own before those of other protocols."""
        own = usual(self.config["task"]).file("evaluation")
        others = sorted(path.name for path in self.path.glob(f"{Path(EVALUATION).stem}-*.parquet"))
        paths = (self.path / name for name in dict.fromkeys([own, EVALUATION, *others]))
        return [path for path in paths if os.path.lexists(path)]

    def evaluated(self) -> tuple[str, pd.DataFrame] | None:
        """The first of `evaluations` that flew as in training: its file's name, and its rows and modes."""
        for path in self.evaluations():
            rows = self._table(path.name, EVALUATED | {"mode": "object"})
            if self._as_trained(rows.attrs):
                return path.name, rows
        return None

    def _as_trained(self, header: Mapping[Any, Any]) -> bool:
        """Whether an evaluation flew the final policies, without the shield, with the faults of training."""
        if header.keys() & {"at", "shield"}:
            return False
        return "faults" not in header or header["faults"] == str(self.faults)

    def evaluation(self) -> pd.DataFrame | None:
        """The rows of `evaluated`; None where there are none."""
        found = self.evaluated()
        return None if found is None else found[1]

    def behaviour_file(self) -> Path:
        """The watched steps that belong to `evaluation`."""
        name, _ = self.evaluated() or (EVALUATION, None)
        return self.path / name.replace(Path(EVALUATION).stem, Path(BEHAVIOUR).stem, 1)

    def _table(self, name: str, columns: Mapping[str, str]) -> pd.DataFrame:
        again = (
            "evaluate the run again"
            if name.startswith(Path(EVALUATION).stem)
            else "run again with overwrite=true"
        )
        return read_table(self.path / name, columns, again)


def kept(at: float) -> str:
    """The file of the policies after a share of training."""
    return f"{KEPT}{at:g}.safetensors"


def default_folder(algorithm: str, preset: str, activation: str, changes: Mapping[str, str]) -> Path:
    """runs/<algorithm>-<preset>/<activation>[-<key>=<value> ...], below the current directory.

    changes: what else differs from the preset; a hash stands for it where it is long, or no file's name.
    """
    told = "-".join(f"{name}={value.strip('[]')}" for name, value in sorted(changes.items()))
    if not re.fullmatch(rf"[\w.,=+-]{{0,{LONGEST_NAME}}}", told, re.ASCII):
        told = hashlib.sha256(told.encode()).hexdigest()[:8]
    return Path("runs") / f"{algorithm}-{preset}" / "-".join(filter(None, (activation, told)))


def runs_below(folder: Path) -> str:
    """What is wrong with a folder that contains runs and is none, with their names; else empty."""
    if not os.path.isdir(folder) or os.path.lexists(folder / "config.yaml"):
        return ""
    configs = (one for depth in DEPTHS for one in folder.glob(f"{depth}/config.yaml"))
    names = sorted(str(one.parent) for one in configs if not {*NO_RUNS} & {*one.relative_to(folder).parts})
    if not names:
        return ""
    n = max(1, sum(length < LONG for length in itertools.accumulate(len(name) + 2 for name in names)))
    more = f" and {len(names) - n} more" if names[n:] else ""
    return f"contains runs and is none; give one of {', '.join(names[:n])}{more}"


def read_settings(path: Path, instead: str = "give a run's folder") -> dict[str, Any]:
    """What a config.yaml or meta.json contains; raises a RunError if missing, damaged, or no run's."""
    kind, what = (Meta, "facts") if path.suffix == ".json" else (Config, "configuration")
    try:
        said = files.read_json(path) if kind is Meta else files.read_yaml(path)
    except (OSError, ValueError) as error:
        raise RunError(f"{path}: missing or damaged; {instead}") from error
    if not isinstance(said, dict):
        raise RunError(f"{path}: not a run's {what}; {instead}")
    if "n_worlds" in said:
        raise RunError(
            f"{path}: written by uavnav 0.1, which reads it; train it again, or install that version"
        )
    try:
        files.facts(kind, said)
    except ValueError as error:
        raise RunError(f"{path}: not a run's, its {error}; {instead}") from error
    return said


def progress(folder: Path) -> dict[str, Any]:
    """What `progress.json` says, with a `rate` of 0 where it is not known; empty where unreadable."""
    try:
        there = files.facts(Progress, files.read_json(folder / PROGRESS))
    except (OSError, ValueError):
        return {}
    return {name: getattr(there, name) for name in Progress.model_fields} | {"rate": there.rate or 0}


def saved_frames(folder: Path) -> int:
    """The frames per seed behind the newest snapshot of an unfinished run, by file names; 0 without one."""
    workers = [one for one in folder.glob(f"{WORKERS}/*") if one.is_dir()]
    if workers:
        return min(map(saved_frames, workers))
    if not (folder / "checkpoint").is_dir() and os.path.lexists(folder / "meta.json"):
        return read_settings(folder / "meta.json").get("frames") or 0  # a worker that has finished
    states = sorted(path.name for path in folder.glob("checkpoint/state-[0-9]*-*.safetensors"))
    return int(states[-1].split("-")[1]) if states else 0


def heard(told: Mapping[str, Any], now: float) -> bool:
    """Whether a run that said this runs; a killed one may speak of the future, after a clock was set back."""
    return bool(told) and abs(now - told["at"]) < SILENCE


def run_folders(folder: Path) -> tuple[list[Path], list[str]]:
    """Every folder with a config.yaml in or below a folder, in order of name, hidden ones aside; and strays.

    Strays are tables where no run is, one line each.

    Raises:
        RunError: it is missing, a file, or contains no run.
    """
    if not os.path.isdir(folder):  # Path.is_dir would raise for a name that is too long
        beside = [name for name in ("runs", "results") if os.path.isdir(name)]
        problem = "is a file" if os.path.exists(folder) else "there is no such folder"
        raise RunError(f"{folder}: {problem}{did_you_mean(folder, beside)}; give a folder that contains runs")
    found, strays = [], []
    for path, names, there in os.walk(folder):
        none = (*NO_RUNS, TRIALS) if Path(path).name == TUNING else NO_RUNS
        names[:] = sorted(name for name in names if not name.startswith(".") and name not in none)
        if "config.yaml" in (*there, *names):
            found.append(Path(path))
        elif "episodes.parquet" in there:
            strays.append(f"{path}: has episodes.parquet and no config.yaml; not a run of this package")
        elif Path(path).name not in OF_REPORTS:
            strays += [
                f"{path}/{name}: is where no run is" for name in sorted(there) if name.endswith(".parquet")
            ]
    if not found:
        raise RunError(f"{folder}: contains no run; give a folder that does, or train one: uavnav train ppo")
    return found, strays
