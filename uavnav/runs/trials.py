"""What a study that tunes leaves for others to read: its folders, its tables, and which trial won."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from uavnav import files
from uavnav.runs.tables import RunError, read_csv

TUNING, TRIALS, TUNED = "tuning", "trials", "tuned"
"""What a study that tunes writes into: trials, which are no runs of their own, and winners by trial."""
DEFAULT = "default"  # settings of rows of a comparison, other than `TUNED`
DIFFERENCE = "tuned − default"  # settings of a row that compares the winner with the default
TABLE, IMPORTANCE = "trials.csv", "importance.csv"
COLUMNS = {
    "algorithm": "object",
    "trial": "int64",
    "state": "object",
    "value": "float64",
    "settings": "object",
}
OF_IMPORTANCE = {"algorithm": "object", "setting": "object", "importance": "float64"}
MOST_TRIALS = 10**6  # of an algorithm, at most
AGAIN = "carry the study out again"
FINISHED, DIVERGED = "finished", "diverged"  # states of a trial that was told


def best(trials: pd.DataFrame, algorithm: str) -> dict[str, Any] | None:
    """An algorithm's row with the highest value, the first of equals; None where no trial has finished."""
    mine = trials[(trials["algorithm"] == algorithm) & (trials["state"] == FINISHED)]
    return None if mine.empty else {**mine.loc[mine["value"].idxmax()]}


def winner(trial: int) -> str:
    """Where the settings of a trial that won are trained, in `TUNING`."""
    return f"{TUNED}/{trial:03}"


def folders(of: Sequence[Path]) -> list[Path]:
    """The folders of studies that tuned: `tuning` among other studies, or `tuning/tuning`."""
    places = [place for folder in of for place in (folder / TUNING, folder / TUNING / TUNING)]
    return [place for place in places if (place / TABLE).is_file()]


def read(path: Path, columns: Mapping[str, str]) -> pd.DataFrame:
    """One of the tables; no rows where it is not there yet; raises a RunError where it is another one."""
    if not path.exists():
        return pd.DataFrame(columns=list(columns))
    table = read_csv(path, columns, AGAIN)
    if columns == COLUMNS and not all(_is_trial(row) for row in table.to_dict("records")):
        raise RunError(f"{path}: contains other rows than trials; {AGAIN}")
    return table


def _is_trial(row: Mapping[Any, Any]) -> bool:
    try:
        known = isinstance(files.parsed(row["settings"]), dict) and 0 <= row["trial"] < MOST_TRIALS
    except ValueError:
        return False
    known = known and re.fullmatch(r"\w[\w-]*", row["algorithm"]) is not None
    return known and (row["state"] != FINISHED or math.isfinite(row["value"]))
