"""Flights that go round for ever: found, and counted to their cap without being flown.

A greedy policy in a static task always does the same at the same pose: place and heading, in 3D also pitch. So a flight
that comes to an earlier pose, bit for bit, repeats the steps in between until its cap. Letters: F flights that are up,
C of them that are counted.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from uavnav.evaluation.flights import Transition
from uavnav.tasks.state import COUNTS, State, at

LONGEST = 512
"""Steps of a round at most."""


class Repeats:
    """Watches flights that are flown step by step.

    repeatable: [n] of which of all flights the same pose is always followed by the same steps; cap: their steps at
    most; earliest: the step from which they may be counted instead of flown.
    """

    def __init__(self, repeatable: Tensor, cap: int, earliest: int = 1) -> None:
        self._repeatable, n = repeatable, len(repeatable)
        self._cap, self._earliest = cap, earliest
        self._pose: Tensor | None = None  # [fields of a pose, n] what later poses are compared with
        self._since = 0  # the step of that
        self._rounds = torch.zeros(n, dtype=torch.int64)  # steps a round has; 0: none was found
        self._circling = torch.zeros(n, dtype=torch.bool)  # those that fly a round once more, to be written down
        self._states: list[State] = []  # of these
        self._rewards: list[Tensor] = []

    def see(self, step: Transition) -> tuple[Tensor, State] | None:
        """Take note of a step; which flights need not be flown on [C], and their state at the cap, if some are known.

        These flights are marked as ended.
        """
        up = ~step.ended & self._repeatable[step.flight]
        if not up.any():
            return None
        flight, place = step.flight[up], step.place[up]
        self._compare(step, flight, place)
        if not self._states:
            if step.number >= self._earliest and bool((found := self._rounds[flight] > 0).any()):
                self._circling[flight[found]] = True
                self._states = [at(step.states, place[found])]
            return None
        own = self._circling[flight]
        circling, places = flight[own], place[own]
        self._states.append(at(step.states, places))
        self._rewards.append(step.outcomes.reward[places])
        rounds = self._rounds[circling]
        all_fly = len(circling) == len(self._states[0].layout)
        if all_fly and len(self._rewards) < rounds.max():
            return None
        at_cap = counted(self._states, self._rewards, rounds, self._cap - step.number) if all_fly else None
        if at_cap is not None:
            step.ended[up.nonzero().flatten()[own]] = True
        self._rounds[self._circling] = 0
        self._circling.zero_()
        self._states, self._rewards = [], []
        return None if at_cap is None else (circling, at_cap)

    def _compare(self, step: Transition, flight: Tensor, place: Tensor) -> None:
        """Find flights [F] whose pose [n, F] is the one that was kept, and now and then keep the present one."""
        pose = torch.stack([getattr(step.states, name)[place].double() for name in pose_of(step.states)])
        if self._pose is None:
            self._pose = torch.full((len(pose), len(self._rounds)), torch.nan, dtype=torch.float64)
        back = flight[(pose == self._pose[:, flight]).all(0)]
        self._rounds[back[self._rounds[back] == 0]] = step.number - self._since
        if step.number >= 2 * self._since or step.number - self._since >= LONGEST:
            self._pose[:, flight] = pose
            self._since = step.number


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
