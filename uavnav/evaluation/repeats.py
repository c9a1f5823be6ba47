"""Episodes that go round for ever: found, and counted to their time limit without their further steps.

A greedy policy in a static task always does the same at the same pose: place and heading, in 3D also pitch.
So an episode that comes to an earlier pose, bit for bit, repeats the steps in between until its time limit.
Letters: F episodes that go on, C of them that are counted.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from uavnav.evaluation.episodes import Transition
from uavnav.tasks.state import COUNTS, State, at

LONGEST = 512  # steps of a round at most


class Repeats:
    """Watches episodes step by step.

    repeatable: [n] where the same pose has the same future; earliest: the first step that may be counted.
    """

    def __init__(self, repeatable: Tensor, max_steps: int, earliest: int) -> None:
        self._repeatable, n = repeatable, len(repeatable)
        self._max_steps, self._earliest = max_steps, earliest
        self._pose: Tensor | None = None  # [fields of a pose, n] what later poses are compared with
        self._since = 0  # the step of that
        self._rounds = torch.zeros(n, dtype=torch.int64)  # steps a round has; 0: none was found
        self._circling = torch.zeros(n, dtype=torch.bool)  # those that go round once more, to be written down
        self._states: list[State] = []  # of these
        self._rewards: list[Tensor] = []

    def see(self, step: Transition) -> tuple[Tensor, State] | None:
        """Take note of a step; which episodes end by it [C], and their state at the limit, if known."""
        on = ~step.ended & self._repeatable[step.episode]
        if not on.any():
            return None
        episode, place = step.episode[on], step.place[on]
        self._compare(step, episode, place)
        if not self._states:
            found = self._rounds[episode] > 0
            if step.number >= self._earliest and found.any():
                self._circling[episode[found]] = True
                self._states = [at(step.states, place[found])]
            return None
        own = self._circling[episode]
        circling, places = episode[own], place[own]
        self._states.append(at(step.states, places))
        self._rewards.append(step.outcomes.reward[places])
        rounds = self._rounds[circling]
        all_go_on = len(circling) == len(self._states[0].layout)
        if all_go_on and len(self._rewards) < rounds.max():
            return None
        last = (
            counted(self._states, self._rewards, rounds, self._max_steps - step.number) if all_go_on else None
        )
        self._rounds[self._circling] = 0
        self._circling.zero_()
        self._states, self._rewards = [], []
        if last is None:
            return None
        step.ended[on.nonzero().flatten()[own]] = True
        return circling, last

    def _compare(self, step: Transition, episode: Tensor, place: Tensor) -> None:
        """Find episodes [F] whose pose [n, F] is the one that was kept; now and then keep the present one."""
        pose = torch.stack([getattr(step.states, name)[place].double() for name in pose_of(step.states)])
        if self._pose is None:
            self._pose = torch.full((len(pose), len(self._rounds)), torch.nan, dtype=torch.float64)
        back = episode[(pose == self._pose[:, episode]).all(0)]
        self._rounds[back[self._rounds[back] == 0]] = step.number - self._since
        if step.number >= 2 * self._since or step.number - self._since >= LONGEST:
            self._pose[:, episode] = pose
            self._since = step.number


def counted(states: Sequence[State], rewards: Sequence[Tensor], rounds: Tensor, steps: int) -> State | None:
    """Where episodes are `steps` steps after the last of some states, if each repeats its round until then.

    states: [F] each, one more than a round has; rewards: of the steps between them, [F] each; rounds [F].
    Rewards are added one by one, as steps add them. None where an episode has not come back to its pose.
    """
    first = states[0]
    tables = {name: torch.stack([getattr(state, name) for state in states]).numpy() for name in first._fields}
    earned = torch.stack(list(rewards)).numpy()
    last = {name: table[-1].copy() for name, table in tables.items()}
    for episode, length in enumerate(rounds.tolist()):
        if any(tables[name][-1 - length, episode] != last[name][episode] for name in pose_of(first)):
            return None
        times, rest = divmod(steps, length)
        for name in COUNTS[:-1]:
            column = tables[name][-1 - length :, episode]
            last[name][episode] += times * (column[-1] - column[0]) + (column[rest] - column[0])
        added = np.resize(earned[-length:, episode], steps)
        last["reward"][episode] = np.add.accumulate(np.append(last["reward"][episode], added))[-1]
    return type(first)(**{name: torch.from_numpy(table) for name, table in last.items()})


def pose_of(state: State) -> list[str]:
    """The fields of a state that say where a drone is and where it points."""
    return [name for name in state._fields if name not in ("layout", *COUNTS)]
