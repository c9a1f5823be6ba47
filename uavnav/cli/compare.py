"""`uavnav compare`: runs, zips of Stable-Baselines3 and scripted policies, in text and as a page."""

from __future__ import annotations

import json
import sys
from argparse import Namespace

from rich.console import Console

from uavnav.errors import ConfigError
from uavnav.files import check_out
from uavnav.report.compare import apart, check, contend, metrics, page, text
from uavnav.runs.tables import records, write


def main(arguments: Namespace) -> int:
    if arguments.activation:
        from uavnav.runs import policies  # brings torch

        policies.zips(arguments.runs, arguments.activation)
    if arguments.out is not None:
        check_out(arguments.out)
    names = list(dict.fromkeys(arguments.runs))
    if len(names) < 2 and not arguments.shield:
        raise ConfigError(
            f"{names[0]}: there is nothing to compare it with; give at least two, such as ppo-best reactive"
        )
    asked = {
        name: value for name in ("episodes", "max_steps") if (value := getattr(arguments, name)) is not None
    }
    contenders = contend(names, arguments.activation, arguments.shield, **asked)
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
    return 0
