"""Everything physical about the simulated world: one home for every constant, with its unit and its source.

Section and equation numbers are the paper's ("Comparative Analysis of DQN and PPO Algorithms in UAV Obstacle Avoidance
2D Simulation"). Where the paper is silent the choice is a row of docs/decisions.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args, get_type_hints

from uavnav.errors import ConfigError, among, did_you_mean, quoted
from uavnav.settings import key

VERSION = "1"
"""Version of the world's semantics and of the distribution of obstacles; written into every bank, run and policy."""


MOST = 1_000_000
"""The largest number of a world, in whatever unit."""
POSITIVE = ("width", "height", "border", "sensor_radius", "sensor_arc", "n_slots", "n_turns", "n_distances")
"""The fields of `World` that are above 0."""


@dataclass(frozen=True)
class World:
    """The arena, the drone, its sensor and the reward's amounts.

    The origin is the lower-left corner of the window, x to the right, y up; a heading counts whole degrees
    counter-clockwise from +x. Changing a default is a new `VERSION`.

    Raises:
        ConfigError: a switch has a value that is not among its choices, or the geometry makes no sense.
    """

    width: int = key(800, "of the window, sec. 3.6", "px")
    height: int = key(600, "of the window, sec. 3.6", "px")
    border: int = key(20, "side of a border square, sec. 3.6", "px")
    obstacle_radius_min: float = key(30.0, "of the smallest circle, sec. 3.6", "px")
    obstacle_radius_max: float = key(100.0, "of the largest circle, sec. 3.6", "px")
    drone_radius: float = key(30.0, "r_d, sec. 3.6", "px")
    sensor_radius: float = key(120.0, "R_s, from the drone's centre, sec. 3.6", "px")
    sensor_arc: float = key(180.0, "of the sensor, centred on the heading, sec. 3.6", "degrees")
    n_slots: int = key(10, "sensed at once, sec. 3.6 and eq. (13)", "obstacles")
    safe_zone: float = key(50.0, "from the start to the edge of every obstacle, sec. 4.1", "px")
    n_turns: int = key(10, "turns to choose from, eq. (11)")
    n_distances: int = key(10, "distances to choose from, eq. (12)")
    collision_reward: float = key(-10.0, "for a collision, eq. (14)", "reward")
    penalty: float = key(-0.01, "for a stop or a turn, eq. (14)", "reward")
    reward_per_pixel: float = key(0.01, "for flying straight on, eq. (14)", "reward per px")
    slots: Literal["nearest", "listed"] = key("nearest", "which ten obstacles are sensed (decision 3)")
    padding: Literal["far", "zeros"] = key("far", "an empty slot: (0, 0, 1) or (0, 0, 0) (decision 6)")
    start_heading: Literal["up", "random"] = key("up", "90 degrees, or uniform over whole degrees (decision 8)")

    def __post_init__(self) -> None:
        hints = get_type_hints(type(self))
        for field in fields(self):
            choices = get_args(hints[field.name])
            value: Any = getattr(self, field.name)
            shown = quoted(value)
            if hints[field.name] is bool:
                if not isinstance(value, bool):
                    raise ConfigError(f"{field.name}={shown}; choose from false, true")
            elif choices and not among(value, choices):
                hint = did_you_mean(value, choices)
                raise ConfigError(f"{field.name}={shown}; choose from {', '.join(choices)}{hint}")
            elif not choices and (isinstance(value, bool) or not isinstance(value, (int, float))):
                raise ConfigError(f"{field.name}={shown}; give a number")
            elif not choices and MOST < abs(value) < math.inf:
                raise ConfigError(f"{field.name}={shown}; give a number of at most {MOST:,}")
            elif field.name in POSITIVE and not 0 < value < math.inf:
                raise ConfigError(f"{field.name}={value:g}; give a number above 0")
            elif not choices and not math.isfinite(value):
                raise ConfigError(f"{field.name}={value:g}; give a finite number")
            elif hints[field.name] is int and not isinstance(value, int):
                raise ConfigError(f"{field.name}={value:g}; give a whole number")
        if not self.sensor_arc <= 360:
            raise ConfigError(f"sensor_arc={self.sensor_arc:g}; give at most 360 degrees")
        if self.width % self.border or self.height % self.border:
            raise ConfigError(f"border={self.border} must divide width={self.width} and height={self.height}")
        if min(self.width, self.height) // self.border < self.sensed_squares_of_a_wall + 2:
            reach = f"sensor_radius={self.sensor_radius:g}"
            raise ConfigError(f"{reach} reaches two opposite walls at once; give a smaller one, or a larger window")
        if not 1 <= self.n_slots <= 2 * self.sensed_squares_of_a_wall:
            raise ConfigError(f"n_slots={self.n_slots}; give 1 to {2 * self.sensed_squares_of_a_wall}")
        if not 0 <= self.drone_radius < self.sensor_radius:
            raise ConfigError(
                f"drone_radius={self.drone_radius:g}; give 0 to below sensor_radius={self.sensor_radius:g}"
            )
        if not 0 < self.obstacle_radius_min <= self.obstacle_radius_max:
            most = f"obstacle_radius_max={self.obstacle_radius_max:g}"
            raise ConfigError(f"obstacle_radius_min={self.obstacle_radius_min:g}; give above 0, to {most}")
        if self.safe_zone < 0:
            raise ConfigError(f"safe_zone={self.safe_zone:g}; give at least 0")

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
        """How many squares of a wall, left and right of the one beside the drone, its sensor can reach."""
        return math.ceil(self.sensor_radius / self.border)

    @property
    def sensed_squares_of_a_wall(self) -> int:
        """How many neighbouring squares of a wall hold all that its sensor can reach, wherever the drone is."""
        return 2 * self.sensed_squares_each_way + 2

    @property
    def view_cosine(self) -> float:
        """Cosine of half the sensor's arc: the least forward component of a direction in view."""
        return math.cos(math.radians(self.sensor_arc / 2))
