"""Advantage Actor-Critic, the synchronous A3C of Mnih et al. (2016): one gradient step a rollout, nothing
clipped.

    L_policy = -E[log pi(a|s) A],   A as in PPO with lambda = 1: returns of several steps less V(s)
    L_value  = (V(s) - V_target)^2

Networks and advantages are PPO's; the settings and RMSprop are those of Stable-Baselines3's A2C.
Letters: A agents, W environments an agent, T steps of a rollout.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import A2CLoss

from uavnav.acting import Actor
from uavnav.algorithms import ALGORITHMS
from uavnav.algorithms.ppo import estimate_advantages, make_networks
from uavnav.networks import Init
from uavnav.settings import AtLeast0, Count, Share, key
from uavnav.training.checkpoints import Stateful
from uavnav.training.config import TrainConfig
from uavnav.training.loop import Row, train
from uavnav.training.update import Learner, RMSprop

__all__ = ["A2C", "PRESETS", "A2CConfig", "train"]

HOW = ALGORITHMS["a2c"]
LOG_FRAMES = 2_000  # frames per seed between two rows of progress


class A2CConfig(TrainConfig):
    """Advantage Actor-Critic, which the paper does not have; the defaults are Stable-Baselines3's."""

    algorithm: ClassVar[str] = "a2c"
    PRESETS: ClassVar[dict[str, dict[str, Any]]] = {
        "paper": {},  # as SB3 runs by default
        "vectorised": {"n_envs": 16},
        "fast": {  # the best of 40 settings after 200,000 frames, on the split `validation`: results/tuning
            "total_frames": 200_000,
            "n_envs": 16,
            "n_steps": 3,
            "lr": 8.6e-4,
            "gae_lambda": 0.5,
            "entropy_coeff": 0.001,
        },
    }

    n_steps: Count = key(5, "of every environment in a rollout, and so in a gradient step", "steps")
    lr: AtLeast0 = key(7e-4, "RMSprop's learning rate")
    rms_eps: AtLeast0 = key(1e-5, "RMSprop's ε")
    gae_lambda: Share = key(1.0, "λ of the advantage estimate")
    critic_coeff: float = key(0.5, "weight of the value loss", gt=0)  # advantages need a value that learns
    entropy_coeff: AtLeast0 = key(0.0, "weight of the entropy bonus")
    init: Init = key("orthogonal", "of the weights, with gains √2, 0.01 (policy) and 1 (value) if orthogonal")

    @property
    def frames_between_rows(self) -> int:
        return LOG_FRAMES

    @property
    def frames_per_iteration(self) -> int:
        return self.n_steps * self.n_envs

    def make(self, compile: bool) -> A2C:
        return A2C(self, compile)


PRESETS = {name: A2CConfig(preset=name) for name in A2CConfig.PRESETS}


def make_loss(policy: nn.Module, value: nn.Module, config: A2CConfig) -> A2CLoss:
    """TorchRL's A2CLoss with SB3's settings, one loss a row."""
    actor = ProbabilisticActor(
        TensorDictModule(policy, in_keys=["observation"], out_keys=["logits"]),
        in_keys=["logits"],
        distribution_class=Categorical,
        distribution_kwargs={"validate_args": False},
        return_log_prob=True,
    )
    return A2CLoss(
        actor,
        TensorDictModule(value, in_keys=["observation"], out_keys=["state_value"]),
        critic_coeff=config.critic_coeff,
        loss_critic_type="l2",
        entropy_coeff=config.entropy_coeff,  # zero: no bonus
        reduction="none",
        functional=False,
    )


def make_learner(loss: nn.Module, config: A2CConfig, compile: bool) -> Learner:
    """RMSprop as SB3's A2C sets it."""
    losses = ["loss_objective", "loss_critic", *(["loss_entropy"] if config.entropy_coeff > 0 else [])]
    rmsprop = RMSprop(config.lr, config.rms_eps, until=config.lr_ends_at)
    return Learner(loss, losses, rmsprop, max_grad_norm=config.max_grad_norm, compile=compile)


class A2C:
    """All seeds' agents, as the training loop needs them."""

    replay = None

    def __init__(self, config: A2CConfig, compile: bool) -> None:
        self.config = config
        self.policy, self.value = make_networks(config)
        self.loss = make_loss(self.policy, self.value, config).to(config.device)
        self.actor = Actor(self.policy, config.seeds, HOW.acts, HOW.head, compile)
        self.learner = make_learner(self.loss, config, compile)
        self.parts: Mapping[str, Stateful] = {"learner": self.learner}

    def learn(self, batch: TensorDictBase, frames: int) -> Row | None:
        """One step on a whole rollout [A, W, T]; now and then a row, [A]."""
        config = self.config
        estimate_advantages(batch, self.value, config.gamma, config.gae_lambda)
        needed = batch.select("observation", "action", "advantage", "value_target").flatten(1, 2)
        losses = self.learner.learn(needed[:, None])
        if not config.logs(frames):
            return None
        with torch.no_grad():
            logits = self.policy(batch["observation"]).log_softmax(-1)
        entropy = -(logits.exp() * logits).sum(-1).flatten(1).mean(1)
        return {**losses, "entropy": entropy}

    def networks(self) -> Mapping[str, nn.Module]:
        return {"policy": self.policy, "value": self.value}
