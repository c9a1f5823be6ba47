"""Circles that fly straight on and bounce off the edges of the window: where each is, is a closed function of
the step.

A layout file has rows (x, y, radius, vx, vy): a circle as in the paper's task, and its velocity [px a step]
at step 0.
Letters: B the batch shape, K obstacles of a layout.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from uavnav.errors import ConfigError
from uavnav.settings import key
from uavnav.tasks import circles
from uavnav.tasks.protocol import DEFAULT_K
from uavnav.tasks.state import State
from uavnav.tasks.task import Task
from uavnav.tasks.world import Number, World

VELOCITIES = 1
"""The stream of a layout file's velocities; its circles have another."""


class MovingWorld(World):
    """The paper's arena, drone and sensor, and how fast obstacles are.

    Raises:
        ConfigError: as of `World`, or the speeds are no range.
    """

    speed_min: Number = key(0.0, "of the slowest obstacle", "px a step")
    speed_max: Number = key(
        2.0, "of the fastest obstacle; sensed velocities are shares of it", "px a step", ge=0
    )
    sense_velocity: bool = key(
        False, "a slot has two numbers more, the obstacle's velocity to the right and forward"
    )

    def check(self) -> None:
        super().check()
        if not 0 <= self.speed_min <= self.speed_max:
            raise ConfigError(
                f"speed_min={self.speed_min:g}; give 0 to speed_max={self.speed_max:g} px a step"
            )

    @property
    def slot_low(self) -> tuple[float, ...]:
        """The least of each number of a slot."""
        return (*super().slot_low, *[-1.0] * (len(self.size) * self.sense_velocity))


def generate(n: int, k: int = DEFAULT_K, seed: int = 0, world: World | None = None) -> Tensor:
    """The circles that the same arguments give `circles.generate`, each with a velocity: its speed is uniform
    in [speed_min, speed_max] px a step, its direction uniform, in 3D over the sphere.

    Returns:
        Tensor [n, k, 5] float32 of (x, y, radius) px and (vx, vy) px a step, in 3D [n, k, 7].

    Raises:
        LayoutError: n, k or seed is negative.
    """
    world = circles.of_kind(MovingWorld, world)
    standing = circles.generate(n, k, seed, world)
    rng = np.random.Generator(np.random.PCG64([seed, VELOCITIES]))
    share, turn, *height = rng.random((len(world.size), n, k))
    speed = world.speed_min + (world.speed_max - world.speed_min) * share
    up = [2 * one - 1 for one in height]  # of a direction that is uniform over the sphere
    level = np.sqrt(1 - up[0] * up[0]) if up else 1.0
    ways = level * np.cos(2 * np.pi * turn), level * np.sin(2 * np.pi * turn), *up
    velocity = speed * np.stack(ways)
    return torch.cat([standing, torch.from_numpy(velocity.astype(np.float32)).movedim(0, -1)], -1)


def validate(layouts: Tensor, world: World | None = None) -> None:
    """As `circles.validate`; and every centre is in the window or the box, for there is no bouncing in from
    outside.

    Raises:
        LayoutError: naming the first layout that is wrong.
    """
    world = circles.of_kind(MovingWorld, world)
    axes = len(world.size)
    circles.validate(layouts, world, more=axes)
    centres = layouts[..., :axes].cpu().numpy()
    inside = (centres >= 0) & (centres <= np.array(world.size))
    circles.refuse_first(
        np.asarray(~inside.all(-1)), f"has its centre outside the {'window' if axes == 2 else 'box'}"
    )


def motion(layouts: Tensor, steps: Tensor, world: World) -> tuple[Tensor, Tensor]:
    """Where obstacles are and move after so many steps: p(t) = reflect(p(0) + v t), a triangle wave between
    the edges.

    layouts [*B, K, 5], steps [*B] int64 -> obstacles [*B, K, 3] px, velocities [*B, K, 2] px a step; in 3D
    layouts [*B, K, 7] -> [*B, K, 4], [*B, K, 3].

    The way and the wave are float64, for float32 would err by 0.1 px after a million steps; then float32. A
    velocity is that of the next moment: at an edge it points inwards.
    """
    axes = len(world.size)
    numbers = layouts.movedim((-1, -2), (0, 1))  # the batch is innermost, as in `sensing.sense`
    start, radius, velocity = numbers[:axes].double(), numbers[axes : axes + 1], numbers[axes + 1 :]
    size = torch.tensor(world.size, dtype=torch.float64, device=layouts.device).reshape(
        -1, *[1] * (layouts.ndim - 1)
    )
    way = start + velocity.double() * steps
    rest = way - 2 * size * torch.round(way / (2 * size))  # [-size, size]: the wave is its magnitude
    there = torch.where(velocity > 0, (rest >= 0) & (rest < size), (rest > 0) | (rest <= -size))
    places, speeds = torch.cat([rest.abs().float(), radius]), torch.where(there, velocity, -velocity)
    return places.movedim((0, 1), (-1, -2)), speeds.movedim((0, 1), (-1, -2))


class Moving(Task):
    """The paper's task among obstacles that fly straight on and bounce off the edges of the window.

    In a step the drone moves first and the obstacles after it; who stands still can be hit.
    """

    WORLD = MovingWorld
    STATIC = False
    world: MovingWorld

    def obstacles(self, state: State) -> Tensor:
        """Where the obstacles of each row are now: [*B, K, 3] px."""
        return motion(self.layouts[state.layout], state.steps, self.world)[0]

    def velocities(self, state: State) -> Tensor:
        """Where the obstacles of each row move: [*B, K, 2] px a step."""
        return motion(self.layouts[state.layout], state.steps, self.world)[1]

    def info(self, state: State) -> dict[str, Tensor]:
        """The paper's facts, and the episode's steps, which decide where the obstacles are."""
        return super().info(state) | {"steps": state.steps}

    def sensed_velocities(self, state: State) -> Tensor | None:
        """Velocities as shares of the greatest speed, where they are sensed."""
        if not self.world.sense_velocity:
            return None
        velocities = self.velocities(state)
        return velocities / self.world.speed_max if self.world.speed_max else torch.zeros_like(velocities)

    def move(self, state: State, action: Tensor) -> tuple[State, Tensor, Tensor]:
        """Move as in the paper's task. The count of steps rises, so the obstacles move too."""
        moved, angle, distance = super().move(state, action)
        return moved._replace(steps=state.steps + 1), angle, distance
