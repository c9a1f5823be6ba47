"""`uavnav render`: draw flights as a film, or their trails as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

from uavnav import plugins
from uavnav.cli import commands
from uavnav.envs.drawing import STEPS_PER_SECOND
from uavnav.errors import complain
from uavnav.files import check_out
from uavnav.runs import policies
from uavnav.tasks.faults import NO_FAULTS, from_option
from uavnav.training import machine
from uavnav.views.render import MOST_FLOWN, WIDTHS, Film, check_picture, fly, load_layout, load_pilots, save


def main(argv: Sequence[str] | None = None) -> int:
    """Draw flights of policies on the same set of obstacles, side by side, as MP4 or GIF, or their trails as PNG."""
    arguments = commands.parse("render", argv)
    try:
        for option, number in (("steps", arguments.steps), ("every", arguments.every)):
            if not 1 <= number <= MOST_FLOWN:
                raise ValueError(f"--{option} {number}: give at least 1 and at most {MOST_FLOWN:,}")
        if not 0.1 <= arguments.speed <= 100:
            raise ValueError(f"--speed {arguments.speed:g}: give 0.1 to 100")
        if arguments.width not in WIDTHS:
            raise ValueError(f"--width {arguments.width}: give {WIDTHS.start} to {WIDTHS.stop - 1}")
        rate = Fraction(arguments.speed).limit_denominator(100) * STEPS_PER_SECOND / arguments.every
        plugins.load(arguments.plugins)
        faults = from_option(arguments.faults)
        check_picture(arguments.out, rate)
        check_out(arguments.out)
        pilots = load_pilots(arguments.runs, arguments.seed, arguments.greedy, arguments.activation, arguments.task)
        if faults is not None:
            told = f"{faults}" if faults != NO_FAULTS else "no faults"
            pilots = [one._replace(name=f"{told} {one.name}", task=replace(one.task, faults=faults)) for one in pilots]
        bank = load_layout(arguments.layouts, arguments.layout, pilots)
        with machine.use_threads(1):
            flown = [fly(pilot, bank, arguments.layout, arguments.steps) for pilot in pilots]
            film = Film(flown, bank[arguments.layout], arguments.width, arguments.every)
            save(film, arguments.out, rate)
    except ValueError as error:
        complain("render", policies.as_option(error))
        return 2
    for flight in flown:
        last = flight.states[-1]
        told = f"{int(last.steps)} steps, {int(last.distance)} px, reward {float(last.reward):.2f}"
        print(f"{flight.pilot.title}: {told}{flight.ended and f', {flight.ended}'}")
    print(f"wrote {arguments.out}")
    return 0
