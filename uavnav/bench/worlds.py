"""Jobs that measure steps/s of worlds alone, with random actions. Their first argument, the launch, is not used."""

from __future__ import annotations

import functools
import itertools
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from uavnav.bench.results import Result

WARM_UP = 10


def batched(
    launched: float,
    batches: list[int],
    compiled: bool,
    seconds: float,
    meeting: str = "",
    copies: int = 1,
    settings: Mapping[str, Any] | None = None,
) -> Result:
    """Steps/s of DroneEnv by batch size, through the call that collectors make; settings: its keywords.

    With a folder `meeting`, so many copies of this job measure each batch size at the same time.
    """
    found = {}
    for batch in batches:
        step = _batched_step(batch, compiled, settings or {})
        step()  # compiles
        if meeting:
            _meet(Path(meeting), str(batch), copies)
        found[str(batch)] = batch * _rate(step, seconds)
    return found


def _batched_step(batch: int, compiled: bool, settings: Mapping[str, Any]) -> Callable[[], None]:
    import torch

    from uavnav.envs.env import DroneEnv

    env = DroneEnv([batch], **settings)
    if compiled:
        env.compile()
    actions = itertools.cycle(torch.randint(100, (16, batch)).unbind(0))
    now = env.reset()

    def step() -> None:
        nonlocal now
        _, now = env.step_and_maybe_reset(now.set("action", next(actions)))

    return step


def _meet(folder: Path, name: str, copies: int, patience: float = 300.0) -> None:
    """Wait until so many processes are here, and go on at the same time."""
    (folder / f"{name}-{os.getpid()}").touch()
    end = time.monotonic() + patience
    while len(here := list(folder.glob(f"{name}-*"))) < copies:
        if time.monotonic() > end:
            raise TimeoutError(f"{len(here)} of {copies} processes came to measure {name}")
        time.sleep(0.01)
    last = max(path.stat().st_mtime for path in here)
    time.sleep(max(last + 0.2 - time.time(), 0))


def single(launched: float, which: str, seconds: float) -> Result:
    """Steps/s of one Gymnasium environment, resets included; `which` is `numpy` or `uavnav`."""
    env = make_env(which)
    actions = itertools.cycle(np.random.default_rng(0).integers(env.action_space.n, size=4096))
    env.reset(seed=0)

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(next(actions))
        if terminated or truncated:
            env.reset()

    return {"rate": _rate(step, seconds)}


def vector(launched: float, batches: list[int], seconds: float) -> Result:
    """Steps/s of `gymnasium.make_vec` by the number of environments."""
    import gymnasium

    found = {}
    for batch in batches:
        env = gymnasium.make_vec("uavnav/Drone-v0", num_envs=batch)
        actions = itertools.cycle(np.random.default_rng(0).integers(100, size=(64, batch)))
        env.reset(seed=0)
        steps = map(env.step, actions)  # each `next` is a step
        found[str(batch)] = batch * _rate(functools.partial(next, steps), seconds)
    return found


def _rate(step: Callable[[], object], seconds: float) -> float:
    """Calls a second, over so many seconds and at least 2 calls; the first calls, which warm up, are not timed."""
    for _ in range(WARM_UP):
        step()
    began, steps = time.perf_counter(), 0
    while time.perf_counter() - began < seconds or steps < 2:
        step()
        steps += 1
    return steps / (time.perf_counter() - began)


def make_env(which: str) -> Any:
    """One environment as `gymnasium.make` gives it, with the same wrappers for both worlds: `numpy` or `uavnav`."""
    import gymnasium

    if which == "uavnav":
        return gymnasium.make("uavnav/Drone-v0")
    if "uavnav/NumpyDrone-v0" not in gymnasium.registry:
        gymnasium.register(id="uavnav/NumpyDrone-v0", entry_point="uavnav.bench.numpy_world:NumpyDroneEnv")
    return gymnasium.make("uavnav/NumpyDrone-v0")
