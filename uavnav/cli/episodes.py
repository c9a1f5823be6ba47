"""The process of an evaluation that a study started: `uavnav evaluate`, with a heartbeat."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from uavnav import files
from uavnav.cli import commands
from uavnav.training.heartbeat import Heartbeat


def main(argv: Sequence[str]) -> None:
    """argv: the file that tells how this ended, and the words of `uavnav evaluate`, a run's folder first."""
    ended, *words = argv
    status: object = 1
    try:
        with Heartbeat(Path(words[0]), total=0):
            status = commands.run("evaluate", words)
    except SystemExit as stop:
        status = stop.code
    finally:
        files.write(Path(ended), json.dumps({"status": status}).encode())


if __name__ == "__main__":
    main(sys.argv[1:])
