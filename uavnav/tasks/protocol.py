"""What is trained on and what is judged on: the splits of the obstacle sets, and the protocol of an evaluation.

Nothing here imports torch.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

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


def header(layouts: str | Path, episodes: int, max_steps: int, faults: Faults | None = None) -> dict[Any, Any]:
    """What the header of a file of rows says of how they were flown: the protocol."""
    own = {"layouts": str(layouts), "episodes": episodes, "max_steps": max_steps}
    return own if faults is None else own | {"faults": str(faults)}


SCRIPTS = ("random", "straight", "reactive")
"""Policies that need no training; what they do is in `baselines`."""

TASK_NAMES = ("drone", "moving", "goal", "space", "space-moving")
"""What `simulator.TASKS` holds, in its order."""

OF_FAULTS = ("noise", "lost", "late", "sticky")
LADDER_NAMES = ("density", "slalom", "arc", "reach", "speed", *OF_FAULTS)
"""What `ladders` holds, in its order."""
GROUPS = {"faults": OF_FAULTS, "all": LADDER_NAMES}
"""Several ladders by one name."""
ACROSS_STEPS = 2_000
"""The cap on steps across ladders."""
