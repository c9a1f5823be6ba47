"""Rows of the scripted policies in the tasks of a study, which a report compares with its runs."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from uavnav.runs.evaluations import Protocol
from uavnav.runs.metrics import EVALUATED
from uavnav.runs.tables import RunError, read_table
from uavnav.tasks.faults import NO_FAULTS
from uavnav.tasks.moving import MovingWorld
from uavnav.tasks.protocol import DRAWS, ORCA, SCRIPTED, USUAL, VFH
from uavnav.tasks.space import SpaceWorld
from uavnav.tasks.table import EMPTY, make_task, name_of
from uavnav.tasks.wrapper import WrappedTask

SEEDS = 10  # of `protocol.DRAWS`, for an interval
REWARDS = {"drone": 428.13, "goal": 10.89, "moving": 14.73, "space": 368.36, "space-moving": -9.88}
"""What `reactive` earns in a test episode of each task, with the time limit of `runs.evaluations.usual`."""


def task_of(name: str) -> WrappedTask:
    """The task of a name as scripted policies fly it: velocities are sensed where bodies move, for `orca`."""
    task = make_task(EMPTY, task=name)
    if isinstance(task.world, MovingWorld):
        return task.replace(world=task.world.replace(sense_velocity=True))
    return task


def missing(folder: Path, protocol: Protocol, names: Sequence[str]) -> list[str]:
    """The scripted policies of some names that can fly so, and whose rows are not in a folder."""
    world = task_of(protocol.task).world
    able = {ORCA: isinstance(world, MovingWorld), VFH: not isinstance(world, SpaceWorld)}
    return [one for one in names if able.get(one, True) and not (folder / protocol.file(one)).exists()]


def protocol_in(
    task: WrappedTask, layouts: str, episodes: int, max_steps: int, shield: bool = False
) -> Protocol | None:
    """How scripted policies fly a task of training; None where no command can give them its settings."""
    if task.world not in (task.WORLD(), task_of(name_of(task)).world) or task.reward != task.REWARD:
        return None
    faults = None if task.faults == NO_FAULTS else task.faults
    return Protocol(layouts, episodes, max_steps, faults, name_of(task), shield=shield)


def rows_of_scripted(
    folders: Sequence[Path], protocol: Protocol
) -> tuple[dict[str, pd.DataFrame], list[str]]:
    """Rows of scripted policies, from the first folder that has them; and commands for the usual others."""
    found, left_out = {}, []
    has = {
        name: [folder for folder in folders if (folder / protocol.file(name)).exists()] for name in SCRIPTED
    }
    absent = [name for name in USUAL if not has[name]]
    if absent:
        left_out.append(
            f"{folders[0]}: no rows of {', '.join(absent)}; {_command(absent, folders[0], protocol)}"
        )
    for name, (folder, *_) in ((name, own) for name, own in has.items() if own):
        path, again = folder / protocol.file(name), _command([name], folder, protocol)
        try:
            rows = read_table(path, EVALUATED, again)
            if rows.attrs != (wanted := protocol.header()):
                differs = [key for key in rows.attrs | wanted if rows.attrs.get(key) != wanted.get(key)]
                there, asked = (
                    ", ".join(f"{key}={said.get(key)}" for key in differs) for said in (rows.attrs, wanted)
                )
                raise RunError(f"{path}: its rows are of {there}, not of {asked}; {again}")
            found[name] = rows
        except RunError as error:
            left_out.append(str(error))
    return found, left_out


def words(names: Sequence[str], folder: Path, protocol: Protocol) -> list[str]:
    """What `uavnav evaluate` is given to write the rows of some scripted policies into a folder."""
    usual = Protocol()._asdict()
    own = {name: value for name, value in protocol._asdict().items() if value != usual[name]}
    return [*names, *options(own), *["--seeds", str(SEEDS)] * (DRAWS in names), "--out", str(folder)]


def options(own: Mapping[str, object]) -> list[str]:
    """Keys of a protocol and their values as words of `uavnav evaluate`."""
    given = [[f"--{name.replace('_', '-')}", *[str(one)] * (one is not True)] for name, one in own.items()]
    return [*itertools.chain(*given)]


def _command(names: Sequence[str], folder: Path, protocol: Protocol) -> str:
    return f"write them with uavnav evaluate {shlex.join(words(names, folder, protocol))}"
