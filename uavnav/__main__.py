"""`uavnav`, and the same as `python -m uavnav`: the list of commands, or one of them with its words."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Sequence
from typing import Any

import uavnav
from uavnav.algorithms import ALGORITHMS
from uavnav.cli import commands
from uavnav.errors import choose_from, one_line

TRAINS = ("train", "study", "verify", "bench")
ALLOCATOR = "glibc.malloc.tcache_count=1000"
"""Keeps 1,000 freed blocks of a size for the thread that freed them, where glibc keeps 7 by default."""


def launch(argv: Sequence[str], **how: Any) -> int:
    """`main`, where the process was started for nothing else: before it trains, it starts again with
    `ALLOCATOR`.

    glibc reads its settings only when a process starts; processes that this one starts inherit them.
    """
    given = sys.argv[1:]
    ours = sys.orig_argv[len(sys.orig_argv) - len(given) :] == given  # no program that runs a command
    trains = argv[:1] and argv[0] in TRAINS
    tuned = "GLIBC_TUNABLES" in os.environ
    if sys.platform == "linux" and sys.executable and ours and trains and not tuned:
        os.environ["GLIBC_TUNABLES"] = ALLOCATOR
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    return main(argv, **how)


def main(argv: Sequence[str] | None = None, **how: Any) -> int:
    """Run the command that is named, by default the command line's; its help and mistakes in its words come
    before torch is imported.

    how: further arguments of the command's own `main`, such as a recipe's `fit`.
    """
    if argv is None:
        return launch(sys.argv[1:])
    name, *words = [*argv] or ["--help"]
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
