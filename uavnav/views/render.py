"""The environment as a picture: one state as RGB, episodes side by side as a film, without a screen.

`uavnav render RUN... --out episode.gif` draws what trained policies do on the same layout.
"""

from __future__ import annotations

import functools
import io
import itertools
import math
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from uavnav import files
from uavnav.colours import OTHERS, PILOTS, colours, rgb
from uavnav.envs import drawing
from uavnav.envs.drawing import BORDER, GROUND, INK, OBSTACLE, SENSED, STEPS_PER_SECOND, Colour, Picture, font
from uavnav.errors import did_you_mean
from uavnav.evaluation import episodes
from uavnav.evaluation.scripted import task_of
from uavnav.runs import policies
from uavnav.runs.shipped import is_shipped
from uavnav.tasks import layouts as splits
from uavnav.tasks.baselines import BASELINES, AnyPolicy, suited
from uavnav.tasks.protocol import EPISODES
from uavnav.tasks.state import State, at
from uavnav.tasks.wrapper import WrappedTask

SUFFIXES = (".mp4", ".gif", ".png")
COLOURS = 128  # of a GIF
GAP = 8  # between episodes side by side [px]
WIDTHS = range(160, 3841)  # of one episode's picture [px]
MOST_STEPS = 100_000  # steps of an episode that is drawn: its states are kept
SLOWEST = Fraction(1, 100)  # pictures per second of a film
FASTEST_GIF = 50  # pictures per second: viewers slow shorter pauses than 0.02 s down


# -- episodes ------------------------------------------------------------------------------------------------


class Pilot(NamedTuple):
    """Who flies: a policy, in its task, with the generator of its seed."""

    name: str
    policy: AnyPolicy
    task: WrappedTask
    seed: int = 0

    @property
    def kind(self) -> str:
        """Its algorithm, or the name of a scripted policy: by this it has its colour."""
        return self.policy.algorithm if isinstance(self.policy, policies.Policy) else self.name

    @property
    def mode(self) -> str:
        """`greedy` or `sampled`; nothing of a scripted policy."""
        return self.policy.mode if isinstance(self.policy, policies.Policy) else ""

    @property
    def title(self) -> str:
        return f"{self.name}, {self.mode}" if self.mode else self.name


class Episode(NamedTuple):
    """One episode: its states, the first and the last included, and how it ended."""

    pilot: Pilot
    states: list[State]
    ended: str  # collided, arrived, or nothing at the time limit


def load_pilots(
    words: Sequence[str],
    seed: int | None = None,
    greedy: bool = False,
    activation: str | None = None,
    task: str = "drone",
) -> list[Pilot]:
    """Runs' folders, zips, or names of scripted policies, as pilots; named by the last two parts of the path.

    activation: of the zips' hidden layers; task: that scripted policies fly, where no run is named.

    Raises:
        PolicyError: no such run or seed, or an activation and no .zip.
        ValueError: there is no such task, one beside a run, or the runs fly layouts of several.
    """
    zips, scripted = policies.zips(words, activation), task_of(task)
    trained = {
        word: policies.load_policy(word, seed, greedy, activation if word in zips else None)
        for word in words
        if word not in BASELINES
    }
    if trained and task != "drone":
        raise ValueError(f"--task {task}: what was trained flies in its own task; leave it out")
    if len(kinds := {splits.kind_of(one.world) for one in trained.values()}) > 1:
        raise ValueError(
            f"runs of task={' and task='.join(sorted(kinds))} have no layout in common; give those of one"
        )
    beside = next((one.task for one in trained.values()), scripted)
    pilots = []
    for word in words:
        if word in BASELINES:
            pilots.append(Pilot(word, suited(BASELINES[word], beside), beside))
        else:
            name = word if is_shipped(word) else "/".join(Path(word).resolve().parts[-2:])
            pilots.append(Pilot(name, trained[word], trained[word].task, trained[word].seed))
    return pilots


def fly(pilot: Pilot, layouts: Tensor, layout: int, max_steps: int) -> Episode:
    """One episode of a policy on one layout: the very episode that an evaluation of 200 layouts counts.

    Sampled actions of one episode follow others, as an evaluation flies its layouts as one batch.
    """
    task = pilot.task.on(layouts[: max(EPISODES, layout + 1)], max_steps)
    states = [at(episodes.start(task, [pilot.seed]), layout)]
    for step in episodes.steps([(pilot.seed, pilot.policy)], task):
        mine = step.place[step.episode == layout].squeeze()
        states.append(at(step.states, mine))
        if step.outcomes.terminated[mine] or step.outcomes.truncated[mine]:
            arrived = "arrived" if step.outcomes.terminated[mine] else ""
            hit = step.outcomes.clearance[mine] <= task.world.drone_radius
            return Episode(pilot, states, "collided" if hit else arrived)
    raise AssertionError("every episode ends at its time limit")


class Film(Sequence[Picture]):
    """Episodes on the same layout, side by side, with their trails: drawn when they are asked for.

    obstacles: a layout, such as [K, 3] px; width: of one episode's picture [px]; every: steps between
    two. The last one is of the longest episode. An episode that is over stands still.
    """

    def __init__(self, episodes: Sequence[Episode], obstacles: Tensor, width: int, every: int = 1) -> None:
        self.episodes, self.obstacles, self.width = episodes, obstacles, width
        self.colours = [rgb(one) for one in colours(episode.pilot.kind for episode in episodes)]
        axes = [axis for axis in "xyz" if hasattr(episodes[0].states[0], axis)]
        self._trails = [
            [tuple(float(getattr(state, axis)) for axis in axes) for state in episode.states]
            for episode in episodes
        ]
        self._panel = functools.lru_cache(len(episodes))(self._draw)  # what stands still is drawn once
        last = max(len(episode.states) for episode in episodes) - 1
        self.steps = [*range(0, last, every), last]

    def __len__(self) -> int:
        return len(self.steps)

    def __getitem__(self, index: int) -> Picture:  # type: ignore[override] # nobody slices a film
        step = self.steps[index]
        panels = [
            self._panel(number, min(step, len(episode.states) - 1))
            for number, episode in enumerate(self.episodes)
        ]
        columns = len(panels) if len(panels) <= 3 else math.ceil(math.sqrt(len(panels)))
        rows = math.ceil(len(panels) / columns)
        width, height = panels[0].width + GAP, panels[0].height + GAP
        picture = Image.new("RGB", (columns * width - GAP, rows * height - GAP), GROUND)
        for number, panel in enumerate(panels):
            picture.paste(panel, (number % columns * width, number // columns * height))
        return np.asarray(picture)

    def _draw(self, number: int, step: int) -> Image.Image:
        episode, colour = self.episodes[number], self.colours[number]
        state, trail = episode.states[step], self._trails[number][: step + 1]
        task = episode.pilot.task.replace(layouts=self.obstacles[None])
        here = state._replace(layout=torch.tensor(0))
        arena = drawing.draw_arena(here, task, self.width, [(trail, colour)], colour)
        ended = episode.ended if step == len(episode.states) - 1 else ""
        strip = _caption(self.width, episode.pilot, state, ended, colour)
        panel = Image.new("RGB", (self.width, arena.height + strip.height))
        panel.paste(arena, (0, 0))
        panel.paste(strip, (0, arena.height))
        return panel


def _caption(width: int, pilot: Pilot, state: State, ended: str, colour: Colour) -> Image.Image:
    """A line below an episode: who flies, greedy or sampled, and how far it is."""
    size = max(8, width // 32)
    strip = Image.new("RGB", (width, 2 * size), GROUND)
    canvas = ImageDraw.Draw(strip)
    canvas.ellipse((size // 2, size // 2, size // 2 + size, size // 2 + size), fill=colour)
    steps, reward = int(state.steps), f"{float(state.reward):.2f}"
    told = [f"step {steps}   reward {reward}", f"{steps}   {reward}"]
    # the first that leaves room for the name
    for counts in [f"{ended} at {told[0]}", *told] if ended else told:
        room = width - 3 * size - canvas.textlength(f"{counts} {pilot.mode}", font(size))
        if room > 3 * size:
            break
    name = pilot.name
    while name and canvas.textlength(name, font(size, bold=True)) > room:
        name = f"…{name.lstrip('…')[1:]}" if name != "…" else ""
    canvas.text((2 * size, size), name, INK, font(size, bold=True), anchor="lm")
    if pilot.mode:
        after = 2 * size + canvas.textlength(f"{name} ", font(size, bold=True))
        canvas.text((after, size), pilot.mode, INK, font(size), anchor="lm")
    canvas.text(
        (width - size // 2, size), counts, SENSED if ended == "collided" else INK, font(size), anchor="rm"
    )
    return strip


# -- files ---------------------------------------------------------------------------------------------------


def check_picture(path: Path, rate: Fraction) -> str:
    """The kind of a file by its name; a ValueError where it takes no pictures at that rate."""
    kind = path.suffix.lower()
    if kind not in SUFFIXES:
        raise ValueError(f"{path}{did_you_mean(kind, SUFFIXES)}: choose an .mp4, .gif or .png file")
    if kind == ".mp4":
        _pyav()
    bound = ""
    if kind == ".gif" and rate > FASTEST_GIF:
        bound = f"a GIF shows {FASTEST_GIF} at most: draw fewer (--every) or choose .mp4"
    elif kind != ".png" and rate < SLOWEST:
        bound = f"a film shows {float(SLOWEST):g} at least: draw more (a lower --every)"
    if bound:
        raise ValueError(f"{float(rate):g} pictures per second, {bound}")
    return kind


def save(frames: Sequence[Picture], path: Path, fps: float | Fraction = STEPS_PER_SECOND) -> None:
    """Write pictures as MP4 or GIF, or the last one as PNG; the file is whole or not there.

    fps: pictures per second. An MP4's odd width or height gains a column or a row of its edge. Raises a
    ValueError as `check_picture` does.
    """
    rate = Fraction(fps).limit_denominator(1000)
    kind = check_picture(path, rate)
    if kind == ".png":
        content = io.BytesIO()
        Image.fromarray(frames[-1]).save(content, "PNG")
    else:
        content = (_mp4 if kind == ".mp4" else _gif)(frames, rate)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        files.write(path, content.getvalue())
    except OSError as error:
        raise ValueError(f"{path}: cannot be written ({error}); give a path that can be written") from error


def _gif(frames: Sequence[Picture], rate: Fraction) -> io.BytesIO:
    """An animated GIF in few colours. Its clock counts hundredths of a second: pauses differ by one."""
    palette = _palette(frames)
    ticks = [round(100 * index / rate) for index in range(len(frames) + 1)]
    pauses = [10 * (later - now) for now, later in itertools.pairwise(ticks)]
    indexed = (Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    content = io.BytesIO()
    next(indexed).save(content, "GIF", save_all=True, append_images=indexed, duration=pauses, loop=0)
    return content


def _palette(frames: Sequence[Picture]) -> Image.Image:
    """The colours of a GIF: those that things are drawn in, and the rest from five pictures of the film."""
    own = list(dict.fromkeys((GROUND, BORDER, OBSTACLE, INK, SENSED, *map(rgb, (*PILOTS.values(), *OTHERS)))))
    spread = [frames[round(index * (len(frames) - 1) / 4)][::2, ::2] for index in range(5)]
    mixed = Image.fromarray(np.concatenate(spread)).quantize(COLOURS - len(own)).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette([*itertools.chain(*own), *mixed])
    return palette


def _mp4(frames: Sequence[Picture], rate: Fraction) -> io.BytesIO:
    """H.264 as every player reads it."""
    av, content = _pyav(), io.BytesIO()
    height, width = frames[0].shape[:2]
    with av.open(content, "w", format="mp4") as film:
        stream = film.add_stream("libx264", rate=rate, options={"crf": "20", "preset": "veryfast"})
        stream.width, stream.height, stream.pix_fmt = width + width % 2, height + height % 2, "yuv420p"
        for frame in frames:
            padded = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
            film.mux(stream.encode(av.VideoFrame.from_ndarray(padded, format="rgb24")))
        film.mux(stream.encode(None))
    return content


def _pyav() -> Any:
    try:
        import av
    except ImportError as error:
        raise ValueError("an MP4 needs PyAV: pip install 'uavnav[play]', or choose a .gif") from error
    return av
