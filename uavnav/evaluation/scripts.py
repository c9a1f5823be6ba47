"""Rows of the scripted policies in the worlds of a study, which a report reads beside its runs.

`uavnav evaluate random straight reactive --seeds 10 --out DIR` writes them, and so does a study that has `scripts`.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from uavnav.evaluation import EPISODES, MAX_STEPS, header, protocol_name
from uavnav.runs.metrics import EVALUATED
from uavnav.runs.tables import RunError, read_table
from uavnav.tasks.faults import NO_FAULTS, Faults
from uavnav.tasks.protocol import DRAWS, SCRIPTS
from uavnav.tasks.task import Task, name_of

SEEDS = 10
"""Of `protocol.DRAWS`, for an interval."""


class Protocol(NamedTuple):
    """The world that a script flies in, with the task's usual settings, and its sets and cap."""

    layouts: str = "test"
    episodes: int = EPISODES
    max_steps: int = MAX_STEPS
    faults: Faults | None = None
    task: str = "drone"

    def file(self, rule: str) -> str:
        """The name of a script's rows."""
        return f"{rule}{protocol_name(*self)}.parquet"

    def words(self, rules: Sequence[str], folder: Path) -> list[str]:
        """What `uavnav evaluate` is given to write the rows of some scripts into a folder."""
        usual = Protocol()._asdict()
        own = {name: value for name, value in self._asdict().items() if value != usual[name]}
        given = [word for name, value in own.items() for word in (f"--{name.replace('_', '-')}", str(value))]
        return [*rules, *given, *["--seeds", str(SEEDS)] * (DRAWS in rules), "--out", str(folder)]


def missing(folder: Path, protocol: Protocol) -> list[str]:
    """The scripts whose rows are not in a folder."""
    return [rule for rule in SCRIPTS if not (folder / protocol.file(rule)).exists()]


def protocol_in(task: Task, layouts: str, episodes: int, max_steps: int) -> Protocol | None:
    """How scripts fly in a task of training; None where it has settings that no command can give a script."""
    if task.world != task.WORLD() or task.reward != task.REWARD:
        return None
    faults = None if task.faults == NO_FAULTS else task.faults
    return Protocol(layouts, episodes, max_steps, faults, name_of(task))


def rows_of_scripts(folders: Sequence[Path], protocol: Protocol) -> tuple[dict[str, pd.DataFrame], list[str]]:
    """Rows of scripts by name, each from the first of some folders that has them; a line for what cannot be used.

    Each line names the command that writes the rows.
    """
    found, left_out = {}, []
    absent = [rule for rule in SCRIPTS if all(rule in missing(folder, protocol) for folder in folders)]
    if absent:
        left_out.append(f"{folders[0]}: no rows of {', '.join(absent)}; {_command(absent, folders[0], protocol)}")
    for rule in (rule for rule in SCRIPTS if rule not in absent):
        folder = next(folder for folder in folders if rule not in missing(folder, protocol))
        path, again = folder / protocol.file(rule), _command([rule], folder, protocol)
        try:
            rows = read_table(path, EVALUATED, again)
            if rows.attrs != (wanted := header(*protocol)):
                differs = [key for key in rows.attrs | wanted if rows.attrs.get(key) != wanted.get(key)]
                there, asked = (_shown({key: said.get(key) for key in differs}) for said in (rows.attrs, wanted))
                raise RunError(f"{path}: its rows are of {there}, not of {asked}; {again}")
            found[rule] = rows
        except RunError as error:
            left_out.append(str(error))
    return found, left_out


def _command(rules: Sequence[str], folder: Path, protocol: Protocol) -> str:
    return f"write them with uavnav evaluate {shlex.join(protocol.words(rules, folder))}"


def _shown(said: Mapping[Any, Any]) -> str:
    return ", ".join(f"{key}={value}" for key, value in said.items())
