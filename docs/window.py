"""Draw docs/flight-window.png: one policy hands the drone to another in mid-episode (`python docs/window.py
RUN RUN`).
"""

from __future__ import annotations

import sys
from pathlib import Path

from uavnav.views.render import load_layout, load_pilots
from uavnav.views.window import game, hud

LAYOUT = 56
STEPS = 180, 100
"""Of the first pilot, and then of the second."""


def main(runs: list[str]) -> None:
    """Fly, and keep the last picture."""
    shown = game.new(load_pilots(runs), load_layout("test", LAYOUT), "test", LAYOUT)
    for pilot, steps in enumerate(STEPS, 1):
        shown = game.seat(shown, pilot)
        for _ in range(steps):
            shown = game.step(shown)
    hud.draw(shown, hud.DESIGN).save(Path(__file__).parent / "flight-window.png")


if __name__ == "__main__":
    main(sys.argv[1:])
