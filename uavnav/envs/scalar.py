"""One drone in plain numbers: the same as `dynamics`, `sensing` and `task`, without tensors.

For a single row, tensor calls cost far more than the arithmetic (docs/benchmarks.md). Positions agree with
the batch bit for bit, and observations up to rounding. Turns, distances, rewards, sines and cosines come from
the batch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import itemgetter

import numpy as np
import torch
from torch import Tensor

from uavnav.tasks.dynamics import COSINE, SINE, decode
from uavnav.tasks.goal import SCALE, Goal, GoalWorld
from uavnav.tasks.moving import Moving
from uavnav.tasks.rewards import BY_ACTION, REWARDS, Step, goal
from uavnav.tasks.sensing import VIEW_TOLERANCE
from uavnav.tasks.state import State
from uavnav.tasks.task import Task
from uavnav.tasks.world import World
from uavnav.tasks.wrapper import WrappedTask

COSINES, SINES = COSINE.tolist(), SINE.tolist()
Observation = np.ndarray[tuple[int], np.dtype[np.float32]]
Circles = Sequence[Sequence[float]]  # of each: x, y, radius [px]


def fly(task: WrappedTask) -> Episode | BatchOfOne:
    """A drone in plain numbers in a 2D task of the package, without memory, faults and sensed velocities,
    for a reward of the table; else as a batch of one.
    """
    kind = {Task: Episode, Moving: AmongMoving, Goal: ToGoal}.get(type(task.task))
    earns = REWARDS[task.reward] in BY_ACTION or (kind is ToGoal and REWARDS[task.reward] is goal)
    usual = (
        not task.remembers and task.trained_reach is None and not getattr(task.world, "sense_velocity", False)
    )
    return kind(task.task) if kind is not None and earns and usual else BatchOfOne(task)


class Episode:
    """A drone among the obstacles of one layout: `start`, then `step` until it is over. It needs no draws."""

    def __init__(self, task: Task) -> None:
        self.task, self.world, self.max_steps = task, task.world, task.max_steps
        self._layouts: list[Circles] = task.layouts.tolist()
        action = torch.arange(self.world.n_actions)
        angle, distance = decode(action, self.world)
        self._angles, self._distances = angle.tolist(), distance.tolist()
        nowhere = task.start(torch.zeros_like(action), torch.zeros_like(action))
        clearance = torch.tensor([[math.inf], [0.0]])
        # the same distance from a goal before and after: no progress
        far = torch.full_like(angle, 1.0 + getattr(self.world, "goal_radius", 0.0), dtype=torch.float64)
        step = Step(nowhere, nowhere, action, angle, distance, clearance, angle, self.world, (far, far))
        terms = REWARDS[task.reward](step).values()
        shape = 2, self.world.n_actions
        self._rewards = torch.stack([term.expand(shape) for term in terms]).sum(0).tolist()

    def start(self, layout: int, heading: int, draws: Tensor | None = None) -> Observation:
        """Put the drone at the start; layout: index; heading: whole degrees -> observation float32."""
        self.layout, self.heading, self.steps = layout, heading, 0
        self.x, self.y = self.world.start
        return self._observe()

    def step(self, action: int, draws: Tensor | None = None) -> tuple[Observation, float, bool, bool]:
        """Turn, move, sense, then judge: action -> observation float32, reward, terminated, truncated."""
        distance = self._distances[action]
        self.heading = (self.heading + self._angles[action]) % 360
        self.x = _float32(self.x + _float32(distance * COSINES[self.heading]))
        self.y = _float32(self.y + _float32(distance * SINES[self.heading]))
        self.steps += 1
        observation = self._observe()
        reward, over = self._judge(action, self.clearance <= self.world.drone_radius)
        at_limit = self.max_steps is not None and self.steps >= self.max_steps
        return observation, reward, over, at_limit and not over

    @property
    def state(self) -> State:
        """Where it is, as a row without a batch; of the counts only the steps."""
        start = self.task.start(torch.tensor(self.layout), torch.tensor(self.heading))
        return start._replace(x=torch.tensor(self.x), y=torch.tensor(self.y), steps=torch.tensor(self.steps))

    def info(self) -> dict[str, float]:
        """What `Task.info` says, in plain numbers."""
        return {"layout": self.layout, "x": self.x, "y": self.y, "heading": self.heading}

    def _circles(self) -> Circles:
        return self._layouts[self.layout]

    def _observe(self) -> Observation:
        slots, self.clearance = sense(self.x, self.y, self.heading, self._circles(), self.world)
        return np.array(slots + self._ahead(), dtype=np.float32)

    def _ahead(self) -> list[float]:
        """What is sensed besides the slots."""
        return []

    def _judge(self, action: int, collided: bool) -> tuple[float, bool]:
        """What the step earned, and whether the episode is over."""
        return self._rewards[collided][action], collided


class AmongMoving(Episode):
    """The same among circles that move as `moving.motion` says."""

    def _circles(self) -> Circles:
        width, height = self.world.width, self.world.height
        return [
            (_reflected(x + vx * self.steps, width), _reflected(y + vy * self.steps, height), radius)
            for x, y, radius, vx, vy in self._layouts[self.layout]
        ]

    def info(self) -> dict[str, float]:
        return super().info() | {"steps": self.steps}


class ToGoal(Episode):
    """The same with a goal, as `goal.Goal` has it."""

    world: GoalWorld

    def start(self, layout: int, heading: int, draws: Tensor | None = None) -> Observation:
        self.goal_x, self.goal_y, _ = self._layouts[layout][-1]
        self.to_goal = 0.0
        return super().start(layout, heading, draws)

    def info(self) -> dict[str, float]:
        succeeded = self.to_goal <= self.world.goal_radius and self.clearance > self.world.drone_radius
        return super().info() | {"goal_x": self.goal_x, "goal_y": self.goal_y, "succeeded": succeeded}

    def _circles(self) -> Circles:
        return self._layouts[self.layout][:-1]

    def _ahead(self) -> list[float]:
        dx, dy = _float32(self.goal_x - self.x), _float32(self.goal_y - self.y)
        square = torch.tensor(_float32(dx * dx) + _float32(dy * dy))
        self._before = self.to_goal
        self.to_goal = torch.sqrt(square).item()  # torch's root is not that of `math`
        scale = 1 / self.to_goal if self.to_goal else 0.0
        cosine, sine = COSINES[self.heading], SINES[self.heading]
        right, forward = (dx * sine - dy * cosine) * scale, (dx * cosine + dy * sine) * scale
        return [max(-1.0, min(right, 1.0)), max(-1.0, min(forward, 1.0)), min(self.to_goal / SCALE, 1.0)]

    def _judge(self, action: int, collided: bool) -> tuple[float, bool]:
        reward, there = self._rewards[collided][action], self.to_goal <= self.world.goal_radius
        if REWARDS[self.task.reward] is goal and not collided:  # besides what follows from the action
            reward += self.world.goal_reward * there + self.world.reward_per_pixel * (
                self._before - self.to_goal
            )
        return reward, collided or there


class BatchOfOne:
    """The same of any task: its own functions on a batch without a shape."""

    def __init__(self, task: WrappedTask) -> None:
        self.task = task

    def start(self, layout: int, heading: int, draws: Tensor | None = None) -> Observation:
        """As `Episode.start`; draws: the task's [n_draws], where it needs some."""
        state = self.task.start(torch.tensor(layout), torch.tensor(heading), draws)
        observation, clearance = self.task.observe(state)
        return self._keep(state, observation, clearance)

    def step(self, action: int, draws: Tensor | None = None) -> tuple[Observation, float, bool, bool]:
        """As `Episode.step`; draws: as for `start`."""
        state, outcome = self.task.step(self.state, torch.tensor(action), draws)
        observation = self._keep(state, outcome.observation, outcome.clearance)
        return observation, float(outcome.reward), bool(outcome.terminated), bool(outcome.truncated)

    def info(self) -> dict[str, float]:
        return {name: value.item() for name, value in self.task.info(self.state).items()}

    def _keep(self, state: State, observation: Tensor, clearance: Tensor) -> Observation:
        self.state, self.clearance = state, float(clearance)
        return observation.numpy()


def _reflected(way: float, size: float) -> float:
    """A place between two edges that reflect: the triangle wave of `moving.motion`."""
    return way if 0 <= way <= size else abs(way - 2 * size * round(way / (2 * size)))


def _float32(value: float) -> float:
    return float(np.float32(value))


def sense(x: float, y: float, heading: int, circles: Circles, world: World) -> tuple[list[float], float]:
    """The slots, flattened, and the clearance [px]: `sensing.sense` for one row. Eqs (9), (10) and (13)."""
    cosine, sine, reach, side = COSINES[heading], SINES[heading], world.sensor_radius, world.border
    least = world.view_cosine - VIEW_TOLERANCE
    to_wall = min(x - side, world.width - side - x, y - side, world.height - side - y)
    clearance = to_wall if to_wall > 0 else 0.0
    candidates = []
    for circle_x, circle_y, radius in circles:
        dx, dy = circle_x - x, circle_y - y
        length = math.sqrt(dx * dx + dy * dy)
        distance = length - radius
        if distance < clearance:
            clearance = distance
        if distance <= reach:
            candidates.append((distance, dx, dy, length))
    if to_wall <= reach:
        for dx, dy in _offsets_to_squares(x, y, world):
            length = math.sqrt(dx * dx + dy * dy)
            if length <= reach:
                candidates.append((length, dx, dy, length))
    if world.slots == "nearest":
        candidates.sort(key=itemgetter(0))  # a stable sort: ties keep the order of their index
    slots: list[float] = []
    size, radius, span = 3 * world.n_slots, world.drone_radius, reach - world.drone_radius
    for distance, dx, dy, length in candidates:
        scale = 1 / length if length else 0.0  # a centre that coincides has no direction: u = (0, 0)
        forward = (dx * cosine + dy * sine) * scale
        if forward >= least:
            proximity = (distance - radius) / span
            slots += (
                (dx * sine - dy * cosine) * scale,
                forward if forward > 0 else 0.0,
                proximity if proximity > 0 else 0.0,
            )
            if len(slots) == size:
                return slots, clearance
    empty = (0.0, 0.0, 1.0 if world.padding == "far" else 0.0)
    return slots + list(empty) * ((size - len(slots)) // 3), clearance


def _offsets_to_squares(x: float, y: float, world: World) -> list[tuple[float, float]]:
    """Offsets [px] to the nearest points of the border squares within the sensor's reach, and of a few more.

    Index order: bottom and top row from left to right, then left and right column from bottom to top without
        corners.
    """
    side, reach, width, height = world.border, world.sensor_radius, world.width, world.height
    found = []
    for bottom in (0, height - side):
        dy = _to_interval(y, bottom, side)
        if -reach <= dy <= reach:
            squares = _within(x, reach, side, 0, width - side)
            found += [(_to_interval(x, left, side), dy) for left in squares]
    for left in (0, width - side):
        dx = _to_interval(x, left, side)
        if -reach <= dx <= reach:
            squares = _within(y, reach, side, side, height - 2 * side)
            found += [(dx, _to_interval(y, bottom, side)) for bottom in squares]
    return found


def _to_interval(place: float, start: float, length: float) -> float:
    """Offset [px] from a place to the nearest point of [start, start + length]; zero inside."""
    if place < start:
        return start - place
    return start + length - place if place > start + length else 0.0


def _within(place: float, reach: float, side: int, lowest: int, highest: int) -> range:
    """Starts [px] of the squares along a wall that are within reach of a place."""
    first = int((place - reach) // side) * side - side
    return range(max(first, lowest), min(int(place + reach) + side, highest + 1), side)
