"""The tasks by their names, and a task from its parts.

To add a task, write a class below `Task` and its entry in `TASKS`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from uavnav.errors import ConfigError, among, choose_from, quoted
from uavnav.settings import part
from uavnav.tasks import layouts as splits
from uavnav.tasks.faults import Faults
from uavnav.tasks.goal import Goal
from uavnav.tasks.moving import Moving
from uavnav.tasks.space import Space, SpaceMoving
from uavnav.tasks.task import Task
from uavnav.tasks.world import World
from uavnav.tasks.wrapper import WrappedTask

TASKS: dict[str, type[Task]] = {
    "drone": Task,
    "moving": Moving,
    "goal": Goal,
    "space": Space,
    "space-moving": SpaceMoving,
}
"""Every task by its name; a plugin adds its own."""

KNOWN = dict(TASKS)
"""Those that every process of a run has: built in, or of a plugin."""

EMPTY = torch.empty(1, 0, 3)
"""One layout without an obstacle."""


def name_of(task: Task | WrappedTask) -> str:
    """The name of a task.

    Raises:
        ValueError: its class has none.
    """
    own = type(task.task if isinstance(task, WrappedTask) else task)
    for name, kind in TASKS.items():
        if kind is own:
            return name
    raise ValueError(f"{own.__name__}: has no name; give it one in TASKS, as TASKS['mine'] = Mine")


def unusual(task: WrappedTask) -> list[str]:
    """The constants of a task's world that are not its usual ones, each as `sensor_arc=90.0`."""
    usual = task.WORLD().model_dump()
    return [f"{name}={value}" for name, value in task.world.model_dump().items() if value != usual[name]]


def header(task: WrappedTask) -> dict[str, Any]:
    """All of a task, as the header of a policy's file has it; of the split its SHA-256.

    Raises:
        ValueError: its class has no name in `TASKS`.
    """
    return {
        "task": name_of(task),
        "world": task.world.model_dump(),
        "reward": task.reward,
        "max_steps": task.max_steps,
        "stack": task.stack,
        "faults": task.faults.model_dump(),
        "layouts": splits.checksum(task.layouts),
    }


def make_task(
    layouts: str | Path | Tensor = "train",
    world: World | Mapping[str, Any] | None = None,
    reward: str | None = None,
    max_steps: int | None = None,
    task: str | Task | WrappedTask = "drone",
    stack: int = 1,
    faults: Faults | Mapping[str, Any] | None = None,
) -> WrappedTask:
    """A task from its parts.

    Args:
        layouts: `train`, `validation`, `test`, a rung's such as `density-12/test`, a path, or a tensor [L, K,
            3].
        world: constants and switches; by default, or where a mapping leaves them out, the task's own.
        reward, max_steps: as of `Task`; by default the task's own, `REWARD` and `MAX_STEPS`.
        task: a name of `TASKS`; or a whole `Task`, which then says all that is above, or a `WrappedTask`,
            which says what is below too.
        stack: newest observations that a policy sees at once.
        faults: of its sensor and actuator, or a mapping of some; by default none.

    Raises:
        LayoutError: the split cannot be read or is not valid.
        ValueError: there is no such task, or as for `Task`, its world and `WrappedTask`.
    """
    if isinstance(task, WrappedTask):
        return task
    if isinstance(task, Task):
        return WrappedTask(task, part(Faults, "faults", faults), stack)
    if not among(task, TASKS):
        raise ConfigError(f"task={quoted(task)}; {choose_from(task, TASKS)}")
    kind = TASKS[task]
    world, faults = part(kind.WORLD, "world", world), part(Faults, "faults", faults)
    max_steps = kind.MAX_STEPS if max_steps is None else max_steps
    made = WrappedTask(
        kind(world, EMPTY, kind.REWARD if reward is None else reward, max_steps), faults, stack
    )
    return made if layouts is EMPTY else made.on(layouts, max_steps)
