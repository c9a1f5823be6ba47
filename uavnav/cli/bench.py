"""Benchmarks: the world, training and its peers, side by side on this machine, into one Markdown file.

`uavnav bench` measures in about 40 minutes what a plain run measures, `--quick` a first impression in 3.
`--only` chooses sections, also those that take longer: `growth` and `parity`. Sections that were not measured
stay as they are in the file. A run that is stopped writes what it has found by then, and marks it.

Each measurement is a fresh process with a fixed number of threads (`uavnav.bench.jobs`). Measurements are interleaved
over several rounds; the file gives medians, and ratios of the same round.
"""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import replace

from rich.console import Console

from uavnav.bench.page import write_figure, write_sections
from uavnav.bench.plan import Measurement
from uavnav.bench.runner import Runner
from uavnav.bench.sections import SECTIONS, write
from uavnav.cli import commands
from uavnav.cli.benches import BY_DEFAULT, OUT, QUICK, SCRATCH
from uavnav.errors import complain
from uavnav.files import check_out

STOPS = (signal.SIGTERM, signal.SIGHUP)
"""Signals that stop a run as Ctrl-C does."""


def plan(names: Sequence[str], quick: bool) -> list[Measurement]:
    """The measurements of sections; `quick`, shorter ones of one round each."""
    found = [one for name in names for one in SECTIONS[name].plan(quick)]
    return [replace(one, rounds=1) for one in found] if quick else found


def main(argv: Sequence[str] | None = None) -> int:
    """Measure the world, training and its peers on this machine, and write it down; 40 minutes."""
    arguments = commands.parse("bench", argv)
    names = [name for name in SECTIONS if name in (arguments.only or (QUICK if arguments.quick else BY_DEFAULT))]
    out = arguments.out or (SCRATCH / "quick.md" if arguments.quick else OUT)
    try:
        check_out(out)
    except ValueError as error:
        complain("bench", error)
        return 2
    console = Console(highlight=False, soft_wrap=True, markup=False)
    runner = Runner(SCRATCH, console.print)
    for number in STOPS:
        if signal.getsignal(number) != signal.SIG_IGN:  # as under nohup
            signal.signal(number, signal.default_int_handler)
    try:
        results = runner.run(plan(names, arguments.quick))
        if runner.stopped:
            names = [name for name in names if results.measured(name)]
        found = write(results, names)
        for name, lines in found.items():
            section = SECTIONS.get(name)
            if section is not None and section.draw is not None:
                picture = out.with_name(f"{out.stem}-{name}.png")
                write_figure(picture, section.draw(results))
                lines += ["", f"![{section.title}]({picture.name})"]
        if found:
            marks = [*(["one round each"] if arguments.quick else []), *(["cut short"] if runner.stopped else [])]
            write_sections(out, found, time.monotonic() - runner.began, ", ".join(marks))
            print(f"wrote {out}")
    except BrokenPipeError:  # nobody reads on: `terminal` ends it
        raise
    except OSError as error:
        complain("bench", error)
        return 2
    except KeyboardInterrupt:
        print("uavnav bench: stopped while it wrote; the file is whole or as it was", file=sys.stderr)
        return 130
    if runner.stopped:
        kept = f"what was found so far is in {out}" if found else "nothing was found yet"
        print(f"uavnav bench: stopped; {kept}", file=sys.stderr)
    return 130 if runner.stopped else 0


if __name__ == "__main__":
    sys.exit(main())
