"""Peers in plain PyTorch, as one would write them in one file: what Stable-Baselines3 has not, discrete SAC and C51.

They are written after CleanRL's `sac_atari.py` and `c51.py`: one environment, a NumPy buffer, a module a network, and
an Adam for each loss, one after the other. Their numbers are those of our presets `paper`.
"""

from __future__ import annotations

import copy
import itertools
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from uavnav.bench import ours
from uavnav.bench.results import Result
from uavnav.bench.watch import WHOLE, Clock
from uavnav.bench.worlds import make_env

LOOK_EVERY = 100
"""Frames from one look at the clock to the next."""

Batch = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]


class Buffer:
    """A ring of transitions (s, a, R, s', terminated)."""

    def __init__(self, size: int, observation_size: int) -> None:
        self.size, self.written = size, 0
        self.observation = np.zeros((size, observation_size), np.float32)
        self.following = np.zeros((size, observation_size), np.float32)
        self.action = np.zeros((size, 1), np.int64)
        self.reward, self.terminated = np.zeros(size, np.float32), np.zeros(size, np.float32)

    def add(self, observation: Any, action: int, reward: float, following: Any, terminated: bool) -> None:
        row = self.written % self.size
        self.observation[row], self.following[row] = observation, following
        self.action[row], self.reward[row], self.terminated[row] = action, reward, terminated
        self.written += 1

    def sample(self, n: int, generator: np.random.Generator) -> Batch:
        rows = generator.integers(min(self.written, self.size), size=n)
        parts = (self.observation, self.action, self.reward, self.following, self.terminated)
        s, a, r, following, terminated = (torch.from_numpy(part[rows]) for part in parts)
        return s, a, r, following, terminated


def network(config: Any, outputs: int) -> nn.Sequential:
    """Observation to outputs, with the hidden layers of our configuration."""
    sizes = [config.world.observation_size, *config.hidden, outputs]
    activation = {"tanh": nn.Tanh, "relu": nn.ReLU}[config.activation]
    layers = [layer for pair in itertools.pairwise(sizes) for layer in (nn.Linear(*pair), activation())]
    return nn.Sequential(*layers[:-1])


class Agent:
    """SAC: policy, two Q networks with targets that follow softly, and a temperature."""

    def __init__(self, config: Any) -> None:
        self.config = config

        def adam(parameters: Any) -> torch.optim.Adam:
            return torch.optim.Adam(parameters, lr=config.lr, eps=config.adam_eps)

        self.policy, self.first, self.second = (network(config, config.world.n_actions) for _ in range(3))
        self.targets = copy.deepcopy((self.first, self.second))
        self.pairs = list(zip(self.targets, (self.first, self.second), strict=True))
        self.log_alpha = torch.zeros(1, requires_grad=True)
        self.entropy = config.target_entropy * float(np.log(config.world.n_actions))
        self.of_q = adam([*self.first.parameters(), *self.second.parameters()])
        self.of_policy, self.of_alpha = adam(self.policy.parameters()), adam([self.log_alpha])

    @torch.no_grad()
    def act(self, observation: Any) -> int:
        return int(torch.multinomial(self.policy(torch.from_numpy(observation)).softmax(-1), 1))

    def update(self, batch: Batch) -> None:
        s, a, r, following, terminated = batch
        alpha = self.log_alpha.detach().exp()
        with torch.no_grad():
            log_next = F.log_softmax(self.policy(following), -1)
            least = torch.min(*(target(following) for target in self.targets))
            value = (log_next.exp() * (least - alpha * log_next)).sum(-1)
            y = r + self.config.gamma * (1 - terminated) * value
        losses = [F.mse_loss(network(s).gather(1, a).squeeze(1), y) for network in (self.first, self.second)]
        self._step(self.of_q, losses[0] + losses[1])
        log_pi = F.log_softmax(self.policy(s), -1)
        pi = log_pi.exp()
        with torch.no_grad():
            least = torch.min(self.first(s), self.second(s))
        self._step(self.of_policy, (pi * (alpha * log_pi - least)).sum(-1).mean())
        entropy = -(pi * log_pi).sum(-1).detach()
        self._step(self.of_alpha, (self.log_alpha * (entropy - self.entropy)).mean())
        with torch.no_grad():
            for target, network in self.pairs:
                for new, old in zip(network.parameters(), target.parameters(), strict=True):
                    old.lerp_(new, self.config.tau)

    @staticmethod
    def _step(optimiser: torch.optim.Adam, loss: Tensor) -> None:
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()


class Distributional:
    """C51: a network that gives each action a distribution over atoms, and its target, which is a copy now and then."""

    def __init__(self, config: Any) -> None:
        self.config, self.updates = config, 0
        self.network = network(config, config.n_outputs)
        self.target = copy.deepcopy(self.network)
        self.atoms = torch.linspace(config.support[0], config.support[1], config.n_atoms)
        self.adam = torch.optim.Adam(self.network.parameters(), lr=config.lr, eps=config.adam_eps)

    def probabilities(self, which: nn.Module, observation: Tensor) -> Tensor:
        """Of each action and atom [..., actions, atoms]."""
        logits: Tensor = which(observation).unflatten(-1, (-1, self.config.n_atoms))
        return logits.softmax(-1)

    @torch.no_grad()
    def act(self, observation: Any) -> int:
        if torch.rand(1) < self.config.epsilon_end:  # its last value as soon as learning starts
            return int(torch.randint(self.config.world.n_actions, (1,)))
        return int((self.probabilities(self.network, torch.from_numpy(observation)) * self.atoms).sum(-1).argmax())

    def update(self, batch: Batch) -> None:
        s, a, r, following, terminated = batch
        rows, last = torch.arange(len(r)), self.config.n_atoms - 1
        with torch.no_grad():
            pi = self.probabilities(self.target, following)
            pi = pi[rows, (pi * self.atoms).sum(-1).argmax(-1)]
            places = r[:, None] + self.config.gamma * (1 - terminated)[:, None] * self.atoms
            places = (places.clamp(self.atoms[0], self.atoms[-1]) - self.atoms[0]) / (self.atoms[1] - self.atoms[0])
            below = places.floor().clamp(0, last - 1)
            share = places - below
            target = torch.zeros_like(pi).scatter_add_(1, below.long(), pi * (1 - share))
            target.scatter_add_(1, below.long() + 1, pi * share)
        predicted = self.probabilities(self.network, s)[rows, a[:, 0]].clamp(1e-5, 1 - 1e-5)
        self.adam.zero_grad()
        loss = -(target * predicted.log()).sum(-1).mean()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.network.parameters(), self.config.max_grad_norm)
        self.adam.step()
        self.updates += 1
        if self.updates * self.config.frames_per_update % self.config.target_update_frames == 0:
            self.target.load_state_dict(self.network.state_dict())


AGENTS: dict[str, type[Agent] | type[Distributional]] = {"sac": Agent, "c51": Distributional}


def watched(
    launched: float, algorithm: str, which: str, frames: int, seconds: float, learning_starts: int, **changed: Any
) -> Result:
    """A run on one environment that is watched for a while: what `Clock.result` gives."""
    config = ours.settings(algorithm, learning_starts=learning_starts, **changed)
    torch.manual_seed(0)
    env, generator = make_env(which), np.random.default_rng(0)
    agent, buffer = AGENTS[algorithm](config), Buffer(min(config.buffer_size, WHOLE), config.world.observation_size)
    clock = Clock(launched, learning_starts + LOOK_EVERY, frames, seconds)
    observation, _ = env.reset(seed=0)
    for frame in itertools.count(1):
        action = agent.act(observation) if frame > learning_starts else int(generator.integers(config.world.n_actions))
        following, reward, terminated, truncated, _ = env.step(action)
        buffer.add(observation, action, reward, following, terminated)
        observation = env.reset()[0] if terminated or truncated else following
        if frame > learning_starts and frame % config.frames_per_update == 0:
            agent.update(buffer.sample(config.batch_size, generator))
        if frame % LOOK_EVERY == 0 and not clock(frame):
            break
    return clock.result(learning_starts, ours.starts(ours.settings(algorithm)))
