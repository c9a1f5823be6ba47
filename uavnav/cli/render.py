"""`uavnav render`: draw episodes as a film, or their trails as a picture."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import replace
from fractions import Fraction

from uavnav.envs.drawing import STEPS_PER_SECOND
from uavnav.errors import ConfigError
from uavnav.files import check_out
from uavnav.tasks.faults import NO_FAULTS, from_option
from uavnav.tasks.layouts import load
from uavnav.training import machine
from uavnav.views.render import MOST_STEPS, WIDTHS, Film, check_picture, fly, load_pilots, save


def main(arguments: Namespace) -> int:
    for option, number in (("steps", arguments.steps), ("every", arguments.every)):
        if not 1 <= number <= MOST_STEPS:
            raise ConfigError(f"--{option} {number}: give at least 1 and at most {MOST_STEPS:,}")
    if not 0.1 <= arguments.speed <= 100:
        raise ConfigError(f"--speed {arguments.speed:g}: give 0.1 to 100")
    if arguments.width not in WIDTHS:
        raise ConfigError(f"--width {arguments.width}: give {WIDTHS.start} to {WIDTHS.stop - 1}")
    rate = Fraction(arguments.speed).limit_denominator(100) * STEPS_PER_SECOND / arguments.every
    faults = from_option(arguments.faults)
    check_picture(arguments.out, rate)
    check_out(arguments.out)
    pilots = load_pilots(
        arguments.runs, arguments.seed, arguments.greedy, arguments.activation, arguments.task
    )
    if faults is not None:
        told = f"{faults}" if faults != NO_FAULTS else "no faults"
        pilots = [
            one._replace(name=f"{told} {one.name}", task=replace(one.task, faults=faults)) for one in pilots
        ]
    layouts = load(arguments.layouts, pilots[0].task.world)
    if not 0 <= arguments.layout < len(layouts):
        raise ConfigError(f"--layout {arguments.layout}: choose from 0 to {len(layouts) - 1}")
    with machine.use_threads(1):
        episodes = [fly(pilot, layouts, arguments.layout, arguments.steps) for pilot in pilots]
        film = Film(episodes, layouts[arguments.layout], arguments.width, arguments.every)
        save(film, arguments.out, rate)
    for episode in episodes:
        last = episode.states[-1]
        told = f"{int(last.steps)} steps, {int(last.distance)} px, reward {float(last.reward):.2f}"
        print(f"{episode.pilot.title}: {told}{episode.ended and f', {episode.ended}'}")
    print(f"wrote {arguments.out}")
    return 0
