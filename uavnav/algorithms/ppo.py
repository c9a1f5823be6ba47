"""Proximal Policy Optimization, sec. 3.3, from top to bottom: config, networks, loss, learning.

    L_clip  = E[min(r A, clip(r, 1 - epsilon, 1 + epsilon) A)],  r = pi(a|s) / pi_old(a|s)        eq. (2)
    A       = generalised advantage estimate of delta = R + gamma V(s') - V(s)                     eq. (3), lambda = 0
    L_value = (V(s) - V_target)^2                                                                  eq. (4)

Everything has a leading axis of agents A, one a seed, that learn side by side and independently of each other.
Letters: A agents, W environments an agent, T steps of a rollout.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.distributions import Categorical
from torchrl.data import ReplayBuffer
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from uavnav.acting import Actor
from uavnav.algorithms import ALGORITHMS
from uavnav.algorithms.replay import AgentSampler, AgentStorage
from uavnav.errors import ConfigError
from uavnav.networks import Init, mlp
from uavnav.settings import key
from uavnav.tasks.seeding import stream
from uavnav.training import probes
from uavnav.training.checkpoints import Stateful
from uavnav.training.config import TrainConfig, at_least, within
from uavnav.training.learner import Learner
from uavnav.training.loop import Row, train
from uavnav.training.optimisers import Adam

__all__ = ["PPO", "PRESETS", "PPOConfig", "train"]

HOW = ALGORITHMS["ppo"]


@dataclass(frozen=True, kw_only=True)
class PPOConfig(TrainConfig):
    """Proximal Policy Optimization, sec. 3.3; the defaults are Stable-Baselines3's of the paper's time."""

    algorithm: ClassVar[str] = "ppo"
    PRESETS: ClassVar[dict[str, dict[str, Any]]] = {
        "vectorised": {},
        "paper": {"n_envs": 1},  # as SB3 runs by default
        "fast": {  # a good drone soon: few, large steps of both collection and learning
            "total_frames": 400_000,
            "n_envs": 128,
            "frames_per_batch": 4096,
            "minibatch_size": 512,
            "epochs": 8,
            "lr": 1e-3,
        },
    }
    MICROSECONDS: ClassVar[dict[tuple[str, bool], tuple[float, float]]] = {
        ("vectorised", True): (24.7, 25.9),
        ("vectorised", False): (338.4, 25.9),
        ("fast", True): (4.6, 35.4),
    }

    lr: float = at_least(3e-4, 0, "Adam's learning rate")
    frames_per_batch: int = at_least(2048, 1, "collected in an iteration, from all environments", "frames a seed")
    minibatch_size: int = at_least(64, 2, "in a gradient step", "frames")
    epochs: int = within(10, 1, 1_000, "passes over an iteration's frames")
    adam_eps: float = at_least(1e-5, 0, "Adam's ε")
    gae_lambda: float = within(0.95, 0, 1, "λ of the advantage estimate")
    clip_epsilon: float | None = within(0.2, 0, 1, "ε of eq. (2); null clips nothing")
    critic_coeff: float = at_least(0.5, 0, "weight of the value loss")
    entropy_coeff: float = at_least(0.0, 0, "weight of the entropy bonus")
    init: Init = key("orthogonal", "of the weights, with gains √2, 0.01 (policy) and 1 (value) if orthogonal")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.critic_coeff == 0:
            raise ConfigError("critic_coeff=0: advantages need a value that learns; give a number above 0")
        if self.frames_per_batch % self.minibatch_size:
            raise ConfigError(
                f"minibatch_size={self.minibatch_size}; give a divisor of frames_per_batch={self.frames_per_batch}"
            )

    @property
    def frames_between_rows(self) -> int:
        return self.frames_per_batch

    @property
    def frames_per_iteration(self) -> int:
        return self.frames_per_batch

    def make(self, compile: bool) -> PPO:
        return PPO(self, compile)


PRESETS = {name: PPOConfig(preset=name) for name in PPOConfig.PRESETS}


def make_networks(config: TrainConfig) -> tuple[nn.Sequential, nn.Sequential]:
    """Separate policy [A, ..., 30] -> [A, ..., 100] logits and value [A, ..., 30] -> [A, ..., 1] networks."""
    inputs, outputs = config.observation_size, config.world.n_actions

    def network(purpose: str, outputs: int, gain: float) -> nn.Sequential:
        generators = [stream(seed, purpose) for seed in config.seeds]
        sizes = [inputs, *config.hidden, outputs]
        return mlp(sizes, config.activation, generators, config.init, gain, config.layer_norm)

    return network("policy network", outputs, 0.01), network("value network", 1, 1.0)


def make_actor_critic(policy: nn.Module, value: nn.Module) -> tuple[ProbabilisticActor, TensorDictModule]:
    """The networks as TorchRL's losses call them."""
    actor = ProbabilisticActor(
        TensorDictModule(policy, in_keys=["observation"], out_keys=["logits"]),
        in_keys=["logits"],
        distribution_class=Categorical,
        distribution_kwargs={"validate_args": False},
        return_log_prob=True,
    )
    return actor, TensorDictModule(value, in_keys=["observation"], out_keys=["state_value"])


def clip_bound(config: PPOConfig) -> float:
    """The most by which the ratio of probabilities may differ from 1."""
    return math.inf if config.clip_epsilon is None else config.clip_epsilon


class TraceableClipPPOLoss(ClipPPOLoss):  # type: ignore[misc]
    """TorchRL's own asks whether the entropy is finite, which no graph can be made of, and always clips."""

    @property
    def _clip_bounds(self) -> tuple[Tensor, Tensor]:
        return (-self.clip_epsilon.clamp(max=1)).log1p(), self.clip_epsilon.log1p()

    def _get_entropy(self, dist: Categorical, adv_shape: torch.Size) -> Tensor:
        entropy: Tensor = dist.entropy()[..., None]  # type: ignore[no-untyped-call]
        return entropy


def make_loss(policy: nn.Module, value: nn.Module, config: PPOConfig) -> ClipPPOLoss:
    """Equations (2) and (4) as TorchRL's ClipPPOLoss with SB3's settings, one loss a row."""
    return TraceableClipPPOLoss(
        *make_actor_critic(policy, value),
        clip_epsilon=clip_bound(config),
        critic_coeff=config.critic_coeff,
        loss_critic_type="l2",
        entropy_bonus=config.entropy_coeff > 0,
        entropy_coeff=config.entropy_coeff if config.entropy_coeff > 0 else None,
        normalize_advantage=True,
        normalize_advantage_exclude_dims=(0,),
        log_explained_variance=False,
        reduction="none",
        functional=False,
    )


def make_learner(loss: ClipPPOLoss, config: PPOConfig, compile: bool) -> Learner:
    """Adam as SB3 sets it."""
    losses = ["loss_objective", "loss_critic", *(["loss_entropy"] if config.entropy_coeff > 0 else [])]
    adam = Adam(config.lr, config.adam_eps)
    return Learner(loss, losses, adam, max_grad_norm=config.max_grad_norm, compile=compile)


def make_buffer(sampler: AgentSampler, config: PPOConfig) -> ReplayBuffer:
    """Holds one rollout, and gives it back in an order of its own for each agent: an epoch a draw."""
    storage = AgentStorage(config.frames_per_batch, device=config.device)
    return ReplayBuffer(storage=storage, sampler=sampler, batch_size=config.frames_per_batch)


def make_advantage(gamma: float, gae_lambda: float) -> GAE:
    """Generalised advantage estimation over the time of a rollout; a collision and a cap end its sums."""
    return GAE(gamma=gamma, lmbda=gae_lambda, value_network=None, vectorized=False)


@torch.no_grad()
def estimate(batch: TensorDictBase, loss: ClipPPOLoss, advantage: GAE) -> None:
    """Write into a rollout [A, W, T] the log-probabilities, values, advantages and value targets of its policy."""
    batch["action_log_prob"] = loss.actor_network.get_dist(batch).log_prob(batch["action"])
    loss.critic_network(batch)
    loss.critic_network(batch["next"])
    advantage(batch)


def rows(batch: TensorDictBase) -> TensorDictBase:
    """What the loss needs of a rollout [A, W, T], as rows [W T, A] of a buffer whose agents stay apart."""
    needed = batch.select("observation", "action", "action_log_prob", "advantage", "value_target")
    return needed.flatten(1, 2).transpose(0, 1)


@torch.no_grad()
def diagnostics(batch: TensorDictBase, loss: ClipPPOLoss, clip_epsilon: float) -> dict[str, Tensor]:
    """How far the policy moved in an iteration, and how good the values were before it; each [A]."""
    distribution = loss.actor_network.get_dist(batch)
    log_ratio = distribution.log_prob(batch["action"]) - batch["action_log_prob"]
    ratio = log_ratio.exp()
    target = batch["value_target"].flatten(1)
    residual = target - batch["state_value"].flatten(1)
    return {
        "entropy": distribution.entropy().flatten(1).mean(1),
        "kl_approx": (ratio - 1 - log_ratio).flatten(1).mean(1),
        "clip_fraction": ((ratio - 1).abs() > clip_epsilon).float().flatten(1).mean(1),
        "explained_variance": 1 - residual.var(1) / target.var(1),
    }


class PPO:
    """All seeds' agents, as the training loop needs them."""

    replay = None

    def __init__(self, config: PPOConfig, compile: bool) -> None:
        self.config = config
        self.policy, self.value = (network.to(config.device) for network in make_networks(config))
        self.actor = Actor(self.policy, config.seeds, HOW.acts, HOW.head, compile)
        self.advantage = make_advantage(config.gamma, config.gae_lambda)
        self.loss = make_loss(self.policy, self.value, config)
        self.learner = make_learner(self.loss, config, compile)
        minibatches = AgentSampler(config.seeds, "minibatches", replace=False)
        self.buffer = make_buffer(minibatches, config)
        self.probe = probes.poses(config.make_task()).to(config.device)
        self.parts: Mapping[str, Stateful] = {"minibatches": minibatches, "learner": self.learner}

    def learn(self, batch: TensorDictBase, frames: int) -> Row:
        """Epochs of minibatches over a rollout [A, W, T]; each agent's mean losses and what became of it, [A]."""
        config = self.config
        estimate(batch, self.loss, self.advantage)
        self.buffer.empty()
        self.buffer.extend(rows(batch))
        minibatches = (config.n_seeds, -1, config.minibatch_size)
        epochs = [self.learner.learn(self.buffer.sample().reshape(minibatches)) for _ in range(config.epochs)]
        losses = {name: torch.stack([epoch[name] for epoch in epochs]).mean(0) for name in epochs[0]}
        moved = diagnostics(batch, self.loss, clip_bound(config))
        return {**losses, **moved, **probes.units(self.policy, self.probe)}

    def networks(self) -> Mapping[str, nn.Module]:
        return {"policy": self.policy, "value": self.value}
