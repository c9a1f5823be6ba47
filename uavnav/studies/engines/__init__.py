"""Where the jobs of a study run: on the cores of this machine, on a Ray cluster, or on a SLURM cluster.

A job is a command line, and what it needs is in files below a folder that all machines see. An engine
starts jobs, and may know that one has ended; whether a job lives, and how it ended, is in the files. An
engine is a file here and an entry in `ENGINES`.
"""

from __future__ import annotations

import functools
import importlib
import os
import secrets
import shutil
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, ClassVar, Protocol, get_type_hints

from uavnav.errors import ConfigError, unknown, unknown_key
from uavnav.settings import checked

ENGINES = {"local": "Local", "ray": "Ray", "slurm": "Slurm"}
"""The module of each engine here, and the class in it, whose fields are its settings."""


class Engine(Protocol):
    """Starts jobs. Building one raises a ConfigError where it cannot be used here."""

    SEEDS_PER_WORKER: int | None
    """How many seeds a worker trains; None: as one machine spreads them over its cores."""

    def slots(self) -> int:
        """How many jobs it runs at once, at this moment."""

    def check(self, folder: Path) -> None:
        """Raise a ConfigError unless its machines see this folder and have this environment."""

    def start(self, jobs: Sequence[list[str]]) -> list[Any]:
        """Start command lines, and return what stands for each."""

    def ended(self, job: Any) -> bool:
        """Whether a job is known to have ended or died; false is no proof that it lives."""

    def queued(self, job: Any) -> bool:
        """Whether the engine explains that a job has not begun, however long that lasts."""

    def cancel(self, job: Any) -> None:
        """End a job that counts as dead, as far as it can be reached."""

    def close(self) -> None:
        """End all jobs that still run."""


def chosen(name: str, settings: Mapping[str, Any], others: Collection[str] = ()) -> Callable[[], Engine]:
    """What makes an engine, by its name and its settings; others: further keys, which a wrong one may mean.

    Raises:
        ConfigError: there is no such engine or setting; when it is made, also where what it needs is not
            installed, or there is no such cluster.
    """
    if name not in ENGINES:
        raise unknown("engine", name, ENGINES)
    kind = getattr(importlib.import_module(f"uavnav.studies.engines.{name}"), ENGINES[name])
    hints = get_type_hints(kind, include_extras=True)
    names = [item.name for item in fields(kind)]
    for key in settings:
        if key not in names:
            raise unknown_key(key, [*names, *others])
    return functools.partial(
        kind, **{key: checked(key, value, hints[key]) for key, value in settings.items()}
    )


class Probe:
    """A new folder in that of a study: a machine that sees it copies a file in it, under its own name.

    So a folder of the same path on the machine's own disk, or one that it may not write to, does not pass.
    """

    SECONDS: ClassVar[float] = 60.0  # the time in which what one machine writes is seen by another
    PATIENCE: ClassVar[float] = 3600.0
    """The time in which a machine answers, unless its engine says that the question is queued."""

    def __init__(self, folder: Path) -> None:
        self._file = folder / f"seen-{secrets.token_hex(4)}" / "question"

    def __enter__(self) -> Probe:
        self._file.parent.mkdir(parents=True)
        self._file.touch()
        return self

    def __exit__(self, *error: object) -> None:
        shutil.rmtree(self._file.parent, ignore_errors=True)

    def words(self, machine: str) -> list[str]:
        return ["cp", str(self._file), str(self._file.with_name(machine))]

    def answered(self, machine: str) -> bool:
        """Whether the copy is seen from here."""
        return machine in os.listdir(self._file.parent)


def missing(engine: str) -> ConfigError:
    """The error where an engine's package is not installed."""
    return ConfigError(f"engine={engine}: not installed; pip install 'uavnav[scale]' brings it")


def unseen(folder: Path, machine: str) -> ConfigError:
    """The error where a machine does not see the folder of a study."""
    return ConfigError(f"out={folder}: {machine} does not see it; give a folder that all machines share")


def lacking(engine: str, machine: str) -> ConfigError:
    """The error where a machine does not have this environment."""
    return ConfigError(
        f"engine={engine}: {machine} has no {sys.executable}; install uavnav there, at that path"
    )


def logged(words: Sequence[str], log: Path) -> list[str]:
    """A command line whose output goes to a file."""
    return ["/bin/sh", "-c", 'log=$0; exec "$@" >>"$log" 2>&1', str(log), sys.executable, *words]
