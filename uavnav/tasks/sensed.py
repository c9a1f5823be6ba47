"""An observation as geometry: what scripted policies and the shield decide by. Nothing else is looked at.

Vectors are in the drone's frame, forward last: (right, forward), in a box (right, up, forward). Letters: S
slots, A actions, N points of a way.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from uavnav.tasks import dynamics, space
from uavnav.tasks.goal import SCALE, GoalWorld
from uavnav.tasks.moving import MovingWorld
from uavnav.tasks.space import SpaceWorld
from uavnav.tasks.world import World

MARGIN = 0.01  # [px] against rounding
FAR = 1e4  # [px] to a goal that there is not


class Seen(NamedTuple):
    """The slots of the newest observation."""

    towards: Tensor  # [..., S, axes] unit vectors
    distance: Tensor  # [..., S] px from the drone's centre to the nearest point of a body
    empty: Tensor  # [..., S] bool
    velocity: Tensor  # [..., S, axes] px a step; zero where none is sensed


def seen(observation: Tensor, world: World) -> Seen:
    """What an observation [..., numbers] says; of a stack, its newest. world: what is sensed."""
    width, axes = len(world.slot_low), len(world.size)
    slots = observation[..., : world.n_slots * width].reshape(*observation.shape[:-1], world.n_slots, width)
    towards = slots[..., :axes]
    distance = world.drone_radius + slots[..., axes] * (world.sensor_radius - world.drone_radius)
    velocity = torch.zeros_like(towards)
    if isinstance(world, MovingWorld) and world.sense_velocity:
        velocity = slots[..., axes + 1 :] * world.speed_max
    return Seen(towards, distance, (towards == 0).all(-1), velocity)


def target(observation: Tensor, world: World) -> tuple[Tensor, Tensor]:
    """Where to fly: a unit vector [..., axes] and how far it is [...] px; straight ahead without a goal."""
    if isinstance(world, GoalWorld):
        end = world.observation_size
        return observation[..., end - 3 : end - 1], observation[..., end - 1] * SCALE
    ahead = torch.eye(len(world.size))[-1].expand(*observation.shape[:-1], -1)
    return ahead, torch.full(observation.shape[:-1], FAR)


class Moves(NamedTuple):
    """What every action asks for; in a box as if the drone were level, for it does not sense its pitch."""

    turn: Tensor  # [A, angles] degrees: to the left, in a box also upwards
    distance: Tensor  # [A] px
    heading: Tensor  # [A, axes] unit vectors

    @property
    def to(self) -> Tensor:
        """Where a step ends [A, axes] px."""
        return self.distance[:, None] * self.heading


@functools.cache
def moves(world: World) -> Moves:
    """All actions of a world."""
    action = torch.arange(world.n_actions)
    decoded = space.decode(action, world) if isinstance(world, SpaceWorld) else dynamics.decode(action, world)
    *angles, distance = (one.float() for one in decoded)
    turn = torch.stack(angles, -1)
    return Moves(turn, distance, ahead(turn))


def ahead(turn: Tensor) -> Tensor:
    """The unit vector that is ahead after a turn: [..., angles] degrees -> [..., axes]."""
    yaw, *pitch = torch.deg2rad(turn).unbind(-1)
    level = pitch[0].cos() if pitch else torch.ones_like(yaw)
    return torch.stack([-yaw.sin() * level, *(one.sin() for one in pitch), yaw.cos() * level], -1)


def steer(wanted: Tensor, world: World, tolerance: float = 0.0, forbidden: Tensor | float = 0.0) -> Tensor:
    """The action whose displacement is nearest to a wanted one [..., axes] px; of several, the one that turns
    most towards it.

    It does not turn where it would fly within so many degrees of it anyway. forbidden: how deep [..., A] px
    each action leads into what is forbidden; the least deep comes before the nearest.
    """
    each, length = moves(world), wanted.norm(dim=-1, keepdim=True)
    along = wanted @ each.heading.T
    score = each.distance * (2 * along - each.distance) + 0.01 * along - 1e3 * forbidden
    ahead_already = along[..., :1] >= length * math.cos(math.radians(tolerance))
    return torch.where(ahead_already & (each.turn != 0).any(-1), -torch.inf, score).argmax(-1)
