"""All that is random in the flights of a batch: start headings, and what faults need, from streams of each seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from uavnav.tasks import seeding
from uavnav.tasks.simulator import Task
from uavnav.tasks.state import UP

FIRST, LATER = "first_faults", "faults"
"""The streams of what is sensed at the beginning of episodes, and of steps."""


class Chance:
    """The streams of each seed, for so many rows a seed. A step draws for every row what an episode would begin with,
    whether one ended or not: what a row gets does not depend on others, if none is reset twice between two steps.
    """

    def __init__(self, task: Task, seeds: Sequence[int], rows: int, device: torch.device | str = "cpu") -> None:
        self._task, self._rows, self._device = task, rows, device
        self._seeds = len(seeds)
        purposes = ["headings", *((FIRST, LATER) if task.n_draws else ())]
        self._streams = {purpose: seeding.Streams(seeds, purpose) for purpose in purposes}
        self._starts: tuple[Tensor, Tensor | None] | None = None  # drawn with the last step

    def headings(self) -> Tensor:
        """Start headings [seeds, rows] whole degrees."""
        if self._task.world.start_heading == "up":
            return torch.full((self._seeds, self._rows), UP, device=self._device)
        return self._streams["headings"].draw(torch.randint, 360, (self._rows,), device=self._device)

    def start(self) -> tuple[Tensor, Tensor | None]:
        """What `Task.start` needs: headings [seeds, rows], draws [seeds, rows, n_draws]; None where it needs none."""
        found, self._starts = self._starts, None
        return found or (self.headings(), self._drawn(FIRST))

    def step(self) -> Tensor | None:
        """What `Task.step` needs [seeds, rows, n_draws]; None where it needs nothing."""
        if self._task.n_draws or self._task.world.start_heading != "up":
            self._starts = self.headings(), self._drawn(FIRST)
        return self._drawn(LATER)

    def _drawn(self, purpose: str) -> Tensor | None:
        if purpose not in self._streams:
            return None
        return self._streams[purpose].draw(self._task.draw, self._rows, device=self._device)

    def state_dict(self) -> dict[str, Any]:
        """Where each stream is, and what is drawn and not yet taken."""
        headings, first = self._starts or (None, None)
        starts = {name: one for name, one in (("start headings", headings), ("start draws", first)) if one is not None}
        return {purpose: streams.state_dict() for purpose, streams in self._streams.items()} | starts

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on from where `state_dict` was taken, of a task alike."""
        for purpose, streams in self._streams.items():
            streams.load_state_dict(state_dict[purpose])
        headings = state_dict.get("start headings")
        draws = state_dict.get("start draws")
        if headings is None:
            self._starts = None
        else:
            self._starts = headings.to(self._device), None if draws is None else draws.to(self._device)
