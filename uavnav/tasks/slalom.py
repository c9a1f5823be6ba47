"""Four columns of circles across the window, each with one gap: a layout file for the paper's task, without
new physics.

A layout has 48 places, twelve a column from the bottom up. A place without a circle is `NOWHERE`, far out
of reach.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from uavnav.tasks.circles import LayoutError
from uavnav.tasks.state import State

COLUMNS = (150.0, 290.0, 510.0, 650.0)  # x of the centres [px]
RADIUS = 30.0  # [px]
SPACING = 60.0  # from centre to centre [px]: closed to a drone of that width
HEIGHT = 600.0  # of the topmost centre [px]
PLACES = 12  # a column
NOWHERE = (-1000.0, -1000.0, RADIUS)
WIDEST = 480
"""[px] A wider gap has no room above and below."""


def generate(n: int, gap: int, seed: int = 0) -> Tensor:
    """Draw n layouts: the middle of each column's gap is uniform in [60 + gap / 2, 540 - gap / 2] px. Circles
    that reach into the gap are taken away, and the two next to it are moved to its ends.

    gap: from edge to edge [px].

    Returns:
        Tensor [n, 48, 3] float32 of (x, y, radius) px; the same for the same arguments on every machine.

    Raises:
        LayoutError: the gap is not 1 to 480 px, or n or seed is negative.
    """
    if not 1 <= gap <= WIDEST:
        raise LayoutError(f"gap={gap}; give 1 to {WIDEST} px")
    if min(n, seed) < 0:
        raise LayoutError(f"n={n}, seed={seed}; give whole numbers of at least 0")
    rng = np.random.Generator(np.random.PCG64(seed))
    margin = SPACING + gap / 2
    middle = margin + (HEIGHT - 2 * margin) * rng.random((n, len(COLUMNS), 1))
    bottom, top = middle - gap / 2, middle + gap / 2
    y = np.arange(0, HEIGHT + 1, SPACING) + 0 * middle  # [n, columns, 11]
    below, above = y + RADIUS <= bottom, y - RADIUS >= top
    y = np.where(y == np.where(below, y, -np.inf).max(-1, keepdims=True), bottom - RADIUS, y)
    y = np.where(above & (np.cumsum(above, -1) == 1), top + RADIUS, y)
    layouts = np.empty((n, len(COLUMNS), PLACES, 3), dtype=np.float32)
    layouts[:] = NOWHERE
    kept = below | above
    place = np.cumsum(kept, -1) - 1
    row, column, _ = np.nonzero(kept)
    layouts[row, column, place[kept]] = np.stack(
        [np.array(COLUMNS)[column], y[kept], np.full(len(row), RADIUS)], -1
    )
    return torch.from_numpy(layouts.reshape(n, -1, 3))


def passages(before: State, after: State) -> dict[str, Tensor]:
    """Whether each row's step took the drone's centre across a column's x: `passages` [*B]."""
    columns = torch.tensor(COLUMNS, device=after.x.device)
    return {"passages": ((before.x[..., None] > columns) != (after.x[..., None] > columns)).sum(-1)}
