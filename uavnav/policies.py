"""A trained policy as one thing to call: load it, ask it for actions or for the numbers behind them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from uavnav.networks import ACTIVATIONS, mlp
from uavnav.sampling import epsilon_greedy, sample_categorical
from uavnav.world import VERSION

FILE_NAME = "policy.safetensors"


class PolicyError(ValueError):
    """A policy cannot be found, read or trusted; the message says what is wrong and what would be right."""


class Policy:
    """One seed's network with a way to act: greedy, or as in training (PPO samples, DQN explores with `epsilon`)."""

    def __init__(self, network: nn.Module, algorithm: str, greedy: bool, epsilon: float) -> None:
        self.network = network
        self.algorithm = algorithm
        self.greedy = greedy
        self.epsilon = epsilon

    @torch.no_grad()
    def values(self, observation: Tensor) -> Tensor:
        """What the network says of each action: observation [..., 30] -> logits (PPO) or Q (DQN) [..., 100]."""
        result: Tensor = self.network(observation[None])[0]
        return result

    def __call__(self, observation: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """An action for each row: observation [..., 30] -> int64 [...]; `generator` is used unless greedy."""
        values = self.values(observation)
        if self.greedy:
            return values.argmax(-1)
        shape = values.shape[:-1]
        if self.algorithm == "ppo":
            return sample_categorical(values, torch.rand(shape, generator=generator).to(values.device))
        coin, choice = torch.rand((2, *shape), generator=generator).to(values.device)
        return epsilon_greedy(values, self.epsilon, coin, choice)


def serialize(networks: Mapping[str, nn.Module], facts: Mapping[str, Any]) -> bytes:
    """The bytes of a policy file: the networks of all seeds, and the facts that rebuild them as its header.

    facts: algorithm, activation, hidden, seeds and, for DQN, epsilon.
    """
    tensors = {
        f"{name}.{key}": value.detach().cpu().contiguous()
        for name, network in networks.items()
        for key, value in network.state_dict().items()
    }
    return save(tensors, metadata={"uavnav": json.dumps({"world_version": VERSION, **facts}, sort_keys=True)})


def load_policy(run: str | Path, seed: int | None = None, greedy: bool = True) -> Policy:
    """The policy of one seed of a run's folder (or of its policy.safetensors); nothing is unpickled or executed.

    Args:
        run: a run's folder, or its policy file.
        seed: which training seed; the first one if None.
        greedy: the best action always, or as in training: PPO samples, DQN explores with its final epsilon.

    Raises:
        PolicyError: the file is missing or damaged, or has no such seed.
    """
    path = Path(run)
    path = path / FILE_NAME if path.is_dir() else path
    if not path.is_file():
        raise PolicyError(f"{run}: no {FILE_NAME} there; give the folder of a finished run")
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {}).get("uavnav", "{}"))
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        seeds, hidden, algorithm = header["seeds"], header["hidden"], header["algorithm"]
        activation, version = header["activation"], header["world_version"]
    except (OSError, SafetensorError, ValueError, KeyError) as error:
        raise PolicyError(f"{path}: not a readable policy file ({error})") from error
    if version != VERSION:
        raise PolicyError(f"{path}: trained in world version {version}, this is {VERSION}")
    if activation not in ACTIVATIONS:
        raise PolicyError(f"{path}: unknown activation {activation!r}; choose from {', '.join(sorted(ACTIVATIONS))}")
    seed = seeds[0] if seed is None else seed
    if seed not in seeds:
        raise PolicyError(f"{path}: seed={seed} is not there; choose from {seeds[0]} ... {seeds[-1]}")
    agent = seeds.index(seed)
    policy = {
        key.removeprefix("policy."): tensor[agent : agent + 1]
        for key, tensor in tensors.items()
        if key.startswith("policy.")
    }
    try:
        inputs, outputs = policy["0.weight"].shape[1], policy[f"{2 * len(hidden)}.weight"].shape[2]
        network = mlp([inputs, *hidden, outputs], activation, [torch.Generator()], "default")
        network.load_state_dict(policy)
    except (KeyError, IndexError, RuntimeError) as error:
        raise PolicyError(f"{path}: its tensors do not fit its header") from error
    return Policy(network, algorithm, greedy, header.get("epsilon", 0.0))
