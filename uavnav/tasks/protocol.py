"""What is trained on and what is judged on: the splits of the obstacle sets, and the protocol of an evaluation.

Nothing here imports torch or pydantic.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from uavnav.tasks.faults import Faults

DEFAULT_K = 8
"""Obstacles per set (decision 1)."""


class Split(NamedTuple):
    """How many sets a shipped bank has, and the seed that it is generated from."""

    n: int
    seed: int


SPLITS = {"train": Split(10_000, 0), "validation": Split(1_000, 2), "test": Split(1_000, 1)}
"""Train on one, choose on the second, judge on the third: seeds of one distribution, with no set in common."""

EPISODES = 200
MAX_STEPS = 10_000
"""An evaluation flies so many sets of the split `test`, with this cap on steps."""
CAPS = {"goal": 1_000}
"""The caps of tasks that have their own, in training and in evaluation."""


def header(
    layouts: str | Path, episodes: int, max_steps: int, faults: Faults | None = None, task: str = "drone"
) -> dict[Any, Any]:
    """What the header of a file of rows says of how they were flown; of a task, if it is not the paper's."""
    own: dict[Any, Any] = {"layouts": str(layouts), "episodes": episodes, "max_steps": max_steps}
    own |= {} if faults is None else {"faults": str(faults)}
    return own if task == "drone" else own | {"task": task}


SCRIPTS = ("random", "straight", "reactive")
"""Policies that need no training; what they do is in `baselines`."""
DRAWS = "random"
"""The one of them that draws its actions, so that its seeds differ."""

TASK_NAMES = ("drone", "moving", "goal", "space", "space-moving")
"""What `simulator.TASKS` holds, in its order."""

OF_FAULTS = ("noise", "lost", "late", "sticky")
LADDER_NAMES = ("density", "slalom", "arc", "reach", "speed", *OF_FAULTS)
"""What `ladders` holds, in its order."""
GROUPS = {"faults": OF_FAULTS, "all": LADDER_NAMES}
"""Several ladders by one name."""
ACROSS_STEPS = 2_000
"""The cap on steps across ladders."""
