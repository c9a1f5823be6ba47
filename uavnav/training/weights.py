"""The file of a run's policies: the networks of all seeds, and what rebuilds them. `uavnav.policies` reads it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import nn

from uavnav.tasks.world import VERSION
from uavnav.training.config import SWITCHES, TrainConfig


def serialize(networks: Mapping[str, nn.Module], algorithm: str, config: TrainConfig, epsilon: float = 0.0) -> bytes:
    """The bytes of a policy file: the networks of all seeds, and in its header what rebuilds them and their world."""
    facts = {
        "algorithm": algorithm,
        "activation": config.activation,
        "hidden": list(config.hidden),
        "seeds": config.seeds,
        "epsilon": epsilon,
        "reward": config.reward,
        "world": {name: getattr(config, name) for name in SWITCHES},
        "world_version": VERSION,
    }
    tensors = {
        f"{name}.{key}": value.detach().cpu().contiguous()
        for name, network in networks.items()
        for key, value in network.state_dict().items()
    }
    return save(tensors, metadata={"uavnav": json.dumps(facts, sort_keys=True)})


def join(paths: Sequence[Path]) -> bytes:
    """The bytes of one policy file from those of runs that differ in nothing but their seeds, in that order."""
    parts, seeds = [], []
    for path in paths:
        with safe_open(path, framework="pt") as file:
            facts = json.loads(file.metadata()["uavnav"])
            parts.append({key: file.get_tensor(key) for key in file.keys()})  # noqa: SIM118
        seeds += facts["seeds"]
    tensors = {key: torch.cat([part[key] for part in parts]) for key in parts[0]}
    return save(tensors, metadata={"uavnav": json.dumps(facts | {"seeds": seeds}, sort_keys=True)})
