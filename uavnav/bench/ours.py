"""Jobs that train with uavnav. All that the benchmarks use of its algorithms is here: settings, and `train`.

A run is told when to stop by `tell`, which `train` calls with the frames so far. Frames are per seed.
"""

from __future__ import annotations

import importlib
import json
import os
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uavnav.algorithms import ALGORITHMS
from uavnav.bench.results import Result, when
from uavnav.bench.watch import Clock, Stages

if TYPE_CHECKING:
    import pandas as pd

    from uavnav.runs import Run


def settings(algorithm: str, preset: str = "paper", **changed: Any) -> Any:
    """An algorithm's configuration: a preset, and what differs from it."""
    return ALGORITHMS[algorithm].config(preset=preset, **changed)


def has_buffer(algorithm: str) -> bool:
    """Whether it learns from a replay buffer, which takes memory and is filled before learning starts."""
    return hasattr(settings(algorithm), "buffer_size")


def has_fast(algorithm: str) -> bool:
    """Whether it has a preset `fast` without a schedule: N frames make the same policy however many follow."""
    presets = ALGORITHMS[algorithm].presets
    return "fast" in presets and not hasattr(presets["fast"], "exploration_fraction")


def starts(config: Any) -> int:
    """Frames before learning starts; 0 where it starts at once."""
    return int(getattr(config, "learning_starts", 0))


def train(algorithm: str, config: Any, out: str, **how: Any) -> Run:
    """Train to the end; `how` are further arguments of `train`."""
    run: Run = importlib.import_module(ALGORITHMS[algorithm].module).train(config, out=out, quiet=True, **how)
    return run


class _Enough(Exception):
    """A run was watched for long enough."""


def watch(algorithm: str, config: Any, out: str, keep_on: Callable[[int], bool]) -> None:
    """Train for as long as `keep_on` says so."""

    def tell(frames: int, rewards: list[float]) -> None:
        if not keep_on(frames):
            raise _Enough

    with suppress(_Enough):
        train(algorithm, config, out, tell=tell)


# -- runs that are timed ----------------------------------------------------------------------------------------------


def watched(
    launched: float, algorithm: str, frames: int, seconds: float, stages: bool = False, **changed: Any
) -> Result:
    """A run that is watched for a while: what `Clock.result` gives, and how it used the machine.

    With `stages` the time of each is taken, on one core: the run is then one process, as each of a larger run's.
    """
    if stages and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
    config = settings(algorithm, **changed)
    before = starts(config)
    warm = before + 10 * config.n_worlds if before else 3 * getattr(config, "frames_per_batch", config.n_worlds)
    clock = Clock(launched, warm, frames, seconds, _stages() if stages else None)
    with tempfile.TemporaryDirectory() as scratch:
        watch(algorithm, config, f"{scratch}/run", clock)
        meta = json.loads(Path(scratch, "run", "meta.json").read_text())
    how = {name: meta.get(name) for name in ("compiled", "threads", "processes")}
    return clock.result(before, starts(settings(algorithm))) | how


def _stages() -> Stages:
    from torchrl.collectors import Collector
    from torchrl.data import ReplayBuffer
    from torchrl.objectives import HardUpdate
    from torchrl.objectives.value import GAE

    from uavnav.training.display import Display
    from uavnav.training.learner import Learner
    from uavnav.training.recorder import Recorder

    return Stages(
        [
            (Collector, "rollout", "collection"),
            (GAE, "forward", "advantage"),
            (ReplayBuffer, "extend", "buffer"),
            (ReplayBuffer, "sample", "buffer"),
            (Learner, "learn", "update"),
            (HardUpdate, "step", "update"),
            (Recorder, "add_episodes", "logging"),
            (Recorder, "add_progress", "logging"),
            (Recorder, "checkpoint", "logging"),
            (Display, "update", "logging"),
        ]
    )


def whole(launched: float, algorithm: str, checkpoint_seconds: float = 60.0, **changed: Any) -> Result:
    """A run to its end: seconds from the command to the folder."""
    config = settings(algorithm, **changed)
    with tempfile.TemporaryDirectory() as scratch:
        run = train(algorithm, config, f"{scratch}/run", checkpoint_seconds=checkpoint_seconds)
    return {"whole": time.time() - launched, "frames": run.frames}


# -- how soon a good policy is there ----------------------------------------------------------------------------------


def reach(
    launched: float, algorithm: str, preset: str, seed: int, target: float, held_out: int, patience: float
) -> Result:
    """Seconds from the command to the first policy whose mean reward on held-out sets reaches the target.

    The run trains on the train split without its last `held_out` sets, and notes the time of its frames about once a
    second. Policies of those frames are then trained again and judged on the held-out sets: sampled, at most 10,000
    steps an episode. `seconds` and `frames` are None if no policy of the first `patience` seconds reaches the target.
    """
    from uavnav.evaluation import evaluate_policy
    from uavnav.runs.policies import load_policy
    from uavnav.tasks import layouts

    bank = layouts.load("train")
    marks: list[tuple[float, int]] = []

    def keep_on(frames: int) -> bool:
        now = time.time() - launched
        if frames and (not marks or now - marks[-1][0] >= 1):
            marks.append((now, frames))
        return now < patience

    with tempfile.TemporaryDirectory() as scratch:
        layouts.save(bank[:-held_out], f"{scratch}/train.safetensors", seed=0, split="train")
        config = settings(algorithm, preset, seed=seed, layouts=f"{scratch}/train.safetensors")
        watch(algorithm, config, f"{scratch}/run", keep_on)
        compiled = json.loads(Path(scratch, "run", "meta.json").read_text()).get("compiled")

        def good(frames: int) -> bool:
            again = replace(config, total_frames=frames, compile="on" if compiled else "off")
            train(algorithm, again, f"{scratch}/{frames}")
            policy = load_policy(f"{scratch}/{frames}", greedy=False)
            rows = evaluate_policy(policy, bank[-held_out:], held_out, 10_000)
            return float(rows["reward"].mean()) >= target

        seconds, frames = next((mark for mark in marks if good(mark[1])), (None, None))
    return {"seed": seed, "seconds": seconds, "frames": frames}


# -- learning curves, for parity --------------------------------------------------------------------------------------


def curves(launched: float, algorithm: str, paths: list[str], **changed: Any) -> Result:
    """Train seeds side by side, as many as paths, and keep the flights of each seed."""
    config = settings(algorithm, n_seeds=len(paths), **changed)
    with tempfile.TemporaryDirectory() as scratch:
        run = train(algorithm, config, f"{scratch}/run")
    for seed, path in zip(config.seeds, paths, strict=True):
        keep(run.episodes.loc[run.episodes.seed == seed, ["frame", "steps", "reward"]], path)
    return {"seconds": time.time() - launched}


def keep(flights: pd.DataFrame, path: str) -> None:
    """Write a seed's flights (frame at the end, steps, reward) as Parquet, with the date and the commit."""
    from uavnav.runs.tables import write_table

    Path(path).parent.mkdir(parents=True, exist_ok=True)
    flights = flights.reset_index(drop=True)
    flights.attrs["when"] = when()
    write_table(Path(path), flights)
