"""Deep Q-Network, sec. 3.2, from top to bottom: config, network, loss, buffer, learning.

    L(theta) = E[(R + gamma max_a' Q(s', a'; theta-) - Q(s, a; theta))^2]        eq. (1)

over transitions (s, a, R, s') drawn uniformly from the buffer, with SB3's Huber loss in place of the square by default.
theta- is a copy of theta, renewed every so many frames; where an episode terminated at s' the target is R alone.

Letters: A agents, one a seed, that learn side by side and independently of each other; W worlds an agent.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss, HardUpdate

from uavnav.algorithms import ALGORITHMS
from uavnav.choices import ConfigError
from uavnav.help import key
from uavnav.networks import mlp
from uavnav.tasks.seeding import stream
from uavnav.training import probes
from uavnav.training.checkpoints import Stateful
from uavnav.training.config import TrainConfig, at_least, within
from uavnav.training.learner import Learner
from uavnav.training.loop import Row, train
from uavnav.training.optimisers import Adam
from uavnav.training.sampler import AgentSampler
from uavnav.training.sampling import Actor

__all__ = ["DQN", "PRESETS", "DQNConfig", "train"]

HOW = ALGORITHMS["dqn"]
LOG_FRAMES = 5_000
"""Frames per seed between two rows of progress."""
FRAME_BYTES = 14
"""Of a transition beside its observations: action, reward and two flags."""


@dataclass(frozen=True, kw_only=True)
class DQNConfig(TrainConfig):
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

    n_worlds: int = at_least(64, 1)
    lr: float = at_least(1e-4, 0, "Adam's learning rate")
    max_grad_norm: float = at_least(10.0, 0)
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
    loss: Literal["huber", "squared"] = key("huber", "Stable-Baselines3's, or squared as in eq. (1)")
    n_steps: int = at_least(1, 1, "whose rewards are in a target before Q takes over", "steps")
    double: bool = key(False, "double Q-learning: the best action is the network's, its value the target's")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.n_worlds % self.frames_per_update and self.frames_per_update % self.n_worlds:
            raise ConfigError(
                f"n_worlds={self.n_worlds}; give a multiple or a divisor of frames_per_update={self.frames_per_update}"
            )
        if self.buffer_size <= self.n_steps * self.n_worlds:
            least = "n_worlds" if self.n_steps == 1 else "n_steps x n_worlds"
            raise ConfigError(f"buffer_size={self.buffer_size}; give more than {least}={self.n_steps * self.n_worlds}")
        if self.n_steps > 1 and self.max_steps is not None:
            raise ConfigError(f"n_steps={self.n_steps}, max_steps={self.max_steps}; give n_steps=1, or no cap on steps")

    def make(self, compile: bool) -> DQN:
        return DQN(self, compile)

    def check_machine(self) -> None:
        """Raise a ConfigError where the buffers of all seeds would not fit into the machine's memory."""
        capacity = min(self.buffer_size, self.frames)
        observations = 2 if self.keeps_next_observations else 1
        needed = self.n_seeds * capacity * (observations * 4 * self.observation_size + FRAME_BYTES) / 2**30
        available = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
        if self.device == "cpu" and needed > available:
            raise ConfigError(
                f"buffer_size={self.buffer_size}, n_seeds={self.n_seeds}: the buffer would take {needed:.1f} GiB of the"
                f" machine's {available:.1f}; give a smaller buffer_size or fewer seeds"
            )

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
    def frames_per_iteration(self) -> int:
        return self.n_worlds * self.steps_between_updates

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


PRESETS = {name: DQNConfig(preset=name) for name in DQNConfig.PRESETS}


def make_network(config: DQNConfig) -> nn.Sequential:
    """The Q network: observation [A, ..., 30] -> [A, ..., 100] values."""
    inputs, outputs = config.observation_size, config.world.n_actions
    generators = [stream(seed, "value network") for seed in config.seeds]
    return mlp(
        [inputs, *config.hidden, outputs], config.activation, generators, config.init, layer_norm=config.layer_norm
    )


def make_loss(network: nn.Module, config: DQNConfig) -> DQNLoss:
    """Equation (1) as TorchRL's DQNLoss with a target network, one loss a row."""
    loss = DQNLoss(
        QValueActor(network, in_keys=["observation"], spec=None, action_space="categorical"),
        loss_function="smooth_l1" if config.loss == "huber" else "l2",
        delay_value=True,
        double_dqn=config.double,
        action_space="categorical",
        reduction="none",
    )
    loss.make_value_estimator(gamma=config.gamma**config.n_steps)
    return loss


def make_learner(loss: DQNLoss, config: DQNConfig, compile: bool) -> Learner:
    """Adam as SB3 sets it."""
    adam = Adam(config.lr, config.adam_eps)
    return Learner(loss, ["loss"], adam, max_grad_norm=config.max_grad_norm, compile=compile)


def make_buffer(sampler: AgentSampler, config: DQNConfig) -> ReplayBuffer:
    """A ring of transitions with a draw of its own for each agent: all minibatches of a round at once."""
    return ReplayBuffer(
        storage=LazyTensorStorage(min(config.buffer_size, config.frames), device=config.device),
        sampler=sampler,
        batch_size=config.batch_size * config.updates_per_step,
    )


def rows(batch: TensorDictBase, config: DQNConfig) -> TensorDictBase:
    """What the buffer keeps of steps [A, W, T], as rows [T W, A] in the order of time: its agents stay apart."""
    names = ["reward", "done", "terminated", *(["observation"] if config.keeps_next_observations else [])]
    following = [("next", name) for name in names]
    return batch.select("observation", "action", *following).transpose(1, 2).flatten(1, 2).transpose(0, 1)


def make_sampler(config: DQNConfig) -> AgentSampler:
    """Draws transitions uniformly; with each those that follow it, where the buffer has no s' of its own."""
    following = [] if config.keeps_next_observations else [n * config.n_worlds for n in range(1, config.n_steps + 1)]
    return AgentSampler(config.seeds, "replay", replace=True, successors=following)


def draw(buffer: ReplayBuffer, config: DQNConfig) -> TensorDictBase:
    """A round's transitions (s, a, R, s') [A, M, N]: M batches of N for each agent.

    With n steps R is R_1 + gamma R_2 + ... + gamma^(n-1) R_n, up to a collision, and s' is n steps later.
    """
    batch = buffer.sample()
    if not config.keeps_next_observations:
        batch, *later = batch.unbind(0)
        following = batch["next"]
        following["observation"] = later[-1]["observation"]
        for n, step in enumerate(later[:-1], 1):
            reward = config.gamma**n * step["next", "reward"]
            following["reward"] = following["reward"] + torch.where(following["terminated"], 0, reward)
            for flag in ("terminated", "done"):
                following[flag] = following[flag] | step["next", flag]
    return batch.reshape(config.n_seeds, -1, config.batch_size)


class DQN:
    """All seeds' agents, as the training loop needs them."""

    def __init__(self, config: DQNConfig, compile: bool) -> None:
        self.config = config
        self.network = make_network(config).to(config.device)
        self.actor = Actor(self.network, config.seeds, HOW.acts, HOW.head, compile, epsilon=config.epsilon)
        self.loss = make_loss(self.network, config)
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
        if frames > max(config.learning_starts, config.n_steps * config.n_worlds):  # a row has its successors
            losses = self.learner.learn(draw(self.replay, config))
        if frames % config.frames_between_rows and frames < config.frames:
            return None
        with torch.no_grad():
            q_value = self.network(batch["observation"][:, :, -1]).amax(-1).mean(1)
        epsilon = torch.tensor(config.epsilon(frames)).item()
        return {**losses, "q_value": q_value, "epsilon": epsilon, **probes.units(self.network, self.probe)}

    def networks(self) -> Mapping[str, nn.Module]:
        return {"policy": self.network}
