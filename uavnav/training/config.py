"""What a training run is configured by: the fields that all algorithms share, and their checks."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import torch
from pydantic import AfterValidator, BeforeValidator, SerializeAsAny, model_validator
from torch import nn

from uavnav import files
from uavnav.errors import ConfigError, among, telling_line, told, unknown
from uavnav.networks import ACTIVATIONS, Init, mlp
from uavnav.runs import MOST_SEEDS, default_folder
from uavnav.settings import (
    AtLeast0,
    Count,
    Numbers,
    OneOf,
    Settings,
    Share,
    Units,
    Whole,
    at_most,
    flat,
    key,
    part,
    shown,
)
from uavnav.tasks.faults import MOST_REMEMBERED, Faults
from uavnav.tasks.rewards import REWARDS, check_reward
from uavnav.tasks.seeding import stream
from uavnav.tasks.table import TASKS, make_task
from uavnav.tasks.world import World
from uavnav.tasks.wrapper import WrappedTask

TASK = "drone"
"""The task of a run that names none."""
STEP_BYTES = 60
"""Of a step of an iteration besides its two observations: an episode's counts, action, reward and flags."""
SEED_BYTES = 80_000  # the order in which a seed takes the layouts of the split `train`
ROW_COLUMNS = 5  # numbers of a row of progress, at least: seed, frame, pace, and some of the algorithm's
ROW_BYTES = 600  # what the rows of all seeds take besides their numbers, as one mapping of arrays
PARTS = ("world", "faults")
"""The fields that are settings of their own, whose fields a command line sets as `world.sensor_arc`."""
MOST_LAYERS = 100

Compile = Annotated[
    Literal["auto", "on", "off"],
    # YAML reads on and off as booleans
    BeforeValidator(lambda value: {True: "on", False: "off"}[value] if isinstance(value, bool) else value),
]


class TrainConfig(Settings):
    """The fields that all algorithms have. Counts of frames are per seed.

    Raises:
        ConfigError: a value has the wrong type, is out of range, or is not among the choices.
    """

    PRESETS: ClassVar[dict[str, dict[str, Any]]] = {"paper": {}}
    """What each preset sets, where it is not given, instead of the defaults."""
    COPIES: ClassVar[int] = 3
    """Numbers that an agent keeps for each weight of a network: itself, Adam's moments and others."""
    algorithm: ClassVar[str]
    """Its name in `uavnav.algorithms.ALGORITHMS`."""

    preset: str = key("paper", "which table of settings to start from")
    activation: Annotated[str, AfterValidator(OneOf(ACTIVATIONS))] = key("tanh", "of the hidden layers")
    seed: Whole = key(0, "the first of the seeds", ge=0, le=2**31 - 1)
    n_seeds: Annotated[Count, at_most(MOST_SEEDS)] = key(
        1, "trained in parallel; their seeds count from the first", "agents"
    )
    total_frames: Count = key(1_000_000, "length of training, in whole iterations", "frames per seed")
    n_envs: Count = key(1, "that act in parallel", "environments per seed")
    hidden: Units = key((64, 64), "of each hidden layer", "units")
    lr: AtLeast0 = key(3e-4, "learning rate")
    anneal_lr: bool = key(False, "the learning rate falls linearly to 0 over the training")
    gamma: Share = key(0.99, "discount of a step")
    max_grad_norm: AtLeast0 | None = key(0.5, "to which each agent's gradient is scaled down")
    init: Init = key("default", "of the weights; default is PyTorch's, unit suits gains to activations")
    layer_norm: bool = key(False, "LayerNorm before each activation, without parameters of its own")
    layouts: str = key(
        "train",
        "layouts: a split (train, validation, test), a rung such as density-12/train, or a file's path",
    )
    max_steps: Count | None = key(None, "time limit of an episode, which truncates it", "steps")
    reward: Annotated[str, AfterValidator(OneOf(REWARDS))] = key("eq14", "what a step earns")
    task: Annotated[str, AfterValidator(OneOf(TASKS))] = key(TASK, "what the drone must do")
    stack: Whole = key(1, "newest ones that a policy sees at once", "observations", ge=1, le=MOST_REMEMBERED)
    world: SerializeAsAny[World] = key(None, "fields of the world that differ from the task's own")
    faults: Faults = key(None, "faults of the sensor and the actuator")
    device: str = key("cpu", "where tensors live")
    keep_at: Numbers = key((), "of training, after which policies are kept too, such as [0.1,0.3]", "shares")
    compile: Compile = key("auto", "auto compiles runs of 100,000 frames and more")

    @model_validator(mode="before")
    @classmethod
    def _completed(cls, given: dict[str, Any]) -> dict[str, Any]:
        """The task's own settings, then those of the preset, then the given ones."""
        preset = given.get("preset", cls.model_fields["preset"].default)
        if not among(preset, cls.PRESETS):
            raise unknown("preset", preset, cls.PRESETS)
        chosen = cls.PRESETS[preset] | given
        task = chosen.get("task", TASK)
        task = task if among(task, TASKS) else TASK  # else the field is refused
        settings = {"reward": TASKS[task].REWARD} | chosen
        if settings.get("max_steps") is None:
            settings["max_steps"] = TASKS[task].MAX_STEPS
        return settings | {
            name: part(kind, name, settings.get(name)) for name, kind in parts_of(task).items()
        }

    def check(self) -> None:
        check_reward(self.reward, self.world)
        if self.frames_per_iteration % self.n_envs:
            raise ConfigError(
                f"n_envs={self.n_envs}; give a divisor of the {self.frames_per_iteration} frames of an "
                "iteration"
            )
        if not self.hidden or min(self.hidden) < 1:
            raise ConfigError(
                f"hidden={told(list(self.hidden))}; give at least one layer, each of at least 1 unit"
            )
        if not all(0 < at < 1 for at in self.keep_at):
            raise ConfigError(
                f"keep_at={told(list(self.keep_at))}; give shares between 0 and 1, as [0.1,0.3]"
            )
        if len(self.hidden) > MOST_LAYERS:
            raise ConfigError(f"hidden: {len(self.hidden)} layers; give at most {MOST_LAYERS}")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of names that torch knew once
                torch.ones(1, device=self.device).item()  # `meta`, say, has no numbers
        except Exception as error:  # each kind of device has its own
            raise ConfigError(
                f"device={told(self.device)}; choose cpu, or a device that this machine has"
            ) from error

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> Self:
        """Build from plain keys and values, as of a command line.

        Raises:
            ConfigError: there is no such key, or as for the constructor.
        """
        if not isinstance(mapping, Mapping):
            raise ConfigError(f"{told(mapping)}: is no mapping; give keys and values")
        given = {told(name): value for name, value in mapping.items()}
        for name in [name for name in given if "." in name and name.partition(".")[0] in PARTS]:
            whole, _, field = name.partition(".")
            own = given.get(whole) or {}
            if isinstance(own, Settings):
                raise ConfigError(
                    f"there is no key '{name}' with {whole}={type(own).__name__}; give one of them"
                )
            if isinstance(own, Mapping):
                given[whole] = {**own, field: given.pop(name)}
        return cls(**given)

    @classmethod
    def names(cls) -> list[str]:
        """The names of all settings, with those of a world and of faults as a command line sets them."""
        return [
            *super().names(),
            *(f"{name}.{one}" for name, kind in parts_of(TASK).items() for one in kind.names()),
        ]

    @classmethod
    def as_run(cls, mapping: Mapping[str, Any]) -> dict[str, Any]:
        """The settings in a run's config.yaml; a setting that came later than the run has its default."""
        default = plain(cls())
        there = {key: value for key, value in mapping.items() if key != "algorithm"}
        for name, kind in parts_of(there.get("task", TASK)).items():
            there[name] = kind().model_dump() | dict(there.get(name, {}))
        return default | there

    @classmethod
    def usual(cls, preset: str, task: str) -> dict[str, Any]:
        """The settings of a preset in a task, built with a reward that asks nothing more of an algorithm."""
        reward = cls.model_fields["reward"].default
        return plain(cls(preset=preset, task=task, reward=reward)) | {"reward": TASKS[task].REWARD}

    def changes(self) -> dict[str, Any]:
        """The settings in which this configuration differs from its preset, the activation aside."""
        mine, theirs = flat(plain(self)), flat(self.usual(self.preset, self.task))
        theirs |= {"task": TASK, "activation": self.activation}
        return {name: value for name, value in mine.items() if value != theirs[name]}

    def beyond_preset(self) -> dict[str, Any]:
        """The same, apart from what every table names."""
        named = ("seed", "n_seeds", "total_frames", "n_envs", "device", "compile")
        return {name: value for name, value in self.changes().items() if name not in named}

    def make(self, compile: bool) -> Any:
        """The algorithm with these settings, as `uavnav.training.loop` needs it."""
        raise NotImplementedError(f"{type(self).__name__} has no algorithm to make")

    def network(self, purpose: str, outputs: int, gain: float = 1.0) -> nn.Sequential:
        """A network of each seed, initialised from a stream of its own: [A, ..., 30] -> [A, ..., outputs].

        gain: of the last layer, where the initialisation has gains.
        """
        sizes = [self.observation_size, *self.hidden, outputs]
        generators = [stream(seed, purpose) for seed in self.seeds]
        return mlp(sizes, self.activation, generators, self.init, gain, self.layer_norm)

    def check_machine(self) -> None:
        """Raise a ConfigError where what all seeds learn would not fit into the machine's memory."""
        sizes = [self.observation_size, *self.hidden, self.n_outputs]
        weights = self.n_seeds * sum((inputs + 1) * outputs for inputs, outputs in itertools.pairwise(sizes))
        self.check_memory(
            f"hidden={list(self.hidden)}, n_seeds={self.n_seeds}: networks of {self.n_outputs:,} outputs",
            4 * self.COPIES * weights,
            "smaller networks or fewer seeds",
        )
        steps = self.n_seeds * self.frames_per_iteration
        self.check_memory(
            f"n_seeds={self.n_seeds}, n_envs={self.n_envs}: the {steps:,} frames of an iteration",
            steps * (2 * 4 * self.observation_size + STEP_BYTES),
            "fewer frames an iteration, environments or seeds",
        )
        self.check_memory(
            f"n_seeds={self.n_seeds}: their orders of a layout file", SEED_BYTES * self.n_seeds, "fewer seeds"
        )
        self.check_memory(
            f"hidden={told(list(self.hidden))}: the products of the last layer's units",
            12 * self.n_seeds * self.hidden[-1] ** 2,
            "a narrower last layer or fewer seeds",
        )
        kept = max(self.stack, self.faults.late) * self.world.observation_size
        self.check_memory(
            f"stack={self.stack}, faults.late={self.faults.late}: the observations that are remembered",
            4 * self.n_seeds * self.n_envs * kept,
            "fewer of them, environments or seeds",
        )
        rows = self.frames // max(self.frames_between_rows, self.frames_per_iteration)
        self.check_memory(
            f"total_frames={self.total_frames}: its {rows:,} rows of progress a seed",
            rows * (ROW_BYTES + self.n_seeds * 8 * ROW_COLUMNS),
            "fewer frames, or more of them an iteration",
        )

    def check_memory(self, what: str, needed: int, instead: str) -> None:
        """Raise a ConfigError where something takes more bytes than there are; instead: what to give."""
        if self.device == "cpu" and needed > files.MEMORY_BYTES:
            taken = f"at least {needed / 2**30:,.1f} GiB of the machine's {files.MEMORY_BYTES / 2**30:.1f}"
            raise ConfigError(f"{what} would take {taken}; give {instead}")

    @property
    def n_outputs(self) -> int:
        """How many outputs the policy's network has: one an action."""
        return self.world.n_actions

    @property
    def frames_per_iteration(self) -> int:
        """Collected per seed between two calls of `learn`: here a step of all environments."""
        return self.n_envs

    @property
    def frames_between_rows(self) -> int:
        """Collected per seed between two rows of progress, if an iteration has fewer; unknown here."""
        return self.frames

    def logs(self, frames: int) -> bool:
        """Whether a row of progress is due after the iteration that ends after so many frames per seed."""
        before, every = frames - self.frames_per_iteration, self.frames_between_rows
        return frames // every > before // every or frames >= self.frames

    @property
    def iterations(self) -> int:
        """Whole ones, as SB3 runs them."""
        return -(-self.total_frames // self.frames_per_iteration)

    def shares_reached(self, frames: int) -> list[float]:
        """Those of `keep_at` that the iteration which ends after so many frames per seed reaches."""
        return [at for at in self.keep_at if 0 <= frames - at * self.frames < self.frames_per_iteration]

    @property
    def frames(self) -> int:
        """Frames that are really run, per seed."""
        return self.iterations * self.frames_per_iteration

    @property
    def frames_before_learning(self) -> int:
        """Per seed, until the first update."""
        return 0

    @property
    def updates(self) -> int:
        """Gradient steps of a training: here one an iteration."""
        return self.iterations

    @property
    def lr_ends_at(self) -> float:
        """The gradient step at which the learning rate comes to 0."""
        return self.updates if self.anneal_lr else math.inf

    @property
    def final_epsilon(self) -> float:
        """The share of random actions of the trained policy, where it acts as in training."""
        return 0.0

    @property
    def seeds(self) -> list[int]:
        """One seed an agent."""
        return list(range(self.seed, self.seed + self.n_seeds))

    @property
    def folder(self) -> Path:
        """Where its run goes by default."""
        changes = {name: shown(value).removesuffix(".0") for name, value in self.changes().items()}
        return default_folder(self.algorithm, self.preset, self.activation, changes)

    @property
    def observation_size(self) -> int:
        """Numbers that a policy sees."""
        return self.stack * self.world.observation_size

    def try_task(self) -> None:
        """Raise a ConfigError where a first step fails, as it may with a task or a reward of one's own."""
        task = self.make_task()
        try:
            task.try_out()
        except Exception as error:  # a caller's function may raise any kind
            raise ConfigError(f"task={self.task} with reward={self.reward}: {telling_line(error)}") from error

    def make_task(self) -> WrappedTask:
        """The task with these settings; raises a LayoutError where its split is not right."""
        return make_task(
            self.layouts, self.world, self.reward, self.max_steps, self.task, self.stack, self.faults
        )


def plain(config: TrainConfig) -> dict[str, Any]:
    """Its settings as YAML and JSON have them, with lists for tuples."""
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in config.model_dump().items()
    }


def parts_of(task: str) -> dict[str, type[World] | type[Faults]]:
    """The classes of `PARTS` in a task of `TASKS`."""
    return {"world": TASKS[task].WORLD, "faults": Faults}
