"""`uavnav report`: write report.html from the runs in some folders."""

from __future__ import annotations

import sys
from argparse import Namespace

from uavnav.errors import complain
from uavnav.report import report


def main(arguments: Namespace) -> int:
    """Write the page, and say which runs were left out."""
    try:
        written = report(arguments.folders, arguments.out)
    except KeyboardInterrupt:
        print("uavnav report: stopped; no report was written", file=sys.stderr)
        return 130
    for line in written.left_out:
        complain("report", f"left out: {line}")
    print(f"the report is in {written.path}")
    return 0
