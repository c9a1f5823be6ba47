"""`uavnav playground`: write the page on which one flies in a browser."""

from __future__ import annotations

from argparse import Namespace

from uavnav import files
from uavnav.errors import complain
from uavnav.runs.tables import write
from uavnav.views.browser.playground import collect, page


def main(arguments: Namespace) -> int:
    """Write the page with the policies of some folders, and say which were left out."""
    files.check_out(arguments.out)
    found, left_out = collect(arguments.folders)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    write(arguments.out, page(found).encode())
    for line in left_out:
        complain("playground", f"left out: {line}")
    print(f"{arguments.out}: policies: {len(found)}; open it in a browser")
    return 0
