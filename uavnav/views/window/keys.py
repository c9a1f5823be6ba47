"""What a key does that goes down or up, by the table of `uavnav.views.window.table`."""

from __future__ import annotations

from dataclasses import replace

from uavnav.views.window import game as rules
from uavnav.views.window.game import Game
from uavnav.views.window.table import ALIASES, KEYS, TILTING, TURNING

_BY_NAME = {name: key for key in KEYS for name in key.names}


def press(game: Game, name: str) -> Game:
    """A key went down."""
    name = ALIASES.get(name, name)
    game = replace(
        game, message="", held=game.held | {name}, tapped=game.tapped | ({name} & (TURNING | TILTING))
    )
    if name not in _BY_NAME:
        return _act(game, "steer")
    key = _BY_NAME[name]
    return _act(game, key.act, key.by)


def release(game: Game, name: str) -> Game:
    """A key went up."""
    return _act(replace(game, held=game.held - {ALIASES.get(name, name)}), "steer")


def release_all(game: Game) -> Game:
    """The window lost the keyboard."""
    return _act(replace(game, held=frozenset(), tapped=frozenset()), "steer")


def _act(game: Game, name: str, by: int | None = None) -> Game:
    """What a function of `game` makes of a game."""
    act = getattr(rules, name)
    after: Game = act(game) if by is None else act(game, by)
    return after
