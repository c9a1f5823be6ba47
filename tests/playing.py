"""What tests of the live window share: games, keys that are pressed, and a window without a screen."""

import contextlib

import pytest

from uavnav.cli import play
from uavnav.tasks import layouts
from uavnav.tasks.baselines import BASELINES, straight_ahead
from uavnav.tasks.table import make_task
from uavnav.tasks.world import World
from uavnav.views.render import Pilot
from uavnav.views.window import game as rules
from uavnav.views.window import hud, keys

WORLD = World()
pygame = pytest.importorskip("pygame")

EMPTY = layouts.generate(30, k=0)
STRAIGHT = Pilot("straight", straight_ahead, make_task(EMPTY))
REACTIVE = Pilot("reactive", BASELINES["reactive"], make_task(EMPTY))


def new(*pilots, layouts=EMPTY, **how):
    return rules.new(list(pilots), layouts, **how)


def fly(game, steps):
    for _ in range(steps):
        game = rules.step(game)
    return game


def press(game, *names):
    for name in names:
        game = keys.release(keys.press(game, name), name)
    return game


def place(game):
    return float(game.state.x), float(game.state.y), int(game.state.heading)


@contextlib.contextmanager
def opened(monkeypatch):
    """A window without a screen, to which events are posted; `opened(game, *keys)` is the game after them."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    play.open_window(hud.DESIGN)
    pygame.event.clear()

    def after(game, *names, seconds=0.0):
        for name in names:
            for kind in (pygame.KEYDOWN, pygame.KEYUP):
                pygame.event.post(pygame.event.Event(kind, key=pygame.key.key_code(name), mod=0))
        return play.turn(game, seconds)

    yield after
    pygame.display.quit()


def click(kind, x, y, button=1):
    """An event at a place of the world [px]."""
    places = hud.arrange(hud.DESIGN, WORLD)
    scale = places.width / WORLD.width
    at = round(places.left + x * scale), round(places.top + (WORLD.height - y) * scale)
    if kind == pygame.MOUSEMOTION:
        return pygame.event.Event(kind, pos=at, rel=(0, 0), buttons=(1, 0, 0))
    return pygame.event.Event(kind, pos=at, button=button)


def drag(x, y, to_x, to_y):
    pygame.event.post(click(pygame.MOUSEBUTTONDOWN, x, y))
    pygame.event.post(click(pygame.MOUSEMOTION, to_x, to_y))
    pygame.event.post(click(pygame.MOUSEBUTTONUP, to_x, to_y))
