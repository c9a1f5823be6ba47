"""Write a trained policy for programs that know nothing of this package: ONNX, or torch.export's archive.

`uavnav export RUN [--seed S] --out policy.onnx` (or `policy.pt2`)

What is written maps `observation` [N, 30] float32 to `values` [N, 100]: logits or Q values, whose largest is
the greedy action. The file's metadata say which, how the policy acted in training, and in which task. Neither
file contains a pickle of code, nor where it was written.
"""

from __future__ import annotations

import io
import json
import logging
import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import nn

from uavnav.acting import Values
from uavnav.algorithms import ALGORITHMS
from uavnav.errors import choose_from
from uavnav.networks import AgentLinear
from uavnav.runs.policies import Policy, PolicyError
from uavnav.runs.tables import write
from uavnav.tasks.table import header
from uavnav.tasks.world import VERSION

SUFFIXES = (".onnx", ".pt2")
NEEDED = ("onnx", "onnxscript")
FACTS = "uavnav"  # the key, in the file's metadata, of what its values are


def export_policy(policy: Policy, path: str | Path) -> Path:
    """Write a policy to a file whose suffix says how: `.onnx`, or `.pt2` for `torch.export.load`.

    Raises:
        PolicyError: another suffix, or ONNX's packages are not installed.
        RunError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise PolicyError(f"{path}: its suffix says what to write; {choose_from(path.suffix, SUFFIXES)}")
    missing = [name for name in NEEDED if find_spec(name) is None]
    if path.suffix == ".onnx" and missing:
        raise PolicyError(f"{path}: {missing[0]} is not installed; pip install 'uavnav[onnx]'")
    program = _program(policy)
    facts = {
        "algorithm": policy.algorithm,
        "values": ALGORITHMS[policy.algorithm].values,
        "acts": policy.acts,
        "epsilon": policy.epsilon,
        **header(policy.task),
        "layouts": policy.layouts,
        "world_version": VERSION,
    }
    write(path, _onnx(program, facts) if path.suffix == ".onnx" else _pt2(program, facts))
    return path


def _program(policy: Policy) -> torch.export.ExportedProgram:
    """The policy's network as a graph over any number of rows."""
    layers = [_alone(layer) for layer in policy.network.children()]
    rows = torch.zeros(2, policy.task.observation_size)
    shapes = ({0: torch.export.Dim("rows")},)
    program = torch.export.export(
        Values(nn.Sequential(*layers), policy.head).eval(), (rows,), dynamic_shapes=shapes
    )
    for node in program.graph.nodes:
        # they contain paths of this machine
        for name in ("stack_trace", "nn_module_stack", "source_fn_stack", "from_node"):
            node.meta.pop(name, None)
    return program


def _alone(layer: nn.Module) -> nn.Module:
    """The one agent's layer [N, ...] -> [N, ...]; a linear one as PyTorch's own, and a function as it is."""
    if not isinstance(layer, AgentLinear):
        learns = any(True for _ in layer.parameters())
        return nn.Sequential(nn.Unflatten(0, (1, -1)), layer, nn.Flatten(0, 1)) if learns else layer
    result = nn.Linear(*layer.weight.shape[1:])
    result.load_state_dict({"weight": layer.weight[0].T, "bias": layer.bias[0, 0]})
    return result


def _pt2(program: torch.export.ExportedProgram, facts: dict[str, Any]) -> bytes:
    buffer = io.BytesIO()
    torch.export.save(program, buffer, extra_files={f"{FACTS}.json": json.dumps(facts)})
    return buffer.getvalue()


def _onnx(program: torch.export.ExportedProgram, facts: dict[str, Any]) -> bytes:
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)  # else it tells of each package that it could have used
    try:
        with warnings.catch_warnings(action="ignore"):
            result = torch.onnx.export(
                program, dynamo=True, verbose=False, input_names=["observation"], output_names=["values"]
            )
    finally:
        logger.setLevel(level)
    assert result is not None
    model = result.model_proto
    for part in (
        model.graph,
        *model.graph.node,
        *model.graph.value_info,
        *model.graph.input,
        *model.graph.output,
    ):
        part.ClearField("metadata_props")  # paths and names of this package's classes
    model.metadata_props.add(key=FACTS, value=json.dumps(facts))
    return bytes(model.SerializeToString())
