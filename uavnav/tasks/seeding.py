"""Streams of random numbers: one independent generator for each seed and purpose, and none of them global.

`Chance` contains all that is random in the episodes of a batch: start headings, and what faults need.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from uavnav.tasks.state import UP

if TYPE_CHECKING:
    from uavnav.tasks.wrapper import WrappedTask


def stream(seed: int, purpose: str) -> torch.Generator:
    """A CPU generator that depends only on `seed` and `purpose`, so that no stream shifts another."""
    digest = hashlib.sha256(f"uavnav/{purpose}/{seed}".encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:4], "little"))


class Streams:
    """A stream for each seed, drawn from side by side: what one seed gets does not depend on the others."""

    def __init__(self, seeds: Sequence[int], purpose: str) -> None:
        self._generators = [stream(seed, purpose) for seed in seeds]

    def draw(self, function: Callable[..., Tensor], *args: object, device: torch.device | str) -> Tensor:
        """One draw from every stream: `draw(torch.rand, 16, device="cpu")` -> [seeds, 16].

        Numbers are always drawn on the CPU, so that a run on another device sees the same ones.
        """
        drawn = [function(*args, generator=generator) for generator in self._generators]
        return torch.stack(drawn).to(device)

    def state_dict(self) -> dict[str, Tensor]:
        """Where each stream is: [seeds, bytes] uint8."""
        return {"generators": torch.stack([generator.get_state() for generator in self._generators])}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on from where `state_dict` was taken."""
        for generator, saved in zip(self._generators, state["generators"], strict=True):
            generator.set_state(saved.clone())  # it reads the storage from its beginning


def places(seeds: Sequence[int], rows: int, n_layouts: int, device: torch.device | str) -> Tensor:
    """Where in a layout file the rows of each seed begin: [seeds, rows] int64.

    A row's place follows from its seed and its index among that seed's rows, not from how many there are of
    either: the seed shuffles the layouts, and its rows take the first ones in turn, each another while
    there are enough.
    """
    shuffled = Streams(seeds, "places").draw(torch.randperm, n_layouts, device=device)
    return shuffled[:, torch.arange(rows, device=device) % n_layouts]


FIRST, LATER = "first_faults", "faults"
"""The streams of what is sensed at the beginning of episodes, and of steps."""
STARTS = "start headings", "start draws"
"""What is drawn of starts and not yet taken, as a snapshot names it."""


class Chance:
    """The streams of each seed, for a batch of shape B that the seeds share in equal parts. A step draws for
    every row what an episode would begin with, whether one ended or not: what a row gets does not depend on
    others, if none is reset twice between two steps.
    """

    def __init__(
        self, task: WrappedTask, seeds: Sequence[int], shape: Sequence[int], device: str | torch.device
    ) -> None:
        self._task, self._shape, self._device = task, shape, device
        self._rows = math.prod(shape) // len(seeds)
        purposes = ["headings", *((FIRST, LATER) if task.n_draws else ())]
        self._streams = {purpose: Streams(seeds, purpose) for purpose in purposes}
        self._starts: tuple[Tensor, Tensor | None] | None = None  # drawn with the last step

    def headings(self) -> Tensor:
        """Start headings [*B] whole degrees."""
        if self._task.world.start_heading == "up":
            return torch.full(self._shape, UP, device=self._device)
        drawn = self._streams["headings"].draw(torch.randint, 360, (self._rows,), device=self._device)
        return drawn.reshape(self._shape)

    def start(self) -> tuple[Tensor, Tensor | None]:
        """What a start needs: headings [*B], draws [*B, n_draws] or None."""
        found, self._starts = self._starts, None
        return found or (self.headings(), self._drawn(FIRST))

    def step(self) -> Tensor | None:
        """What a step needs [*B, n_draws]; None where it needs nothing."""
        if self._task.n_draws or self._task.world.start_heading != "up":
            self._starts = self.headings(), self._drawn(FIRST)
        return self._drawn(LATER)

    def steps(self, n: int) -> list[Tensor]:
        """What n steps need, one after the other: start headings [n, *B], and where faults need some, draws
        of starts and of steps [n, *B, n_draws].
        """
        if not self._task.n_draws and self._task.world.start_heading == "up":
            return [self.headings().expand(n, *self._shape)]
        later, starts = zip(*[(self.step(), self.start()) for _ in range(n)], strict=True)
        drawn = [*zip(*starts, strict=True), later]
        return [torch.stack(one) for one in drawn if one[0] is not None]

    def _drawn(self, purpose: str) -> Tensor | None:
        if purpose not in self._streams:
            return None
        drawn = self._streams[purpose].draw(self._task.draw, self._rows, device=self._device)
        return drawn.reshape(*self._shape, -1)

    def state_dict(self) -> dict[str, Any]:
        """Where each stream is, and what is drawn and not yet taken."""
        starts = zip(STARTS, self._starts or (), strict=False)
        found: dict[str, Any] = {purpose: streams.state_dict() for purpose, streams in self._streams.items()}
        return found | {name: one for name, one in starts if one is not None}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on from where `state_dict` was taken, of a task alike."""
        for purpose, streams in self._streams.items():
            streams.load_state_dict(state_dict[purpose])
        starts = {name: state_dict[name].to(self._device) for name in STARTS if name in state_dict}
        self._starts = (starts[STARTS[0]], starts.get(STARTS[1])) if starts else None
