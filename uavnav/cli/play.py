"""The live window: fly a drone with the keyboard, or watch trained policies, on any layout.

`uavnav play [RUN...]`. The rules are in `game`, the picture in `hud`; this is the command, and a thin shell
of pygame around the two.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

from uavnav.algorithms import ALGORITHMS
from uavnav.envs.drawing import STEPS_PER_SECOND
from uavnav.errors import ConfigError
from uavnav.files import check_out
from uavnav.runs.policies import is_zip
from uavnav.tasks.baselines import BASELINES
from uavnav.tasks.protocol import MAX_STEPS
from uavnav.tasks.table import EMPTY, make_task
from uavnav.training.machine import use_threads
from uavnav.views.render import Pilot, load_layout, load_pilots
from uavnav.views.window import game as rules
from uavnav.views.window import hud, mouse
from uavnav.views.window.game import Game
from uavnav.views.window.keys import press, release, release_all
from uavnav.views.window.table import DRAWN, ROWS

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
try:
    import pygame
except ImportError:
    pygame = None  # type: ignore[assignment]

SMALLEST = 320, 240  # of a window [px]
UNSEEN = ("dummy", "offscreen", "evdev")  # SDL's drivers without a screen: good where they are asked for


def open_window(size: tuple[int, int]) -> pygame.Surface:
    """A window that can be resized.

    Raises:
        ConfigError: pygame is not installed, or there is no screen.
    """
    if pygame is None:
        raise ConfigError("needs pygame-ce: pip install 'uavnav[play]'")
    # else Wayland's library has a line of its own
    os.environ.setdefault("XDG_RUNTIME_DIR", tempfile.gettempdir())
    try:
        pygame.display.init()
        if "SDL_VIDEODRIVER" not in os.environ and pygame.display.get_driver() in UNSEEN:
            raise pygame.error("there is no screen")
        pygame.display.set_caption("uavnav")
        return pygame.display.set_mode(size, pygame.RESIZABLE)
    except pygame.error as error:
        raise ConfigError(f"no window can be opened ({error}); uavnav render needs no screen") from error


def handle(game: Game, event: pygame.event.Event, size: tuple[int, int]) -> Game:
    """What an event of pygame makes of a game in a window of this size [px]."""
    if event.type == pygame.QUIT:
        return rules.leave(game)
    if event.type == pygame.KEYDOWN:
        return press(game, pygame.key.name(event.key))
    if event.type == pygame.KEYUP:
        return release(game, pygame.key.name(event.key))
    if event.type == pygame.WINDOWFOCUSLOST:
        return release_all(game)
    if event.type not in (pygame.MOUSEBUTTONDOWN, pygame.MOUSEMOTION, pygame.MOUSEBUTTONUP):
        return game
    place = hud.to_world(event.pos, size, game.world)
    if event.type == pygame.MOUSEMOTION:
        return mouse.drag(game, *place)
    if event.type == pygame.MOUSEBUTTONUP:
        return mouse.drop(game) if event.button == pygame.BUTTON_LEFT else game
    if event.button == pygame.BUTTON_LEFT:
        return mouse.grab(game, *place)
    return mouse.erase(game, *place) if event.button == pygame.BUTTON_RIGHT else game


def turn(game: Game, seconds: float) -> Game:
    """One round of the window: what happened meanwhile, then the time that passed."""
    for event in pygame.event.get():
        game = handle(game, event, pygame.display.get_window_size())
    return rules.advance(game, seconds)


def show(game: Game) -> None:
    """Draw the game into the window."""
    surface = pygame.display.get_surface()
    assert surface is not None
    size = max(surface.get_width(), SMALLEST[0]), max(surface.get_height(), SMALLEST[1])
    picture = hud.draw(game, size)
    surface.blit(pygame.image.frombuffer(picture.tobytes(), size, "RGB"), (0, 0))
    pygame.display.flip()


def play(game: Game) -> Game:
    """Until the window is closed, or Ctrl-C; a picture is drawn where something changed."""
    clock = pygame.time.Clock()
    shown: tuple[Game, tuple[int, int]] | None = None
    with contextlib.suppress(KeyboardInterrupt):
        while not game.closed:
            game = turn(game, clock.tick(STEPS_PER_SECOND) / 1000)
            now = game, pygame.display.get_window_size()
            if now != shown:
                show(game)
                shown = now
    return game


def rows_file(words: Sequence[str]) -> Path:
    """Where a report finds rows of episodes by hand: in `baselines` of the first run's root, the folder of
    studies.

    The root is the first part of the path above the configuration, `runs` of runs/ppo/relu and of runs/first;
    of a path that leads out of the working folder it is all of that part.
    """
    runs = [Path(word) for word in words if word not in BASELINES and not is_zip(word)]
    if not runs:
        return ROWS
    above = (runs[0].parent if os.path.isfile(runs[0]) else runs[0]).parent
    above = above.parent if above.name.partition("-")[0] in ALGORITHMS else above
    root = above if above.is_absolute() or ".." in above.parts else Path(*above.parts[:1])
    return root / "baselines" / ROWS.name


def main(arguments: Namespace) -> int:
    """Open the window, and say what was not saved when it is closed."""
    if arguments.max_steps is not None and arguments.max_steps < 1:
        raise ConfigError(f"--max-steps {arguments.max_steps}: give at least 1")
    if arguments.person < 0:
        raise ConfigError(f"--person {arguments.person}: give at least 0")
    for path in filter(None, (arguments.out, arguments.drawn)):
        check_out(path)
    rows_path = arguments.out or rows_file(arguments.runs)
    pilots = load_pilots(
        arguments.runs, arguments.seed, arguments.greedy, arguments.activation, arguments.task
    )
    you = Pilot("you", rules.nobody, pilots[0].task if pilots else make_task(EMPTY, task=arguments.task))
    layouts = load_layout(arguments.layouts, arguments.layout, [you])
    rules.read_rows(rows_path)
    open_window(hud.DESIGN)
    with use_threads(1):
        paths = {"rows_path": rows_path, "drawn_path": arguments.drawn or DRAWN}
        limit = you.task.limit(MAX_STEPS) if arguments.max_steps is None else arguments.max_steps
        how = {"max_steps": limit, "person": arguments.person, **paths}
        game = play(rules.new(pilots, layouts, arguments.layouts, arguments.layout, you, **how))
    if lost := len(game.episodes):
        print(f"{rules.counted(lost)} by hand {'was' if lost == 1 else 'were'} not saved")
    return 0
