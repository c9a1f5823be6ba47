"""What the drone perceives: equations (9), (10) and (13). Pure functions of tensors of any batch shape.

Letters: K obstacles of a layout, Q = 28 border squares that can matter, N = K + Q candidates, S slots, F
numbers of a slot besides its distance.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from uavnav.tasks.dynamics import direction
from uavnav.tasks.world import World

VIEW_TOLERANCE = 1e-6
"""A direction counts as in front of the drone down to this: rounding never hides a neighbour."""

FEW, MANY_ROWS = 36, 1024
"""Up to `FEW` candidates, as many as the paper's 8 circles and 28 squares, are ranked by counting in a graph,
if it has fewer than `MANY_ROWS` rows.
"""

FAR = 1e6
"""Coordinates of a circle that is never sensed [px]."""


class Scan(NamedTuple):
    """What comes back to the sensor before eq. (13) scales it; slots lead, the batch comes last."""

    numbers: Tensor  # [F, S, ...] the direction, forward last, then the velocity where it is sensed
    distance: Tensor  # [S, ...] px, infinite of an empty slot


def sense(
    x: Tensor, y: Tensor, heading: Tensor, obstacles: Tensor, world: World, velocities: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """The ten sensed obstacles and the distance to the nearest one.

    x, y [...] px, heading [...] whole degrees in 0..359, obstacles [..., K, 3] of (x, y, radius) px ->
    slots [..., 10, 3] of (right, forward, proximity), eq. (13), and clearance [...] px, the least distance
    from the drone's centre to any circle or border square, in view or not: at most `world.drone_radius` is a
    collision.

    With velocities [..., K, 2], as shares of the greatest speed, a slot has two numbers more: the obstacle's
    velocity to the right and forward, clamped to [-1, 1]; zero of a square or an empty slot.
    """
    found, near = scan(x, y, heading, obstacles, world, velocities)
    return encode(found, world), near


def scan(
    x: Tensor, y: Tensor, heading: Tensor, obstacles: Tensor, world: World, velocities: Tensor | None = None
) -> tuple[Scan, Tensor]:
    """As `sense`, with distances in px: what comes back, and the clearance [...] px.

    Inside, candidates lead and the batch comes last: the innermost loops run over many drones, and vectorise.
    """
    dx, dy, distance = _candidates(x, y, obstacles, world)
    length = torch.sqrt(dx * dx + dy * dy)
    scale = torch.where(length > 0, 1 / length, 0.0)  # a centre that coincides has no direction: u = (0, 0)
    right, forward = to_drone_frame(dx * scale, dy * scale, heading)
    in_view = (distance <= world.sensor_radius) & (forward >= world.view_cosine - VIEW_TOLERANCE)
    candidates = torch.stack([right.clamp(-1, 1), forward.clamp(0, 1), distance])
    of_circles = None
    if velocities is not None:
        east, north = velocities.movedim((-1, -2), (0, 1))
        of_circles = torch.stack(to_drone_frame(east, north, heading)).clamp(-1, 1)
    return first_in_view(candidates, in_view, world, of_circles), distance.amin(0)


def encode(found: Scan, world: World) -> Tensor:
    """Eq. (13) of what came back: slots [..., S, F + 1], with the proximity after the direction."""
    axes = len(world.size)
    proximity = (found.distance - world.drone_radius) / (world.sensor_radius - world.drone_radius)
    slots = torch.cat([found.numbers[:axes], proximity.clamp(0, 1)[None], found.numbers[axes:]])
    far = 1.0 if world.padding == "far" else 0.0
    padding = torch.tensor([far * (n == axes) for n in range(len(slots))], device=slots.device)
    slots = torch.where(found.distance < math.inf, slots, padding.reshape(-1, *[1] * found.distance.ndim))
    return slots.movedim((0, 1), (-1, -2)).contiguous()


def clearance(x: Tensor, y: Tensor, obstacles: Tensor, world: World) -> Tensor:
    """Only the clearance that `sense` gives: [...] px."""
    return _candidates(x, y, obstacles, world)[2].amin(0)


def _candidates(x: Tensor, y: Tensor, obstacles: Tensor, world: World) -> tuple[Tensor, Tensor, Tensor]:
    """Offsets to all that may be sensed, and the distance to its edge [px]: dx, dy, distance [N, ...]."""
    # without a circle, a graph would work the squares out again in every comparison
    if not obstacles.shape[-2]:
        obstacles = obstacles.new_tensor([[FAR, FAR, 0.0]]).expand(*x.shape, 1, 3)
    circle_x, circle_y, circle_distance = _offsets_to_circles(x, y, obstacles.movedim((-2, -1), (0, 1)))
    square_x, square_y = _offsets_to_squares(x, y, world)
    square_length = torch.sqrt(square_x * square_x + square_y * square_y)
    dx = torch.cat([circle_x, square_x])
    dy = torch.cat([circle_y, square_y])
    return dx, dy, torch.cat([circle_distance, square_length])


def to_drone_frame(dx: Tensor, dy: Tensor, heading: Tensor) -> tuple[Tensor, Tensor]:
    """Rotate offsets into the drone's frame: right and forward components. Eq. (10) with a = 90 degrees -
    heading.

    dx, dy [N, ...] px, heading [...] whole degrees -> right, forward [N, ...] px.
    """
    cosine, sine = direction(heading)
    return dx * sine - dy * cosine, dx * cosine + dy * sine


def _offsets_to_circles(x: Tensor, y: Tensor, obstacles: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Offsets to the centres, eq. (9), and to the edges (negative inside) [px]: [K, 3, ...] -> [K, ...]."""
    dx = obstacles[:, 0] - x
    dy = obstacles[:, 1] - y
    return dx, dy, torch.sqrt(dx * dx + dy * dy) - obstacles[:, 2]


def _offsets_to_squares(x: Tensor, y: Tensor, world: World) -> tuple[Tensor, Tensor]:
    """Offsets to the nearest points of the border squares that can be in view or nearest: dx, dy [Q, ...] px.

    Only the nearer of two opposite walls can be in view, and only its squares within the sensor's radius of
    the drone: 14 and 14 stand for all 136 (13 would do, but for a drone whose centre is on a line between
    two squares and in the wall itself). They come in index order: the bottom or top row from left to right
    with its corners, then the left or right column from bottom to top without them.
    """
    columns, rows, side = world.width // world.border, world.height // world.border, float(world.border)
    reach, count = world.sensed_squares_each_way, world.sensed_squares_of_a_wall
    nth = torch.arange(count, device=x.device).reshape(-1, *[1] * x.ndim)

    first = (torch.ceil(x / side) - 1 - reach).clamp(0, columns - count)
    along = (first + nth) * side
    wall = torch.where(y < world.height / 2, 0.0, world.height - side).expand_as(along)
    row_dx, row_dy = _offset_to_square(x, y, along, wall, side)

    first = (torch.ceil(y / side) - 1 - reach).clamp(1, rows - 1 - count)
    along = (first + nth) * side
    wall = torch.where(x < world.width / 2, 0.0, world.width - side).expand_as(along)
    column_dx, column_dy = _offset_to_square(x, y, wall, along, side)
    return torch.cat([row_dx, column_dx]), torch.cat([row_dy, column_dy])


def _offset_to_square(
    x: Tensor, y: Tensor, left: Tensor, bottom: Tensor, side: float
) -> tuple[Tensor, Tensor]:
    """Offset from the drone to the nearest point of closed squares, zero inside: dx, dy [Q, ...] px."""
    return torch.clamp(x, left, left + side) - x, torch.clamp(y, bottom, bottom + side) - y


def first_in_view(candidates: Tensor, in_view: Tensor, world: World, more: Tensor | None = None) -> Scan:
    """The first ten candidates in view, nearest (or lowest index) first, ties by index.

    candidates [3, N, ...] (in 3D [4, N, ...]), the distance [px] last, in_view [N, ...] bool, more [G, K,
    ...] further numbers of the first K candidates, which are zero of the others -> numbers [F, 10, ...],
    distance [10, ...].

    In a graph the candidates are gone through ten times, each time for the nearest that is left: adding and
    comparing fuse and vectorise where a sort and a scatter do not, and floats where flags and integers do
    not. `FEW` candidates of less than `MANY_ROWS` rows are ranked at once instead, each by the number of
    candidates before it: that grows with N squared, but its steps do not depend on each other. Step by step
    nothing fuses, and a sort is five times faster. All three ways give the same bits.
    """
    distance = candidates[-1]
    index, slot = (
        torch.arange(n, dtype=distance.dtype, device=distance.device).reshape(-1, *[1] * (distance.ndim - 1))
        for n in (len(distance), world.n_slots)
    )
    key = torch.where(in_view, distance if world.slots == "nearest" else index, math.inf)
    parts = [candidates] if more is None else [candidates, more]
    if type(distance) is Tensor:  # and not what stands for one while a graph is traced
        order = key.sort(dim=0, stable=True).indices[: world.n_slots]
        if more is not None:
            others = more.new_zeros(len(more), len(key) - more.shape[1], *key.shape[1:])
            candidates = torch.cat([candidates, torch.cat([more, others], 1)])
        slots = candidates.gather(1, order.expand(len(candidates), *order.shape)) + 0.0  # a sum has no -0.0
    elif len(key) > FEW or key[0].numel() >= MANY_ROWS:
        slots = _one_by_one(parts, key, index, world.n_slots)
    else:
        before = (key[:, None] < key) | ((key[:, None] == key) & (index[:, None] < index))
        rank = before.sum(0, dtype=distance.dtype)
        found = [
            torch.where(rank[: part.shape[1]] == slot[:, None], part[:, None], 0.0).sum(2) for part in parts
        ]
        slots = found[0] if more is None else torch.cat(found)
    filled = slot < (key < math.inf).sum(0, dtype=distance.dtype)
    axes = len(world.size)
    numbers = slots[:axes] if more is None else torch.cat([slots[:axes], slots[axes + 1 :]])
    return Scan(numbers, torch.where(filled, slots[axes], math.inf))


def _one_by_one(parts: list[Tensor], key: Tensor, index: Tensor, n_slots: int) -> Tensor:
    """The candidates with the least keys [N, ...], in order, ties by index: [F + 1, n_slots, ...].

    parts: some of the F + 1 numbers each, of the first candidates.
    """
    slots = []
    for _ in range(n_slots):
        lowest = torch.where(key == key.amin(0), index, math.inf).amin(0)
        chosen = index == lowest
        slots.append(torch.cat([torch.where(chosen[: part.shape[1]], part, 0.0).sum(1) for part in parts]))
        key = torch.where(chosen, math.inf, key)
    return torch.stack(slots, 1)
