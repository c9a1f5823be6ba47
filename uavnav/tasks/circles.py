"""Circles that stand still, the paper's obstacles: how they are drawn, and what makes a layout file of them
valid.

In a world of three dimensions they are spheres. Letter: D the dimensions of the world.
"""

from __future__ import annotations

import functools
import numbers
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from uavnav.errors import MOST_WHOLE, OneLineError, told
from uavnav.tasks.protocol import DEFAULT_K
from uavnav.tasks.world import World

W = TypeVar("W", bound=World)


class LayoutError(OneLineError, ValueError):
    """A layout file cannot be found, read or trusted; the message says what is wrong and what is right."""


MOST_OBSTACLES = 20_000_000
"""Of all layouts of a layout file: half a gigabyte where they are drawn."""
DRAWS = 1_000
"""Places that an obstacle may try; the paper's task refuses one in eleven."""


def of_kind(kind: type[W], world: World | None) -> W:
    """A world that is of this kind, by default with its own constants; raises a LayoutError for another."""
    if not isinstance(world, kind | None):
        raise LayoutError(f"world={told(world)}: is a {type(world).__name__}; give a {kind.__name__}")
    return kind() if world is None else world


def generate(n: int, k: int = DEFAULT_K, seed: int = 0, world: World | None = None) -> Tensor:
    """Draw n layouts of k obstacles: radius uniform in [30, 100], centre uniform in the window, drawn again
    until the edge is at least 50 px from the start (sec. 4.1). Obstacles may overlap each other and the
    border.

    Returns:
        Tensor [n, k, D + 1] float32 of (x, y, radius) px, in 3D of (x, y, z, radius); the same for the same
        arguments on every machine.

    Raises:
        LayoutError: n, k or seed is negative, `world` is none, or an obstacle finds no place.
    """
    world = of_kind(World, world)
    if not all(isinstance(one, numbers.Integral) and 0 <= one <= MOST_WHOLE for one in (n, k, seed)):
        given = f"n={told(n)}, k={told(k)}, seed={told(seed)}"
        raise LayoutError(f"{given}; give whole numbers of at least 0 and at most {MOST_WHOLE:,}")
    if n * max(k, 1) > MOST_OBSTACLES:
        raise LayoutError(f"n={n}, k={k}; give at most {MOST_OBSTACLES:,} obstacles or layouts in all")
    rng = np.random.Generator(np.random.PCG64(seed))
    smallest, largest = np.float32(world.obstacle_radius_min), np.float32(world.obstacle_radius_max)
    size = np.array(world.size, dtype=np.float32)
    layouts = np.empty((n, k, len(size) + 1), dtype=np.float32)
    layouts[..., -1] = smallest + (largest - smallest) * rng.random((n, k), dtype=np.float32)
    misplaced = np.ones((n, k), dtype=bool)
    for _ in range(DRAWS):
        layouts[misplaced, :-1] = rng.random((int(misplaced.sum()), len(size)), dtype=np.float32) * size
        misplaced = edge_to_start(layouts, world) < world.safe_zone
        if not misplaced.any():
            return torch.from_numpy(layouts)
    raise LayoutError(
        f"safe_zone={world.safe_zone:g}: an obstacle with a radius of {layouts[misplaced, -1].max():g} px "
        f"found no place in {DRAWS:,} draws; give a smaller safe_zone or obstacle_radius_max"
    )


def validate(layouts: Tensor, world: World | None = None, more: int = 0) -> None:
    """Check shape, type, finiteness, the range of radii and the safe zone; a row begins with its centre and
    radius, and has so many numbers more.

    Raises:
        LayoutError: naming the first layout that is wrong.
    """
    world = of_kind(World, world)
    if not isinstance(layouts, Tensor):
        raise LayoutError(f"{told(layouts)}: is no tensor of layouts; give a tensor")
    columns = len(world.size) + 1 + more
    if layouts.ndim != 3 or layouts.shape[-1] != columns or layouts.shape[0] == 0:
        raise LayoutError(f"layouts have the shape [n > 0, k, {columns}], not {list(layouts.shape)}")
    if layouts.dtype != torch.float32:
        raise LayoutError(f"layouts are float32, not {str(layouts.dtype).removeprefix('torch.')}")
    numbers = layouts.cpu().numpy()
    radius = numbers[..., len(world.size)]
    edge = edge_to_start(np.nan_to_num(numbers), world)
    smallest, largest = world.obstacle_radius_min, world.obstacle_radius_max
    refuse_first(~np.isfinite(numbers).all(-1), "is not finite")
    refuse_first(
        ~((radius >= smallest) & (radius <= largest)), f"has a radius outside {smallest:g} ... {largest:g} px"
    )
    refuse_first(edge < world.safe_zone, f"is nearer than {world.safe_zone:g} px to the start")


def refuse_first(wrong: np.ndarray, problem: str) -> None:
    """Raise a LayoutError that names the first obstacle of which a problem holds; wrong [n, k] bool."""
    if wrong.any():
        row, obstacle = np.argwhere(wrong)[0]
        raise LayoutError(f"obstacle {obstacle} of layout {row} {problem}")


def edge_to_start(layouts: np.ndarray, world: World) -> np.ndarray:
    """Distance from the start to every obstacle's edge [n, k] px, in float64."""
    axes = len(world.size)
    offset = layouts[..., :axes].astype(np.float64) - np.array(world.start)
    edge: np.ndarray = functools.reduce(np.hypot, np.moveaxis(offset, -1, 0)) - layouts[..., axes]
    return edge
