"""A filter between a policy and the drone: no step into what is sensed.

An action can collide if a step of it may touch a body in one of the slots, whatever the body's size: its
nearest point is d px away in the direction u, so it is behind a plane there, and a step s leaves d - s . u.
That is exact for bodies that stand still, and for those that fly straight on with a velocity that is sensed.
The shield does not see what is in no slot: what is behind the drone or at its side, or where an echo was
lost. It takes a noisy distance as it is, a body without a sensed velocity as one that stands, and knows of no
bounce.
Letters: S slots, A actions.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from uavnav.tasks.sensed import MARGIN, moves, seen
from uavnav.tasks.world import World

PITCHED = 0.7
"""[px] by which a step in a box may end elsewhere than that of a level drone, for it senses no pitch."""


def clearances(observation: Tensor, world: World) -> Tensor:
    """The least distance to what is sensed that each action can leave: [..., numbers] -> [..., A] px."""
    slots = seen(observation, world)
    closing = moves(world).to @ slots.towards.mT - (slots.velocity * slots.towards).sum(-1)[..., None, :]
    left = torch.where(slots.empty[..., None, :], torch.inf, slots.distance[..., None, :] - closing)
    return left.amin(-1)


@functools.cache
def apart(world: World) -> Tensor:
    """How far actions are from each other [A, A]: squared degrees of turn and squared px, added up."""
    each = moves(world)
    asked = torch.cat([each.turn, each.distance[:, None]], -1)
    return (asked[:, None] - asked).square().sum(-1)


def shield(action: Tensor, observation: Tensor, world: World) -> Tensor:
    """The nearest action that cannot collide in the next step, of several the lowest; where there is none,
    the one that leaves the most room.

    action [...] int64, observation [..., numbers] -> [...]. world: as what is sensed is scaled.
    """
    room = clearances(observation, world)
    safe = room > world.drone_radius + (MARGIN if len(world.size) == 2 else PITCHED)
    nearest = torch.where(safe, apart(world)[action], torch.inf).argmin(-1)
    return torch.where(safe.any(-1), nearest, room.argmax(-1))


def shielded(policy: Callable[..., Any], world: World) -> Callable[..., Tensor]:
    """A policy of tensors under the shield; a trained one has `Policy.shielded`."""

    def act(observation: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return shield(policy(observation, generator), observation, world)

    return act
