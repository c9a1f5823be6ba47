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
from uavnav.algorithms.dqn import ExploringConfig
from uavnav.algorithms.ppo import estimate_advantages
from uavnav.algorithms.rollout import RolloutConfig, learn_in_epochs
from uavnav.settings import AtLeast0, Share, Whole, key
from uavnav.tasks.seeding import Streams
from uavnav.training.checkpoints import Stateful
from uavnav.training.loop import Row, train
from uavnav.training.update import Adam, Learner

__all__ = ["PQN", "PRESETS", "PQNConfig", "train"]

HOW = ALGORITHMS["pqn"]
LEARNED = ("observation", "action", "value_target")  # what `PQNLoss` is given of a step


class PQNConfig(RolloutConfig, ExploringConfig):
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
        "best": {  # the same for longer, in episodes of at most 500 steps, as PPO's
            "total_frames": 2_000_000,
            "n_envs": 128,
            "frames_per_batch": 4096,
            "minibatch_size": 256,
            "anneal_lr": True,
            "activation": "relu",
            "gamma": 0.995,
            "q_lambda": 0.9,
            "epsilon_end": 0.01,
            "exploration_fraction": 0.2,
            "max_steps": 500,
        },
    }

    lr: AtLeast0 = key(5e-4, "Adam's learning rate")
    max_grad_norm: AtLeast0 | None = key(10.0)
    layer_norm: bool = key(True)
    epochs: Whole = key(2, ge=1, le=1_000)
    adam_eps: AtLeast0 = key(1e-8, "Adam's ε")
    q_lambda: Share = key(0.65, "λ of the targets")

    def make(self, compile: bool) -> PQN:
        return PQN(self, compile)


PRESETS = {name: PQNConfig(preset=name) for name in PQNConfig.PRESETS}


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
        self.network = config.network("value network", config.n_outputs).to(config.device)
        self.loss = PQNLoss(self.network)
        self.actor = Actor(self.network, config.seeds, HOW.acts, HOW.head, compile, epsilon=config.epsilon)
        adam = Adam(config.lr, config.adam_eps, until=config.lr_ends_at)
        self.learner = Learner(self.loss, ["loss"], adam, max_grad_norm=config.max_grad_norm, compile=compile)
        self.orders = Streams(config.seeds, "minibatches")
        self.parts: Mapping[str, Stateful] = {"minibatches": self.orders, "learner": self.learner}

    def learn(self, batch: TensorDictBase, frames: int) -> Row:
        """Epochs of minibatches over a rollout [A, W, T]; each agent's mean loss and Q values, [A]."""
        config = self.config
        # with max Q as a state's value, the targets are G
        estimate_advantages(
            batch, lambda seen: self.network(seen).amax(-1, keepdim=True), config.gamma, config.q_lambda
        )
        return {
            **learn_in_epochs(batch, self.learner, self.orders, config, LEARNED),
            "q_value": batch["state_value"].flatten(1).mean(1),
            "epsilon": torch.tensor(config.epsilon(frames)).item(),
        }

    def networks(self) -> Mapping[str, nn.Module]:
        return {"policy": self.network}
