"""The world as a picture: one state as RGB, a flight as an animation, without a screen.

`python -m uavnav.render RUN --out flight.gif` draws a flight of a trained policy.
"""

from __future__ import annotations

import argparse
import io
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from uavnav import layouts as banks
from uavnav import policies, simulator
from uavnav.dynamics import direction
from uavnav.sensing import sense
from uavnav.simulator import UP, State
from uavnav.world import World

Picture = np.ndarray[Any, np.dtype[np.uint8]]

# Okabe and Ito's colours, which people with any colour vision tell apart.
GROUND, BORDER, OBSTACLE = (250, 250, 247), (84, 88, 96), (150, 156, 166)
DRONE, SENSOR, SENSED, TRAIL = (0, 114, 178), (86, 180, 233, 56), (213, 94, 0), (0, 158, 115)
SMOOTHING = 2  # drawn so many times larger, then scaled down


def draw_state(state: State, bank: Tensor, world: World, trail: Sequence[tuple[float, float]] = ()) -> Picture:
    """One row's state: the border, its obstacles, the drone with its sensor's arc, and the points that it senses.

    state: fields without a batch; bank [L, K, 3] px; trail: earlier positions (x, y) px.

    Returns:
        Array [height, width, 3] uint8. This is the one place where y is flipped.
    """
    obstacles = bank[state.layout]
    slots, _ = sense(state.x, state.y, state.heading, obstacles, world)
    x, y, heading = float(state.x), float(state.y), int(state.heading)
    image = Image.new("RGB", (world.width * SMOOTHING, world.height * SMOOTHING), GROUND)
    canvas = ImageDraw.Draw(image, "RGBA")

    def at(px: float, py: float) -> tuple[float, float]:
        return px * SMOOTHING, (world.height - py) * SMOOTHING

    def disc(px: float, py: float, radius: float) -> tuple[float, float, float, float]:
        (left, top), (right, bottom) = at(px - radius, py + radius), at(px + radius, py - radius)
        return left, top, right, bottom

    for px, py, radius in obstacles.tolist():
        canvas.ellipse(disc(px, py, radius), fill=OBSTACLE)
    for left in range(0, world.width, world.border):
        for bottom in range(0, world.height, world.border):
            if left in (0, world.width - world.border) or bottom in (0, world.height - world.border):
                corners = (*at(left, bottom + world.border), *at(left + world.border, bottom))
                canvas.rectangle(corners, fill=BORDER, outline=GROUND)
    half = world.sensor_arc / 2
    canvas.pieslice(disc(x, y, world.sensor_radius), -heading - half, -heading + half, fill=SENSOR)
    if len(trail) > 1:
        canvas.line([at(*point) for point in trail], fill=TRAIL, width=2 * SMOOTHING)
    canvas.ellipse(disc(x, y, world.drone_radius), fill=DRONE)
    cosine, sine = (float(part) for part in direction(state.heading))
    nose = at(x + world.drone_radius * cosine, y + world.drone_radius * sine)
    canvas.line([at(x, y), nose], fill=GROUND, width=3 * SMOOTHING)
    for right, forward, proximity in slots.tolist():
        if (right, forward) != (0, 0):
            reach = world.drone_radius + proximity * (world.sensor_radius - world.drone_radius)
            dx, dy = right * sine + forward * cosine, forward * sine - right * cosine
            canvas.ellipse(disc(x + reach * dx, y + reach * dy, 4), fill=SENSED)
    return np.asarray(image.reduce(SMOOTHING))


def fly(policy: Callable[[Tensor], Tensor], bank: Tensor, layout: int, max_steps: int, world: World) -> list[State]:
    """One episode of a policy on one set of obstacles: its states, the first and the last included."""
    state = simulator.start(torch.tensor(layout), torch.tensor(UP), world)
    states = [state]
    for _ in range(max_steps):
        observation, _ = simulator.observe(state, bank, world)
        state, outcome = simulator.step(state, policy(observation), bank, world, "eq14", None)
        states.append(state)
        if outcome.terminated:
            break
    return states


def pictures(states: Sequence[State], bank: Tensor, world: World, every: int = 1) -> Iterable[Picture]:
    """Each `every`-th state of a flight with the trail up to it, and the last one."""
    positions = [(float(state.x), float(state.y)) for state in states]
    for index in [*range(0, len(states) - 1, every), len(states) - 1]:
        yield draw_state(states[index], bank, world, positions[: index + 1])


def check_name(path: Path) -> None:
    """Raises ValueError for the name of a file that is neither a GIF nor a PNG."""
    if path.suffix not in (".gif", ".png"):
        raise ValueError(f"{path}: choose a .gif or .png file")


def save(frames: Iterable[Picture], path: Path, fps: float, width: int) -> None:
    """Write an animated GIF, or the last picture as PNG, scaled to a width in px; the file is whole or not there.

    Raises:
        ValueError: the file is neither, or cannot be written.
    """
    check_name(path)
    images = [Image.fromarray(frame) for frame in frames]
    size = (width, round(images[0].height * width / images[0].width))
    images = [image.resize(size, Image.Resampling.LANCZOS) for image in images]
    content = io.BytesIO()
    if path.suffix == ".gif":
        palette = images[-1].quantize(64)
        indexed = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
        pause = round(1000 / fps)
        indexed[0].save(content, "GIF", save_all=True, append_images=indexed[1:], duration=pause, loop=0)
    else:
        images[-1].save(content, "PNG")
    aside = path.with_name(f".{path.name}.aside")
    try:
        try:
            aside.write_bytes(content.getvalue())
            os.replace(aside, path)
        finally:
            aside.unlink(missing_ok=True)
    except OSError as error:
        raise ValueError(f"{path}: cannot be written ({error}); give a path that can be written") from error


def main(argv: list[str] | None = None) -> int:
    """Draw a flight of a trained policy as an animated GIF, or its whole trail as PNG."""
    parser = argparse.ArgumentParser(prog="python -m uavnav.render", description=main.__doc__)
    parser.add_argument("run", type=Path, help="a run's folder")
    parser.add_argument(
        "--out", type=Path, default=Path("flight.gif"), help="a .gif or .png file (default: flight.gif)"
    )
    parser.add_argument("--seed", type=int, help="training seed (default: the run's first)")
    parser.add_argument("--sampled", action="store_true", help="act as in training instead of greedily")
    parser.add_argument("--layouts", default="test", help="train, test or a bank's path (default: test)")
    parser.add_argument("--layout", type=int, default=0, help="index of the obstacle set (default: 0)")
    parser.add_argument("--steps", type=int, default=500, help="steps at most (default: 500)")
    parser.add_argument("--every", type=int, default=3, help="steps from one picture to the next (default: 3)")
    parser.add_argument("--width", type=int, default=480, help="width in px (default: 480)")
    arguments = parser.parse_args(argv)
    try:
        check_name(arguments.out)
        if min(arguments.steps, arguments.every, arguments.width) < 1:
            raise ValueError("--steps, --every and --width are at least 1")
        policy = policies.load_policy(arguments.run, arguments.seed, greedy=not arguments.sampled)
        bank = banks.load(arguments.layouts)
        if not 0 <= arguments.layout < len(bank):
            raise ValueError(f"--layout {arguments.layout}: choose from 0 to {len(bank) - 1}")
        world = policy.world
        generator = torch.Generator().manual_seed(0)
        states = fly(lambda observation: policy(observation, generator), bank, arguments.layout, arguments.steps, world)
        save(pictures(states, bank, world, arguments.every), arguments.out, 30, arguments.width)
    except ValueError as error:
        print(f"uavnav.render: {error}", file=sys.stderr)
        return 2
    last = states[-1]
    print(f"wrote {arguments.out}: {int(last.steps)} steps, {int(last.distance)} px, reward {float(last.reward):.2f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
