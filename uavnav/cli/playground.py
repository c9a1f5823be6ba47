"""`uavnav playground`: the command."""

from __future__ import annotations

from collections.abc import Sequence

from uavnav import files, plugins
from uavnav.cli import commands
from uavnav.errors import ConfigError, complain
from uavnav.runs.policies import as_option
from uavnav.runs.tables import RunError, write
from uavnav.views.browser.playground import collect, page


def main(argv: Sequence[str] | None = None) -> int:
    """Write playground.html: fly the drone in a browser, beside trained policies and a hand-written rule."""
    arguments = commands.parse("playground", argv)
    try:
        plugins.load(arguments.plugins)
        files.check_out(arguments.out)
        found, left_out = collect(arguments.folders)
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        write(arguments.out, page(found).encode())
    except (ConfigError, RunError, ValueError, OSError) as error:
        complain("playground", as_option(error))
        return 2
    for line in left_out:
        complain("playground", f"left out: {line}")
    print(f"{arguments.out}: policies: {len(found)}; open it in a browser")
    return 0
