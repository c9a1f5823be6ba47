"""Jobs that train with the libraries Stable-Baselines3 and SBX, which is the same on JAX."""

from __future__ import annotations

import importlib
from typing import Any

from uavnav.bench import ours
from uavnav.bench.watch import WHOLE, Clock, Result
from uavnav.bench.worlds import make_env

SB3, SBX = "stable_baselines3", "sbx"


def make_model(library: str, algorithm: str, env: Any, **beyond: Any) -> Any:
    """The model of a library with the preset `vectorised`, for one environment; `beyond` is what differs from it.

    The preset has the libraries' own settings but for those named here.
    """
    config = ours.settings(algorithm)
    if library == SBX:
        activation = importlib.import_module("jax.nn").tanh
    else:
        activation = importlib.import_module("torch.nn").Tanh
        beyond["device"] = "cpu"
    policy = {"net_arch": list(config.hidden), "activation_fn": activation}
    if algorithm == "dqn":
        own = {"learning_starts": config.learning_starts}
        own["target_update_interval"] = config.target_update_frames  # SBX has another
    else:
        own = {"n_steps": config.frames_per_iteration}
    model = getattr(importlib.import_module(library), algorithm.upper())
    return model("MlpPolicy", env, seed=0, policy_kwargs=policy, **own | beyond)


def watched(
    launched: float,
    algorithm: str,
    seconds: float,
    which: str = "numpy",
    library: str = SB3,
) -> Result:
    """A run of a library on one environment that is watched for a while: what `Clock.result` gives.

    DQN's epsilon has its last value as soon as learning starts, as in nine tenths of a whole run.
    """
    from stable_baselines3.common.callbacks import BaseCallback

    clock = Clock(launched, ours.settings(algorithm), seconds)

    class Watch(BaseCallback):  # type: ignore[misc]
        keep_on = True

        def _on_rollout_start(self) -> None:
            self.keep_on = clock(self.num_timesteps)

        def _on_step(self) -> bool:
            return self.keep_on

    beyond = {"exploration_fraction": clock.starts / WHOLE} if algorithm == "dqn" else {}
    make_model(library, algorithm, make_env(which), **beyond).learn(WHOLE, Watch())
    return clock.result()
