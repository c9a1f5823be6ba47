"""Learning from replay: its settings, the ring of transitions, and targets of n steps.

Every agent draws rows of its own, from its own generator. TorchRL's own samplers draw from one global stream, which
would tie the agents of a population together.

Letters: A agents, one a seed; W environments an agent; T steps; M minibatches of N transitions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer, Storage
from torchrl.data.replay_buffers import Sampler

from uavnav.errors import ConfigError
from uavnav.tasks.seeding import Streams
from uavnav.training.config import TrainConfig, at_least

LOG_FRAMES = 5_000
"""Frames per seed between two rows of progress."""
FRAME_BYTES = 14
"""Of a transition beside its observations: action, reward and two flags."""


@dataclass(frozen=True, kw_only=True)
class ReplayConfig(TrainConfig):
    """What learning from replay needs, whatever its loss."""

    n_envs: int = at_least(64, 1)
    buffer_size: int = at_least(1_000_000, 1, "the newest so many are kept", "frames a seed")
    learning_starts: int = at_least(50_000, 0, "of uniformly random actions, without updates", "frames a seed")
    batch_size: int = at_least(32, 1, "in a gradient step", "transitions")
    frames_per_update: int = at_least(4, 1, "for each gradient step", "frames a seed")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.n_envs % self.frames_per_update and self.frames_per_update % self.n_envs:
            raise ConfigError(
                f"n_envs={self.n_envs}; give a multiple or a divisor of frames_per_update={self.frames_per_update}"
            )
        if self.buffer_size <= self.steps_in_target * self.n_envs:
            least = "n_envs" if self.steps_in_target == 1 else "n_steps x n_envs"
            raise ConfigError(
                f"buffer_size={self.buffer_size}; give more than {least}={self.steps_in_target * self.n_envs}"
            )

    def check_machine(self) -> None:
        """Raise a ConfigError where networks or buffers of all seeds would not fit into the machine's memory."""
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

        Without a cap, s' is the same world's next row, or unused after a collision. A step at the cap bootstraps from
        an observation that no other row has.
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
        """Steps of all worlds from one round of gradient steps to the next."""
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

    With n steps in a target, R is R_1 + gamma R_2 + ... + gamma^(n-1) R_n, and s' is n steps later. The sum ends at a
    collision, and at a cap, whose own last observation is s' then: `steps_to_next_obs` says after how many steps.
    """

    def __init__(self, config: ReplayConfig) -> None:
        self.config, self.n_steps = config, config.steps_in_target
        self.sampler = make_sampler(config)
        self.buffer = make_buffer(self.sampler, config)

    def extend(self, batch: TensorDictBase) -> None:
        """Write steps [A, W, T]."""
        self.buffer.extend(rows(batch, self.config))

    def draw(self) -> TensorDictBase:
        """A round's transitions [A, M, N]."""
        config, batch = self.config, self.buffer.sample()
        if self.sampler.successors:
            batch, *later = batch.unbind(0)
            if self.n_steps > 1:
                self._sum_rewards(batch, later[: self.n_steps - 1])
            if not config.keeps_next_observations:
                batch["next", "observation"] = later[-1]["observation"]
        return batch.reshape(config.n_seeds, -1, config.batch_size)

    def _sum_rewards(self, batch: TensorDictBase, later: Sequence[TensorDictBase]) -> None:
        config, following = self.config, batch["next"]
        steps = torch.ones_like(following["done"], dtype=torch.int64)
        for n, step in enumerate(later, 1):
            over, then = following["done"], step["next"]
            following["reward"] = following["reward"] + torch.where(over, 0, config.gamma**n * then["reward"])
            if config.keeps_next_observations:
                following["observation"] = torch.where(over, following["observation"], then["observation"])
            for flag in ("terminated", "done"):
                following[flag] = following[flag] | (then[flag] & ~over)
            steps = steps + ~over
        if config.keeps_next_observations:
            batch["steps_to_next_obs"] = steps


def make_buffer(sampler: AgentSampler, config: ReplayConfig) -> ReplayBuffer:
    """The ring, with a draw of its own for each agent: all minibatches of a round at once."""
    return ReplayBuffer(
        storage=AgentStorage(min(config.buffer_size, config.frames), device=config.device),
        sampler=sampler,
        batch_size=config.batch_size * config.updates_per_step,
    )


def make_sampler(config: ReplayConfig) -> AgentSampler:
    """Draws transitions uniformly, each with those that follow it as far as its target needs them.

    These are the next n - 1, and the n-th too where no row has its own s'.
    """
    last = config.steps_in_target + (not config.keeps_next_observations)
    successors = [n * config.n_envs for n in range(1, last)]
    return AgentSampler(config.seeds, "replay", replace=True, successors=successors)


def rows(batch: TensorDictBase, config: ReplayConfig) -> TensorDictBase:
    """What the ring keeps of steps [A, W, T], as rows [T W, A] in the order of time: its agents stay apart."""
    names = ["reward", "done", "terminated", *(["observation"] if config.keeps_next_observations else [])]
    following = [("next", name) for name in names]
    return batch.select("observation", "action", *following).transpose(1, 2).flatten(1, 2).transpose(0, 1)


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
