"""What a batch of episodes is at one moment. Letters: B the batch shape (any, also none)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

UP = 90
"""The default start heading [degrees]."""


class State(NamedTuple):
    """Where each drone is and what it did since its episode began; every field has the batch shape B.

    A task may have a class of its own with more fields (`Task.STATE`); a drone that remembers has two more
    (`wrapper.remembering`).
    """

    x: Tensor  # [px] float32
    y: Tensor  # [px] float32
    heading: Tensor  # whole degrees in 0..359, int64
    layout: Tensor  # index of the layout in the split, int64
    steps: Tensor  # int64, as are the next four
    stops: Tensor  # steps with distance = 0
    full_stops: Tensor  # steps with distance = 0 and angle = 0
    turns: Tensor  # steps with angle != 0
    distance: Tensor  # [px]
    reward: Tensor  # sum over the episode, float64


COUNTS = ("steps", "stops", "full_stops", "turns", "distance", "reward")
"""The fields of `State` that describe an episode as a whole: one column each of every table of episodes."""


def where(condition: Tensor, chosen: State, other: State) -> State:
    """Row by row, one state or the other: condition [*B] bool."""
    return type(other)(*(torch.where(_like(condition, a), a, b) for a, b in zip(chosen, other, strict=True)))


def at(state: State, index: Tensor | int) -> State:
    """Some rows of a batch [P], or one: every field at these places."""
    return type(state)(*(field[index] for field in state))


def _like(condition: Tensor, field: Tensor) -> Tensor:
    """A condition [*B] with a dimension for each further one of a field [*B, ...]."""
    further = field.ndim - condition.ndim
    return condition.reshape(*condition.shape, *[1] * further) if further else condition
