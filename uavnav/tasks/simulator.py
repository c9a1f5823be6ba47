"""One flight, step by step: start, observe, move, judge, count. Pure functions over a batch of independent rows.

The environments (TorchRL in `env`, Gymnasium in `gym`) are thin shells around these functions; nothing here knows of
TensorDicts, specs or agents. Letters: B the batch shape (any, also none), L layouts of a bank, K obstacles of a layout.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from uavnav.choices import did_you_mean
from uavnav.tasks.dynamics import decode, move
from uavnav.tasks.rewards import REWARDS
from uavnav.tasks.sensing import sense
from uavnav.tasks.world import World

UP = 90
"""The default start heading [degrees]."""


class State(NamedTuple):
    """Where each drone is and what it did since its episode began; every field has the batch shape."""

    x: Tensor  # [px] float32
    y: Tensor  # [px] float32
    heading: Tensor  # whole degrees in 0..359, int64
    layout: Tensor  # index of the obstacle set in the bank, int64
    steps: Tensor  # int64, as are the next four
    stops: Tensor  # steps with distance = 0
    full_stops: Tensor  # steps with distance = 0 and angle = 0
    turns: Tensor  # steps with angle != 0
    distance: Tensor  # [px]
    reward: Tensor  # sum over the episode, float64


COUNTS = ("steps", "stops", "full_stops", "turns", "distance", "reward")
"""The fields of `State` that describe an episode as a whole: one column each of every table of episodes."""


class Outcome(NamedTuple):
    """What a step led to."""

    observation: Tensor  # [*B, 30] float32, at the collision where there was one
    clearance: Tensor  # [*B] px
    reward: Tensor  # [*B] float64
    terminated: Tensor  # [*B] bool: a collision
    truncated: Tensor  # [*B] bool: the cap on steps, and no collision


def check_rules(reward: str, max_steps: int | None) -> None:
    """Refuse an unknown reward and a cap that is no whole number from 1.

    Raises:
        ValueError: naming the choices.
    """
    if reward not in REWARDS:
        raise ValueError(f"reward={reward!r}; choose from {', '.join(REWARDS)}{did_you_mean(reward, REWARDS)}")
    if max_steps is not None and (not isinstance(max_steps, int) or max_steps < 1):
        raise ValueError(f"max_steps={max_steps}; choose None or a whole number from 1")


def start(layout: Tensor, heading: Tensor, world: World) -> State:
    """The state at the beginning of an episode: layout [*B] index, heading [*B] whole degrees."""
    x, y = world.start
    steps, stops, full_stops, turns, distance = (torch.zeros_like(layout) for _ in range(5))
    return State(
        x=torch.full_like(layout, x, dtype=torch.float32),
        y=torch.full_like(layout, y, dtype=torch.float32),
        heading=heading,
        layout=layout,
        steps=steps,
        stops=stops,
        full_stops=full_stops,
        turns=turns,
        distance=distance,
        reward=torch.zeros_like(layout, dtype=torch.float64),
    )


def observe(state: State, bank: Tensor, world: World) -> tuple[Tensor, Tensor]:
    """Eq. (13) as one vector a row: bank [L, K, 3] px -> observation [*B, 30], clearance [*B] px."""
    slots, clearance = sense(state.x, state.y, state.heading, bank[state.layout], world)
    return slots.flatten(-2), clearance


def step(
    state: State, action: Tensor, bank: Tensor, world: World, reward: str, max_steps: int | None
) -> tuple[State, Outcome]:
    """Turn, move, sense, then judge: one step of every row.

    action [*B] int64 in 0..99, bank [L, K, 3] px, reward a name of `REWARDS`. A collision is `terminated`; the cap on
    steps, where there is one, is `truncated` and never also a collision.
    """
    angle, distance = decode(action, world)
    x, y, heading = move(state.x, state.y, state.heading, angle, distance)
    moved = state._replace(x=x, y=y, heading=heading)
    observation, clearance = observe(moved, bank, world)
    collided = clearance <= world.drone_radius
    terms = REWARDS[reward](collided, distance, angle, world)
    earned = torch.stack(list(terms.values())).sum(0)
    stopped, turned = distance == 0, angle != 0
    after = moved._replace(
        steps=state.steps + 1,
        stops=state.stops + stopped,
        full_stops=state.full_stops + (stopped & ~turned),
        turns=state.turns + turned,
        distance=state.distance + distance,
        reward=state.reward + earned,
    )
    capped = torch.zeros_like(collided) if max_steps is None else after.steps >= max_steps
    return after, Outcome(observation, clearance, earned, collided, capped & ~collided)


def where(condition: Tensor, chosen: State, other: State) -> State:
    """Row by row, one state or the other: condition [*B] bool."""
    return State(*(torch.where(condition, a, b) for a, b in zip(chosen, other, strict=True)))
