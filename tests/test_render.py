"""Pictures: things are where they should be, in their colours, and flights become files."""

import math

import numpy as np
import pytest
import torch
from PIL import Image

import uavnav
from uavnav import ppo, render, simulator
from uavnav.render import BORDER, DRONE, GROUND, OBSTACLE, draw_state, fly, pictures
from uavnav.simulator import State
from uavnav.world import World

WORLD = World()


def state(x, y, heading):
    start = simulator.start(torch.tensor(0), torch.tensor(heading), WORLD)
    return start._replace(x=torch.tensor(float(x)), y=torch.tensor(float(y)))


def colour(picture, x, y):
    """At a point of the world: y upwards."""
    return tuple(int(part) for part in picture[round(WORLD.height - 1 - y), round(x)])


def test_the_picture_is_the_window_with_y_upwards():
    bank = torch.tensor([[[100.0, 500.0, 40.0]]])
    picture = draw_state(state(600, 150, 90), bank, WORLD)
    assert picture.shape == (600, 800, 3)
    assert picture.dtype == np.uint8
    assert colour(picture, 100, 500) == OBSTACLE
    assert colour(picture, 100, 100) == GROUND
    assert colour(picture, 610, 140) == DRONE
    for x, y in ((5, 5), (795, 5), (5, 595), (795, 595), (410, 5), (5, 310)):
        assert colour(picture, x, y) == BORDER


@pytest.mark.parametrize("heading", [0, 45, 90, 200])
def test_the_sensors_arc_lies_in_front_of_the_drone(heading):
    picture = draw_state(state(400, 300, heading), torch.zeros(1, 0, 3), WORLD)
    for offset, inside in ((0, True), (80, True), (-80, True), (100, False), (180, False)):
        angle = math.radians(heading + offset)
        shade = colour(picture, 400 + 90 * math.cos(angle), 300 + 90 * math.sin(angle))
        assert (shade != GROUND) == inside


def test_a_flight_is_drawn_with_its_trail_and_ends_with_the_collision():
    bank = uavnav.layouts.generate(1, k=0)
    states = fly(lambda observation: torch.tensor(9), bank, 0, 1000, WORLD)
    assert len(states) == 28 + 1  # contact at 300 + 250 px: ceil(250 / 9) steps, and the start
    assert isinstance(states[-1], State)
    frames = list(pictures(states, bank, WORLD, every=10))
    assert len(frames) == 4
    assert colour(frames[-1], 400, 350) == render.TRAIL


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    config = ppo.PPOConfig(total_frames=256, frames_per_batch=256, compile="off")
    return ppo.train(config, out=tmp_path_factory.mktemp("render") / "run", quiet=True)


def test_the_command_writes_a_gif_with_a_frame_for_every_third_step(run, tmp_path, capsys):
    path = tmp_path / "flight.gif"
    assert render.main([str(run.path), "--sampled", "--out", str(path), "--steps", "30"]) == 0
    steps = int(capsys.readouterr().out.split(": ")[1].split()[0])
    with Image.open(path) as image:
        assert image.n_frames == -(-steps // 3) + 1
        assert image.size == (480, 360)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "no policy.safetensors there"),
        (["RUN", "--out", "flight.bmp"], "choose a .gif or .png file"),
        (["RUN", "--layout", "1000"], "--layout 1000: choose from 0 to 999"),
        (["RUN", "--steps", "0"], "at least 1"),
        (["RUN", "--seed", "9"], "seed=9 is not there"),
        (["RUN", "--layouts", "nowhere"], "no such bank"),
        (["RUN", "--out", "/nowhere/flight.png", "--steps", "2"], "No such file or directory"),
    ],
)
def test_a_wrong_word_is_one_line_and_status_2(run, arguments, message, capsys):
    assert render.main([str(run.path) if word == "RUN" else word for word in arguments]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert err.count("\n") == 1
