"""`python -m uavnav.cli.help` (`make help`): write the help of each algorithm, and the tables of commands and
settings in docs/.
"""

from pathlib import Path

from uavnav.algorithms import ALGORITHMS
from uavnav.cli.help import pages, text_of
from uavnav.cli.help.render import render
from uavnav.cli.train import Command
from uavnav.report.docs import between_marks
from uavnav.tasks.world import World

if __name__ == "__main__":
    kinds = {name: algorithm.config for name, algorithm in ALGORITHMS.items()}
    for name, kind in kinds.items():
        text_of(name).write_text(render(kind, World, Command), encoding="utf-8")
    for page, block, table in (
        ("docs/commands.md", "commands", pages.command_table()),
        ("docs/algorithms.md", "settings", pages.settings_table(kinds)),
        ("docs/algorithms.md", "presets", pages.preset_table(kinds)),
    ):
        path = Path(page)
        path.write_text(between_marks(path.read_text(encoding="utf-8"), table, page, block), encoding="utf-8")
