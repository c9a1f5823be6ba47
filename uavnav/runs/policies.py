"""A trained policy as one thing to call: load it, ask it for actions or for the numbers behind them."""

from __future__ import annotations

import io
import os
import pickle
import re
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, overload

import numpy as np
import numpy.typing as npt
import torch
from pydantic import Field
from torch import Tensor, nn

from uavnav import files, plugins
from uavnav.acting import ACTS, HEADS, SHOWN, values_of
from uavnav.algorithms import ALGORITHMS
from uavnav.errors import OneLineError, choose_from
from uavnav.networks import ACTIVATIONS, mlp, shapes
from uavnav.runs import MOST_SEEDS, POLICY, read_settings, runs_below, shipped
from uavnav.runs.metrics import MODES
from uavnav.runs.tables import RunError
from uavnav.tasks import tensors as safe
from uavnav.tasks.rewards import REWARDS
from uavnav.tasks.shield import shield
from uavnav.tasks.table import EMPTY, TASKS, make_task
from uavnav.tasks.world import VERSION, World
from uavnav.tasks.wrapper import WrappedTask

Actions = np.ndarray[Any, np.dtype[np.int64]]

SB3_WEIGHTS, SB3_SETTINGS = "policy.pth", "data"
SB3_MAX_BYTES = 2**26  # of a zip's weights, unpacked: a network of 64-64 has a hundred thousand
SB3_EPSILON = 0.05  # the final epsilon by default, Stable-Baselines3's and ours: a zip's weights do not tell


class PolicyError(OneLineError, ValueError):
    """A policy cannot be found, read or trusted; the message says what is wrong and what would be right."""


class Diverged(PolicyError):
    """A policy's weights are not finite."""


class Header(files.Facts):
    """What a policy file says of its networks."""

    algorithm: str
    activation: str
    hidden: Annotated[list[Annotated[int, Field(ge=1)]], Field(min_length=1, max_length=100)]
    seeds: Annotated[list[Annotated[int, Field(ge=0)]], Field(max_length=MOST_SEEDS)]
    epsilon: Annotated[float, Field(ge=0, le=1)]
    world_version: str
    world: dict[str, Any]
    reward: str
    task: str = "drone"
    max_steps: int | None = None
    stack: int = 1
    faults: dict[str, Any] = Field(default_factory=dict)
    layer_norm: bool = False
    acts: str | None = None  # files of earlier versions do not say
    head: Annotated[str, Field(max_length=100)] | None = None
    layouts: str | None = None
    plugins: list[str] = Field(default_factory=list)


@dataclass(frozen=True, eq=False)
class Policy:
    """One seed's network with a way to act: greedy, or as in training."""

    network: nn.Module
    algorithm: str
    greedy: bool
    task: WrappedTask  # that it was trained in, without the split
    acts: str  # in training: a name of `uavnav.acting.ACTS`
    head: str  # how outputs become one number an action: a name of `HEADS` there, with its numbers
    epsilon: float = 0.0  # the share of random actions, where its way to act has one
    seed: int = 0  # that it was trained with
    layouts: str | None = None  # SHA-256 of the split that it was trained on
    under_shield: bool = False  # whether its actions go through `tasks.shield`

    @property
    def world(self) -> World:
        """The `World` that it was trained in."""
        return self.task.world

    @property
    def reward(self) -> str:
        """The reward that it was trained with."""
        return self.task.task.reward

    @property
    def mode(self) -> str:
        """How it flies: `greedy` or `sampled`."""
        return "greedy" if self.greedy else "sampled"

    @torch.no_grad()
    def values(self, observation: Tensor) -> Tensor:
        """One number an action, such as logits or Q: observation [..., 30] -> [..., 100]."""
        return self.of_agents(observation[None])[0]

    def of_agents(self, observation: Tensor) -> Tensor:
        """The same of a network with several agents: observation [A, ..., 30] -> [A, ..., 100]."""
        return values_of(self.head, self.network(observation))

    @overload
    def __call__(self, observation: Tensor, generator: torch.Generator | None = None) -> Tensor: ...

    @overload
    def __call__(self, observation: npt.ArrayLike, generator: torch.Generator | None = None) -> Actions: ...

    def __call__(self, observation: Any, generator: torch.Generator | None = None) -> Any:
        """An action for each row: observation [..., 30] -> int64 [...]; `generator` is used unless greedy.

        A tensor gives a tensor; a NumPy array or a list gives a NumPy array.
        """
        if isinstance(observation, Tensor):
            return self.kept_safe(self.act(self.values(observation), generator), observation)
        rows = torch.from_numpy(np.array(observation, dtype=np.float32))
        if rows.shape[-1:] != (self.task.observation_size,):
            raise PolicyError(
                f"observation of shape {list(rows.shape)}; give [..., {self.task.observation_size}]"
            )
        return self(rows, generator).numpy()

    def shielded(self) -> Policy:
        """The same policy under the shield: the nearest action that cannot collide in the next step."""
        return replace(self, under_shield=True)

    def kept_safe(self, action: Tensor, observation: Tensor) -> Tensor:
        """Its actions [...] as it executes them: through the shield, where it is under one."""
        return shield(action, observation, self.world) if self.under_shield else action

    def act(self, values: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """An action for each row of what `values` gives: [..., 100] -> int64 [...]."""
        return self.choose(values, self.draw(values.shape[:-1], generator))

    def draw(self, shape: Sequence[int], generator: torch.Generator | None = None) -> Tensor:
        """The random numbers of as many actions: [numbers an action, *shape]; none if greedy."""
        return torch.rand((0 if self.greedy else ACTS[self.acts].uniforms, *shape), generator=generator)

    def choose(self, values: Tensor, uniforms: Tensor) -> Tensor:
        """An action for each row of what `values` gives, by what `draw` drew: [..., 100] -> int64 [...]."""
        if self.greedy:
            return values.argmax(-1)
        return ACTS[self.acts].choose(values, self.epsilon, uniforms.to(values.device).unbind())

    def shown(self, values: Tensor) -> Tensor:
        """What a picture shows of `values` [..., 100], which `ALGORITHMS` names."""
        return SHOWN[ALGORITHMS[self.algorithm].shown](values)


def is_zip(run: str | Path) -> bool:
    """Whether it is read as what Stable-Baselines3 saved."""
    return Path(run).suffix == ".zip" and not os.path.isdir(run)


def zips(words: Sequence[str], activation: str | None) -> list[str]:
    """Which of a command's words are zips; a PolicyError where an activation is given and none is."""
    found = [word for word in words if is_zip(word)]
    if activation is not None and not found:
        raise PolicyError(f"--activation {activation}: runs know their own; give it with a .zip")
    return found


def contents(path: Path) -> tuple[dict[str, Tensor], Header]:
    """What a policy file contains: the tensors of all seeds by name, and its header; raises a PolicyError."""
    try:
        tensors, said = safe.read(path)
        header = files.facts(Header, files.parsed(said.get("uavnav", "{}")))
    except (OSError, ValueError) as error:
        raise PolicyError(
            f"{path}: not a readable policy file ({error}); give the one of a finished run"
        ) from error
    return tensors, header


def load_policy(
    run: str | Path, seed: int | None = None, greedy: bool = True, activation: str | None = None
) -> Policy:
    """The policy of one seed of a run's folder (or of its policy.safetensors); nothing is unpickled or
    executed.

    A `.zip` is read as one of Stable-Baselines3: the weights of a PPO or a DQN with MlpPolicy, and its
    activation where that is plain text.

    Args:
        run: a run's folder, its policy file, the zip that `model.save` of Stable-Baselines3 wrote, or the
            name of a policy that ships, such as `ppo-tanh`.
        seed: which training seed; the first one if None. A zip has no seeds.
        greedy: the best action always, or as in training: PPO samples, DQN explores with its final epsilon
            (0.05 for a zip).
        activation: of a zip's hidden layers, if the zip does not say it; a run knows its own.

    Raises:
        PolicyError: the file is missing or damaged, has no such seed, or is of another kind of network.
    """
    if is_zip(run):
        if seed is not None:
            raise PolicyError(
                f"{run}: seed={seed}; a zip of Stable-Baselines3 contains one policy: give no seed"
            )
        return _from_sb3(Path(run), greedy, activation)
    if activation is not None:
        raise PolicyError(f"{run}: activation={activation}; a run knows its own: give it only for a .zip")
    return next(each_policy(run, None if seed is None else [seed], greedy))


def load_policies(
    run: str | Path, seeds: Sequence[int] | None = None, greedy: bool = True
) -> dict[int, Policy]:
    """The policies of some seeds of a run, or of all, by seed. Raises a PolicyError as `load_policy` does."""
    return {policy.seed: policy for policy in each_policy(run, seeds, greedy)}


def by_mode(policies: Mapping[int, Policy]) -> dict[str, dict[int, Policy]]:
    """The same policies greedy and sampled, by mode and seed."""
    return {
        mode: {seed: replace(one, greedy=mode == "greedy") for seed, one in policies.items()}
        for mode in MODES
    }


def each_policy(run: str | Path, seeds: Sequence[int] | None, greedy: bool) -> Iterator[Policy]:
    """The same one after the other, each read when it is asked for."""
    path = Path(run) / POLICY if os.path.isdir(run) else shipped.found(run)
    if not os.path.isfile(path):  # as Path.is_file, which raises for a name that is too long
        problem = runs_below(Path(run)) or f"no {POLICY} there; give the folder of a finished run"
        raise PolicyError(f"{run}: {problem}{shipped.instead(run)}")
    tensors, header = contents(path)
    how = ALGORITHMS.get(header.algorithm)
    acts, head = header.acts or (how and how.acts), header.head or (how and how.head)
    task = _trained_in(path, header, acts, head)
    if not header.seeds:
        raise PolicyError(f"{path}: contains no seed; give the policy of a finished run")
    seeds = header.seeds if seeds is None else seeds
    if unknown := [seed for seed in seeds if seed not in header.seeds]:
        choices = " ... ".join(map(str, dict.fromkeys((header.seeds[0], header.seeds[-1]))))
        raise PolicyError(f"{path}: seed={unknown[0]} is not there; choose from {choices}")
    sizes, weights = _network(path, header, tensors, str(head), task)
    _warn_of_changed_plugins(path, header)
    for seed in seeds:
        agent = header.seeds.index(seed)
        own = {key: tensor[agent : agent + 1] for key, tensor in weights.items()}
        for key, tensor in own.items():
            if not tensor.isfinite().all():
                raise Diverged(
                    f"{path}: policy.{key} of seed {seed} is not finite, it diverged; train with a lower lr"
                )
        network = mlp(sizes, header.activation, [torch.Generator()], "default", layer_norm=header.layer_norm)
        network.load_state_dict(own)
        yield Policy(
            network,
            header.algorithm,
            greedy,
            task,
            str(acts),
            str(head),
            header.epsilon,
            seed,
            header.layouts,
        )


def _trained_in(path: Path, header: Header, acts: str | None, head: str | None) -> WrappedTask:
    """The task of a policy's training, whose parts and ways to act are all known here."""
    if header.world_version != VERSION:
        raise PolicyError(f"{path}: trained in world version {header.world_version}, this is {VERSION}")
    for name, value, choices in (
        ("activation", header.activation, ACTIVATIONS),
        ("reward", header.reward, REWARDS),
        ("task", header.task, TASKS),
        ("algorithm", header.algorithm, ALGORITHMS),
        ("way to act", acts, ACTS),
        ("head", str(head).partition(" ")[0], HEADS),  # its numbers follow
    ):
        if value not in list(choices):
            hint = plugins.missing(header.plugins) or f"; {choose_from(value, choices)}"
            raise PolicyError(f"{path}: unknown {name} {value!r}{hint}")
    try:
        return make_task(
            EMPTY, header.world, header.reward, header.max_steps, header.task, header.stack, header.faults
        )
    except (TypeError, ValueError) as error:
        raise PolicyError(
            f"{path}: not a readable policy file ({error}); give the one of a finished run"
        ) from error


def _network(
    path: Path, header: Header, tensors: Mapping[str, Tensor], head: str, task: WrappedTask
) -> tuple[list[int], dict[str, Tensor]]:
    """The layers' sizes, and the weights [A, ...] by a network's names; checked before memory is taken."""
    weights = {key.removeprefix("policy."): one for key, one in tensors.items() if key.startswith("policy.")}
    try:
        if any(tensor.shape[:1] != (len(header.seeds),) for tensor in tensors.values()):
            raise ValueError(f"not {len(header.seeds)} networks")
        inputs, outputs = weights["0.weight"].shape[1], weights[f"{2 * len(header.hidden)}.weight"].shape[2]
        sizes = [inputs, *header.hidden, outputs]
        expected = mlp(sizes, header.activation, [], "default")  # of no agent: it takes no memory
        if shapes(weights) != shapes(expected.state_dict()) or any(
            tensor.dtype != torch.float32 for tensor in weights.values()
        ):
            raise ValueError("other tensors")
        n_actions = values_of(head, torch.zeros(1, outputs)).shape[-1]
    except (KeyError, IndexError, RuntimeError, TypeError, ValueError, OverflowError) as error:
        raise PolicyError(
            f"{path}: its tensors do not fit its header; give the one of a finished run"
        ) from error
    _check_sizes(path, inputs, n_actions, task)
    return sizes, weights


def _warn_of_changed_plugins(path: Path, header: Header) -> None:
    facts = path.with_name("meta.json")
    if header.plugins and facts.is_file():
        try:
            plugins.warn_of_changed(path, read_settings(facts).get("plugins", {}))
        except RunError as error:
            raise PolicyError(str(error)) from error


def _check_sizes(path: Path, inputs: int, outputs: int, task: WrappedTask) -> None:
    if inputs != task.observation_size or outputs != task.world.n_actions:
        raise PolicyError(
            f"{path}: sees {inputs} numbers and chooses from {outputs} actions, not"
            f" {task.observation_size} and {task.world.n_actions} as in this world"
        )


# -- Stable-Baselines3 ---------------------------------------------------------------------------------------

SB3_LAYERS = {"ppo": ("mlp_extractor.policy_net.", "action_net."), "dqn": ("q_net.q_net.", "")}
"""Where a zip keeps the hidden layers that choose actions, and the last one if it is apart."""
SB3_DEFAULTS = {"ppo": "tanh", "dqn": "relu"}  # the activation of its MlpPolicy, where none is given
SB3_OTHERS = ("mlp_extractor.value_net.", "value_net.", "q_net_target.q_net.")
"""Networks that no action depends on."""


def _from_sb3(path: Path, greedy: bool, activation: str | None) -> Policy:
    if not os.path.isfile(path):
        raise PolicyError(f"{path}: no such file; give what model.save of PPO, A2C or DQN wrote")
    tensors = _sb3_tensors(path)
    algorithm, layers = _sb3_layers(path, tensors)
    sizes = [layers[0][0].shape[1], *(len(bias) for _, bias in layers)]
    task, how = make_task(EMPTY), ALGORITHMS[algorithm]
    _check_sizes(path, sizes[0], sizes[-1], task)
    said = _sb3_activation(path, algorithm)
    activation = activation or said
    if activation is None:
        choices = ", ".join(sorted(ACTIVATIONS))
        raise PolicyError(f"{path}: it does not tell the activation; give activation=..., one of {choices}")
    if said not in (None, activation):
        raise PolicyError(f"{path}: activation={activation}; its own is {said}: leave it out")
    if activation not in ACTIVATIONS:
        raise PolicyError(
            f"{path}: unknown activation {activation!r}; {choose_from(activation, ACTIVATIONS)}"
        )
    network = mlp(sizes, activation, [torch.Generator()], "default")
    own = {f"{2 * index}.weight": weight.T[None] for index, (weight, _) in enumerate(layers)}
    own |= {f"{2 * index}.bias": bias[None, None] for index, (_, bias) in enumerate(layers)}
    if shapes(own) != shapes(network.state_dict()):
        raise PolicyError(f"{path}: activation={activation}; a zip has none of its layers: give a function")
    for index, (weight, bias) in enumerate(layers):
        if not (weight.isfinite().all() and bias.isfinite().all()):
            raise PolicyError(
                f"{path}: layer {index} is not finite, it diverged; train with a lower learning_rate"
            )
    network.load_state_dict(own)
    return Policy(network, algorithm, greedy, task, how.acts, how.head, SB3_EPSILON)


def _sb3_layers(path: Path, tensors: dict[str, Tensor]) -> tuple[str, list[tuple[Tensor, Tensor]]]:
    """Which algorithm it is by the names of its weights, and each layer's weight [out, in] and bias [out]."""
    algorithm = "dqn" if any(key.startswith(SB3_LAYERS["dqn"][0]) for key in tensors) else "ppo"
    hidden, last = SB3_LAYERS[algorithm]
    names = [f"{hidden}{2 * index}." for index in range(sum(key.startswith(hidden) for key in tensors) // 2)]
    names += [last] if last else []
    expected = {f"{name}{part}" for name in names for part in ("weight", "bias")}
    strange = sorted(expected ^ {key for key in tensors if not key.startswith(SB3_OTHERS)})
    if strange:
        raise PolicyError(
            f"{path}: no MlpPolicy of PPO, A2C or DQN, for its {', '.join(strange[:2])}; give one of them"
        )
    layers = [(tensors[f"{name}weight"], tensors[f"{name}bias"]) for name in names]
    fits = all(weight.ndim == 2 and bias.shape == weight.shape[:1] for weight, bias in layers)
    if not fits or any(len(bias) != weight.shape[1] for (_, bias), (weight, _) in pairwise(layers)):
        raise PolicyError(
            f"{path}: the shapes of its layers do not fit each other; give what model.save wrote"
        )
    return algorithm, layers


def _sb3_activation(path: Path, algorithm: str) -> str | None:
    """The activation that the settings in a zip say in plain text, or the default of Stable-Baselines3's own
    policies; else None. The pickles next to that text are not touched.
    """
    try:
        with zipfile.ZipFile(path) as archive, archive.open(SB3_SETTINGS) as file:
            said = files.parsed(file.read(SB3_MAX_BYTES))
        given, kind = said["policy_kwargs"], said["policy_class"]
        if "activation_fn" not in given:
            own = kind["__module__"].startswith("stable_baselines3.")
            return SB3_DEFAULTS[algorithm] if own else None
        found = re.fullmatch(r"<class 'torch\.nn\.modules\.activation\.(\w+)'>", given["activation_fn"])
        return next(name for name in ACTIVATIONS if found and name.replace("_", "") == found[1].lower())
    except Exception:  # as of the weights
        return None


def _sb3_tensors(path: Path) -> dict[str, Tensor]:
    """The weights in a zip of Stable-Baselines3, by torch's own reader, which reads only tensors."""
    try:
        with zipfile.ZipFile(path) as archive, archive.open(SB3_WEIGHTS) as file:
            content = file.read(SB3_MAX_BYTES + 1)  # whatever the zip says of its size
        if len(content) > SB3_MAX_BYTES:
            raise ValueError(f"{SB3_WEIGHTS} has more than {SB3_MAX_BYTES:,} bytes")
        with zipfile.ZipFile(io.BytesIO(content)) as inner:  # what torch.save writes is a zip too
            if sum(one.file_size for one in inner.infolist()) > SB3_MAX_BYTES:
                raise ValueError(f"more than {SB3_MAX_BYTES:,} bytes of weights")
        tensors = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
        if not isinstance(tensors, dict) or not all(_is_plain(value) for value in tensors.values()):
            raise ValueError("not a table of float32 tensors")
        if sum(value.numel() for value in tensors.values()) * 4 > SB3_MAX_BYTES:
            raise ValueError(f"more than {SB3_MAX_BYTES:,} bytes of weights")
    except Exception as error:
        # zlib, zipfile, struct and torch raise nearly every kind, in any number of lines
        problem = "its weights are more than tensors" if isinstance(error, pickle.UnpicklingError) else error
        reason = str(problem).strip().splitlines()[0] if str(problem).strip() else type(error).__name__
        raise PolicyError(
            f"{path}: not a readable zip of Stable-Baselines3 ({reason}); give what model.save of PPO or "
            "DQN wrote"
        ) from error
    return {str(name): value for name, value in tensors.items()}


def _is_plain(value: Any) -> bool:
    kind = "cpu", torch.strided, torch.float32
    return isinstance(value, Tensor) and (value.device.type, value.layout, value.dtype) == kind
