"""Learning from replay: its settings, the ring of transitions, and targets of n steps.

Every agent draws rows of its own, from its own generator. TorchRL's own samplers draw from one global stream,
which would tie the agents of a population together.

Letters: A agents, one per seed; W environments an agent; T steps; M minibatches of N transitions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, RandomSampler, ReplayBuffer, RoundRobinWriter, Storage

from uavnav.errors import ConfigError
from uavnav.settings import Count, Whole, key
from uavnav.tasks.seeding import Streams
from uavnav.training.config import TrainConfig

LOG_FRAMES = 5_000  # frames per seed between two rows of progress
OTHERS = 4  # numbers of a transition besides its observations: action, reward and two flags


class ReplayConfig(TrainConfig):
    """What learning from replay needs, whatever its loss."""

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
        super().check_machine()
        filled = min(self.buffer_size, self.frames)
        observations = 2 if self.keeps_next_observations else 1
        needed = 4 * self.n_seeds * filled * (observations * self.observation_size + OTHERS)
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
    def capacity(self) -> int:
        """Rows of the ring: for a run that is shorter than `buffer_size` a power of two, so that runs of many
        lengths share a compiled graph.
        """
        return min(self.buffer_size, 1 << (self.frames - 1).bit_length())

    @property
    def frames_per_iteration(self) -> int:
        """From one round of gradient steps to the next, whole steps of all environments."""
        return self.n_envs * max(self.frames_per_update // self.n_envs, 1)

    @property
    def frames_before_learning(self) -> int:
        return max(self.learning_starts, self.steps_in_target * self.n_envs)  # a row has its successors

    @property
    def updates_per_step(self) -> int:
        """Gradient steps in such a round."""
        return max(self.n_envs // self.frames_per_update, 1)

    @property
    def updates(self) -> int:
        rounds = self.iterations - self.frames_before_learning // self.frames_per_iteration
        return max(rounds, 0) * self.updates_per_step

    @property
    def frames_between_rows(self) -> int:
        """Frames per seed from one row of progress to the next, whole rounds of updates."""
        return max(LOG_FRAMES // self.frames_per_iteration, 1) * self.frames_per_iteration


class Replay:
    """A ring of transitions (s, a, R, s') of all agents, from which each draws its own.

    With n steps in a target, R is R_1 + gamma R_2 + ... + gamma^(n-1) R_n, and s' is n steps later. The sum
    ends at a collision, and at a time limit, whose own last observation is s' then: `steps_to_next_obs` says
    after how many steps.

    A step is one row of F numbers: s, a, R, whether the episode is done and terminated, and s' where it is
    kept. What is together in memory is written and read in one go.

    Args:
        seeds: one for each agent.
        capacity: the newest so many transitions of each agent are kept.
        n_envs: that an agent steps at once.
        observation_size: numbers in s.
        keeps_next: store s' with each step; else it is read from the same environment's later row.
        n_steps, gamma: the n steps of a target, and their discount.
        device: where the ring is.
    """

    def __init__(
        self,
        seeds: Sequence[int],
        capacity: int,
        n_envs: int,
        observation_size: int,
        keeps_next: bool,
        n_steps: int = 1,
        gamma: float = 1.0,
        device: str = "cpu",
    ) -> None:
        self.keeps_next, self.n_steps, self.gamma, self.size = keeps_next, n_steps, gamma, observation_size
        last = n_steps + (not keeps_next)
        self.sampler = AgentSampler(seeds, successors=[n * n_envs for n in range(1, last)])
        self.writer = AgentWriter()
        row = torch.empty(len(seeds), (1 + keeps_next) * observation_size + OTHERS)
        self.storage = AgentStorage(capacity, row, device)
        self.buffer = ReplayBuffer(storage=self.storage, sampler=self.sampler, writer=self.writer)

    def rows(self, batch: TensorDictBase) -> Tensor:
        """Steps [A, W, T] as rows [T W, A, F] in the order of time."""
        following = batch["next"]
        numbers = [batch["observation"], batch["action"][..., None]]
        numbers += [following[name] for name in ("reward", "done", "terminated")]
        numbers += [following["observation"]] if self.keeps_next else []
        return torch.cat(numbers, -1).permute(2, 1, 0, 3).flatten(0, 1)

    def extend(self, batch: TensorDictBase) -> None:
        """Write steps [A, W, T]: agents stay apart."""
        self.sampler.extend(self.writer.extend(self.rows(batch)))

    def draw(self, n_batches: int, batch_size: int) -> TensorDictBase:
        """Uniformly drawn places in the ring, each with those of its S successors: `places` [A, M, N, 1 + S]
        of M minibatches of N, which `read` looks up.
        """
        (rows, agents), _ = self.sampler.sample(self.storage, n_batches * batch_size)
        places = (rows * len(agents) + agents).movedim(0, 2)
        places = places.reshape(len(agents), n_batches, batch_size, -1)
        return TensorDict._new_unsafe({"places": places}, places.shape[:2])

    def draw_ahead(
        self, n_rounds: int, n_rows: int, n_batches: int, batch_size: int
    ) -> tuple[Tensor, Tensor]:
        """Draw for K rounds ahead, each of which begins with writing so many rows: `places` as of `draw`,
        [K, A, M, N, 1 + S]; and `fresh`, where each is among the rows of these rounds, or -1.

        `write` the rows afterwards.
        """
        storage, sampler, n = self.storage, self.sampler, n_batches * batch_size
        first, written = self.writer.cursor, n_rows * torch.arange(1, n_rounds + 1)  # before a round draws
        sizes = (len(storage) + written).clamp(max=storage.max_size)
        drawn = torch.stack([sampler.draw(size, n) for size in sizes.tolist()])[:, None]
        written, size = written[:, None, None, None], sizes[:, None, None, None]
        rows, agents = sampler.rows(drawn, first + written - 1, size), sampler.agents
        sampler.extend(self.writer.advance(n_rounds * n_rows))
        age, shape = (rows - first) % storage.max_size, (n_rounds, len(agents), n_batches, batch_size, -1)
        places = rows * len(agents) + agents
        fresh = torch.where(age < written, age * len(agents) + agents, -1)
        places, fresh = (one.movedim(1, 3).reshape(shape) for one in (places, fresh))
        alike = torch.contiguous_format  # other strides would be another graph
        return places.clone(memory_format=alike), fresh.clone(memory_format=alike)

    def write(self, rows: Tensor) -> None:
        """Fill the newest places with rows [n, A, F] that came after `draw_ahead`."""
        first = self.writer.cursor - len(rows)
        self.storage.put(torch.arange(first, first + len(rows)) % self.storage.max_size, rows)

    def read(self, batch: TensorDictBase, ring: Tensor, new: Tensor | None = None) -> TensorDict:
        """The transitions [..., N] at places that were drawn, for a loss; compiled with it.

        new: rows of the rounds of `draw_ahead` [n, A, F], which the ring lacks.
        """
        places = batch["places"]
        rows = ring.flatten(0, 1).index_select(0, places.flatten())
        if new is not None:
            fresh = batch["fresh"].flatten()
            newest = new.flatten(0, 1).index_select(0, fresh.clamp(min=0))
            rows = torch.where((fresh >= 0)[:, None], newest, rows)
        rows = rows.reshape(*places.shape, -1)
        sizes = [self.size, 1, 1, 1, 1, self.size * self.keeps_next]
        observation, action, *flags, after = torch.split(rows, sizes, -1)
        reward, done, terminated = flags[0], flags[1] > 0, flags[2] > 0
        following = {
            "reward": reward[..., 0, :],
            "done": done[..., 0, :],
            "terminated": terminated[..., 0, :],
        }
        following["observation"] = after[..., 0, :] if self.keeps_next else observation[..., -1, :]
        steps = torch.ones_like(following["done"], dtype=torch.int64)
        for n in range(1, self.n_steps):
            over, then = following["done"], reward[..., n, :]
            following["reward"] = following["reward"] + torch.where(over, 0, self.gamma**n * then)
            if self.keeps_next:
                following["observation"] = torch.where(over, following["observation"], after[..., n, :])
            for flag, later in (("terminated", terminated), ("done", done)):
                following[flag] = following[flag] | (later[..., n, :] & ~over)
            steps = steps + ~over
        found = {"observation": observation[..., 0, :], "action": action[..., 0, 0].long(), "next": following}
        if self.keeps_next and self.n_steps > 1:
            found["steps_to_next_obs"] = steps
        return TensorDict(found, places.shape[:-1])


def make_replay(config: ReplayConfig) -> Replay:
    """The ring of a run. On a CPU, rows that are never written take no memory."""
    return Replay(
        config.seeds,
        config.capacity,
        config.n_envs,
        config.observation_size,
        config.keeps_next_observations,
        config.steps_in_target,
        config.gamma,
        config.device,
    )


class AgentStorage(LazyTensorStorage):  # type: ignore[misc]
    """TorchRL's storage of rows [A, F], whose memory is there from the beginning: a graph reads it."""

    def __init__(self, capacity: int, row: Tensor, device: str) -> None:
        super().__init__(capacity, device=device)
        self._init(row)

    @property
    def ring(self) -> Tensor:
        """All rows [capacity, A, F], also those that nothing was written into yet."""
        ring: Tensor = self._storage
        return ring

    def put(self, index: Tensor, rows: Tensor) -> None:
        """As `set`, without what it does for other kinds of data; `grow` counts them."""
        self._storage[index] = rows

    def grow(self, n: int) -> None:
        """There are so many rows more."""
        self._len: int = min(len(self) + n, self.max_size)


class AgentWriter(RoundRobinWriter):  # type: ignore[misc]
    """TorchRL's writer of rows in turn, without what it does for buffers that processes share."""

    def __init__(self) -> None:
        super().__init__(compilable=True)

    @property
    def cursor(self) -> int:
        """Where the next row is written."""
        return self._cursor

    def advance(self, n: int) -> Tensor:
        """Count so many rows as written; where they are, of more than there is room for the last."""
        capacity = self._storage.max_size
        index: Tensor = torch.arange(self._cursor, self._cursor + n, device=self._storage.device) % capacity
        self._storage.grow(n)
        self._cursor: int = (self._cursor + n) % capacity
        self._write_count: int = self._write_count + n
        return index[-capacity:]  # no place twice: several threads write

    def extend(self, data: Tensor) -> Tensor:
        """Write rows behind the newest ones; where they are now."""
        index = self.advance(len(data))
        self._storage.put(index, data[-len(index) :])
        return index


class AgentSampler(RandomSampler):  # type: ignore[misc]
    """Indices (row, agent) into a storage of rows [A, ...]: every agent draws its own rows uniformly, each
    with its successors, [1 + S, A, N].

    Args:
        seeds: one for each agent.
        successors: how many rows later they are. The newest rows are not drawn until all of theirs are there.
    """

    def __init__(self, seeds: Sequence[int], successors: Sequence[int] = ()) -> None:
        self.streams = Streams(seeds, "replay")
        self.successors = successors
        self._later = torch.tensor([0, *successors])[:, None, None]
        self.agents = torch.arange(len(seeds))[:, None]
        self._newest = -1

    def sample(self, storage: Storage, batch_size: int) -> tuple[tuple[Tensor, Tensor], dict[str, Any]]:
        rows = self.rows(self.draw(len(storage), batch_size), self._newest, len(storage))
        return (rows.to(storage.device), self.agents.to(storage.device)), {}

    def draw(self, size: int, n: int) -> Tensor:
        """Each agent's next n draws of a storage with so many rows [A, N], counted from the oldest one."""
        there = size - max(self.successors, default=0)
        return self.streams.draw(torch.randint, there, (n,), device="cpu")

    def rows(self, drawn: Tensor, newest: Tensor | int, size: Tensor | int) -> Tensor:
        """Where these rows [..., A, N] and their successors are, [..., 1 + S, A, N]."""
        return ((drawn + newest + 1 if self.successors else drawn) + self._later) % size

    def extend(self, index: Tensor) -> None:
        """Rows were written there, in the order of time."""
        self._newest = int(index[-1])

    def state_dict(self) -> dict[str, Any]:
        return self.streams.state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.streams.load_state_dict(state_dict)
