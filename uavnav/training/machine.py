"""How a run uses the machine, by its configuration and never by a clock: compiled or not, processes, threads."""

from __future__ import annotations

import contextlib
import ctypes
import os
import warnings
from collections.abc import Iterator

import torch

from uavnav import graph, networks
from uavnav.choices import ConfigError
from uavnav.tasks import rewards
from uavnav.training.config import TrainConfig

MAPPED_FROM = 2**20
"""Bytes from which glibc gives a block pages of its own."""
M_MMAP_THRESHOLD = -3
"""As malloc.h calls it."""
PAYS_FROM = 100_000
"""Frames per seed from which compilation (20-60 s when cold) is paid back by faster updates."""
FLIGHTS_PAY_FROM = 10_000_000
"""Steps of all drones of an evaluation, if none ended, from which compilation is paid back."""
EAGER = "runs without compilation, several times slower"
"""Begins the warning where `compile=auto` finds no compiler."""


def decide(config: TrainConfig) -> bool:
    """Follow `compile=on` or `off`; with `auto`, compile runs long enough to pay for it where a compiler is at hand.

    Raises:
        ConfigError: `compile=on` where nothing can be compiled.
    """
    if not _wanted(config):
        return False
    problem = graph.problem(config.device)
    if problem and config.compile == "on":
        raise ConfigError(f"compile=on: no graph can be compiled here ({problem}); install g++ and Python's headers")
    if problem:
        warnings.warn(f"{EAGER}: {problem}", stacklevel=2)
    return problem is None


def flights(n_drones: int, max_steps: int) -> bool:
    """Whether to compile the world's step for an evaluation: a long one, where a compiler is at hand."""
    if n_drones * max_steps < FLIGHTS_PAY_FROM:
        return False
    return graph.problem("cpu") is None


def processes(config: TrainConfig) -> int:
    """A process a core, each with its share of the seeds, where a run is long enough to be compiled.

    An activation or a reward that the caller has added is not there in another process.
    """
    if own_parts(config) or torch.device(config.device).type != "cpu" or not _wanted(config):
        return 1
    return min(config.n_seeds, cores())


def own_parts(config: TrainConfig) -> str:
    """The activation and the reward that the caller has added or changed, which no other process knows; often none."""
    activation, reward = config.activation, config.reward
    own = {
        f"activation={activation}": networks.ACTIVATIONS[activation] is not networks.BUILT_IN.get(activation),
        f"reward={reward}": rewards.REWARDS[reward] is not rewards.BUILT_IN.get(reward),
    }
    return ", ".join(part for part, added in own.items() if added)


def cores() -> int:
    """That this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def threads(config: TrainConfig) -> int:
    """Within one process, two threads are slower than one for fewer than 4 agents, and faster from there on."""
    return 1 if config.n_seeds < 4 else min(2, cores())


def keep_memory_flat() -> None:
    """Let this process return large blocks to the system when they are freed.

    glibc raises the size from which it does so up to 32 MB by itself: rollouts then lie on a heap among small things
    that live on, and ten seeds of PPO grow by 5 to 10 MB an iteration, to 3 to 5 GB. Other C libraries are left as they
    are.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").mallopt(M_MMAP_THRESHOLD, MAPPED_FROM)


@contextlib.contextmanager
def use_threads(number: int) -> Iterator[None]:
    """Let torch use so many threads, and then as many as before."""
    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _wanted(config: TrainConfig) -> bool:
    return config.compile == "on" or (config.compile == "auto" and config.total_frames >= PAYS_FROM)
