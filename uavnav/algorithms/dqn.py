"""Deep Q-Network, sec. 3.2, from top to bottom: config, network, loss, buffer, learning.

    L(theta) = E[(R + gamma max_a' Q(s', a'; theta-) - Q(s, a; theta))^2]        eq. (1)

over transitions (s, a, R, s') drawn uniformly from the buffer, with SB3's Huber loss in place of the square
by default. theta- is a copy of theta, renewed every so many frames; where an episode terminated at s' the
target is only R.

Letters: A agents, one per seed, that learn side by side and independently of each other; W environments an
agent.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss, HardUpdate, LossModule

from uavnav.acting import Actor, Values, values_of
from uavnav.algorithms import ALGORITHMS
from uavnav.algorithms.replay import Replay, ReplayConfig, make_replay
from uavnav.algorithms.rounds import Rounds
from uavnav.settings import AtLeast0, Count, Share, key
from uavnav.training.checkpoints import Stateful
from uavnav.training.config import TrainConfig
from uavnav.training.loop import Row, train
from uavnav.training.update import Adam, Learner

__all__ = ["DQN", "PRESETS", "DQNConfig", "train"]


class ExploringConfig(TrainConfig):
    """What acting epsilon-greedily needs, whatever learns."""

    epsilon_start: Share = key(1.0, "of random actions at frame 0", "share")
    epsilon_end: Share = key(0.05, "of random actions at the end of the fall", "share")
    exploration_fraction: Share = key(0.1, "of total_frames, over which ε falls", "share")

    @property
    def final_epsilon(self) -> float:
        return self.epsilon_end

    def epsilon(self, frames: int) -> float:
        """The share of random actions after so many frames: a linear fall."""
        decay = self.exploration_fraction * self.total_frames
        progress = min(frames / decay, 1.0) if decay else 1.0
        return self.epsilon_start + progress * (self.epsilon_end - self.epsilon_start)


class QConfig(ReplayConfig, ExploringConfig):
    """What Q-learning from replay needs, whatever its loss."""

    COPIES: ClassVar[int] = 4  # a target too

    lr: AtLeast0 = key(1e-4, "Adam's learning rate")
    max_grad_norm: AtLeast0 | None = key(10.0)
    target_update_frames: Count = key(
        10_000, "between two copies of the network into the target", "frames per seed"
    )
    adam_eps: AtLeast0 = key(1e-8, "Adam's ε")
    n_steps: Count = key(1, "whose rewards are in a target before Q takes over", "steps")
    double: bool = key(False, "double Q-learning: the best action is the network's, its value the target's")
    dueling: bool = key(
        False, "the network gives a state's value and each action's advantage, and Q is their sum"
    )

    def make(self, compile: bool) -> DQN:
        return DQN(self, compile)

    def make_loss(self, network: nn.Module) -> LossModule:
        """A loss a row, of a network and a target network that `HardUpdate` writes."""
        raise NotImplementedError(f"{type(self).__name__} has no loss")

    @property
    def steps_in_target(self) -> int:
        return self.n_steps

    @property
    def discount(self) -> float:
        """Discount of Q in a target: gamma^n_steps, or gamma where a time limit may end it sooner."""
        return self.gamma if self.keeps_next_observations else self.gamma**self.n_steps

    @property
    def head(self) -> str:
        """How the network's outputs are read: an entry in `acting.HEADS` with its numbers."""
        return "dueling" if self.dueling else "direct"

    @property
    def n_outputs(self) -> int:
        """Outputs of the network: one an action; with `dueling`, the state's value in front."""
        return super().n_outputs + self.dueling

    def epsilon(self, frames: int) -> float:
        """The share of random actions: 1 until learning starts, then a linear fall."""
        return 1.0 if frames < self.learning_starts else super().epsilon(frames)


class DQNConfig(QConfig):
    """Deep Q-Network, sec. 3.2; the defaults are Stable-Baselines3's of the paper's time."""

    algorithm: ClassVar[str] = "dqn"
    PRESETS: ClassVar[dict[str, dict[str, Any]]] = {
        "paper": {},  # as SB3 runs by default
        "vectorised": {"n_envs": 64},
        "vectorised-2.3": {"n_envs": 64, "learning_starts": 100},  # SB3's default since its version 2.3
        "fast": {  # targets of five steps and double Q-learning; what it reaches: docs/archive/speed.md
            "total_frames": 400_000,
            "n_envs": 128,
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

    loss: Literal["huber", "squared"] = key("huber", "Stable-Baselines3's, or squared as in eq. (1)")

    def make_loss(self, network: nn.Module) -> DQNLoss:
        return make_loss(network, self)


PRESETS = {name: DQNConfig(preset=name) for name in DQNConfig.PRESETS}


def make_network(config: QConfig) -> nn.Sequential:
    """The Q network: observation [A, ..., 30] -> [A, ..., outputs], read by `config.head` as 100 values."""
    return config.network("value network", config.n_outputs)


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


def make_learner(loss: nn.Module, config: QConfig, compile: bool, replay: Replay | None = None) -> Learner:
    """Adam as SB3 sets it, for transitions, or for what is drawn of a ring."""
    adam = Adam(config.lr, config.adam_eps, until=config.lr_ends_at)
    how: dict[str, Any] = {"read": replay.read, "memory": [replay.storage.ring]} if replay else {}
    return Learner(loss, ["loss"], adam, max_grad_norm=config.max_grad_norm, compile=compile, **how)


def renews_target(config: QConfig, frames: int) -> bool:
    """Whether theta- becomes a copy of theta in the iteration that ends after so many frames per seed."""
    every = max(config.target_update_frames // config.n_envs, 1) * config.n_envs  # whole steps of all
    return frames // every > (frames - config.frames_per_iteration) // every


@torch.no_grad()
def diagnostics(observation: Tensor, network: nn.Module, config: QConfig, frames: int) -> Row:
    """The mean of the best Q values over observations [A, W, 30], [A]; and the share of random actions."""
    best = values_of(config.head, network(observation)).amax(-1)
    return {"q_value": best.mean(1), "epsilon": torch.tensor(config.epsilon(frames)).item()}


class DQN:
    """All seeds' agents, whatever their loss, as the training loop needs them."""

    def __init__(self, config: QConfig, compile: bool) -> None:
        self.config = config
        self.network = make_network(config).to(config.device)
        self.loss = config.make_loss(self.network).to(config.device)
        acts = ALGORITHMS[config.algorithm].acts
        self.actor = Actor(self.network, config.seeds, acts, config.head, compile, epsilon=config.epsilon)
        self.copy_to_target = HardUpdate(self.loss, value_network_update_interval=0)
        self.transitions = make_replay(config)
        self.learner = make_learner(self.loss, config, compile, self.transitions)
        self.replay = self.transitions.buffer
        renews = functools.partial(renews_target, config)
        rounds = Rounds(config, self.actor, self.transitions, self.learner, renews)
        self.rounds = rounds if type(self).learn is DQN.learn else None
        self.parts: Mapping[str, Stateful] = {"replay": self.transitions.sampler, "learner": self.learner}

    def learn(self, batch: TensorDictBase, frames: int) -> Row | None:
        """Steps [A, W, T] into the buffer, then a round of updates; now and then a row, [A]."""
        config, losses = self.config, {}
        self.transitions.extend(batch)
        if renews_target(config, frames):
            self.copy_to_target.step()
        if frames > config.frames_before_learning:
            losses = self.learner.learn(self.transitions.draw(config.updates_per_step, config.batch_size))
        if not config.logs(frames):
            return None
        newest = batch["observation"][:, :, -1]
        return {**losses, **diagnostics(newest, self.network, config, frames)}

    def networks(self) -> Mapping[str, nn.Module]:
        return {"policy": self.network}
