"""How a run uses the machine, by its configuration and no clock: compiled or not, processes, threads."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import multiprocessing
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from typing import TypeVar

import torch

from uavnav import graph, plugins
from uavnav.errors import ConfigError
from uavnav.training.config import TrainConfig

Result = TypeVar("Result")

MAPPED_FROM = 2**20  # bytes from which glibc gives a block pages of its own
MAPPED_AT_MOST = 2**25  # the largest such number that glibc takes
KEPT = 2**28  # bytes that glibc keeps at the end of its heap, where blocks of weights come and go
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # as malloc.h calls them
PAYS_FROM = 100_000
"""Frames per seed from which compilation (20-60 s when cold) is paid back by faster updates."""
EPISODES_PAY_FROM = 2_000
"""Steps that an episode may last from which the compilation of a task's step is paid back."""
MANY = 10_000_000  # steps of all episodes, if none ended, from which the first step is compiled already
EAGER_STEPS = 1_024
"""Of an evaluation, before its step is compiled: most episodes have ended by then, and often all of them."""
EAGER = "runs without compilation, several times slower"
"""Begins the warning where `compile=auto` finds no compiler."""


def decide(config: TrainConfig) -> bool:
    """Follow `compile=on` or `off`; with `auto`, compile runs long enough to pay for it where a compiler is
    at hand.

    Raises:
        ConfigError: `compile=on` where nothing can be compiled.
    """
    if not _wanted(config):
        return False
    problem = graph.problem(config.device)
    if problem and config.compile == "on":
        raise ConfigError(
            f"compile=on: no graph can be compiled here ({problem}); install g++ and Python's headers"
        )
    if problem:
        warnings.warn(f"{EAGER}: {problem}", stacklevel=2)
    return problem is None


def episodes(max_steps: int | None) -> bool:
    """Whether to compile a task's step for episodes that may last so long, where a compiler is at hand."""
    return max_steps is not None and max_steps >= EPISODES_PAY_FROM and graph.problem("cpu") is None


def processes(config: TrainConfig) -> int:
    """A process a core, each with its share of the seeds, where a run is long enough to be compiled.

    What the caller has added without a plugin is not there in another process.
    """
    if own_parts(config) or torch.device(config.device).type != "cpu" or not _wanted(config):
        return 1
    return min(config.n_seeds, cores())


def own_parts(config: TrainConfig) -> str:
    """What the caller has added or changed without a plugin, and no other process knows; often nothing."""
    own = []
    for setting, (table, known) in plugins.TABLES.items():
        name = getattr(config, setting)
        if table[name] is not known.get(name):
            own.append(f"{setting}={name}")
    if type(config).__module__ == "__main__":
        own.append(f"algorithm={config.algorithm}")
    return ", ".join(own)


def cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def threads(config: TrainConfig, processes: int) -> int:
    """One where processes share the seeds. Two are slower than one for fewer than 4 agents, else faster."""
    return 1 if config.n_seeds < 4 or processes > 1 else min(2, cores())


def forks() -> bool:
    """Whether a fork of this process can compute next to it: on Linux, as PyTorch's DataLoader does."""
    return sys.platform == "linux" and cores() > 1 and not multiprocessing.current_process().daemon


@contextlib.contextmanager
def forked(work: Callable[[], Result]) -> Iterator[Callable[[], Result]]:
    """Let a fork of this process do some work that uses one thread; what this gives waits for its result.

    The work is done here where this process does not fork, or the fork failed, and raises here what it
    raises.
    """
    if not forks():
        yield work
        return
    fork = multiprocessing.get_context("fork")
    heard, said = fork.Pipe(duplex=False)
    process = fork.Process(target=_do, args=(work, heard, said), daemon=True)
    with contextlib.suppress(OSError):  # there is no memory for another process
        process.start()
    said.close()

    def result() -> Result:
        try:
            found: Result = heard.recv()
            return found
        except (EOFError, OSError):  # it ended before it had said all
            return work()

    try:
        yield result
    finally:
        if process.pid is not None:
            process.kill()
            process.join()


def _do(work: Callable[[], Result], heard: Connection, said: Connection) -> None:
    """What a fork does; whoever started it hears the signals of the terminal, and ends it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    heard.close()  # else it waits for itself to read where its starter was killed
    with contextlib.suppress(Exception):
        said.send(work())


def keep_memory_flat(layer: int = 0, weights: int = 0) -> None:
    """Let this process return large blocks to the system when they are freed.

    glibc raises the size from which it does so up to 32 MB by itself: rollouts are then on a heap among small
    things that live on, and ten seeds of PPO grow by 5 to 10 MB an iteration, to 3 to 5 GB. Each update has
    blocks as large as all `weights` of a network [bytes] and what aligns them, and new pages would take half
    of its time: they stay, and little that is larger. So do the outputs of a `layer` whose weights alone
    exceed a megabyte, for a batch of a few hundred. Other C libraries are left as they are.
    """
    kept = max(8 * layer * (layer > MAPPED_FROM), weights * 9 // 8 * (weights > MAPPED_FROM))
    with contextlib.suppress(OSError, AttributeError):
        libc = ctypes.CDLL("libc.so.6")
        if kept:
            libc.mallopt(M_TRIM_THRESHOLD, KEPT)
        libc.mallopt(M_MMAP_THRESHOLD, min(kept, MAPPED_AT_MOST) if kept else MAPPED_FROM)


@contextlib.contextmanager
def little_garbage() -> Iterator[None]:
    """Leave what lives already out of Python's garbage collections, a twelfth of a run of small steps."""
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


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
