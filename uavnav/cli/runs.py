"""`uavnav runs`: what is in some folders, read from a few small files of each run. Nothing here trains.

A run that says it is running, and whose `progress.json` is older than a minute, was killed.
"""

from __future__ import annotations

import contextlib
import datetime
import json
import operator
import os
import time
from argparse import Namespace
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow.compute
from rich.console import Console, Group, JustifyMethod, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from uavnav.errors import complain
from uavnav.runs import FINISHED, heard, progress, read_settings, run_folders, saved_frames, shipped
from uavnav.runs.evaluations import usual
from uavnav.runs.lately import Lately, line, span
from uavnav.runs.metrics import MODES
from uavnav.runs.tables import RunError, arrow

COLUMNS = ("run", "policy", "seeds", "frames", "status", "sampled", "greedy", "age")
"""Of the table; `sampled` and `greedy` are rewards of a test episode."""
OF_WORDS = ("run", "policy", "status")
WATCH_SECONDS = 2.0
WIDEST = 1_000  # columns of what is no terminal
MEANS = {f"reward_{mode}": mode for mode in reversed(MODES)}
ENDS = (FINISHED, "failed")
"""What meta.json says of a run that has ended; whatever else it says, a run that does not run was stopped."""


def row(path: Path, now: float) -> dict[str, Any]:
    """What is said of a run: `RUN_COLUMNS`, `total` frames, and while it trains its pace and `lately`.

    Frames are per seed: so far, or saved by a run that was stopped. Raises a RunError.
    """
    config = read_settings(path / "config.yaml")
    meta = read_settings(path / "meta.json") if os.path.lexists(path / "meta.json") else {}
    told = progress(path)
    running = told if meta.get("status") == "running" and heard(told, now) else {}
    frames, status = running.get("frames", meta.get("frames")), meta.get("status")
    return {
        "run": str(path),
        **{key: config[key] for key in ("algorithm", "activation", "task", "preset")},
        "seeds": [config["seed"], config["seed"] + config["n_seeds"] - 1],
        "frames": saved_frames(path) or told.get("frames", 0) if frames is None else frames,
        "total": config["total_frames"],
        "status": "running" if running else status if status in ENDS else "stopped",
        **_rewards(path, config["task"]),
        "age": _age(str(meta.get("ended") or meta.get("started")), now),
        **_pace(running),
    }


def _age(written: str, now: float) -> int | None:
    """Seconds since a time that meta.json names; 0 where the clock was set back since."""
    try:
        return max(0, round(now - datetime.datetime.fromisoformat(written).timestamp()))
    except (ValueError, OverflowError):
        return None


def _pace(running: Mapping[str, Any]) -> dict[str, Any]:
    """What a run does while it trains; frames per second of each seed and the seconds left, where known."""
    if not running:
        return {}
    rate, lately = running["rate"], {"lately": running["lately"].model_dump()}
    left = running["total"] - running["frames"]
    return lately | ({"frames_per_second": rate, "seconds_left": left / rate} if rate else {})


def _rewards(path: Path, task: str) -> dict[str, float | None]:
    """The mean reward of a test episode in each mode, by the run's own protocol."""
    try:
        rows = arrow(path / usual(task).file("evaluation"), ["mode", "reward"])
        by_mode = {
            column: rows.filter(pyarrow.compute.equal(rows["mode"], mode)) for column, mode in MEANS.items()
        }
        return {column: pyarrow.compute.mean(part["reward"]).as_py() for column, part in by_mode.items()}
    except (OSError, ValueError, NotImplementedError):
        # there is none, or it is damaged, or its rewards are words
        return dict.fromkeys(MEANS)


# -- in words ------------------------------------------------------------------------------------------------


def words(one: Mapping[str, Any]) -> list[str]:
    """A run as the table shows it, by `COLUMNS`."""
    first, last = one["seeds"]
    done = one["status"] in ("finished", "shipped")
    return [
        one["run"],
        f"{one['algorithm']} {one['activation']}",
        f"{last - first + 1:,}",
        thousands(one["frames"]) if done else f"{thousands(one['frames'])}/{thousands(one['total'])}",
        one["status"],
        *("" if one[column] is None else f"{one[column]:,.1f}" for column in MEANS),
        "" if one["age"] is None else span(one["age"]),
    ]


def thousands(frames: int) -> str:
    """`401k`; fewer than a thousand as they are."""
    return f"{frames // 1000:,}k" if frames >= 1000 else str(frames)


def in_order(rows: Sequence[dict[str, Any]], column: str) -> list[dict[str, Any]]:
    """Runs sorted by a column: frames and rewards fall, all else rises; what is not known comes last."""
    known = [one for one in rows if one[column] is not None]
    known.sort(key=operator.itemgetter(column), reverse=column in ("frames", *MEANS))
    return known + [one for one in rows if one[column] is None]


def shown(rows: Sequence[Mapping[str, Any]]) -> Group:
    """Each run that trains, with its curve, above a table of all runs."""
    training: list[RenderableType] = []
    for one in rows:
        if "lately" in one:
            now = one["frames"], one["total"], one.get("frames_per_second")
            training += [Text(one["run"]), Text(f"  {line(*now, Lately(**one['lately']))}"), Text()]
    told = "sampled, greedy: mean reward of a test episode"
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), caption=told, caption_justify="left")
    for name in COLUMNS:
        justify: JustifyMethod = "left" if name in OF_WORDS else "right"
        table.add_column(name, justify=justify, no_wrap=name != "run", overflow="fold")
    for one in rows:
        table.add_row(*map(Text, words(one)))
    return Group(*training, table)


def found(given: Namespace, tell: bool) -> list[dict[str, Any]]:
    """What is said of every run in the folders given, or of one's own and those that ship."""
    own = [name for name in ("runs", "results") if Path(name).is_dir()]
    folders = given.folders or own[:1]
    now, rows = time.time(), list[dict[str, Any]]()
    paths = list[Path]()
    for folder in folders:
        try:
            paths += run_folders(Path(folder))[0]
        except RunError:
            if given.folders:  # one's own may still be empty
                raise
    for path in dict.fromkeys(paths):
        try:
            rows.append(row(path, now))
        except RunError as error:
            if tell:
                complain("runs", f"left out: {error}")
    rows += [] if given.folders else shipped.rows()
    return in_order(rows, given.sort) if given.sort else rows


def main(arguments: Namespace) -> int:
    rows = found(arguments, tell=True)
    if arguments.json:
        print(json.dumps(rows, indent=2))
        return 0
    console = Console(highlight=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:  # nothing limits a file
        console.width = WIDEST
    if not (arguments.watch and console.is_terminal):
        with console.capture() as told:  # a closed pipe is met as by `print`
            console.print(shown(rows))
        print(told.get(), end="")
        if arguments.watch:
            complain("runs", "--watch: no terminal to renew, so this is shown once")
        return 0
    show = Live(shown(rows), console=console, auto_refresh=False)
    with contextlib.suppress(KeyboardInterrupt), show as live:
        while True:
            time.sleep(WATCH_SECONDS)
            live.update(shown(found(arguments, tell=False)), refresh=True)
    return 0
