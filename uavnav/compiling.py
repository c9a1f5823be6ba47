"""How a run uses the machine, by its configuration and never by a clock: compiled or not, processes, threads."""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor
from torch._inductor import standalone_compile
from torch.fx.experimental.proxy_tensor import make_fx

from uavnav import networks, rewards
from uavnav.config import ConfigError, TrainConfig

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


class Graph:
    """A pure function from tensors to a tuple of tensors, compiled: a graph for each shape, stride, type and device.

    `torch.compile` looks at every call whether the function's Python is still the same, which takes a small step as
    long as its arithmetic. Here nothing but tensors comes in, and nothing else is looked at: what the function reads
    elsewhere is as it was at the first call. It may write into what it is given. Graphs are kept on disk, as those of
    `torch.compile` are.

    Args:
        function: traceable by `make_fx` without values: no branches on data, no NumPy.
        options: inductor's.

    Raises:
        ConfigError: at the first call, of a function that is not.
    """

    def __init__(self, function: Callable[..., Sequence[Tensor]], **options: Any) -> None:
        self.function, self.options = function, options
        self._graphs: dict[Any, Callable[..., Sequence[Tensor]]] = {}

    @torch.no_grad()
    def __call__(self, *tensors: Tensor) -> Sequence[Tensor]:
        """Its outputs for these tensors."""
        key = tuple([(tensor.shape, tensor.stride(), tensor.dtype, tensor.device) for tensor in tensors])
        graph = self._graphs.get(key)
        if graph is None:
            graph = self._graphs[key] = self._compile(tensors)
        return graph(*tensors)

    def _compile(self, tensors: Sequence[Tensor]) -> Callable[..., Sequence[Tensor]]:
        given: list[Any] = [  # only what they are like: values are not looked at, and shared memory would be refused
            torch.empty_strided(tensor.shape, tensor.stride(), dtype=tensor.dtype, device=tensor.device)
            for tensor in tensors
        ]
        try:
            traced = make_fx(self.function, tracing_mode="fake", _allow_non_fake_inputs=True)(*given)
        except Exception as error:  # whatever an activation or a reward of the caller's raises
            raise ConfigError(
                f"no graph can be made ({_telling_line(error)}); activations and rewards are torch operations alone,"
                " without NumPy and branches on values: or give compile=off"
            ) from error
        graph: Callable[..., Sequence[Tensor]] = standalone_compile(
            traced,
            given,
            dynamic_shapes="from_example_inputs",
            options={"config_patches": self.options},
            donate_graph_module=True,
        )
        return graph


def decide(config: TrainConfig) -> bool:
    """Follow `compile=on` or `off`; with `auto`, compile runs long enough to pay for it where a compiler is at hand.

    Raises:
        ConfigError: `compile=on` where nothing can be compiled.
    """
    if not _wanted(config):
        return False
    problem = _problem(config.device)
    if problem and config.compile == "on":
        raise ConfigError(f"compile=on: no graph can be compiled here ({problem}); install g++ and Python's headers")
    if problem:
        warnings.warn(f"{EAGER}: {problem}", stacklevel=2)
    return problem is None


def flights(n_drones: int, max_steps: int) -> bool:
    """Whether to compile the world's step for an evaluation: a long one, where a compiler is at hand."""
    if n_drones * max_steps < FLIGHTS_PAY_FROM:
        return False
    return _problem("cpu") is None


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


def _problem(device: str) -> str | None:
    """Compile something tiny: what a compiler, its headers or a driver lack shows only when they are used."""
    logger = logging.getLogger("torch._inductor")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        torch._inductor.config.compile_threads = 1  # a pool of processes takes longer to start than these few kernels
        if torch._inductor.config.cpp.vec_isa_ok is None:
            torch._inductor.config.cpp.vec_isa_ok = True  # or ten processes are started to see what the next line shows
        Graph(lambda x: (x.exp(),))(torch.ones(64, device=device))
    except Exception as error:  # whatever the tool chain raises: the run goes on without it
        return _telling_line(error)
    finally:
        logger.setLevel(level)
    return None


def _telling_line(error: Exception) -> str:
    """Of a message of many: the compiler's own word where there is one, else the first that says more than who failed.

    >>> _telling_line(Exception("backend='inductor' raised:\\nCppCompileError: C++ compile error"))
    'CppCompileError: C++ compile error'
    """
    lines = [line.strip() for line in str(error).splitlines() if line.strip() and not line.endswith("raised:")]
    return next((line for line in lines if "error: " in line), lines[0] if lines else type(error).__name__)
