"""The table of algorithms: one light record each. To add one, write its module and its line here."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple


class Algorithm(NamedTuple):
    """What others must know of an algorithm without importing it."""

    module: str
    acts: str  # how it acts in training: a name of `training.sampling.ACTS`
    values: str  # what its outputs are, for people
    shown: str  # what a picture shows of them: a name of `training.sampling.SHOWN`
    head: str = "direct"  # how outputs become one number an action: a name of `training.sampling.HEADS`
    came_later: Mapping[str, Any] = {}  # settings that the configurations of older runs lack, as those were run


ALGORITHMS = {
    "ppo": Algorithm("uavnav.algorithms.ppo", "categorical", "logits", "probability"),
    "dqn": Algorithm("uavnav.algorithms.dqn", "epsilon-greedy", "Q values", "Q value", came_later={"n_steps": 1}),
}
