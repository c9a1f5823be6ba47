"""A box in 3D with spheres, where a drone turns by yaw and by pitch: constants, layouts, motion, sensing.

A layout file has rows (x, y, z, radius), where spheres move also (vx, vy, vz) [px a step]; z points up.
Spheres are drawn, checked and moved as circles are (`circles`, `moving`).
Letters: B the batch shape, K spheres of a layout, N = K + 3 candidates that may be sensed.
"""

from __future__ import annotations

import math
from collections import namedtuple
from typing import cast

import torch
from torch import Tensor

from uavnav.errors import ConfigError
from uavnav.settings import key
from uavnav.tasks.dynamics import direction
from uavnav.tasks.moving import Moving, MovingWorld
from uavnav.tasks.sensing import VIEW_TOLERANCE, Scan, first_in_view, to_drone_frame
from uavnav.tasks.state import State
from uavnav.tasks.task import Task
from uavnav.tasks.world import Positive, World

DEFAULT_K = 40
"""Spheres per layout: they fill about as much of the box as 8 circles of the window."""
TURN, STRETCH = 2, 3
"""Degrees and px by which the choices of an action differ."""
STEEPEST = 45
"""Pitch at most, up or down [degrees]."""

SpaceState = cast(type[State], namedtuple("SpaceState", (*State._fields, "z", "pitch")))
"""A state in 3D: `heading` is the yaw, z [*B] px float32, pitch [*B] whole degrees, -45..45, up positive."""


class SpaceWorld(World):
    """The paper's drone and sensor in a box: width x depth x height px along x, y and z.

    Raises:
        ConfigError: as of `World`, or the sensor reaches two opposite walls at once.
    """

    depth: Positive = key(600, "of the box, along y", "px")
    n_turns: Positive = key(5, "yaws to choose from, and as many pitches")
    n_distances: Positive = key(4, "distances to choose from, 3 px apart")

    def check(self) -> None:
        super().check()
        reached = 2 * (self.border + self.sensor_radius)
        if self.depth <= reached:
            raise ConfigError(
                f"depth={self.depth:g}; give above {reached:g} px, or two opposite walls are in reach at once"
            )

    @property
    def size(self) -> tuple[int, ...]:
        """How far the box reaches along x, y and z [px]."""
        return self.width, self.depth, self.height

    @property
    def n_actions(self) -> int:
        """Yaws x pitches x distances."""
        return self.n_turns**2 * self.n_distances

    @property
    def distances(self) -> tuple[int, ...]:
        """What a step can fly [px]."""
        return tuple(STRETCH * n for n in range(self.n_distances))

    @property
    def slot_low(self) -> tuple[float, ...]:
        """The least of each number of a slot, (right, up, forward, proximity); the most is 1."""
        right, *others = super().slot_low
        return right, -1.0, *others


class SpaceMovingWorld(SpaceWorld, MovingWorld):
    """The same, and how fast spheres are: a slot may have their velocity, to the right, up and forward."""


def decode(action: Tensor, world: SpaceWorld) -> tuple[Tensor, Tensor, Tensor]:
    """Split an action into the yaw, the pitch and the distance that it asks for.

    action [...] int64 in 0..99 -> yaw and pitch 0, +2, +4, -2, -4 degrees (left and up positive), distance 0,
    3, 6, 9 px, each [...]: `a // 20`, `a // 4 % 5`, `a % 4`.
    """
    n, half = world.n_turns, world.n_turns // 2
    rest = torch.div(action, world.n_distances, rounding_mode="floor")
    yaw, pitch = (
        TURN * torch.where(turn <= half, turn, half - turn)
        for turn in (torch.div(rest, n, rounding_mode="floor"), rest % n)
    )
    return yaw, pitch, STRETCH * (action % world.n_distances)


def move(state: State, yaw: Tensor, pitch: Tensor, distance: Tensor) -> State:
    """Turn, keep the pitch in its bounds, fly straight along f: yaw, pitch [*B] degrees, distance [*B] px."""
    heading = (state.heading + yaw) % 360
    pitch = (pitch_of(state) + pitch).clamp(-STEEPEST, STEEPEST)
    (cosine, sine), (level, up) = direction(heading), direction(pitch % 360)
    return state._replace(  # type: ignore[call-arg]
        x=state.x + distance * (level * cosine),
        y=state.y + distance * (level * sine),
        z=z_of(state) + distance * up,
        heading=heading,
        pitch=pitch,
    )


def scan(
    state: State, obstacles: Tensor, world: SpaceWorld, velocities: Tensor | None = None
) -> tuple[Scan, Tensor]:
    """What comes back of the ten nearest spheres and walls in view, and the distance to the nearest of all.

    obstacles [*B, K, 4] px -> directions (right, up, forward) and distances of ten slots, and the clearance
    [*B] px from the drone's centre. Velocities [*B, K, 3], as shares of the greatest speed, are three numbers
    more of a slot.

    A wall has one nearest point, on its inner plane (distance 0 beyond it). Of two opposite walls the nearer
    one stands for both, for the sensor never reaches the other: 43 candidates for 40 spheres and six walls.
    """
    spheres = obstacles.movedim((-2, -1), (0, 1))
    dx, dy, dz = spheres[:, 0] - state.x, spheres[:, 1] - state.y, spheres[:, 2] - z_of(state)
    length = torch.sqrt(dx * dx + dy * dy + dz * dz)
    # a centre that coincides has no direction: u = (0, 0, 0)
    scale = torch.where(length > 0, 1 / length, 0.0)
    outwards, gaps = _walls(state, world)
    distance = torch.cat([length - spheres[:, 3], gaps])
    blank = max(world.n_slots - len(distance), 0)  # out of reach, where there are fewer candidates than slots
    distance = torch.cat([distance, distance.new_full((blank, *state.x.shape), math.inf)])
    towards = torch.stack([dx * scale, dy * scale, dz * scale])
    towards = torch.cat([towards, outwards, towards.new_zeros(3, blank, *state.x.shape)], 1)
    right, up, forward = to_body(towards, state)
    in_view = (distance <= world.sensor_radius) & (forward >= world.view_cosine - VIEW_TOLERANCE)
    candidates = torch.stack([right.clamp(-1, 1), up.clamp(-1, 1), forward.clamp(0, 1), distance])
    of_spheres = None
    if velocities is not None:
        of_spheres = torch.stack(to_body(velocities.movedim((-1, -2), (0, 1)), state)).clamp(-1, 1)
    return first_in_view(candidates, in_view, world, of_spheres), distance.amin(0)


def to_body(vectors: Tensor, state: State) -> tuple[Tensor, Tensor, Tensor]:
    """Rotate vectors of the world [3, N, *B] into the drone's frame: right, up and forward, each [N, *B].

    f = (cos p cos y, cos p sin y, sin p), r = (sin y, -cos y, 0), u = r x f, of yaw y and pitch p.
    """
    level, climb = direction(pitch_of(state) % 360)
    right, ahead = to_drone_frame(vectors[0], vectors[1], state.heading)
    return right, vectors[2] * level - ahead * climb, ahead * level + vectors[2] * climb


def _walls(state: State, world: SpaceWorld) -> tuple[Tensor, Tensor]:
    """Direction outwards [3, 3, *B] and distance [3, *B] px of the nearer wall along each axis."""
    places = torch.stack([state.x, state.y, z_of(state)])
    size = torch.tensor(world.size, dtype=places.dtype, device=places.device).reshape(-1, *[1] * state.x.ndim)
    near = places < size / 2
    gaps = (torch.where(near, places, size - places) - world.border).clamp(min=0)
    axes = torch.eye(3, dtype=places.dtype, device=places.device).reshape(3, 3, *[1] * state.x.ndim)
    return axes * torch.where(near, -1.0, 1.0), gaps


def z_of(state: State) -> Tensor:
    """The height of each drone [*B] px."""
    found: Tensor = getattr(state, "z")  # noqa: B009
    return found


def pitch_of(state: State) -> Tensor:
    """The pitch of each drone [*B] whole degrees."""
    found: Tensor = getattr(state, "pitch")  # noqa: B009
    return found


class Space(Task):
    """A drone in a box with spheres, which turns by yaw and by pitch. A step turns if it asks for one."""

    WORLD = SpaceWorld
    STATIC = True
    STATE = SpaceState
    world: SpaceWorld

    def start(self, layout: Tensor, heading: Tensor) -> State:
        """The state at the beginning of an episode: at the centre of the box, level."""
        z = torch.full_like(layout, self.world.start[2], dtype=torch.float32)
        level = torch.zeros_like(layout)
        return self.STATE(*super().start(layout, heading), z, level)  # type: ignore[call-arg]

    def info(self, state: State) -> dict[str, Tensor]:
        """As of the paper's task, and z, yaw and pitch."""
        facts = {"z": z_of(state), "yaw": state.heading, "pitch": pitch_of(state)}
        return super().info(state) | facts

    def sense(self, state: State) -> tuple[Scan, Tensor]:
        """What comes back of spheres and walls, and the clearance [*B] px."""
        return scan(state, self.obstacles(state), self.world, self.sensed_velocities(state))

    def move(self, state: State, action: Tensor) -> tuple[State, Tensor, Tensor]:
        """Turn, then fly: where the drone is after action [*B], degrees asked for [*B], distance [*B] px."""
        yaw, pitch, distance = decode(action, self.world)
        return move(state, yaw, pitch, distance), yaw.abs() + pitch.abs(), distance


class SpaceMoving(Moving, Space):
    """The same among spheres that fly straight on and bounce off the sides of the box."""

    WORLD = SpaceMovingWorld
    world: SpaceMovingWorld
