"""Soft Actor-Critic for discrete actions (Christodoulou 2019), from top to bottom: config, networks, loss,
learning.

    L_Q     = sum over both Q of (Q(s, a) - y)^2,   y = R + gamma V(s')
    V(s')   = sum over a' of pi(a'|s') (min Q-(s', a') - alpha log pi(a'|s'))
    L_pi    = sum over a of pi(a|s) (alpha log pi(a|s) - min Q(s, a))
    L_alpha = log alpha (H(pi(.|s)) - H_target)

over transitions (s, a, R, s') drawn uniformly from DQN's buffer. Both Q- follow their Q softly after each
step; where an episode terminated at s', y is R. The temperature alpha keeps the policy's entropy H near
its target.

Letters: A agents, one per seed, that learn side by side and independently of each other; W environments an
agent; N rows.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from uavnav.acting import Actor
from uavnav.algorithms import ALGORITHMS
from uavnav.algorithms.replay import Replay, ReplayConfig, make_replay
from uavnav.algorithms.rounds import Rounds
from uavnav.settings import AtLeast0, Count, Share, Whole, key
from uavnav.training.checkpoints import Stateful
from uavnav.training.loop import Row, train
from uavnav.training.update import Adam, Learner

__all__ = ["PRESETS", "SAC", "SACConfig", "train"]

HOW = ALGORITHMS["sac"]


class SACConfig(ReplayConfig):
    """Soft Actor-Critic for discrete actions, which the paper does not have; the defaults are CleanRL's."""

    COPIES: ClassVar[int] = 11  # a policy, two Q networks, and the targets of these
    algorithm: ClassVar[str] = "sac"
    PRESETS: ClassVar[dict[str, dict[str, Any]]] = {
        "paper": {},  # as CleanRL and SB3 run by default
        "vectorised": {"n_envs": 64},
        "fast": {  # the best of 40 settings after 200,000 frames, on the split `validation`: results/tuning
            "total_frames": 200_000,
            "n_envs": 64,
            "hidden": (32, 32),
            "lr": 2.3e-3,
            "gamma": 0.999,
            "batch_size": 256,
            "frames_per_update": 8,
            "tau": 0.0037,
            "target_entropy": 0.17,
        },
    }

    lr: AtLeast0 = key(3e-4, "Adam's learning rate, of policy, Q networks and temperature")
    max_grad_norm: AtLeast0 | None = key(None)  # neither CleanRL nor SB3 clips
    learning_starts: Whole = key(20_000, "of the untrained policy, without updates", "frames per seed", ge=0)
    batch_size: Count = key(64, "in a gradient step", "transitions")
    # as SB3 has it
    tau: Share = key(0.005, "of the Q networks that enters the targets after each step", "share")
    target_entropy: Share = key(
        0.89, "that the policy's entropy should have of that of random actions, ln 100", "share"
    )
    adam_eps: AtLeast0 = key(1e-4, "Adam's ε")

    def make(self, compile: bool) -> SAC:
        return SAC(self, compile)


PRESETS = {name: SACConfig(preset=name) for name in SACConfig.PRESETS}


class Twins(nn.Module):
    """Two Q networks: observation [A, ..., 30] -> [2, A, ..., 100] values."""

    def __init__(self, first: nn.Module, second: nn.Module) -> None:
        super().__init__()
        self.first, self.second = first, second

    def forward(self, observation: Tensor) -> Tensor:
        return torch.stack([self.first(observation), self.second(observation)])


def make_networks(config: SACConfig) -> tuple[nn.Sequential, Twins]:
    """The policy [A, ..., 30] -> [A, ..., 100] logits, and the two Q networks; no layer is shared."""
    n = config.world.n_actions
    twins = (config.network(f"{which} Q network", n) for which in ("first", "second"))
    return config.network("policy network", n, 0.01), Twins(*twins)


class SACLoss(nn.Module):
    """The three losses, one a row. TorchRL's DiscreteSACLoss has one temperature for all agents together."""

    def __init__(self, policy: nn.Module, twins: Twins, config: SACConfig) -> None:
        super().__init__()
        self.policy, self.twins = policy, twins
        self.target_twins = copy.deepcopy(twins).requires_grad_(False)
        self.log_alpha = nn.Parameter(torch.zeros(config.n_seeds, 1))
        self.gamma = config.gamma
        self.target_entropy = config.target_entropy * math.log(config.world.n_actions)

    def forward(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Transitions [A, N] -> `loss_actor`, `loss_qvalue` and `loss_alpha`, each [A, N]."""
        following, alpha = batch["next"], self.log_alpha.detach().exp()[..., None]
        with torch.no_grad():
            pi, _ = self._policy(following)
            log_pi = torch.where(pi == 0, 1e-8, pi).log()  # as TorchRL: 0 log 0 is 0
            least = self.target_twins(following["observation"]).amin(0)
            value = (pi * (least - alpha * log_pi)).sum(-1, keepdim=True)
            target = (following["reward"] + self.gamma * ~following["terminated"] * value).squeeze(-1)
        values = self.twins(batch["observation"])
        action = batch["action"].expand(values.shape[:-1])[..., None]
        pi, log_pi = self._policy(batch)
        entropy = -(log_pi * pi).sum(-1).detach()
        return {
            "loss_actor": (pi * (alpha * log_pi - values.detach().amin(0))).sum(-1),
            "loss_qvalue": (values.gather(-1, action).squeeze(-1) - target).square().sum(0),
            "loss_alpha": self.log_alpha * (entropy - self.target_entropy),
        }

    def _policy(self, rows: TensorDictBase) -> tuple[Tensor, Tensor]:
        """pi and log pi: observations [A, N] -> [A, N, actions]."""
        logits = self.policy(rows["observation"])
        log_pi = logits - logits.logsumexp(-1, keepdim=True)
        return log_pi.softmax(-1), log_pi


def make_learner(loss: nn.Module, config: SACConfig, compile: bool, replay: Replay | None = None) -> Learner:
    """One Adam for all three losses, each at the weights before the step; the targets follow softly after
    it. For transitions, or for what is drawn of a ring.
    """
    losses = ["loss_actor", "loss_qvalue", "loss_alpha"]
    adam = Adam(config.lr, config.adam_eps, until=config.lr_ends_at)
    how: dict[str, Any] = {"read": replay.read, "memory": [replay.storage.ring]} if replay else {}
    how |= {"max_grad_norm": config.max_grad_norm, "tau": config.tau}
    return Learner(loss, losses, adam, compile=compile, **how)


class SAC:
    """All seeds' agents, as the training loop needs them."""

    def __init__(self, config: SACConfig, compile: bool) -> None:
        self.config = config
        self.policy, self.twins = make_networks(config)
        self.loss = SACLoss(self.policy, self.twins, config).to(config.device)
        self.actor = Actor(self.policy, config.seeds, HOW.acts, HOW.head, compile)
        self.transitions = make_replay(config)
        self.learner = make_learner(self.loss, config, compile, self.transitions)
        self.replay = self.transitions.buffer
        rounds = Rounds(config, self.actor, self.transitions, self.learner)
        self.rounds = rounds if type(self).learn is SAC.learn else None
        self.parts: Mapping[str, Stateful] = {"replay": self.transitions.sampler, "learner": self.learner}

    def learn(self, batch: TensorDictBase, frames: int) -> Row | None:
        """Steps [A, W, T] into the buffer, then a round of updates; now and then a row, [A]."""
        config, losses = self.config, {}
        self.transitions.extend(batch)
        if frames > config.frames_before_learning:
            losses = self.learner.learn(self.transitions.draw(config.updates_per_step, config.batch_size))
        if not config.logs(frames):
            return None
        return {**losses, **self.diagnostics(batch["observation"][:, :, -1])}

    @torch.no_grad()
    def diagnostics(self, observation: Tensor) -> dict[str, Tensor]:
        """Temperature, and entropy and value of the policy: means over observations [A, W, 30], each [A]."""
        log_pi = self.policy(observation).log_softmax(-1)
        pi = log_pi.exp()
        return {
            "alpha": self.loss.log_alpha.detach().exp().flatten(),
            "entropy": -(pi * log_pi).sum(-1).mean(1),
            "q_value": (pi * self.twins(observation).amin(0)).sum(-1).mean(1),
        }

    def networks(self) -> Mapping[str, nn.Module]:
        return {"policy": self.policy, "first": self.twins.first, "second": self.twins.second}
