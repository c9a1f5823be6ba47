"""Jobs that measure only frames/s of environments, with random actions; `launched` is not used."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec

from uavnav.bench import Result

WARM_UP = 10  # calls before those that are timed
NUMPY = EnvSpec("uavnav/NumpyDrone-v0", "uavnav.bench.numpy_world:NumpyDroneEnv")
PATIENCE = 300.0  # seconds in which all processes come that measure side by side


def batched(
    launched: float,
    batches: list[int],
    compiled: bool = True,
    seconds: float = 2.0,
    meeting: str = "",
    copies: int = 1,
    settings: Mapping[str, Any] | None = None,
) -> Result:
    """Steps/s of DroneEnv by batch size and at its best, as collectors call it; settings: its keywords.

    With a folder `meeting`, so many copies of this job measure each batch size at the same time.
    """
    import torch

    from uavnav.envs.env import DroneEnv

    found = {}
    for batch in batches:
        env = DroneEnv([batch], **settings or {})
        if compiled:
            env.compile()
        actions = itertools.cycle(torch.randint(100, (16, batch)).unbind(0))
        now = env.reset()

        def step() -> None:
            nonlocal now
            now.set("action", next(actions))  # noqa: B023 - called in this round
            _, now = env.step_and_maybe_reset(now)  # noqa: B023

        step()  # compiles
        if meeting:
            _meet(Path(meeting), str(batch), copies)
        found[str(batch)] = batch * _rate(step, seconds)
    return {"rate": max(found.values())} | (found if len(found) > 1 else {})


def _meet(folder: Path, name: str, copies: int) -> None:
    """Wait until so many processes are here."""
    (folder / f"{name}-{os.getpid()}").touch()
    end = time.monotonic() + PATIENCE
    while len(list(folder.glob(f"{name}-*"))) < copies:
        if time.monotonic() > end:
            raise TimeoutError(f"fewer than {copies} processes came to measure {name}")
        time.sleep(0.001)


def single(launched: float, which: str, seconds: float = 2.0) -> Result:
    """Steps/s of one Gymnasium environment, resets included."""
    env = make_env(which)
    actions = itertools.cycle(np.random.default_rng(0).integers(env.action_space.n, size=4096))
    env.reset(seed=0)

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(next(actions))
        if terminated or truncated:
            env.reset()

    return {"rate": _rate(step, seconds)}


def vector(launched: float, n_envs: int, seconds: float = 2.0) -> Result:
    """Steps/s of `gymnasium.make_vec`."""
    env = gymnasium.make_vec("uavnav/Drone-v0", num_envs=n_envs)
    actions = itertools.cycle(np.random.default_rng(0).integers(100, size=(64, n_envs)))
    env.reset(seed=0)
    return {"rate": n_envs * _rate(lambda: env.step(next(actions)), seconds)}


def _rate(step: Callable[[], object], seconds: float) -> float:
    """Calls a second, over so many seconds and at least 2 calls."""
    for _ in range(WARM_UP):
        step()
    began, steps = time.perf_counter(), 0
    while time.perf_counter() - began < seconds or steps < 2:
        step()
        steps += 1
    return steps / (time.perf_counter() - began)


def make_env(which: str) -> Any:
    """One environment with the wrappers of `gymnasium.make`; `which`: `numpy` or `uavnav`."""
    return gymnasium.make(NUMPY if which == "numpy" else "uavnav/Drone-v0")
