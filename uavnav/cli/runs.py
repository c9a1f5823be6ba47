"""`uavnav runs`: what lies in some folders, read from a few small files of each run. Nothing here trains.

A run that says it is running, and whose `progress.json` is older than a minute, was killed.
"""

from __future__ import annotations

import datetime
import json
import os
import time
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow.compute

from uavnav.cli import commands
from uavnav.errors import complain
from uavnav.runs import (
    FINISHED,
    heard,
    progress,
    read_settings,
    run_folders,
    shipped,
)
from uavnav.runs.evaluations import usual
from uavnav.runs.metrics import MODES
from uavnav.runs.tables import RunError, arrow

MEANS = {f"reward_{mode}": mode for mode in reversed(MODES)}
STATES = {FINISHED: "finished", "failed": "failed"}
"""By the status in meta.json; whatever else it says, a run that does not run was stopped."""


def row(path: Path, now: float) -> dict[str, Any]:
    """What is said of a run: `commands.RUN_COLUMNS`, `total` frames, and its pace where it runs.

    Frames are per seed, so far; they are not known of a run that was stopped. Rewards are means over the
    run's own evaluation. Raises a RunError where its files are no run's.
    """
    config = read_settings(path / "config.yaml")
    if "total_frames" not in config:
        raise RunError(f"{path / 'config.yaml'}: not a run's, its total_frames=None; give a run's folder")
    meta = read_settings(path / "meta.json") if os.path.lexists(path / "meta.json") else {}
    running = _progress(path, now) if meta.get("status") == "running" else {}
    return {
        "run": str(path),
        **{key: config[key] for key in ("algorithm", "activation")},
        "task": str(config.get("task", "drone")),
        "preset": str(config.get("preset", "")),
        "seeds": [config["seed"], config["seed"] + config["n_seeds"] - 1],
        "frames": running.get("frames", meta.get("frames")),
        "total": config["total_frames"],
        "status": "running" if running else STATES.get(str(meta.get("status")), "stopped"),
        **_rewards(path, str(config.get("task", "drone"))),
        "age": _age(str(meta.get("ended") or meta.get("started")), now),
        **_pace(running),
    }


def _progress(path: Path, now: float) -> dict[str, Any]:
    """How far a running run is; empty where it has been silent for a minute."""
    known = progress(path)
    return known if heard(known, now) else {}


def _age(written: str, now: float) -> int | None:
    """Seconds since a time that meta.json names; 0 where the clock was set back since."""
    try:
        return max(0, round(now - datetime.datetime.fromisoformat(written).timestamp()))
    except (ValueError, OverflowError):
        return None


def _pace(running: Mapping[str, Any]) -> dict[str, float]:
    """Frames per second of each seed and the seconds that are left, where they are known."""
    rate = running.get("rate")
    if not rate:
        return {}
    return {"frames_per_second": rate, "seconds_left": (running["total"] - running["frames"]) / rate}


def _rewards(path: Path, task: str) -> dict[str, float | None]:
    """The mean reward of a test episode in each mode, by the run's own protocol."""
    try:
        rows = arrow(path / usual(task).file("evaluation"), ["mode", "reward"])
        flown = {
            column: rows.filter(pyarrow.compute.equal(rows["mode"], mode)) for column, mode in MEANS.items()
        }
        return {column: pyarrow.compute.mean(part["reward"]).as_py() for column, part in flown.items()}
    except (
        OSError,
        ValueError,
        NotImplementedError,
    ):
        # there is none, or it is damaged, or its rewards are words
        return dict.fromkeys(MEANS)


# -- in words ------------------------------------------------------------------------------------------------


def span(seconds: float) -> str:
    """`40 s`, `4 min`, `3 h`, `12 days`."""
    for unit, size in (("s", 60), ("min", 60), ("h", 48)):
        if seconds < 1.5 * size:
            return f"{seconds:.0f} {unit}"
        seconds /= 24 if unit == "h" else 60
    return f"{seconds:.0f} days"


def words(one: Mapping[str, Any]) -> list[str]:
    """A run as the table shows it."""
    first, last = one["seeds"]
    status = one["status"]
    if "seconds_left" in one:
        status += f", {one['frames_per_second'] / 1000:.1f}k frames/s, {span(one['seconds_left'])} left"
    done = f"{one['frames']:,} " if one["frames"] is not None else ""
    shown = {
        **one,
        "seeds": str(first) if first == last else f"{first} to {last}",
        "frames": done.rstrip() if one["status"] in ("finished", "shipped") else f"{done}of {one['total']:,}",
        "status": status,
        "age": "" if one["age"] is None else span(one["age"]),
        **{column: "" if one[column] is None else f"{one[column]:.1f}" for column in MEANS},
    }
    return [str(shown[column]) for column in commands.RUN_COLUMNS]


def order(column: str) -> Callable[[Mapping[str, Any]], tuple[bool, Any]]:
    """What to sort by: frames and rewards from the largest, all else from the first; what is not known
    comes last.
    """

    def key(one: Mapping[str, Any]) -> tuple[bool, Any]:
        value = one[column]
        falling = column in ("frames", *MEANS)
        return value is None, "" if value is None else -value if falling else value

    return key


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """A line a run, numbers to the right."""
    lines = [list(commands.RUN_COLUMNS), *map(words, rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    right = [column in ("seeds", "frames", "age", *MEANS) for column in commands.RUN_COLUMNS]
    told = [
        "  ".join(
            configuration.rjust(width) if to_right else configuration.ljust(width)
            for configuration, width, to_right in zip(line, widths, right, strict=True)
        )
        for line in lines
    ]
    return "\n".join(line.rstrip() for line in told)


def main(arguments: Namespace) -> int:
    """List the runs of some folders: what each is, how far it is, and what it reached."""
    default = [name for name in ("runs", "results") if Path(name).is_dir()]
    now, rows = time.time(), []
    found = [path for folder in arguments.folders or default for path in run_folders(Path(folder))[0]]
    for path in dict.fromkeys(found):
        try:
            rows.append(row(path, now))
        except RunError as error:
            complain("runs", f"left out: {error}")
    rows += [] if arguments.folders else shipped.rows()
    if arguments.sort:
        rows.sort(key=order(arguments.sort))
    print(json.dumps(rows, indent=2) if arguments.json else table(rows))
    return 0
