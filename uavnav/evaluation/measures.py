"""Measures of an episode besides the paper's six metrics: danger, separation, smoothness.

They are optional columns of the rows of an evaluation; `metrics.OWN` makes numbers for people of them.
Letters: N episodes, F of them that go on.
"""

from __future__ import annotations

import torch
from torch import Tensor

from uavnav.evaluation.episodes import Transition
from uavnav.tasks.space import SpaceWorld, pitch_of, z_of
from uavnav.tasks.state import State, at
from uavnav.tasks.wrapper import WrappedTask

DANGER = 30.0
"""[px] from the drone's edge to the nearest body, below which a step is in danger: the drone's radius."""


class Measures:
    """Counts step by step; `columns` [N] by name:

    - danger: steps that end with less than `DANGER` px of separation, which is clearance less the drone's
      radius;
    - separation: the smallest at the end of a step [px], not above 0 after a collision;
    - turned: degrees of turn, in a box of yaw and pitch, added up;
    - jerk: the length of the third difference of places [px/step^3], added up, from rest.
    """

    def __init__(self, n: int, task: WrappedTask) -> None:
        self.task = task
        self.columns = {
            "danger": torch.zeros(n, dtype=torch.int64),
            "separation": torch.full((n,), torch.inf),
            "turned": torch.zeros(n, dtype=torch.int64),
            "jerk": torch.zeros(n, dtype=torch.float64),
        }
        self._before = torch.zeros(2, n, len(task.world.size))  # velocity and acceleration of the last step

    def see(self, step: Transition) -> None:
        """Count a step of the episodes that go on [F]."""
        before, after, episode = at(step.before, step.place), step.state, step.episode
        separation = step.outcome.clearance - self.task.world.drone_radius
        self.columns["danger"][episode] += separation < DANGER
        self.columns["separation"][episode] = self.columns["separation"][episode].minimum(separation)
        self.columns["turned"][episode] += self._turned(before, after)
        velocity = self._place(after) - self._place(before)
        speed, force = self._before[:, episode]
        acceleration = velocity - speed
        self.columns["jerk"][episode] += (acceleration - force).norm(dim=-1).double()
        self._before[:, episode] = torch.stack([velocity, acceleration])

    def _place(self, state: State) -> Tensor:
        """[F, axes] px."""
        z = [z_of(state)] if isinstance(self.task.world, SpaceWorld) else []
        return torch.stack([state.x, state.y, *z], -1)

    def _turned(self, before: State, after: State) -> Tensor:
        """[F] whole degrees."""
        turn = ((after.heading - before.heading + 180) % 360 - 180).abs()
        if isinstance(self.task.world, SpaceWorld):
            turn = turn + (pitch_of(after) - pitch_of(before)).abs()
        return turn
