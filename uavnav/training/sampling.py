"""The random choice of an action, from uniform numbers that the caller draws: nothing here has a generator."""

from __future__ import annotations

import torch
from torch import Tensor


def sample_categorical(logits: Tensor, uniform: Tensor) -> Tensor:
    """An action from softmax(logits) by inverting its cumulative distribution.

    logits [..., actions], uniform [...] in [0, 1) -> int64 [...].
    """
    cumulative = torch.softmax(logits, -1).cumsum(-1)
    return (cumulative <= uniform[..., None]).sum(-1).clamp(max=logits.shape[-1] - 1)


def epsilon_greedy(values: Tensor, epsilon: Tensor | float, coin: Tensor, choice: Tensor) -> Tensor:
    """The best action, or with probability epsilon a uniformly random one.

    values [..., actions], coin and choice [...] uniform in [0, 1) -> int64 [...].
    """
    n_actions = values.shape[-1]
    explored = (choice * n_actions).long().clamp(max=n_actions - 1)
    return torch.where(coin < epsilon, explored, values.argmax(-1))
