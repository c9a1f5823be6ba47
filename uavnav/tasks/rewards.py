"""Equation (14) and the other readings of the paper's reward, each as named terms whose sum is the reward.

Every variant has the same form: collided [...] bool, distance [...] px and angle [...] degrees (whole numbers) and the
world's amounts -> a dict of float64 tensors [...]. To add one, write a function and name it in `REWARDS`.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from uavnav.tasks.world import World

Terms = dict[str, Tensor]


def eq14(collided: Tensor, distance: Tensor, angle: Tensor, world: World) -> Terms:
    """Exclusive cases: -10 on collision; else -0.01 if distance = 0 or angle != 0; else 0.01 distance. Eq. (14)."""
    penalised = ~collided & ((distance == 0) | (angle != 0))
    return {
        "collision": _where(collided, world.collision_reward),
        "penalty": _where(penalised, world.penalty),
        "progress": _where(~collided & ~penalised, world.reward_per_pixel * distance.double()),
    }


def additive(collided: Tensor, distance: Tensor, angle: Tensor, world: World) -> Terms:
    """The text of sec. 4.2: -10 on collision; else 0.01 distance - 0.01 [distance = 0] - 0.01 [angle != 0]."""
    return initial(collided, distance, angle, world) | {
        "stop": _where(~collided & (distance == 0), world.penalty),
        "turn": _where(~collided & (angle != 0), world.penalty),
    }


def initial(collided: Tensor, distance: Tensor, angle: Tensor, world: World) -> Terms:
    """The first version of sec. 4.2, before the penalties: -10 on collision; else 0.01 distance."""
    return {
        "collision": _where(collided, world.collision_reward),
        "progress": _where(~collided, world.reward_per_pixel * distance.double()),
    }


def _where(condition: Tensor, amount: float | Tensor) -> Tensor:
    if isinstance(amount, float):
        return condition.double() * amount
    return torch.where(condition, amount, 0.0)


REWARDS: dict[str, Callable[[Tensor, Tensor, Tensor, World], Terms]] = {
    "eq14": eq14,
    "additive": additive,
    "initial": initial,
}

BUILT_IN = dict(REWARDS)
"""Those that every process has, whatever its caller adds to the table."""
