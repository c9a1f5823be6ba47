"""`uavnav export`: write a trained policy as ONNX or for torch.export.load."""

from __future__ import annotations

from collections.abc import Sequence

from uavnav import plugins
from uavnav.cli import commands
from uavnav.errors import ConfigError, complain
from uavnav.runs.export import export_policy
from uavnav.runs.policies import PolicyError, as_option, load_policy, zips
from uavnav.runs.tables import RunError


def main(argv: Sequence[str] | None = None) -> int:
    """Write a trained policy as ONNX (.onnx) or for torch.export.load (.pt2)."""
    arguments = commands.parse("export", argv)
    try:
        plugins.load(arguments.plugins)
        zips([arguments.run], arguments.activation)
        policy = load_policy(arguments.run, arguments.seed, activation=arguments.activation)
        path = export_policy(policy, arguments.out)
    except (ConfigError, PolicyError, RunError) as error:
        complain("export", as_option(error))
        return 2
    print(f"{path}: observation [N, {policy.task.observation_size}] -> values [N, {policy.world.n_actions}]")
    return 0
