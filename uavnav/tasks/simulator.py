"""The worlds by their names: the paper's, and those that say what is different; a task from its parts.

To add a world, write a class below `Task` and its line of `TASKS`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from uavnav.errors import ConfigError, among, did_you_mean, quoted
from uavnav.settings import part
from uavnav.tasks import goal, moving, space
from uavnav.tasks.faults import Faults
from uavnav.tasks.protocol import CAPS
from uavnav.tasks.rewards import REWARDS, Step, Terms
from uavnav.tasks.sensing import Echoes, clearance, to_drone_frame
from uavnav.tasks.state import State
from uavnav.tasks.task import TASKS, Outcome, Task, name_of
from uavnav.tasks.world import World

__all__ = [
    "EMPTY",
    "KNOWN",
    "TASKS",
    "Goal",
    "Moving",
    "Outcome",
    "Space",
    "SpaceMoving",
    "Task",
    "make_task",
    "name_of",
]


class Moving(Task):
    """The paper's task among obstacles that fly straight on and bounce off the edges of the window.

    In a step the drone moves first and the obstacles after it; who stands still can be hit. See `moving`.
    """

    WORLD = moving.MovingWorld
    STATIC = False
    world: moving.MovingWorld

    def obstacles(self, state: State) -> Tensor:
        """Where the obstacles of each row are now: [*B, K, 3] px."""
        return moving.motion(self.bank[state.layout], state.steps, self.world)[0]

    def velocities(self, state: State) -> Tensor:
        """Where the obstacles of each row move: [*B, K, 2] px a step."""
        return moving.motion(self.bank[state.layout], state.steps, self.world)[1]

    def info(self, state: State) -> dict[str, Tensor]:
        """The paper's facts, and the episode's steps, which decide where the obstacles are."""
        return super().info(state) | {"steps": state.steps}

    def sense(self, state: State, draws: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """What is sensed, with or without velocities: [*B, world.observation_size], clearance [*B] px."""
        if not self.world.sense_velocity:
            return super().sense(state, draws)
        obstacles, velocities = moving.motion(self.bank[state.layout], state.steps, self.world)
        shares = velocities / self.world.speed_max if self.world.speed_max else torch.zeros_like(velocities)
        slots, clearance = self.look(state, obstacles, shares, self.echoes(draws))
        return slots.flatten(-2), clearance

    def move(self, state: State, action: Tensor) -> tuple[State, Tensor, Tensor]:
        """Move as in the paper's task. The count of steps rises, so the obstacles move too."""
        moved, angle, distance = super().move(state, action)
        return moved._replace(steps=state.steps + 1), angle, distance


class Goal(Task):
    """The paper's task with a place to fly to: an episode ends there, at a collision, or after 1,000 steps.

    The last row of a set is (x, y) of the goal and the length of the shortest way. See `goal`.
    """

    WORLD = goal.GoalWorld
    REWARD = "goal"
    MAX_STEPS = CAPS["goal"]
    STATIC = True
    world: goal.GoalWorld

    def obstacles(self, state: State) -> Tensor:
        """Where the obstacles of each row are: [*B, K, 3] px."""
        return self.bank[state.layout][..., :-1, :]

    def to_goal(self, state: State) -> tuple[Tensor, Tensor, Tensor]:
        """From the drone to its goal: dx, dy and distance, each [*B] px."""
        place = self.bank[state.layout][..., -1, :]
        dx, dy = place[..., 0] - state.x, place[..., 1] - state.y
        return dx, dy, torch.sqrt(dx * dx + dy * dy)

    def sense(self, state: State, draws: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """What is sensed, then the direction to the goal, right and forward, and its distance / 1,000 px, at most 1."""
        slots, clearance = super().sense(state, draws)
        dx, dy, distance = self.to_goal(state)
        scale = torch.where(distance > 0, 1 / distance, 0.0)
        right, forward = to_drone_frame(dx * scale, dy * scale, state.heading)
        ahead = [right.clamp(-1, 1), forward.clamp(-1, 1), (distance / goal.SCALE).clamp(max=1)]
        return torch.cat([slots, torch.stack(ahead, -1)], -1), clearance

    def judge(self, step: Step) -> tuple[Tensor, Terms]:
        """Over at a collision or at the goal."""
        before, after = self.to_goal(step.before)[-1], self.to_goal(step.after)[-1]
        terms = REWARDS[self.reward](step._replace(to_goal=(before, after)))
        return step.collided | (after <= self.world.goal_radius), terms

    def succeeded(self, state: State) -> Tensor:
        """Whether each row's drone has reached its goal, without a collision: [*B] bool."""
        near = clearance(state.x, state.y, self.obstacles(state), self.world)
        return (self.to_goal(state)[-1] <= self.world.goal_radius) & (near > self.world.drone_radius)

    def info(self, state: State) -> dict[str, Tensor]:
        """As of the paper's task, and where the goal is and whether it is reached."""
        place = self.bank[state.layout][..., -1, :]
        facts = {"goal_x": place[..., 0], "goal_y": place[..., 1], "succeeded": self.succeeded(state)}
        return super().info(state) | facts

    def marks(self, state: State) -> Tensor:
        """The goal: [*B, 1, 3] px."""
        place = self.bank[state.layout][..., -1:, :2]
        return torch.cat([place, torch.full_like(place[..., :1], self.world.goal_radius)], -1)

    def measure(self, before: State, after: State) -> dict[str, Tensor]:
        """`succeeded` at the step that reaches the goal, and once a flight the length of its shortest way [px]."""
        shortest = torch.where(before.steps == 0, self.bank[before.layout][..., -1, 2], 0.0)
        return {"succeeded": self.succeeded(after).long(), "shortest": shortest * (after.steps > 0)}


class Space(Task):
    """A drone in a box with spheres, which turns by yaw and by pitch. A step turns if it asks for one. See `space`."""

    WORLD = space.SpaceWorld
    STATIC = True
    STATE = space.SpaceState
    world: space.SpaceWorld

    def place(self, layout: Tensor, heading: Tensor) -> State:
        """Where an episode begins: the centre of the box, level."""
        z = torch.full_like(layout, self.world.start[2], dtype=torch.float32)
        return self.STATE(*super().place(layout, heading), z, torch.zeros_like(layout))  # type: ignore[call-arg]

    def info(self, state: State) -> dict[str, Tensor]:
        """As of the paper's task, and z, yaw and pitch."""
        facts = {"z": space.z_of(state), "yaw": state.heading, "pitch": space.pitch_of(state)}
        return super().info(state) | facts

    def look(
        self, state: State, obstacles: Tensor, velocities: Tensor | None, echoes: Echoes | None
    ) -> tuple[Tensor, Tensor]:
        """As of the paper's task, of spheres and walls; see `space.sense`."""
        return space.sense(state, obstacles, self.world, velocities, echoes)

    def move(self, state: State, action: Tensor) -> tuple[State, Tensor, Tensor]:
        """Turn, then fly: where the drone is after action [*B], degrees asked for [*B], distance [*B] px."""
        yaw, pitch, distance = space.decode(action, self.world)
        return space.move(state, yaw, pitch, distance), yaw.abs() + pitch.abs(), distance


class SpaceMoving(Moving, Space):
    """The same among spheres that fly straight on and bounce off the sides of the box."""

    WORLD = space.SpaceMovingWorld
    world: space.SpaceMovingWorld


TASKS |= {"moving": Moving, "goal": Goal, "space": Space, "space-moving": SpaceMoving}

KNOWN = dict(TASKS)
"""Those that every process of a run has: built in, or of a plugin."""

EMPTY = torch.empty(1, 0, 3)
"""A bank of one set without an obstacle."""


def make_task(
    layouts: str | Path | Tensor = "train",
    world: World | Mapping[str, Any] | None = None,
    reward: str | None = None,
    max_steps: int | None = None,
    task: str | Task = "drone",
    stack: int = 1,
    faults: Faults | Mapping[str, Any] | None = None,
) -> Task:
    """A task from its parts.

    Args:
        layouts: `train`, `validation`, `test`, a rung's such as `density-12/test`, a path, or a tensor [L, K, 3].
        world: constants and switches; by default, or where a mapping leaves them out, the task's own.
        reward, max_steps: as of `Task`; by default the task's own, `REWARD` and `MAX_STEPS`.
        task: a name of `TASKS`; or a whole task, which then says all that is above and below.
        stack: as of `Task`.
        faults: of its sensor and actuator, or a mapping of some; by default none.

    Raises:
        LayoutError: the bank cannot be read or is not valid.
        ValueError: there is no such task, or as for `Task` and its world.
    """
    if isinstance(task, Task):
        return task
    if not among(task, TASKS):
        raise ConfigError(f"task={quoted(task)}; choose from {', '.join(TASKS)}{did_you_mean(task, TASKS)}")
    kind = TASKS[task]
    world, faults = part(kind.WORLD, "world", world), part(Faults, "faults", faults)
    max_steps = kind.MAX_STEPS if max_steps is None else max_steps
    made = kind(world, EMPTY, kind.REWARD if reward is None else reward, max_steps, stack, faults)
    return made if layouts is EMPTY else made.on(layouts, max_steps)
