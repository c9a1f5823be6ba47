"""A run's folder: what is in it, who may write it, and how it is read.

    config.yaml         all that is needed to repeat the run
    meta.json           versions, git commit, machine, threads, wall time, status, frames per seed
    episodes.parquet    one row a training episode, the columns of `metrics.EPISODE_COLUMNS`
    progress.parquet    one row an iteration and seed: losses and diagnostics
    policy.safetensors  the networks of all seeds
    evaluation.parquet  one row a test episode, the same columns and `mode`: greedy or sampled
    behaviour.parquet   poses, clearances and actions of some of those flights, step by step
    checkpoint/         while the run is under way: what it goes on from (see `checkpoints`)
    tensorboard/ wandb/ logs, where they were asked for (see `loggers`)

Files appear whole or not at all, and a folder is locked while a run writes it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from uavnav.algorithms import ALGORITHMS
from uavnav.runs.metrics import FIRST_COLUMNS
from uavnav.runs.tables import RunError, read_table

FINISHED = "finished"
EVALUATION = "evaluation.parquet"
BEHAVIOUR = "behaviour.parquet"
POLICY = "policy.safetensors"
FILES = ("config.yaml", "meta.json", "episodes.parquet", "progress.parquet", POLICY)
LOG_FOLDERS = ("tensorboard", "wandb")


class Run:
    """A finished run, read from its folder.

    Args:
        path: the folder.
        fresh: this very call trained it; false where it was there before.

    Raises:
        RunError: the folder is missing, not a run's, not finished, or damaged.
    """

    def __init__(self, path: str | Path, fresh: bool = False) -> None:
        self.path = Path(path)
        self.fresh = fresh
        if not os.path.isdir(path):  # as Path.is_dir, which raises for a name that is too long
            raise RunError(f"{path}: no such run folder; give a run's folder")
        self.config: dict[str, Any] = read_yaml(self.path / "config.yaml")
        self.meta: dict[str, Any] = read_json(self.path / "meta.json")
        self.algorithm: str = self.config.get("algorithm", "?")
        if self.meta.get("status") != FINISHED:
            raise RunError(f"{path}: the run is not finished; give the same command again to complete it")
        self._check("config.yaml", self.config, {"algorithm": str, "activation": str, "seed": int, "n_seeds": int})
        self._check("meta.json", self.meta, {"frames": int})
        del self.config["algorithm"]
        self.config = came_later(self.algorithm) | self.config
        self.episodes = self._table("episodes.parquet", FIRST_COLUMNS)
        self.progress = self._table("progress.parquet", {"seed": "int64", "frame": "int64"})

    @property
    def frames(self) -> int:
        """Frames per seed that were really run."""
        return int(self.meta["frames"])

    @property
    def seeds(self) -> list[int]:
        """The training seeds."""
        return list(range(self.config["seed"], self.config["seed"] + self.config["n_seeds"]))

    def evaluation(self) -> pd.DataFrame | None:
        """The rows of its evaluation on the test split, with their mode; None where it was not evaluated."""
        there = (self.path / EVALUATION).exists()
        return self._table(EVALUATION, FIRST_COLUMNS | {"mode": "object"}) if there else None

    def _check(self, name: str, there: Mapping[str, Any], kinds: Mapping[str, type]) -> None:
        for key, kind in kinds.items():
            if type(there.get(key)) is not kind or (key == "n_seeds" and there[key] < 1):
                raise RunError(f"{self.path / name}: not a run's, its {key}={there.get(key)}; give a run's folder")

    def _table(self, name: str, columns: Mapping[str, str]) -> pd.DataFrame:
        again = "evaluate the run again" if name == EVALUATION else "run again with overwrite=true"
        return read_table(self.path / name, columns, again)


def read_yaml(path: Path) -> dict[str, Any]:
    return _read(path, yaml.safe_load, "a run's configuration")


def read_json(path: Path) -> dict[str, Any]:
    return _read(path, json.loads, "a run's facts")


def _read(path: Path, parse: Callable[[str], Any], what: str) -> dict[str, Any]:
    try:
        content = parse(path.read_text())
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise RunError(f"{path}: missing or damaged; give a run's folder") from error
    if not isinstance(content, dict):
        raise RunError(f"{path}: not {what}; give a run's folder")
    return content


def came_later(algorithm: str) -> dict[str, Any]:
    """Settings that the configurations of older runs lack, as those were run."""
    return dict(ALGORITHMS[algorithm].came_later) if algorithm in ALGORITHMS else {}
