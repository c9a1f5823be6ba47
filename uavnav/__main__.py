"""`uavnav`, and the same as `python -m uavnav`: the list of commands, or one of them with its words."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence
from typing import Any

import uavnav
from uavnav.algorithms import ALGORITHMS
from uavnav.cli import commands
from uavnav.errors import choose_from, one_line


def main(argv: Sequence[str] | None = None, **how: Any) -> int:
    """Run the command that is named; its help and mistakes in its words come before torch is imported.

    how: further arguments of the command's own `main`, such as a recipe's `fit`.
    """
    name, *words = list(sys.argv[1:] if argv is None else argv) or ["--help"]
    if name in ("-h", "--help", "--version"):
        what = (uavnav.__doc__ or "").partition("\n")[0].removeprefix("uavnav: ")
        overview = f"uavnav {uavnav.__version__}: {what}\n\n{commands.overview()}"
        print(uavnav.__version__ if name == "--version" else overview)
        return 0
    if name not in commands.COMMANDS:
        known = (
            f"it is an algorithm: uavnav train {name}"
            if name in ALGORITHMS
            else choose_from(name, commands.COMMANDS)
        )
        print(one_line(f"uavnav: there is no command {name!r}; {known}"), file=sys.stderr)
        return 2
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a path may contain what no terminal shows
    return commands.run(name, words, **how)


if __name__ == "__main__":
    sys.exit(main())
