"""`uavnav bench`: the world, training and its peers, side by side on this machine, into one Markdown file.

Rounds are interleaved; each measurement is a fresh process. A run that is stopped writes what it has found.
"""

from __future__ import annotations

import functools
import signal
import sys
from argparse import Namespace

from uavnav.bench import BY_DEFAULT, OUT, QUICK, SCRATCH
from uavnav.bench.jobs import run
from uavnav.bench.page import read_sections, sections, write_sections
from uavnav.bench.plan import plan
from uavnav.errors import ConfigError
from uavnav.files import check_out

STOPS = (signal.SIGTERM, signal.SIGHUP)  # signals that stop a run as Ctrl-C does


def main(arguments: Namespace) -> int:
    """Measure the sections that are asked for; other sections stay as they are in the file."""
    names = arguments.only or (QUICK if arguments.quick else BY_DEFAULT)
    if arguments.quick and (slow := [name for name in names if name not in QUICK]):
        raise ConfigError(f"--quick: {', '.join(slow)} cannot be quick; leave out --quick")
    out = arguments.out or (SCRATCH / "quick.md" if arguments.quick else OUT)
    for number in STOPS:
        if signal.getsignal(number) != signal.SIG_IGN:  # as under nohup
            signal.signal(number, signal.default_int_handler)
    check_out(out)
    if len(read_sections(out)) == 1:  # it is there, without a mark
        raise ConfigError(f"--out {out}: contains something else; give a new file")
    results = run(plan(names, arguments.quick), SCRATCH, functools.partial(print, flush=True))
    tables = sections(results)
    if tables:
        marks = ["one round each"] * arguments.quick + ["cut short"] * results.stopped
        write_sections(out, tables, ", ".join(marks))
        print(f"wrote {out}")
    if results.stopped:
        kept = f"what was found so far is in {out}" if tables else "nothing was found yet"
        print(f"uavnav bench: stopped; {kept}", file=sys.stderr)
    return 130 if results.stopped else 0
