"""A task: where episodes start and obstacles are, what is sensed, how an action moves the drone, what a step
earns.

A `Task` has no state. Its functions are pure and work on a batch of independent rows. `wrapper.WrappedTask`
adds faults and memory, and the shells around that (TorchRL in `env`, Gymnasium in `gym`, evaluations,
pictures) do not know which task it is. Nothing here knows of TensorDicts, specs or agents. Letters: B the
batch shape (any, also none), L layouts of a layout file, K obstacles of a layout, S slots of an observation.
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from uavnav.errors import MOST_WHOLE, ConfigError, among, choose_from, quoted, told
from uavnav.tasks import sensing
from uavnav.tasks.dynamics import decode, move
from uavnav.tasks.rewards import REWARDS, Step, Terms, check_reward, total
from uavnav.tasks.sensing import Scan
from uavnav.tasks.state import COUNTS, State
from uavnav.tasks.world import World


class Outcome(NamedTuple):
    """What a step led to."""

    # [*B, observation_size] float32 that a policy sees, at the collision where there was one
    observation: Tensor
    clearance: Tensor  # [*B] px
    reward: Tensor  # [*B] float64
    terminated: Tensor  # [*B] bool: a collision, or at a goal
    truncated: Tensor  # [*B] bool: the time limit, and no collision


@dataclass(frozen=True, eq=False)
class Task:
    """The paper's task: a drone among circles in a window, whose observation is eq. (13).

    Another task is another class: a subclass that says what is different, and an entry in `table.TASKS`.
    `observe` and `step` put the others together; `WrappedTask` has its own, so a subclass leaves them alone.

    Raises:
        ConfigError: an unknown reward, or a time limit that is no whole number from 1; a subclass that
            defines `observe` or `step`.
    """

    WORLD: ClassVar[type[World]] = World
    """What is physical about it; every field can be set in a run."""

    REWARD: ClassVar[str] = "eq14"
    """What a step earns where nothing else is chosen."""

    MAX_STEPS: ClassVar[int | None] = None
    """The time limit where none is given."""

    STATIC: ClassVar[bool] = True
    """Nothing moves but the drone, and nothing is random: from the same place the same actions lead the same
    way.

    A subclass that defines functions is not static unless it sets this itself.
    """

    STATE: ClassVar[type[State]] = State
    """What a drone is at one moment."""

    world: World
    layouts: Tensor  # [L, K, 3] of (x, y, radius) px
    reward: str = "eq14"  # a name of `REWARDS`
    max_steps: int | None = None  # a time limit, or none as in the paper

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        for name in ("observe", "step"):
            if name in cls.__dict__:
                called = "sense, encode, move or judge"
                raise ConfigError(f"{cls.__name__}.{name}: runs would never call it; define {called} instead")
        if "STATIC" not in cls.__dict__ and any(map(inspect.isroutine, cls.__dict__.values())):
            cls.STATIC = False

    def __post_init__(self) -> None:
        if not among(self.reward, REWARDS):
            raise ConfigError(f"reward={quoted(self.reward)}; {choose_from(self.reward, REWARDS)}")
        check_reward(self.reward, self.world)
        limit = self.max_steps
        if limit is not None and (not isinstance(limit, int) or not 1 <= limit <= MOST_WHOLE):
            raise ConfigError(f"max_steps={told(limit)}; choose None or a whole number from 1")

    # -- what there is ---------------------------------------------------------------------------------------

    def obstacles(self, state: State) -> Tensor:
        """Where the obstacles of each row are now: [*B, K, 3] px."""
        return self.layouts[state.layout]

    def velocities(self, state: State) -> Tensor:
        """Where the obstacles of each row move: [*B, K, 2] px a step, in 3D [*B, K, 3]."""
        return torch.zeros_like(self.obstacles(state)[..., :-1])

    def info(self, state: State) -> dict[str, Tensor]:
        """What an environment tells of each row besides its observation: names and values [*B]."""
        return {"layout": state.layout, "x": state.x, "y": state.y, "heading": state.heading}

    def marks(self, state: State) -> Tensor:
        """What is drawn of each row and not sensed: [*B, marks, 3] of (x, y, radius) px."""
        return self.layouts.new_zeros(*state.layout.shape, 0, 3)

    # -- what happens ----------------------------------------------------------------------------------------

    def start(self, layout: Tensor, heading: Tensor) -> State:
        """The state at the beginning of an episode: layout [*B] index, heading [*B] whole degrees."""
        x, y = (torch.full_like(layout, place, dtype=torch.float32) for place in self.world.start[:2])
        counts = {name: torch.zeros_like(layout) for name in COUNTS[:-1]}
        return State(x, y, heading, layout, **counts, reward=torch.zeros_like(layout, dtype=torch.float64))

    def sense(self, state: State) -> tuple[Scan, Tensor]:
        """What comes back to the sensor, and the clearance [*B] px."""
        obstacles, velocities = self.obstacles(state), self.sensed_velocities(state)
        return sensing.scan(state.x, state.y, state.heading, obstacles, self.world, velocities)

    def sensed_velocities(self, state: State) -> Tensor | None:
        """What is sensed of velocities, as shares of the greatest speed [*B, K, 2]; None where none is."""
        return None

    def encode(self, state: State, found: Scan) -> Tensor:
        """Eq. (13): the observation that is made of what came back, [*B, world.observation_size]."""
        return sensing.encode(found, self.world).flatten(-2)

    def observe(self, state: State) -> tuple[Tensor, Tensor]:
        """The observation [*B, world.observation_size], and the clearance [*B] px."""
        found, clearance = self.sense(state)
        return self.encode(state, found), clearance

    def move(self, state: State, action: Tensor) -> tuple[State, Tensor, Tensor]:
        """Turn, then fly: where the drone is after action [*B], angle [*B] degrees, distance [*B] px."""
        angle, distance = decode(action, self.world)
        x, y, heading = move(state.x, state.y, state.heading, angle, distance)
        return state._replace(x=x, y=y, heading=heading), angle, distance

    def step(self, state: State, action: Tensor) -> tuple[State, Outcome]:
        """Move, observe, then judge: one step of every row, of action [*B] int64 in 0..n_actions - 1."""
        moved, angle, distance = self.move(state, action)
        observation, clearance = self.observe(moved)
        return self.conclude(Step(state, moved, action, angle, distance, clearance, observation, self.world))

    def conclude(self, step: Step) -> tuple[State, Outcome]:
        """Count a step and judge it. A collision is `terminated`; the time limit is `truncated`, and never
        also a collision.

        step: without its counts -> the state after it, and what it led to.
        """
        before, stopped, turned = step.before, step.distance == 0, step.angle != 0
        after = step.after._replace(
            steps=before.steps + 1,
            stops=before.stops + stopped,
            full_stops=before.full_stops + (stopped & ~turned),
            turns=before.turns + turned,
            distance=before.distance + step.distance,
        )
        over, terms = self.judge(step._replace(after=after))
        earned = total(self.reward, terms, over)
        at_limit = torch.zeros_like(over) if self.max_steps is None else after.steps >= self.max_steps
        outcome = Outcome(step.observation, step.clearance, earned, over, at_limit & ~over)
        return after._replace(reward=before.reward + earned), outcome

    def judge(self, step: Step) -> tuple[Tensor, Terms]:
        """Whether each row's episode is over [*B], the time limit aside; what the step earns, by name."""
        return step.collided, REWARDS[self.reward](step)

    def measure(self, before: State, after: State) -> dict[str, Tensor]:
        """What an evaluation adds up over an episode, besides `COUNTS`: names and numbers [*B] of a step."""
        return {}

    @classmethod
    def limit(cls, most: int) -> int:
        """The time limit of an evaluation if none is given: so many steps, or the task's own if lower."""
        return min(most, cls.MAX_STEPS or most)
