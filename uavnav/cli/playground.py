"""`uavnav playground`: write the page on which one flies in a browser."""

from __future__ import annotations

import tempfile
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from uavnav import files
from uavnav.errors import complain
from uavnav.runs.tables import write
from uavnav.views.browser.playground import Opening, collect, page, usual

NAME = "playground.html"


def main(arguments: Namespace) -> int:
    out, n = write_page("playground", arguments.folders, arguments.out, otherwise=Path(NAME))
    print(f"{out}: policies: {n}; open it in a browser")
    return 0


def write_page(
    command: str,
    words: Sequence[str | Path],
    out: Path | None,
    opening: Opening | None = None,
    otherwise: Path | None = None,
    **how: Any,
) -> tuple[Path, int]:
    """Write the page of what is named, and say which runs are not on it; how: as of `collect`.

    If no file is given, it is in `runs`, or else `otherwise`, or else in a new temporary folder. Returns the
    file and how many policies it has.
    """
    if out:
        files.check_out(out)
    flyers = collect(words or usual(), **how)
    own = Path("runs") / NAME if Path("runs").is_dir() else otherwise
    out = out or own or Path(tempfile.mkdtemp(prefix="uavnav-")) / NAME
    content = page(flyers, opening).encode()
    out.parent.mkdir(parents=True, exist_ok=True)
    write(out, content)
    for line in flyers.left_out:
        complain(command, f"left out: {line}")
    return out, len(flyers.policies)
