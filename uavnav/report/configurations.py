"""Configurations from run folders: runs of the same settings, whatever their seeds. Nothing here trains.

A *configuration* is an algorithm with an activation and all other settings. Frames are per seed throughout.
"""

from __future__ import annotations

import functools
import itertools
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from uavnav.algorithms import ALGORITHMS
from uavnav.runs import Run, paper, read_settings, run_folders, trials
from uavnav.runs.definitions import (
    EVALUATIONS,
    LAST_EPISODES,
    LOG_CURVE,
    PER_FRAME,
    TOTALS,
    as_logged,
    last_hundred,
    per_frame,
    within,
)
from uavnav.runs.metrics import EPISODE_COLUMNS, MODES, finished, in_order, last_episodes, per_seed
from uavnav.runs.tables import RunError, joined
from uavnav.settings import flat
from uavnav.tasks.world import World

BINS = 25
"""Points of a learning curve: a run's frames fall into so many bins."""
APART = ("worlds", "longer", "ambiguities", "noise", "activations", "horizon", "learned")
"""Folders, in a report's, of the studies of these names, which modules of their own read."""
NO_SETTINGS = ("algorithm", "activation", "seed", "n_seeds", "keep_at")
MODE = MODES[1]
"""How a policy acts at the end of training: what a report shows where it does not say greedy."""
EMPTY = pd.DataFrame(columns=[*EPISODE_COLUMNS, "mode"]).astype(EPISODE_COLUMNS)
Key = tuple[str, str]
"""Algorithm and activation."""


@dataclass(frozen=True, eq=False)
class Configuration:
    """Runs that differ only in their seeds."""

    algorithm: str
    activation: str
    settings: dict[str, Any]  # all else that its runs share
    runs: list[Run]
    episodes: pd.DataFrame  # of training, the columns of `metrics.EPISODE_COLUMNS`
    evaluation: pd.DataFrame  # the same and `mode`; no rows where there is none
    # episodes by metric definition, once asked for
    known: dict[str, pd.DataFrame] = field(default_factory=dict, init=False, repr=False)

    @property
    def study(self) -> str:
        """The study that its first run names, if it is of one."""
        return str(self.runs[0].meta.get("study", ""))

    @property
    def n_seeds(self) -> int:
        return sum(len(run.seeds) for run in self.runs)

    @functools.cached_property
    def curve(self) -> pd.DataFrame:
        """Reward per frame in each of `BINS` stretches of training (index: its middle) and of each seed."""
        return self._stretched(lambda windows: windowed(self, windows))

    @functools.cached_property
    def logged(self) -> pd.DataFrame:
        """Reward per episode there as Stable-Baselines3 logs it."""
        return self._stretched(lambda windows: last_hundred(self.episodes, "reward", windows))

    def _stretched(self, read: Callable[[Sequence[tuple[float, float]]], pd.DataFrame]) -> pd.DataFrame:
        edges = np.linspace(0, self.settings["frames"], BINS + 1)
        return read([*itertools.pairwise(edges)]).T.set_axis((edges[:-1] + edges[1:]) / 2)


def collect(folders: Sequence[Path]) -> tuple[list[Configuration], list[str]]:
    """The configurations of all runs in some folders, and one line for each run or table that is of no use.

    Raises a RunError where no run can be used.
    """
    walked = [run_folders(folder) for folder in folders]
    elsewhere = [folder.resolve() for study in APART for folder in apart(folders, study)]
    there = {path.resolve(): path for found, _ in walked for path in found}
    main = {
        key: path
        for key, path in there.items()
        if not any(key.is_relative_to(one) for one in elsewhere) or not of_a_study(path)
    }
    paths = _beside_tuning(folders, main)
    configurations: dict[str, Configuration] = {}
    left_out = []
    for path in paths.values():
        try:
            configuration = read(path)
            who = [configuration.algorithm, configuration.activation, configuration.settings]
            key = json.dumps(who, sort_keys=True, default=str)
            configurations[key] = (
                _merged(configurations[key], configuration) if key in configurations else configuration
            )
        except RunError as error:
            left_out.append(str(error))
    if not configurations and main == there:
        raise RunError(f"{', '.join(map(str, folders))}: no run that can be used; {left_out[0]}")
    return list(configurations.values()), [*left_out, *(line for _, strays in walked for line in strays)]


def apart(folders: Sequence[Path], study: str) -> list[Path]:
    """The folders of a study of `APART` in those of a report."""
    found = [folder / study for folder in folders]
    return [folder for folder in found if folder.is_dir() and not (folder / "config.yaml").exists()]


def of_a_study(path: Path) -> bool:
    """Whether a run in a study's folder is of that study: not if it names none. A damaged one may be."""
    try:
        return bool(read_settings(path / "meta.json").get("study"))
    except RunError:
        return True


def _beside_tuning(folders: Sequence[Path], paths: Mapping[Path, Path]) -> Mapping[Path, Path]:
    """Without the runs of a study that tunes; if it is all there is, its defaults."""
    tuned = [folder.resolve() for folder in trials.folders(folders)]

    def below(key: Path, *parts: str) -> bool:
        return any(key.is_relative_to(folder.joinpath(*parts)) for folder in tuned)

    beside = {key: path for key, path in paths.items() if not below(key)}
    return beside or {key: path for key, path in paths.items() if below(key, "default")} or paths


def read(path: Path) -> Configuration:
    """The configuration of one run; raises a RunError where it lacks what a report needs."""
    run = Run(path)
    for key in ("layouts", "versions", "beyond_preset"):
        run.meta.setdefault(key, {})
    file, evaluation = run.evaluated() or ("", None)
    run.meta["evaluation"] = "none" if evaluation is None else _protocol(run, file, evaluation)
    return Configuration(
        run.algorithm,
        run.config["activation"],
        settings_of(run.config, run.meta, run.frames),
        [run],
        _checked(run, "episodes", run.episodes),
        EMPTY if evaluation is None else _checked(run, "evaluation", evaluation),
    )


def _protocol(run: Run, file: str, rows: pd.DataFrame) -> str:
    """Which evaluation was read: its file, layouts and time limit; and which files were not."""
    cut = rows.loc[rows["truncated"], "steps"]
    limit = rows.attrs.get("max_steps", cut.max() if len(cut) else "not known")
    layouts = rows.attrs.get("layouts", "not known")
    others = [path.name for path in run.evaluations() if path.name != file]
    read = f"{file}, {rows['layout'].nunique()} layouts ({layouts}), at most {show(limit)} steps"
    return read + (f"; not read: {', '.join(others)}" if others else "")


def settings_of(config: Mapping[str, Any], meta: Mapping[str, Any], frames: int) -> dict[str, Any]:
    """All that a run's episodes depend on, except algorithm, activation and seeds; layouts are a checksum."""
    own = flat(config)
    all_layouts, layouts = meta.get("layouts", {}), str(own.pop("layouts"))
    facts = {
        "frames": frames,
        "obstacles": all_layouts.get("k", "not known"),
        "layouts": all_layouts.get("sha256", layouts),
        "world.version": meta.get("versions", {}).get("world", "not known"),
    }
    return {key: value for key, value in own.items() if key not in NO_SETTINGS} | facts


def _checked(run: Run, name: str, rows: pd.DataFrame) -> pd.DataFrame:
    """The columns that rows of episodes have; or a RunError."""
    if not set(rows["seed"]) <= set(run.seeds):
        raise RunError(f"{run.path / name}.parquet: has seeds that config.yaml has not")
    columns = [column for column in (*EPISODE_COLUMNS, "mode") if column in rows]
    return rows if columns == [*rows] else rows[columns]  # no copy, for the rows of many seeds are gigabytes


def _merged(configuration: Configuration, other: Configuration) -> Configuration:
    (added,) = other.runs
    for run in configuration.runs:
        if twice := sorted({*run.seeds} & {*added.seeds}):
            there = f"its seed {twice[0]} is in {run.path} already"
            raise RunError(f"{added.path}: {there}, with the same settings")
    return replace(
        configuration,
        runs=[*configuration.runs, added],
        episodes=joined([configuration.episodes, other.episodes]),
        evaluation=joined([configuration.evaluation, other.evaluation]),
    )


def algorithms(keys: Iterable[Key]) -> list[str]:
    """The algorithms of some configurations, in order."""
    return list(dict.fromkeys(algorithm for algorithm, _ in sorted(keys, key=order)))


def order(key: Key) -> tuple[int | bool | str, ...]:
    """Where a configuration stands: the paper's activations first, then the paper's algorithms."""
    algorithm, activation = key
    known, of_paper = [*paper.TABLE_OF, *ALGORITHMS, algorithm], [*paper.ACTIVATIONS, activation]
    is_other = activation not in paper.ACTIVATIONS
    return is_other, known.index(algorithm), algorithm, of_paper.index(activation), activation


def episodes_of(configuration: Configuration, definition: str) -> pd.DataFrame:
    """The episodes that a metric definition is of."""
    if definition in EVALUATIONS:
        mode = MODES[EVALUATIONS.index(definition)]
        return finished(configuration.evaluation[configuration.evaluation["mode"] == mode])
    if definition == PER_FRAME:
        return configuration.episodes
    ended = last_episodes if definition == LAST_EPISODES else in_order
    return ended(configuration.episodes)


def read_as(configuration: Configuration, definition: str) -> pd.DataFrame:
    """A row a seed and a column a metric, worked out once; no rows without episodes, or an unknown rhythm."""
    if (known := configuration.known.get(definition)) is not None:
        return known
    episodes, own = episodes_of(configuration, definition), configuration.settings
    if definition == PER_FRAME:
        found = per_frame(episodes, own["frames"])
    elif definition == LOG_CURVE:
        logged = as_logged(configuration.algorithm, own, episodes, own["frames"])
        found = per_seed(episodes[:0]) if logged is None else logged
    else:
        found = per_seed(episodes, ratio_of_means=definition == TOTALS)
    configuration.known[definition] = found
    return found


def windowed(configuration: Configuration, windows: Sequence[tuple[float, float]]) -> pd.DataFrame:
    """Reward of training per frame: a row a seed, a column a window of frames (`definitions.within`).

    Rows do not tell a goal from a collision, so with goals all reward is spread evenly.
    """
    own = configuration.settings
    at_end = own.get("world.collision_reward", World().collision_reward) * (own.get("task") != "goal")
    return within(configuration.episodes, "reward", windows, own["n_envs"], at_end)


def show(value: object) -> str:
    """A value of a setting, in one line."""
    if isinstance(value, (int, np.integer)) and not isinstance(value, bool):
        return f"{value:,}"
    return " ".join(str(value).split())
