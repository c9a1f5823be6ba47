"""`uavnav export`: write a trained policy as ONNX or for torch.export.load."""

from __future__ import annotations

import os
from argparse import Namespace
from pathlib import Path

from uavnav.errors import ConfigError
from uavnav.files import check_out
from uavnav.runs.export import export_policy
from uavnav.runs.policies import load_policy, zips
from uavnav.tasks.protocol import SCRIPTED


def main(arguments: Namespace) -> int:
    if arguments.run in SCRIPTED and not os.path.exists(arguments.run):
        raise ConfigError(f"{arguments.run}: a scripted policy has no network; give a trained one")
    check_out(path := Path(arguments.out))
    zips([arguments.run], arguments.activation)
    policy = load_policy(arguments.run, arguments.seed, activation=arguments.activation)
    path.parent.mkdir(parents=True, exist_ok=True)
    export_policy(policy, path)
    print(f"{path}: observation [N, {policy.task.observation_size}] -> values [N, {policy.world.n_actions}]")
    return 0
