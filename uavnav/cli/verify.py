"""`uavnav verify`: repeat a run and say whether its rows and weights are the same."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from uavnav import plugins
from uavnav.cli import commands
from uavnav.errors import ConfigError, complain
from uavnav.evaluation.verify import verify
from uavnav.runs import Run
from uavnav.runs.policies import as_option
from uavnav.runs.tables import RunError
from uavnav.tasks.layouts import LayoutError
from uavnav.training.recorder import Interrupted


def main(argv: Sequence[str] | None = None) -> int:
    """Repeat a run from its config.yaml and say whether its rows and weights are the same, bit for bit."""
    arguments = commands.parse("verify", argv)
    try:
        plugins.load(arguments.plugins)
        if arguments.frames is not None and arguments.frames < 1:
            raise ConfigError(f"--frames {arguments.frames}: give a number of at least 1")
        verdict = verify(Run(arguments.run), arguments.frames)
    except Interrupted as stop:
        print("uavnav verify: stopped, nothing was compared", file=sys.stderr)
        return 128 + stop.signum
    except (ConfigError, LayoutError, RunError) as error:
        complain("verify", as_option(error))
        return 2
    print("\n".join(verdict.lines))
    return 0 if verdict.same else 1
