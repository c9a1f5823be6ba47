"""One state of the world as a picture, without a screen."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from uavnav.tasks.dynamics import direction
from uavnav.tasks.sensing import sense
from uavnav.tasks.simulator import Task
from uavnav.tasks.state import State
from uavnav.tasks.world import World

Picture = np.ndarray[Any, np.dtype[np.uint8]]
Colour = tuple[int, int, int]
Ink = tuple[int, ...]
"""Red, green, blue and maybe opacity."""
Trail = tuple[Sequence[tuple[float, float]], Ink]
"""Earlier positions (x, y) [px] and the colour of their line."""

# Okabe and Ito's colours, which people with any colour vision tell apart.
GROUND, BORDER, OBSTACLE, INK = (250, 250, 247), (84, 88, 96), (150, 156, 166), (32, 36, 44)
DRONE, SENSOR, SENSED, GOAL = (0, 114, 178), (86, 180, 233, 56), (213, 94, 0), (0, 158, 115)
PILOTS = (DRONE, (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233), (84, 88, 96))
"""One for each policy, in order: its drone and its trail."""

STEPS_PER_SECOND = 30
"""The simulation's own rate."""
SMOOTHING = 2  # drawn so many times larger, then scaled down


def draw_state(state: State, task: Task) -> Picture:
    """One row's state, without a batch, at the world's own size [height, width, 3]; see `draw_arena`."""
    return np.asarray(draw_arena(state, task, task.world.width))


def draw_arena(
    state: State, task: Task, width: int, trails: Sequence[Trail] = (), colour: Colour = DRONE
) -> Image.Image:
    """The border, the obstacles, what else the task marks, the drone with its sensor's arc, and the points it senses.

    state: fields without a batch; width: of the picture [px]; trails: under the drone.
    """
    world, obstacles = task.world, task.obstacles(state)
    slots, _ = sense(state.x, state.y, state.heading, obstacles, world)
    x, y, heading = float(state.x), float(state.y), int(state.heading)
    image = _backdrop(tuple(map(tuple, obstacles.tolist())), world, width).copy()
    canvas = ImageDraw.Draw(image, "RGBA")
    at, disc = _places(world, width)
    thickness = max(1, round(SMOOTHING * width / world.width))
    for mark in task.marks(state).tolist():
        canvas.ellipse(disc(*mark), outline=GOAL, width=2 * thickness)
    for points, line in trails:
        if len(points) > 1:
            canvas.line([at(*point) for point in points], fill=line, width=thickness + SMOOTHING)
    half = world.sensor_arc / 2
    canvas.pieslice(disc(x, y, world.sensor_radius), -heading - half, -heading + half, fill=SENSOR)
    cosine, sine = (float(part) for part in direction(state.heading))
    sensed = []
    for right, forward, proximity in slots.tolist():
        if (right, forward) != (0, 0):
            reach = world.drone_radius + proximity * (world.sensor_radius - world.drone_radius)
            dx, dy = right * sine + forward * cosine, forward * sine - right * cosine
            sensed.append((x + reach * dx, y + reach * dy))
            canvas.line([at(x, y), at(*sensed[-1])], fill=(*SENSED, 110), width=thickness)
    canvas.ellipse(disc(x, y, world.drone_radius), fill=colour)
    nose = at(x + world.drone_radius * cosine, y + world.drone_radius * sine)
    canvas.line([at(x, y), nose], fill=GROUND, width=3 * thickness)
    for point in sensed:
        canvas.ellipse(disc(*point, 4), fill=SENSED)
    return image.reduce(SMOOTHING)


def height_of(width: int, world: World) -> int:
    """Height of a picture of the arena [px]."""
    return round(width * world.height / world.width)


Point = Callable[[float, float], tuple[float, float]]
Disc = Callable[[float, float, float], tuple[float, float, float, float]]


def _places(world: World, width: int) -> tuple[Point, Disc]:
    """Where a place of the world, or a disc, is in the enlarged picture. This is the one place where y is flipped."""
    scale, height = SMOOTHING * width / world.width, SMOOTHING * height_of(width, world)

    def at(x: float, y: float) -> tuple[float, float]:
        return x * scale, height - y * scale

    def disc(x: float, y: float, radius: float) -> tuple[float, float, float, float]:
        return *at(x - radius, y + radius), *at(x + radius, y - radius)

    return at, disc


@functools.lru_cache(maxsize=16)
def _backdrop(obstacles: tuple[tuple[float, float, float], ...], world: World, width: int) -> Image.Image:
    """What does not move in a flight, enlarged: ground, obstacles (x, y, radius) px, border."""
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


@functools.cache
def font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """The font that Matplotlib ships, which has arrows and signs; size [px]."""
    import matplotlib

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), size)
