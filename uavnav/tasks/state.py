"""What a batch of flights is at one moment. Letters: B the batch shape (any, also none)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

UP = 90
"""The default start heading [degrees]."""


class State(NamedTuple):
    """Where each drone is and what it did since its episode began; every field has the batch shape B."""

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


def where(condition: Tensor, chosen: State, other: State) -> State:
    """Row by row, one state or the other: condition [*B] bool."""
    return State(*(torch.where(condition, a, b) for a, b in zip(chosen, other, strict=True)))
