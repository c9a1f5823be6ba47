"""`python -m uavnav.cli.help` (`make help`): write the help of each algorithm, from its configuration."""

from uavnav.algorithms import ALGORITHMS
from uavnav.cli.help import render, text_of
from uavnav.tasks.faults import Faults
from uavnav.tasks.world import World

if __name__ == "__main__":
    for name, algorithm in ALGORITHMS.items():
        text_of(name).write_text(render(algorithm.config, World, Faults), encoding="utf-8")
