"""What is between a task and a policy: a faulty sensor, a stack of observations, lateness, an actuator that
sticks.

A `WrappedTask` is what shells, evaluations and pictures have: with nothing set it is its task, bit for bit.
All random numbers come in as tensors. Letters: B the batch shape (any, also none), L layouts of a layout
file, M observations that are kept, N numbers of one.
"""

from __future__ import annotations

import functools
from collections import namedtuple
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from uavnav.errors import ConfigError, told
from uavnav.tasks import layouts as splits
from uavnav.tasks.faults import MOST_REMEMBERED, NO_FAULTS, Faults
from uavnav.tasks.rewards import Step
from uavnav.tasks.sensing import Scan
from uavnav.tasks.state import State
from uavnav.tasks.task import Outcome, Task
from uavnav.tasks.world import World


@functools.cache
def remembering(kind: Any) -> type[State]:
    """The class of a state's own fields, and of what a drone remembers: its newest observations and last
    action.

    `seen` are observations [*B, M, N], the newest first, and `executed` is the action [*B] of the last step,
    0 before the first.
    """
    return namedtuple("Remembering", (*kind._fields, "seen", "executed"))  # type: ignore[return-value]


@dataclass(frozen=True, eq=False)
class WrappedTask:
    """A task as a policy meets it. What is not said here is the task's own.

    Raises:
        ConfigError: the stack is no whole number from 1 to 1,000.
    """

    task: Task
    faults: Faults = NO_FAULTS
    stack: int = 1  # newest observations that a policy sees at once, the newest first
    # [px] where a proximity is 1, of a policy trained with another sensor's radius
    trained_reach: float | None = None

    def __post_init__(self) -> None:
        if type(self.stack) is not int or not 1 <= self.stack <= MOST_REMEMBERED:
            raise ConfigError(f"stack={told(self.stack)}; give a whole number from 1 to {MOST_REMEMBERED}")

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # what copies ask for before there is a task
            raise AttributeError(name)
        return getattr(self.task, name)

    def replace(self, **fields: Any) -> WrappedTask:
        """The same with other fields, of the task or of what is around it."""
        own = {name: fields.pop(name) for name in ("faults", "stack", "trained_reach") if name in fields}
        return replace(self, task=replace(self.task, **fields) if fields else self.task, **own)

    def on(self, layouts: str | Path | Tensor, max_steps: int | None) -> WrappedTask:
        """The same on another layout file, with another time limit.

        Raises:
            LayoutError, ValueError: the split or the time limit is not right.
        """
        return self.replace(layouts=splits.resolve(layouts, self.world), max_steps=max_steps)

    @property
    def world(self) -> World:
        """The task's constants and switches."""
        return self.task.world

    @property
    def observation_size(self) -> int:
        """Numbers that a policy sees: those of the world, for each observation of the stack."""
        return self.stack * self.world.observation_size

    @property
    def remembers(self) -> bool:
        """Whether states remember observations and the last action: for a stack, or for faults."""
        return self.stack > 1 or self.faults != NO_FAULTS

    @property
    def state_class(self) -> type[State]:
        """That of its states, with what a drone remembers."""
        return remembering(self.task.STATE) if self.remembers else self.task.STATE  # type: ignore[arg-type]

    # -- random numbers --------------------------------------------------------------------------------------

    @property
    def n_draws(self) -> int:
        """Random numbers that a row needs to start, and for each step; mostly none."""
        return sum(self.faults.sizes(self.world.n_slots))

    def draw(self, rows: int, generator: torch.Generator) -> Tensor:
        """The random numbers of one step, or of one start, of so many rows: [rows, n_draws] float32."""
        normal, *uniform = self.faults.sizes(self.world.n_slots)
        noise = torch.randn(rows, normal, generator=generator)
        return torch.cat([noise, torch.rand(rows, sum(uniform), generator=generator)], -1)

    def _check_draws(self, draws: Tensor | None) -> None:
        if draws is None and self.n_draws:
            raise ValueError(f"faults={self.faults}: give draws, which the task's `draw` makes for its rows")

    # -- what happens ----------------------------------------------------------------------------------------

    def start(self, layout: Tensor, heading: Tensor, draws: Tensor | None = None, *first: Tensor) -> State:
        """The state at the beginning of an episode.

        layout [*B] index, heading [*B] whole degrees, draws [*B, n_draws] where faults need some; first: the
        scans of the starts on all layouts, where they are known, with the layouts as their batch.
        """
        self._check_draws(draws)
        state = self.task.start(layout, heading)
        return self.remember(state, draws, Scan(*(one[..., layout] for one in first)) if first else None)

    def remember(self, state: State, draws: Tensor | None = None, found: Scan | None = None) -> State:
        """The same state as if the episode began there: with a memory, the one observation of now.

        draws [*B, n_draws] disturb what came back, if they are given; found: what came back, where it is
        known.
        """
        bare = self.task.STATE(*(getattr(state, name) for name in self.task.STATE._fields))
        if not self.remembers:
            return bare
        found = self.task.sense(bare)[0] if found is None else found
        newest = self._encode(bare, found, draws)[..., None, :]
        seen = newest.expand(*bare.layout.shape, self.faults.late + self.stack, -1).clone()
        return self.state_class(*bare, seen, torch.zeros_like(bare.layout))  # type: ignore[call-arg]

    def observe(self, state: State) -> tuple[Tensor, Tensor]:
        """What a policy sees, as one vector a row: observation [*B, observation_size], clearance [*B] px.

        A drone that remembers does not sense again: it sees what its state contains.
        """
        found, clearance = self.task.sense(state)
        return self.recall(state) if self.remembers else self._encode(state, found), clearance

    def recall(self, state: State) -> Tensor:
        """The stack of observations that a policy sees, as late as `faults` says: [*B, observation_size]."""
        seen: Tensor = state.seen  # type: ignore[attr-defined]
        return seen[..., self.faults.late : self.faults.late + self.stack, :].flatten(-2).clone()

    def step(self, state: State, action: Tensor, draws: Tensor | None = None) -> tuple[State, Outcome]:
        """One step of every row: action [*B] int64 in 0..n_actions - 1, draws [*B, n_draws] where faults need
        some.

        Raises:
            ValueError: there are faults that need random numbers, and there are none.
        """
        self._check_draws(draws)
        if draws is not None and self.faults.sticky:
            last = state.executed  # type: ignore[attr-defined]
            action = self.faults.executed(action, last, state.steps, draws)
        moved, angle, distance = self.task.move(state, action)
        found, clearance = self.task.sense(moved)
        observation = self._encode(moved, found, draws)
        if self.remembers:
            older = state.seen[..., :-1, :]  # type: ignore[attr-defined]
            seen = torch.cat([observation[..., None, :], older], -2)
            moved = moved._replace(seen=seen, executed=action)  # type: ignore[call-arg]
            observation = self.recall(moved)
        step = Step(state, moved, action, angle, distance, clearance, observation, self.world)
        return self.task.conclude(step)

    def _encode(self, state: State, found: Scan, draws: Tensor | None = None) -> Tensor:
        """The newest observation [*B, N]: what came back, as faults disturb it, in the scale of training."""
        distance, near = found.distance, self.world.drone_radius
        if draws is not None:
            distance = self.faults.disturbed(distance, draws)
        if self.trained_reach is not None:
            distance = near + (distance - near) * (
                (self.world.sensor_radius - near) / (self.trained_reach - near)
            )
        return self.task.encode(state, found._replace(distance=distance))

    def try_out(self) -> None:
        """Fly two rows for a step; raises whatever is wrong with a task's functions or with its reward."""
        rows = torch.zeros(2, dtype=torch.int64)
        draws = self.draw(2, torch.Generator())
        state = self.start(rows, rows, draws)
        self.step(state, torch.tensor([0, self.world.n_actions - 1]), draws)
