"""Draw docs/episode.gif: episodes on the same obstacles, and their rewards below (`python docs/film.py RUN
...`).
"""

from __future__ import annotations

import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from uavnav.envs.drawing import GROUND, INK, STEPS_PER_SECOND, Picture
from uavnav.tasks.layouts import load
from uavnav.views.render import Episode, Film, fly, load_pilots, save

LAYOUT, STEPS, EVERY, SPEED, WIDTH = 56, 600, 6, 4, 280
DPI, HEIGHT = 100, 170


def curves(episodes: list[Episode], film: Film) -> list[Picture]:
    """Each episode's reward so far, a picture for each of the film's."""
    width = film[0].shape[1]
    figure = Figure((width / DPI, HEIGHT / DPI), dpi=DPI, layout="constrained", facecolor=colour(GROUND))
    canvas, axes = FigureCanvasAgg(figure), figure.subplots()
    rewards = [[float(state.reward) for state in episode.states] for episode in episodes]
    axes.set(xlabel="step", ylabel="reward so far", xlim=(0, film.steps[-1]), facecolor=colour(GROUND))
    axes.set_ylim(min(map(min, rewards)) - 1, max(map(max, rewards)) + 1)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=colour(INK), labelsize=8)
    lines = [axes.plot([], color=colour(one), linewidth=2)[0] for one in film.colours]
    pictures = []
    for step in film.steps:
        for line, own in zip(lines, rewards, strict=True):
            line.set_data(range(len(own[: step + 1])), own[: step + 1])
        canvas.draw()
        pictures.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    return pictures


def colour(rgb: tuple[int, int, int]) -> tuple[float, ...]:
    """As matplotlib takes it."""
    return tuple(part / 255 for part in rgb)


def main(words: list[str]) -> None:
    """Fly, draw, write."""
    layouts = load("test")
    episodes = [fly(pilot, layouts, LAYOUT, STEPS) for pilot in load_pilots(words)]
    film = Film(episodes, layouts[LAYOUT], WIDTH, EVERY)
    pictures = [np.vstack(both) for both in zip(film, curves(episodes, film), strict=True)]
    out = Path(__file__).parent / "episode.gif"
    save(pictures, out, Fraction(SPEED * STEPS_PER_SECOND, EVERY))
    for episode in episodes:
        last = episode.states[-1]
        print(f"{episode.pilot.title}: {int(last.steps)} steps, reward {float(last.reward):.2f}")


if __name__ == "__main__":
    main(sys.argv[1:])
