"""Episodes and configurations made up of a few numbers, for tests of what a report works out of them."""

from types import SimpleNamespace

import pandas as pd

from uavnav.report.configurations import EMPTY, Configuration
from uavnav.report.studies import Studies
from uavnav.runs.metrics import EPISODE_COLUMNS

USUAL = dict.fromkeys(EPISODE_COLUMNS, 0) | {"terminated": True, "truncated": False}
NO_STUDIES = Studies({}, {}, {}, {}, {}, {}, {}, [])
SETTINGS = {
    "preset": "vectorised",
    "total_frames": 1_000_000,
    "frames": 1_000_000,
    "exploration_fraction": 0.1,
    "n_envs": 16,
    "layouts": "abc",
    "obstacles": 8,
    "reward": "eq14",
    "world.slots": "nearest",
    "world.version": "1",
}


def episodes(columns, *rows):
    """Episodes by the values of some columns, such as ("seed steps", (0, 10)); the rest is 0, and each
    crashes.
    """
    named = [USUAL | dict(zip(columns.split(), row, strict=False)) for row in rows]
    return pd.DataFrame(named, columns=list(EPISODE_COLUMNS)).astype(EPISODE_COLUMNS)


def run(seeds, progress=None, frames=1_000_000, **meta):
    return SimpleNamespace(seeds=[*seeds], meta=meta, frames=frames, progress=progress)


def configuration(rows, key=("ppo", "tanh"), tested=EMPTY, runs=None, n_seeds=None, **settings):
    """A configuration of some episodes; n_seeds: of its one run, by default those that have an episode."""
    runs = runs or [run(range(rows["seed"].nunique() if n_seeds is None else n_seeds))]
    return Configuration(*key, settings, runs, rows, tested)


def in_study(
    algorithm="ppo", activation="tanh", rows=None, tested=EMPTY, n_seeds=2, wall=3600.0, study="", **changes
):
    """A configuration with all the settings that deal it out to a study."""
    own = SETTINGS | changes
    runs = [run(range(n_seeds), frames=own["frames"], wall_seconds=wall, study=study)]
    return configuration(episodes("") if rows is None else rows, (algorithm, activation), tested, runs, **own)
