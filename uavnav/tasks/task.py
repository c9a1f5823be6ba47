"""A task: where flights start, what is sensed, how an action moves the drone, what a step earns and ends.

A `Task` holds no state. Its functions are pure and work on a batch of independent rows; the shells around them (TorchRL
in `env`, Gymnasium in `gym`, flights, pictures) ask it and do not know which world it is. Nothing here knows of
TensorDicts, specs or agents. Letters: B the batch shape (any, also none), L layouts of a bank, K obstacles of a layout.
"""

from __future__ import annotations

import functools
import inspect
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self

import torch
from torch import Tensor

from uavnav.errors import MOST_WHOLE, ConfigError, among, did_you_mean, quoted, told
from uavnav.tasks import layouts as banks
from uavnav.tasks import memory
from uavnav.tasks.dynamics import decode, move
from uavnav.tasks.faults import MOST_REMEMBERED, NO_FAULTS, Faults
from uavnav.tasks.rewards import REWARDS, Step, Terms, check_reward, total
from uavnav.tasks.sensing import Echoes, at_reach, heard, sense
from uavnav.tasks.state import COUNTS, State
from uavnav.tasks.world import World


class Outcome(NamedTuple):
    """What a step led to."""

    observation: Tensor  # [*B, observation_size] float32 that a policy sees, at the collision where there was one
    clearance: Tensor  # [*B] px
    reward: Tensor  # [*B] float64
    terminated: Tensor  # [*B] bool: a collision, or at a goal
    truncated: Tensor  # [*B] bool: the cap on steps, and no collision


@dataclass(frozen=True, eq=False)
class Task:
    """The paper's task: a drone among circles in a window, whose observation is eq. (13).

    Another world is another class: a subclass that says what is different, and a line of `TASKS`.

    Raises:
        ValueError: an unknown reward, or a cap that is no whole number from 1.
        LayoutError: the bank is not valid for the world.
    """

    WORLD: ClassVar[type[World]] = World
    """What is physical about it; every field can be set in a run."""

    REWARD: ClassVar[str] = "eq14"
    """What a step earns where nothing else is chosen."""

    MAX_STEPS: ClassVar[int | None] = None
    """The cap where none is given."""

    STATIC: ClassVar[bool] = True
    """Nothing moves but the drone, and nothing is random: from the same place the same actions lead the same way.

    A subclass with functions of its own says so itself; else nothing is made of it.
    """

    STATE: ClassVar[type[State]] = State
    """What a drone is at one moment, aside from what it remembers."""

    world: World
    bank: Tensor  # [L, K, 3] of (x, y, radius) px
    reward: str = "eq14"  # a name of `REWARDS`
    max_steps: int | None = None  # a cap on steps, or none as in the paper
    stack: int = 1  # newest observations that a policy sees at once, the newest first
    faults: Faults = NO_FAULTS
    trained_reach: float | None = None  # [px] where a proximity is 1, of a policy trained with another sensor's radius

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if "STATIC" not in cls.__dict__ and any(map(inspect.isroutine, cls.__dict__.values())):
            cls.STATIC = False

    def __post_init__(self) -> None:
        if not among(self.reward, REWARDS):
            hint = did_you_mean(self.reward, REWARDS)
            raise ConfigError(f"reward={quoted(self.reward)}; choose from {', '.join(REWARDS)}{hint}")
        check_reward(self.reward, self.world)
        cap = self.max_steps
        if cap is not None and (not isinstance(cap, int) or not 1 <= cap <= MOST_WHOLE):
            raise ConfigError(f"max_steps={told(cap)}; choose None or a whole number from 1")
        if not isinstance(self.stack, int) or not 1 <= self.stack <= MOST_REMEMBERED:
            raise ConfigError(f"stack={told(self.stack)}; give a whole number from 1 to {MOST_REMEMBERED}")

    @property
    def observation_size(self) -> int:
        """Numbers that a policy sees: those of the world, for each observation of the stack."""
        return self.stack * self.world.observation_size

    @property
    def remembers(self) -> bool:
        """Whether states remember observations: of a stack, or as faults had them sensed."""
        return self.stack > 1 or self.faults != NO_FAULTS

    @property
    def state_class(self) -> type[State]:
        """That of its states, with what a drone remembers."""
        return memory.remembering(self.STATE) if self.remembers else self.STATE  # type: ignore[arg-type]

    # -- random numbers: tensors that come in ------------------------------------------------------------------------

    @property
    def n_draws(self) -> int:
        """Random numbers that a row needs to start, and for each step; mostly none."""
        return sum(self.faults.sizes(self.world.n_slots))

    def draw(self, rows: int, generator: torch.Generator) -> Tensor:
        """The random numbers of one step, or of one start, of so many rows: [rows, n_draws] float32."""
        normal, *uniform = self.faults.sizes(self.world.n_slots)
        drawn = [torch.randn(rows, normal, generator=generator), torch.rand(rows, sum(uniform), generator=generator)]
        some = [one for one in drawn if one.numel()]
        return some[0] if len(some) == 1 else torch.cat(drawn, -1)

    def _check_draws(self, draws: Tensor | None) -> None:
        if draws is None and self.n_draws:
            raise ValueError(f"faults={self.faults}: give draws, which the task's `draw` makes for its rows")

    # -- what happens ------------------------------------------------------------------------------------------------

    def start(self, layout: Tensor, heading: Tensor, draws: Tensor | None = None) -> State:
        """The state at the beginning of an episode.

        layout [*B] index, heading [*B] whole degrees, draws [*B, n_draws] where the task needs some.
        """
        self._check_draws(draws)
        return self.remember(self.place(layout, heading), draws)

    def place(self, layout: Tensor, heading: Tensor) -> State:
        """Where an episode begins, without what is sensed there: layout [*B] index, heading [*B] whole degrees."""
        x, y = (torch.full_like(layout, place, dtype=torch.float32) for place in self.world.start[:2])
        counts = {name: torch.zeros_like(layout) for name in COUNTS[:-1]}
        return State(x, y, heading, layout, **counts, reward=torch.zeros_like(layout, dtype=torch.float64))

    def remember(
        self, state: State, draws: Tensor | None = None, sensed: Tensor | None = None, distance: Tensor | None = None
    ) -> State:
        """The same state as if the episode began there: where this task remembers, the one observation of now.

        draws [*B, n_draws] disturb what is sensed, if they are given; or sensed [*B, n] says what it was. With the
        slots' distance [*B, S] px too, these two say what is `truly` there, and draws disturb that.
        """
        bare = self.STATE(*(getattr(state, name) for name in self.STATE._fields))
        if not self.remembers:
            return bare
        if sensed is None:
            sensed, _ = self.sense(bare, draws)
        elif distance is not None:
            sensed = self._disturbed(sensed, distance, draws)
        return memory.begin(bare, sensed, self.faults.late + self.stack)

    def obstacles(self, state: State) -> Tensor:
        """Where the obstacles of each row are now: [*B, K, 3] px."""
        return self.bank[state.layout]

    def velocities(self, state: State) -> Tensor:
        """Where the obstacles of each row move: [*B, K, 2] px a step, in 3D [*B, K, 3]."""
        return torch.zeros_like(self.obstacles(state)[..., :-1])

    def info(self, state: State) -> dict[str, Tensor]:
        """What an environment tells of each row beside its observation: names and values [*B]."""
        return {"layout": state.layout, "x": state.x, "y": state.y, "heading": state.heading}

    def sense(self, state: State, draws: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """What is sensed now, as one vector a row: [*B, world.observation_size], and clearance [*B] px.

        draws [*B, n_draws] disturb it as `faults` says; without them it is as it is.
        """
        slots, clearance = self.look(state, self.obstacles(state), None, self.echoes(draws))
        return slots.flatten(-2), clearance

    def look(
        self, state: State, obstacles: Tensor, velocities: Tensor | None, echoes: Echoes | None
    ) -> tuple[Tensor, Tensor]:
        """The slots [*B, S, n] that are sensed of obstacles, and clearance [*B] px; see `sensing.sense`."""
        return sense(state.x, state.y, state.heading, obstacles, self.world, velocities, echoes)

    def echoes(self, draws: Tensor | None) -> Echoes | None:
        """What faults, and a policy's other reach, make of the echoes of slots, if anything: draws [*B, n_draws]."""
        found: Echoes | None = None
        if draws is not None and self.faults.disturbs:
            found = functools.partial(self.faults.echoes, draws=draws)
        return found if self.trained_reach is None else at_reach(self.trained_reach, self.world, found)

    def truly(self, state: State) -> tuple[Tensor, Tensor]:
        """What there is to sense [*B, n], and each slot's distance [*B, S] px before `faults`, inf of an empty one."""
        found: list[Tensor] = []

        def listen(distance: Tensor, filled: Tensor) -> tuple[Tensor, Tensor]:
            found.append(distance.where(filled, math.inf).movedim(0, -1).contiguous())
            return distance, filled

        self.look(state, self.obstacles(state), None, listen)
        return self.sense(state)[0], found[0]

    def _disturbed(self, sensed: Tensor, distance: Tensor, draws: Tensor | None) -> Tensor:
        """What `sense` gives with some draws, of what is `truly` there."""
        if (echoes := self.echoes(draws)) is None:
            return sensed
        n, distance = self.world.n_slots * len(self.world.slot_low), distance.movedim(-1, 0)
        slots = sensed[..., :n].reshape(*sensed.shape[:-1], self.world.n_slots, -1).movedim((-1, -2), (0, 1))
        slots = heard(slots, distance, distance < math.inf, self.world, echoes)
        return torch.cat([slots.movedim((0, 1), (-1, -2)).flatten(-2), sensed[..., n:]], -1)

    def observe(self, state: State) -> tuple[Tensor, Tensor]:
        """What a policy sees, as one vector a row: observation [*B, observation_size], clearance [*B] px.

        A drone that remembers does not sense again: it sees what its state holds.
        """
        sensed, clearance = self.sense(state)
        return self.recall(state) if self.remembers else sensed, clearance

    def recall(self, state: State) -> Tensor:
        """The stack of observations that a policy sees, late as `faults` says: [*B, observation_size], a copy."""
        return memory.seen_of(state)[..., self.faults.late : self.faults.late + self.stack, :].flatten(-2).clone()

    def move(self, state: State, action: Tensor) -> tuple[State, Tensor, Tensor]:
        """Turn, then fly: where the drone is after action [*B], angle [*B] degrees, distance [*B] px."""
        angle, distance = decode(action, self.world)
        x, y, heading = move(state.x, state.y, state.heading, angle, distance)
        return state._replace(x=x, y=y, heading=heading), angle, distance

    def step(self, state: State, action: Tensor, draws: Tensor | None = None) -> tuple[State, Outcome]:
        """Move, sense, then judge: one step of every row.

        action [*B] int64 in 0..n_actions - 1, draws [*B, n_draws] where the task needs some. A collision is
        `terminated`; the cap on steps, where there is one, is `truncated` and never also a collision.

        Raises:
            ValueError: the task has faults that need random numbers, and there are none.
        """
        self._check_draws(draws)
        if draws is not None and self.faults.sticky:
            action = self.faults.executed(action, memory.executed_of(state), state.steps, draws)
        moved, angle, distance = self.move(state, action)
        observation, clearance = self.sense(moved, draws)
        if self.remembers:
            moved = memory.add(moved, observation, action)
            observation = self.recall(moved)
        collided = clearance <= self.world.drone_radius
        stopped, turned = distance == 0, angle != 0
        after = moved._replace(
            steps=state.steps + 1,
            stops=state.stops + stopped,
            full_stops=state.full_stops + (stopped & ~turned),
            turns=state.turns + turned,
            distance=state.distance + distance,
        )
        seen = Step(state, after, action, angle, distance, collided, clearance, observation, self.world)
        over, terms = self.judge(seen)
        earned = total(self.reward, terms, over)
        capped = torch.zeros_like(collided) if self.max_steps is None else after.steps >= self.max_steps
        outcome = Outcome(observation, clearance, earned, over, capped & ~over)
        return after._replace(reward=state.reward + earned), outcome

    def try_out(self) -> None:
        """Fly two rows for a step; raises whatever is wrong with a task's functions or with its reward."""
        rows = torch.zeros(2, dtype=torch.int64)
        draws = self.draw(2, torch.Generator())
        state = self.start(rows, rows, draws)
        self.step(state, torch.tensor([0, self.world.n_actions - 1]), draws)

    def judge(self, step: Step) -> tuple[Tensor, Terms]:
        """Whether each row's episode is over [*B] bool, the cap aside; and what the step earns, by name [*B]."""
        return step.collided, REWARDS[self.reward](step)

    def marks(self, state: State) -> Tensor:
        """What is drawn of each row and not sensed: [*B, marks, 3] of (x, y, radius) px."""
        return self.bank.new_zeros(*state.layout.shape, 0, 3)

    def measure(self, before: State, after: State) -> dict[str, Tensor]:
        """What an evaluation counts of each step, beside `COUNTS`: names and numbers [*B], added up over a flight."""
        return {}

    @classmethod
    def cap(cls, most: int) -> int:
        """The cap of an evaluation if none is given: so many steps, or the task's own cap where that is lower."""
        return min(most, cls.MAX_STEPS or most)

    def with_bank(self, bank: Tensor) -> Self:
        """The same task on a bank that is known to be valid."""
        return replace(self, bank=bank)

    def on(self, layouts: str | Path | Tensor, max_steps: int | None) -> Self:
        """The same task on another bank, with another cap.

        Raises:
            LayoutError, ValueError: the bank or the cap is not right.
        """
        return replace(self, bank=banks.resolve(layouts, self.world), max_steps=max_steps)

    def header(self) -> dict[str, Any]:
        """All of it, as the header of a policy's file holds it; of the bank its SHA-256.

        Raises:
            ValueError: its class has no name in `TASKS`.
        """
        own = {
            "task": name_of(self),
            "world": self.world.model_dump(),
            "reward": self.reward,
            "max_steps": self.max_steps,
        }
        return own | {"stack": self.stack, "faults": self.faults.model_dump(), "bank": banks.checksum(self.bank)}


TASKS: dict[str, type[Task]] = {"drone": Task}
"""Every world by its name; `uavnav.tasks.simulator` adds the package's further ones, and a plugin its own."""


def name_of(task: Task) -> str:
    """The name of a task's world.

    Raises:
        ValueError: its class has none.
    """
    for name, kind in TASKS.items():
        if kind is type(task):
            return name
    raise ValueError(f"{type(task).__name__}: has no name; give it one in TASKS, as TASKS['mine'] = Mine")
