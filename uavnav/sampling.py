"""The random choices of training, each agent's from its own generator: actions, replay indices, minibatch order.

TorchRL's own samplers draw from one global stream, which would tie the agents of a population together.
Letters: A agents, W worlds an agent, N rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.data import Storage
from torchrl.data.replay_buffers import Sampler

from uavnav.seeding import Streams


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


class AgentSampler(Sampler):  # type: ignore[misc]
    """Indices (row, agent) into a storage of rows [A, ...]: every agent draws its own rows, and gets a batch [A, N].

    Args:
        seeds: one for each agent.
        purpose: names its streams.
        replace: uniform draws as for replay, or a permutation of all rows as for an epoch of minibatches.
    """

    def __init__(self, seeds: Sequence[int], purpose: str, replace: bool) -> None:
        self.streams = Streams(seeds, purpose)
        self.replace = replace

    def sample(self, storage: Storage, batch_size: int) -> tuple[tuple[Tensor, Tensor], dict[str, Any]]:
        if self.replace:
            rows = self.streams.draw(torch.randint, len(storage), (batch_size,), device=storage.device)
        else:
            rows = self.streams.draw(torch.randperm, len(storage), device=storage.device)[:, :batch_size]
        return (rows, torch.arange(len(rows), device=rows.device)[:, None]), {}

    def state_dict(self) -> dict[str, Any]:
        return self.streams.state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.streams.load_state_dict(state_dict)

    def _empty(self) -> None:
        """Nothing is kept between draws."""

    def dumps(self, path: str | Path) -> None:
        raise NotImplementedError("a run's checkpoint saves the generators through state_dict")

    def loads(self, path: str | Path) -> None:
        raise NotImplementedError("a run's checkpoint restores the generators through load_state_dict")
