"""The one table of keys of the live window: the help shows it, and `press` acts by it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

from uavnav.window import game as rules
from uavnav.window.game import LEFT, RIGHT, TURNING, Game


class Key(NamedTuple):
    """One line of the help: names as `pygame.key.name` gives them, how they are shown, what they do."""

    names: tuple[str, ...]
    shown: str
    does: str
    act: Callable[[Game], Game]


ALIASES = {"a": LEFT, "d": RIGHT, "w": "up", "s": "down"}  # as those keys of the table

KEYS = (
    Key((LEFT,), "← A", "turn 5° left for as long as it is down; with shift 1°", rules.hold),
    Key((RIGHT,), "→ D", "turn 4° right (the most that eq. 11 has); with shift 1°", rules.hold),
    Key(("up",), "↑ W", "one pixel a step faster, up to 9", partial(rules.quicker, by=1)),
    Key(("down",), "↓ S", "one pixel a step slower, down to 0", partial(rules.quicker, by=-1)),
    Key(("0",), "0", "fly yourself, from where the drone is", partial(rules.seat, pilot=0)),
    Key(("1",), "1 … 9", "hand the drone to policy 1 … 9, where it is", partial(rules.seat, pilot=1)),
    *(Key((str(n),), "", "", partial(rules.seat, pilot=n)) for n in range(2, 10)),
    Key(("tab",), "Tab", "hand it to the next one", rules.next_pilot),
    Key(("space",), "Space", "pause, go on", rules.pause),
    Key((".",), ".", "one step, then pause", rules.single_step),
    Key(("-",), "-", "slower: ½, ¼, ⅒ of 30 steps a second", partial(rules.paced, by=-1)),
    Key(("=", "+"), "+ =", "faster: up to 4 times", partial(rules.paced, by=1)),
    Key(("r", "return"), "R Enter", "start again on the same obstacles; the trail stays", rules.reset),
    Key(("n",), "N", "next set of obstacles", partial(rules.following, by=1)),
    Key(("p",), "P", "the set before", partial(rules.following, by=-1)),
    Key(("page down",), "PgDn", "ten sets on", partial(rules.following, by=10)),
    Key(("page up",), "PgUp", "ten sets back", partial(rules.following, by=-10)),
    Key(("e",), "E", "draw obstacles; again: fly them", rules.draw),
    Key(("c", "delete"), "C Del", "while drawing: take all obstacles away", rules.clear),
    Key(("b",), "B", "save these obstacles as a bank", rules.save_bank),
    Key(("k",), "K", "keep flights by hand as rows for the report", rules.save_flights),
    Key(("h", "f1"), "H F1", "this help", rules.show_help),
    Key(("escape", "q"), "Esc Q", "close the help, the drawing, the window", rules.close),
)
"""Every key, in the order of the help; one that is not shown belongs to the line above."""

MOUSE = (
    ("Left drag", "while drawing: an obstacle, from its centre to its edge"),
    ("Right click", "while drawing: take that obstacle away"),
)
HELP = (*((key.shown, key.does) for key in KEYS if key.shown), *MOUSE)
"""How each key and the mouse are shown, and what they do."""

_BY_NAME = {name: key for key in KEYS for name in key.names}


def press(game: Game, name: str) -> Game:
    """A key went down."""
    name = ALIASES.get(name, name)
    game = replace(game, message="", held=game.held | {name}, tapped=game.tapped | ({name} & TURNING))
    return _BY_NAME[name].act(game) if name in _BY_NAME else rules.steer(game)


def release(game: Game, name: str) -> Game:
    """A key went up."""
    return rules.steer(replace(game, held=game.held - {ALIASES.get(name, name)}))


def release_all(game: Game) -> Game:
    """The window lost the keyboard."""
    return rules.steer(replace(game, held=frozenset(), tapped=frozenset()))
