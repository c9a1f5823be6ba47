"""The file of a run's policies: the networks of all seeds, and what rebuilds them in `runs.policies`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from safetensors.torch import save
from torch import nn

from uavnav import plugins
from uavnav.acting import Actor
from uavnav.errors import ConfigError
from uavnav.networks import mlp, shapes
from uavnav.tasks import tensors
from uavnav.tasks.table import header
from uavnav.tasks.world import VERSION
from uavnav.training.config import TrainConfig


def check(networks: Mapping[str, nn.Module], config: TrainConfig) -> None:
    """Raise a ConfigError where `uavnav.runs.policies` could not build the network that acts again."""
    needed = f"algorithm={config.algorithm}: networks() must give policy, made by uavnav.networks.mlp"
    if "policy" not in networks:
        raise ConfigError(f"{needed}; it gives {', '.join(networks)}")
    own = shapes(networks["policy"].state_dict())
    last = own.get(f"{2 * len(config.hidden)}.weight", torch.Size([0, 0]))
    sizes = [config.observation_size, *config.hidden, last[-1]]
    if own != shapes(mlp(sizes, config.activation, [], "default").state_dict()):
        raise ConfigError(f"{needed} of hidden={list(config.hidden)}; its tensors are others")


def serialize(networks: Mapping[str, nn.Module], config: TrainConfig, actor: Actor) -> bytes:
    """The bytes of a policy file: all seeds' networks; its header has what rebuilds them, and their task."""
    facts = {
        "algorithm": config.algorithm,
        "activation": config.activation,
        "hidden": list(config.hidden),
        "layer_norm": config.layer_norm,
        "seeds": config.seeds,
        "acts": actor.acts,
        "head": actor.head,
        "epsilon": config.final_epsilon,
        **header(config.make_task()),
        "world_version": VERSION,
        **({"plugins": list(plugins.LOADED)} if plugins.LOADED else {}),
    }
    found = {
        f"{name}.{key}": value.detach().cpu().contiguous()
        for name, network in networks.items()
        for key, value in network.state_dict().items()
    }
    return save(found, metadata={"uavnav": json.dumps(facts, sort_keys=True)})


def join(paths: Sequence[Path]) -> bytes:
    """The bytes of one policy file from those of runs that differ only in their seeds, in that order."""
    parts, seeds = [], []
    for path in paths:
        found, header = tensors.read(path)
        facts = json.loads(header["uavnav"])
        parts.append(found)
        seeds += facts["seeds"]
    joined = {key: torch.cat([part[key] for part in parts]) for key in parts[0]}
    return save(joined, metadata={"uavnav": json.dumps(facts | {"seeds": seeds}, sort_keys=True)})
