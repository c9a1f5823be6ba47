"""Flights in the empty arena, from the centre: how drones fly where nothing is in the way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pandas as pd
import torch

from uavnav.evaluation import flights
from uavnav.runs.policies import Policy

HEADINGS = (0, 90, 180, 270)
"""Start headings of a seed's flights [degrees]."""
EMPTY_ARENA = torch.empty(len(HEADINGS), 0, 3)
"""A bank [4, 0, 3]: as many sets without an obstacle."""
STEPS = 500
"""A flight that lasts so long is cut off."""


def fly(population: Mapping[int, Policy], steps: int = STEPS) -> pd.DataFrame:
    """The actions of a flight for each seed and start heading, until a collision or for so many steps.

    What a seed does depends on its policy and its own generator alone.

    Returns:
        A row a step, columns seed, layout, action; layout counts `HEADINGS`.

    Raises:
        ValueError: steps is below 1.
    """
    task = replace(next(iter(population.values())).task, bank=EMPTY_ARENA, max_steps=steps)
    seeds = torch.tensor(list(population)).repeat_interleave(len(HEADINGS))
    parts = [
        {"seed": seeds[step.flight], "layout": step.flight % len(HEADINGS), "action": step.action}
        for step in flights.fly(list(population.items()), task, torch.tensor(HEADINGS))
    ]
    table = pd.DataFrame({name: torch.cat([part[name] for part in parts]).numpy() for name in parts[0]})
    return table.sort_values(["seed", "layout"], kind="stable", ignore_index=True)
