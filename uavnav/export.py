"""Write a trained policy for programs that know nothing of this package: ONNX, or torch.export's archive.

`python -m uavnav.export RUN [--seed S] --out policy.onnx` (or `policy.pt2`)

What is written maps `observation` [N, 30] float32 to `values` [N, 100]: PPO's logits or DQN's Q, whose largest is the
greedy action. Neither file holds a pickle of code, nor where it was written.
"""

from __future__ import annotations

import io
import json
import logging
import sys
import warnings
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor, nn

from uavnav.choices import Parser
from uavnav.networks import AgentLinear
from uavnav.policies import Policy, PolicyError, as_option, load_policy, zips
from uavnav.runs.tables import RunError, write
from uavnav.tasks.world import VERSION

SUFFIXES = (".onnx", ".pt2")
NEEDED = ("onnx", "onnxscript")
FACTS = "uavnav"
"""The key, in the file's metadata, of what its values are."""


def export_policy(policy: Policy, path: str | Path) -> Path:
    """Write a policy to a file whose suffix says how: `.onnx`, or `.pt2` for `torch.export.load`.

    Raises:
        PolicyError: another suffix, or ONNX's packages are not installed.
        RunError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise PolicyError(f"{path}: its suffix says what to write; choose from {', '.join(SUFFIXES)}")
    missing = [name for name in NEEDED if find_spec(name) is None]
    if path.suffix == ".onnx" and missing:
        raise PolicyError(f"{path}: {missing[0]} is not installed; pip install 'uavnav[onnx]'")
    program = _program(policy)
    facts = {
        "algorithm": policy.algorithm,
        "values": "logits" if policy.algorithm == "ppo" else "Q",
        "reward": policy.reward,
        "world_version": VERSION,
    }
    write(path, _onnx(program, facts) if path.suffix == ".onnx" else _pt2(program, facts))
    return path


def _program(policy: Policy) -> torch.export.ExportedProgram:
    """The policy's network as a graph over any number of rows."""
    layers = [_linear(layer) if isinstance(layer, AgentLinear) else layer for layer in policy.network.children()]
    rows = torch.zeros(2, policy.world.observation_size)
    shapes = ({0: torch.export.Dim("rows")},)
    program = torch.export.export(_Values(nn.Sequential(*layers)).eval(), (rows,), dynamic_shapes=shapes)
    for node in program.graph.nodes:
        for name in ("stack_trace", "nn_module_stack", "source_fn_stack", "from_node"):  # paths of this machine
            node.meta.pop(name, None)
    return program


class _Values(nn.Module):
    """Names the input."""

    def __init__(self, network: nn.Sequential) -> None:
        super().__init__()
        self.network = network

    def forward(self, observation: Tensor) -> Tensor:
        values: Tensor = self.network(observation)
        return values


def _linear(layer: AgentLinear) -> nn.Linear:
    """The one agent's layer as PyTorch's own."""
    _, inputs, outputs = layer.weight.shape
    result = nn.Linear(inputs, outputs)
    with torch.no_grad():
        result.weight.copy_(layer.weight[0].T)
        result.bias.copy_(layer.bias[0, 0])
    return result


def _pt2(program: torch.export.ExportedProgram, facts: dict[str, str]) -> bytes:
    buffer = io.BytesIO()
    torch.export.save(program, buffer, extra_files={f"{FACTS}.json": json.dumps(facts)})
    return buffer.getvalue()


def _onnx(program: torch.export.ExportedProgram, facts: dict[str, str]) -> bytes:
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)  # else it tells of each package that it could have used
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = torch.onnx.export(
                program, dynamo=True, verbose=False, input_names=["observation"], output_names=["values"]
            )
    finally:
        logger.setLevel(level)
    assert result is not None
    model = result.model_proto
    for part in (model.graph, *model.graph.node, *model.graph.value_info, *model.graph.input, *model.graph.output):
        part.ClearField("metadata_props")  # paths and names of this package's classes
    model.metadata_props.add(key=FACTS, value=json.dumps(facts))
    content: bytes = model.SerializeToString()
    return content


def main(argv: Sequence[str] | None = None) -> int:
    """Write a trained policy as ONNX (.onnx) or for torch.export.load (.pt2)."""
    parser = Parser(
        prog="python -m uavnav.export",
        description=main.__doc__,
        epilog="example: python -m uavnav.export runs/ppo/relu --out policy.onnx",
    )
    parser.add_argument("run", metavar="RUN", help="a run's folder, its policy file, or a zip of Stable-Baselines3")
    parser.add_argument("--seed", type=int, help="which training seed (default: the first)")
    parser.add_argument("--activation", help="of a .zip's hidden layers, which its weights do not tell")
    parser.add_argument("--out", required=True, metavar="FILE", help="policy.onnx or policy.pt2")
    arguments = parser.parse_args(argv)
    try:
        zips([arguments.run], arguments.activation)
        policy = load_policy(arguments.run, arguments.seed, activation=arguments.activation)
        path = export_policy(policy, arguments.out)
    except (PolicyError, RunError) as error:
        print(f"uavnav.export: {as_option(error)}", file=sys.stderr)
        return 2
    print(f"{path}: observation [N, {policy.world.observation_size}] -> values [N, {policy.world.n_actions}]")
    return 0


if __name__ == "__main__":
    sys.exit(main())
