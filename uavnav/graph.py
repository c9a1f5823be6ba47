"""Functions of tensors as compiled graphs. All that is private of PyTorch lies in this file.

`torch.compile` looks at every call whether the function's Python is still the same, which takes a small step as long as
its arithmetic. A `Graph` is traced once instead. Where a later PyTorch lacks these parts, `torch.compile` takes over.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
import torch._inductor.config
from torch import Tensor

from uavnav.choices import ConfigError

try:
    from torch._higher_order_ops.while_loop import while_loop_op
    from torch._inductor import standalone_compile
    from torch.fx.experimental.proxy_tensor import make_fx
except ImportError:  # torch.compile takes over
    make_fx = standalone_compile = while_loop_op = None  # type: ignore[assignment]

Tensors = Sequence[Tensor]
Function = Callable[..., Tensors]

SETTINGS: dict[str, Any] = {
    "compile_threads": 1,  # a pool of processes takes longer to start than these few kernels
    "cpp.vec_isa_ok": True,  # or ten processes are started to see what the first graph shows
    "unsafe_marked_cacheable_functions": {"torch.ops.higher_order.while_loop": "1"},  # loops are kept on disk too
}
"""Inductor's, while a graph is compiled; then it has its own again."""


class Graph:
    """A pure function from tensors to a tuple of tensors, compiled: a graph for each shape, stride, type and device.

    Whatever is not an argument is frozen at the first call. The function may write into its arguments. Graphs are kept
    on disk, as those of `torch.compile` are.

    Args:
        function: traceable without values: no branches on data, no NumPy.
        options: inductor's.

    Raises:
        ConfigError: at the first call, if the function cannot be traced.
    """

    def __init__(self, function: Function, **options: Any) -> None:
        self.function, self.options = function, options
        self._graphs: dict[Any, Function] = {}

    @torch.no_grad()
    def __call__(self, *tensors: Tensor) -> Tensors:
        """Its outputs for these tensors."""
        key = tuple([(tensor.shape, tensor.stride(), tensor.dtype, tensor.device) for tensor in tensors])
        graph = self._graphs.get(key)
        if graph is None:
            graph = self._graphs[key] = self._compile(tensors)
        return graph(*tensors)

    def _compile(self, tensors: Tensors) -> Function:
        with _settings():
            try:
                traced = self._traced(tensors)
            except _MissingError:
                return _left_to_torch(self.function)
            except Exception as error:  # whatever an activation or a reward of the caller's raises
                raise ConfigError(
                    f"no graph can be made ({telling_line(error)}); activations and rewards are torch operations alone,"
                    " without NumPy and branches on values: or give compile=off"
                ) from error
            return traced

    def _traced(self, tensors: Tensors) -> Function:
        return _compiled(self.function, tensors, self.options)


class Loop(Graph):
    """Updates of a state, one after the other, as one graph.

    Autograd cannot run inside a traced loop, so one update, backward included, is traced first and becomes its body.

    Args:
        update: (rate, *state, *constants, *batch) -> (found, *next state); `found` is one tensor.
        n_state, n_constants: how many tensors there are of either.
        options: inductor's.

    Call it with the rates of M updates [M, ...], the state, which is written in place, the constants, and the
    batches [A, M, ...]; it returns the mean of what the updates found.
    """

    def __init__(self, update: Function, n_state: int, n_constants: int, **options: Any) -> None:
        super().__init__(self._one_by_one, **options)
        self.update, self.n_state, self.n_constants = update, n_state, n_constants

    def _split(self, tensors: Tensors) -> tuple[Tensors, Tensors, Tensors]:
        first = self.n_state + self.n_constants
        return tensors[: self.n_state], tensors[self.n_state : first], tensors[first:]

    def _one_by_one(self, rates: Tensor, *tensors: Tensor) -> Tensors:
        state, constants, batches = self._split(tensors)
        total: list[Tensor] = []
        for index, rate in enumerate(rates):
            found, *following = self.update(rate, *state, *constants, *(batch[:, index] for batch in batches))
            total.append(found)
            for value, new in zip(state, following, strict=True):
                value.copy_(new)
        return (torch.stack(total).mean(0),)

    def _traced(self, tensors: Tensors) -> Function:
        if make_fx is None or while_loop_op is None:
            raise _MissingError
        rates, *others = tensors
        state, constants, batches = self._split(others)
        first = rates[0], *state, *constants, *(batch[:, 0] for batch in batches)
        update = make_fx(self.update)(*first)
        shape = update(*first)[0].shape

        def unfinished(index: Tensor, total: Tensor, *rest: Tensor) -> Tensor:
            return index < len(rest[self.n_state])

        def body(index: Tensor, total: Tensor, *rest: Tensor) -> tuple[Tensor, ...]:
            state, (rates, *others) = rest[: self.n_state], rest[self.n_state :]
            constants, batches = others[: self.n_constants], others[self.n_constants :]
            rate = rates.index_select(0, index[None]).squeeze(0)
            batch = [one.index_select(1, index[None]).squeeze(1) for one in batches]
            found, *following = update(rate, *state, *constants, *batch)
            return index + 1, total + found, *following

        def loop(rates: Tensor, *tensors: Tensor) -> tuple[Tensor]:
            state, others = tensors[: self.n_state], tensors[self.n_state :]
            index = torch.zeros((), dtype=torch.int64, device=rates.device)
            total = torch.zeros(shape, device=rates.device)
            _, total, *after = while_loop_op(unfinished, body, (index, total, *state), (rates, *others))  # type: ignore[arg-type]
            for value, new in zip(state, after, strict=True):
                value.copy_(new)
            return (total / len(rates),)

        return _compiled(loop, tensors, self.options)


class _MissingError(Exception):
    """This PyTorch has not what a graph is traced with, or has it in another form."""


def _compiled(function: Function, tensors: Tensors, options: dict[str, Any]) -> Function:
    """Trace a function and compile the trace."""
    given: list[Any] = [  # only what they are like: values are not looked at, and shared memory would be refused
        torch.empty_strided(tensor.shape, tensor.stride(), dtype=tensor.dtype, device=tensor.device)
        for tensor in tensors
    ]
    if make_fx is None or standalone_compile is None:
        raise _MissingError
    try:
        tracer = make_fx(function, tracing_mode="fake", _allow_non_fake_inputs=True)
    except TypeError as error:
        raise _MissingError from error
    traced = tracer(*given)
    try:
        graph: Function = standalone_compile(
            traced,
            given,
            dynamic_shapes="from_example_inputs",
            options={"config_patches": options},
            donate_graph_module=True,
        )
    except (TypeError, AttributeError, ImportError) as error:
        raise _MissingError from error
    return graph


def _left_to_torch(function: Function) -> Function:
    """The public way: checked at every call, and with breaks where it cannot trace."""
    compiled = torch.compile(function, dynamic=False)

    def run(*tensors: Tensor) -> Tensors:
        with _settings():
            return compiled(*tensors)

    return run


@contextlib.contextmanager
def _settings() -> Iterator[None]:
    """Inductor's own while a graph is compiled; afterwards the caller's are back."""
    with torch._inductor.config.patch(SETTINGS):
        yield


def problem(device: str) -> str | None:
    """Compile something tiny: what a compiler, its headers or a driver lack shows only when they are used."""
    logger = logging.getLogger("torch._inductor")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        Graph(lambda x: (x.exp(),))(torch.ones(64, device=device))
    except Exception as error:  # whatever the tool chain raises: the run goes on without it
        return telling_line(error.__cause__ or error)
    finally:
        logger.setLevel(level)
    return None


def telling_line(error: BaseException) -> str:
    """Of a message of many: the compiler's own word where there is one, else the first that says more than who failed.

    >>> telling_line(Exception("backend='inductor' raised:\\nCppCompileError: C++ compile error"))
    'CppCompileError: C++ compile error'
    """
    lines = [line.strip() for line in str(error).splitlines() if line.strip() and not line.endswith("raised:")]
    return next((line for line in lines if "error: " in line), lines[0] if lines else type(error).__name__)
