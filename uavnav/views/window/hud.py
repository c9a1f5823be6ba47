"""The live window as a picture: a game and a size in, pixels out. Who flies, what it sees, does next, and how
it fares.

Everything is laid out in units that are one pixel in a window of `DESIGN` and scale with it; the panel is
beside the arena, or below it where that leaves more room.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from matplotlib import colormaps
from PIL import Image, ImageDraw

from uavnav.envs import drawing
from uavnav.envs.drawing import BORDER, GROUND, INK, OBSTACLE, SENSED, STEPS_PER_SECOND, Ink, font, height_of
from uavnav.runs.metrics import METRICS
from uavnav.tasks.world import World
from uavnav.views.window.game import PACES, Game, colour, in_3d, parts
from uavnav.views.window.mouse import problem
from uavnav.views.window.table import HELP

MARGIN, BLOCK, FOOTER = 12, 330, 30  # [units]; a block of the panel is as wide as that
ARENA_UNITS = 800, 600
DESIGN = ARENA_UNITS[0] + BLOCK + 3 * MARGIN, ARENA_UNITS[1] + 2 * MARGIN + FOOTER
"""Size of the window at first [px]."""
BELOW = ARENA_UNITS[0] + 2 * MARGIN, ARENA_UNITS[1] + BLOCK + 3 * MARGIN + FOOTER
FACTS_HEIGHT = 285  # of the block above the action grid [units]
SMALLEST = 0.4  # pixels a unit
FADED = 90  # opacity of earlier trails, of 255
WHITE, UNKNOWN = (255, 255, 255), (236, 237, 240)
DARK = 350  # red + green + blue of a colour that white stands out from


class Places(NamedTuple):
    """Where things are in a window [px], and how many pixels a unit is."""

    unit: float
    left: int  # of the arena
    top: int
    width: int
    height: int
    facts: tuple[int, int]  # left, top of the block of facts
    grid: tuple[int, int]  # and of the block with the action grid


def arrange(size: tuple[int, int], world: World) -> Places:
    """Lay a window of this size out [px]."""
    beside, below = (min(size[0] / form[0], size[1] / form[1]) for form in (DESIGN, BELOW))
    unit = max(beside, below, SMALLEST)
    margin, block = round(MARGIN * unit), round(BLOCK * unit)
    panel = (block + margin, 0) if beside >= below else (0, block + margin)
    free_width = size[0] - 2 * margin - panel[0]
    free_height = size[1] - 2 * margin - panel[1] - round(FOOTER * unit)
    width = max(40, min(free_width, int(free_height * 1000 / height_of(1000, world))))
    height = height_of(width, world)
    left, top = margin + max(0, free_width - width) // 2, margin + max(0, free_height - height) // 2
    if beside >= below:
        x = size[0] - margin - block
        return Places(unit, left, top, width, height, (x, margin), (x, margin + round(FACTS_HEIGHT * unit)))
    y = top + height + margin
    first = max(margin, (size[0] - 2 * block - 4 * margin) // 2)
    return Places(unit, left, top, width, height, (first, y), (first + block + 4 * margin, y))


def to_world(position: tuple[int, int], size: tuple[int, int], world: World) -> tuple[float, float]:
    """The place of the world [px], y upwards, under a pixel of the window."""
    places = arrange(size, world)
    scale = world.width / places.width
    return (position[0] - places.left) * scale, world.height - (position[1] - places.top) * scale


def draw(game: Game, size: tuple[int, int]) -> Image.Image:
    """The whole window at a size [px]."""
    places = arrange(size, game.world)
    image = Image.new("RGB", size, WHITE)
    trails: list[drawing.Trail] = [(leg.points, (*colour(leg.pilot), FADED)) for leg in game.ghosts]
    trails += [(leg.points, colour(leg.pilot)) for leg in game.legs]
    arena = drawing.draw_arena(game.state, game.task, places.width, trails, colour(game.pilot))
    image.paste(arena, (places.left, places.top))
    canvas = ImageDraw.Draw(image, "RGBA")
    if game.drawing:
        _sketch(canvas, game, places)
    _banner(canvas, game, places)
    _facts(_Block(canvas, places.facts, places.unit), game)
    _grid(_Block(canvas, places.grid, places.unit), game)
    _footer(_Block(canvas, (0, size[1] - round(FOOTER * places.unit)), places.unit), game, size[0])
    if game.help:
        _help(image, places, size)
    return image


class _Block:
    """A canvas whose coordinates are units from a corner; y downwards."""

    def __init__(self, canvas: ImageDraw.ImageDraw, corner: tuple[int, int], unit: float) -> None:
        self.canvas, self.corner, self.unit = canvas, corner, unit

    def at(self, x: float, y: float) -> tuple[float, float]:
        return round(self.corner[0] + x * self.unit), round(self.corner[1] + y * self.unit)

    def write(
        self,
        x: float,
        y: float,
        words: str,
        size: float = 13,
        bold: bool = False,
        fill: Ink = INK,
        anchor: str = "lm",
        room: float | None = None,
    ) -> None:
        """Text at a place; shortened to the room that there is [units]."""
        face = font(max(5, round(size * self.unit)), bold)
        if room is not None and face.getlength(words) > room * self.unit:
            while words and face.getlength(words + "…") > room * self.unit:
                words = words[:-1]
            words += "…"
        self.canvas.text(self.at(x, y), words, fill, face, anchor=anchor)

    def box(
        self,
        x: float,
        y: float,
        wide: float,
        high: float,
        fill: Ink | None,
        outline: Ink | None = None,
        line: int = 1,
    ) -> None:
        corners = (*self.at(x, y), *self.at(x + wide, y + high))
        self.canvas.rectangle(corners, fill=fill, outline=outline, width=max(1, round(line * self.unit)))


def _sketch(canvas: ImageDraw.ImageDraw, game: Game, places: Places) -> None:
    """While drawing: the zone around the start that stays free, and the obstacle under the mouse."""
    scale = places.width / game.world.width
    x, y = game.world.start
    rings: list[tuple[float, float, float, Ink, Ink | None]] = [(x, y, game.world.safe_zone, INK, None)]
    if game.circle is not None:
        edge, fill = (SENSED, SENSED) if problem(game) else (INK, OBSTACLE)
        rings.append((*game.circle, edge, (*fill, 150)))
    for x, y, radius, line, inside in rings:
        left, top, reach = places.left + x * scale, places.top + places.height - y * scale, radius * scale
        corners = (left - reach, top - reach, left + reach, top + reach)
        canvas.ellipse(corners, fill=inside, outline=line, width=max(2, round(2 * places.unit)))


def headline(game: Game) -> tuple[str, str]:
    """What is going on, and what one can do now; empty while a drone flies."""
    if game.drawing:
        return (
            "Drawing obstacles",
            "drag: one more · right click: one less · C: none · E: fly them · B: save them",
        )
    if game.ended:
        return game.ended, "R: start again · N: next set"
    if game.waiting:
        nose = " · T G: nose up, down" if in_3d(game.world) else ""
        return "You fly", f"↑ ↓: speed · ← →: turn{nose} · the first key starts the episode"
    if game.paused:
        return "Paused", "Space: go on · the full stop: one step"
    return "", ""


def _banner(canvas: ImageDraw.ImageDraw, game: Game, places: Places) -> None:
    title, hint = headline(game)
    if not title:
        return
    unit = places.width / ARENA_UNITS[0]
    block = _Block(canvas, (places.left, places.top), unit)
    lengths = font(round(14 * unit) or 5).getlength(hint), font(round(20 * unit) or 5, True).getlength(title)
    wide = 40 + max(lengths) / unit
    middle = ARENA_UNITS[0] / 2
    block.box(middle - wide / 2, 36, wide, 62, (*WHITE, 225), SENSED if game.ended else BORDER, 2)
    block.write(middle, 56, title, 20, bold=True, anchor="mm")
    block.write(middle, 81, hint, 14, fill=BORDER, anchor="mm")


def _facts(block: _Block, game: Game) -> None:
    """Who flies, where, how fast time goes, and the metrics of the episode so far."""
    block.canvas.ellipse((*block.at(0, 4), *block.at(16, 20)), fill=colour(game.pilot))
    block.write(24, 12, game.pilots[game.pilot].title, 19, bold=True, room=BLOCK - 24)
    where = (
        "obstacles of your own"
        if game.own
        else f"{game.split}, set {game.index} of 0 to {len(game.layouts) - 1}"
    )
    pace = "paused" if game.paused else f"{STEPS_PER_SECOND * PACES[game.pace]:g} steps a second"
    block.write(0, 36, f"{pace} · {where}", fill=BORDER, room=BLOCK)
    columns = 2 if len(game.pilots) <= 6 else 3
    room = BLOCK / columns
    for number, pilot in enumerate(game.pilots[:10]):
        x, y = number % columns * room, 58 + number // columns * 19
        here = number == game.pilot
        block.box(x, y - 8, 17, 17, (*colour(number), 255 if here else 60))
        ink = WHITE if here and sum(colour(number)) < DARK else INK
        block.write(x + 8.5, y + 0.5, str(number), 12, bold=here, fill=ink, anchor="mm")
        block.write(x + 23, y + 0.5, pilot.name, 12, bold=here, room=room - 28)
    for number, (label, value) in enumerate(figures(game).items()):
        x, y = number % 2 * BLOCK / 2, 140 + number // 2 * 37
        block.write(x, y, label, 11, fill=BORDER)
        block.write(x, y + 15, value, 17, bold=True)


def figures(game: Game) -> dict[str, str]:
    """The metrics of the episode so far and the last step's reward, as label and value."""
    steps, shown = int(game.state.steps), {}
    for metric in METRICS.values():
        value = float(getattr(game.state, metric.column))
        label = f"{metric.label} {metric.unit}".strip()
        if metric.scale is None:
            shown[label] = f"{value:.2f}" if value % 1 else f"{value:.0f}"
        else:
            shown[label] = (
                f"{metric.scale * value / steps:.{1 if metric.scale > 1 else 2}f}" if steps else "-"
            )
    shown["reward, eq. (14)"] = f"{float(shown.pop('reward')):+.2f}"
    return shown | {"reward of the last step": f"{game.earned:+.2f}"}


def _grid(block: _Block, game: Game) -> None:
    """The 100 actions: turns from left to right as they turn, distances upwards, in 3D in each pitch; the
    next one outlined twice.
    """
    world, choice = game.world, game.choice
    actions = list(zip(*(part.tolist() for part in parts(world)), strict=True))
    angle, pitch, distance = actions[choice.action]
    turn = f"turn {angle:+d}°" if angle else "straight on"
    turn += f", nose {pitch:+d}°" if pitch else ""
    block.write(0, 8, f"{'Last' if game.ended else 'Next'} action: {turn}, {distance} px", 14, bold=True)
    columns = {one: number for number, one in enumerate(sorted({turn for turn, *_ in actions}, reverse=True))}
    rows = {
        one: number for number, one in enumerate(sorted({tuple(rest) for _, *rest in actions}, reverse=True))
    }
    left, top, width, height = 26.0, 24.0, 240 / len(columns), 210 / len(rows)
    shades = [UNKNOWN] * world.n_actions if choice.values is None else _shades(choice.values)
    if choice.values is None:
        shades[choice.action] = colour(game.pilot)
    for (one, *rest), fill in zip(actions, shades, strict=True):
        block.box(left + columns[one] * width, top + rows[tuple(rest)] * height, width - 2, height - 2, fill)
    x, y = left + columns[angle] * width, top + rows[pitch, distance] * height
    block.box(x - 3, y - 3, width + 4, height + 4, None, INK, 3)
    block.box(x, y, width - 2, height - 2, None, WHITE, 2)
    for one, number in columns.items():
        words, here = f"{one:+d}" if one else "0", one == angle
        middle = left + (number + 0.5) * width
        block.write(middle, top + len(rows) * height + 11, words, 11, here, INK if here else BORDER, "mm")
    ways, boxed = len(world.distances), in_3d(world)
    for number, (tilt, far) in enumerate(rows):
        if not boxed or not number % ways:  # of a pitch once
            words, here = (
                (f"{tilt:+d}" if tilt else "0", tilt == pitch) if boxed else (str(far), far == distance)
            )
            middle = top + (number + (ways if boxed else 1) / 2) * height
            block.write(left - 8, middle, words, 11, here, INK if here else BORDER, "rm")
    bottom = top + len(rows) * height + 29
    upwards = (
        f"↑ pitch [°], {', '.join(map(str, reversed(world.distances)))} px" if boxed else "↑ distance [px]"
    )
    block.write(left, bottom, f"← left   turn [°]   right →     {upwards}", 11, fill=BORDER)
    block.write(0, bottom + 21, f"nearest obstacle {game.clearance:.0f} px", 13)
    block.write(BLOCK, bottom + 21, f"a collision at {world.drone_radius:.0f}", 11, fill=BORDER, anchor="rm")
    if choice.values is not None:
        _scale(
            block, choice.values, choice.meaning, left + len(columns) * width + 10, top, len(rows) * height
        )


def _scale(block: _Block, values: torch.Tensor, meaning: str, x: float, top: float, height: float) -> None:
    """What the colours of the action grid mean."""
    for number, shade in enumerate(_viridis(torch.arange(255, 0, -8))):
        block.box(x, top + number * height / 32, 10, height / 32, shade)
    block.write(x + 15, top + 7, f"{float(values.max()):.3g}", 11)
    block.write(x + 15, top + height - 7, f"{float(values.min()):.3g}", 11)
    block.write(x + 15, top + height / 2, meaning.replace(" ", "\n"), 11, fill=BORDER)


def _shades(values: torch.Tensor) -> list[Ink]:
    """A colour for each action, from the lowest value to the highest."""
    low, high = float(values.min()), float(values.max())
    return _viridis(((values - low) / max(high - low, 1e-12) * 255).long())


def _viridis(places: torch.Tensor) -> list[Ink]:
    """Colours whose order anyone sees: places [n] of 0 to 255."""
    return [tuple(one) for one in colormaps["viridis"](places.numpy(), bytes=True)[:, :3].tolist()]


def _footer(block: _Block, game: Game, width: int) -> None:
    room = width / block.unit - 2 * MARGIN
    hints = "H: all keys · Space: pause · R: again · N: next set · Tab: next pilot · E: draw obstacles"
    message = problem(game) if game.circle else game.message
    block.write(MARGIN, 13, message or hints, 14, bool(message), INK if message else BORDER, room=room)


def _help(image: Image.Image, places: Places, size: tuple[int, int]) -> None:
    """Every key over a veil, as large as the window allows."""
    wide, high = 620, 24 * len(HELP) + 74
    unit = min(size[0] / (wide + 20), size[1] / (high + 20), 1.25 * places.unit)
    canvas = ImageDraw.Draw(image, "RGBA")
    canvas.rectangle((0, 0, *size), fill=(*GROUND, 170))
    corner = round((size[0] - wide * unit) / 2), round((size[1] - high * unit) / 2)
    block = _Block(canvas, corner, unit)
    block.box(0, 0, wide, high, (*WHITE, 250), BORDER, 2)
    block.write(24, 30, "Keys", 20, bold=True)
    block.write(wide - 24, 30, "H closes this", 13, fill=BORDER, anchor="rm")
    for number, (shown, does) in enumerate(HELP):
        block.write(24, 66 + 24 * number, shown, 14, bold=True)
        block.write(140, 66 + 24 * number, does, 14, room=wide - 164)
