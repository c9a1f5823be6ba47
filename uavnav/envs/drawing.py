"""One state of a task as a picture, without a screen; a box in 3D is seen from above and from the side."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
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
Ink = tuple[int, ...]  # red, green, blue and maybe opacity
Trail = tuple[Sequence[tuple[float, ...]], Ink]
"""Earlier positions (x, y) or (x, y, z) [px] and the colour of their line."""

# Okabe and Ito's colours, which people with any colour vision tell apart.
GROUND, BORDER, OBSTACLE, INK = (250, 250, 247), (84, 88, 96), (150, 156, 166), (32, 36, 44)
DRONE, SENSOR, SENSED, GOAL = (0, 114, 178), (86, 180, 233, 56), (213, 94, 0), (0, 158, 115)

STEPS_PER_SECOND = 30  # the simulation's own rate
SMOOTHING = 2  # drawn so many times larger, then scaled down
BETWEEN = 8  # the two views of a box [px]
DOT = 4  # radius of a point that is sensed, in a box one more [px]
VIEWS = {"from above": (0, 1, 2), "from the side": (0, 2, 1)}
"""The axes of a box that a view shows to the right and upwards, and the axis that it looks along."""


def draw_state(state: State, task: WrappedTask) -> Picture:
    """One row's state, without a batch, at the world's own size [height, width, 3]; see `draw_arena`."""
    world = task.world
    is_box = isinstance(world, SpaceWorld)
    return np.asarray(draw_arena(state, task, 2 * world.width + BETWEEN if is_box else world.width))


def draw_arena(
    state: State, task: WrappedTask, width: int, trails: Sequence[Trail] = (), colour: Colour = DRONE
) -> Image.Image:
    """The border, the obstacles, what else the task marks, the drone with its sensor's arc, and the points it
    senses.

    state: fields without a batch; width: of the picture [px]; trails: under the drone. A box is drawn as
    `draw_views` does.
    """
    if isinstance(task.world, SpaceWorld):
        return draw_views(state, task, width, trails, colour)
    world, obstacles = task.world, task.obstacles(state)
    found, _ = task.sense(state)
    x, y = float(state.x), float(state.y)
    image = _backdrop(tuple(map(tuple, obstacles.tolist())), world, width).copy()
    canvas = Canvas(image, world)
    for mark in task.marks(state).tolist():
        canvas.draw.ellipse(canvas.disc(*mark), outline=GOAL, width=2 * canvas.thickness)
    canvas.trails(trails, (0, 1))
    cosine, sine = (float(part) for part in direction(state.heading))
    sensed = []
    reached = found.distance.clamp(min=world.drone_radius)
    for right, forward, reach in zip(*found.numbers[:2].tolist(), reached.tolist(), strict=True):
        if reach < math.inf:
            dx, dy = right * sine + forward * cosine, forward * sine - right * cosine
            sensed.append((x + reach * dx, y + reach * dy))
    canvas.drone((x, y), (cosine, sine), int(state.heading), sensed, DOT, colour)
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
    image = Image.new("RGB", (width, height_of(width, world)), GROUND)
    for number, (title, (right, up, along)) in enumerate(VIEWS.items()):
        size = (width - BETWEEN) // 2, round((width - BETWEEN) // 2 * world.size[up] / world.width)
        view = Image.new("RGB", (size[0] * SMOOTHING, size[1] * SMOOTHING), GROUND)
        canvas = Canvas(view, world)
        slices = []
        for *centre, radius in obstacles.tolist():
            away = abs(centre[along] - place[along])
            touches = away < radius + world.drone_radius
            canvas.circle(centre[right], centre[up], radius, (*OBSTACLE, 90 if touches else 28))
            if away < radius:
                slices.append((centre[right], centre[up], math.sqrt(radius**2 - away**2)))
        for one in slices:
            canvas.circle(*one, OBSTACLE)
        canvas.walls(world.size[up])
        canvas.trails(trails, (right, up))
        here, *seen = ((point[right], point[up]) for point in (place, *sensed))
        nose = forward[right], forward[up]
        heading = math.degrees(math.atan2(nose[1], nose[0])) if math.hypot(*nose) > 1e-6 else None
        canvas.drone(here, nose, heading, seen, DOT + 1, colour)
        small = view.reduce(SMOOTHING)
        face, corner = font(max(8, size[0] // 30)), round(size[0] * world.border / world.width) + 3
        label = ImageDraw.Draw(small)
        box = label.textbbox((corner, corner), title, face)
        label.rectangle((box[0] - 2, box[1] - 2, box[2] + 2, box[3] + 2), fill=GROUND)
        label.text((corner, corner), title, INK, face)
        image.paste(small, (number * (width - size[0]), 0))
    return image


def height_of(width: int, world: World) -> int:
    if isinstance(world, SpaceWorld):
        return round((width - BETWEEN) // 2 * max(world.size[1:]) / world.width)
    return round(width * world.height / world.width)


class Canvas:
    """Draws on an enlarged picture in px of the world, from edge to edge. Only here is y flipped."""

    def __init__(self, image: Image.Image, world: World) -> None:
        self.draw, self.world = ImageDraw.Draw(image, "RGBA"), world
        self._scale, self._height = image.width / world.width, image.height
        self.thickness = max(1, round(self._scale))  # of a line, in the enlarged picture

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Where a place of the world is in the enlarged picture."""
        return x * self._scale, self._height - y * self._scale

    def disc(self, x: float, y: float, radius: float) -> tuple[float, float, float, float]:
        """The left, upper, right and lower end of a disc there."""
        return *self.at(x - radius, y + radius), *self.at(x + radius, y - radius)

    def circle(self, x: float, y: float, radius: float, fill: Ink) -> None:
        self.draw.ellipse(self.disc(x, y, radius), fill=fill)

    def rectangle(self, left: float, bottom: float, right: float, top: float, outline: Ink | None) -> None:
        self.draw.rectangle((*self.at(left, top), *self.at(right, bottom)), fill=BORDER, outline=outline)

    def walls(self, height: float) -> None:
        """The border of a view of so many px, without squares."""
        width, side = self.world.width, self.world.border
        for bottom in (0, height - side):
            self.rectangle(0, bottom, width, bottom + side, None)
        for left in (0, width - side):
            self.rectangle(left, 0, left + side, height, None)

    def trails(self, trails: Sequence[Trail], axes: tuple[int, int]) -> None:
        """Lines; axes: of their points, those to the right and upwards."""
        for points, ink in trails:
            if len(points) > 1:
                line = [self.at(*(point[axis] for axis in axes)) for point in points]
                self.draw.line(line, fill=ink, width=self.thickness + SMOOTHING)

    def drone(
        self,
        place: tuple[float, float],
        nose: tuple[float, float],
        heading: float | None,
        sensed: Sequence[tuple[float, float]],
        dot: float,
        colour: Colour,
    ) -> None:
        """The sensor's arc, the drone, and what it senses.

        nose: its direction, at most of length 1; heading: of that [degrees]; None: along the view;
        dot: the radius of a point [px].
        """
        (x, y), half, radius = place, self.world.sensor_arc / 2, self.world.drone_radius
        arc = self.disc(x, y, self.world.sensor_radius)
        if heading is None:
            self.draw.ellipse(arc, fill=SENSOR)
        else:
            self.draw.pieslice(arc, -heading - half, -heading + half, fill=SENSOR)
        for point in sensed:
            self.draw.line([self.at(x, y), self.at(*point)], fill=(*SENSED, 110), width=self.thickness)
        self.circle(x, y, radius, colour)
        tip = self.at(x + radius * nose[0], y + radius * nose[1])
        self.draw.line([self.at(x, y), tip], fill=GROUND, width=3 * self.thickness)
        for point in sensed:
            self.circle(*point, dot, SENSED)


@functools.lru_cache(maxsize=16)
def _backdrop(obstacles: tuple[tuple[float, float, float], ...], world: World, width: int) -> Image.Image:
    """What does not move in an episode, enlarged: ground, obstacles (x, y, radius) px, border."""
    image = Image.new("RGB", (width * SMOOTHING, height_of(width, world) * SMOOTHING), GROUND)
    canvas, side = Canvas(image, world), world.border
    for obstacle in obstacles:
        canvas.circle(*obstacle, OBSTACLE)
    for left in range(0, world.width, side):
        for bottom in range(0, world.height, side):
            if left in (0, world.width - side) or bottom in (0, world.height - side):
                canvas.rectangle(left, bottom, left + side, bottom + side, GROUND)
    return image


@functools.cache
def font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """The font that Matplotlib ships, which has arrows and signs; size [px]."""
    import matplotlib

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), size)
