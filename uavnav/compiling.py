"""How a run uses the machine: compiled or not, and in how many threads; by its configuration, never by a clock."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import warnings
from collections.abc import Callable, Iterator
from typing import Concatenate, ParamSpec, TypeVar

import torch

from uavnav.config import ConfigError, TrainConfig

C = TypeVar("C", bound=TrainConfig)
P = ParamSpec("P")
R = TypeVar("R")

PAYS_FROM = 100_000
"""Frames per seed from which compilation (20-60 s when cold) is paid back by faster updates."""


def decide(config: TrainConfig) -> bool:
    """Follow `compile=on` or `off`; with `auto`, compile runs long enough to pay for it where a compiler is at hand.

    Raises:
        ConfigError: `compile=on` where nothing can be compiled.
    """
    if config.compile == "off" or (config.compile == "auto" and config.total_frames < PAYS_FROM):
        return False
    problem = _problem(config.device)
    if problem and config.compile == "on":
        raise ConfigError(f"compile=on: no graph can be compiled here ({problem}); install g++ and Python's headers")
    if problem:
        warnings.warn(f"runs without compilation, several times slower: {problem}", stacklevel=2)
    return problem is None


def threads(config: TrainConfig) -> int:
    """Two threads are slower than one on the networks of fewer than 4 agents, and faster from there on."""
    return 1 if config.n_seeds < 4 else min(2, len(os.sched_getaffinity(0)))


@contextlib.contextmanager
def use_threads(number: int) -> Iterator[None]:
    """Let torch use so many threads, and then as many as before."""
    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def in_threads(train: Callable[Concatenate[C, P], R]) -> Callable[Concatenate[C, P], R]:
    """Give a training function the threads of its configuration, and its caller the old number back."""

    @functools.wraps(train)
    def limited(config: C, /, *args: P.args, **kwargs: P.kwargs) -> R:
        with use_threads(threads(config)):
            return train(config, *args, **kwargs)

    return limited


def _problem(device: str) -> str | None:
    """Compile something tiny: what a compiler, its headers or a driver lack shows only when they are used."""
    logger = logging.getLogger("torch._inductor")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        torch.compile(torch.square, fullgraph=True)(torch.ones(8, device=device))
    except Exception as error:  # whatever the tool chain raises: the run goes on without it
        return str(error).strip().splitlines()[0]
    finally:
        logger.setLevel(level)
    return None
