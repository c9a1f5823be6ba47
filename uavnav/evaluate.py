"""Fly a policy on sets of obstacles that it never trained on: one row an episode."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pandas as pd
import torch
from torch import Tensor

from uavnav import layouts as banks
from uavnav import simulator
from uavnav.metrics import EPISODE_COLUMNS
from uavnav.simulator import COUNTS, UP, State
from uavnav.world import World

AnyPolicy = Callable[[Tensor, torch.Generator | None], Tensor]
"""observation [N, 30], generator -> action [N] int64 in 0..99."""


def evaluate_policy(
    policy: AnyPolicy,
    layouts: str | Path | Tensor = "test",
    episodes: int = 200,
    max_steps: int = 10_000,
    world: World | None = None,
    reward: str = "eq14",
    seed: int = 0,
) -> pd.DataFrame:
    """One episode on each of the first sets of a bank, all in one batch, each starting upwards from the centre.

    Args:
        policy: what `uavnav.load_policy` returns, or any callable of that form.
        layouts: `train`, `test`, a bank's path, or a tensor [n, k, 3].
        episodes: how many sets, from the first.
        max_steps: an episode that lasts so long is cut off: `truncated`, a censored observation and no collision.
        world: constants and switches.
        reward: a name of `uavnav.rewards.REWARDS`.
        seed: of the generator that the policy is given; also written into the column `seed`.

    Returns:
        A row an episode, the columns of `metrics.EPISODE_COLUMNS` (`frame` is the step of its end, `world` its row).

    Raises:
        LayoutError: the bank cannot be read.
        ValueError: more episodes than the bank has sets, or a count below 1.
    """
    world = world or World()
    bank = layouts if isinstance(layouts, Tensor) else banks.load(layouts)
    if not 1 <= episodes <= len(bank) or max_steps < 1:
        raise ValueError(
            f"episodes={episodes}, max_steps={max_steps}; give 1 to {len(bank)} episodes of at least 1 step"
        )
    generator = torch.Generator().manual_seed(seed)
    row = torch.arange(episodes)
    state = simulator.start(row, torch.full_like(row, UP), world)
    ended: list[dict[str, Tensor]] = []
    with torch.no_grad():
        observation, _ = simulator.observe(state, bank, world)
        for _ in range(max_steps):
            action = policy(observation, generator)
            state, outcome = simulator.step(state, action, bank, world, reward, max_steps)
            done = outcome.terminated | outcome.truncated
            observation = outcome.observation
            if done.any():
                ended.append(_rows(state, outcome, row, done))
                row, state, observation = row[~done], State(*(field[~done] for field in state)), observation[~done]
            if not len(row):
                break
    columns = {name: torch.cat([part[name] for part in ended]).numpy() for name in ended[0]}
    table = pd.DataFrame({"seed": seed, **columns}).astype(EPISODE_COLUMNS)
    return table[list(EPISODE_COLUMNS)].sort_values("world", ignore_index=True)


def _rows(state: State, outcome: simulator.Outcome, row: Tensor, done: Tensor) -> dict[str, Tensor]:
    counts = {name: getattr(state, name)[done] for name in ("layout", *COUNTS)}
    flags = {"terminated": outcome.terminated[done], "truncated": outcome.truncated[done]}
    return {"frame": state.steps[done], "world": row[done], **counts, **flags}


def uniform_random(observation: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Every action equally likely: the free check of the world (90 % turns, 10 % stops, 4.5 px a step)."""
    return torch.randint(World().n_actions, observation.shape[:-1], generator=generator)


def straight_ahead(observation: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Nine pixels a step and never a turn, whatever is in the way."""
    return torch.full(observation.shape[:-1], World().n_distances - 1)
