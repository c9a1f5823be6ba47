"""What the seeds of a run do while they train: what they earn, and how long episodes stay open.

All is of the newest tenth of the run's frames, episodes that go on included. Of each environment at most as
many steps count as a test episode has. Letters: A seeds, W environments of each.
"""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from pydantic import Field

from uavnav import files
from uavnav.runs.tables import Columns
from uavnav.tasks.protocol import MAX_STEPS

if TYPE_CHECKING:
    from torch import Tensor

    from uavnav.tasks.state import State  # brings torch

SHARE = 10  # the newest frames are one of so many parts of a run
MOST_TOLD = 1_000  # seeds that are told of, at most, as the files of settings that contain them are small
POINTS = 12  # of a run's curve
BARS = "▁▂▃▄▅▆▇"
Array = npt.NDArray[np.float64]


class Lately(files.Facts):
    """What the newest frames of a run say; all is empty before its first row of progress."""

    rewards: list[float] = Field(default_factory=list)  # each seed's reward per 1,000 frames
    # each seed's share of environments in which no episode was terminated
    flying: list[float] = Field(default_factory=list)
    lengths: list[float] = Field(default_factory=list)  # each seed's mean steps so far of its open episodes
    # reward per 1,000 frames, the mean over seeds, in each of the `POINTS` parts of the run so far
    curve: list[float] = Field(default_factory=list)


NOTHING = Lately()


def all_seeds(parts: Sequence[Lately]) -> Lately:
    """Of all seeds, from those of some each; the curve goes as far as all have come."""
    told = {
        name: [value for part in parts for value in getattr(part, name)][:MOST_TOLD]
        for name in ("rewards", "flying", "lengths")
    }
    weights = [len(part.rewards) or 1 for part in parts]  # a resumed part has a curve before rewards
    points = zip(*(part.curve for part in parts), strict=False)
    return Lately(**told, curve=[float(np.average(point, weights=weights)) for point in points])


def sparkline(curve: Sequence[float]) -> str:
    """A bar a point from the least to the most, and a dot for each part of the run that is still to come."""
    low, high = min(curve, default=0.0), max(curve, default=0.0)
    steps = (len(BARS) - 1) / (high - low) if high > low else 0.0
    return "".join(BARS[round((value - low) * steps)] for value in curve).ljust(POINTS, "·")


def line(frames: int, total: int, rate: float | None, lately: Lately) -> str:
    """How far a run is and what it does, in 80 columns; rate: frames a second of each seed, where known."""
    pace = f" {rate / 1000:.3g}k/s, {span(max(0, total - frames) / rate)} left" if rate else ""
    done = f"{sparkline(lately.curve)} {min(frames / total, 1):.0%}{pace}"
    if not lately.rewards:
        return done
    opened = f"{np.mean(lately.flying):.0%} open, {np.mean(lately.lengths):.0f} steps"
    return f"{done}; reward/1k {with_spread(lately.rewards, int(len(lately.rewards) == 1))}, {opened}"


def with_spread(values: Sequence[float], digits: int) -> str:
    """A mean, and the standard deviation of several."""
    if not values:
        return "-"
    mean = f"{statistics.mean(values):,.{digits}f}"
    return mean if len(values) == 1 else f"{mean} ± {statistics.stdev(values):,.{digits}f}"


def span(seconds: float) -> str:
    """`40 s`, `4 min`, `3 h`, `12 days`."""
    for unit, size in (("s", 60), ("min", 60), ("h", 48)):
        if seconds < 1.5 * size:
            return f"{seconds:.0f} {unit}"
        seconds /= 24 if unit == "h" else 60
    return f"{seconds:.0f} days"


class Watch:
    """Follows a run from row to row of its progress; total: its frames per seed in the end."""

    def __init__(self, seeds: Sequence[int], n_envs: int, total: int) -> None:
        self._first_seed, self._n_envs, self._total = seeds[0], n_envs, total
        self._earned = np.zeros(len(seeds))  # by the episodes that ended
        self._terminated = np.full((len(seeds), n_envs), -1.0)  # the frame of each environment's newest
        self._marks = deque([(0, self._earned.copy())])  # frames per seed, and what was earned by then [A]
        self._curve: list[float] = []
        self._point = self._marks[0]  # where the newest point of the curve ends

    def add(self, ended: Columns) -> None:
        """Take note of episodes that have ended: columns of `metrics.EPISODE_COLUMNS`."""
        agent, hit = ended["seed"] - self._first_seed, ended["terminated"]
        np.add.at(self._earned, agent, ended["reward"])
        np.maximum.at(self._terminated, (agent[hit], ended["env"][hit]), ended["frame"][hit])

    def resume(self, reward: Tensor, frames: int, curve: list[float]) -> None:
        """Go on after so many frames per seed, with the curve of before; reward [A, W]: of open episodes."""
        self._point, self._curve = (frames, self._earned + _each(reward).sum(1)), curve
        self._marks = deque([self._point])

    def look(self, state: State, frames: int) -> Lately:
        """What the seeds do after so many frames per seed; state [A, W]: of now."""
        now = frames, self._earned + _each(state.reward).sum(1)
        since = frames - min(self._total // SHARE, MAX_STEPS * self._n_envs)
        self._marks.append(now)
        while len(self._marks) > 2 and self._marks[1][0] <= since:
            self._marks.popleft()
        if new := min(frames * POINTS // self._total, POINTS) - len(self._curve):
            self._curve = [*self._curve, *[float(_rate(self._point, now).mean())] * new]
            self._point = now
        first = self._marks[0]
        return Lately(
            rewards=_rate(first, now)[:MOST_TOLD].tolist(),
            flying=(self._terminated <= first[0]).mean(1)[:MOST_TOLD].tolist(),
            lengths=_each(state.steps).mean(1)[:MOST_TOLD].tolist(),
            curve=self._curve,
        )


def _each(field: Tensor) -> Array:
    return np.asarray(field.cpu(), dtype=np.float64)


def _rate(first: tuple[int, Array], last: tuple[int, Array]) -> Array:
    """Reward per 1,000 frames [A] between two marks; a reward of one's own may be no number."""
    return np.nan_to_num(1000 * (last[1] - first[1]) / max(last[0] - first[0], 1))
