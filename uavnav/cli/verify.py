"""`uavnav verify`: repeat a run and say whether its rows and weights are the same."""

from __future__ import annotations

import sys
from argparse import Namespace

from uavnav.evaluation.verify import verify
from uavnav.runs import Run
from uavnav.training.recorder import Interrupted


def main(arguments: Namespace) -> int:
    """Status 0 where the run is the same, bit for bit, and 1 where it is not."""
    try:
        verdict = verify(Run(arguments.run), arguments.frames)
    except Interrupted as stop:
        print("uavnav verify: stopped, nothing was compared", file=sys.stderr)
        return stop.status
    print("\n".join(verdict.lines))
    return 0 if verdict.same else 1
