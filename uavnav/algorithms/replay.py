"""Learning from replay: its settings, the ring of transitions, and targets of n steps.

Every agent draws rows of its own, from its own generator. TorchRL's own samplers draw from one global stream,
which would tie the agents of a population together.

Letters: A agents, one per seed; W environments an agent; T steps; M minibatches of N transitions.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer, Storage
from torchrl.data.replay_buffers import Sampler

from uavnav.errors import ConfigError
from uavnav.settings import Count, Whole, key
from uavnav.tasks.seeding import Streams
from uavnav.training.config import TrainConfig

LOG_FRAMES = 5_000
"""Frames per seed between two rows of progress."""
FRAME_BYTES = 14
"""Of a transition besides its observations: action, reward and two flags."""


class ReplayConfig(TrainConfig):
    """What learning from replay needs, whatever its loss."""

    n_envs: Count = key(64)
    buffer_size: Count = key(1_000_000, "the newest so many are kept", "frames per seed")
    learning_starts: Whole = key(
        50_000, "of uniformly random actions, without updates", "frames per seed", ge=0
    )
    batch_size: Count = key(32, "in a gradient step", "transitions")
    frames_per_update: Count = key(4, "for each gradient step", "frames per seed")

    def check(self) -> None:
        super().check()
        if self.n_envs % self.frames_per_update and self.frames_per_update % self.n_envs:
            raise ConfigError(
                f"n_envs={self.n_envs}; give a multiple or a divisor of "
                f"frames_per_update={self.frames_per_update}"
            )
        if self.buffer_size <= self.steps_in_target * self.n_envs:
            least = "n_envs" if self.steps_in_target == 1 else "n_steps x n_envs"
            raise ConfigError(
                f"buffer_size={self.buffer_size}; give more than {least}={self.steps_in_target * self.n_envs}"
            )

    def check_machine(self) -> None:
        """Raise a ConfigError where networks or buffers of all seeds would not fit into the machine's
        memory.
        """
        super().check_machine()
        capacity = min(self.buffer_size, self.frames)
        observations = 2 if self.keeps_next_observations else 1
        needed = self.n_seeds * capacity * (observations * 4 * self.observation_size + FRAME_BYTES)
        named = f"buffer_size={self.buffer_size}, n_seeds={self.n_seeds}: the buffer"
        self.check_memory(named, needed, "a smaller buffer_size or fewer seeds")
        named = f"batch_size={self.batch_size}, n_seeds={self.n_seeds}: the observations of a batch"
        needed = 4 * self.n_seeds * self.batch_size * self.observation_size
        self.check_memory(named, needed, "a smaller batch_size or fewer seeds")

    @property
    def steps_in_target(self) -> int:
        """Steps whose rewards a target sums up."""
        return 1

    @property
    def keeps_next_observations(self) -> bool:
        """Whether the buffer stores s' too.

        Without a time limit, s' is the same environment's next row, or unused after a collision. A step at
        the time limit bootstraps from an observation that no other row has.
        """
        return self.max_steps is not None

    @property
    def frames_per_iteration(self) -> int:
        return self.n_envs * self.steps_between_updates

    @property
    def frames_before_learning(self) -> int:
        return max(self.learning_starts, self.steps_in_target * self.n_envs)  # a row has its successors

    @property
    def steps_between_updates(self) -> int:
        """Steps of all environments from one round of gradient steps to the next."""
        return max(self.frames_per_update // self.n_envs, 1)

    @property
    def updates_per_step(self) -> int:
        """Gradient steps in such a round."""
        return max(self.n_envs // self.frames_per_update, 1)

    @property
    def frames_between_rows(self) -> int:
        """Frames per seed from one row of progress to the next, whole rounds of updates."""
        return max(LOG_FRAMES // self.frames_per_iteration, 1) * self.frames_per_iteration

    def logs(self, frames: int) -> bool:
        """Whether a row of progress is due after so many frames."""
        return frames % self.frames_between_rows == 0 or frames >= self.frames


class Replay:
    """A ring of transitions (s, a, R, s') of all agents, from which each draws its own.

    With n steps in a target, R is R_1 + gamma R_2 + ... + gamma^(n-1) R_n, and s' is n steps later. The sum
    ends at a collision, and at a time limit, whose own last observation is s' then: `steps_to_next_obs` says
    after how many steps.

    Args:
        seeds: one for each agent.
        capacity: the newest so many transitions of each agent are kept.
        n_envs: that an agent steps at once.
        keeps_next: store s' with each step; else it is read from the same environment's later row.
        n_steps, gamma: the n steps of a target, and their discount.
        device: where the ring is.
    """

    def __init__(
        self,
        seeds: Sequence[int],
        capacity: int,
        n_envs: int,
        keeps_next: bool,
        n_steps: int = 1,
        gamma: float = 1.0,
        device: str = "cpu",
    ) -> None:
        self.keeps_next, self.n_steps, self.gamma = keeps_next, n_steps, gamma
        last = n_steps + (not keeps_next)
        self.sampler = AgentSampler(seeds, successors=[n * n_envs for n in range(1, last)])
        self.buffer = ReplayBuffer(storage=AgentStorage(capacity, device=device), sampler=self.sampler)

    def extend(self, batch: TensorDictBase) -> None:
        """Write steps [A, W, T], as rows [T W, A] in the order of time: agents stay apart."""
        following = ["reward", "done", "terminated", *(["observation"] if self.keeps_next else [])]
        rows = batch.select("observation", "action", *(("next", name) for name in following))
        self.buffer.extend(rows.transpose(1, 2).flatten(1, 2).transpose(0, 1))

    def draw(self, n_batches: int, batch_size: int) -> TensorDictBase:
        """Uniformly drawn transitions [A, M, N]: M minibatches of N."""
        batch = self.buffer.sample(n_batches * batch_size)
        if self.sampler.successors:
            batch, *later = batch.unbind(0)
            if self.n_steps > 1:
                self._sum_rewards(batch, later[: self.n_steps - 1])
            if not self.keeps_next:
                batch["next", "observation"] = later[-1]["observation"]
        return batch.reshape(len(batch), n_batches, batch_size)

    def _sum_rewards(self, batch: TensorDictBase, later: Sequence[TensorDictBase]) -> None:
        following = batch["next"]
        steps = torch.ones_like(following["done"], dtype=torch.int64)
        for n, step in enumerate(later, 1):
            over, then = following["done"], step["next"]
            following["reward"] = following["reward"] + torch.where(over, 0, self.gamma**n * then["reward"])
            if self.keeps_next:
                following["observation"] = torch.where(over, following["observation"], then["observation"])
            for flag in ("terminated", "done"):
                following[flag] = following[flag] | (then[flag] & ~over)
            steps = steps + ~over
        if self.keeps_next:
            batch["steps_to_next_obs"] = steps


class AgentStorage(LazyTensorStorage):  # type: ignore[misc]
    """TorchRL's storage of rows [A, ...], read as an `AgentSampler` draws them: by (row, agent).

    A large buffer's rows are all over the memory. `index_select` waits for them a third as long as an index
    of two tensors does, and copies the same numbers.
    """

    def get(self, index: slice | Tensor | tuple[Tensor, Tensor]) -> TensorDictBase:
        if not isinstance(index, tuple):
            return super().get(index)
        rows, agents = index
        whole = super().get(slice(None))
        drawn = (rows * whole.shape[1] + agents).flatten()
        return whole.apply(
            lambda column: column.flatten(0, 1).index_select(0, drawn).unflatten(0, rows.shape),
            batch_size=rows.shape,
        )


class AgentSampler(Sampler):  # type: ignore[misc]
    """Indices (row, agent) into a storage of rows [A, ...]: every agent draws its own rows uniformly, a batch
    [A, N].

    Args:
        seeds: one for each agent.
        successors: every row is drawn with others so many rows later, in batches [1 + S, A, N]. The newest
            rows are not drawn until all their successors are there.
    """

    def __init__(self, seeds: Sequence[int], successors: Sequence[int] = ()) -> None:
        self.streams = Streams(seeds, "replay")
        self.successors = successors
        self._newest = -1

    def sample(self, storage: Storage, batch_size: int) -> tuple[tuple[Tensor, Tensor], dict[str, Any]]:
        size = len(storage)
        there = size - max(self.successors, default=0)
        rows = self.streams.draw(torch.randint, there, (batch_size,), device=storage.device)
        if self.successors:
            rows = rows + self._newest + 1  # counted from the oldest
            rows = torch.stack([(rows + later) % size for later in (0, *self.successors)])
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
