"""`uavnav compare`: runs, zips of Stable-Baselines3 and scripted policies, side by side."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence

from rich.console import Console

from uavnav.cli import commands
from uavnav.errors import complain
from uavnav.files import check_out
from uavnav.report.compare import apart, check, contend, metrics, page, text
from uavnav.runs.tables import RunError, records, write


def main(argv: Sequence[str] | None = None) -> int:
    """Compare runs, zips of Stable-Baselines3 and scripted baselines: intervals, probabilities, curves."""
    arguments = commands.parse("compare", argv)
    try:
        if arguments.plugins or arguments.activation:
            from uavnav import plugins
            from uavnav.runs import policies

            plugins.load(arguments.plugins)
            policies.zips(arguments.runs, arguments.activation)
        if arguments.out is not None:
            check_out(arguments.out)
        names = list(dict.fromkeys(arguments.runs))
        if len(names) < 2:
            raise ValueError(f"{names[0]}: there is nothing to compare it with; give at least two, such as reactive")
        contenders = contend(names, arguments.activation)
        check(contenders)
        if line := apart(contenders):
            print(line, file=sys.stderr)
        if arguments.json:
            print(json.dumps(records(metrics(contenders)), indent=2))
        else:
            console = Console(highlight=False, soft_wrap=True, markup=False)
            with console.capture() as told:
                text(contenders, console)
            print(told.get(), end="")
        if arguments.out is not None:
            arguments.out.parent.mkdir(parents=True, exist_ok=True)
            write(arguments.out, page(contenders))
            print(f"wrote {arguments.out}", file=sys.stderr)
    except BrokenPipeError:  # nobody reads on: `terminal` ends it
        raise
    except (RunError, ValueError, OSError) as error:
        from uavnav.runs.policies import as_option

        complain("compare", as_option(error))
        return 2
    return 0
