"""`uavnav report`: the command."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from uavnav import plugins
from uavnav.cli import commands
from uavnav.errors import ConfigError, complain
from uavnav.report import report
from uavnav.runs.tables import RunError


def main(argv: Sequence[str] | None = None) -> int:
    """Write report.html: verdicts on the paper's claims, its tables beside ours, figures, statistics, replays."""
    arguments = commands.parse("report", argv)
    try:
        plugins.load(arguments.plugins)
        written = report(arguments.folders, arguments.out)
    except (ConfigError, RunError) as error:
        complain("report", error)
        return 2
    except KeyboardInterrupt:
        print("uavnav report: stopped; no report was written", file=sys.stderr)
        return 130
    for line in written.left_out:
        complain("report", f"left out: {line}")
    print(f"the report is in {written.path}")
    return 0
