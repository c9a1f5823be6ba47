"""How an action moves the drone: equations (11) and (12). Pure functions of tensors of any batch shape."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from uavnav.tasks.world import World


def _exact_cosine(degrees: int) -> float:
    return {0: 1.0, 90: 0.0, 180: -1.0, 270: 0.0}.get(degrees % 360, math.cos(math.radians(degrees)))


COSINE = torch.tensor([_exact_cosine(degrees) for degrees in range(360)], dtype=torch.float32)
SINE = torch.tensor([_exact_cosine(degrees - 90) for degrees in range(360)], dtype=torch.float32)


def direction(heading: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vector of a heading, exact at multiples of 90 degrees.

    heading [...] whole degrees in 0..359 -> cos, sin [...] float32.
    """
    # stacked, they are looked up once a row in a compiled step, and not for each candidate again
    cosine, sine = torch.stack([COSINE.to(heading.device)[heading], SINE.to(heading.device)[heading]])
    return cosine, sine


def decode(action: Tensor, world: World) -> tuple[Tensor, Tensor]:
    """Split an action into its turn and its distance, eqs (11) and (12).

    action [...] int64 in 0..99 -> angle [...] degrees (left positive, right negative), distance [...] px.
    """
    turn = torch.div(action, world.n_distances, rounding_mode="floor")
    angle = torch.where(turn <= world.n_turns // 2, turn, turn - world.n_turns)
    return angle, action % world.n_distances


def move(
    x: Tensor, y: Tensor, heading: Tensor, angle: Tensor, distance: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Turn first, then fly straight along the new heading.

    x, y [...] px, heading [...] and angle [...] whole degrees, distance [...] px -> the new x, y, heading.
    """
    heading = (heading + angle) % 360
    cosine, sine = direction(heading)
    return x + distance * cosine, y + distance * sine, heading
