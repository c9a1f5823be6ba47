"""A trained policy as one thing to call: load it, ask it for actions or for the numbers behind them."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from uavnav.config import SWITCHES, TrainConfig
from uavnav.networks import ACTIVATIONS, mlp
from uavnav.rewards import REWARDS
from uavnav.sampling import epsilon_greedy, sample_categorical
from uavnav.world import VERSION, World

FILE_NAME = "policy.safetensors"
ALGORITHMS = ("ppo", "dqn")


class PolicyError(ValueError):
    """A policy cannot be found, read or trusted; the message says what is wrong and what would be right."""


class Policy:
    """One seed's network with a way to act: greedy, or as in training (PPO samples, DQN explores with `epsilon`).

    `world` and `reward` are those that it was trained in.
    """

    def __init__(
        self, network: nn.Module, algorithm: str, greedy: bool, epsilon: float, world: World, reward: str
    ) -> None:
        self.network = network
        self.algorithm = algorithm
        self.greedy = greedy
        self.epsilon = epsilon
        self.world = world
        self.reward = reward

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
    path = path / FILE_NAME if os.path.isdir(path) else path
    if not os.path.isfile(path):  # as Path.is_file, which raises for a name that is too long
        raise PolicyError(f"{run}: no {FILE_NAME} there; give the folder of a finished run")
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {}).get("uavnav", "{}"))
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        seeds, hidden, algorithm = list(header["seeds"]), list(header["hidden"]), str(header["algorithm"])
        activation, version, reward = header["activation"], header["world_version"], header["reward"]
        epsilon, world = float(header["epsilon"]), World(**header["world"])
        if not all(type(one) is int for one in seeds):
            raise TypeError("its seeds are no whole numbers")
    except (OSError, SafetensorError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise PolicyError(f"{path}: not a readable policy file ({error}); give the one of a finished run") from error
    if version != VERSION:
        raise PolicyError(f"{path}: trained in world version {version}, this is {VERSION}")
    for name, value, choices in (
        ("activation", activation, ACTIVATIONS),
        ("reward", reward, REWARDS),
        ("algorithm", algorithm, ALGORITHMS),
    ):
        if value not in list(choices):
            raise PolicyError(f"{path}: unknown {name} {value!r}; choose from {', '.join(sorted(choices))}")
    if not seeds:
        raise PolicyError(f"{path}: holds no seed; give the policy of a finished run")
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
        if any(len(tensor) != len(seeds) for tensor in tensors.values()):
            raise RuntimeError(f"not {len(seeds)} networks for {len(seeds)} seeds")
    except (KeyError, IndexError, RuntimeError, TypeError) as error:
        raise PolicyError(f"{path}: its tensors do not fit its header; give the one of a finished run") from error
    if inputs != world.observation_size or outputs != world.n_actions:
        raise PolicyError(
            f"{path}: sees {inputs} numbers and chooses from {outputs} actions, not"
            f" {world.observation_size} and {world.n_actions} as in this world"
        )
    for key, tensor in policy.items():
        if not tensor.isfinite().all():
            raise PolicyError(f"{path}: policy.{key} of seed {seed} is not finite, it diverged; train with a lower lr")
    return Policy(network, algorithm, greedy, epsilon, world, reward)
