"""The page of benchmarks: a section each, with the date and the commit; `page.md` has titles and texts."""

from __future__ import annotations

import datetime
import importlib.metadata
import platform
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pandas as pd

from uavnav import files
from uavnav.bench import Result
from uavnav.bench.jobs import Results
from uavnav.bench.plan import BATCHES, CORES
from uavnav.training.provenance import git_commit, processor

TEXTS = Path(__file__).with_name("page.md")
MARK = re.compile(r"^<!-- bench: (\w+) -->\n", flags=re.MULTILINE)
PACKAGES = ("torch", "torchrl", "stable-baselines3", "sbx-rl")


# -- the tables -----------------------------------------------------------------------------


HEADS = {
    **{str(batch): f"{batch:,}" for batch in BATCHES},
    "startup": "start-up [s]",
    "rate": "frames/s",
    "gflops": "GFLOP/s a core",
    "whole": "1 M frames",
    "times": "times",
    "peak": "peak [GB]",
}
"""The columns of all tables in their order; a table has those of which something was found."""


def frame(results: Results) -> pd.DataFrame:
    """A row for each measurement that found something: medians over rounds, and what is known of it."""
    records = []
    for one, turn, found in results.rows:
        row: Result = {"name": one.name, "turn": turn, "base": one.base} | found
        if "whole" in found:
            seeds = one.arguments.get("n_seeds", 1)
            row |= {"rate": found["rate"] * seeds, "per_seed": found["whole"] / seeds / one.copies}
        elif "rate" in found:  # the environment's memory is that of torch
            row["peak"] = float("nan")
        records.append(row | {"speed": 1 / row["per_seed"] if "per_seed" in row else row.get("rate")})
    rows = pd.DataFrame(records)
    rows["speed"] = rows["speed"].astype(float)
    speed = rows.set_index(["name", "turn"])["speed"]
    rows["times"] = rows["speed"] / speed.reindex(pd.MultiIndex.from_frame(rows[["base", "turn"]])).to_numpy()
    numbers = rows.select_dtypes("number").columns
    ways = {name: "median" if name in numbers else "first" for name in rows}
    return rows.groupby("name", sort=False).agg(ways)


def show(key: str, value: Any) -> str:
    """Three significant digits, with commas between thousands; a clock for a run; a dash for nothing."""
    if isinstance(value, str):
        return value
    if pd.isna(value):
        return "-"
    if key == "whole":
        return str(datetime.timedelta(seconds=round(value)))
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def sections(results: Results) -> dict[str, list[str]]:
    """The table of each section of which something was measured, and what could not be."""
    rows = frame(results) if results.rows else pd.DataFrame(index=pd.Index([], dtype=str))
    found = {}
    for name in dict.fromkeys(name.split("/")[0] for name in (*rows.index, *results.missing)):
        found[name] = _table(rows[rows.index.str.startswith(f"{name}/")])
        missing = [f"- `{row}`: {why}" for row, why in results.missing.items() if row.startswith(f"{name}/")]
        if missing:
            found[name] += ["", "Not measured:", "", *missing]
    return found


def _table(rows: pd.DataFrame) -> list[str]:
    """The columns in which there is something."""
    texts = {key: [show(key, value) for value in rows[key]] for key in HEADS if key in rows}
    shown = {key: column for key, column in texts.items() if set(column) - {"-"}}
    table = [["", *map(HEADS.__getitem__, shown)], ["---", *["--:"] * len(shown)]]
    for name, *row in zip(rows.index, *shown.values(), strict=True):
        table.append([name.split("/", 1)[1], *row])
    return [f"| {' | '.join(row)} |" for row in table if shown]


# -- the file -------------------------------------------------------------------------------


def machine() -> str:
    """The machine and the versions, in a sentence."""
    versions = [f"python {platform.python_version()}"]
    for name in PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            versions.append(f"{name} {importlib.metadata.version(name)}")
    return f"{processor()}, {CORES} cores, {files.MEMORY_BYTES / 1e9:.0f} GB; {', '.join(versions)}"


def read_sections(path: Path) -> dict[str, str]:
    """The sections of a file as they stand, the text before the first as ""; none of no file."""
    if not path.is_file():
        return {}
    head, *parts = MARK.split(path.read_text(errors="replace"))
    return dict(zip(["", *parts[::2]], (text.strip() for text in (head, *parts[1::2])), strict=True))


def write_sections(path: Path, tables: Mapping[str, Sequence[str]], mark: str = "") -> None:
    """Put sections into the file in place of the old ones; the file is whole or as it was. Raises OSError.

    tables: the lines below each section's text; mark: said with the date.
    """
    texts, old = read_sections(TEXTS), read_sections(path)
    today = datetime.datetime.now(datetime.UTC).date()
    said = f"*{today}, commit {git_commit(10) or 'unknown'}{mark and f', {mark}'}; {machine()}.*"
    new = {name: "\n".join([texts[name], "", said, "", *lines]) for name, lines in tables.items()}
    every = dict.fromkeys(texts, "") | old | new | {"": texts[""]}  # sections without a text stay last
    parts = [f"<!-- bench: {name} -->\n{text}" if name else text for name, text in every.items() if text]
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write(path, ("\n\n".join(parts) + "\n").encode())
