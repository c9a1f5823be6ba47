"""The six metrics of sec. 4.3, as means over episodes; `definitions` has all that may have been averaged.

A table of episodes has one row per episode and the columns of `EPISODE_COLUMNS`. To add a metric, add a line
to `METRICS`. A metric that counts something new also needs a column in `EPISODE_COLUMNS`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pandas as pd

EPISODE_COLUMNS = {
    "seed": "int64",
    "frame": "int64",  # frames of its seed at the end of the episode
    "env": "int64",  # index of the parallel environment
    "layout": "int64",  # index in the layout file
    "steps": "int64",
    "stops": "int64",
    "full_stops": "int64",
    "turns": "int64",
    "distance": "int64",
    "reward": "float64",
    "terminated": "bool",
    "truncated": "bool",
}
"""Columns that training and evaluation write; a metric of a column that a table lacks is NaN."""
TRAINED, EVALUATED = (
    {name: EPISODE_COLUMNS[name] for name in ("seed", place, "steps", "reward", "terminated", "truncated")}
    for place in ("frame", "layout")
)
"""Columns without which a table of training episodes, or of evaluated ones, is none."""

MODES = ("greedy", "sampled")
"""How a policy acts in an evaluation; sampled DQN has epsilon = 0.05."""

LAST = 100
"""Episodes that count as the last; Stable-Baselines3's log averages the same number."""


class Metric(NamedTuple):
    """A metric of a column: its sum per episode, or its ratio to the steps, times `scale`."""

    label: str
    column: str
    scale: float | None = None  # None: per episode; a number: ratio to steps, times this number
    digits: int = 3  # most decimals in a report
    unit: str = ""
    better: int = 1  # 1: more is better, -1: less is better
    over: str = "collision"  # or `frame`: what the metric definition *per frame* divides a sum by

    def words(self, over: str = "") -> str:
        """In words, with its unit; over: what a sum is divided by, if it is to be said."""
        label = f"{self.label} per {over}" if over and self.scale is None else self.label
        return f"{label} [{self.unit}]" if self.unit else label

    def __str__(self) -> str:
        return self.words("episode")


METRICS: dict[str, Metric] = {
    "steps": Metric("steps", "steps", digits=1),
    "stops": Metric("stops", "stops", 100.0, unit="%", better=-1),
    "full_stops": Metric("full stops", "full_stops", 100.0, unit="%", better=-1),
    "turns": Metric("turning", "turns", 100.0, unit="%", better=-1),
    "distance": Metric("distance", "distance", digits=1, unit="px"),
    "speed": Metric("speed", "distance", 1.0, unit="px a step"),
    "reward": Metric("reward", "reward", over="frame"),
}
"""The report shows every metric of this table."""


FULL_SPEED = 9.0  # px a step


def collided(episodes: pd.DataFrame) -> pd.Series:
    """Whether each episode ended at an obstacle; a goal ends an episode too."""
    return episodes["terminated"] & (episodes.get("succeeded", 0) == 0)


def spl(episodes: pd.DataFrame) -> pd.Series:
    """Success weighted by path length (Anderson et al. 2018), an episode a row: success x shortest /
    max(distance, shortest).
    """
    shortest = episodes["shortest"]
    return episodes["succeeded"] * shortest / np.maximum(episodes["distance"], shortest)


def barn(episodes: pd.DataFrame) -> pd.Series:
    """The score of the BARN challenge (Xiao et al. 2022), an episode a row: success x optimal / steps, the
    steps clipped to 4 to 8 times the optimal ones, which fly the shortest way at full speed. At most 0.25.
    """
    optimal = episodes["shortest"] / FULL_SPEED
    return episodes["succeeded"] * optimal / episodes["steps"].clip(4 * optimal, 8 * optimal)


class Own(NamedTuple):
    """A metric that only some tasks or layouts have: a sum over all episodes of a seed, per what it names."""

    label: str
    columns: tuple[str, ...]  # that a table must have
    counted: Callable[[pd.DataFrame], pd.Series]  # a number an episode
    per: str = ""  # a column of `EPISODE_COLUMNS`, or nothing: per episode


OWN: dict[str, Own] = {
    "passages_per_1000_steps": Own(
        "passages per 1,000 steps", ("passages",), lambda rows: 1000 * rows["passages"], "steps"
    ),
    "passages_per_episode": Own("passages per episode", ("passages",), lambda rows: rows["passages"]),
    "success": Own("success [%]", ("succeeded",), lambda rows: 100 * rows["succeeded"]),
    "collision": Own("collision [%]", ("succeeded",), lambda rows: 100 * collided(rows)),
    "time_out": Own("time-out [%]", ("succeeded",), lambda rows: 100 * rows["truncated"]),
    "spl": Own("SPL", ("succeeded", "shortest"), spl),
    "barn": Own("BARN's score", ("succeeded", "shortest", "danger"), barn),
    "danger": Own("time in danger [%]", ("danger",), lambda rows: 100 * rows["danger"], "steps"),
    "separation": Own("smallest separation [px]", ("separation",), lambda rows: rows["separation"]),
    "curvature": Own(
        "curvature [degrees per 100 px]", ("turned",), lambda rows: 100 * rows["turned"], "distance"
    ),
    "jerk": Own("jerk [px/step³]", ("jerk",), lambda rows: rows["jerk"], "steps"),
}
"""By name; a table shows those whose columns it has."""


PER_EPISODE = {
    "reward": "reward per episode",
    "collisions": "collisions per 1,000 px",
    "survive": "episodes that reach the time limit [%]",
}
"""What episodes in any task are judged by, in words with its unit."""
COLLISIONS_PER = 1000.0  # px


def of_episodes(episodes: pd.DataFrame) -> pd.DataFrame:
    """A row a seed, a column a measure: those of `PER_EPISODE` and of `OWN`."""
    of_seeds, hits = episodes.groupby("seed"), collided(episodes).groupby(episodes["seed"]).sum()
    px = of_seeds["distance"].sum()
    values = {
        "reward": of_seeds["reward"].mean(),
        "collisions": COLLISIONS_PER * hits / px.where(px > 0),
        "survive": 100 * of_seeds["truncated"].mean(),
    }
    return pd.DataFrame(values).join(own(episodes))


def own(episodes: pd.DataFrame) -> pd.DataFrame:
    """The metrics of `OWN` that a table has the columns for: one row per seed, one column per metric."""
    there = {name: one for name, one in OWN.items() if set(one.columns) <= set(episodes.columns)}
    columns = {name: one.counted(episodes) for name, one in there.items()}
    counted = pd.DataFrame(columns, index=episodes.index, dtype=np.float64)
    of_seeds = counted.groupby(episodes["seed"])
    found = of_seeds.mean()
    for name, one in there.items():
        if one.per:
            found[name] = of_seeds[name].sum() / episodes.groupby("seed")[one.per].sum().clip(lower=1)
    return found


def has_ended(episodes: pd.DataFrame) -> pd.Series[bool]:
    """Whether each episode ended; one still open when training ended has neither flag."""
    return episodes["terminated"] | episodes["truncated"]


def finished(episodes: pd.DataFrame) -> pd.DataFrame:
    """The episodes that ended."""
    ended = has_ended(episodes)
    return episodes if ended.all() else episodes[ended]


def in_order(episodes: pd.DataFrame) -> pd.DataFrame:
    """The episodes that ended, each seed's together and in order of time."""
    ended = np.flatnonzero(has_ended(episodes))
    keys = [episodes[name].to_numpy()[ended] for name in ("env", "frame", "seed") if name in episodes]
    is_later = np.ones(max(len(ended) - 1, 0), dtype=bool)
    for change in map(np.diff, keys):
        is_later = (change > 0) | ((change == 0) & is_later)
    if len(ended) == len(episodes) and is_later.all():
        return episodes
    return episodes.iloc[ended[np.lexsort(keys)]]


def last_episodes(episodes: pd.DataFrame, n: int = LAST) -> pd.DataFrame:
    """The last n episodes of each seed that ended."""
    return in_order(episodes).groupby("seed").tail(n)


def counted(episodes: pd.DataFrame) -> pd.DataFrame:
    """What each metric counts, an episode a row: its column, or NaN where the table lacks it."""
    columns = {name: episodes.get(one.column, np.nan) for name, one in METRICS.items()}
    return pd.DataFrame(columns, index=episodes.index, copy=False)


def per_episode(episodes: pd.DataFrame) -> pd.DataFrame:
    """Each episode's metrics: a column a metric."""
    scales = {name: one.scale / episodes["steps"] for name, one in METRICS.items() if one.scale is not None}
    sums = counted(episodes)
    columns = {name: sums[name] * scales[name] if name in scales else sums[name] for name in METRICS}
    return pd.DataFrame(columns, copy=False)


def per_seed(episodes: pd.DataFrame, ratio_of_means: bool = False) -> pd.DataFrame:
    """Mean metrics over the episodes that ended: one row per seed, one column per metric.

    Ratios (stops, full stops, turns, speed) are means of the episodes' ratios. With `ratio_of_means`, they
    are ratios of sums (decision 13). A metric is NaN if the table lacks its column.
    """
    ended = finished(episodes)
    if not ratio_of_means:
        return per_episode(ended).groupby(ended["seed"]).mean()
    of_seeds = counted(ended).groupby(ended["seed"])
    sums = of_seeds.sum(min_count=1)
    ratios = {name: metric.scale for name, metric in METRICS.items() if metric.scale is not None}
    return of_seeds.mean().assign(
        **{name: scale * sums[name] / sums["steps"] for name, scale in ratios.items()}
    )
