"""One loop for all episodes that are not training: evaluations, replays and films see the same ones.

Each policy has one episode on each layout of the task. Who else is there, and the number of cores, can only
change its rounding: the number of episodes and the time limit decide when the step is compiled. What faults
draw follows from the policy's seed, the layout and the step. Letters: F episodes that go on, P places of a
batch, which also contains some that have ended.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from uavnav import graph
from uavnav.evaluation.agents import Policies, Seeded
from uavnav.tasks.seeding import Streams, stream
from uavnav.tasks.state import UP, State, at
from uavnav.tasks.task import Outcome
from uavnav.tasks.wrapper import WrappedTask
from uavnav.training import machine

CHUNK = 256  # episodes that one call of a compiled step moves at most


class Transition(NamedTuple):
    """One step of the episodes that went on before it."""

    number: int  # counted from 1
    episode: Tensor  # [F] which they are: first all layouts of the first policy
    place: Tensor  # [F] where they are in `before`, `states` and `outcomes`
    action: Tensor  # [F] as it was executed
    values: Tensor | None  # [F, n_actions] the numbers behind the actions; None where a scripted policy acts
    before: State  # [P]
    states: State  # [P] after the step
    outcomes: Outcome  # [P]
    ended: Tensor  # [F] bool: which episodes are over now

    @property
    def state(self) -> State:
        """After the step, [F]."""
        return at(self.states, self.place)

    @property
    def outcome(self) -> Outcome:
        """Of the step, [F]."""
        return Outcome(*(field[self.place] for field in self.outcomes))


def headings(task: WrappedTask, n: int) -> Tensor:
    """Start headings on the first n layouts [n] whole degrees; random ones belong to the layout."""
    if task.world.start_heading == "up":
        return torch.full((n,), UP)
    return torch.randint(360, (n,), generator=stream(0, "headings in evaluation"))


def start(task: WrappedTask, seeds: Sequence[int] = (0,), heading: Tensor | None = None) -> State:
    """Where the episodes of policies with these seeds begin, each on every layout: [policies x layouts]."""
    n = len(task.layouts)
    heading = headings(task, n) if heading is None else heading
    layout = torch.arange(n).repeat(len(seeds))
    return task.start(
        layout, heading.repeat(len(seeds)), next(_draws(task, seeds, "first faults in evaluation"))
    )


def _draws(task: WrappedTask, seeds: Sequence[int], purpose: str) -> Iterator[Tensor | None]:
    """Step by step, what the episodes of policies need for faults: [policies x layouts, n_draws], or None."""
    streams = Streams(seeds, purpose)
    while True:
        yield streams.draw(task.draw, len(task.layouts), device="cpu").flatten(0, 1) if task.n_draws else None


def steps(
    policies: Sequence[Seeded], task: WrappedTask, heading: Tensor | None = None
) -> Iterator[Transition]:
    """Step until every episode has ended by a collision or at the time limit, or the caller has seen enough.

    Set `ended` of an episode, and it goes no further. policies: with the seeds of their generators; heading:
    [layouts] of the start, where it is not the task's. Raises a ValueError for what is no action.
    """
    seeds = [seed for seed, _ in policies]
    state, draws = start(task, seeds, heading), _draws(task, seeds, "faults in evaluation")
    acting = Policies(policies, task.world.n_actions)
    episode = place = torch.arange(len(state.x))
    sizes = [len(task.layouts)] * len(policies)
    compiled = False
    compiles_at = (
        1 if task.max_steps and len(episode) * task.max_steps >= machine.MANY else machine.EAGER_STEPS
    )
    observation, _ = task.observe(state)
    for number, drawn in enumerate(draws, 1):
        with torch.no_grad():
            seen = observation if len(place) == len(observation) else observation[place]
            action, values = acting.act(seen, sizes)
            if not compiled and number == compiles_at and machine.episodes(task.max_steps):
                state, compiled = _padded(state), True
            before, own = state, None if drawn is None else drawn[episode]
            state, outcome = (
                _advance(task, state, place, action, own) if compiled else task.step(state, action, own)
            )
            if task.remembers:
                action = state.executed[place]  # type: ignore[attr-defined]
        ended = (outcome.terminated | outcome.truncated)[place]
        yield Transition(number, episode, place, action, values, before, state, outcome, ended)
        observation, up = outcome.observation, ~ended
        if not up.all():
            sizes = [int(part.sum()) for part in torch.split(up, sizes)]
            episode, place = episode[up], place[up]
            if not len(episode):
                return
            if not compiled or max(CHUNK, _size(len(place))) < len(state.layout):
                state, observation = at(state, place), observation[place]
                place = torch.arange(len(place))
                state = _padded(state, CHUNK) if compiled else state


def _advance(
    task: WrappedTask, state: State, place: Tensor, action: Tensor, draws: Tensor | None
) -> tuple[State, Outcome]:
    """A step as a compiled graph: of all P places, those that have ended included."""
    everywhere = torch.zeros_like(state.layout)
    everywhere[place] = action
    drawn = [] if draws is None else [torch.zeros(len(everywhere), task.n_draws).index_copy(0, place, draws)]
    fields, step = (everywhere, *state, *drawn), _graph(task)
    chunks = zip(*(torch.split(field, CHUNK) for field in fields), strict=True)
    parts = [step(action, task.layouts, *rest) for action, *rest in chunks]
    found = parts[0] if len(parts) == 1 else [torch.cat(fields) for fields in zip(*parts, strict=True)]
    return task.state_class(*found[: len(state)]), Outcome(*found[len(state) :])


@functools.lru_cache(maxsize=4)
def _graph(task: WrappedTask) -> graph.Graph:
    kind = task.state_class
    n = len(kind._fields)

    def step(action: Tensor, layouts: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
        state, outcome = task.replace(layouts=layouts).step(kind(*tensors[:n]), action, *tensors[n:])
        return *state, *outcome

    return graph.Graph(step)


def _padded(state: State, least: int = 1) -> State:
    """Repeat the last of some episodes until there are as many as graphs are compiled for."""
    n = len(state.layout)
    return at(state, torch.arange(max(least, _size(n))).clamp(max=n - 1))


def _size(n: int) -> int:
    """Places of n episodes in compiled steps: 64, 128, or a multiple of 256; few sizes mean few graphs."""
    return max(64, 1 << (n - 1).bit_length()) if n <= CHUNK else -(-n // CHUNK) * CHUNK
