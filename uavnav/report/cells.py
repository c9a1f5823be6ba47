"""Cells from run folders: runs of the same settings, whatever their seeds. Nothing here trains.

A *cell* is an algorithm with an activation and all other settings. Frames are per seed throughout.
"""

from __future__ import annotations

import itertools
import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from uavnav.algorithms import ALGORITHMS
from uavnav.runs import Run, paper, run_folders, trials
from uavnav.runs.metrics import EPISODE_COLUMNS, MODES, finished, in_order, last_episodes, per_seed
from uavnav.runs.readings import (
    ALL,
    EVALUATIONS,
    LAST_EPISODES,
    LOG_CURVE,
    PER_FRAME,
    TOTALS,
    log_curve,
    per_frame,
    within,
)
from uavnav.runs.tables import RunError
from uavnav.tasks.faults import NO_FAULTS, Faults
from uavnav.tasks.world import World

BINS = 25
"""Points of a learning curve: a run's frames fall into so many bins."""
TASK = "drone"
"""The task of a run that names none."""
UNSAID = {"task": TASK, "stack": 1, "faults": NO_FAULTS.model_dump()}
"""Settings of a run that does not name them."""
PARTS = {"world": World, "faults": Faults}
"""The tables of a configuration: a field is a setting of its own."""
WORLDS = "worlds"
"""The folder, in a report's, of the study of that name, which `report.worlds` reads."""
NO_SETTINGS = ("algorithm", "activation", "seed", "n_seeds")
NAMED = ("preset", "frames", "n_envs", "obstacles", "reward", "init")
"""Settings that every section names; it names others where cells differ in them or from their preset."""
EMPTY = pd.DataFrame(columns=[*EPISODE_COLUMNS, "mode"]).astype(EPISODE_COLUMNS)
OF_ENDED = (LOG_CURVE, ALL, TOTALS, LAST_EPISODES)
"""Readings of the training episodes that ended."""
Key = tuple[str, str]
"""Algorithm and activation."""


class Counts(NamedTuple):
    """How many episodes a reading is of; cap: the steps at which some were cut off, 0 where none was."""

    seeds: int
    episodes: int
    cut: int
    cap: int


@dataclass(frozen=True, eq=False)
class Cell:
    """Runs that differ in their seeds alone."""

    algorithm: str
    activation: str
    settings: dict[str, Any]  # all else that its runs share
    runs: list[Run]
    episodes: pd.DataFrame  # of training, the columns of `metrics.EPISODE_COLUMNS`
    evaluation: pd.DataFrame  # the same and `mode`; no rows where there is none
    label: str = ""
    known: dict[str, tuple[pd.DataFrame, Counts]] = field(default_factory=dict, init=False, repr=False)  # by reading
    curves: dict[str, pd.DataFrame] = field(default_factory=dict, init=False, repr=False)  # by column

    @property
    def study(self) -> str:
        """The study that its first run names, if it is of one."""
        return str(self.runs[0].meta.get("study", ""))

    def labelled(self, label: str) -> Cell:
        """The same under a label."""
        same = replace(self, label=label)
        same.known.update(self.known)
        same.curves.update(self.curves)
        return same


def collect(folders: Sequence[Path]) -> tuple[list[Cell], list[str]]:
    """The cells of all runs in some folders, and one line for each run or table that is of no use.

    Raises:
        RunError: a folder is missing or holds no run, or no run can be used.
    """
    walked = [run_folders(folder) for folder in folders]
    apart = [folder.resolve() for folder in of_worlds(folders)]
    there = {path.resolve(): path for found, _ in walked for path in found}
    main = {key: path for key, path in there.items() if not any(key.is_relative_to(one) for one in apart)}
    paths = _beside_tuning(folders, main)
    cells: dict[str, Cell] = {}
    left_out = []
    for path in paths.values():
        try:
            cell = read(path)
            key = json.dumps([cell.algorithm, cell.activation, cell.settings], sort_keys=True, default=str)
            cells[key] = _merged(cells[key], cell) if key in cells else cell
        except RunError as error:
            left_out.append(one_line(error))
    if not cells and main == there:
        raise RunError(f"{', '.join(map(str, folders))}: no run that can be used; {left_out[0]}")
    return list(cells.values()), [*left_out, *(line for _, strays in walked for line in strays)]


def of_worlds(folders: Sequence[Path]) -> list[Path]:
    """The folders of the study `worlds` in those of a report."""
    found = [folder / WORLDS for folder in folders]
    return [folder for folder in found if folder.is_dir() and not (folder / "config.yaml").exists()]


def _beside_tuning(folders: Sequence[Path], paths: Mapping[Path, Path]) -> Mapping[Path, Path]:
    """Without the runs of a study that tunes, which has a section of its own; if it is all there is, its defaults."""
    tuned = [folder.resolve() for folder in trials.folders(folders)]
    beside = {key: path for key, path in paths.items() if not any(key.is_relative_to(folder) for folder in tuned)}
    defaults = {
        key: path for key, path in paths.items() if any(key.is_relative_to(folder / "default") for folder in tuned)
    }
    return beside or defaults or paths


def read(path: Path) -> Cell:
    """The cell of one run.

    Raises:
        RunError: it is missing, damaged, not finished, or lacks what a report needs.
    """
    run = Run(path)
    if "n_envs" not in run.config:
        raise RunError(f"{path / 'config.yaml'}: does not say in how many environments; not a run of this package")
    for key in ("bank", "versions", "beyond_preset"):
        run.meta.setdefault(key, {})
    evaluation = run.evaluation()
    run.meta["evaluation"] = "none" if evaluation is None else _protocol(run, evaluation)
    return Cell(
        run.algorithm,
        run.config["activation"],
        settings_of(run),
        [run],
        _checked(run, "episodes", run.episodes),
        EMPTY if evaluation is None else _checked(run, "evaluation", evaluation),
    )


def _protocol(run: Run, rows: pd.DataFrame) -> str:
    """Which evaluation was read: its file, its sets of obstacles, its bank and its cap; and which files were not."""
    cut = rows.loc[rows["truncated"], "steps"]
    cap = rows.attrs.get("max_steps", cut.max() if len(cut) else "not known")
    bank = rows.attrs.get("layouts", "not known")
    own, *others = (path.name for path in run.evaluations())
    read = f"{own}, {rows['layout'].nunique()} sets of obstacles (bank {bank}), at most {show(cap)} steps"
    return read + (f"; not read: {', '.join(others)}" if others else "")


def settings_of(run: Run) -> dict[str, Any]:
    """All that a run's episodes depend on, except algorithm, activation and seeds.

    A field of the world is `world.<field>`; whatever a run of the task `drone` does not name is a default of `World`. A
    bank is its checksum, whatever path led to it.
    """
    config = {"layouts": "train", **flat(UNSAID), **flat(run.config)}
    if config["task"] == TASK:
        config = flat({"world": World().model_dump()}) | config
    bank, layouts = run.meta["bank"], str(config.pop("layouts"))
    facts = {
        "frames": run.frames,
        "obstacles": bank.get("k", "not known"),
        "bank": bank.get("sha256", layouts),
        "world.version": run.meta["versions"].get("world", "not known"),
    }
    return {key: value for key, value in config.items() if key not in NO_SETTINGS} | facts


def flat(config: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration with the fields of its tables as `world.<field>`."""
    rest = dict(config)
    for part, kind in PARTS.items():
        own = rest.pop(part) if isinstance(rest.get(part), dict) else {}
        usual = kind().model_dump()
        for name, value in own.items():
            is_float = type(value) is int and isinstance(usual.get(name), float)
            rest[f"{part}.{name}"] = float(value) if is_float else value  # 90 is 90.0
    return rest


def _checked(run: Run, name: str, rows: pd.DataFrame) -> pd.DataFrame:
    """The columns that rows of episodes have; or a RunError."""
    if not set(rows["seed"]) <= set(run.seeds):
        raise RunError(f"{run.path / name}.parquet: has seeds that config.yaml has not")
    columns = [column for column in (*EPISODE_COLUMNS, "mode") if column in rows]
    return rows if columns == [*rows] else rows[columns]  # no copy, for the rows of many seeds are gigabytes


def _merged(cell: Cell, other: Cell) -> Cell:
    (added,) = other.runs
    for run in cell.runs:
        if twice := sorted({*run.seeds} & {*added.seeds}):
            raise RunError(f"{added.path}: its seed {twice[0]} is in {run.path} already, with the same settings")
    return replace(
        cell,
        runs=[*cell.runs, added],
        episodes=_joined(cell.episodes, other.episodes),
        evaluation=_joined(cell.evaluation, other.evaluation),
    )


def _joined(*tables: pd.DataFrame) -> pd.DataFrame:
    return pd.concat([table for table in tables if len(table)] or tables[:1], ignore_index=True)


def algorithms(keys: Iterable[Key]) -> list[str]:
    """The algorithms of some cells, in order."""
    return list(dict.fromkeys(algorithm for algorithm, _ in sorted(keys, key=order)))


def order(key: Key) -> tuple[int | bool | str, ...]:
    """Where a cell stands: the paper's activations before others, the paper's algorithms before those of the table."""
    algorithm, activation = key
    known, of_paper = [*paper.TABLE_OF, *ALGORITHMS, algorithm], [*paper.ACTIVATIONS, activation]
    is_other = activation not in paper.ACTIVATIONS
    return is_other, known.index(algorithm), algorithm, of_paper.index(activation), activation


def label(cells: list[Cell]) -> tuple[list[Cell], str]:
    """An algorithm's cells in the paper's order, labelled by how each differs from what is usual, and what is usual."""
    settings = [{key: show(value) for key, value in cell.settings.items()} for cell in cells]
    differing = {key for one in settings for key in one if len({other.get(key) for other in settings}) > 1}
    differing -= {"total_frames"} if "frames" in differing else set()
    beyond = {key for cell in cells for run in cell.runs for key in flat(run.meta["beyond_preset"])} - {"layouts"}
    named = [*NAMED, *sorted((differing | beyond).difference(NAMED))]
    usual = {key: Counter(one.get(key) for one in settings).most_common(1)[0][0] for key in named if cells}
    labelled = []
    for cell, own in zip(cells, settings, strict=True):
        changes = ", ".join(f"{key}={own.get(key)}" for key in usual if own.get(key) != usual[key])
        labelled.append(cell.labelled(f"{cell.activation} ({changes})" if changes else cell.activation))
    labelled.sort(key=lambda cell: (*order((cell.algorithm, cell.activation)), cell.label))
    return labelled, ", ".join(f"{key}={value}" for key, value in usual.items())


def episodes_of(cell: Cell, reading: str) -> pd.DataFrame:
    """The episodes that a reading is of."""
    if reading in EVALUATIONS:
        mode = MODES[EVALUATIONS.index(reading)]
        return finished(cell.evaluation[cell.evaluation["mode"] == mode])
    return cell.episodes if reading == PER_FRAME else _of_ended(cell)[reading]


def read_as(cell: Cell, reading: str) -> pd.DataFrame:
    """A row a seed and a column a metric; no rows where there are no episodes, or the log's rhythm is not known.

    It is worked out once, however often it is asked for: leave the table as it is.
    """
    return _known(cell, reading)[0]


def counts(cell: Cell, reading: str) -> Counts:
    """How many seeds and episodes a reading is of; worked out once, as `read_as` is."""
    return _known(cell, reading)[1]


def counted(episodes: pd.DataFrame) -> Counts:
    """How many some rows are."""
    cut = episodes.loc[episodes["truncated"], "steps"]
    return Counts(episodes["seed"].nunique(), len(episodes), len(cut), int(cut.max()) if len(cut) else 0)


def _known(cell: Cell, reading: str) -> tuple[pd.DataFrame, Counts]:
    if reading not in cell.known:
        episodes = {reading: episodes_of(cell, reading)} if reading not in OF_ENDED else _of_ended(cell)
        cell.known.update({one: (_read_as(cell, one, rows), counted(rows)) for one, rows in episodes.items()})
    return cell.known[reading]


def _of_ended(cell: Cell) -> dict[str, pd.DataFrame]:
    """The episodes of each reading of `OF_ENDED`, which share one table in order: it is large where seeds are many."""
    ended = in_order(cell.episodes)
    return dict.fromkeys(OF_ENDED, ended) | {LAST_EPISODES: last_episodes(ended)}


def _read_as(cell: Cell, reading: str, episodes: pd.DataFrame) -> pd.DataFrame:
    own = cell.settings
    if reading == PER_FRAME:
        return per_frame(episodes, own["frames"])
    if reading == LOG_CURVE:
        rhythm = ALGORITHMS[cell.algorithm].rhythm(own) if cell.algorithm in ALGORITHMS else None
        return log_curve(episodes, own["frames"], *rhythm) if rhythm else per_seed(episodes[:0])
    return per_seed(episodes, ratio_of_means=reading == TOTALS)


def windowed(cell: Cell, column: str, windows: Sequence[tuple[float, float]]) -> pd.DataFrame:
    """A column of training per frame in windows of frames: a row a seed, a column a window (`readings.within`)."""
    own = cell.settings
    at_end = {"reward": own.get("world.collision_reward", World().collision_reward), "terminated": 1.0}
    return within(cell.episodes, column, windows, own["n_envs"], at_end.get(column, 0.0))


def curve(cell: Cell, column: str) -> pd.DataFrame:
    """A column per frame in each of `BINS` equal stretches of training (index: its middle) and of each seed.

    It is worked out once, as `read_as` is.
    """
    if column not in cell.curves:
        edges = np.linspace(0, cell.settings["frames"], BINS + 1)
        seeds = windowed(cell, column, [*itertools.pairwise(edges)])
        cell.curves[column] = seeds.T.set_axis((edges[:-1] + edges[1:]) / 2)
    return cell.curves[column]


def show(value: object) -> str:
    return f"{value:,}" if isinstance(value, (int, np.integer)) and not isinstance(value, bool) else one_line(value)


def one_line(text: object) -> str:
    return " ".join(str(text).split())
