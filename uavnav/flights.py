"""One loop that flies: evaluation, behaviour, replays and films see the same flights, the window the same rules.

A flyer is a seed with its policy and a generator of its own; it flies each set of the task's bank once. It does not see
what others do. The number of flights and the cap decide when the step is compiled, which rounds otherwise. Letters: F
flights that are up, P places of a batch, which holds some that have ended too.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from uavnav import graph
from uavnav.policies import Policy
from uavnav.squads import Flyers, Squads
from uavnav.tasks.seeding import stream
from uavnav.tasks.simulator import Outcome, Task
from uavnav.tasks.state import UP, State
from uavnav.training import machine


class Step(NamedTuple):
    """One step of the flights that were up before it."""

    number: int  # counted from 1
    flight: Tensor  # [F] which they are: first all sets of the first flyer
    place: Tensor  # [F] where they lie in `states` and `outcomes`
    action: Tensor  # [F]
    values: Tensor | None  # [F, n_actions] the numbers behind the actions, where they were asked for
    states: State  # [P] after the step
    outcomes: Outcome  # [P]
    ended: Tensor  # [F] bool: which flights are over now

    @property
    def state(self) -> State:
        """After the step, [F]."""
        return State(*(field[self.place] for field in self.states))

    @property
    def outcome(self) -> Outcome:
        """Of the step, [F]."""
        return Outcome(*(field[self.place] for field in self.outcomes))


def headings(task: Task, n: int) -> Tensor:
    """Start headings on the first n sets [n] whole degrees: random ones belong to the set, whoever flies."""
    if task.world.start_heading == "up":
        return torch.full((n,), UP)
    return torch.randint(360, (n,), generator=stream(0, "headings in evaluation"))


def start(task: Task, flyers: int = 1, heading: Tensor | None = None) -> State:
    """Where the flights of so many flyers begin, each on every set: [flyers x sets]."""
    n = len(task.bank)
    heading = headings(task, n) if heading is None else heading
    return task.start(torch.arange(n).repeat(flyers), heading.repeat(flyers))


def fly(flyers: Flyers, task: Task, heading: Tensor | None = None, values: bool = False) -> Iterator[Step]:
    """Fly until every flight has ended by a collision or at the task's cap; stop whenever you have seen enough.

    heading: [sets] of the start, where it is not the task's; values: keep the numbers behind the actions of `Policy`s.

    Raises:
        ValueError: a policy chose something that is no action.
    """
    state = start(task, len(flyers), heading)
    squads = Squads(flyers, task.world.n_actions)
    flight = place = torch.arange(len(state.x))
    sizes = [len(task.bank)] * len(flyers)
    compiled = False
    compiles_at = 1 if task.max_steps and len(flight) * task.max_steps >= machine.MANY else machine.EAGER_STEPS
    observation, _ = task.observe(state)
    for number in itertools.count(1):
        with torch.no_grad():
            seen = observation if len(place) == len(observation) else observation[place]
            action, behind = squads.act(seen, sizes, values)
            if not compiled and number == compiles_at and machine.flights(task.max_steps):
                state, place, compiled = _padded(state, len(place)), torch.arange(len(place)), True
            state, outcome = _advance(task, state, place, action) if compiled else task.step(state, action)
        ended = (outcome.terminated | outcome.truncated)[place]
        yield Step(number, flight, place, action, behind, state, outcome, ended)
        observation, up = outcome.observation, ~ended
        if not up.all():
            sizes = [int(part.sum()) for part in torch.split(up, sizes)]
            flight, place = flight[up], place[up]
            if not len(flight):
                return
            if not compiled:
                state, observation = State(*(field[place] for field in state)), observation[place]
                place = torch.arange(len(place))


def alike(policies: Sequence[Policy]) -> list[list[int]]:
    """Which policies were trained in the same world with the same reward, so that they can fly as one batch."""
    keys = [(type(policy.task), policy.task.world, policy.task.reward) for policy in policies]
    return [[place for place, own in enumerate(keys) if own == key] for key in dict.fromkeys(keys)]


def _advance(task: Task, state: State, place: Tensor, action: Tensor) -> tuple[State, Outcome]:
    """A step as a compiled graph: of all P places, those that have ended included."""
    everywhere = torch.zeros_like(state.layout)
    everywhere[place] = action
    found = _graph(task)(everywhere, task.bank, *state)
    return State(*found[: len(state)]), Outcome(*found[len(state) :])


@functools.lru_cache(maxsize=4)
def _graph(task: Task) -> graph.Graph:
    def step(action: Tensor, bank: Tensor, *fields: Tensor) -> tuple[Tensor, ...]:
        state, outcome = task.with_bank(bank).step(State(*fields), action)
        return *state, *outcome

    return graph.Graph(step)


def _padded(state: State, n: int) -> State:
    """Repeat the last flight until there are 64, 128, 256, ... of them: few sizes mean few graphs."""
    size = max(64, 1 << (n - 1).bit_length())
    index = torch.arange(size).clamp(max=n - 1)
    return State(*(field[index] for field in state))
