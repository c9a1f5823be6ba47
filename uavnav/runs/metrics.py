"""The six metrics of sec. 4.3, from rows of episodes, in every reading that the paper's words allow.

A table of episodes has one row an episode and the columns of `EPISODE_COLUMNS`. To add a metric, add a line to
`METRICS`, and if it counts something new a column to `EPISODE_COLUMNS`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pandas as pd

FIRST_COLUMNS = {
    "seed": "int64",
    "frame": "int64",  # of its seed, at the end of the episode
    "world": "int64",  # which of the seed's parallel worlds
    "layout": "int64",  # index of the obstacle set in the bank
    "steps": "int64",
    "stops": "int64",
    "full_stops": "int64",
    "turns": "int64",
    "distance": "int64",
    "reward": "float64",
    "terminated": "bool",
    "truncated": "bool",
}
"""What every run has."""
EPISODE_COLUMNS: dict[str, str] = FIRST_COLUMNS | {}
"""These and what came later, which older runs lack: metrics of it are NaN for them."""

MODES = ("greedy", "sampled")
"""How a trained policy is evaluated: its best action always, or as in training (sampled DQN means epsilon = 0.05)."""

LAST = 100
"""Episodes in the second reading: what Stable-Baselines3 averages in its log."""


class Metric(NamedTuple):
    """A metric as printed: a count per episode, or scale x count / steps (of: the column, as a ratio to steps)."""

    label: str
    column: str
    scale: float | None = None  # None: per episode; else a ratio to steps, times this
    digits: int = 3  # decimals in a report, at most
    unit: str = ""
    better: int = 1  # 1: more is better, -1: less is

    def __str__(self) -> str:
        return f"{self.label} [{self.unit}]" if self.unit else self.label


METRICS: dict[str, Metric] = {
    "steps": Metric("steps per episode", "steps", digits=1),
    "stops": Metric("stops", "stops", 100.0, unit="%", better=-1),
    "full_stops": Metric("full stops", "full_stops", 100.0, unit="%", better=-1),
    "turns": Metric("turning", "turns", 100.0, unit="%", better=-1),
    "distance": Metric("distance per episode", "distance", digits=1, unit="px"),
    "speed": Metric("speed", "distance", 1.0, unit="px a step"),
    "reward": Metric("reward per episode", "reward"),
}
"""To show one more in the report takes no more than its line here."""


def finished(episodes: pd.DataFrame) -> pd.DataFrame:
    """The episodes that ended; those still open when a run stopped have neither flag."""
    return episodes[episodes["terminated"] | episodes["truncated"]]


def last_episodes(episodes: pd.DataFrame, n: int = LAST) -> pd.DataFrame:
    """The last n episodes of each seed that ended."""
    ended = finished(episodes).sort_values(["seed", "frame", "world"], kind="stable")
    return ended.groupby("seed").tail(n)


def per_seed(episodes: pd.DataFrame, ratio_of_means: bool = False) -> pd.DataFrame:
    """One row a seed, one column a metric, over the episodes that ended.

    Ratios (stops, full stops, turns, speed) are the mean of each episode's ratio, or, with `ratio_of_means`, the ratio
    of the sums (decision 13). A metric whose column the rows lack is NaN.
    """
    ended = finished(episodes)
    ended = ended.assign(**{one.column: np.nan for one in METRICS.values() if one.column not in ended})
    ratios = {name: metric.scale for name, metric in METRICS.items() if metric.scale is not None}
    counted = pd.DataFrame({name: ended[metric.column] for name, metric in METRICS.items()})
    if ratio_of_means:
        seeds, steps = counted.groupby(ended["seed"]), ended.groupby("seed")["steps"].sum()
        sums = seeds[list(ratios)].sum(min_count=1)
        return seeds.mean().assign(**{name: scale * sums[name] / steps for name, scale in ratios.items()})
    counted = counted.assign(**{name: scale * counted[name] / ended["steps"] for name, scale in ratios.items()})
    return counted.groupby(ended["seed"]).mean()
