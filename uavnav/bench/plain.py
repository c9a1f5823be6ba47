"""Peers in plain PyTorch, as one would write them in one file: discrete SAC and C51, which SB3 has not.

They are written after CleanRL's `sac_atari.py` and `c51.py`: one environment, a NumPy buffer, a module a
network, and an Adam for each loss, one after the other. Their numbers are those of our presets `paper`.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from uavnav.bench import ours
from uavnav.bench.watch import WHOLE, Clock, Result
from uavnav.bench.worlds import make_env

LOOK_EVERY = 100
"""Frames from one look at the clock to the next."""


class Buffer:
    """A ring of transitions (s, a, R, s', terminated)."""

    def __init__(self, size: int, width: int) -> None:
        self.size, self.written = size, 0
        shapes = [(size, width), (size, 1), size, (size, width), size]
        self.parts = [np.zeros(shape, np.int64 if n == 1 else np.float32) for n, shape in enumerate(shapes)]

    def add(self, *transition: Any) -> None:
        for part, value in zip(self.parts, transition, strict=True):
            part[self.written % self.size] = value
        self.written += 1

    def sample(self, n: int, generator: np.random.Generator) -> list[Tensor]:
        rows = generator.integers(min(self.written, self.size), size=n)
        return [torch.from_numpy(part[rows]) for part in self.parts]


def network(config: Any, outputs: int) -> nn.Sequential:
    """Observation to outputs, with the hidden layers of our configuration."""
    sizes = [config.world.observation_size, *config.hidden, outputs]
    layers = [layer for pair in itertools.pairwise(sizes) for layer in (nn.Linear(*pair), nn.Tanh())]
    return nn.Sequential(*layers[:-1])


def adam(config: Any, parameters: Iterable[Tensor]) -> torch.optim.Adam:
    return torch.optim.Adam(parameters, lr=config.lr, eps=config.adam_eps)


def descend(optimiser: torch.optim.Adam, loss: Tensor, max_norm: float | None = None) -> None:
    """A gradient step."""
    optimiser.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    if max_norm is not None:
        nn.utils.clip_grad_norm_(optimiser.param_groups[0]["params"], max_norm)
    optimiser.step()


class SAC:
    """Policy, two Q networks with targets that follow softly, and a temperature."""

    def __init__(self, config: Any) -> None:
        self.config, n_actions = config, config.world.n_actions
        self.policy = network(config, n_actions)
        self.q = nn.ModuleList(network(config, n_actions) for _ in range(2))
        self.targets = copy.deepcopy(self.q)
        self.log_alpha = torch.zeros(1, requires_grad=True)
        self.entropy = config.target_entropy * float(np.log(n_actions))
        self.of_q, self.of_policy = adam(config, self.q.parameters()), adam(config, self.policy.parameters())
        self.of_alpha = adam(config, [self.log_alpha])

    @torch.no_grad()
    def act(self, observation: Any) -> int:
        return int(torch.multinomial(self.policy(torch.from_numpy(observation)).softmax(-1), 1))

    def update(self, batch: list[Tensor]) -> None:
        s, a, r, following, terminated = batch
        alpha = self.log_alpha.detach().exp()
        with torch.no_grad():
            log_next = F.log_softmax(self.policy(following), -1)
            least = torch.min(*(target(following) for target in self.targets))
            value = (log_next.exp() * (least - alpha * log_next)).sum(-1)
            y = r + self.config.gamma * (1 - terminated) * value
        losses = [F.mse_loss(q(s).gather(1, a).squeeze(1), y) for q in self.q]
        descend(self.of_q, losses[0] + losses[1])
        log_pi = F.log_softmax(self.policy(s), -1)
        pi = log_pi.exp()
        with torch.no_grad():
            least = torch.min(*(q(s) for q in self.q))
        descend(self.of_policy, (pi * (alpha * log_pi - least)).sum(-1).mean())
        entropy = -(pi * log_pi).sum(-1).detach()
        descend(self.of_alpha, (self.log_alpha * (entropy - self.entropy)).mean())
        with torch.no_grad():
            for new, old in zip(self.q.parameters(), self.targets.parameters(), strict=True):
                old.lerp_(new, self.config.tau)


class C51:
    """A network that gives each action a distribution over atoms, and its target, a copy now and then."""

    def __init__(self, config: Any) -> None:
        self.config, self.updates = config, 0
        self.network = network(config, config.n_outputs)
        self.target = copy.deepcopy(self.network)
        self.atoms = torch.linspace(config.support[0], config.support[1], config.n_atoms)
        self.adam = adam(config, self.network.parameters())

    def probabilities(self, which: nn.Module, observation: Tensor) -> Tensor:
        """Of each action and atom [..., actions, atoms]."""
        logits: Tensor = which(observation).unflatten(-1, (-1, self.config.n_atoms))
        return logits.softmax(-1)

    @torch.no_grad()
    def act(self, observation: Any) -> int:
        if torch.rand(1) < self.config.epsilon_end:  # its last value as soon as learning starts
            return int(torch.randint(self.config.world.n_actions, (1,)))
        pi = self.probabilities(self.network, torch.from_numpy(observation))
        return int((pi * self.atoms).sum(-1).argmax())

    def update(self, batch: list[Tensor]) -> None:
        s, a, r, following, terminated = batch
        rows, last = torch.arange(len(r)), self.config.n_atoms - 1
        with torch.no_grad():
            pi = self.probabilities(self.target, following)
            pi = pi[rows, (pi * self.atoms).sum(-1).argmax(-1)]
            places = r[:, None] + self.config.gamma * (1 - terminated)[:, None] * self.atoms
            lowest, gap = self.atoms[0], self.atoms[1] - self.atoms[0]
            places = (places.clamp(lowest, self.atoms[-1]) - lowest) / gap
            below = places.floor().clamp(0, last - 1)
            share = places - below
            target = torch.zeros_like(pi).scatter_add_(1, below.long(), pi * (1 - share))
            target.scatter_add_(1, below.long() + 1, pi * share)
        predicted = self.probabilities(self.network, s)[rows, a[:, 0]].clamp(1e-5, 1 - 1e-5)
        descend(self.adam, -(target * predicted.log()).sum(-1).mean(), self.config.max_grad_norm)
        self.updates += 1
        if self.updates * self.config.frames_per_update % self.config.target_update_frames == 0:
            self.target.load_state_dict(self.network.state_dict())


AGENTS: dict[str, type[SAC] | type[C51]] = {"sac": SAC, "c51": C51}


def watched(launched: float, algorithm: str, seconds: float, **changed: Any) -> Result:
    """A run on one environment that is watched for a while: what `Clock.result` gives."""
    config = ours.settings(algorithm, **changed)
    torch.manual_seed(0)
    env, generator = make_env("numpy"), np.random.default_rng(0)
    agent = AGENTS[algorithm](config)
    buffer = Buffer(min(config.buffer_size, WHOLE), config.world.observation_size)
    clock = Clock(launched, config, seconds)
    observation, _ = env.reset(seed=0)
    for frame in itertools.count(1):
        learns = frame > clock.starts
        action = agent.act(observation) if learns else int(generator.integers(config.world.n_actions))
        following, reward, terminated, truncated, _ = env.step(action)
        buffer.add(observation, action, reward, following, terminated)
        observation = env.reset()[0] if terminated or truncated else following
        if learns and frame % config.frames_per_update == 0:
            agent.update(buffer.sample(config.batch_size, generator))
        if frame % LOOK_EVERY == 0 and not clock(frame):
            break
    return clock.result()
