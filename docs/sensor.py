"""Draw docs/sensor.png: what the drone senses, and the slots of its observation (`python docs/sensor.py`)."""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib
import matplotlib.figure
import torch
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle, Wedge

from uavnav import style
from uavnav.colours import PILOTS
from uavnav.tasks import sensing
from uavnav.tasks.world import World

X, Y, HEADING = 650.0, 470.0, 60
CIRCLES = [[565.0, 540.0, 45.0], [765.0, 510.0, 45.0], [600.0, 375.0, 45.0]]
EMPTY = (0.0, 0.0, 1.0)


def scene(axes: Axes, world: World, slots: list[list[float]], distances: list[float]) -> None:
    """The drone, its half disc of view, and a numbered line to each obstacle that it senses."""
    colour = PILOTS["you"]
    reach, side = world.sensor_radius, world.border
    axes.add_patch(Wedge((X, Y), reach, HEADING - 90, HEADING + 90, color=colour, alpha=0.15, lw=0))
    squares = [(x, world.height - side) for x in range(0, world.width, side)]
    squares += [(world.width - side, y) for y in range(0, world.height - side, side)]
    for place in squares:
        axes.add_patch(Rectangle(place, side, side, facecolor=style.OBSTACLE, edgecolor="white"))
    for x, y, radius in CIRCLES:
        axes.add_patch(Circle((x, y), radius, color=style.OBSTACLE, lw=0))
    axes.add_patch(Circle((X, Y), world.drone_radius, facecolor="white", edgecolor=colour, lw=2))
    ahead = math.radians(HEADING)
    axes.annotate(
        "",
        (X + 62 * math.cos(ahead), Y + 62 * math.sin(ahead)),
        (X, Y),
        arrowprops={"arrowstyle": "-|>", "color": style.INK, "lw": 2},
    )
    for number, ((right, forward, _), distance) in enumerate(zip(slots, distances, strict=True), 1):
        dx = right * math.sin(ahead) + forward * math.cos(ahead)
        dy = -right * math.cos(ahead) + forward * math.sin(ahead)
        axes.plot([X, X + dx * distance], [Y, Y + dy * distance], color=style.INK, lw=0.8)
        place = (X + dx * (distance + 9), Y + dy * (distance + 9))
        axes.annotate(str(number), place, ha="center", va="center", fontsize=10)
    axes.annotate("drone, radius 30 px", (X - 24, Y - 28), fontsize=10, ha="right", va="top")
    axes.annotate("behind:\nnot sensed", (600, 375), fontsize=10, ha="center", va="center")
    axes.annotate("sensor: 180°,\nreach 120 px", (X + 76, Y - 14), fontsize=10, ha="center", va="center")
    axes.set(xlim=(510, world.width), ylim=(330, world.height), aspect="equal", xticks=[], yticks=[])
    axes.grid(visible=False)
    axes.set_title("seen: two circles and the squares of the border")


def table(axes: Axes, slots: list[list[float]]) -> None:
    """The ten slots, empty ones pale."""
    axes.axis("off")
    axes.set_title("observation: 10 slots × 3 numbers")
    heads = ("slot", "right", "forward", "proximity")
    for column, head in enumerate(heads):
        axes.text(column, 0, head, ha="right", weight="bold")
    for row, numbers in enumerate([*slots, *[EMPTY] * (10 - len(slots))], 1):
        colour = style.INK if row <= len(slots) else style.PALE
        words = [str(row), *(f"{number:.2f}".replace("-", "−") for number in numbers)]
        for column, word in enumerate(words):
            axes.text(column, row, word, ha="right", color=colour)
    axes.set(xlim=(-0.5, 3.1), ylim=(10.8, -0.8))


@matplotlib.rc_context(style.STYLE)
def main() -> None:
    """Sense the scene with the package's own function, and draw it."""
    world = World()
    x, y, heading = torch.tensor(X), torch.tensor(Y), torch.tensor(HEADING)
    found, _ = sensing.scan(x, y, heading, torch.tensor(CIRCLES), world)
    n = int((found.distance < math.inf).sum())
    slots = sensing.encode(found, world)[:n].tolist()
    figure = matplotlib.figure.Figure((11, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.1, 1))
    scene(left, world, slots, found.distance[:n].tolist())
    table(right, slots)
    (Path(__file__).parent / "sensor.png").write_bytes(style.png(figure))


if __name__ == "__main__":
    main()
