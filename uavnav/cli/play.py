"""`uavnav play`: fly in the browser, against runs; keep a person's episodes as rows for a report."""

from __future__ import annotations

import os
import shlex
import sys
import webbrowser
from argparse import Namespace
from pathlib import Path

import pandas as pd

from uavnav.cli.playground import write_page
from uavnav.errors import ConfigError
from uavnav.runs.metrics import EPISODE_COLUMNS, EVALUATED
from uavnav.runs.tables import RunError, lock, read_csv, read_table, write_table
from uavnav.tasks.protocol import MAX_STEPS, SPLITS
from uavnav.tasks.table import EMPTY, make_task
from uavnav.tasks.world import World
from uavnav.views.browser import TITLES
from uavnav.views.browser.playground import Opening

ROWS = Path("runs/baselines/human.parquet")  # where `uavnav report runs` finds what people flew


def main(arguments: Namespace) -> int:
    if arguments.person < 0:
        raise ConfigError(f"--person {arguments.person}: give at least 0")
    if arguments.keep:
        print(keep(arguments.keep, arguments.person))
        return 0
    if arguments.max_steps is not None and arguments.max_steps < 1:
        raise ConfigError(f"--max-steps {arguments.max_steps}: give at least 1")
    make_task(EMPTY, task=arguments.task)
    if arguments.task not in TITLES:
        given = ["--plugins", ",".join(arguments.plugins)] if arguments.plugins else []
        words = ["render", "reactive", "--task", arguments.task, *given, "--out", "episode.gif"]
        film = shlex.join(["uavnav", *words])
        raise ConfigError(f"--task {arguments.task}: the playground has no such task; watch it: {film}")
    opening = Opening(
        arguments.layouts, arguments.layout, arguments.task, arguments.greedy, arguments.max_steps
    )
    who = {"seed": arguments.seed, "activation": arguments.activation}
    out, n = write_page("play", arguments.runs, arguments.out, opening, **who)
    shown = has_screen() and webbrowser.open(out.absolute().as_uri())
    says = "it opens in your browser" if shown else f"open {out.absolute().as_uri()} in a browser"
    print(f"{out}: policies: {n}; {says}")
    return 0


def has_screen() -> bool:
    """Whether a browser with a window can be opened; a browser of text would take the terminal."""
    windows = ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
    return sys.platform in ("darwin", "win32") or any(os.environ.get(name) for name in windows)


def keep(path: Path, person: int) -> str:
    """Add the episodes of a file that the page saved to those of `ROWS`; says how many there are.

    person: the rows' seed. Raises a RunError where the file is none of the page's.
    """
    rows = read_csv(path, EPISODE_COLUMNS, "give human.csv, which K of the playground saves")
    counts = rows[["steps", "stops", "full_stops", "turns", "distance"]]
    possible = rows["layout"].between(0, SPLITS["test"].n - 1) & (rows["terminated"] != rows["truncated"])
    possible &= rows["terminated"] | (rows["steps"] == MAX_STEPS)  # no shorter time limit
    possible &= (counts >= 0).all(axis=1) & rows["steps"].between(1, MAX_STEPS)
    possible &= (counts["full_stops"] <= counts["stops"]) & (counts["stops"] <= counts["steps"])
    possible &= counts["turns"] + counts["full_stops"] <= counts["steps"]
    possible &= counts["distance"] <= max(World().distances) * (counts["steps"] - counts["stops"])
    if not possible.all():
        line = 2 + int(possible.argmin())
        raise RunError(f"{path}: line {line} is no episode; give human.csv, which K of the playground saves")
    rows = rows.assign(seed=person)
    ROWS.parent.mkdir(parents=True, exist_ok=True)
    with lock(ROWS.parent):
        before = read_table(ROWS, EVALUATED, "move it away") if ROWS.exists() else rows[:0]
        flights = [part.assign(again=part.groupby([*part]).cumcount()) for part in (before, rows)]
        together = pd.concat(flights, ignore_index=True).drop_duplicates(ignore_index=True)
        together = together.drop(columns="again")
        together.attrs = {"layouts": "test", "max_steps": MAX_STEPS}
        write_table(ROWS, together)
    return f"{ROWS}: {len(together)} episodes, {len(together) - len(before)} of them new; uavnav report runs"
