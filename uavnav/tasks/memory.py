"""What a drone remembers of an episode: its newest observations and its last action, as two more fields of its state.

Stacks and late observations read them, and an observation keeps the noise that it was sensed with. Letters: B the
batch shape (any, also none), M observations that are kept, N numbers of one.
"""

from __future__ import annotations

import functools
from collections import namedtuple
from typing import Any

import torch
from torch import Tensor

from uavnav.tasks.state import State

FIELDS = ("seen", "executed")
"""Observations [*B, M, N], the newest first, and the action [*B] of the last step, 0 before the first."""


@functools.cache
def remembering(kind: Any) -> type[State]:
    """The class of a state's own fields and of `FIELDS`."""
    return namedtuple("Remembering", (*kind._fields, *FIELDS))  # type: ignore[return-value]


def begin(state: State, sensed: Tensor, n: int) -> State:
    """A bare state that now remembers one observation [*B, N] n times, as at the start of an episode."""
    seen = sensed[..., None, :].expand(*sensed.shape[:-1], n, -1).clone()
    kind = remembering(type(state))  # type: ignore[arg-type]
    return kind(*state, seen, torch.zeros_like(state.layout))  # type: ignore[call-arg]


def add(state: State, sensed: Tensor, action: Tensor) -> State:
    """Remember a new observation [*B, N] and the action [*B] that led to it; the oldest observation is forgotten."""
    seen = torch.cat([sensed[..., None, :], seen_of(state)[..., :-1, :]], -2)
    return state._replace(seen=seen, executed=action)  # type: ignore[call-arg]


def seen_of(state: State) -> Tensor:
    """The observations that are kept [*B, M, N]."""
    found: Tensor = getattr(state, "seen")  # noqa: B009
    return found


def executed_of(state: State) -> Tensor:
    """The action of the last step [*B]."""
    found: Tensor = getattr(state, "executed")  # noqa: B009
    return found
