"""Ladders: one difficulty in steps, and the task of each step. The same policy flies all rungs.

To add a ladder, write a function that gives the task of a rung, and an entry in `LADDERS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from uavnav.tasks import layouts, slalom
from uavnav.tasks.moving import Moving
from uavnav.tasks.space import Space, SpaceMoving
from uavnav.tasks.state import State
from uavnav.tasks.task import Task
from uavnav.tasks.wrapper import WrappedTask

Measure = Callable[[State, State], dict[str, Tensor]]
"""States before and after a step -> numbers [*B] that an evaluation adds up over each episode."""


class Ladder(NamedTuple):
    """A difficulty: its meaning with its unit, its rungs, and the task of a rung."""

    words: str
    rungs: tuple[float, ...]
    task: Callable[[WrappedTask, float, str], WrappedTask]  # of a policy, rung, split -> what it flies there
    measure: Measure | None = None
    of: tuple[str, ...] = ()  # kinds of layouts whose tasks have it (`layouts.kind_of`); by default all
    any_task: bool = True  # also one of a plugin; else its functions would be lost, as another class is used

    def fits(self, task: WrappedTask) -> bool:
        """Whether a policy that was trained in a task can be evaluated on it."""
        return (not self.of or layouts.kind_of(task.world) in self.of) and (
            self.any_task or type(task.task) in (Task, Moving, Space, SpaceMoving)
        )


def split_of(ladder: str, rung: float, split: str = "test") -> str:
    """The name of a rung's layouts, on a ladder of layouts."""
    return f"{ladder}-{rung:g}/{split}"


def other_layouts(ladder: str, task: WrappedTask, rung: float, split: str = "test") -> WrappedTask:
    """The policy's task on a rung's layouts: so many obstacles each, or columns with a gap of so many px."""
    return task.on(split_of(ladder, rung, split), task.max_steps)


def arc(task: WrappedTask, rung: float, split: str = "test") -> WrappedTask:
    """The policy's task with a sensor of so many degrees."""
    return task.replace(world=task.world.replace(sensor_arc=rung)).on(split, task.max_steps)


def reach(task: WrappedTask, rung: float, split: str = "test") -> WrappedTask:
    """The policy's task with a sensor that reaches so many px; proximities are scaled as in training."""
    there = task.replace(world=task.world.replace(sensor_radius=rung))
    return reached(there, task.trained_reach or task.world.sensor_radius).on(split, task.max_steps)


def reached(task: WrappedTask, own: float) -> WrappedTask:
    """A task as a policy flies it whose sensor reached so many px in training."""
    return task.replace(trained_reach=None if task.world.sensor_radius == own else own)


def speed(task: WrappedTask, rung: float, split: str = "test") -> WrappedTask:
    """The policy's task with obstacles of up to so many px a step: the usual split, velocities scaled."""
    kind = SpaceMoving if isinstance(task.task, Space) else Moving
    usual = kind.WORLD()
    all_layouts, still = layouts.load(split, usual), len(usual.size) + 1  # numbers of a place and a radius
    all_layouts = torch.cat(
        [all_layouts[..., :still], all_layouts[..., still:] * (rung / usual.speed_max)], -1
    )
    world = task.world if isinstance(task.world, kind.WORLD) else kind.WORLD(**task.world.model_dump())
    return replace(task, task=kind(world, layouts.resolve(all_layouts, world), task.reward, task.max_steps))


def fault(name: str, task: WrappedTask, rung: float, split: str = "test") -> WrappedTask:
    """The policy's task with one fault of the sensor or the actuator at a value; its other faults stay."""
    return task.replace(faults=task.faults.replace(**{name: rung})).on(split, task.max_steps)


LADDERS = {
    "density": Ladder(
        "obstacles a layout",
        tuple(range(0, 21, 2)),
        partial(other_layouts, "density"),
        of=("drone", "moving", "goal"),
    ),
    "slalom": Ladder(
        "gap [px]",
        (160, 140, 120, 110, 100, 90, 80, 70),
        partial(other_layouts, "slalom"),
        slalom.passages,
        ("drone",),
    ),
    "arc": Ladder("sensor's arc [degrees]", (60, 90, 120, 180), arc),
    "reach": Ladder("sensor's radius [px]", (60, 90, 120, 160), reach),
    "speed": Ladder(
        "greatest speed of an obstacle [px a step]",
        (0, 1, 2, 3, 4, 6),
        speed,
        of=("drone", "moving", "space", "space-moving"),
        any_task=False,
    ),
    "noise": Ladder("noise σ of the sensed distance [px]", (0, 2, 5, 10, 20), partial(fault, "noise")),
    "lost": Ladder("probability of an echo to be lost", (0, 0.05, 0.1, 0.2, 0.4), partial(fault, "lost")),
    "late": Ladder("delay of observations [steps]", (0, 1, 2, 4, 8), partial(fault, "late")),
    "sticky": Ladder(
        "probability of an action to be repeated", (0, 0.1, 0.25, 0.5), partial(fault, "sticky")
    ),
}
"""By name, in the order of a report."""


def measure_of(all_layouts: str | Path | Tensor) -> Measure | None:
    """What an evaluation on a layout file counts besides the metrics, by its name or by its file's header."""
    named = "" if isinstance(all_layouts, Tensor) else layouts.split_of(all_layouts)
    return LADDERS["slalom"].measure if named.startswith("slalom-") else None
