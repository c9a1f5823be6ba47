"""Parallelised Q-Network, Gallici et al. (2025), from top to bottom: config, loss, targets, learning.

    G_t      = R_t + gamma (lambda G_t+1 + (1 - lambda) max_a' Q(s_t+1, a'))        Q(lambda), its eq. (6)
    L(theta) = E[(Q(s, a; theta) - G)^2] / 2

DQN without its buffer and its target network: many environments give fresh steps, LayerNorm keeps the network
stable, and G looks further ahead than one step. After a collision G is only R; at a time limit and at the end
of a rollout it is R + gamma max Q.
Letters: A agents, W environments an agent, T steps of a rollout.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from uavnav.acting import Actor
from uavnav.algorithms import ALGORITHMS
from uavnav.algorithms.ppo import make_advantage, minibatches
from uavnav.errors import ConfigError
from uavnav.networks import mlp
from uavnav.settings import AtLeast0, Count, Share, Whole, key
from uavnav.tasks.seeding import Streams, stream
from uavnav.training import probes
from uavnav.training.checkpoints import Stateful
from uavnav.training.config import TrainConfig
from uavnav.training.loop import Row, train
from uavnav.training.update import Adam, Learner

__all__ = ["PQN", "PRESETS", "PQNConfig", "train"]

HOW = ALGORITHMS["pqn"]
LEARNED = ("observation", "action", "value_target")
"""What `PQNLoss` is given of a step."""


class PQNConfig(TrainConfig):
    """Parallelised Q-Network, which the paper does not have; defaults are near its authors' for MinAtar."""

    algorithm: ClassVar[str] = "pqn"
    PRESETS: ClassVar[dict[str, dict[str, Any]]] = {
        "paper": {},
        "vectorised": {"n_envs": 64},
        "fast": {  # the best of 5 settings of two seeds, by 50 layouts of `validation`: no more than a start
            "total_frames": 400_000,
            "n_envs": 128,
            "frames_per_batch": 4096,
            "minibatch_size": 256,
            "gamma": 0.98,
            "q_lambda": 0.9,
            "epsilon_end": 0.01,
            "exploration_fraction": 0.2,
        },
    }

    lr: AtLeast0 = key(5e-4, "Adam's learning rate")
    max_grad_norm: AtLeast0 | None = key(10.0)
    layer_norm: bool = key(True)
    frames_per_batch: Count = key(2048, "collected in an iteration, from all environments", "frames per seed")
    minibatch_size: Count = key(64, "in a gradient step", "frames")
    epochs: Whole = key(2, "passes over an iteration's frames", ge=1, le=1_000)
    adam_eps: AtLeast0 = key(1e-8, "Adam's ε")
    q_lambda: Share = key(0.65, "λ of the targets")
    epsilon_start: Share = key(1.0, "of random actions at frame 0", "share")
    epsilon_end: Share = key(0.05, "of random actions at the end of the fall", "share")
    exploration_fraction: Share = key(0.1, "of total_frames, over which ε falls", "share")

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
    def final_epsilon(self) -> float:
        return self.epsilon_end

    def epsilon(self, frames: int) -> float:
        """The share of random actions after so many frames: a linear fall."""
        decay = self.exploration_fraction * self.total_frames
        progress = min(frames / decay, 1.0) if decay else 1.0
        return self.epsilon_start + progress * (self.epsilon_end - self.epsilon_start)

    def make(self, compile: bool) -> PQN:
        return PQN(self, compile)


PRESETS = {name: PQNConfig(preset=name) for name in PQNConfig.PRESETS}


def make_network(config: PQNConfig) -> nn.Sequential:
    """The Q network: observation [A, ..., 30] -> [A, ..., 100]."""
    sizes = [config.observation_size, *config.hidden, config.n_outputs]
    generators = [stream(seed, "value network") for seed in config.seeds]
    return mlp(sizes, config.activation, generators, config.init, layer_norm=config.layer_norm)


class PQNLoss(nn.Module):
    """Half the squared error of Q(s, a), one a row."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Rows [A, N] of a rollout, each with its `value_target` -> `loss` [A, N, 1]."""
        chosen = self.network(batch["observation"]).gather(-1, batch["action"][..., None])
        return {"loss": (chosen - batch["value_target"]).square() / 2}


class PQN:
    """All seeds' agents, as the training loop needs them."""

    replay = None

    def __init__(self, config: PQNConfig, compile: bool) -> None:
        self.config = config
        self.network = make_network(config).to(config.device)
        self.loss = PQNLoss(self.network)
        self.actor = Actor(self.network, config.seeds, HOW.acts, HOW.head, compile, epsilon=config.epsilon)
        # with max Q as a state's value, the advantage plus that value is G
        self.targets = make_advantage(config.gamma, config.q_lambda)
        adam = Adam(config.lr, config.adam_eps)
        self.learner = Learner(self.loss, ["loss"], adam, max_grad_norm=config.max_grad_norm, compile=compile)
        self.orders = Streams(config.seeds, "minibatches")
        self.probe = probes.poses(config.make_task()).to(config.device)
        self.parts: Mapping[str, Stateful] = {"minibatches": self.orders, "learner": self.learner}

    def learn(self, batch: TensorDictBase, frames: int) -> Row:
        """Epochs of minibatches over a rollout [A, W, T]; each agent's mean loss and Q values, [A]."""
        config = self.config
        with torch.no_grad():
            for rows in (batch, batch["next"]):
                rows["state_value"] = self.network(rows["observation"]).amax(-1, keepdim=True)
            self.targets(batch)
        epochs = [
            self.learner.learn(minibatches(batch, self.orders, config.minibatch_size, LEARNED))
            for _ in range(config.epochs)
        ]
        return {
            **{name: torch.stack([epoch[name] for epoch in epochs]).mean(0) for name in epochs[0]},
            "q_value": batch["state_value"].flatten(1).mean(1),
            "epsilon": torch.tensor(config.epsilon(frames)).item(),
            **probes.units(self.network, self.probe),
        }

    def networks(self) -> Mapping[str, nn.Module]:
        return {"policy": self.network}
