"""What is trained on and what is judged on: the splits of layouts, and the numbers of an evaluation.

Nothing here imports torch or pydantic.
"""

from __future__ import annotations

from typing import NamedTuple

DEFAULT_K = 8
"""Obstacles per layout (decision 1)."""


class Split(NamedTuple):
    """How many layouts a shipped split has, and the seed that it is generated from."""

    n: int
    seed: int


SPLITS = {"train": Split(10_000, 0), "validation": Split(1_000, 2), "test": Split(1_000, 1)}
"""Train on one, choose on the second, judge on the third: seeds of one distribution, no layout in common."""

EPISODES = 200
MAX_STEPS = 10_000
"""An evaluation flies so many layouts of the split `test`, with this time limit."""
LIMITS = {"goal": 1_000}
"""The time limits of tasks that have their own, in training and in evaluation."""


USUAL = ("random", "straight", "reactive")
"""Policies that need no training, which learned ones are compared with; what they do is in `baselines`."""
ORCA = "orca"
"""The one that needs velocities, so that it flies only where bodies move."""
VFH = "vfh"
"""The one whose histogram is of a plane, so that it flies in no box."""
SCRIPTED = (*USUAL, "apf", VFH, "dwa", ORCA)
"""All of them, with those of `classics`."""
DRAWS = "random"
"""The one that draws its actions, so that its seeds differ."""

TASK_NAMES = ("drone", "moving", "goal", "space", "space-moving")
"""The names in `table.TASKS`, in its order."""

OF_FAULTS = ("noise", "lost", "late", "sticky")
LADDER_NAMES = ("density", "slalom", "arc", "reach", "speed", *OF_FAULTS)
"""The names in `ladders`, in its order."""
GROUPS = {"faults": OF_FAULTS, "all": LADDER_NAMES}
"""Several ladders by one name."""
ACROSS_STEPS = 2_000
"""The time limit across ladders."""
