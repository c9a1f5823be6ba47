"""What learns from rollouts in epochs of minibatches, whatever its loss: its settings, and its minibatches.

Letters: A agents, one per seed; W environments an agent; T steps of a rollout; M minibatches.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from uavnav.errors import ConfigError
from uavnav.settings import Count, Whole, key
from uavnav.tasks.seeding import Streams
from uavnav.training.config import TrainConfig
from uavnav.training.update import Learner


class RolloutConfig(TrainConfig):
    """What learning from minibatches of rollouts needs, whatever its loss."""

    frames_per_batch: Count = key(2048, "collected in an iteration, from all environments", "frames per seed")
    minibatch_size: Count = key(64, "in a gradient step", "frames")
    epochs: Whole = key(10, "passes over an iteration's frames", ge=1, le=1_000)

    def check(self) -> None:
        super().check()
        if self.frames_per_batch % self.minibatch_size:
            raise ConfigError(
                f"minibatch_size={self.minibatch_size}; give a divisor of "
                f"frames_per_batch={self.frames_per_batch}"
            )

    @property
    def frames_between_rows(self) -> int:
        return self.frames_per_batch

    @property
    def frames_per_iteration(self) -> int:
        return self.frames_per_batch

    @property
    def updates(self) -> int:
        return self.frames // self.minibatch_size * self.epochs


def minibatches(batch: TensorDictBase, orders: Streams, size: int, keys: Sequence[str]) -> TensorDictBase:
    """An epoch's minibatches [A, M, size]: the rows of a rollout [A, W, T], each agent's in an order of
    its own; keys: of what a loss is given.
    """
    rows = batch.select(*keys).flatten(1, 2)
    n_agents, n = rows.shape
    order = orders.draw(torch.randperm, n, device=rows["action"].device)
    first = n * torch.arange(n_agents, device=order.device)[:, None]
    return rows.flatten(0, 1)[(first + order).flatten()].reshape(n_agents, -1, size)


def learn_in_epochs(
    batch: TensorDictBase,
    learner: Learner,
    orders: Streams,
    config: RolloutConfig,
    keys: Sequence[str],
) -> dict[str, Tensor]:
    """Epochs of minibatches over a rollout [A, W, T]; each agent's mean losses, [A]."""
    epochs = [
        learner.learn(minibatches(batch, orders, config.minibatch_size, keys)) for _ in range(config.epochs)
    ]
    return {name: torch.stack([epoch[name] for epoch in epochs]).mean(0) for name in epochs[0]}
