"""What seeds expect of their episodes, and what they get: their action values against returns."""

from __future__ import annotations

from collections.abc import Mapping

import pandas as pd
import torch

from uavnav.evaluation import episodes
from uavnav.runs.policies import Policy
from uavnav.tasks import layouts
from uavnav.tasks.protocol import MAX_STEPS
from uavnav.tasks.state import UP


def overestimation(
    population: Mapping[int, Policy],
    gamma: float,
    steps: int = 300,
    n_layouts: int = 20,
    max_steps: int = MAX_STEPS,
) -> pd.DataFrame:
    """How much more seeds expect than they get: columns seed, q, realised, overestimation = q - realised.

    q is the mean of max_a Q(s, a) over the states of greedy episodes, one on each of the first test layouts,
    and realised the mean of the discounted return from the same states on. States are those of the first
    `steps` steps. The episode goes on until gamma^n < 0.01 (459 steps at 0.99). Where that takes more than
    `max_steps` steps in all, only states with so much future, or with a collision ahead, count: NaN where
    there is none. All episodes start upwards.

    population: greedy policies whose outputs are values, by seed; gamma: the discount of their training.

    Raises:
        ValueError: gamma is no discount, or there are no such layouts or steps.
    """
    all_layouts = layouts.load("test")
    if not isinstance(gamma, (int, float)) or not 0 <= gamma <= 1:
        raise ValueError(f"gamma={gamma}; give a discount from 0 to 1")
    if not 1 <= n_layouts <= len(all_layouts) or steps < 1:
        raise ValueError(
            f"n_layouts={n_layouts}, steps={steps}; give 1 to {len(all_layouts)} layouts and at least 1 step"
        )
    horizon = next((n for n in range(1, max_steps + 1) if gamma**n < 0.01), max_steps + 1)
    seeds, heading = list(population), torch.full((n_layouts,), UP)
    n, limit = len(seeds) * n_layouts, min(steps + horizon, max_steps)
    q, returned = (torch.zeros(limit, n, dtype=torch.float64) for _ in range(2))
    seen = torch.zeros(limit, n, dtype=torch.bool)
    collided = torch.zeros(n, dtype=torch.bool)
    task = population[seeds[0]].task.replace(layouts=all_layouts[:n_layouts], max_steps=limit)
    for one in episodes.steps(list(population.items()), task, heading):
        assert one.values is not None
        step, outcome = one.number - 1, one.outcome
        q[step, one.episode] = one.values.amax(-1).double()
        returned[step, one.episode] = outcome.reward
        seen[step, one.episode] = True
        collided[one.episode] = outcome.terminated
    for step in reversed(range(limit - 1)):
        returned[step] += gamma * returned[step + 1]
    known = collided | (torch.arange(limit)[:, None] + horizon <= limit)
    counts = (seen & known)[:steps].reshape(-1, len(seeds), n_layouts)
    sums = ((values[:steps].reshape(counts.shape) * counts).sum((0, 2)) for values in (q, returned))
    expected, realised = (summed / counts.sum((0, 2)) for summed in sums)  # 0 / 0 is NaN
    columns = {"q": expected, "realised": realised, "overestimation": expected - realised}
    return pd.DataFrame({"seed": seeds, **columns})
