"""Deep Q-Network, sec. 3.2, from top to bottom: config, network, loss, buffer, learning.

    L(theta) = E[(R + gamma max_a' Q(s', a'; theta-) - Q(s, a; theta))^2]        eq. (1)

over transitions (s, a, R, s') drawn uniformly from the buffer, with SB3's Huber loss in place of the square by default.
theta- is a copy of theta, renewed every so many frames; where an episode terminated at s' the target is R alone.

Letters: A agents, one a seed, that learn side by side and independently of each other; W worlds an agent.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.data import ReplayBuffer
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss, HardUpdate, LossModule

from uavnav.algorithms import ALGORITHMS
from uavnav.algorithms.acting import Actor, Values, values_of
from uavnav.algorithms.networks import mlp
from uavnav.algorithms.replay import AgentSampler, AgentStorage
from uavnav.errors import ConfigError
from uavnav.settings import key
from uavnav.tasks.seeding import stream
from uavnav.training import probes
from uavnav.training.checkpoints import Stateful
from uavnav.training.config import TrainConfig, at_least, within
from uavnav.training.learner import Learner
from uavnav.training.loop import Row, train
from uavnav.training.optimisers import Adam

__all__ = ["DQN", "PRESETS", "DQNConfig", "train"]

LOG_FRAMES = 5_000
"""Frames per seed between two rows of progress."""
FRAME_BYTES = 14
"""Of a transition beside its observations: action, reward and two flags."""


@dataclass(frozen=True, kw_only=True)
class ReplayConfig(TrainConfig):
    """What Q-learning from replay needs, whatever its loss."""

    COPIES: ClassVar[int] = 4  # a target too

    n_worlds: int = at_least(64, 1)
    lr: float = at_least(1e-4, 0, "Adam's learning rate")
    max_grad_norm: float | None = at_least(10.0, 0)
    buffer_size: int = at_least(1_000_000, 1, "the newest so many are kept", "frames a seed")
    learning_starts: int = at_least(50_000, 0, "of uniformly random actions, without updates", "frames a seed")
    batch_size: int = at_least(32, 1, "in a gradient step", "transitions")
    frames_per_update: int = at_least(4, 1, "for each gradient step", "frames a seed")
    target_update_frames: int = at_least(
        10_000, 1, "between two copies of the network into the target", "frames a seed"
    )
    epsilon_start: float = within(1.0, 0, 1, "of random actions at frame 0", "share")
    epsilon_end: float = within(0.05, 0, 1, "of random actions at the end of the fall", "share")
    exploration_fraction: float = within(0.1, 0, 1, "of total_frames, over which ε falls", "share")
    adam_eps: float = at_least(1e-8, 0, "Adam's ε")
    n_steps: int = at_least(1, 1, "whose rewards are in a target before Q takes over", "steps")
    double: bool = key(False, "double Q-learning: the best action is the network's, its value the target's")
    dueling: bool = key(False, "the network gives a state's value and each action's advantage, and Q is their sum")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.n_worlds % self.frames_per_update and self.frames_per_update % self.n_worlds:
            raise ConfigError(
                f"n_worlds={self.n_worlds}; give a multiple or a divisor of frames_per_update={self.frames_per_update}"
            )
        if self.buffer_size <= self.n_steps * self.n_worlds:
            least = "n_worlds" if self.n_steps == 1 else "n_steps x n_worlds"
            raise ConfigError(f"buffer_size={self.buffer_size}; give more than {least}={self.n_steps * self.n_worlds}")

    def make(self, compile: bool) -> DQN:
        return DQN(self, compile)

    def make_loss(self, network: nn.Module) -> LossModule:
        """A loss a row, of a network and a target network that `HardUpdate` writes."""
        raise NotImplementedError(f"{type(self).__name__} has no loss")

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
    def final_epsilon(self) -> float:
        return self.epsilon_end

    @property
    def keeps_next_observations(self) -> bool:
        """Whether the buffer stores s' too.

        Without a cap, s' is the same world's next row, or unused after a collision. A step at the cap bootstraps from
        an observation that no other row has.
        """
        return self.max_steps is not None

    @property
    def successors(self) -> list[int]:
        """How many steps later those lie that a target needs beside its first: s' too, if no row has its own."""
        return list(range(1, self.n_steps + (not self.keeps_next_observations)))

    @property
    def steps_vary(self) -> bool:
        """Whether a target may bootstrap after fewer than n steps: at a cap."""
        return self.n_steps > 1 and self.keeps_next_observations

    @property
    def discount(self) -> float:
        """Discount of Q in a target: gamma if the number of its steps varies, else gamma^n_steps."""
        return self.gamma if self.steps_vary else self.gamma**self.n_steps

    @property
    def head(self) -> str:
        """How the network's outputs are read: a line of `sampling.HEADS` with its numbers."""
        return "dueling" if self.dueling else "direct"

    @property
    def n_outputs(self) -> int:
        """The same, and with `dueling` the state's value in front."""
        return super().n_outputs + self.dueling

    @property
    def frames_per_iteration(self) -> int:
        return self.n_worlds * self.steps_between_updates

    @property
    def frames_before_learning(self) -> int:
        return max(self.learning_starts, self.n_steps * self.n_worlds)  # a row has its successors

    @property
    def steps_between_updates(self) -> int:
        """Steps of all worlds from one round of gradient steps to the next."""
        return max(self.frames_per_update // self.n_worlds, 1)

    @property
    def updates_per_step(self) -> int:
        """Gradient steps in such a round."""
        return max(self.n_worlds // self.frames_per_update, 1)

    @property
    def frames_between_targets(self) -> int:
        """Frames per seed from one copy of theta to the next, whole steps of all worlds."""
        return max(self.target_update_frames // self.n_worlds, 1) * self.n_worlds

    @property
    def frames_between_rows(self) -> int:
        """Frames per seed from one row of progress to the next, whole rounds of updates."""
        return max(LOG_FRAMES // self.frames_per_iteration, 1) * self.frames_per_iteration

    def epsilon(self, frames: int) -> float:
        """The share of random actions after so many frames: all, until learning starts, then a linear fall."""
        if frames < self.learning_starts:
            return 1.0
        decay = self.exploration_fraction * self.total_frames
        progress = min(frames / decay, 1.0) if decay else 1.0
        return self.epsilon_start + progress * (self.epsilon_end - self.epsilon_start)


@dataclass(frozen=True, kw_only=True)
class DQNConfig(ReplayConfig):
    """Deep Q-Network, sec. 3.2; the defaults are Stable-Baselines3's of the paper's time."""

    algorithm: ClassVar[str] = "dqn"
    PRESETS: ClassVar[dict[str, dict[str, Any]]] = {
        "paper": {},
        "one-world": {"n_worlds": 1},  # as SB3 runs by default
        "paper-2.3": {"learning_starts": 100},  # SB3's default since its version 2.3
        "fast": {  # targets of five steps and double Q-learning; what it reaches: docs/performance.md
            "total_frames": 400_000,
            "n_worlds": 128,
            "learning_starts": 10_000,
            "batch_size": 128,
            "frames_per_update": 8,
            "lr": 2.5e-4,
            "gamma": 0.98,
            "max_grad_norm": 1.0,
            "target_update_frames": 1_000,
            "epsilon_end": 0.01,
            "exploration_fraction": 0.2,
            "n_steps": 5,
            "double": True,
        },
    }
    MICROSECONDS: ClassVar[dict[tuple[str, bool], tuple[float, float]]] = {
        ("paper", True): (30.0, 26.2),
        ("paper", False): (373.5, 26.2),
    }

    loss: Literal["huber", "squared"] = key("huber", "Stable-Baselines3's, or squared as in eq. (1)")

    def make_loss(self, network: nn.Module) -> DQNLoss:
        return make_loss(network, self)


PRESETS = {name: DQNConfig(preset=name) for name in DQNConfig.PRESETS}


def make_network(config: ReplayConfig) -> nn.Sequential:
    """The Q network: observation [A, ..., 30] -> [A, ..., outputs], which `config.head` reads as 100 values."""
    sizes = [config.observation_size, *config.hidden, config.n_outputs]
    generators = [stream(seed, "value network") for seed in config.seeds]
    return mlp(sizes, config.activation, generators, config.init, layer_norm=config.layer_norm)


def make_loss(network: nn.Module, config: DQNConfig) -> DQNLoss:
    """Equation (1) as TorchRL's DQNLoss with a target network, one loss a row."""
    values = Values(network, config.head) if config.dueling else network
    loss = DQNLoss(
        QValueActor(values, in_keys=["observation"], spec=None, action_space="categorical"),
        loss_function="smooth_l1" if config.loss == "huber" else "l2",
        delay_value=True,
        double_dqn=config.double,
        action_space="categorical",
        reduction="none",
    )
    loss.make_value_estimator(gamma=config.discount)
    return loss


def make_learner(loss: LossModule, config: ReplayConfig, compile: bool) -> Learner:
    """Adam as SB3 sets it."""
    adam = Adam(config.lr, config.adam_eps)
    return Learner(loss, ["loss"], adam, max_grad_norm=config.max_grad_norm, compile=compile)


def make_buffer(sampler: AgentSampler, config: ReplayConfig) -> ReplayBuffer:
    """A ring of transitions with a draw of its own for each agent: all minibatches of a round at once."""
    return ReplayBuffer(
        storage=AgentStorage(min(config.buffer_size, config.frames), device=config.device),
        sampler=sampler,
        batch_size=config.batch_size * config.updates_per_step,
    )


def rows(batch: TensorDictBase, config: ReplayConfig) -> TensorDictBase:
    """What the buffer keeps of steps [A, W, T], as rows [T W, A] in the order of time: its agents stay apart."""
    names = ["reward", "done", "terminated", *(["observation"] if config.keeps_next_observations else [])]
    following = [("next", name) for name in names]
    return batch.select("observation", "action", *following).transpose(1, 2).flatten(1, 2).transpose(0, 1)


def make_sampler(config: ReplayConfig) -> AgentSampler:
    """Draws transitions uniformly, each with those that follow it as far as its target needs them."""
    successors = [n * config.n_worlds for n in config.successors]
    return AgentSampler(config.seeds, "replay", replace=True, successors=successors)


def draw(buffer: ReplayBuffer, config: ReplayConfig) -> TensorDictBase:
    """A round's transitions (s, a, R, s') [A, M, N]: M batches of N for each agent.

    With n steps R is R_1 + gamma R_2 + ... + gamma^(n-1) R_n, and s' is n steps later. The sum ends at a collision, and
    at a cap, whose own last observation is s' then: `steps_to_next_obs` says after how many steps.
    """
    batch = buffer.sample()
    if config.successors:
        batch, *later = batch.unbind(0)
        following = batch["next"]
        steps = torch.ones_like(following["done"], dtype=torch.int64)
        for n, step in enumerate(later[: config.n_steps - 1], 1):
            over, then = following["done"], step["next"]
            following["reward"] = following["reward"] + torch.where(over, 0, config.gamma**n * then["reward"])
            if config.keeps_next_observations:
                following["observation"] = torch.where(over, following["observation"], then["observation"])
            for flag in ("terminated", "done"):
                following[flag] = following[flag] | (then[flag] & ~over)
            steps = steps + ~over
        if config.steps_vary:
            batch["steps_to_next_obs"] = steps
        if not config.keeps_next_observations:
            following["observation"] = later[-1]["observation"]
    return batch.reshape(config.n_seeds, -1, config.batch_size)


class DQN:
    """All seeds' agents, whatever their loss, as the training loop needs them."""

    def __init__(self, config: ReplayConfig, compile: bool) -> None:
        self.config = config
        self.network = make_network(config).to(config.device)
        acts = ALGORITHMS[config.algorithm].acts
        self.actor = Actor(self.network, config.seeds, acts, config.head, compile, epsilon=config.epsilon)
        self.loss = config.make_loss(self.network)
        self.copy_to_target = HardUpdate(self.loss, value_network_update_interval=0)
        self.learner = make_learner(self.loss, config, compile)
        sampler = make_sampler(config)
        self.replay = make_buffer(sampler, config)
        self.probe = probes.poses(config.make_task()).to(config.device)
        self.parts: Mapping[str, Stateful] = {"replay": sampler, "learner": self.learner}

    def learn(self, batch: TensorDictBase, frames: int) -> Row | None:
        """Steps [A, W, T] into the buffer, then a round of updates; now and then a row, [A]."""
        config, losses = self.config, {}
        before = frames - config.frames_per_iteration
        self.replay.extend(rows(batch, config))
        if frames // config.frames_between_targets > before // config.frames_between_targets:
            self.copy_to_target.step()
        if frames > config.frames_before_learning:
            losses = self.learner.learn(draw(self.replay, config))
        if frames % config.frames_between_rows and frames < config.frames:
            return None
        with torch.no_grad():
            values = values_of(config.head, self.network(batch["observation"][:, :, -1]))
        q_value = values.amax(-1).mean(1)
        epsilon = torch.tensor(config.epsilon(frames)).item()
        return {**losses, "q_value": q_value, "epsilon": epsilon, **probes.units(self.network, self.probe)}

    def networks(self) -> Mapping[str, nn.Module]:
        return {"policy": self.network}
