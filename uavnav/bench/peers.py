"""Jobs that train with the peers: Stable-Baselines3, and SBX, which is the same on JAX. `plain` has more."""

from __future__ import annotations

import importlib
import time
from typing import Any

import numpy as np
import pandas as pd

from uavnav.bench import ours
from uavnav.bench.results import Result
from uavnav.bench.watch import WHOLE, Clock, Stages
from uavnav.bench.worlds import make_env

SPEED_UPS: dict[str, dict[int, tuple[float, float | None]]] = {
    "ppo": {1: (8, 20), 10: (25, 60)},
    "dqn": {1: (6, 20), 10: (20, 60)},
    "a2c": {1: (6, None), 10: (20, None)},
    "c51": {1: (6, None), 10: (20, None)},
    "sac": {1: (6, None), 10: (20, None)},
}
"""How many times less a whole run of ours must take, per seed, than one of its peer: by algorithm and number of seeds,
what must be reached and the aim."""
SBX = ("ppo", "dqn")
"""What SBX has of them."""
PLAIN = ("c51", "sac")
"""What SB3 has not: their peers are programs of `uavnav.bench.plain`."""


def make_model(library: str, algorithm: str, env: Any, seed: int, n_envs: int = 1, **beyond: Any) -> Any:
    """The model of a library, Stable-Baselines3 or SBX, with the preset `paper`; `beyond` is what differs from it.

    With n_envs parallel environments the frames per rollout of PPO and A2C and DQN's updates per frame stay the same.
    """
    config = ours.settings(algorithm)
    activation = beyond.pop("activation", config.activation)
    if library == "sbx":
        import jax

        policy = {"activation_fn": getattr(jax.nn, activation)}
    else:
        import torch

        policy = {"activation_fn": {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}[activation]}
        beyond["device"] = "cpu"
    policy["net_arch"] = list(config.hidden)
    if algorithm == "ppo":
        same = {
            "n_steps": config.frames_per_batch // n_envs,
            "batch_size": config.minibatch_size,
            "n_epochs": config.epochs,
            "gae_lambda": config.gae_lambda,
            "clip_range": config.clip_epsilon,
            "vf_coef": config.critic_coeff,
            "ent_coef": config.entropy_coeff,
            "max_grad_norm": config.max_grad_norm,
        }
    elif algorithm == "a2c":
        same = {
            "n_steps": config.frames_per_iteration // n_envs,
            "rms_prop_eps": config.rms_eps,
            "gae_lambda": config.gae_lambda,
            "vf_coef": config.critic_coeff,
            "ent_coef": config.entropy_coeff,
            "max_grad_norm": config.max_grad_norm,
        }
    else:
        same = {
            "buffer_size": config.buffer_size,
            "learning_starts": config.learning_starts,
            "batch_size": config.batch_size,
            "train_freq": max(config.frames_per_update // n_envs, 1),
            "gradient_steps": max(n_envs // config.frames_per_update, 1),
            "target_update_interval": config.target_update_frames,
            "exploration_fraction": config.exploration_fraction,
            "exploration_final_eps": config.epsilon_end,
        }
        if library != "sbx":  # which does not clip in DQN
            same["max_grad_norm"] = config.max_grad_norm
    model = getattr(importlib.import_module(library), algorithm.upper())
    common = {"learning_rate": config.lr, "gamma": config.gamma, "policy_kwargs": policy, "verbose": 0}
    return model("MlpPolicy", env, seed=seed, **common, **same | beyond)


# -- runs that are timed ----------------------------------------------------------------------------------------------


def watched(
    launched: float,
    algorithm: str,
    which: str,
    frames: int,
    seconds: float,
    learning_starts: int,
    library: str = "stable_baselines3",
    stages: bool = False,
) -> Result:
    """A run of a library on one environment that is watched for a while: what `Clock.result` gives.

    DQN's epsilon has its last value as soon as learning starts, as in nine tenths of a whole run.
    """
    from stable_baselines3.common.callbacks import BaseCallback

    starts = learning_starts if ours.has_buffer(algorithm) else 0
    clock = Clock(launched, starts + 100 if starts else 2048, frames, seconds, _stages() if stages else None)

    class Watch(BaseCallback):  # type: ignore[misc]
        keep_on = True

        def _on_rollout_start(self) -> None:
            self.keep_on = clock(self.num_timesteps)

        def _on_step(self) -> bool:
            return self.keep_on

    beyond: Result = {"learning_starts": starts, "exploration_fraction": starts / WHOLE} if starts else {}
    make_model(library, algorithm, make_env(which), seed=0, **beyond).learn(WHOLE, Watch())
    return clock.result(starts, ours.starts(ours.settings(algorithm)))


def _stages() -> Stages:
    from stable_baselines3 import A2C, DQN, PPO
    from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer

    methods = {"collect_rollouts": "collection", "train": "update", "dump_logs": "logging"}
    return Stages(
        [
            *((model, name, stage) for model in (PPO, DQN, A2C) for name, stage in methods.items()),
            (RolloutBuffer, "compute_returns_and_advantage", "advantage"),
            (RolloutBuffer, "add", "buffer"),
            (ReplayBuffer, "add", "buffer"),
            (ReplayBuffer, "sample", "buffer"),
        ]
    )


# -- learning curves, for parity --------------------------------------------------------------------------------------


def curves(
    launched: float, algorithm: str, activation: str, seed: int, n_worlds: int, total_frames: int, path: str
) -> Result:
    """Train one seed of Stable-Baselines3 in parallel worlds, and keep its flights."""
    from stable_baselines3.common.callbacks import BaseCallback

    from uavnav.envs.sb3 import DroneVecEnv

    flights: list[tuple[int, int, float]] = []
    steps, sums = np.zeros(n_worlds, int), np.zeros(n_worlds)

    class Watch(BaseCallback):  # type: ignore[misc]
        def _on_step(self) -> bool:
            steps[:] += 1
            sums[:] += self.locals["rewards"]
            for row in np.flatnonzero(self.locals["dones"]):
                flights.append((self.num_timesteps, int(steps[row]), float(sums[row])))
                steps[row] = sums[row] = 0
            return True

    env = DroneVecEnv(n_worlds, seed=seed) if n_worlds > 1 else make_env("numpy")
    model = make_model("stable_baselines3", algorithm, env, seed, n_worlds, activation=activation)
    model.learn(total_frames, Watch())
    flights += [(model.num_timesteps, int(steps[row]), float(sums[row])) for row in np.flatnonzero(steps)]  # still open
    ours.keep(pd.DataFrame(flights, columns=["frame", "steps", "reward"]), path)
    return {"seconds": time.time() - launched}
