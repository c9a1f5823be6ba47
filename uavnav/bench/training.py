"""Jobs that train: with uavnav, with Stable-Baselines3, and with SBX, which is the same on JAX.

Frames are per seed, times in seconds since the process was launched.
"""

from __future__ import annotations

import importlib
import tempfile
import time
from contextlib import suppress
from typing import Any

from uavnav.algorithms import ALGORITHMS
from uavnav.bench import Result
from uavnav.bench.worlds import make_env
from uavnav.training.loop import train

SB3, SBX = "stable_baselines3", "sbx"
WHOLE = 1_000_000
"""Frames of a whole run."""
WARM = 2
"""Marks until the work is steady: everything is compiled."""


class Clock:
    """Notes how far a run is, and says when it was watched for long enough.

    launched: when the process was started [s since the epoch]; config: says how many frames come before it
    learns; seconds: how long to watch it learn, once it is warm.
    """

    def __init__(self, launched: float, config: Any, seconds: float) -> None:
        self.launched, self.seconds = launched, seconds
        self.starts = getattr(config, "learning_starts", 0)
        self.marks: list[tuple[int, float]] = []  # frames so far, and when [s]

    def __call__(self, frames: int) -> bool:
        """Note the frames so far; whether to go on."""
        if frames > self.starts:
            self.marks.append((frames, time.time() - self.launched))
        steady = len(self.marks) - WARM
        return steady < 3 or self.marks[-1][1] - self.marks[WARM][1] < self.seconds

    def result(self) -> Result:
        """Start-up until it learns, the rate without its first quarter, and the time of `WHOLE` frames."""
        (first, began), (frames, ended) = self.marks[max(WARM, len(self.marks) // 4)], self.marks[-1]
        rate = (frames - first) / (ended - began)
        startup = ended - (frames - self.starts) / rate
        whole = startup + (WHOLE - self.starts) / rate
        return {"startup": startup, "rate": rate, "whole": whole, "frames": frames}


def settings(algorithm: str, **changed: Any) -> Any:
    """An algorithm's configuration: the preset `vectorised`, and what differs from it."""
    return ALGORITHMS[algorithm].config(preset="vectorised", **changed)


class _Enough(Exception):
    """A run was watched for long enough."""


def ours(launched: float, algorithm: str, seconds: float, **changed: Any) -> Result:
    """A run of ours, watched for a while: what `Clock.result` gives."""
    config = settings(algorithm, **changed)
    clock = Clock(launched, config, seconds)

    def tell(frames: int, rewards: list[float]) -> None:
        if not clock(frames):
            raise _Enough

    with tempfile.TemporaryDirectory() as scratch:
        with suppress(_Enough):
            train(config, f"{scratch}/run", quiet=True, tell=tell)
        return clock.result()


def whole(launched: float, algorithm: str, **changed: Any) -> Result:
    """A run of ours to its end: its frames."""
    with tempfile.TemporaryDirectory() as scratch:
        run = train(settings(algorithm, **changed), f"{scratch}/run", quiet=True, checkpoint_seconds=5.0)
        return {"frames": run.frames}


def make_model(library: str, algorithm: str, env: Any, **beyond: Any) -> Any:
    """The model of a library with the preset `vectorised`, for one environment; `beyond` is what differs."""
    config = settings(algorithm)
    if library == SBX:
        activation = importlib.import_module("jax.nn").tanh
    else:
        activation = importlib.import_module("torch.nn").Tanh
        beyond["device"] = "cpu"
    if algorithm == "dqn":
        beyond["learning_starts"] = config.learning_starts
        beyond["target_update_interval"] = config.target_update_frames  # SBX has another
    else:
        beyond["n_steps"] = config.frames_per_iteration
    model = getattr(importlib.import_module(library), algorithm.upper())
    policy = {"net_arch": list(config.hidden), "activation_fn": activation}
    return model("MlpPolicy", env, seed=0, policy_kwargs=policy, **beyond)


def peer(launched: float, algorithm: str, seconds: float, which: str = "numpy", library: str = SB3) -> Result:
    """A run of a library on one environment that is watched for a while: what `Clock.result` gives.

    DQN's epsilon has its last value as soon as learning starts, as in nine tenths of a whole run.
    """
    from stable_baselines3.common.callbacks import BaseCallback

    clock = Clock(launched, settings(algorithm), seconds)

    class Watch(BaseCallback):  # type: ignore[misc]
        keep_on = True

        def _on_rollout_start(self) -> None:
            self.keep_on = clock(self.num_timesteps)

        def _on_step(self) -> bool:
            return self.keep_on

    beyond = {"exploration_fraction": clock.starts / WHOLE} if algorithm == "dqn" else {}
    make_model(library, algorithm, make_env(which), **beyond).learn(WHOLE, Watch())
    return clock.result()
