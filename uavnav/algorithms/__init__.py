"""The table of algorithms: one light record each. To add one, write its module and its entry here, or in
a plugin.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from uavnav.errors import ConfigError


class Algorithm(NamedTuple):
    """What others must know of an algorithm without importing it."""

    module: str  # has its `PRESETS`, configurations by name, and `train`
    acts: str  # how it acts in training: a name of `acting.ACTS`
    values: str  # what its outputs are, for people
    shown: str  # what a picture shows of them: a name of `acting.SHOWN`
    head: str = "direct"  # how outputs become one number an action: a name of `acting.HEADS`
    # when Stable-Baselines3 writes a row of its log: every so many `frames` or `episodes`, by factors
    logs: tuple[str | int, ...] = ()

    @property
    def presets(self) -> Mapping[str, Any]:
        """Its configurations by name; the first call imports its module, and so torch.

        Raises:
            ConfigError: there is no such module, or it has none.
        """
        try:
            found: Mapping[str, Any] = importlib.import_module(self.module).PRESETS
        except (ModuleNotFoundError, AttributeError) as error:
            raise ConfigError(f"{self.module}: is no algorithm's module with PRESETS ({error})") from error
        return found

    @property
    def config(self) -> Any:
        """The class of its configurations."""
        return type(next(iter(self.presets.values())))

    def rhythm(self, settings: Mapping[str, Any]) -> tuple[str, int] | None:
        """When Stable-Baselines3 logs a run of these settings: every so many `frames` per seed or finished
        `episodes`.

        None where that is not known.
        """
        unit, *factors = self.logs or ("",)
        numbers = [settings.get(factor) if isinstance(factor, str) else factor for factor in factors]
        known = [number for number in numbers if type(number) is int and number > 0]
        return (str(unit), math.prod(known)) if known and len(known) == len(factors) else None


class Table(dict[str, Algorithm]):
    """Records by name. Those of the package stay as they are, and no module takes another one's name.

    Raises:
        ConfigError: the package, or another module, has a record of this name.
    """

    def __setitem__(self, name: str, record: Algorithm) -> None:
        if BUILT_IN.get(name, record) != record or self.get(name, record).module != record.module:
            raise ConfigError(f"algorithm={name} is there already; give yours another name")
        super().__setitem__(name, record)


BUILT_IN = {
    "ppo": Algorithm(
        "uavnav.algorithms.ppo", "categorical", "logits", "probability", logs=("frames", "frames_per_batch")
    ),
    # logs as all that learns from replay in Stable-Baselines3
    "dqn": Algorithm("uavnav.algorithms.dqn", "epsilon-greedy", "Q values", "Q value", logs=("episodes", 4)),
    "a2c": Algorithm(
        "uavnav.algorithms.a2c",
        "categorical",
        "logits",
        "probability",
        logs=("frames", 100, "n_steps", "n_envs"),
    ),
    "c51": Algorithm(
        "uavnav.algorithms.c51",
        "epsilon-greedy",
        "Q values",
        "Q value",
        "distribution",
        logs=("episodes", 4),
    ),
    "sac": Algorithm("uavnav.algorithms.sac", "categorical", "logits", "probability", logs=("episodes", 4)),
    "pqn": Algorithm(
        "uavnav.algorithms.pqn", "epsilon-greedy", "Q values", "Q value", logs=("frames", "frames_per_batch")
    ),
}

ALGORITHMS = Table(BUILT_IN)
