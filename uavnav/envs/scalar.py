"""One drone in plain numbers: what `dynamics`, `sensing` and `simulator` do for a batch, without tensors.

For a single row the arithmetic is nothing and the calls are all, so that this is some thirty times faster. The tests
hold it against the same oracle and against the batch: places are the same bit for bit (rounded to float32 as there),
observations up to rounding. Turns, distances, rewards, sines and cosines are read off the batched functions.
"""

from __future__ import annotations

import math
from operator import itemgetter

import numpy as np
import torch
from torch import Tensor

from uavnav.tasks.dynamics import COSINE, SINE, decode
from uavnav.tasks.rewards import REWARDS
from uavnav.tasks.sensing import VIEW_TOLERANCE
from uavnav.tasks.world import World

COSINES, SINES = COSINE.tolist(), SINE.tolist()
Observation = np.ndarray[tuple[int], np.dtype[np.float32]]
Circle = tuple[float, float, float]
"""x, y, radius [px]."""


class Flight:
    """A drone among the obstacles of one set: `start`, then `step` until it is over.

    Args:
        bank: Tensor [n, k, 3] of (x, y, radius) px.
        world: constants and switches.
        reward: a name of `uavnav.rewards.REWARDS`.
        max_steps: a cap on steps, or None.
    """

    def __init__(self, bank: Tensor, world: World, reward: str, max_steps: int | None) -> None:
        self.world, self.max_steps = world, max_steps
        self._bank: list[list[Circle]] = bank.tolist()
        angle, distance = decode(torch.arange(world.n_actions), world)
        self._angles, self._distances = angle.tolist(), distance.tolist()
        terms = REWARDS[reward](torch.tensor([[False], [True]]), distance, angle, world)
        shape = 2, world.n_actions
        self._rewards = torch.stack([term.expand(shape) for term in terms.values()]).sum(0).tolist()

    def start(self, layout: int, heading: int) -> Observation:
        """Put the drone at the centre; layout: index in the bank, heading: whole degrees. Returns the observation."""
        self.layout, self.heading, self.steps = layout, heading, 0
        self.x, self.y = self.world.start
        return self._observe()

    def step(self, action: int) -> tuple[Observation, float, bool, bool]:
        """Turn, move, sense, then judge: observation [30] float32, reward, terminated, truncated."""
        distance = self._distances[action]
        self.heading = (self.heading + self._angles[action]) % 360
        self.x = _float32(self.x + _float32(distance * COSINES[self.heading]))
        self.y = _float32(self.y + _float32(distance * SINES[self.heading]))
        self.steps += 1
        observation = self._observe()
        collided = self.clearance <= self.world.drone_radius
        capped = self.max_steps is not None and self.steps >= self.max_steps
        return observation, self._rewards[collided][action], collided, capped and not collided

    def _observe(self) -> Observation:
        slots, self.clearance = sense(self.x, self.y, self.heading, self._bank[self.layout], self.world)
        return np.array(slots, dtype=np.float32)


def _float32(value: float) -> float:
    return float(np.float32(value))


def sense(x: float, y: float, heading: int, circles: list[Circle], world: World) -> tuple[list[float], float]:
    """Eqs (9), (10) and (13): the slots one after the other, and the clearance [px]; as `sensing.sense` of one row."""
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
        candidates.sort(key=itemgetter(0))  # stable: ties stay in the order of their index
    slots: list[float] = []
    size, radius, span = world.observation_size, world.drone_radius, reach - world.drone_radius
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
    """Offsets to the nearest points of the border squares within the sensor's reach, and a few more; in index order:
    bottom and top row from left to right, left and right column from bottom to top without the corners."""
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
    """From a place to the nearest one in [start, start + length]; zero inside."""
    if place < start:
        return start - place
    return start + length - place if place > start + length else 0.0


def _within(place: float, reach: float, side: int, lowest: int, highest: int) -> range:
    """Where the squares begin, along a wall, that reach can touch."""
    first = int((place - reach) // side) * side - side
    return range(max(first, lowest), min(int(place + reach) + side, highest + 1), side)
