"""Scripted policies, of the form that `uavnav.evaluate_policy` takes: what a learned one must be better than."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from uavnav.tasks.protocol import SCRIPTS
from uavnav.tasks.world import World

AnyPolicy = Callable[[Tensor, torch.Generator | None], Tensor]
"""observation [N, 30], generator -> action [N] int64 in 0..99."""

WORLD = World()
FULL_SPEED = WORLD.n_distances - 1  # straight ahead, 9 px
LEFT_IN_PLACE = WORLD.n_turns // 2 * WORLD.n_distances  # 5 degrees, 0 px
MARGIN = 0.01  # [px] against rounding


def uniform_random(observation: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Every action equally likely: the free check of the world (90 % turns, 10 % stops, 4.5 px a step)."""
    return torch.randint(WORLD.n_actions, observation.shape[:-1], generator=generator)


def straight_ahead(observation: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Nine pixels a step and never a turn, whatever is in the way."""
    return torch.full(observation.shape[:-1], FULL_SPEED)


def reactive(observation: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Fly straight at full speed where that is certainly safe, else turn left on the spot.

    The distance to a convex body at d px in a direction with forward component y falls by at most s y over s px
    straight ahead, and what is behind recedes: d - 9 y > 30 for all that is in view excludes a collision. It looks at
    the newest observation of a stack.
    """
    size = observation.shape[-1]
    width = 3 if size % WORLD.observation_size == 0 else 5  # with velocities
    slots = observation[..., : WORLD.n_slots * width].reshape(*observation.shape[:-1], WORLD.n_slots, width)
    distance = WORLD.drone_radius + slots[..., 2] * (WORLD.sensor_radius - WORLD.drone_radius)
    closest = (distance - FULL_SPEED * slots[..., 1]).amin(-1)
    return torch.where(closest > WORLD.drone_radius + MARGIN, FULL_SPEED, LEFT_IN_PLACE)


BASELINES: dict[str, AnyPolicy] = dict(zip(SCRIPTS, (uniform_random, straight_ahead, reactive), strict=True))
