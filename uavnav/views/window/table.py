"""The one table of keys of the live window: the help shows it, and `uavnav.views.window.keys` acts by it."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

LEFT, RIGHT, RISE, SINK = "left", "right", "t", "g"
TURNING, TILTING = frozenset({LEFT, RIGHT}), frozenset({RISE, SINK})
ROWS, DRAWN = Path("results/baselines/human.parquet"), Path("own.safetensors")
"""Where episodes by hand and drawn obstacles are saved if nothing else is said."""


class Key(NamedTuple):
    """One line of the help: names as `pygame.key.name` gives them, how they are shown, what they do."""

    names: tuple[str, ...]
    shown: str
    does: str
    act: str  # a function of `game`
    by: int | None = None  # its further argument, if it has one


ALIASES = {"a": LEFT, "d": RIGHT, "w": "up", "s": "down"}  # as those keys of the table

KEYS = (
    Key((LEFT,), "← A", "turn 5° left for as long as it is down; with shift 1°", "hold"),
    Key((RIGHT,), "→ D", "turn 4° right (the most that eq. 11 has); with shift 1°", "hold"),
    Key((RISE,), "T", "in 3D: nose up for as long as it is down", "hold"),
    Key((SINK,), "G", "in 3D: nose down", "hold"),
    Key(("up",), "↑ W", "one pixel a step faster, up to 9", "quicker", 1),
    Key(("down",), "↓ S", "one pixel a step slower, down to 0", "quicker", -1),
    Key(("0",), "0", "fly yourself, from where the drone is", "seat", 0),
    Key(("1",), "1 … 9", "hand the drone to policy 1 … 9, where it is", "seat", 1),
    *(Key((str(n),), "", "", "seat", n) for n in range(2, 10)),
    Key(("tab",), "Tab", "hand it to the next one", "next_pilot"),
    Key(("space",), "Space", "pause, go on", "pause"),
    Key((".",), ".", "one step, then pause", "single_step"),
    Key(("-",), "-", "slower: ½, ¼, ⅒ of 30 steps a second", "paced", -1),
    Key(("=", "+"), "+ =", "faster: up to 4 times", "paced", 1),
    Key(("r", "return"), "R Enter", "start again on the same obstacles; the trail stays", "reset"),
    Key(("n",), "N", "next layout", "following", 1),
    Key(("p",), "P", "the layout before", "following", -1),
    Key(("page down",), "PgDn", "ten layouts on", "following", 10),
    Key(("page up",), "PgUp", "ten layouts back", "following", -10),
    Key(("e",), "E", "draw obstacles; again: fly them", "draw"),
    Key(("c", "delete"), "C Del", "while drawing: take all obstacles away", "clear"),
    Key(("b",), "B", "save these obstacles as a layout file", "save_layouts"),
    Key(("k",), "K", "keep episodes by hand as rows for the report", "save_episodes"),
    Key(("h", "f1"), "H F1", "this help", "show_help"),
    Key(("escape", "q"), "Esc Q", "close the help, the drawing, the window", "close"),
)
"""Every key, in the order of the help; one that is not shown belongs to the line above."""

MOUSE = (
    ("Left drag", "while drawing: an obstacle, from its centre to its edge"),
    ("Right click", "while drawing: take that obstacle away"),
)
HELP = (*((key.shown, key.does) for key in KEYS if key.shown), *MOUSE)
"""How each key and the mouse are shown, and what they do."""
