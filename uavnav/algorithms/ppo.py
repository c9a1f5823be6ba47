"""Proximal Policy Optimization, sec. 3.3, from top to bottom: config, networks, loss, learning.

    L_clip  = E[min(r A, clip(r, 1 - epsilon, 1 + epsilon) A)],  r = pi(a|s) / pi_old(a|s)        eq. (2)
    A       = generalised advantage estimate of R + gamma V(s') - V(s)                             eq. (3)
    L_value = (V(s) - V_target)^2                                                                  eq. (4)

Eq. (3) has lambda = 0; the default is Stable-Baselines3's 0.95. Everything has a leading axis of agents A,
one per seed, that learn side by side and independently of each other.
Letters: A agents, W environments an agent, T steps of a rollout.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.distributions import Categorical
from torch.nn import functional as F

from uavnav.acting import Actor
from uavnav.algorithms import ALGORITHMS
from uavnav.algorithms.rollout import RolloutConfig, learn_in_epochs
from uavnav.networks import Init
from uavnav.settings import AtLeast0, Share, Whole, key
from uavnav.tasks.seeding import Streams
from uavnav.training.checkpoints import Stateful
from uavnav.training.config import TrainConfig
from uavnav.training.loop import Row, train
from uavnav.training.update import Adam, Learner

__all__ = ["PPO", "PRESETS", "PPOConfig", "train"]

HOW = ALGORITHMS["ppo"]
LEARNED = ("observation", "action", "action_log_prob", "advantage", "value_target")
"""What `PPOLoss` is given of a step."""


class PPOConfig(RolloutConfig):
    """Proximal Policy Optimization, sec. 3.3; the defaults are Stable-Baselines3's of the paper's time."""

    algorithm: ClassVar[str] = "ppo"
    PRESETS: ClassVar[dict[str, dict[str, Any]]] = {
        "paper": {},  # as SB3 runs by default
        "vectorised": {"n_envs": 16},
        "fast": {  # a good drone soon: few, large steps of both collection and learning
            "total_frames": 400_000,
            "n_envs": 128,
            "frames_per_batch": 4096,
            "minibatch_size": 512,
            "epochs": 8,
            "lr": 1e-3,
        },
        # of some 25 settings, on `validation`: gamma looks 500 steps ahead, because a crash costs late, and
        # episodes end after 500, because a drone that flies safely else sees few layouts
        "best": {
            "total_frames": 4_000_000,
            "n_envs": 128,
            "frames_per_batch": 4096,
            "minibatch_size": 512,
            "epochs": 8,
            "lr": 1e-3,
            "anneal_lr": True,
            "gamma": 0.998,
            "max_steps": 500,
        },
    }

    lr: AtLeast0 = key(3e-4, "Adam's learning rate")
    minibatch_size: Whole = key(64, ge=2)
    adam_eps: AtLeast0 = key(1e-5, "Adam's ε")
    gae_lambda: Share = key(0.95, "λ of the advantage estimate")
    clip_epsilon: Share | None = key(0.2, "ε of eq. (2); null clips nothing")
    critic_coeff: float = key(0.5, "weight of the value loss", gt=0)  # advantages need a value that learns
    entropy_coeff: AtLeast0 = key(0.0, "weight of the entropy bonus")
    init: Init = key("orthogonal", "of the weights, with gains √2, 0.01 (policy) and 1 (value) if orthogonal")

    def make(self, compile: bool) -> PPO:
        return PPO(self, compile)


PRESETS = {name: PPOConfig(preset=name) for name in PPOConfig.PRESETS}


def make_networks(config: TrainConfig) -> tuple[nn.Sequential, nn.Sequential]:
    """Separate networks of observations [A, ..., 30]: policy, logits [A, ..., 100]; value [A, ..., 1]."""
    return config.network("policy network", config.world.n_actions, 0.01), config.network("value network", 1)


def clip_bound(config: PPOConfig) -> float:
    """The most by which the ratio of probabilities may differ from 1."""
    return math.inf if config.clip_epsilon is None else config.clip_epsilon


def distribution(policy: nn.Module, rows: TensorDictBase) -> Any:
    """pi(.|s) of the policy network [A, ..., 30] -> [A, ..., 100] logits, at the rows' observations."""
    return Categorical(logits=policy(rows["observation"]), validate_args=False)


class PPOLoss(nn.Module):
    """Equations (2) and (4), one loss a row, with SB3's settings.

    TorchRL's ClipPPOLoss gives the same. It asks whether the entropy is finite, so no graph can be made of
    it.
    """

    log_bounds: Tensor

    def __init__(self, policy: nn.Module, value: nn.Module, config: PPOConfig) -> None:
        super().__init__()
        self.policy, self.value, self.config = policy, value, config
        bound = clip_bound(config)
        self.register_buffer("log_bounds", torch.tensor([-min(bound, 1.0), bound]).log1p())  # of log r
        self.names = [
            "loss_objective",
            "loss_critic",
            *(["loss_entropy"] if config.entropy_coeff > 0 else []),
        ]

    def forward(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Rows [A, N] of a rollout -> `loss_objective`, `loss_critic` and, with a bonus, `loss_entropy`."""
        pi = distribution(self.policy, batch)
        log_ratio = (pi.log_prob(batch["action"]) - batch["action_log_prob"])[..., None]
        ratio, clipped = log_ratio.exp(), log_ratio.clamp(*self.log_bounds).exp()
        mean, std = (of(batch["advantage"], (1, 2), keepdim=True) for of in (torch.mean, torch.std))
        advantage = (batch["advantage"] - mean) / std.clamp(min=1e-6)
        objective = torch.stack([ratio * advantage, clipped * advantage], -1).min(-1).values  # eq. (2)
        # eq. (4)
        error = F.mse_loss(batch["value_target"], self.value(batch["observation"]), reduction="none")
        losses = {"loss_objective": -objective, "loss_critic": self.config.critic_coeff * error}
        if "loss_entropy" in self.names:
            losses["loss_entropy"] = -self.config.entropy_coeff * pi.entropy()
        return losses


def make_learner(loss: PPOLoss, config: PPOConfig, compile: bool) -> Learner:
    """Adam as SB3 sets it."""
    adam = Adam(config.lr, config.adam_eps, until=config.lr_ends_at)
    return Learner(loss, loss.names, adam, max_grad_norm=config.max_grad_norm, compile=compile)


@torch.no_grad()
def estimate_advantages(
    batch: TensorDictBase, value: Callable[[Tensor], Tensor], gamma: float, gae_lambda: float
) -> None:
    """Write values, advantages and value targets into a rollout [A, W, T]; value: observations -> [..., 1].

    Schulman et al. (2016), eq. (16): A_t = delta_t + gamma lambda A_t+1, with the delta of eq. (3). A
    collision ends this sum and has no value after it; a time limit only ends the sum. TorchRL's `GAE` gives
    the same, bit for bit, in thrice the time, a seventh of a run with one environment.
    """
    after = batch["next"]
    for rows in (batch, after):
        rows["state_value"] = value(rows["observation"])
    delta = after["reward"] + gamma * ~after["terminated"] * after["state_value"] - batch["state_value"]
    share = gae_lambda * (gamma * ~after["done"])  # of what follows
    advantage, share = (each.movedim(2, 0).contiguous() for each in (delta, share))
    later = torch.zeros_like(advantage[0])
    for now, kept in reversed([*zip(advantage, share, strict=True)]):
        later = now.add_(kept.mul_(later))
    batch["advantage"] = advantage.movedim(0, 2).contiguous()
    batch["value_target"] = batch["advantage"] + batch["state_value"]


@torch.no_grad()
def estimate(batch: TensorDictBase, policy: nn.Module, value: nn.Module, config: PPOConfig) -> None:
    """Write log-probabilities, values, advantages and value targets into a rollout [A, W, T]."""
    batch["action_log_prob"] = distribution(policy, batch).log_prob(batch["action"])
    estimate_advantages(batch, value, config.gamma, config.gae_lambda)


@torch.no_grad()
def diagnostics(batch: TensorDictBase, policy: nn.Module, clip: float) -> dict[str, Tensor]:
    """How far the policy moved in an iteration, and how good the values were before it; each [A]."""
    pi = distribution(policy, batch)
    log_ratio = pi.log_prob(batch["action"]) - batch["action_log_prob"]
    ratio = log_ratio.exp()
    target = batch["value_target"].flatten(1)
    residual = target - batch["state_value"].flatten(1)
    return {
        "entropy": pi.entropy().flatten(1).mean(1),
        "kl_approx": (ratio - 1 - log_ratio).flatten(1).mean(1),
        "clip_fraction": ((ratio - 1).abs() > clip).float().flatten(1).mean(1),
        "explained_variance": 1 - residual.var(1) / target.var(1),
    }


class PPO:
    """All seeds' agents, as the training loop needs them."""

    replay = None

    def __init__(self, config: PPOConfig, compile: bool) -> None:
        self.config = config
        self.policy, self.value = make_networks(config)
        self.loss = PPOLoss(self.policy, self.value, config).to(config.device)
        self.actor = Actor(self.policy, config.seeds, HOW.acts, HOW.head, compile)
        self.learner = make_learner(self.loss, config, compile)
        self.orders = Streams(config.seeds, "minibatches")
        self.parts: Mapping[str, Stateful] = {"minibatches": self.orders, "learner": self.learner}

    def learn(self, batch: TensorDictBase, frames: int) -> Row:
        """Epochs of minibatches over a rollout [A, W, T]; each agent's mean losses and diagnostics, [A]."""
        config = self.config
        estimate(batch, self.policy, self.value, config)
        return {
            **learn_in_epochs(batch, self.learner, self.orders, config, LEARNED),
            **diagnostics(batch, self.policy, clip_bound(config)),
        }

    def networks(self) -> Mapping[str, nn.Module]:
        return {"policy": self.policy, "value": self.value}
