"""`uavnav report`: write report.html from the runs in some folders."""

from __future__ import annotations

import sys
import time
from argparse import Namespace

from rich.console import Console

from uavnav.errors import complain
from uavnav.report import Written, report
from uavnav.runs.tables import RunError

PAUSE = 5.0  # seconds between two pages of `--watch`


def main(arguments: Namespace) -> int:
    """Write the page, and say which runs were left out; with `--watch` again and again, until Ctrl-C."""
    try:
        written = _write(arguments)
    except KeyboardInterrupt:
        print("uavnav report: stopped; no report was written", file=sys.stderr)
        return 130
    for line in written.left_out:
        complain("report", f"left out: {line}")
    print(f"the report is in {written.path}", flush=True)
    try:
        while arguments.watch:
            time.sleep(PAUSE)
            try:
                _write(arguments)
            except RunError as error:  # a run began or ended meanwhile
                complain("report", error)
    except KeyboardInterrupt:
        pass
    return 0


def _write(arguments: Namespace) -> Written:
    """The page; a terminal shows meanwhile what is being done."""
    console = Console(stderr=True)
    if arguments.watch or not console.is_terminal:
        return report(arguments.folders, arguments.out, watched=arguments.watch)
    with console.status("starting") as status:
        return report(arguments.folders, arguments.out, lambda step: status.update(f"{step} …"))
