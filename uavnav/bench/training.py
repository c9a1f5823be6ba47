"""Jobs that train: with uavnav, with Stable-Baselines3, and with SBX, which is the same on JAX.

Frames are per seed, times in seconds since the process was launched.
"""

from __future__ import annotations

import importlib
import tempfile
import time
from contextlib import suppress
from typing import Any

from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

from uavnav.algorithms import ALGORITHMS
from uavnav.bench import Result
from uavnav.bench.environments import make_env
from uavnav.training.loop import make_collector, train
from uavnav.training.loop import make_env as make_training_env

SB3, SBX = "stable_baselines3", "sbx"
WHOLE = 1_000_000  # frames of a whole run
WARM = 2  # marks until the work is steady: everything is compiled


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


def settings(algorithm: str, preset: str = "vectorised", **changed: Any) -> Any:
    """An algorithm's configuration: a preset, and what differs from it."""
    return ALGORITHMS[algorithm].config(preset=preset, **changed)


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


def part(launched: float, algorithm: str, seconds: float, which: str, **changed: Any) -> Result:
    """The `collection` or the `updates` of a run apart, in one thread, watched for a while once it learns:
    for one iteration at least.

    Frames a second of all seeds, and the arithmetic of the networks' products in that time.
    """
    config = settings(algorithm, compile="on", **changed)
    work = products(config)[which]
    env, trainee = make_training_env(config, True), config.make(True)
    batches = iter(make_collector(env, trainee.actor, config))
    learns_from = getattr(config, "frames_before_learning", 0) + WARM * config.frames_per_iteration
    frames, iterations, spent = 0, 0, 0.0
    while not iterations or spent < seconds:
        began = time.perf_counter()
        batch = next(batches)
        collected = time.perf_counter()
        frames += config.frames_per_iteration
        trainee.learn(batch, frames)
        if frames > learns_from:
            ended = time.perf_counter()
            spent += collected - began if which == "collection" else ended - collected
            iterations += 1
    rate = iterations * config.frames_per_iteration * config.n_seeds / spent
    return {"rate": rate, "gflops": iterations * work / spent / 1e9}


def products(config: Any) -> dict[str, float]:
    """Floating-point operations of the networks' products in an iteration of all seeds, by PyTorch."""
    trainee, found = config.make(False), {}
    batches = iter(make_collector(make_training_env(config, False), trainee.actor, config))
    with Counted() as counted:
        batch = next(batches)
        found["collection"] = counted.total
        trainee.learn(batch, getattr(config, "frames_before_learning", 0) + config.frames_per_iteration)
        found["updates"] = counted.total - found["collection"]
    return found


class Counted(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Adds up the operations of all products; PyTorch's own `FlopCounterMode` refuses `autograd.grad`."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.total = 0.0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = function(*args, **(kwargs or {}))
        if count := flop_registry.get(function.overloadpacket):
            self.total += count(*args, **(kwargs or {}), out_val=found)
        return found


def make_model(library: str, config: Any, env: Any, **beyond: Any) -> Any:
    """The model of a library with our settings, in one environment or a vector; `beyond` is what differs."""
    n_envs = getattr(env, "num_envs", 1)
    if library == SBX:
        activation = importlib.import_module("jax.nn").tanh
    else:
        activation = importlib.import_module("torch.nn").Tanh
        beyond["device"] = "cpu"
    if config.algorithm == "dqn":
        beyond["learning_starts"] = config.learning_starts
        beyond["target_update_interval"] = config.target_update_frames  # SBX has another
        beyond["train_freq"] = max(1, config.frames_per_update // n_envs)
        beyond["gradient_steps"] = max(1, n_envs // config.frames_per_update)
    else:
        beyond["n_steps"] = config.frames_per_iteration // n_envs
    model = getattr(importlib.import_module(library), config.algorithm.upper())
    policy = {"net_arch": list(config.hidden), "activation_fn": activation}
    return model("MlpPolicy", env, seed=0, policy_kwargs=policy, **beyond)


def peer(
    launched: float,
    algorithm: str,
    seconds: float,
    which: str = "numpy",
    library: str = SB3,
    n_envs: int = 1,
) -> Result:
    """A run of a library that is watched for a while: what `Clock.result` gives.

    DQN's epsilon has its last value as soon as learning starts, as in nine tenths of a whole run.
    """
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import DummyVecEnv

    config = settings(algorithm, "paper", n_envs=n_envs)
    clock = Clock(launched, config, seconds)

    class Watch(BaseCallback):  # type: ignore[misc]
        keep_on = True

        def _on_rollout_start(self) -> None:
            self.keep_on = clock(self.num_timesteps)

        def _on_step(self) -> bool:
            return self.keep_on

    env = DummyVecEnv([lambda: make_env(which)] * n_envs)
    beyond = {"exploration_fraction": clock.starts / WHOLE} if algorithm == "dqn" else {}
    make_model(library, config, env, **beyond).learn(WHOLE, Watch())
    return clock.result()
