"""`uavnav export`: write a trained policy as ONNX or for torch.export.load."""

from __future__ import annotations

from argparse import Namespace

from uavnav.runs.export import export_policy
from uavnav.runs.policies import load_policy, zips


def main(arguments: Namespace) -> int:
    zips([arguments.run], arguments.activation)
    policy = load_policy(arguments.run, arguments.seed, activation=arguments.activation)
    path = export_policy(policy, arguments.out)
    print(f"{path}: observation [N, {policy.task.observation_size}] -> values [N, {policy.world.n_actions}]")
    return 0
