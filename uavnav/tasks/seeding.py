"""Streams of random numbers: one independent generator for each seed and purpose, and none of them global."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence

import torch
from torch import Tensor


def stream(seed: int, purpose: str) -> torch.Generator:
    """A CPU generator that depends on `seed` and `purpose` alone, so that no stream shifts another."""
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
    """Where in a bank of n_layouts sets the rows of each seed begin: [seeds, rows] int64.

    A row's place follows from its seed and its index among that seed's rows, not from how many there are of either:
    the seed shuffles the sets, and its rows take the first ones in turn, each another while there are enough.
    """
    shuffled = Streams(seeds, "places").draw(torch.randperm, n_layouts, device=device)
    return shuffled[:, torch.arange(rows, device=device) % n_layouts]
