"""Flights that go round for ever: found, and counted to their cap without being flown.

A greedy policy in a static task always does the same at the same pose: place and heading, in 3D also pitch. So a flight
that comes to an earlier pose, bit for bit, repeats the steps in between until its cap. Letter: F flights.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from uavnav.flights import Step
from uavnav.tasks.state import COUNTS, State, at

LONGEST = 512
"""Steps of a round at most."""


class Repeats:
    """Watches n flights that are flown step by step.

    cap: their steps at most; earliest: the step from which they may be counted instead of flown.
    """

    def __init__(self, n: int, cap: int, earliest: int = 1) -> None:
        self._cap, self._earliest = cap, earliest
        self._pose: Tensor | None = None  # [fields of a pose, n] what later poses are compared with
        self._n = n
        self._since = 0  # the step of that
        self._rounds = torch.zeros(n, dtype=torch.int64)  # steps a round has; 0: none was found
        self._states: list[State] = []  # of the last round, which is flown once more to be written down
        self._rewards: list[Tensor] = []

    def see(self, step: Step) -> State | None:
        """Take note of a step; the state of all that still fly at their cap, once it is known: [F]."""
        up = ~step.ended
        flight, place = step.flight[up], step.place[up]
        if len(self._states) and len(flight) == len(self._states[0].x):
            self._states.append(at(step.states, place))
            self._rewards.append(step.outcomes.reward[place])
            rounds = self._rounds[flight]
            if len(self._rewards) < rounds.max():
                return None
            found = counted(self._states, self._rewards, rounds, self._cap - step.number)
            if found is not None:
                return found
            self._rounds.zero_()
        self._states, self._rewards = [], []
        pose = [getattr(step.states, name)[place].double() for name in pose_of(step.states)]
        self._compare(step.number, flight, torch.stack(pose))
        if len(flight) and step.number >= self._earliest and bool((self._rounds[flight] > 0).all()):
            self._states = [at(step.states, place)]
        return None

    def _compare(self, number: int, flight: Tensor, pose: Tensor) -> None:
        """Find flights [F] whose pose [n, F] is the one that was kept, and now and then keep the present one."""
        if self._pose is None:
            self._pose = torch.full((len(pose), self._n), torch.nan, dtype=torch.float64)
        back = (pose == self._pose[:, flight]).all(0)
        self._rounds[flight[back]] = number - self._since
        if number >= 2 * self._since or number - self._since >= LONGEST:
            self._pose[:, flight] = pose
            self._since = number


def counted(states: Sequence[State], rewards: Sequence[Tensor], rounds: Tensor, steps: int) -> State | None:
    """Where flights are `steps` steps after the last of some states, if each repeats its round until then.

    states: [F] each, one more than a round has; rewards: of the steps between them, [F] each; rounds [F]. Rewards are
    added one by one, as flying adds them. None where a flight has not come back to its pose.
    """
    first = states[0]
    tables = {name: torch.stack([getattr(state, name) for state in states]).numpy() for name in first._fields}
    earned = torch.stack(list(rewards)).numpy()
    last = {name: table[-1].copy() for name, table in tables.items()}
    for flight, length in enumerate(rounds.tolist()):
        if any(tables[name][-1 - length, flight] != last[name][flight] for name in pose_of(first)):
            return None
        times, rest = divmod(steps, length)
        for name in COUNTS[:-1]:
            column = tables[name][-1 - length :, flight]
            last[name][flight] += times * (column[-1] - column[0]) + (column[rest] - column[0])
        added = np.resize(earned[-length:, flight], steps)
        last["reward"][flight] = np.add.accumulate(np.append(last["reward"][flight], added))[-1]
    return type(first)(**{name: torch.from_numpy(table) for name, table in last.items()})


def pose_of(state: State) -> list[str]:
    """The fields of a state that say where a drone is and where it points."""
    return [name for name in state._fields if name not in ("layout", *COUNTS)]
