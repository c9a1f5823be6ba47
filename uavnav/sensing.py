"""What the drone perceives: equations (9), (10) and (13). Pure functions of tensors of any batch shape.

Letters: K obstacles of a layout, S = 28 border squares that can matter, N = K + S candidates.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from uavnav.dynamics import direction
from uavnav.world import World

VIEW_TOLERANCE = 1e-6
"""A direction counts as in front of the drone down to this much behind it, so that rounding never hides a neighbour."""


def sense(x: Tensor, y: Tensor, heading: Tensor, obstacles: Tensor, world: World) -> tuple[Tensor, Tensor]:
    """The ten sensed obstacles and the distance to the nearest one.

    x, y [...] px, heading [...] whole degrees in 0..359, obstacles [..., K, 3] of (x, y, radius) px ->
    slots [..., 10, 3] of (right, forward, distance), eq. (13), and clearance [...] px, the smallest distance from the
    drone's centre to any circle or border square, in view or not: at most `world.drone_radius` is a collision.
    """
    circle_x, circle_y, circle_distance = _offsets_to_circles(x, y, obstacles)
    square_x, square_y = _offsets_to_squares(x, y, world)
    square_length = torch.sqrt(square_x * square_x + square_y * square_y)
    dx = torch.cat([circle_x, square_x], -1)
    dy = torch.cat([circle_y, square_y], -1)
    distance = torch.cat([circle_distance, square_length], -1)

    length = torch.sqrt(dx * dx + dy * dy)
    scale = torch.where(length > 0, 1 / length, 0.0)  # a centre that coincides has no direction: u = (0, 0)
    right, forward = to_drone_frame(dx * scale, dy * scale, heading[..., None])
    in_view = (distance <= world.sensor_radius) & (forward >= world.view_cosine - VIEW_TOLERANCE)
    proximity = (distance - world.drone_radius) / (world.sensor_radius - world.drone_radius)
    triples = torch.stack([right.clamp(-1, 1), forward.clamp(0, 1), proximity.clamp(0, 1)], -1)
    return _first_in_view(triples, distance, in_view, world), distance.amin(-1)


def to_drone_frame(dx: Tensor, dy: Tensor, heading: Tensor) -> tuple[Tensor, Tensor]:
    """Rotate offsets into the drone's frame: right and forward components. Eq. (10) with a = 90 degrees - heading.

    dx, dy [..., N] px, heading [..., 1] whole degrees -> right, forward [..., N] px.
    """
    cosine, sine = direction(heading)
    return dx * sine - dy * cosine, dx * cosine + dy * sine


def _offsets_to_circles(x: Tensor, y: Tensor, obstacles: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Offsets to the centres, eq. (9), and distances to the edges (negative inside): each [..., K] px."""
    dx = obstacles[..., 0] - x[..., None]
    dy = obstacles[..., 1] - y[..., None]
    return dx, dy, torch.sqrt(dx * dx + dy * dy) - obstacles[..., 2]


def _offsets_to_squares(x: Tensor, y: Tensor, world: World) -> tuple[Tensor, Tensor]:
    """Offsets to the nearest points of the border squares that can be in view or nearest: dx, dy [..., S] px.

    Of two opposite walls only the nearer can be in view, and of a wall only the squares within the sensor's radius of
    the drone: 14 and 14 stand for all 136 (13 would do, but for a drone whose centre lies on a line between two squares
    and in the wall itself). They come in index order: the bottom or top row from left to right with
    its corners, then the left or right column from bottom to top without them.
    """
    columns, rows, side = world.width // world.border, world.height // world.border, float(world.border)
    reach, count = world.sensed_squares_each_way, world.sensed_squares_of_a_wall

    first = (torch.ceil(x / side) - 1 - reach).clamp(0, columns - count)
    along = (first[..., None] + torch.arange(count, device=x.device)) * side
    wall = torch.where(y < world.height / 2, 0.0, world.height - side)[..., None].expand_as(along)
    row_dx, row_dy = _offset_to_square(x, y, along, wall, side)

    first = (torch.ceil(y / side) - 1 - reach).clamp(1, rows - 1 - count)
    along = (first[..., None] + torch.arange(count, device=x.device)) * side
    wall = torch.where(x < world.width / 2, 0.0, world.width - side)[..., None].expand_as(along)
    column_dx, column_dy = _offset_to_square(x, y, wall, along, side)
    return torch.cat([row_dx, column_dx], -1), torch.cat([row_dy, column_dy], -1)


def _offset_to_square(x: Tensor, y: Tensor, left: Tensor, bottom: Tensor, side: float) -> tuple[Tensor, Tensor]:
    """Offset from the drone to the nearest point of closed squares, zero inside: dx, dy [..., S] px."""
    x, y = x[..., None], y[..., None]
    return torch.clamp(x, left, left + side) - x, torch.clamp(y, bottom, bottom + side) - y


def _first_in_view(triples: Tensor, distance: Tensor, in_view: Tensor, world: World) -> Tensor:
    """The first ten candidates in view, nearest (or lowest index) first, ties by index; empty slots are padded.

    triples [..., N, 3], distance, in_view [..., N] -> slots [..., 10, 3]. The rank of a candidate is the number of
    candidates before it: on so few, counting fuses and vectorises where a sort does not.
    """
    index = torch.arange(distance.shape[-1], device=distance.device)
    key = distance if world.slots == "nearest" else index.to(distance.dtype).expand_as(distance)
    key = torch.where(in_view, key, math.inf)
    mine, other = key[..., :, None], key[..., None, :]
    before = (other < mine) | ((other == mine) & (index[None, :] < index[:, None]))
    rank = before.sum(-1)
    padding = torch.tensor([0.0, 0.0, 1.0 if world.padding == "far" else 0.0], device=triples.device)
    triples = torch.where(in_view[..., None], triples, padding)
    ranked = torch.empty_like(triples).scatter(-2, rank[..., None].expand_as(triples), triples)
    return ranked[..., : world.n_slots, :]
