"""Proximal Policy Optimization, sec. 3.3, from top to bottom: config, networks, collector, buffer, loss, loop.

    L_clip  = E[min(r A, clip(r, 1 - epsilon, 1 + epsilon) A)],  r = pi(a|s) / pi_old(a|s)        eq. (2)
    A       = generalised advantage estimate of delta = R + gamma V(s') - V(s)                     eq. (3), lambda = 0
    L_value = (V(s) - V_target)^2                                                                  eq. (4)

Everything has a leading axis of agents A, one a seed, that learn side by side and independently of each other.
Letters: A agents, W worlds an agent, T steps of a rollout.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import Categorical
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from uavnav import graph, networks
from uavnav.choices import ConfigError
from uavnav.envs.env import make_env
from uavnav.networks import Init, mlp
from uavnav.runs import Run
from uavnav.tasks.seeding import Streams, stream
from uavnav.training import machine, probes, shares, weights
from uavnav.training.checkpoints import Stateful
from uavnav.training.config import TrainConfig, at_least, within
from uavnav.training.display import Display
from uavnav.training.learner import Learner
from uavnav.training.recorder import CHECKPOINT_SECONDS, Log, Recorder, default_folder
from uavnav.training.sampler import AgentSampler
from uavnav.training.sampling import sample_categorical

ALGORITHM = "ppo"


@dataclass(frozen=True, kw_only=True)
class PPOConfig(TrainConfig):
    """PPO's settings; the defaults are the preset `paper`, Stable-Baselines3's defaults of the paper's time."""

    PRESETS: ClassVar[dict[str, dict[str, Any]]] = {
        "paper": {},
        "fast": {  # a good drone soon: few, large steps of both collection and learning
            "total_frames": 400_000,
            "n_worlds": 128,
            "frames_per_batch": 4096,
            "minibatch_size": 512,
            "epochs": 8,
            "lr": 1e-3,
        },
    }

    frames_per_batch: int = at_least(2048, 1)  # collected per seed and iteration, in n_worlds parallel worlds
    minibatch_size: int = at_least(64, 2)
    epochs: int = at_least(10, 1)
    adam_eps: float = at_least(1e-5, 0)
    gae_lambda: float = within(0.95, 0, 1)
    clip_epsilon: float = within(0.2, 0, 1)
    critic_coeff: float = at_least(0.5, 0)
    entropy_coeff: float = at_least(0.0, 0)
    init: Init = "orthogonal"  # gains sqrt(2), 0.01 policy, 1 value (decision 15)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.frames_per_batch % self.n_worlds:
            raise ConfigError(f"n_worlds={self.n_worlds}; give a divisor of frames_per_batch={self.frames_per_batch}")
        if self.frames_per_batch % self.minibatch_size:
            raise ConfigError(
                f"minibatch_size={self.minibatch_size}; give a divisor of frames_per_batch={self.frames_per_batch}"
            )

    @property
    def iterations(self) -> int:
        """Whole iterations, as SB3 runs them: 489 of 2,048 frames for 1,000,000."""
        return -(-self.total_frames // self.frames_per_batch)


PRESETS = {name: PPOConfig(preset=name) for name in PPOConfig.PRESETS}


def make_networks(config: PPOConfig) -> tuple[nn.Sequential, nn.Sequential]:
    """Separate policy [A, ..., 30] -> [A, ..., 100] logits and value [A, ..., 30] -> [A, ..., 1] networks."""
    inputs, outputs = config.world.observation_size, config.world.n_actions
    policy = [stream(seed, "policy network") for seed in config.seeds]
    value = [stream(seed, "value network") for seed in config.seeds]
    return (
        mlp([inputs, *config.hidden, outputs], config.activation, policy, config.init, output_gain=0.01),
        mlp([inputs, *config.hidden, 1], config.activation, value, config.init, output_gain=1.0),
    )


class SampledPolicy(TensorDictModuleBase):  # type: ignore[misc]
    """Acts in training: observation [A, W, 30] -> action [A, W], each agent's from its own stream."""

    in_keys: ClassVar[list[str]] = ["observation"]
    out_keys: ClassVar[list[str]] = ["action"]

    def __init__(self, network: nn.Module, config: PPOConfig, compile: bool) -> None:
        super().__init__()
        self.network = network
        self.streams = Streams(config.seeds, "actions")
        self._weights = list(network.parameters())  # learning writes them in place
        self._choose = graph.Graph(self.choose) if compile else self.choose

    def choose(self, observation: Tensor, uniform: Tensor, *weights: Tensor) -> tuple[Tensor]:
        """Actions from uniform numbers [A, W], by the network with these weights."""
        return (sample_categorical(networks.call(self.network, weights, observation), uniform),)

    def act(self, observation: Tensor) -> Tensor:
        """Actions from the streams' next numbers."""
        uniform = self.streams.draw(torch.rand, observation.shape[1], device=observation.device)
        return self._choose(observation, uniform, *self._weights)[0]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """As a collector calls it, without the Python of a TensorDictModule around `act`."""
        return tensordict.set("action", self.act(tensordict.get("observation")))


def make_loss(policy: nn.Module, value: nn.Module, config: PPOConfig) -> ClipPPOLoss:
    """Equations (2) and (4) as TorchRL's ClipPPOLoss with SB3's settings, one loss a row."""
    logits = TensorDictModule(policy, in_keys=["observation"], out_keys=["logits"])
    return ClipPPOLoss(
        ProbabilisticActor(
            logits,
            in_keys=["logits"],
            distribution_class=Categorical,
            distribution_kwargs={"validate_args": False},
            return_log_prob=True,
        ),
        TensorDictModule(value, in_keys=["observation"], out_keys=["state_value"]),
        clip_epsilon=config.clip_epsilon,
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
    return Learner(loss, losses, lr=config.lr, eps=config.adam_eps, max_grad_norm=config.max_grad_norm, compile=compile)


def make_buffer(sampler: AgentSampler, config: PPOConfig) -> ReplayBuffer:
    """Holds one rollout, and gives it back in an order of its own for each agent: an epoch a draw."""
    storage = LazyTensorStorage(config.frames_per_batch, device=config.device)
    return ReplayBuffer(storage=storage, sampler=sampler, batch_size=config.frames_per_batch)


def make_advantage(config: PPOConfig) -> GAE:
    """Generalised advantage estimation over the time of a rollout; a collision and a cap end its sums."""
    return GAE(gamma=config.gamma, lmbda=config.gae_lambda, value_network=None, vectorized=False)


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


def learn(batch: TensorDictBase, buffer: ReplayBuffer, learner: Learner, config: PPOConfig) -> dict[str, Tensor]:
    """Epochs of minibatches over a rollout [A, W, T] with its advantages; each agent's losses, their mean, [A]."""
    buffer.empty()
    buffer.extend(rows(batch))
    minibatches = (config.n_seeds, -1, config.minibatch_size)
    epochs = [learner.learn(buffer.sample().reshape(minibatches)) for _ in range(config.epochs)]
    return {name: torch.stack([losses[name] for losses in epochs]).mean(0) for name in epochs[0]}


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


@shares.spread()
def train(
    config: PPOConfig,
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
        out: the run's folder; by default runs/ppo[-preset]/activation.
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
    compile = recorder.repeat(machine.decide(config))
    env = make_env(config, compile)
    policy, value = (network.to(config.device) for network in make_networks(config))
    actor = SampledPolicy(policy, config, compile)
    collector = Collector(
        env,
        actor,
        frames_per_batch=config.n_seeds * config.frames_per_batch,
        total_frames=-1,
        auto_register_policy_transforms=False,
        track_traj_ids=False,
        trust_policy=True,
        use_buffers=False,
        return_same_td=True,
        device=config.device,
    )
    sampler = AgentSampler(config.seeds, "minibatches", replace=False)
    buffer = make_buffer(sampler, config)
    advantage = make_advantage(config)
    loss = make_loss(policy, value, config)
    learner = make_learner(loss, config, compile)
    probe = probes.poses(config.world).to(config.device)

    parts: dict[str, Stateful] = {"env": env, "actions": actor.streams, "minibatches": sampler, "learner": learner}

    total = config.frames_per_batch * config.iterations
    with recorder, Display(ALGORITHM, config, total, quiet, tell) as display:
        recorder.note(
            compiled=compile, threads=torch.get_num_threads(), beyond_preset=config.beyond(PRESETS[config.preset])
        )
        frames = recorder.resume(parts)
        display.begin(recorder.path, recorder.meta, until)
        if frames:
            collector._carrier = env.root()  # the collector has no public way to go on from there
        began = time.perf_counter()
        for _, batch in zip(range(frames, total, config.frames_per_batch), collector, strict=False):
            recorder.add_episodes(batch["next"], frames)
            frames += config.frames_per_batch
            estimate(batch, loss, advantage)
            losses = learn(batch, buffer, learner, config)
            rate = config.frames_per_batch / (time.perf_counter() - began)
            began = time.perf_counter()
            moved, hidden = diagnostics(batch, loss, config.clip_epsilon), probes.units(policy, probe)
            recorder.add_progress(frames, **losses, **moved, **hidden, frames_per_second=rate)
            display.update(frames, recorder.recent_rewards())
            recorder.checkpoint(frames, parts)
        recorder.add_open_episodes(env.state, frames)
        return recorder.finish(weights.serialize({"policy": policy, "value": value}, ALGORITHM, config), frames)
