"""The metric definitions: all that the paper's tables may have averaged over (decision 12).

A metric definition is a table with a row a seed and a column a metric of `metrics.METRICS`. Frames are per
seed. An episode of s steps in one of W parallel environments that ended at frame f lasted from f - s W to f.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from uavnav.algorithms import ALGORITHMS
from uavnav.runs.metrics import LAST, METRICS, MODES, counted, in_order, per_episode

PER_FRAME = "per frame"
"""The primary metric definition: of all frames, those of episodes open at the end too."""
LOG_CURVE = "log curve"
"""What Stable-Baselines3 logs, averaged: most likely what the paper printed."""
ALL = "all training episodes"
TOTALS = f"{ALL}, ratios of totals"
LAST_EPISODES = f"last {LAST} training episodes"
GREEDY, SAMPLED = EVALUATIONS = tuple(f"{mode} evaluation" for mode in MODES)
DEFINITIONS = (PER_FRAME, LOG_CURVE, ALL, TOTALS, LAST_EPISODES, *EVALUATIONS)
"""In the order of the report."""


def words(metric: str, definition: str) -> str:
    """A metric as a metric definition takes it: `reward per frame`."""
    return METRICS[metric].words(METRICS[metric].over if definition == PER_FRAME else "episode")


def decimals(metric: str, definition: str) -> int:
    """How many a metric is shown with: four where it is a small part of 1, as a frame's reward."""
    one = METRICS[metric]
    return 4 if definition == PER_FRAME and one.scale is None and one.over == "frame" else min(one.digits, 2)


def per_frame(episodes: pd.DataFrame, frames: int) -> pd.DataFrame:
    """Reward, stops, turns and speed per frame of all frames; steps and distance per collision.

    Sums are over all rows, episodes open at the end too, and are divided by the frames of a seed or its
    collisions. A seed without a collision has NaN per collision. frames: that each seed had.
    """
    seed = episodes["seed"]
    sums = counted(episodes).groupby(seed).sum(min_count=1)
    collisions = episodes["terminated"].groupby(seed).sum()
    table = {}
    for name, metric in METRICS.items():
        of_frames = metric.scale is not None or metric.over == "frame"
        table[name] = (
            (metric.scale or 1) * sums[name] / (frames if of_frames else collisions.where(collisions > 0))
        )
    return pd.DataFrame(table)


def as_logged(
    algorithm: str, settings: Mapping[str, Any], episodes: pd.DataFrame, frames: int
) -> pd.DataFrame | None:
    """The `log_curve` of a training; None where it is not known when Stable-Baselines3 logs."""
    known = ALGORITHMS.get(algorithm)
    rhythm = known.rhythm(settings) if known else None
    return log_curve(episodes, frames, *rhythm) if rhythm else None


def log_curve(episodes: pd.DataFrame, frames: int, unit: str, every: int) -> pd.DataFrame:
    """The mean over a run's log of Stable-Baselines3's `rollout/ep_rew_mean`; of other metrics likewise.

    An entry of the log is the mean of the last 100 episodes that have ended by then; ratios are means of the
    episodes' ratios. Episodes that end in one step of all environments are all in the mean before any is
    counted. A seed without an entry has NaN.

    frames: that each seed had; unit, every: it logs every so many `frames` per seed or finished `episodes`.
    """
    ended = in_order(episodes)
    seeds, ends = ended["seed"].unique(), ended["frame"].to_numpy()
    first = np.searchsorted(ended["seed"], seeds)
    values = [column.to_numpy(np.float64) for _, column in per_episode(ended).items()]
    means = np.full((len(seeds), len(METRICS)), np.nan)
    for place, (low, high) in enumerate(itertools.pairwise([*first, len(ended)])):
        own = ends[low:high]
        logged = own[every - 1 :: every] if unit == "episodes" else np.arange(every, frames + 1, every)
        behind = np.searchsorted(own, logged, side="right")
        if len(behind := behind[behind > 0]):
            rows = np.stack([column[low:high] for column in values], 1)
            sums = np.vstack([np.zeros(len(METRICS)), rows.cumsum(0)])
            since = np.maximum(behind - LAST, 0)
            means[place] = ((sums[behind] - sums[since]) / (behind - since)[:, None]).mean(0)
    return pd.DataFrame(means, pd.Index(seeds, name="seed"), list(METRICS))


def last_hundred(episodes: pd.DataFrame, column: str, windows: Sequence[tuple[float, float]]) -> pd.DataFrame:
    """The mean over windows of frames of `rollout/ep_rew_mean`: a row a seed, a column a window.

    That is the mean over the last 100 episodes that have ended. Frames before the first end do not count.
    """
    rows = {}
    for seed, own in in_order(episodes).groupby("seed"):
        sums = np.concatenate([[0.0], own[column].to_numpy(np.float64).cumsum()])
        ended = np.arange(1, len(sums))
        since = np.maximum(ended - LAST, 0)
        logged = (sums[ended] - sums[since]) / (ended - since)
        ends = np.append(own["frame"].to_numpy(np.float64), math.inf)
        frames = [np.diff(np.clip(ends, *window)) for window in windows]
        rows[seed] = [logged @ one / one.sum() if one.sum() else math.nan for one in frames]
    index = pd.Index([*rows], name="seed")
    return pd.DataFrame([*rows.values()], index, range(len(windows)), dtype=np.float64)


def within(
    episodes: pd.DataFrame,
    column: str,
    windows: Sequence[tuple[float, float]],
    n_envs: int,
    collision: float = 0.0,
) -> pd.DataFrame:
    """A column's sum per frame in windows [low, high) of frames: a row a seed, a column a window.

    An episode's sum is spread evenly over its frames, but what a `collision` brings is in its last frame.
    """
    edges, place = np.unique(np.asarray(windows, dtype=np.float64), return_inverse=True)
    owner, seeds = pd.factorize(episodes["seed"], sort=True)
    steps, end, total = (episodes[name].to_numpy(np.float64) for name in ("steps", "frame", column))
    at_end = collision * episodes["terminated"].to_numpy(np.float64)
    first = np.searchsorted(edges, end - steps * n_envs, side="right")  # edges that an episode begins behind
    behind = np.searchsorted(edges, end)  # and those that it ends behind
    size = len(seeds), len(edges) + 1
    whole = first == behind  # between two edges
    sums = np.bincount(owner[whole] * size[1] + behind[whole], total[whole], math.prod(size)).reshape(size)
    before = sums.cumsum(1)[:, :-1].astype(np.float64)  # of no episodes, bincount counts in int64
    owner, steps, end, total, at_end = (column[~whole] for column in (owner, steps, end, total, at_end))
    for index, edge in enumerate(edges):
        part = np.clip((edge - end) / (steps * n_envs) + 1, 0, 1)  # the part of each episode before the edge
        earned = (total - at_end) * part + at_end * (end <= edge)
        before[:, index] += np.bincount(owner, earned, len(seeds))
    low, high = place.reshape(-1, 2).T
    return pd.DataFrame(
        (before[:, high] - before[:, low]) / (edges[high] - edges[low]), pd.Index(seeds, name="seed")
    )
