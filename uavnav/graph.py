"""Functions of tensors as compiled graphs. Only this file uses private parts of PyTorch.

`torch.compile` checks at every call whether the function's Python has changed. For a small step, this check
takes as long as the arithmetic, so a `Graph` is traced once instead. `pyproject.toml` pins the PyTorch whose
private parts these are.
"""

from __future__ import annotations

import itertools
import logging
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
import torch._inductor.config
from torch import Tensor, fx
from torch._functorch.compile_utils import fx_graph_cse
from torch._higher_order_ops.scan import scan_op
from torch._higher_order_ops.while_loop import while_loop_op
from torch._inductor import standalone_compile
from torch.fx.experimental.proxy_tensor import make_fx

from uavnav.errors import ConfigError, telling_line

Tensors = Sequence[Tensor]
Function = Callable[..., Tensors]

SETTINGS: dict[str, Any] = {
    "compile_threads": 1,  # these few kernels compile faster than a pool of processes starts
    "cpp_wrapper_build_separate": True,  # what calls the kernels needs no -O3, which takes half the time
    "cpp.vec_isa_ok": True,  # else inductor starts ten processes to test what the first graph shows
    "unsafe_marked_cacheable_functions": {  # keep loops on disk too
        f"torch.ops.higher_order.{loop}": "1" for loop in ("while_loop", "scan")
    },
}
"""Inductor's settings while a graph is compiled; afterwards the caller's settings are restored."""


class Graph:
    """A compiled function from tensors to a tuple of tensors, with one graph per shape, stride, type and
    device.

    Whatever is not an argument is frozen at the first call. The function may write into its arguments. Graphs
    are kept on disk, like those of `torch.compile`.

    Args:
        function: only torch operations, without branches on values and without NumPy.
        options: inductor's options.

    Raises:
        ConfigError: at the first call, if the function cannot be traced.
    """

    def __init__(self, function: Function, **options: Any) -> None:
        self.function, self.options = function, options
        self._graphs: dict[Any, Function] = {}

    @torch.no_grad()
    def __call__(self, *tensors: Tensor) -> Tensors:
        """The function's outputs for these tensors."""
        key = tuple([(tensor.shape, tensor.stride(), tensor.dtype, tensor.device) for tensor in tensors])
        graph = self._graphs.get(key)
        if graph is None:
            graph = self._graphs[key] = self._compile(tensors)
        return graph(*tensors)

    def _compile(self, tensors: Tensors) -> Function:
        with torch._inductor.config.patch(SETTINGS):
            try:
                return self._traced(tensors)
            except Exception as error:  # a caller's activation or reward may raise any kind
                raise ConfigError(
                    f"no graph can be made ({telling_line(error)}); activations and rewards are only torch "
                    "operations, without NumPy and branches on values: or give compile=off"
                ) from error

    def _traced(self, tensors: Tensors) -> Function:
        return _compiled(self.function, tensors, self.options)


def parts(tensors: Tensors, *numbers: int) -> list[Tensors]:
    """So many tensors in turn, and the rest."""
    ends = [0, *itertools.accumulate(numbers), None]
    return [tensors[begin:end] for begin, end in itertools.pairwise(ends)]


class Scan(Graph):
    """Successive steps of a state, each with inputs and outputs of its own, as one graph.

    Args:
        step: (*state, *inputs, *constants) -> (*next state, *outputs).
        n_state, n_inputs: numbers of tensors in the state and in the inputs.
        time: the dimension of T in an output.
        strict: raise a ConfigError where this is no graph, instead of running steps one by one.
        options: inductor's options.

    Call: (*state, *inputs [T, ...] of T steps, *constants) -> (*state after them, *outputs [..., T, ...]).
    """

    def __init__(
        self,
        step: Function,
        n_state: int,
        n_inputs: int,
        time: int = 0,
        strict: bool = False,
        **options: Any,
    ) -> None:
        super().__init__(step, **options)
        self.n_state, self.n_inputs, self.time, self.strict = n_state, n_inputs, time, strict
        self.whole = True  # no steps had to run one by one

    def _compile(self, tensors: Tensors) -> Function:
        try:
            return super()._compile(tensors)
        except ConfigError as error:
            if self.strict:
                raise
            graph, why = self._one_by_one(tensors), telling_line(error.__cause__ or error)
            warnings.warn(f"steps run one by one, slower ({why})", stacklevel=2)
            self.whole = False
            return graph

    def _traced(self, tensors: Tensors) -> Function:
        steps, frozen = self.within(tensors)
        graph = _compiled(steps, (*tensors, *frozen), self.options)
        return lambda *tensors: graph(*tensors, *frozen)

    def within(self, tensors: Tensors) -> tuple[Function, Tensors]:
        """All steps as a function that is part of another graph, and what it takes behind such tensors."""
        state, inputs, constants = parts(tensors, self.n_state, self.n_inputs)
        first = *state, *(each[0] for each in inputs), *constants

        def apart(*tensors: Tensor) -> Tensors:  # a scan has no two names for one tensor
            known, found = {id(tensor) for tensor in tensors}, []
            for tensor in self.function(*tensors):
                found.append(tensor.clone() if id(tensor) in known else tensor)
                known.add(id(tensor))
            return found

        step, frozen = _lifted(_trace(apart, first))

        def steps(*tensors: Tensor) -> Tensors:
            state, inputs, constants = parts(tensors, self.n_state, self.n_inputs)
            found = scan_op(step, [*state], [*inputs], constants)
            return *found[: self.n_state], *(each.movedim(0, self.time) for each in found[self.n_state :])

        return steps, frozen

    def _one_by_one(self, tensors: Tensors) -> Function:
        """One call a step; raises a ConfigError where a step cannot be traced either."""
        step = Graph(self.function)

        def steps(*tensors: Tensor) -> Tensors:
            state, inputs, constants = parts(tensors, self.n_state, self.n_inputs)
            outputs = []
            for each in zip(*inputs, strict=True):
                found = step(*state, *each, *constants)
                state = found[: self.n_state]
                outputs.append(found[self.n_state :])
            return *state, *(torch.stack(each, self.time) for each in zip(*outputs, strict=True))

        steps(*tensors)
        return steps


class Loop(Graph):
    """Successive updates of a state, as one graph.

    Autograd cannot run inside a traced loop, so one update, backward included, is traced first and becomes
    its body.

    Args:
        update: (rate, *state, *constants, *batch) -> (found, *next state); `found` is one tensor.
        n_state, n_constants: numbers of tensors in the state and in the constants.
        options: inductor's options.

    Call: (rates [M, ...] of M updates, *state, *constants, *batches [A, M, ...]) -> (mean of `found`,). The
    state is updated in place.
    """

    def __init__(self, update: Function, n_state: int, n_constants: int, **options: Any) -> None:
        super().__init__(update, **options)
        self.n_state, self.n_constants = n_state, n_constants

    def _traced(self, tensors: Tensors) -> Function:
        updates = self.within(tensors)

        def loop(*tensors: Tensor) -> tuple[Tensor]:
            found, *after = updates(*tensors)
            for value, new in zip(tensors[1 : 1 + self.n_state], after, strict=True):
                value.copy_(new)
            return (found,)

        return _compiled(loop, tensors, self.options)

    def within(self, tensors: Tensors) -> Function:
        """All updates as a function that is part of another graph: -> (mean of `found`, *next state)."""
        (rates,), state, constants, batches = parts(tensors, 1, self.n_state, self.n_constants)
        first = rates[0], *state, *constants, *(batch[:, 0] for batch in batches)
        update = _each_once(make_fx(self.function)(*first))
        shape = update(*first)[0].shape

        def unfinished(index: Tensor, total: Tensor, *rest: Tensor) -> Tensor:
            return index < len(rest[self.n_state])

        def body(index: Tensor, total: Tensor, *rest: Tensor) -> tuple[Tensor, ...]:
            state, (rates,), constants, batches = parts(rest, self.n_state, 1, self.n_constants)
            rate = rates.index_select(0, index[None]).squeeze(0)
            batch = [one.index_select(1, index[None]).squeeze(1) for one in batches]
            found, *following = update(rate, *state, *constants, *batch)
            return index + 1, total + found, *following

        def updates(rates: Tensor, *tensors: Tensor) -> Tensors:
            state, others = parts(tensors, self.n_state)
            index = torch.zeros((), dtype=torch.int64, device=rates.device)
            total = torch.zeros(shape, device=rates.device)
            if len(rates) == 1:  # a loop would carry the state through copies
                _, total, *after = body(index, total, *state, rates, *others)
            else:
                given: Any = (index, total, *state), (rates, *others)
                _, total, *after = while_loop_op(unfinished, body, *given)
            return total / len(rates), *after

        return updates


def _each_once(traced: fx.GraphModule) -> fx.GraphModule:
    """The same trace without repeated calls: two terms of a loss may ask one network for the same values.

    One that writes in place stays as it is: what is called twice could then be two places to write.
    """
    calls = traced.graph.nodes
    operators = [call.target for call in calls if isinstance(call.target, torch._ops.OpOverload)]
    if any(operator._schema.is_mutable for operator in operators):
        return traced
    for call in traced.graph.find_nodes(op="call_function", target=torch.ops.aten.detach.default):
        # autograd is done: a weight and the same one detached are one
        call.replace_all_uses_with(call.args[0])
        traced.graph.erase_node(call)
    return fx.GraphModule(traced, fx_graph_cse(traced.graph))


def _lifted(traced: fx.GraphModule) -> tuple[fx.GraphModule, Tensors]:
    """The same trace with the tensors that its function closes over as further arguments, and these."""
    calls, frozen = traced.graph, dict[str, fx.Node]()
    last = calls.find_nodes(op="placeholder")[-1]
    for node in calls.find_nodes(op="get_attr"):
        if not isinstance(getattr(traced, node.target), Tensor):
            continue  # the body of a loop within
        if node.target not in frozen:
            with calls.inserting_after(last):
                last = calls.placeholder(f"frozen_{len(frozen)}")
            frozen[node.target] = last
        node.replace_all_uses_with(frozen[node.target])
        calls.erase_node(node)
    return fx.GraphModule(traced, calls), [getattr(traced, name) for name in frozen]


def _trace(function: Function, tensors: Tensors) -> fx.GraphModule:
    """Its calls of torch, by what stands for tensors and has no values: it may ask whether it is traced."""
    return make_fx(function, tracing_mode="fake", _allow_non_fake_inputs=True)(*tensors)


def _compiled(function: Function, tensors: Tensors, options: dict[str, Any]) -> Function:
    """Trace a function and compile the trace."""
    given: list[Any] = [  # without values: tracing needs none, and refuses shared memory
        torch.empty_strided(tensor.shape, tensor.stride(), dtype=tensor.dtype, device=tensor.device)
        for tensor in tensors
    ]
    graph: Function = standalone_compile(
        _trace(function, given),
        given,
        dynamic_shapes="from_example_inputs",
        options={"config_patches": options},
        donate_graph_module=True,
    )
    return graph


def problem(device: str) -> str | None:
    """Why no graph can be compiled on a device, found by compiling a tiny one; None if compilation works."""
    logger = logging.getLogger("torch._inductor")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        on_cpu = torch.device(device).type == "cpu"
        Graph(lambda x: (x.exp(),), cpp_wrapper=on_cpu)(torch.ones(64, device=device))
    except Exception as error:  # the tool chain may raise any kind; the run continues uncompiled
        return telling_line(error.__cause__ or error)
    finally:
        logger.setLevel(level)
    return None
