"""Deep Q-Network, sec. 3.2, from top to bottom: config, network, collector, buffer, loss, loop.

    L(theta) = E[(R + gamma max_a' Q(s', a'; theta-) - Q(s, a; theta))^2]        eq. (1)

over transitions (s, a, R, s') drawn uniformly from the buffer, with SB3's Huber loss in place of the square by default.
theta- is a copy of theta, renewed every so many frames; where an episode terminated at s' the target is R alone.

Everything has a leading axis of agents A, one a seed, that learn side by side and independently of each other.
Letters: A agents, W worlds an agent.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss, HardUpdate

from uavnav import graph, networks
from uavnav.choices import ConfigError
from uavnav.envs.env import make_env
from uavnav.networks import mlp
from uavnav.runs import Run
from uavnav.tasks.seeding import Streams, stream
from uavnav.training import machine, probes, shares, weights
from uavnav.training.checkpoints import Stateful
from uavnav.training.config import TrainConfig, at_least, within
from uavnav.training.display import Display
from uavnav.training.learner import Learner
from uavnav.training.recorder import CHECKPOINT_SECONDS, Log, Recorder, default_folder
from uavnav.training.sampler import AgentSampler
from uavnav.training.sampling import epsilon_greedy

ALGORITHM = "dqn"
LOG_FRAMES = 5_000
"""Frames per seed between two rows of progress."""
FRAME_BYTES = 14
"""Of a transition beside its observations: action, reward and two flags."""


@dataclass(frozen=True, kw_only=True)
class DQNConfig(TrainConfig):
    """DQN's settings; the defaults are the preset `paper`, Stable-Baselines3's defaults of the paper's time."""

    PRESETS: ClassVar[dict[str, dict[str, Any]]] = {
        "paper": {},
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

    n_worlds: int = at_least(64, 1)  # parallel worlds per seed, 16 updates after each step of all of them
    lr: float = at_least(1e-4, 0)
    max_grad_norm: float = at_least(10.0, 0)
    buffer_size: int = at_least(1_000_000, 1)  # frames per seed
    learning_starts: int = at_least(50_000, 0)  # frames of uniformly random actions, without updates
    batch_size: int = at_least(32, 1)
    frames_per_update: int = at_least(4, 1)
    target_update_frames: int = at_least(10_000, 1)
    epsilon_start: float = within(1.0, 0, 1)
    epsilon_end: float = within(0.05, 0, 1)
    exploration_fraction: float = within(0.1, 0, 1)  # of total_frames, over which epsilon falls
    adam_eps: float = at_least(1e-8, 0)
    loss: Literal["huber", "squared"] = "huber"  # SB3's, or eq. (1)'s
    n_steps: int = at_least(1, 1)  # rewards in a target before Q takes over
    double: bool = False  # a' is the best of theta instead of theta-: double Q-learning (van Hasselt et al. 2016)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.n_worlds % self.frames_per_update and self.frames_per_update % self.n_worlds:
            raise ConfigError(
                f"n_worlds={self.n_worlds}; give a multiple or a divisor of frames_per_update={self.frames_per_update}"
            )
        if self.buffer_size <= self.n_steps * self.n_worlds:
            least = (
                f"n_worlds={self.n_worlds}"
                if self.n_steps == 1
                else f"n_steps x n_worlds={self.n_steps * self.n_worlds}"
            )
            raise ConfigError(f"buffer_size={self.buffer_size}; give more than {least}")
        if self.n_steps > 1 and self.max_steps is not None:
            raise ConfigError(f"n_steps={self.n_steps}, max_steps={self.max_steps}; give n_steps=1, or no cap on steps")

    @property
    def iterations(self) -> int:
        """Steps of all worlds at once."""
        return -(-self.total_frames // self.n_worlds)

    @property
    def keeps_next_observations(self) -> bool:
        """Whether the buffer stores s' too. Else it is the next row of the same world, or belongs to a collision, where
        it is worth nothing; a step at the cap bootstraps from an observation that no other row has."""
        return self.max_steps is not None

    @property
    def steps_between_updates(self) -> int:
        """Steps of all worlds from one round of gradient steps to the next."""
        return max(self.frames_per_update // self.n_worlds, 1)

    @property
    def updates_per_step(self) -> int:
        """Gradient steps in such a round."""
        return max(self.n_worlds // self.frames_per_update, 1)

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
    inputs, outputs = config.world.observation_size, config.world.n_actions
    generators = [stream(seed, "value network") for seed in config.seeds]
    return mlp([inputs, *config.hidden, outputs], config.activation, generators, config.init)


class ExploringPolicy(TensorDictModuleBase):  # type: ignore[misc]
    """Acts in training: observation [A, W, 30] -> action [A, W], epsilon-greedy, each agent's from its own stream."""

    in_keys: ClassVar[list[str]] = ["observation"]
    out_keys: ClassVar[list[str]] = ["action"]

    def __init__(self, network: nn.Module, config: DQNConfig, compile: bool) -> None:
        super().__init__()
        self.network = network
        self.streams = Streams(config.seeds, "actions")
        self.epsilon = torch.tensor(config.epsilon(0), device=config.device)
        self._weights = list(network.parameters())  # learning writes them in place
        self._choose = graph.Graph(self.choose) if compile else self.choose

    def choose(self, observation: Tensor, uniform: Tensor, epsilon: Tensor, *weights: Tensor) -> tuple[Tensor]:
        """Actions from uniform numbers [A, 2, W], by the network with these weights."""
        values = networks.call(self.network, weights, observation)
        return (epsilon_greedy(values, epsilon, *uniform.unbind(1)),)

    def act(self, observation: Tensor) -> Tensor:
        """Actions from the streams' next numbers."""
        uniform = self.streams.draw(torch.rand, 2, observation.shape[1], device=observation.device)
        return self._choose(observation, uniform, self.epsilon, *self._weights)[0]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """As a collector calls it, without the Python of a TensorDictModule around `act`."""
        return tensordict.set("action", self.act(tensordict.get("observation")))


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
    return Learner(
        loss, ["loss"], lr=config.lr, eps=config.adam_eps, max_grad_norm=config.max_grad_norm, compile=compile
    )


def check_memory(config: DQNConfig) -> None:
    """Raise a ConfigError where the buffers of all seeds would not fit into the machine's memory."""
    capacity = min(config.buffer_size, config.n_worlds * config.iterations)
    observations = 2 if config.keeps_next_observations else 1
    needed = config.n_seeds * capacity * (observations * 4 * config.world.observation_size + FRAME_BYTES) / 2**30
    available = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    if config.device == "cpu" and needed > available:
        raise ConfigError(
            f"buffer_size={config.buffer_size}, n_seeds={config.n_seeds}: the buffer would take {needed:.1f} GiB of the"
            f" machine's {available:.1f}; give a smaller buffer_size or fewer seeds"
        )


def make_buffer(sampler: AgentSampler, config: DQNConfig, total: int) -> ReplayBuffer:
    """A ring of transitions with a draw of its own for each agent: all minibatches of a round at once."""
    return ReplayBuffer(
        storage=LazyTensorStorage(min(config.buffer_size, total), device=config.device),
        sampler=sampler,
        batch_size=config.batch_size * config.updates_per_step,
    )


def rows(batch: TensorDictBase, config: DQNConfig) -> TensorDictBase:
    """What the buffer keeps of a step [A, W, 1], as rows [W, A]: its agents stay apart."""
    names = ["reward", "done", "terminated", *(["observation"] if config.keeps_next_observations else [])]
    following = [("next", name) for name in names]
    return batch.select("observation", "action", *following).flatten(1, 2).transpose(0, 1)


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
        following["observation"] = later[-1]["observation"].clone()  # inputs of a compiled loop share no memory
        for n, step in enumerate(later[:-1], 1):
            reward = config.gamma**n * step["next", "reward"]
            following["reward"] = following["reward"] + torch.where(following["terminated"], 0, reward)
            for flag in ("terminated", "done"):
                following[flag] = following[flag] | step["next", flag]
    return batch.reshape(config.n_seeds, -1, config.batch_size)


def learn(buffer: ReplayBuffer, learner: Learner, config: DQNConfig) -> dict[str, Tensor]:
    """A round of gradient steps, each on a batch of its own; each agent's loss and gradient norm, their mean, [A]."""
    return learner.learn(draw(buffer, config))


@shares.spread(check=check_memory)
def train(
    config: DQNConfig,
    out: str | Path | None = None,
    overwrite: bool = False,
    quiet: bool = False,
    checkpoint_seconds: float = CHECKPOINT_SECONDS,
    until: int | None = None,
    tell: shares.Tell | None = None,
    log: Log | None = None,
) -> Run:
    """Train one agent a seed and keep the run in a folder.

    Args:
        config: the settings.
        out: the run's folder; by default runs/dqn[-preset]/activation.
        overwrite: start anew where the folder holds a run.
        quiet: show no progress.
        checkpoint_seconds: the least time between two snapshots, from which an unfinished run is resumed.
        until: stop after so many frames per seed, as if by a signal.
        tell: called now and then with the frames per seed so far and each seed's mean reward over its last 100
            episodes.
        logger: `tensorboard`, `wandb`, a list of both, or `none`: logs beside the tables, see `uavnav.loggers`.
        processes: how many share the seeds; by default one for each core, where that pays.

    Returns:
        The finished run; at once, where the folder already holds this very run.

    Raises:
        ConfigError, LayoutError, RunError: before anything is written.
        Interrupted: by SIGINT, SIGTERM or `until`; saved, or the message says what is not.
    """
    out = out or default_folder(ALGORITHM, config)
    recorder = Recorder(out, ALGORITHM, config, overwrite, checkpoint_seconds, until, log)
    if recorder.finished:
        return recorder.read()
    total = config.n_worlds * config.iterations
    sampler = make_sampler(config)
    buffer = make_buffer(sampler, config, total)
    compile = recorder.repeat(machine.decide(config))
    env = make_env(config, compile)
    network = make_network(config).to(config.device)
    policy = ExploringPolicy(network, config, compile)
    collector = Collector(
        env,
        policy,
        frames_per_batch=config.n_seeds * config.n_worlds,
        total_frames=-1,
        auto_register_policy_transforms=False,
        track_traj_ids=False,
        trust_policy=True,
        use_buffers=False,
        return_same_td=True,
        device=config.device,
    )
    loss = make_loss(network, config)
    learner = make_learner(loss, config, compile)
    probe = probes.poses(config.world).to(config.device)
    steps_between_copies = max(config.target_update_frames // config.n_worlds, 1)
    target = HardUpdate(loss, value_network_update_interval=steps_between_copies - 1)  # it copies on every n-th + 1

    parts: dict[str, Stateful] = {"env": env, "actions": policy.streams, "replay": sampler, "learner": learner}

    steps_between_rows = (
        max(LOG_FRAMES // (config.n_worlds * config.steps_between_updates), 1) * config.steps_between_updates
    )
    with recorder, Display(ALGORITHM, config, total, quiet, tell) as display:
        recorder.note(
            compiled=compile, threads=torch.get_num_threads(), beyond_preset=config.beyond(PRESETS[config.preset])
        )
        frames = recorder.resume(parts, buffer)
        display.begin(recorder.path, recorder.meta, until)
        if frames:
            collector._carrier = env.root()  # the collector has no public way to go on from there
            policy.epsilon.fill_(config.epsilon(frames))
            target.counter = frames // config.n_worlds % steps_between_copies
        began, logged = time.perf_counter(), frames
        for step, batch in zip(range(frames // config.n_worlds + 1, config.iterations + 1), collector, strict=False):
            recorder.add_episodes(batch["next"], frames)
            frames += config.n_worlds
            buffer.extend(rows(batch, config))
            target.step()
            learning = (
                frames > max(config.learning_starts, config.n_steps * config.n_worlds)
                and step % config.steps_between_updates == 0
            )
            losses = learn(buffer, learner, config) if learning else {}
            policy.epsilon.fill_(config.epsilon(frames))
            if step % steps_between_rows == 0 or step == config.iterations:
                rate = (frames - logged) / (time.perf_counter() - began)
                began, logged = time.perf_counter(), frames
                with torch.no_grad():
                    q_value = network(batch["observation"]).amax(-1).flatten(1).mean(1)
                facts = {"q_value": q_value, "epsilon": policy.epsilon.item(), **probes.units(network, probe)}
                recorder.add_progress(frames, **losses, **facts, frames_per_second=rate)
                display.update(frames, recorder.recent_rewards())
            recorder.checkpoint(frames, parts, buffer)
        recorder.add_open_episodes(env.state, frames)
        return recorder.finish(weights.serialize({"policy": network}, ALGORITHM, config, config.epsilon_end), frames)
