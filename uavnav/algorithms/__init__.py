"""The table of algorithms: one light record each. To add one, write its module and its line here, or in a plugin."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple


class Algorithm(NamedTuple):
    """What others must know of an algorithm without importing it."""

    module: str  # has its `PRESETS`, configurations by name, and `train`
    acts: str  # how it acts in training: a name of `training.sampling.ACTS`
    values: str  # what its outputs are, for people
    shown: str  # what a picture shows of them: a name of `training.sampling.SHOWN`
    head: str = "direct"  # how outputs become one number an action: a name of `training.sampling.HEADS`
    came_later: Mapping[str, Any] = {}  # settings that older runs do not name, as those were run


ALGORITHMS = {
    "ppo": Algorithm("uavnav.algorithms.ppo", "categorical", "logits", "probability"),
    "dqn": Algorithm("uavnav.algorithms.dqn", "epsilon-greedy", "Q values", "Q value", came_later={"n_steps": 1}),
    "a2c": Algorithm("uavnav.algorithms.a2c", "categorical", "logits", "probability"),
}
