"""The tables of a run's folder as Parquet files: whole or not there, checked when read, locked while written."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from filelock import FileLock, Timeout

from uavnav import files
from uavnav.runs.metrics import LAST, finished

Columns = dict[str, np.ndarray[Any, Any]]

LOCK = ".lock"


class RunError(RuntimeError):
    """A run's folder cannot be used or read; the message says what is wrong and what would be right."""


@contextlib.contextmanager
def lock(path: Path) -> Iterator[None]:
    """Keep others from writing into a run's folder meanwhile.

    Raises:
        RunError: another process writes there now, or it cannot be written.
    """
    held = FileLock(path / LOCK)
    try:
        held.acquire(blocking=False)
    except Timeout:
        raise RunError(f"{path}: another process is writing this run; wait for it") from None
    except OSError as error:
        raise RunError(f"{path}: cannot be written ({error}); give a folder that can be written") from error
    try:
        yield
    finally:
        Path(held.lock_file).unlink(missing_ok=True)
        held.release()


def read_table(path: Path, columns: Mapping[str, str], again: str) -> pd.DataFrame:
    """A Parquet file that has these columns in these types, and maybe more.

    again: how to get a good one, for the message.

    Raises:
        RunError: it is missing, damaged, or another table.
    """
    try:
        table = pd.read_parquet(io.BytesIO(path.read_bytes()), page_checksum_verification=True)
    except Exception as error:  # pyarrow raises nearly every kind for a damaged file, in any number of lines
        raise RunError(f"{path}: missing or damaged; {again}") from error
    for column, kind in columns.items():
        if str(table.dtypes.get(column)) != kind:
            raise RunError(f"{path}: its columns are not a run's, {column} is no {kind}; {again}")
    return table


def write_table(path: Path, table: pd.DataFrame) -> None:
    """Write a table as Parquet; raises as `write` does."""
    write(path, parquet(table))


def write(path: Path, content: bytes) -> None:
    """Write a file that is whole or not there.

    Raises:
        RunError: it cannot be written.
    """
    try:
        files.write(path, content)
    except OSError as error:
        raise RunError(f"{path}: cannot be written ({error})") from error


def parquet(table: pd.DataFrame) -> bytes:
    """With the bytes of float32 apart: positions, of which no two are alike, take 40 % less so."""
    buffer = io.BytesIO()
    split = [name for name, kind in table.dtypes.items() if kind == "float32"]
    rest = [name for name in table if name not in split]
    table.to_parquet(
        buffer,
        index=False,
        compression="zstd",
        write_page_checksum=True,
        use_dictionary=rest,
        use_byte_stream_split=split,
    )
    return buffer.getvalue()


def with_reward(progress: pd.DataFrame, episodes: pd.DataFrame) -> Columns:
    """Rows of progress, and at each the mean reward over its seed's last 100 episodes until then (nan: none ended)."""
    reward = np.full(len(progress), np.nan)
    if len(episodes):
        of_seed = dict(list(finished(episodes).sort_values(["frame", "world"], kind="stable").groupby("seed")))
        for seed in progress["seed"].unique():
            ended = of_seed.get(seed, episodes[:0])
            means = ended["reward"].rolling(LAST, min_periods=1).mean()
            rows = (progress["seed"] == seed).to_numpy()
            behind = np.searchsorted(ended["frame"], progress["frame"][rows], side="right")
            reward[rows] = np.array([np.nan, *means])[behind]
    return {str(name): column.to_numpy() for name, column in progress.items()} | {"reward": reward}
