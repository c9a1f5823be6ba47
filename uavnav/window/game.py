"""What the live window does, without a window: a game, the keys and the mouse that change it, and time.

A `Game` is a value: every function takes one and returns the next. The drawing is in `hud`, the window in `play`.
`KEYS` is the one table of keys: the help shows it, and `press` acts by it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import torch
from torch import Tensor

from uavnav.envs.drawing import PILOTS, STEPS_PER_SECOND, Colour
from uavnav.evaluate import MAX_STEPS, header
from uavnav.policies import Policy
from uavnav.render import Pilot
from uavnav.runs.metrics import EPISODE_COLUMNS, FIRST_COLUMNS
from uavnav.runs.tables import RunError, lock, read_table, write_table
from uavnav.tasks import layouts as banks
from uavnav.tasks import simulator
from uavnav.tasks.dynamics import decode
from uavnav.tasks.simulator import COUNTS, UP, State
from uavnav.tasks.world import World

PACES = (1 / 10, 1 / 4, 1 / 2, 1.0, 2.0, 4.0)
"""How many times as fast as the simulation's own rate."""
LONGEST_PAUSE = 0.1  # [s] of simulated time that a slow frame may catch up
FINE_TURN = 1  # [degrees] with shift
KEPT_TRAILS = 5  # of earlier flights on the same set
YOU = "you"

SHIFTS = frozenset({"left shift", "right shift"})
WORLD = World()
ROWS, BANK = Path("results/baselines/human.parquet"), Path("own.safetensors")
"""Where flights by hand and drawn obstacles are saved if nothing else is said."""


class Choice(NamedTuple):
    """What the pilot does next, and the numbers behind it."""

    action: int
    values: Tensor | None  # [100] logits (PPO) or Q (DQN); None of a person or a script
    meaning: str  # of the values


class Leg(NamedTuple):
    """A part of a flight that one pilot flew."""

    pilot: int
    points: tuple[tuple[float, float], ...]  # (x, y) [px]


@dataclass(frozen=True, eq=False)
class Game:
    """One set of obstacles, one drone, several pilots of whom one flies; pilot 0 is the person at the keys."""

    bank: Tensor  # [n, k, 3] px
    split: str  # its name, or its path
    index: int  # the present set, or the one that came before a set of one's own
    obstacles: Tensor  # [1, K, 3] px, the present set
    pilots: tuple[Pilot, ...]
    pilot: int
    state: State
    choice: Choice
    generator: torch.Generator  # of policies that act as in training
    max_steps: int = MAX_STEPS
    person: int = 0
    rows_path: Path = ROWS
    bank_path: Path = BANK
    world: World = WORLD
    own: bool = False  # the obstacles are one's own
    clearance: float = math.inf  # [px]
    earned: float = 0.0  # reward of the last step
    ended: str = ""  # how the flight ended
    legs: tuple[Leg, ...] = ()  # of the present flight
    ghosts: tuple[Leg, ...] = ()  # of earlier flights on this set
    distance: int = 0  # [px a step], set by the keys
    held: frozenset[str] = frozenset()  # keys that are down
    tapped: frozenset[str] = frozenset()  # turning keys that went down since the last step
    paused: bool = False
    pace: int = PACES.index(1.0)
    due: float = 0.0  # steps that time has earned
    help: bool = False
    drawing: bool = False
    circle: tuple[float, float, float] | None = None  # x, y, radius [px] under the mouse
    flights: tuple[dict[str, Any], ...] = ()  # rows of finished flights by hand, not saved yet
    message: str = ""
    warned: bool = False  # that closing loses flights
    closed: bool = False

    @property
    def waiting(self) -> bool:
        """A person's flight begins with the first key, and no step counts before it."""
        still = not self.distance and not self.turning
        return self.pilot == 0 and not int(self.state.steps) and still

    @property
    def turning(self) -> frozenset[str]:
        return (self.held | self.tapped) & TURNING

    @property
    def colour(self) -> Colour:
        return colour(self.pilot)


def colour(pilot: int) -> Colour:
    """Of a pilot's drone and trail."""
    return PILOTS[pilot % len(PILOTS)]


def new(
    pilots: list[Pilot],
    bank: Tensor,
    split: str = "test",
    index: int = 0,
    max_steps: int = MAX_STEPS,
    person: int = 0,
    rows_path: Path = ROWS,
    bank_path: Path = BANK,
) -> Game:
    """A game on one set of a bank; the first of the pilots flies, or the person where there is none."""
    game = Game(
        bank=bank,
        split=split,
        index=index,
        obstacles=bank[index : index + 1],
        pilots=(Pilot(YOU, _nobody, WORLD), *pilots),
        pilot=1 if pilots else 0,
        state=_start(WORLD),
        choice=Choice(0, None, ""),
        generator=torch.Generator(),
        max_steps=max_steps,
        person=person,
        rows_path=rows_path,
        bank_path=bank_path,
    )
    return reset(game)


def _nobody(observation: Tensor, generator: torch.Generator | None = None) -> Tensor:
    raise AssertionError("the keys say what a person does")


def _start(world: World) -> State:
    return simulator.start(torch.tensor(0), torch.tensor(UP), world)


# -- time ------------------------------------------------------------------------------------------------------------


def advance(game: Game, seconds: float) -> Game:
    """Let time pass: as many steps as are due at the present pace."""
    if game.paused or game.waiting or game.drawing or game.ended or game.help:
        return replace(game, due=0.0) if game.due else game
    rate = STEPS_PER_SECOND * PACES[game.pace]
    game = replace(game, due=game.due + min(seconds, LONGEST_PAUSE) * rate)
    while game.due >= 1 and not game.ended:
        game = step(replace(game, due=game.due - 1))
    return game


def step(game: Game) -> Game:
    """One step of the simulation, as the pilot chose."""
    if game.ended or game.drawing:
        return game
    action = torch.tensor(game.choice.action)
    state, outcome = simulator.step(game.state, action, game.obstacles, game.world, "eq14", game.max_steps)
    legs = game.legs
    if legs[-1].pilot != game.pilot:
        legs = (*legs, Leg(game.pilot, legs[-1].points[-1:]))
    last = legs[-1]
    legs = (*legs[:-1], last._replace(points=(*last.points, (float(state.x), float(state.y)))))
    count = f"after {int(state.steps)} steps"
    ended = f"Collided {count}" if outcome.terminated else f"Cut off {count}" if outcome.truncated else ""
    game = replace(
        game,
        state=state,
        clearance=float(outcome.clearance),
        earned=float(outcome.reward),
        legs=legs,
        ended=ended,
        tapped=frozenset(),
    )
    return _landed(game, bool(outcome.terminated)) if ended else look(game)


def look(game: Game) -> Game:
    """What the pilot does next where the drone is now."""
    if game.pilot == 0:
        return replace(game, choice=Choice(steer(game), None, ""))
    _, policy, world = game.pilots[game.pilot]
    observation, _ = simulator.observe(game.state, game.obstacles, world)
    action = int(policy(observation, game.generator))
    if not isinstance(policy, Policy):
        return replace(game, choice=Choice(action, None, ""))
    meaning = "logits" if policy.algorithm == "ppo" else "Q values"
    return replace(game, choice=Choice(action, policy.values(observation), meaning))


def steer(game: Game) -> int:
    """The action of the keys that are down: the greatest turn to that side, or one degree, and the set distance."""
    angles, distances = decode(torch.arange(game.world.n_actions), game.world)
    side = (LEFT in game.turning) - (RIGHT in game.turning)
    greatest = int(angles.max()) if side > 0 else -int(angles.min())
    angle = side * (FINE_TURN if game.held & SHIFTS else greatest)
    return int(((angles == angle) & (distances == game.distance)).nonzero())


def _landed(game: Game, collided: bool) -> Game:
    """The flight is over; if a person flew all of it on a test set, it is one to keep."""
    if {leg.pilot for leg in game.legs} != {0}:
        return game
    if game.own or game.split != "test":
        return replace(game, message="Flights of the test sets alone can be kept")
    steps, counts = int(game.state.steps), {name: getattr(game.state, name).item() for name in COUNTS}
    place = {"seed": game.person, "frame": steps, "world": game.index, "layout": game.index}
    row = place | counts | {"terminated": collided, "truncated": not collided}
    game = replace(game, flights=(*game.flights, row), warned=False)
    return replace(game, message=unsaved(game))


# -- what keys do ----------------------------------------------------------------------------------------------------


def reset(game: Game) -> Game:
    """The same set from the start; the trail of the flight so far stays."""
    flown = tuple(leg for leg in game.legs if len(leg.points) > 1)
    game.generator.manual_seed(0)
    state = _start(game.world)
    _, clearance = simulator.observe(state, game.obstacles, game.world)
    start = Leg(game.pilot, ((float(state.x), float(state.y)),))
    ghosts = (*game.ghosts, *flown)[-KEPT_TRAILS:]
    fresh = replace(game, state=state, clearance=float(clearance), earned=0.0, ended="", distance=0, due=0.0)
    return look(replace(fresh, legs=(start,), ghosts=ghosts, tapped=frozenset(), drawing=False, circle=None))


def go_to(game: Game, index: int) -> Game:
    """Another set of the bank, counted round and round."""
    index %= len(game.bank)
    there = replace(game, index=index, obstacles=game.bank[index : index + 1], own=False, legs=(), ghosts=())
    return reset(there)


def following(by: int) -> Callable[[Game], Game]:
    return lambda game: go_to(game, game.index + by)


def seat(pilot: int) -> Callable[[Game], Game]:
    """Hand the drone over, wherever it is."""

    def act(game: Game) -> Game:
        if pilot >= len(game.pilots):
            return replace(game, message=f"There is no pilot {pilot}: 0 to {len(game.pilots) - 1}")
        swapped = replace(game, pilot=pilot, distance=game.choice.action % game.world.n_distances)
        if not int(game.state.steps):
            swapped = replace(swapped, distance=0, legs=(game.legs[-1]._replace(pilot=pilot),))
        return look(swapped)

    return act


def next_pilot(game: Game) -> Game:
    return seat((game.pilot + 1) % len(game.pilots))(game)


def quicker(by: int) -> Callable[[Game], Game]:
    """Set one's own distance a step, by pixels."""

    def act(game: Game) -> Game:
        if game.pilot:
            return replace(game, message="A policy flies; 0 hands the drone to you")
        distance = min(max(game.distance + by, 0), game.world.n_distances - 1)
        return look(replace(game, distance=distance))

    return act


def paced(by: int) -> Callable[[Game], Game]:
    return lambda game: replace(game, pace=min(max(game.pace + by, 0), len(PACES) - 1))


def pause(game: Game) -> Game:
    return replace(game, paused=not game.paused)


def single_step(game: Game) -> Game:
    return game if game.help else step(replace(game, paused=True))


def draw(game: Game) -> Game:
    """Begin to draw obstacles, or fly what was drawn."""
    if game.drawing:
        return reset(replace(game, legs=(), ghosts=()))
    return replace(reset(replace(game, legs=(), ghosts=())), drawing=True)


def clear(game: Game) -> Game:
    if not game.drawing:
        return replace(game, message="Press E first: it begins to draw")
    return replace(game, obstacles=game.obstacles[:, :0], own=True)


def save_bank(game: Game) -> Game:
    """Write the present obstacles as a bank of one set, to a name that is free."""
    path = free_name(game.bank_path)
    try:
        banks.save(game.obstacles, path, seed=0, split="own")
    except banks.LayoutError as error:
        return replace(game, message=str(error))
    return replace(game, message=f"Saved: python -m uavnav.play --layouts {path}")


def free_name(path: Path) -> Path:
    """The path, or the first of path-2, path-3, … at which there is no file."""
    tried, number = path, 1
    while tried.exists():
        number += 1
        tried = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return tried


def save_flights(game: Game) -> Game:
    """Add the rows of flights by hand to the file, after those that it has."""
    if not game.flights:
        return replace(game, message="No finished flight by hand to save")
    try:
        rows = pd.DataFrame(list(game.flights))
        rows.attrs = header(game.split, game.max_steps)
        kept = append_rows(game.rows_path, rows)
    except (RunError, OSError) as error:
        return replace(game, message=str(error))
    return replace(game, flights=(), message=f"Saved: {game.rows_path} holds {counted(kept)}")


def append_rows(path: Path, rows: pd.DataFrame) -> int:
    """Write rows of `EPISODE_COLUMNS` after those of a file, if it is there; returns how many it holds.

    Raises:
        OSError, RunError: it cannot be written, or what is there is another table.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with lock(path.parent):
        there = read_rows(path)
        rows = rows[list(EPISODE_COLUMNS)].astype(EPISODE_COLUMNS)
        together = rows if there is None else pd.concat([there, rows], ignore_index=True)
        write_table(path, together)
    return len(together)


def read_rows(path: Path) -> pd.DataFrame | None:
    """The rows of a file of flights by hand; None where there is no file.

    Raises:
        RunError: it is another table, or damaged.
    """
    return read_table(path, FIRST_COLUMNS, "move it away, or give another --out") if path.exists() else None


def show_help(game: Game) -> Game:
    return replace(game, help=not game.help)


def close(game: Game) -> Game:
    """Leave the help or the drawing; else the window."""
    if game.help:
        return show_help(game)
    if game.drawing:
        return draw(game)
    return leave(game)


def leave(game: Game) -> Game:
    """Close the window; before flights by hand are lost, ask once."""
    if game.flights and not game.warned:
        return replace(game, warned=True, help=False, message=f"{unsaved(game)}; once more closes without")
    return replace(game, closed=True)


def unsaved(game: Game) -> str:
    """What has not been saved, and how to."""
    return f"{counted(len(game.flights))} by hand not saved yet: K saves"


def counted(flights: int) -> str:
    """`1 flight`, `2 flights`."""
    return f"{flights} flight{'s' * (flights != 1)}"


def hold(game: Game) -> Game:
    """Keys that work for as long as they are down; `press` and `release` keep track."""
    return look(game) if game.pilot == 0 else replace(game, message="A policy flies; 0 hands the drone to you")


class Key(NamedTuple):
    """One line of the help: names as `pygame.key.name` gives them, how they are shown, what they do."""

    names: tuple[str, ...]
    shown: str
    does: str
    act: Callable[[Game], Game]


LEFT, RIGHT = "left", "right"
ALIASES = {"a": LEFT, "d": RIGHT, "w": "up", "s": "down"}  # as those keys of the table
TURNING = frozenset({LEFT, RIGHT})

KEYS = (
    Key((LEFT,), "← A", "turn 5° left for as long as it is down; with shift 1°", hold),
    Key((RIGHT,), "→ D", "turn 4° right (the most that eq. 11 has); with shift 1°", hold),
    Key(("up",), "↑ W", "one pixel a step faster, up to 9", quicker(1)),
    Key(("down",), "↓ S", "one pixel a step slower, down to 0", quicker(-1)),
    Key(("0",), "0", "fly yourself, from where the drone is", seat(0)),
    Key(("1",), "1 … 9", "hand the drone to policy 1 … 9, where it is", seat(1)),
    *(Key((str(n),), "", "", seat(n)) for n in range(2, 10)),
    Key(("tab",), "Tab", "hand it to the next one", next_pilot),
    Key(("space",), "Space", "pause, go on", pause),
    Key((".",), ".", "one step, then pause", single_step),
    Key(("-",), "-", "slower: ½, ¼, ⅒ of 30 steps a second", paced(-1)),
    Key(("=", "+"), "+ =", "faster: up to 4 times", paced(1)),
    Key(("r", "return"), "R Enter", "start again on the same obstacles; the trail stays", reset),
    Key(("n",), "N", "next set of obstacles", following(1)),
    Key(("p",), "P", "the set before", following(-1)),
    Key(("page down",), "PgDn", "ten sets on", following(10)),
    Key(("page up",), "PgUp", "ten sets back", following(-10)),
    Key(("e",), "E", "draw obstacles; again: fly them", draw),
    Key(("c", "delete"), "C Del", "while drawing: take all obstacles away", clear),
    Key(("b",), "B", "save these obstacles as a bank", save_bank),
    Key(("k",), "K", "keep flights by hand as rows for the report", save_flights),
    Key(("h", "f1"), "H F1", "this help", show_help),
    Key(("escape", "q"), "Esc Q", "close the help, the drawing, the window", close),
)
"""Every key, in the order of the help; one that is not shown belongs to the line above."""

MOUSE = (
    ("Left drag", "while drawing: an obstacle, from its centre to its edge"),
    ("Right click", "while drawing: take that obstacle away"),
)

_BY_NAME = {name: key for key in KEYS for name in key.names}


def press(game: Game, name: str) -> Game:
    """A key went down."""
    name = ALIASES.get(name, name)
    game = replace(game, message="", held=game.held | {name}, tapped=game.tapped | ({name} & TURNING))
    return _BY_NAME[name].act(game) if name in _BY_NAME else look(game) if name in SHIFTS else game


def release(game: Game, name: str) -> Game:
    """A key went up."""
    name = ALIASES.get(name, name)
    game = replace(game, held=game.held - {name})
    return look(game) if game.pilot == 0 and name in TURNING | SHIFTS else game


def release_all(game: Game) -> Game:
    """The window lost the keyboard."""
    game = replace(game, held=frozenset(), tapped=frozenset())
    return look(game) if game.pilot == 0 else game


# -- the mouse, while drawing ----------------------------------------------------------------------------------------


def grab(game: Game, x: float, y: float) -> Game:
    """The left button went down at a place of the world [px]: there is the obstacle's centre."""
    inside = 0 <= x <= game.world.width and 0 <= y <= game.world.height
    if not game.drawing or not inside:
        return game
    return replace(game, message="", circle=(x, y, game.world.obstacle_radius_min))


def drag(game: Game, x: float, y: float) -> Game:
    """The mouse moved with the button down: there is the obstacle's edge."""
    if game.circle is None:
        return game
    left, bottom, _ = game.circle
    radius = math.hypot(x - left, y - bottom)
    radius = min(max(radius, game.world.obstacle_radius_min), game.world.obstacle_radius_max)
    return replace(game, circle=(left, bottom, radius))


def drop(game: Game) -> Game:
    """The button went up: the obstacle is there, if a bank may have it."""
    if game.circle is None:
        return game
    refused, lifted = problem(game), replace(game, circle=None)
    if refused:
        return replace(lifted, message=refused)
    return replace(lifted, obstacles=_with(game), own=True)


def problem(game: Game) -> str:
    """Why the obstacle under the mouse cannot be there; empty if it can."""
    try:
        banks.validate(_with(game), game.world)
    except banks.LayoutError as error:
        return f"Not there: {error}"
    return ""


def _with(game: Game) -> Tensor:
    return torch.cat([game.obstacles, torch.tensor([[game.circle]], dtype=torch.float32)], dim=1)


def erase(game: Game, x: float, y: float) -> Game:
    """The right button: take away the last obstacle that covers this place of the world [px]."""
    if not game.drawing:
        return game
    circles = game.obstacles[0]
    covers = torch.hypot(circles[:, 0] - x, circles[:, 1] - y) <= circles[:, 2]
    if not covers.any():
        return game
    kept = torch.arange(len(circles)) != int(covers.nonzero()[-1])
    return replace(game, obstacles=game.obstacles[:, kept], own=True, message="")
