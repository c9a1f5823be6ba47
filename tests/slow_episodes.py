"""Whole episodes in every task as slow loops, in float64 and plain Python, a drone each; and a task of a
user's own.
"""

import oracle
import space_by_hand

from uavnav import World
from uavnav.tasks.table import name_of
from uavnav.tasks.task import Task

KINDS = {
    "drone": oracle.Episode,
    "moving": oracle.AmongMoving,
    "goal": oracle.ToGoal,
    "space": space_by_hand.InTheBox,
    "space-moving": space_by_hand.AmongSpheres,
}


def slow_episodes(task, layouts, headings):
    """One for each layout and start heading."""
    all_layouts, world = task.layouts.tolist(), task.world
    fastest = world.speed_max if getattr(world, "sense_velocity", False) else None
    how = {
        "variant": task.reward,
        "max_steps": task.max_steps,
        "slots": world.slots,
        "padding": world.padding,
    }
    kind = KINDS[name_of(task)]
    return [kind(all_layouts, *pose, fastest=fastest, **how) for pose in zip(layouts, headings, strict=True)]


def take_over(episode, state, row):
    """Its place as float32 rounded it, so that its error does not build up."""
    for axis in {"x", "y", "z"} & {*state._fields}:
        found = float(getattr(state, axis)[row])
        assert abs(getattr(episode, axis) - found) < 1e-4
        setattr(episode, axis, found)


class NarrowWorld(World):
    sensor_arc: float = 90.0
    fog: float = 0.5


class Narrow(Task):
    """The paper's task with a sensor that covers 90 degrees instead of 180."""

    WORLD = NarrowWorld
