"""Equation (14) and the other forms of the paper's reward, each as named terms whose sum is the
reward.

A reward is a function of a `Step` and gives float64 tensors [*B] by name. To add one, write a function and
an entry in `REWARDS`; it may look at everything in the step. An entry in `BOUNDS` declares its least and its
greatest number; one in `BY_ACTION` is optional, and makes evaluations faster.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from uavnav.errors import ConfigError
from uavnav.tasks.state import State
from uavnav.tasks.world import World

Terms = dict[str, Tensor]


class Step(NamedTuple):
    """A step of every row of a batch B, as a reward sees it."""

    before: State  # where each drone was
    after: State  # where it is, with the counts of this step; the reward is still that of `before`
    action: Tensor  # [*B] int64, as it was executed
    # [*B] whole degrees that it turned, left positive; in 3D the degrees of yaw and pitch asked for
    angle: Tensor
    distance: Tensor  # [*B] whole px that it flew
    clearance: Tensor  # [*B] px from the drone's centre to the nearest obstacle
    observation: Tensor  # [*B, observation_size] that the step led to
    world: World  # with the reward's amounts
    # [*B] px from the drone to its goal, before and after; None without
    to_goal: tuple[Tensor, Tensor] | None = None

    @property
    def collided(self) -> Tensor:
        """Whether each drone touches something after the step [*B] bool."""
        return self.clearance <= self.world.drone_radius


def total(reward: str, terms: Terms, rows: Tensor) -> Tensor:
    """The reward of a step: the sum of its terms [*B] float64; rows [*B].

    Raises:
        ValueError: a reward gives something else than named terms of that kind.
    """
    if not isinstance(terms, Mapping) or not terms:
        raise ValueError(
            f"reward={reward}: gives {type(terms).__name__}; give named terms, a dict of at least one"
        )
    for name, term in terms.items():
        if not isinstance(term, Tensor) or term.shape != rows.shape:
            is_not = f"of shape {[*term.shape]}" if isinstance(term, Tensor) else f"a {type(term).__name__}"
            raise ValueError(f"reward={reward}: its term {name} is {is_not}; give a tensor {[*rows.shape]}")
    return torch.stack([term.double() for term in terms.values()]).sum(0)


def eq14(step: Step) -> Terms:
    """Eq. (14): -10 on collision; else -0.01 if distance = 0 or angle != 0; else 0.01 distance."""
    penalised = ~step.collided & ((step.distance == 0) | (step.angle != 0))
    return {
        "collision": step.world.collision_reward * step.collided.double(),
        "penalty": step.world.penalty * penalised.double(),
        "progress": step.world.reward_per_pixel * step.distance.double() * ~(step.collided | penalised),
    }


def additive(step: Step) -> Terms:
    """Sec. 4.2's text: -10 on collision; else 0.01 distance - 0.01 [distance = 0] - 0.01 [angle != 0]."""
    return initial(step) | {
        "stop": step.world.penalty * (~step.collided & (step.distance == 0)).double(),
        "turn": step.world.penalty * (~step.collided & (step.angle != 0)).double(),
    }


def initial(step: Step) -> Terms:
    """The first version of sec. 4.2, before the penalties: -10 on collision; else 0.01 distance."""
    return {
        "collision": step.world.collision_reward * step.collided.double(),
        "progress": step.world.reward_per_pixel * step.distance.double() * ~step.collided,
    }


def goal(step: Step) -> Terms:
    """A way to a goal: -10 on collision and nothing else; else 10 at the goal, 0.01 a pixel nearer to it, and
    -0.01 if distance = 0 or angle != 0.
    """
    assert step.to_goal is not None
    world: Any = step.world  # with a goal, as `check_reward` made sure
    before, after = (distance.double() for distance in step.to_goal)
    penalised = ~step.collided & ((step.distance == 0) | (step.angle != 0))
    return {
        "collision": step.world.collision_reward * step.collided.double(),
        "goal": world.goal_reward * (~step.collided & (after <= world.goal_radius)).double(),
        "progress": step.world.reward_per_pixel * (before - after) * ~step.collided,
        "penalty": step.world.penalty * penalised.double(),
    }


REWARDS: dict[str, Callable[[Step], Terms]] = {
    "eq14": eq14,
    "additive": additive,
    "initial": initial,
    "goal": goal,
}


def check_reward(name: str, world: World) -> None:
    """Raise a ConfigError where a reward asks for what a world does not have."""
    if name == "goal" and not hasattr(world, "goal_radius"):
        raise ConfigError("reward=goal: this task has no goal; choose task=goal, or another reward")


class Bounds(NamedTuple):
    """The least and the most that a reward gives."""

    flying: tuple[float, float]  # for a step after which the episode goes on
    collided: tuple[float, float]  # for one that ends it, by a collision or at a goal


def _among(flying: list[float], world: World) -> Bounds:
    return Bounds((min(flying), max(flying)), (world.collision_reward, world.collision_reward))


def _progress(world: World, least: int) -> list[float]:
    """Of the distances that a step can fly, from so many px."""
    return [world.reward_per_pixel * distance for distance in world.distances if distance >= least]


def _to_goal(world: Any) -> Bounds:
    """A step brings the drone nearer to its goal, or further away, by no more than it flies."""
    most = max(map(abs, _progress(world, 0)))
    flying = (-most + min(world.penalty, 0), most + max(world.penalty, 0))
    ends = (world.collision_reward, *(world.goal_reward + edge for edge in flying))
    return Bounds(flying, (min(ends), max(ends)))


BOUNDS: dict[str, Callable[[World], Bounds]] = {
    "eq14": lambda world: _among([world.penalty, *_progress(world, 1)], world),
    "additive": lambda world: _among(
        [earned + world.penalty * n for n in (0, 1) for earned in (world.penalty, *_progress(world, 1))],
        world,
    ),
    "initial": lambda world: _among(_progress(world, 0), world),
    "goal": _to_goal,
}
"""What the rewards of `REWARDS` that have bounds are between; one without an entry declares none."""


def bounds_of_returns(reward: str, world: World, gamma: float) -> tuple[float, float] | None:
    """Between which two numbers all discounted returns of a reward are; None if it declares no bounds, or
    gamma = 1.

    A return is (1 - gamma^n) times a mean of the flying steps over 1 - gamma, and gamma^n times the last one.
    """
    if reward not in BOUNDS or gamma == 1:
        return None
    flying, collided = BOUNDS[reward](world)
    least, most = (float(f"{edge / (1 - gamma):.12g}") for edge in flying)  # 9, and not 8.999999999999991
    return min(least, collided[0]), max(most, collided[1])


BY_ACTION = (eq14, additive, initial)
"""Those that follow only from the action and the collision: evaluation counts a drone that repeats a round
without stepping it on, and Gymnasium steps it in plain numbers. Another reward is right, and slower.
"""

KNOWN = dict(REWARDS)
"""Those that every process of a run has: built in, or of a plugin."""
