"""`uavnav playground`: write the page on which one flies in a browser."""

from __future__ import annotations

import tempfile
from argparse import Namespace
from pathlib import Path

from uavnav import files
from uavnav.errors import complain
from uavnav.runs.tables import write
from uavnav.views.browser.playground import Flyers, Opening, collect, page, usual

NAME = "playground.html"


def main(arguments: Namespace) -> int:
    if arguments.out:
        files.check_out(arguments.out)
    flyers = collect(arguments.folders or usual())
    out = write_page("playground", arguments.out or where(Path(NAME)), flyers)
    print(f"{out}: policies: {len(flyers.policies)}; open it in a browser")
    return 0


def where(otherwise: Path | None = None) -> Path:
    """The page's file if none is given: in `runs`, or else `otherwise`, or else in a new temporary folder."""
    if Path("runs").is_dir():
        return Path("runs") / NAME
    return otherwise or Path(tempfile.mkdtemp(prefix="uavnav-")) / NAME


def write_page(command: str, out: Path, flyers: Flyers, opening: Opening | None = None) -> Path:
    """Write the page, and say which runs are not on it."""
    content = page(flyers, opening).encode()
    out.parent.mkdir(parents=True, exist_ok=True)
    write(out, content)
    for line in flyers.left_out:
        complain(command, f"left out: {line}")
    return out
