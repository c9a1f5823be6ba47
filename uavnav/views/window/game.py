"""What the live window does, without a window: a game, the keys and the mouse that change it, and time.

A `Game` is a value: every function takes one and returns the next. The drawing is in `hud`, the window in
`play`. Which key does what is in `keys`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import torch
from torch import Tensor

from uavnav.algorithms import ALGORITHMS
from uavnav.envs.drawing import PILOTS, STEPS_PER_SECOND, Colour
from uavnav.evaluation import episodes
from uavnav.runs.metrics import EPISODE_COLUMNS, EVALUATED
from uavnav.runs.policies import Policy
from uavnav.runs.tables import RunError, lock, read_table, write_table
from uavnav.tasks import layouts as splits
from uavnav.tasks import space
from uavnav.tasks.dynamics import decode
from uavnav.tasks.protocol import MAX_STEPS
from uavnav.tasks.space import SpaceWorld
from uavnav.tasks.state import COUNTS, UP, State
from uavnav.tasks.table import EMPTY, make_task
from uavnav.tasks.task import Task
from uavnav.tasks.world import World
from uavnav.tasks.wrapper import WrappedTask
from uavnav.views.render import Pilot
from uavnav.views.window.table import DRAWN, LEFT, RIGHT, RISE, ROWS, SINK, TILTING, TURNING

PACES = (1 / 10, 1 / 4, 1 / 2, 1.0, 2.0, 4.0)
"""How many times as fast as the simulation's own rate."""
LONGEST_PAUSE = 0.1  # [s] of simulated time that a slow frame may catch up
KEPT_TRAILS = 5  # of earlier episodes on the same layout

SHIFTS = frozenset({"left shift", "right shift"})


class Choice(NamedTuple):
    """What the pilot does next, and the numbers behind it."""

    action: int
    values: Tensor | None = None  # [100] logits (PPO) or Q (DQN); None of a person or a script
    meaning: str = ""  # of the values


class Leg(NamedTuple):
    """A part of an episode that one pilot flew."""

    pilot: int
    points: tuple[tuple[float, ...], ...]  # (x, y), in 3D (x, y, z) [px]


@dataclass(frozen=True, eq=False)
class Game:
    """One layout, one drone, several pilots of whom one flies; pilot 0 is the person at the keys."""

    layouts: Tensor  # [n, k, 3] px, or more columns, as its task has it
    split: str  # its name, or its path
    pilots: tuple[Pilot, ...]
    pilot: int
    state: State
    choice: Choice
    index: int = 0  # the present layout, or the one that came before one of one's own
    obstacles: Tensor = EMPTY  # [1, K, 3] px, the present set
    generator: torch.Generator = field(default_factory=torch.Generator)  # of sampled actions, and of faults
    max_steps: int = MAX_STEPS
    person: int = 0
    rows_path: Path = ROWS
    drawn_path: Path = DRAWN
    own: bool = False  # the obstacles are one's own
    clearance: float = math.inf  # [px]
    earned: float = 0.0  # reward of the last step
    ended: str = ""  # how the episode ended
    legs: tuple[Leg, ...] = ()  # of the present episode
    ghosts: tuple[Leg, ...] = ()  # of earlier episodes on this layout
    distance: int = 0  # [px a step], set by the keys
    held: frozenset[str] = frozenset()  # keys that are down
    tapped: frozenset[str] = frozenset()  # turning keys that went down since the last step
    paused: bool = False
    pace: int = PACES.index(1.0)
    due: float = 0.0  # steps that time has earned
    help: bool = False
    drawing: bool = False
    circle: tuple[float, float, float] | None = None  # x, y, radius [px] under the mouse
    episodes: tuple[dict[str, Any], ...] = ()  # rows of finished episodes by hand, not saved yet
    message: str = ""
    warned: bool = False  # that closing loses episodes
    closed: bool = False

    @property
    def waiting(self) -> bool:
        """A person's episode begins with the first key, and no step counts before it."""
        return self.pilot == 0 and not (int(self.state.steps) or self.distance or self.turning)

    @property
    def task(self) -> WrappedTask:
        """The task of the one who flies, on the present obstacles."""
        return self.pilots[self.pilot].task.replace(layouts=self.obstacles, max_steps=self.max_steps)

    @property
    def world(self) -> World:
        """The world of the one who flies."""
        return self.pilots[self.pilot].task.world

    @property
    def turning(self) -> frozenset[str]:
        """Keys that are down and turn it."""
        return (self.held | self.tapped) & (TURNING | TILTING if in_3d(self.world) else TURNING)


def in_3d(world: World) -> bool:
    return isinstance(world, SpaceWorld)


def parts(world: World) -> tuple[Tensor, Tensor, Tensor]:
    """What each action asks for: the turn, the pitch [degrees] and the distance [px], [n] each; 2D has no
    pitch.
    """
    actions = torch.arange(world.n_actions)
    if isinstance(world, SpaceWorld):
        return space.decode(actions, world)
    turn, distance = decode(actions, world)
    return turn, torch.zeros_like(turn), distance


def at(state: State) -> tuple[float, ...]:
    """The place of the drone [px]."""
    return tuple(float(getattr(state, axis)) for axis in "xyz" if axis in state._fields)


def colour(pilot: int) -> Colour:
    """Of a pilot's drone and trail."""
    return PILOTS[pilot % len(PILOTS)]


def new(
    pilots: Sequence[Pilot],
    layouts: Tensor,
    split: str = "test",
    index: int = 0,
    you: Pilot | None = None,
    **how: Any,
) -> Game:
    """A game on one layout of a split; the first of the pilots flies, or the person where there is none.

    you: the person, by default in the paper's world; how: other fields of `Game`, such as `max_steps`.
    """
    you = you or Pilot("you", nobody, make_task(EMPTY))
    state = you.task.start(torch.tensor(0), torch.tensor(UP), you.task.draw(1, torch.Generator())[0])
    return following(
        Game(layouts, split, (you, *pilots), min(len(pilots), 1), state, Choice(0), **how), index
    )


def nobody(observation: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Whoever flies by hand, whom no observation moves."""
    raise AssertionError("the keys say what a person does")


# -- time ----------------------------------------------------------------------------------------------------


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
    state, outcome = game.task.step(game.state, torch.tensor(game.choice.action), _draws(game))
    *earlier, last = game.legs
    if last.pilot != game.pilot:
        earlier, last = [*earlier, last], Leg(game.pilot, last.points[-1:])
    points = (*last.points, at(state))
    count = f"after {int(state.steps)} steps"
    collided = bool(outcome.clearance <= game.world.drone_radius)
    reached = f"Arrived {count}" if outcome.terminated else f"Cut off {count}" if outcome.truncated else ""
    ended = f"Collided {count}" if collided else reached
    game = replace(
        game,
        state=state,
        clearance=float(outcome.clearance),
        earned=float(outcome.reward),
        legs=(*earlier, last._replace(points=points)),
        ended=ended,
        tapped=frozenset(),
    )
    return _landed(game, bool(outcome.terminated)) if ended else look(game)


def _draws(game: Game) -> Tensor:
    """What the faults of its task need for a step, or for a start: [n_draws], often none."""
    return game.task.draw(1, game.generator)[0]


def look(game: Game) -> Game:
    """What the pilot does next where the drone is now."""
    if game.pilot == 0:
        return steer(game)
    policy = game.pilots[game.pilot].policy
    observation, _ = game.task.observe(game.state)
    if not isinstance(policy, Policy):
        return replace(game, choice=Choice(int(policy(observation, game.generator))))
    values = policy.values(observation)
    meaning = ALGORITHMS[policy.algorithm].values
    return replace(game, choice=Choice(int(policy.act(values, game.generator)), values, meaning))


def steer(game: Game) -> Game:
    """A person's action by the keys that are down: the greatest turn to that side, or the least, and the
    distance.
    """
    if game.pilot or game.ended:
        return game
    turns, pitches, distances = parts(game.world)
    turn = _by(turns, (LEFT in game.turning) - (RIGHT in game.turning), game)
    pitch = _by(pitches, (RISE in game.turning) - (SINK in game.turning), game)
    chosen = (turns == turn) & (pitches == pitch) & (distances == game.distance)
    return replace(game, choice=Choice(int(chosen.nonzero())))


def _by(angles: Tensor, side: int, game: Game) -> int:
    """The greatest of some angles to a side, with shift the least; side: 1, -1 or 0."""
    own = (side * angles)[side * angles > 0]
    return side * int(own.min() if game.held & SHIFTS else own.max()) if side else 0


def _landed(game: Game, collided: bool) -> Game:
    """The episode is over; if a person flew all of it on a test layout, it is one to keep."""
    if {leg.pilot for leg in game.legs} != {0}:
        return game
    if game.own or game.split != "test" or type(game.task.task) is not Task:
        return replace(game, message="Episodes of the test layouts alone can be kept")
    steps, counts = int(game.state.steps), {name: getattr(game.state, name).item() for name in COUNTS}
    place = {"seed": game.person, "frame": steps, "env": game.index, "layout": game.index}
    row = place | counts | {"terminated": collided, "truncated": not collided}
    game = replace(game, episodes=(*game.episodes, row), warned=False)
    return replace(game, message=unsaved(game))


# -- what keys do --------------------------------------------------------------------------------------------


def reset(game: Game) -> Game:
    """The same layout from the start; the trail of the episode so far stays."""
    flown = tuple(leg for leg in game.legs if len(leg.points) > 1)
    game.generator.manual_seed(game.pilots[game.pilot].seed)
    heading = episodes.headings(game.task, game.index + 1)[-1]
    state = game.task.start(torch.tensor(0), heading, _draws(game))
    _, clearance = game.task.observe(state)
    start = Leg(game.pilot, (at(state),))
    ghosts = (*game.ghosts, *flown)[-KEPT_TRAILS:]
    fresh = replace(game, state=state, clearance=float(clearance), earned=0.0, ended="", distance=0, due=0.0)
    return look(replace(fresh, legs=(start,), ghosts=ghosts, tapped=frozenset(), drawing=False, circle=None))


def following(game: Game, by: int) -> Game:
    """Another layout of the split, so many further on, counted round and round."""
    index = (game.index + by) % len(game.layouts)
    obstacles = game.layouts[index : index + 1]
    return reset(replace(game, index=index, obstacles=obstacles, own=False, legs=(), ghosts=()))


def seat(game: Game, pilot: int) -> Game:
    """Hand the drone over, wherever it is; the next pilot remembers nothing of the episode so far."""
    if pilot >= len(game.pilots):
        return replace(game, message=f"There is no pilot {pilot}: 0 to {len(game.pilots) - 1}")
    swapped = replace(game, pilot=pilot, distance=int(parts(game.world)[2][game.choice.action]))
    if not int(game.state.steps):
        swapped = replace(swapped, distance=0, legs=(game.legs[-1]._replace(pilot=pilot),))
    return look(replace(swapped, state=swapped.task.remember(swapped.state, _draws(swapped))))


def next_pilot(game: Game) -> Game:
    return seat(game, (game.pilot + 1) % len(game.pilots))


def hold(game: Game) -> Game:
    """Keys that steer; `press` and `release` keep track of those that are down."""
    return replace(game, message="A policy flies; 0 hands the drone to you") if game.pilot else steer(game)


def quicker(game: Game, by: int) -> Game:
    """Set one's own distance a step, to the next that there is."""
    ways = game.world.distances
    return hold(replace(game, distance=ways[min(max(ways.index(game.distance) + by, 0), len(ways) - 1)]))


def paced(game: Game, by: int) -> Game:
    return replace(game, pace=min(max(game.pace + by, 0), len(PACES) - 1))


def pause(game: Game) -> Game:
    return replace(game, paused=not game.paused)


def single_step(game: Game) -> Game:
    return game if game.help else step(replace(game, paused=True))


def draw(game: Game) -> Game:
    """Begin to draw obstacles, or fly what was drawn."""
    if in_3d(game.world) or splits.KINDS[splits.kind_of(game.world)].beside:
        return replace(game, message="Obstacles are drawn in worlds of two dimensions without a goal")
    return replace(reset(replace(game, legs=(), ghosts=())), drawing=not game.drawing)


def clear(game: Game) -> Game:
    if not game.drawing:
        return replace(game, message="Press E first: it begins to draw")
    return replace(game, obstacles=game.obstacles[:, :0], own=True)


def save_layouts(game: Game) -> Game:
    """Write the present obstacles as a layout file of one layout, to a name that is free."""
    path, number = game.drawn_path, 1
    while path.exists():
        number += 1
        path = game.drawn_path.with_stem(f"{game.drawn_path.stem}-{number}")
    try:
        splits.save(game.obstacles, path, seed=0, split="own", world=game.world)
    except splits.LayoutError as error:
        return replace(game, message=str(error))
    return replace(game, message=f"Saved: uavnav play --layouts {path}")


def save_episodes(game: Game) -> Game:
    """Add the rows of episodes by hand to the file, after those that it has."""
    if not game.episodes:
        return replace(game, message="No finished episode by hand to save")
    path, rows = game.rows_path, pd.DataFrame(list(game.episodes)).astype(EPISODE_COLUMNS)
    rows.attrs = {"layouts": game.split, "max_steps": game.max_steps}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with lock(path.parent):
            rows = pd.concat([read_rows(path), rows], ignore_index=True)
            write_table(path, rows)
    except (RunError, OSError) as error:
        return replace(game, message=str(error))
    return replace(game, episodes=(), message=f"Saved: {path} holds {counted(len(rows))}")


def read_rows(path: Path) -> pd.DataFrame | None:
    """The rows of a file of episodes by hand; None where there is no file.

    Raises:
        RunError: it is another table, or damaged.
    """
    return read_table(path, EVALUATED, "move it away, or give another --out") if path.exists() else None


def show_help(game: Game) -> Game:
    return replace(game, help=not game.help)


def close(game: Game) -> Game:
    """Leave the help or the drawing; else the window."""
    if game.help:
        return show_help(game)
    return draw(game) if game.drawing else leave(game)


def leave(game: Game) -> Game:
    """Close the window; before episodes by hand are lost, ask once."""
    if game.episodes and not game.warned:
        return replace(game, warned=True, help=False, message=f"{unsaved(game)}; once more closes without")
    return replace(game, closed=True)


def unsaved(game: Game) -> str:
    """What has not been saved, and how to."""
    return f"{counted(len(game.episodes))} by hand not saved yet: K saves"


def counted(episodes: int) -> str:
    """`1 episode`, `2 episodes`."""
    return f"{episodes} episode{'s' * (episodes != 1)}"
