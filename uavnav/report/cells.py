"""From run folders to cells: runs of the same settings, whatever their seeds. Nothing here trains.

A *cell* is an algorithm with an activation and all other settings. Frames are per seed throughout.
"""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from uavnav.runs import LOG_FOLDERS, Run, paper
from uavnav.runs.metrics import EPISODE_COLUMNS, FIRST_COLUMNS, LAST, MODES, finished, last_episodes
from uavnav.runs.tables import RunError

BINS = 25
"""Of a run's frames, along a learning curve."""
NO_RUNS = ("checkpoint", *LOG_FOLDERS)
"""Folders that are not looked into."""
OF_REPORTS = ("baselines", "tables", "figures")
"""Folders whose files are no run's, and read or written by a report."""
NAMED = ("preset", "frames", "n_worlds", "obstacles", "reward", "init")
"""Settings that every section names; others are named where cells differ in them, or from their preset."""
EMPTY = pd.DataFrame(columns=[*EPISODE_COLUMNS, "mode"]).astype(EPISODE_COLUMNS)


class Cell(NamedTuple):
    """Runs that differ in their seeds alone."""

    algorithm: str
    activation: str
    settings: dict[str, Any]  # all else that its runs share
    runs: list[Run]
    episodes: pd.DataFrame  # of training, the columns of `metrics.EPISODE_COLUMNS`
    evaluation: pd.DataFrame  # the same and `mode`; no rows where there is none
    label: str = ""


def run_folders(folder: Path) -> list[Path]:
    """Every folder with a config.yaml in or below a folder, in order of name; hidden ones are not looked into.

    Raises:
        RunError: it is missing, a file, or holds none.
    """
    return _walk(folder)[0]


def _walk(folder: Path) -> tuple[list[Path], list[str]]:
    """The same, and one line for each table that lies where no run is."""
    if not folder.is_dir():
        problem = "is a file" if folder.exists() else "there is no such folder"
        raise RunError(f"{folder}: {problem}; give a folder that holds runs")
    found, strays = [], []
    for path, names, files in os.walk(folder):
        names[:] = sorted(name for name in names if not name.startswith(".") and name not in NO_RUNS)
        if "config.yaml" in files:
            found.append(Path(path))
        elif "episodes.parquet" in files:
            strays.append(f"{path}: has episodes.parquet and no config.yaml; not a run of this package")
        elif Path(path).name not in OF_REPORTS:
            strays += [f"{path}/{name}: lies where no run is" for name in sorted(files) if name.endswith(".parquet")]
    if not found:
        raise RunError(f"{folder}: holds no run; give a folder that does, or train one with out={folder}/ppo/tanh")
    return found, strays


def collect(folders: Sequence[Path]) -> tuple[list[Cell], list[str]]:
    """The cells of all runs in some folders, and one line for each run or table that is of no use.

    Raises:
        RunError: a folder is missing or holds no run, or no run can be used.
    """
    walked = [_walk(folder) for folder in folders]
    paths = {path.resolve(): path for found, _ in walked for path in found}
    cells: dict[str, Cell] = {}
    left_out = []
    for path in paths.values():
        try:
            cell = read(path)
            key = json.dumps(cell[:3], sort_keys=True, default=str)
            cells[key] = _merged(cells[key], cell) if key in cells else cell
        except RunError as error:
            left_out.append(one_line(error))
    if not cells:
        raise RunError(f"{', '.join(map(str, folders))}: no run that can be used; {left_out[0]}")
    return list(cells.values()), [*left_out, *(line for _, strays in walked for line in strays)]


def read(path: Path) -> Cell:
    """The cell of one run.

    Raises:
        RunError: it is missing, damaged, not finished, or lacks what a report needs.
    """
    run = Run(path)
    config = {"algorithm": run.algorithm} | run.config
    for key, kind in {"algorithm": str, "activation": str, "seed": int, "n_seeds": int}.items():
        if not isinstance(config.pop(key, None), kind):
            raise RunError(f"{path / 'config.yaml'}: has no {key}; not a run of this package")
    if not re.fullmatch(r"[\w-]+", run.algorithm) or not run.seeds:
        raise RunError(f"{path / 'config.yaml'}: names no algorithm or no seeds; not a run of this package")
    for key in ("bank", "versions", "beyond_preset"):
        if not isinstance(run.meta.setdefault(key, {}), dict):
            raise RunError(f"{path / 'meta.json'}: {key} is no table; not a run of this package")
    if not isinstance(run.meta.get("frames"), int) or run.frames < 1:
        raise RunError(f"{path / 'meta.json'}: does not say how many frames were run; not a run of this package")
    bank, world = run.meta["bank"], run.meta["versions"].get("world", "not known")
    facts = {"obstacles": bank.get("k", "not known"), "bank": bank.get("sha256", "not known"), "world": world}
    settings = config | {"frames": run.frames} | facts
    evaluation = run.evaluation()
    return Cell(
        run.algorithm,
        run.config["activation"],
        settings,
        [run],
        _checked(run, "episodes", run.episodes),
        EMPTY if evaluation is None else _checked(run, "evaluation", evaluation, "mode"),
    )


def _checked(run: Run, name: str, rows: pd.DataFrame, *more: str) -> pd.DataFrame:
    """The columns that rows of episodes have, in their types, and more; or a RunError."""
    kinds = {name: kind for name, kind in EPISODE_COLUMNS.items() if name in FIRST_COLUMNS or name in rows}
    try:
        rows = rows[[*kinds, *more]].astype(kinds)
    except (KeyError, ValueError, TypeError) as error:
        raise RunError(f"{run.path / name}.parquet: not a table of episodes ({error})") from error
    if not set(rows["seed"]) <= set(run.seeds):
        raise RunError(f"{run.path / name}.parquet: has seeds that config.yaml has not")
    return rows


def _merged(cell: Cell, other: Cell) -> Cell:
    (added,) = other.runs
    for run in cell.runs:
        if twice := sorted({*run.seeds} & {*added.seeds}):
            raise RunError(f"{added.path}: its seed {twice[0]} is in {run.path} already, with the same settings")
    return cell._replace(
        runs=[*cell.runs, added],
        episodes=_joined(cell.episodes, other.episodes),
        evaluation=_joined(cell.evaluation, other.evaluation),
    )


def _joined(*tables: pd.DataFrame) -> pd.DataFrame:
    filled = [table for table in tables if len(table)]
    return pd.concat(filled, ignore_index=True) if filled else tables[0]


def label(cells: list[Cell]) -> tuple[list[Cell], str]:
    """An algorithm's cells in the paper's order, labelled by how each differs from what is usual, and what is usual."""
    settings = [{key: show(value) for key, value in cell.settings.items()} for cell in cells]
    differing = {key for one in settings for key in one if len({other.get(key) for other in settings}) > 1}
    differing -= {"total_frames"} if "frames" in differing else set()
    beyond = {key for cell in cells for run in cell.runs for key in run.meta["beyond_preset"]}
    named = [*NAMED, *sorted((differing | beyond).difference(NAMED))]
    usual = {key: Counter(one.get(key) for one in settings).most_common(1)[0][0] for key in named if cells}
    labelled = []
    for cell, own in zip(cells, settings, strict=True):
        changes = ", ".join(f"{key}={own.get(key)}" for key in usual if own.get(key) != usual[key])
        labelled.append(cell._replace(label=f"{cell.activation} ({changes})" if changes else cell.activation))
    order = [activation for _, activation in paper.TABLES]
    labelled.sort(key=lambda cell: ([*order, cell.activation].index(cell.activation), cell.label))
    return labelled, ", ".join(f"{key}={value}" for key, value in usual.items())


def readings(cell: Cell) -> dict[str, pd.DataFrame]:
    """The episodes that ended, in each reading of what the paper averages (decision 12)."""
    training = {"all training episodes": cell.episodes, f"last {LAST} training episodes": last_episodes(cell.episodes)}
    modes = {f"{mode} evaluation": cell.evaluation[cell.evaluation["mode"] == mode] for mode in MODES}
    return {name: finished(rows) for name, rows in (training | modes).items()}


def curve(cell: Cell, column: str) -> pd.DataFrame:
    """Means per bin of frames (index: its middle) and seed (columns), over the episodes that ended in it."""
    ended, width = finished(cell.episodes), cell.settings["frames"] / BINS
    middle = (((ended["frame"] - 1) // width).clip(0, BINS - 1) + 0.5) * width
    return ended.groupby([middle, "seed"])[column].mean().unstack("seed")


def show(value: object) -> str:
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else one_line(value)


def one_line(text: object) -> str:
    return " ".join(str(text).split())
