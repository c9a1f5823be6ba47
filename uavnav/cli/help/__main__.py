"""`python -m uavnav.cli.help` (`make help`): write the help of each algorithm, from its configuration."""

from uavnav.algorithms import ALGORITHMS
from uavnav.cli.help import text_of
from uavnav.cli.help.render import render
from uavnav.cli.train import Command
from uavnav.tasks.world import World

if __name__ == "__main__":
    for name, algorithm in ALGORITHMS.items():
        text_of(name).write_text(render(algorithm.config, World, Command), encoding="utf-8")
