"""One state of a task as a picture, without a screen; a box in 3D is seen from above and from the side."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from uavnav.tasks.dynamics import direction
from uavnav.tasks.space import SpaceWorld, to_body
from uavnav.tasks.state import State
from uavnav.tasks.world import World
from uavnav.tasks.wrapper import WrappedTask

Picture = np.ndarray[Any, np.dtype[np.uint8]]
Colour = tuple[int, int, int]
Ink = tuple[int, ...]
"""Red, green, blue and maybe opacity."""
Trail = tuple[Sequence[tuple[float, ...]], Ink]
"""Earlier positions (x, y) or (x, y, z) [px] and the colour of their line."""

# Okabe and Ito's colours, which people with any colour vision tell apart.
GROUND, BORDER, OBSTACLE, INK = (250, 250, 247), (84, 88, 96), (150, 156, 166), (32, 36, 44)
DRONE, SENSOR, SENSED, GOAL = (0, 114, 178), (86, 180, 233, 56), (213, 94, 0), (0, 158, 115)

STEPS_PER_SECOND = 30
"""The simulation's own rate."""
SMOOTHING = 2  # drawn so many times larger, then scaled down
BETWEEN = 8  # the two views of a box [px]
VIEWS = {"from above": (0, 1, 2), "from the side": (0, 2, 1)}
"""The axes of a box that a view shows to the right and upwards, and the axis that it looks along."""


def draw_state(state: State, task: WrappedTask) -> Picture:
    """One row's state, without a batch, at the world's own size [height, width, 3]; see `draw_arena`."""
    world = task.world
    return np.asarray(draw_arena(state, task, 2 * world.width + BETWEEN if _is_box(world) else world.width))


def draw_arena(
    state: State, task: WrappedTask, width: int, trails: Sequence[Trail] = (), colour: Colour = DRONE
) -> Image.Image:
    """The border, the obstacles, what else the task marks, the drone with its sensor's arc, and the points it
    senses.

    state: fields without a batch; width: of the picture [px]; trails: under the drone. A box is drawn as
    `draw_views` does.
    """
    if _is_box(task.world):
        return draw_views(state, task, width, trails, colour)
    world, obstacles = task.world, task.obstacles(state)
    found, _ = task.sense(state)
    x, y, heading = float(state.x), float(state.y), int(state.heading)
    image = _backdrop(tuple(map(tuple, obstacles.tolist())), world, width).copy()
    canvas = ImageDraw.Draw(image, "RGBA")
    at, disc = _places(world, width)
    thickness = max(1, round(SMOOTHING * width / world.width))
    for mark in task.marks(state).tolist():
        canvas.ellipse(disc(*mark), outline=GOAL, width=2 * thickness)
    for points, line in trails:
        if len(points) > 1:
            canvas.line([at(*point[:2]) for point in points], fill=line, width=thickness + SMOOTHING)
    half = world.sensor_arc / 2
    canvas.pieslice(disc(x, y, world.sensor_radius), -heading - half, -heading + half, fill=SENSOR)
    cosine, sine = (float(part) for part in direction(state.heading))
    sensed = []
    reached = found.distance.clamp(min=world.drone_radius)
    for right, forward, reach in zip(*found.numbers[:2].tolist(), reached.tolist(), strict=True):
        if reach < math.inf:
            dx, dy = right * sine + forward * cosine, forward * sine - right * cosine
            sensed.append((x + reach * dx, y + reach * dy))
            canvas.line([at(x, y), at(*sensed[-1])], fill=(*SENSED, 110), width=thickness)
    canvas.ellipse(disc(x, y, world.drone_radius), fill=colour)
    nose = at(x + world.drone_radius * cosine, y + world.drone_radius * sine)
    canvas.line([at(x, y), nose], fill=GROUND, width=3 * thickness)
    for point in sensed:
        canvas.ellipse(disc(*point, 4), fill=SENSED)
    return image.reduce(SMOOTHING)


def draw_views(
    state: State, task: WrappedTask, width: int, trails: Sequence[Trail] = (), colour: Colour = DRONE
) -> Image.Image:
    """A box from above and from the side, side by side; the arguments are as of `draw_arena`.

    Each view is the slice through the drone's centre: what a sphere or the sensor has there is dark.
    Silhouettes of spheres are pale; darker where the sphere is near enough to the slice to touch the drone.
    """
    world, obstacles = task.world, task.obstacles(state)
    place = [float(getattr(state, axis)) for axis in "xyz"]
    frame = torch.stack(to_body(torch.eye(3), state))  # right, up, forward [3, 3 of x, y, z]
    forward = frame[2].tolist()
    found, _ = task.sense(state)
    filled = found.distance < math.inf
    directions, reach = found.numbers[:3, filled].T, found.distance[filled].clamp(min=world.drone_radius)
    sensed = (torch.tensor(place) + reach[:, None] * (directions @ frame)).tolist()
    half = world.sensor_arc / 2
    image = Image.new("RGB", (width, height_of(width, world)), GROUND)
    for number, (title, (right, up, along)) in enumerate(VIEWS.items()):
        size = _view(width), round(_view(width) * world.size[up] / world.width)
        view = Image.new("RGB", (size[0] * SMOOTHING, size[1] * SMOOTHING), GROUND)
        canvas, (at, disc) = ImageDraw.Draw(view, "RGBA"), _placed(size[0] / world.width, size[1])
        thickness = max(1, round(SMOOTHING * size[0] / world.width))
        slices = []
        for *centre, radius in obstacles.tolist():
            away = abs(centre[along] - place[along])
            touches = away < radius + world.drone_radius
            canvas.ellipse(disc(centre[right], centre[up], radius), fill=(*OBSTACLE, 90 if touches else 28))
            if away < radius:
                slices.append(disc(centre[right], centre[up], math.sqrt(radius**2 - away**2)))
        for one in slices:
            canvas.ellipse(one, fill=OBSTACLE)
        _frame(canvas, at, world.width, world.size[up], world.border)
        for points, line in trails:
            if len(points) > 1:
                shown = [at(point[right], point[up]) for point in points]
                canvas.line(shown, fill=line, width=thickness + SMOOTHING)
        x, y, nose = place[right], place[up], (forward[right], forward[up])
        if math.hypot(*nose) > 1e-6:
            heading = math.degrees(math.atan2(nose[1], nose[0]))
            canvas.pieslice(disc(x, y, world.sensor_radius), -heading - half, -heading + half, fill=SENSOR)
        else:  # it looks along the view
            canvas.ellipse(disc(x, y, world.sensor_radius), fill=SENSOR)
        for point in sensed:
            canvas.line([at(x, y), at(point[right], point[up])], fill=(*SENSED, 110), width=thickness)
        canvas.ellipse(disc(x, y, world.drone_radius), fill=colour)
        tip = at(x + world.drone_radius * nose[0], y + world.drone_radius * nose[1])
        canvas.line([at(x, y), tip], fill=GROUND, width=3 * thickness)
        for point in sensed:
            canvas.ellipse(disc(point[right], point[up], 5), fill=SENSED)
        small = view.reduce(SMOOTHING)
        face, corner = font(max(8, size[0] // 30)), round(size[0] * world.border / world.width) + 3
        label = ImageDraw.Draw(small)
        box = label.textbbox((corner, corner), title, face)
        label.rectangle((box[0] - 2, box[1] - 2, box[2] + 2, box[3] + 2), fill=GROUND)
        label.text((corner, corner), title, INK, face)
        image.paste(small, (number * (width - size[0]), 0))
    return image


def _is_box(world: World) -> bool:
    return isinstance(world, SpaceWorld)


def _view(width: int) -> int:
    """Width of one of a box's two views [px]."""
    return (width - BETWEEN) // 2


def height_of(width: int, world: World) -> int:
    """Height of a picture of the arena [px]."""
    if _is_box(world):
        return round(_view(width) * max(world.size[1:]) / world.width)
    return round(width * world.height / world.width)


Point = Callable[[float, float], tuple[float, float]]
Disc = Callable[[float, float, float], tuple[float, float, float, float]]


def _places(world: World, width: int) -> tuple[Point, Disc]:
    """Where a place of the world, or a disc, is in the enlarged picture. Only here is y flipped."""
    return _placed(width / world.width, height_of(width, world))


def _placed(scale: float, height: int) -> tuple[Point, Disc]:
    """The same by the scale and the height [px] of the picture before it is enlarged."""
    scale, height = SMOOTHING * scale, SMOOTHING * height

    def at(x: float, y: float) -> tuple[float, float]:
        return x * scale, height - y * scale

    def disc(x: float, y: float, radius: float) -> tuple[float, float, float, float]:
        return *at(x - radius, y + radius), *at(x + radius, y - radius)

    return at, disc


@functools.lru_cache(maxsize=16)
def _backdrop(obstacles: tuple[tuple[float, float, float], ...], world: World, width: int) -> Image.Image:
    """What does not move in an episode, enlarged: ground, obstacles (x, y, radius) px, border."""
    image = Image.new("RGB", (width * SMOOTHING, height_of(width, world) * SMOOTHING), GROUND)
    canvas = ImageDraw.Draw(image)
    at, disc = _places(world, width)
    for obstacle in obstacles:
        canvas.ellipse(disc(*obstacle), fill=OBSTACLE)
    for left in range(0, world.width, world.border):
        for bottom in range(0, world.height, world.border):
            if left in (0, world.width - world.border) or bottom in (0, world.height - world.border):
                corners = (*at(left, bottom + world.border), *at(left + world.border, bottom))
                canvas.rectangle(corners, fill=BORDER, outline=GROUND)
    return image


def _frame(canvas: ImageDraw.ImageDraw, at: Point, width: int, height: int, thickness: int) -> None:
    """The walls of a view [px]."""
    strips = (
        (0, 0, width, thickness),
        (0, height - thickness, width, height),
        (0, 0, thickness, height),
        (width - thickness, 0, width, height),
    )
    for left, bottom, right, top in strips:
        canvas.rectangle((*at(left, top), *at(right, bottom)), fill=BORDER)


@functools.cache
def font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """The font that Matplotlib ships, which has arrows and signs; size [px]."""
    import matplotlib

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), size)
