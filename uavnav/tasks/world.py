"""Everything physical about the simulated world: one home for every constant, with its unit and its source.

Section and equation numbers are the paper's ("Comparative Analysis of DQN and PPO Algorithms in UAV Obstacle
Avoidance 2D Simulation"). Where the paper is silent the choice is a row of docs/decisions.md.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field

from uavnav.errors import ConfigError
from uavnav.settings import Settings, Whole, at_most, key

VERSION = "1"
"""Version of the world's semantics and of the layouts' distribution, in every split, run and policy."""


MOST = 1_000_000
"""The largest number of a world, in whatever unit."""
Number = Annotated[float, at_most(MOST)]
Size = Annotated[Number, Field(gt=0)]
Positive = Annotated[Whole, at_most(MOST), Field(gt=0)]


class World(Settings):
    """The arena, the drone, its sensor and the reward's amounts.

    The origin is the lower-left corner of the window, x to the right, y up; a heading counts whole degrees
    counter-clockwise from +x. Changing a default is a new `VERSION`.

    Raises:
        ConfigError: a value is not right, or the geometry makes no sense.
    """

    width: Positive = key(800, "of the window, sec. 3.6", "px")
    height: Positive = key(600, "of the window, sec. 3.6", "px")
    border: Positive = key(20, "side of a border square, sec. 3.6", "px")
    obstacle_radius_min: Number = key(30.0, "of the smallest circle, sec. 3.6", "px")
    obstacle_radius_max: Number = key(100.0, "of the largest circle, sec. 3.6", "px")
    drone_radius: Number = key(30.0, "r_d, sec. 3.6", "px")
    sensor_radius: Size = key(120.0, "R_s, from the drone's centre, sec. 3.6", "px")
    sensor_arc: Size = key(180.0, "of the sensor, centred on the heading, sec. 3.6", "degrees", le=360)
    n_slots: Positive = key(10, "sensed at once, sec. 3.6 and eq. (13)", "obstacles")
    safe_zone: Number = key(50.0, "from the start to the edge of every obstacle, sec. 4.1", "px", ge=0)
    n_turns: Positive = key(10, "turns to choose from, eq. (11)")
    n_distances: Positive = key(10, "distances to choose from, eq. (12)")
    collision_reward: Number = key(-10.0, "for a collision, eq. (14)", "reward")
    penalty: Number = key(-0.01, "for a stop or a turn, eq. (14)", "reward")
    reward_per_pixel: Number = key(0.01, "for flying straight on, eq. (14)", "reward per px")
    slots: Literal["nearest", "listed"] = key("nearest", "which ten obstacles are sensed (decision 3)")
    padding: Literal["far", "zeros"] = key("far", "an empty slot: (0, 0, 1) or (0, 0, 0) (decision 6)")
    start_heading: Literal["up", "random"] = key(
        "up", "90 degrees, or uniform over whole degrees (decision 8)"
    )

    def check(self) -> None:
        if self.width % self.border or self.height % self.border:
            raise ConfigError(f"border={self.border} must divide width={self.width} and height={self.height}")
        if min(self.width, self.height) // self.border < self.sensed_squares_of_a_wall + 2:
            reach = f"sensor_radius={self.sensor_radius:g}"
            raise ConfigError(
                f"{reach} reaches two opposite walls at once; give a smaller one, or a larger window"
            )
        if self.n_slots > 2 * self.sensed_squares_of_a_wall:
            raise ConfigError(f"n_slots={self.n_slots}; give 1 to {2 * self.sensed_squares_of_a_wall}")
        if not 0 <= self.drone_radius < self.sensor_radius:
            raise ConfigError(
                f"drone_radius={self.drone_radius:g}; give 0 to below sensor_radius={self.sensor_radius:g}"
            )
        if not 0 < self.obstacle_radius_min <= self.obstacle_radius_max:
            most = f"obstacle_radius_max={self.obstacle_radius_max:g}"
            raise ConfigError(f"obstacle_radius_min={self.obstacle_radius_min:g}; give above 0, to {most}")

    @property
    def size(self) -> tuple[int, ...]:
        """How far the world reaches along each axis, from 0 [px]."""
        return self.width, self.height

    @property
    def start(self) -> tuple[float, ...]:
        """Where every episode starts: the centre of the window [px], sec. 4.1."""
        return tuple(reach / 2 for reach in self.size)

    @property
    def n_actions(self) -> int:
        """Turns x distances, sec. 4.2."""
        return self.n_turns * self.n_distances

    @property
    def distances(self) -> tuple[int, ...]:
        """What a step can fly [px], from the least, eq. (12)."""
        return tuple(range(self.n_distances))

    @property
    def slot_low(self) -> tuple[float, ...]:
        """The least of each number of a slot, eq. (13); the most is 1."""
        return -1.0, 0.0, 0.0

    @property
    def observation_low(self) -> tuple[float, ...]:
        """The least of each number of an observation; the most is 1."""
        return self.n_slots * self.slot_low

    @property
    def observation_size(self) -> int:
        """How many numbers are sensed: three a slot, eq. (13)."""
        return len(self.observation_low)

    @property
    def sensed_squares_each_way(self) -> int:
        """How many squares of a wall, left and right of the one next to the drone, its sensor can reach."""
        return math.ceil(self.sensor_radius / self.border)

    @property
    def sensed_squares_of_a_wall(self) -> int:
        """How many neighbouring squares of a wall contain all that the drone's sensor can reach."""
        return 2 * self.sensed_squares_each_way + 2

    @property
    def view_cosine(self) -> float:
        """Cosine of half the sensor's arc: the least forward component of a direction in view."""
        return math.cos(math.radians(self.sensor_arc / 2))
