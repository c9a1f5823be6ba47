"""How a replay buffer of a population is read: every agent draws rows of its own, from its own generator.

TorchRL's own samplers draw from one global stream, which would tie the agents of a population together.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, Storage
from torchrl.data.replay_buffers import Sampler

from uavnav.tasks.seeding import Streams


class AgentStorage(LazyTensorStorage):  # type: ignore[misc]
    """TorchRL's storage of rows [A, ...], read as an `AgentSampler` draws them: by (row, agent).

    A large buffer's rows lie all over the memory. `index_select` waits for them a third as long as an index of two
    tensors does, and copies the same numbers.
    """

    def get(self, index: slice | Tensor | tuple[Tensor, Tensor]) -> TensorDictBase:
        if not isinstance(index, tuple):
            return super().get(index)
        rows, agents = index
        whole = super().get(slice(None))
        drawn = (rows * whole.shape[1] + agents).flatten()
        return whole.apply(
            lambda column: column.flatten(0, 1).index_select(0, drawn).unflatten(0, rows.shape), batch_size=rows.shape
        )


class AgentSampler(Sampler):  # type: ignore[misc]
    """Indices (row, agent) into a storage of rows [A, ...]: every agent draws its own rows, and gets a batch [A, N].

    Args:
        seeds: one for each agent.
        purpose: names its streams.
        replace: uniform draws as for replay, or a permutation of all rows as for an epoch of minibatches.
        successors: with `replace`, every row is drawn with others so many rows later, in batches [1 + S, A, N]. The
            newest rows are not drawn until all their successors are there.
    """

    def __init__(self, seeds: Sequence[int], purpose: str, replace: bool, successors: Sequence[int] = ()) -> None:
        self.streams = Streams(seeds, purpose)
        self.replace = replace
        self.successors = successors
        self._newest = -1

    def sample(self, storage: Storage, batch_size: int) -> tuple[tuple[Tensor, Tensor], dict[str, Any]]:
        size = len(storage)
        if self.replace:
            rows = self.streams.draw(
                torch.randint, size - max(self.successors, default=0), (batch_size,), device=storage.device
            )
            if self.successors:
                rows = rows + self._newest + 1  # counted from the oldest
                rows = torch.stack([(rows + later) % size for later in (0, *self.successors)])
        else:
            rows = self.streams.draw(torch.randperm, size, device=storage.device)[:, :batch_size]
        agents = torch.arange(rows.shape[-2], device=rows.device)[:, None]
        return (rows, agents), {}

    def extend(self, index: Tensor) -> None:
        """Rows were written there, in the order of time."""
        self._newest = int(index[-1])

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
