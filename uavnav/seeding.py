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


def draw(
    generators: Sequence[torch.Generator], function: Callable[..., Tensor], *args: object, device: torch.device | str
) -> Tensor:
    """One draw from every generator, stacked along a leading axis of agents.

    `draw(generators, torch.rand, 16, device="cpu")` -> [agents, 16]. Numbers are always drawn on the CPU, so that a
    run on another device sees the same ones.
    """
    return torch.stack([function(*args, generator=generator) for generator in generators]).to(device)


def places(seeds: Sequence[int], rows: int, n_layouts: int, device: torch.device | str) -> Tensor:
    """Where in a bank of n_layouts sets the rows of each seed begin: [seeds, rows] int64.

    A row's place follows from its seed and its index among that seed's rows, not from how many there are of either.
    """
    return draw([stream(seed, "places") for seed in seeds], torch.randint, n_layouts, (rows,), device=device)


def headings(generators: Sequence[torch.Generator], rows: int, device: torch.device | str) -> Tensor:
    """Random start headings of each seed's rows: [seeds, rows] whole degrees."""
    return draw(generators, torch.randint, 360, (rows,), device=device)
