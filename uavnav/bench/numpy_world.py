"""The world once more, in plain NumPy: what one would write for Stable-Baselines3 without our core.

It is the yardstick of `uavnav.bench` and of other people's trainers: one drone, vectorised over the circles
and the 136 squares of the border. `tests/test_numpy_world.py` compares it with the oracle and `DroneGymEnv`.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from torch import Tensor

from uavnav.envs.gym import chosen_layouts, observation_space
from uavnav.tasks.seeding import places
from uavnav.tasks.sensing import VIEW_TOLERANCE
from uavnav.tasks.state import UP
from uavnav.tasks.table import make_task
from uavnav.tasks.world import World

Array = np.ndarray[Any, np.dtype[Any]]
Info = dict[str, Any]

COSINE = [{0: 1.0, 90: 0.0, 180: -1.0, 270: 0.0}.get(d, math.cos(math.radians(d))) for d in range(360)]
SINE = [COSINE[degrees - 90] for degrees in range(360)]


class NumpyDroneEnv(gymnasium.Env[Array, np.int64]):
    """One drone that must not hit anything: spaces, reward eq14, start, end and info of `DroneGymEnv`.

    Everything that can be hit is a box of two corners, grown by a radius: a square's radius is 0, a circle's
    corners coincide in its centre.

    Raises:
        LayoutError, ValueError: a bad layout file, time limit, layout or action.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 - Gymnasium's own declaration

    def __init__(self, layouts: str | Path | Tensor = "train", max_steps: int | None = None) -> None:
        self.world = world = World()
        self.layouts: Array = (
            make_task(layouts, world, max_steps=max_steps).layouts.numpy().astype(np.float64)
        )
        self.max_steps = max_steps
        self.observation_space = observation_space(world)
        self.action_space = spaces.Discrete(world.n_actions)
        self._low = self.observation_space.low
        self._empty = np.tile(np.array([0, 0, 1], dtype=np.float32), (world.n_slots, 1))
        corner, k = border_squares(world), self.layouts.shape[1]
        self._lower = np.concatenate([np.zeros((k, 2)), corner])
        self._upper = np.concatenate([np.zeros((k, 2)), corner + world.border])
        self._radius = np.zeros(len(self._lower))
        self._layout: int | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, Info]:
        super().reset(seed=seed)
        if seed is not None or self._layout is None:
            first = int(self.np_random.integers(2**31)) if seed is None else seed
            following = int(places([first], 1, len(self.layouts), "cpu"))
        else:
            following = (self._layout + 1) % len(self.layouts)
        chosen = chosen_layouts(options, (), len(self.layouts))
        self._layout = following if chosen is None else int(chosen)
        circles = self.layouts[self._layout]
        self._lower[: len(circles)] = self._upper[: len(circles)] = circles[:, :2]
        self._radius[: len(circles)] = circles[:, 2]
        (self.x, self.y), self.heading, self.steps = self.world.start, UP, 0
        observation, clearance = self._sense()
        return observation, self._info(clearance)

    def step(self, action: np.int64 | int) -> tuple[Array, float, bool, bool, Info]:
        if self._layout is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        if not 0 <= action < self.world.n_actions:
            raise ValueError(f"action={action}; give a whole number from 0 to {self.world.n_actions - 1}")
        turn, distance = divmod(int(action), self.world.n_distances)
        angle = turn if turn <= self.world.n_turns // 2 else turn - self.world.n_turns
        self.heading = (self.heading + angle) % 360
        self.x += distance * COSINE[self.heading]
        self.y += distance * SINE[self.heading]
        self.steps += 1
        observation, clearance = self._sense()
        terminated = clearance <= self.world.drone_radius
        truncated = self.max_steps is not None and self.steps >= self.max_steps and not terminated
        if terminated:
            reward = self.world.collision_reward
        elif distance == 0 or angle != 0:
            reward = self.world.penalty
        else:
            reward = self.world.reward_per_pixel * distance
        return observation, reward, terminated, truncated, self._info(clearance)

    def _sense(self) -> tuple[Array, float]:
        """Eqs (9), (10) and (13): the observation [30], and the distance to the nearest of all [px]."""
        world, position = self.world, np.array([self.x, self.y])
        offset = np.minimum(np.maximum(position, self._lower), self._upper) - position
        length = np.sqrt(np.square(offset).sum(1))
        distance = length - self._radius
        near = np.flatnonzero(distance <= world.sensor_radius)
        offset, length, seen = offset[near], length[near], distance[near]
        direction = offset / np.where(length > 0, length, np.inf)[:, None]
        cosine, sine = COSINE[self.heading], SINE[self.heading]
        frame = direction @ np.array([[sine, cosine], [-cosine, sine]])  # right, forward
        ahead = np.flatnonzero(frame[:, 1] >= world.view_cosine - VIEW_TOLERANCE)
        first = ahead[np.argsort(seen[ahead], kind="stable")[: world.n_slots]]
        slots = self._empty.copy()
        slots[: len(first), :2] = frame[first]
        reach = world.sensor_radius - world.drone_radius
        slots[: len(first), 2] = (seen[first] - world.drone_radius) / reach
        observation = np.minimum(np.maximum(slots.reshape(-1), self._low), 1.0)
        return observation, float(distance.min())

    def _info(self, clearance: float) -> Info:
        place = {"x": self.x, "y": self.y, "heading": self.heading}
        return {"layout": self._layout, **place, "clearance": clearance}


def border_squares(world: World) -> Array:
    """Lower left corners [136, 2] px in index order: bottom and top row, then the columns between them."""
    side, width, height = world.border, world.width, world.height
    rows = [(x, y) for y in (0, height - side) for x in range(0, width, side)]
    columns = [(x, y) for x in (0, width - side) for y in range(side, height - side, side)]
    return np.array(rows + columns, dtype=np.float64)
