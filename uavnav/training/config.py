"""What a training run is configured by: the fields that both algorithms share, and the checks that answer back."""

from __future__ import annotations

import types
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, ClassVar, Literal, Self, get_args, get_origin, get_type_hints

import torch

from uavnav.choices import ConfigError, unknown, unknown_key
from uavnav.networks import ACTIVATIONS, Init
from uavnav.tasks.rewards import REWARDS
from uavnav.tasks.world import World

SWITCHES = ("slots", "padding", "start_heading")
"""The fields of `World` that a run may set."""


def one_of(default: str, choices: Collection[str]) -> Any:
    """A field whose value is one of a table's names."""
    return field(default=default, metadata={"choices": choices})


def at_least(default: float, least: float) -> Any:
    """A numeric field with a smallest value."""
    return field(default=default, metadata={"least": least})


def within(default: float, least: float, most: float) -> Any:
    """A numeric field with a smallest and a largest value."""
    return field(default=default, metadata={"least": least, "most": most})


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """The fields that both algorithms have. Counts of frames are per seed.

    Raises:
        ConfigError: a value has the wrong type, is out of range, or is not among the choices.
    """

    PRESETS: ClassVar[dict[str, dict[str, Any]]] = {"paper": {}}
    """What each preset sets, where it is not given, instead of the defaults."""

    preset: str = "paper"
    activation: str = one_of("tanh", ACTIVATIONS)
    seed: int = within(0, 0, 2**31 - 1)  # seeds are seed ... seed + n_seeds - 1
    n_seeds: int = at_least(1, 1)
    total_frames: int = at_least(1_000_000, 1)
    n_worlds: int = at_least(16, 1)  # parallel worlds per seed
    hidden: tuple[int, ...] = (64, 64)
    lr: float = at_least(3e-4, 0)
    gamma: float = within(0.99, 0, 1)
    max_grad_norm: float = at_least(0.5, 0)  # of each agent's gradient
    init: Init = "default"
    layouts: str = "train"
    max_steps: int | None = field(default=None, metadata={"least": 1})
    reward: str = one_of("eq14", REWARDS)
    slots: Literal["nearest", "listed"] = World.slots
    padding: Literal["far", "zeros"] = World.padding
    start_heading: Literal["up", "random"] = World.start_heading
    device: str = "cpu"
    compile: Literal["auto", "on", "off"] = "auto"

    def __new__(cls, **given: Any) -> Self:
        self = super().__new__(cls)
        object.__setattr__(self, "_given", frozenset(given))  # until __post_init__
        return self

    def __post_init__(self) -> None:
        if self.preset not in self.PRESETS:
            raise unknown("preset", self.preset, self.PRESETS)
        for name, value in self.PRESETS[self.preset].items():
            if name not in self.__dict__["_given"]:
                object.__setattr__(self, name, value)
        object.__delattr__(self, "_given")
        hints = get_type_hints(type(self))
        for item in fields(self):
            value = _checked(item.name, getattr(self, item.name), hints[item.name], item.metadata)
            object.__setattr__(self, item.name, value)
        if not self.hidden or min(self.hidden) < 1:
            raise ConfigError(f"hidden={list(self.hidden)}; give at least one layer, each of at least 1 unit")
        try:
            torch.ones(1, device=self.device).item()  # `meta`, say, has no numbers
        except (RuntimeError, AssertionError, NotImplementedError) as error:
            raise ConfigError(f"device={self.device}; choose cpu, or a device that this machine has") from error

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> Self:
        """Build from plain keys and values, as of a command line or a run's config.yaml.

        Raises:
            ConfigError: there is no such key, or as for the constructor.
        """
        names = [item.name for item in fields(cls)]
        for key in mapping:
            if key not in names:
                raise unknown_key(key, names)
        return cls(**mapping)

    def beyond(self, preset: Self) -> dict[str, Any]:
        """The settings in which this configuration differs from its preset, apart from what every table names."""
        named = ("preset", "activation", "seed", "n_seeds", "total_frames", "n_worlds", "device", "compile")
        mine, theirs = plain(self), plain(preset)
        return {name: value for name, value in mine.items() if name not in named and value != theirs[name]}

    @property
    def seeds(self) -> list[int]:
        """One seed an agent."""
        return list(range(self.seed, self.seed + self.n_seeds))

    @property
    def world(self) -> World:
        """The world with this configuration's switches."""
        return World(**{name: getattr(self, name) for name in SWITCHES})


def plain(config: TrainConfig) -> dict[str, Any]:
    """Its settings as YAML and JSON hold them, with lists for tuples."""
    return {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(config).items()}


def _checked(name: str, value: Any, hint: Any, limits: Mapping[str, Any]) -> Any:
    """The value in its declared type, or a ConfigError."""
    if get_origin(hint) is Literal:
        value = {True: "on", False: "off"}.get(value, value) if isinstance(value, bool) else value  # yaml's on and off
        if value not in get_args(hint):
            raise unknown(name, value, get_args(hint))
        return value
    if get_origin(hint) is types.UnionType:  # the one form in use: `int | None`
        return None if value is None else _checked(name, value, get_args(hint)[0], limits)
    if get_origin(hint) is tuple:
        if not isinstance(value, (list, tuple)):
            raise ConfigError(f"{name}={value!s}; give a list of whole numbers, such as [64,64]")
        return tuple(_checked(name, entry, int, {}) for entry in value)
    if hint is int:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or value != value // 1:
            raise ConfigError(f"{name}={value!s}; give a whole number")
        value = int(value)
    elif hint is float:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or abs(value) == float("inf"):
            raise ConfigError(f"{name}={value!s}; give a number")
        value = float(value)
    elif hint is bool:
        if not isinstance(value, bool):
            raise ConfigError(f"{name}={value!s}; choose from false, true")
    elif hint is str and not isinstance(value, str):
        raise ConfigError(f"{name}={value!s}; give a name")
    if "choices" in limits and value not in limits["choices"]:
        raise unknown(name, value, limits["choices"])
    if not limits.get("least", value) <= value <= limits.get("most", value):
        bounds = f"at least {limits['least']}" + (f" and at most {limits['most']}" if "most" in limits else "")
        raise ConfigError(f"{name}={value!s}; give a number of {bounds}")
    return value
