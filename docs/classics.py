"""Try parameters of the classics on validation layouts: so their defaults in `uavnav.tasks.classics` were
chosen.

    python docs/classics.py apf vfh dwa orca

Each combination flies the first 30 validation layouts of each task for at most 500 steps. The chosen one has
the least mean rank of its rewards over the tasks.
"""

from __future__ import annotations

import functools
import itertools
import sys

import pandas as pd

from uavnav.evaluation import fly, on
from uavnav.tasks import classics
from uavnav.tasks.table import EMPTY, make_task

GRIDS = {
    "apf": {"gain": [3e3, 1e4, 3e4], "reach": [40.0, 80.0], "tolerance": [0.0, 10.0]},
    "vfh": {"window": [30.0, 45.0, 60.0], "spare": [2.0, 5.0], "wide": [2, 4]},
    "dwa": {"heading": [1.0, 4.0, 16.0], "speed": [0.2, 1.0], "body": [0.0, 60.0]},
    "orca": {"horizon": [4.0, 8.0, 12.0], "body": [60.0, 80.0, 100.0]},
}
TASKS = {"drone": {}, "goal": {}, "moving": {}}
SENSING = {"moving": {"sense_velocity": True}, "space-moving": {"sense_velocity": True}}
"""Of orca."""


def reward(name: str, parameters: dict[str, float], task: str) -> float:
    """What a policy with these parameters earns on validation layouts, in the mean."""
    there = on(
        make_task(EMPTY, (SENSING if name == "orca" else TASKS)[task], task=task), "validation", 30, 500
    )
    policy = functools.partial(getattr(classics, name), world=there.world, **parameters)
    return float(fly({0: policy}, there).episodes["reward"].mean())


for name in sys.argv[1:]:
    tried = [
        dict(zip(GRIDS[name], values, strict=True)) for values in itertools.product(*GRIDS[name].values())
    ]
    tasks = [*(SENSING if name == "orca" else TASKS)]
    table = pd.DataFrame([one | {task: reward(name, one, task) for task in tasks} for one in tried])
    table["rank"] = table[tasks].rank(ascending=False).mean(axis=1)
    print(f"{name}\n{table.sort_values('rank').round(2).to_string(index=False)}\n", flush=True)
