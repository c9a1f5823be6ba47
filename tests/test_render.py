"""Pictures: things are where they should be, in their colours, and episodes become files."""

import functools
import itertools
import math
import sys
from fractions import Fraction

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw

import uavnav
from uavnav.cli import commands
from uavnav.envs.drawing import BORDER, DRONE, GROUND, OBSTACLE, SENSED, draw_state
from uavnav.evaluation.episodes import start
from uavnav.tasks.baselines import BASELINES, straight_ahead
from uavnav.tasks.faults import Faults
from uavnav.tasks.state import at
from uavnav.tasks.table import EMPTY, make_task
from uavnav.tasks.world import World
from uavnav.views import render
from uavnav.views.render import Film, Pilot, fly

render_command = functools.partial(commands.run, "render")

WORLD = World()


def state(x, y, heading):
    start = make_task(EMPTY).start(torch.tensor(0), torch.tensor(heading))
    return start._replace(x=torch.tensor(float(x)), y=torch.tensor(float(y)))


def colour(picture, x, y):
    """At a point of the world: y upwards."""
    return tuple(int(part) for part in picture[round(WORLD.height - 1 - y), round(x)])


def test_the_picture_is_the_window_with_y_upwards():
    layouts = torch.tensor([[[100.0, 500.0, 40.0]]])
    picture = draw_state(state(600, 150, 90), make_task(layouts))
    assert picture.shape == (600, 800, 3)
    assert picture.dtype == np.uint8
    assert colour(picture, 100, 500) == OBSTACLE
    assert colour(picture, 100, 100) == GROUND
    assert colour(picture, 610, 140) == DRONE
    for x, y in ((5, 5), (795, 5), (5, 595), (795, 595), (410, 5), (5, 310)):
        assert colour(picture, x, y) == BORDER


@pytest.mark.parametrize("heading", [0, 45, 90, 200])
def test_the_sensors_arc_lies_in_front_of_the_drone(heading):
    picture = draw_state(state(400, 300, heading), make_task(EMPTY))
    for offset, inside in ((0, True), (80, True), (-80, True), (100, False), (180, False)):
        angle = math.radians(heading + offset)
        shade = colour(picture, 400 + 90 * math.cos(angle), 300 + 90 * math.sin(angle))
        assert (shade != GROUND) == inside


def standing(observation, generator=None):
    return torch.zeros(len(observation), dtype=torch.int64)


def episode(policy=straight_ahead, steps=1000, k=0):
    layouts = uavnav.layouts.generate(1, k=k)
    return fly(Pilot("a pilot", policy, make_task(EMPTY)), layouts, 0, steps), layouts[0]


def film(*policies, steps=30, width=160, every=1):
    flown = [episode(policy, steps) for policy in policies]
    return Film([one for one, _ in flown], flown[0][1], width, every)


def test_straight_ahead_collides_in_step_28_and_its_trail_is_drawn():
    flown, obstacles = episode()
    assert len(flown.states) == 28 + 1  # contact at 300 + 250 px: ceil(250 / 9) steps, and the start
    assert flown.ended == "collided"
    frames = Film([flown], obstacles, 800, every=10)
    assert len(frames) == 4
    assert frames.colours == [(204, 121, 167)]  # the first of others
    assert colour(frames[-1][:600], 400, 350) == frames.colours[0]
    assert colour(frames[0][:600], 400, 350) != frames.colours[0]


def test_an_episode_to_a_goal_ahead_has_arrived_and_one_that_is_cut_off_has_not():
    task = make_task(torch.tensor([[[400.0, 520.0, 180.0]]]), task="goal")
    ends = [fly(Pilot("a pilot", straight_ahead, task), task.layouts, 0, steps).ended for steps in (100, 5)]
    assert ends == ["arrived", ""]


def test_two_episodes_are_480_px_wide_each_with_a_gap_of_8_and_the_one_that_is_over_stands_still():
    frames = film(straight_ahead, standing, steps=40, width=480)
    assert len(frames) == 41
    height, width, _ = frames[0].shape
    assert (width, height) == (2 * 480 + 8, 360 + 30)
    assert (frames[28][:, :480] == frames[40][:, :480]).all()
    assert not (frames[28][360:, 488:] == frames[40][360:, 488:]).all()  # its caption counts on
    assert tuple(frames[5][180, 488 + 240 + 9]) == frames.colours[1]


@pytest.mark.parametrize(("n", "columns", "rows"), [(1, 1, 1), (3, 3, 1), (4, 2, 2), (5, 3, 2)])
def test_up_to_three_episodes_are_in_a_row_and_four_are_two_by_two(n, columns, rows):
    height, width, _ = film(*[standing] * n, steps=1)[0].shape
    assert (width, height) == (columns * 168 - 8, rows * (120 + 16 + 8) - 8)


@pytest.mark.parametrize(("width", "size"), [(160, (328, 136)), (161, (330, 138))])
def test_an_mp4_decodes_to_31_pictures_of_an_even_size_at_30_a_second(tmp_path, width, size):
    av = pytest.importorskip("av")
    frames = film(straight_ahead, standing, steps=30, width=width)
    render.save(frames, tmp_path / "a.mp4")
    with av.open(str(tmp_path / "a.mp4")) as read:
        assert read.streams.video[0].average_rate == 30
        decoded = [frame.to_ndarray(format="rgb24") for frame in read.decode(video=0)]
    assert len(decoded) == 31
    assert decoded[0].shape == (size[1], size[0], 3)
    shown = frames[30]
    differences = np.abs(decoded[30][: len(shown), : shown.shape[1]].astype(int) - shown)
    assert differences.mean() < 4  # H.264 loses a little


def test_a_gif_keeps_31_pictures_of_a_drone_that_stands_still_and_the_simulations_time(tmp_path):
    frames = film(standing, steps=30)
    render.save(frames, tmp_path / "a.gif")
    pauses = []
    with Image.open(tmp_path / "a.gif") as image:
        assert image.n_frames == 31
        assert image.size == (160, 136)
        for index in range(31):
            image.seek(index)
            pauses.append(image.info["duration"])
            difference = np.abs(np.asarray(image.convert("RGB")).astype(int) - frames[index])
            assert difference.mean() < 2  # 128 colours
    assert set(pauses) == {30, 40}
    assert sum(pauses) == pytest.approx(31 * 1000 / 30, abs=5)


def test_a_png_is_the_last_picture(tmp_path):
    frames = film(straight_ahead, standing)
    render.save(frames, tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as image:
        assert (np.asarray(image) == frames[-1]).all()


def test_an_mp4_without_pyav_is_refused(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ValueError, match=r"pip install 'uavnav\[play\]', or choose a .gif"):
        render.save(film(standing, steps=2), tmp_path / "a.mp4")
    assert not list(tmp_path.iterdir())


def test_the_first_picture_of_a_gif_has_the_sensed_points_colour_though_the_last_senses_none(tmp_path):
    layouts = uavnav.layouts.load("test")
    frames = Film(
        [fly(Pilot("reactive", BASELINES["reactive"], make_task(EMPTY)), layouts, 26, 60)], layouts[26], 480
    )
    first, last = ((frames[index] == SENSED).all(-1) for index in (0, -1))
    assert first.sum() == 35
    assert not last.any()
    render.save(frames, tmp_path / "a.gif")
    with Image.open(tmp_path / "a.gif") as image:
        shown = np.asarray(image.convert("RGB"))
    assert (shown[first] == SENSED).all()
    drone = (frames[0] == frames.colours[0]).all(-1)
    assert drone.any()
    assert (shown[drone] == frames.colours[0]).all()
    assert (shown[(frames[0] == OBSTACLE).all(-1)] == OBSTACLE).all()


def sizes(path):
    """The width and height of each picture in a film."""
    if path.suffix == ".gif":
        with Image.open(path) as image:
            return [image.size for index in range(image.n_frames) if image.seek(index) is None]
    with pytest.importorskip("av").open(str(path)) as read:
        return [(frame.width, frame.height) for frame in read.decode(video=0)]


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_what_is_written_for_500_steps_is_500_pictures_and_the_last(suffix, tmp_path):
    render.save(film(standing, steps=500), tmp_path / f"a{suffix}")
    assert sizes(tmp_path / f"a{suffix}") == [(160, 136)] * 501


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_a_film_shows_a_picture_in_100_seconds_and_no_slower(suffix, tmp_path):
    render.save(film(standing, steps=2), tmp_path / f"a{suffix}", Fraction(1, 100))
    assert len(sizes(tmp_path / f"a{suffix}")) == 3
    with pytest.raises(
        ValueError, match=r"^0\.009 pictures per second, a film shows 0\.01 at least: draw more"
    ):
        render.save(film(standing, steps=2), tmp_path / f"b{suffix}", 0.009)


def test_a_suffix_may_be_in_capitals(tmp_path):
    render.save(film(standing, steps=2), tmp_path / "A.GIF")
    assert sizes((tmp_path / "A.GIF").rename(tmp_path / "a.gif")) == [(160, 136)] * 3


@pytest.fixture(scope="module")
def run(trained):
    return trained("ppo")


def test_the_command_flies_a_run_beside_a_scripted_policy_and_draws_every_third_step(run, tmp_path, capsys):
    path = tmp_path / "episode.gif"
    words = [str(run.path), "reactive", "--steps", "30", "--every", "3", "--out", str(path)]
    assert render_command(words) == 0
    first, second, last = capsys.readouterr().out.splitlines()
    assert first.startswith(f"{run.path.parent.name}/run, sampled: ")
    assert second.startswith("reactive: 30 steps, ")
    assert last == f"wrote {path}"
    with Image.open(path) as image:
        assert image.n_frames == 11
        assert image.size == (968, 390)
        assert image.info["duration"] == 100  # three steps at 30 a second


def test_with_faults_reactive_flies_the_60_steps_that_an_evaluation_with_them_has_and_they_are_told(
    tmp_path, capsys
):
    words = ["reactive", "--layout", "3", "--steps", "60", "--faults", "noise=20,sticky=0.5"]
    assert render_command([*words, "--out", str(tmp_path / "a.png")]) == 0
    faults = Faults(noise=20, sticky=0.5)
    row, plain = (
        uavnav.evaluate_policy(BASELINES["reactive"], max_steps=60, faults=one).iloc[3]
        for one in (faults, None)
    )
    told = (
        f"noise=20,sticky=0.5 reactive: {row['steps']} steps, {row['distance']} px, reward "
        f"{row['reward']:.2f}"
    )
    assert capsys.readouterr().out.startswith(told)
    assert row["distance"] != plain["distance"]


@pytest.mark.parametrize("width", [160, 320, 480])
@pytest.mark.parametrize("name", ["ppo/tanh", "a-long-name-of-a-folder/leaky_relu"])
def test_the_words_of_a_caption_do_not_meet(width, name, run, monkeypatch):
    spans, original = [], ImageDraw.ImageDraw.text

    def text(self, xy, words, *rest, anchor="la", **how):
        left, _, right, _ = self.textbbox(xy, words, font=rest[1], anchor=anchor)
        spans.append((left, right, words))
        return original(self, xy, words, *rest, anchor=anchor, **how)

    policy = uavnav.load_policy(run.path, greedy=False)
    state = at(start(policy.task.on(uavnav.layouts.load("test")[:1], 10)), 0)
    monkeypatch.setattr(ImageDraw.ImageDraw, "text", text)
    late = state._replace(steps=torch.tensor(9312), reward=torch.tensor(-101.23))
    render._caption(width, Pilot(name, policy, policy.task), late, True, render.INK)
    spans.sort()
    assert "sampled" in [words for *_, words in spans]
    assert all(right <= left for (_, right, _), (left, _, _) in itertools.pairwise(spans))
    assert spans[-1][1] <= width


@pytest.mark.parametrize(("words", "mode"), [([], "sampled"), (["--greedy"], "greedy")])
def test_the_caption_and_the_printed_line_say_greedy_or_sampled_and_sampled_is_the_default(
    run, words, mode, tmp_path, capsys, monkeypatch
):
    captions, original = [], ImageDraw.ImageDraw.text

    def text(self, xy, words, *rest, **how):
        captions.append(words)
        return original(self, xy, words, *rest, **how)

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", text)
    command = [str(run.path), "straight", *words, "--steps", "2", "--out", str(tmp_path / "episode.png")]
    assert render_command(command) == 0
    name = f"{run.path.parent.name}/run"
    first, second, _ = capsys.readouterr().out.splitlines()
    assert first.startswith(f"{name}, {mode}: 2 steps, ")
    assert second.startswith("straight: 2 steps, 18 px, ")
    assert [word for word in captions if not word.startswith("step ")] == [name, mode, "straight"]


def test_a_run_that_is_spelt_wrongly_is_the_nearest_folder_beside_it(run, capsys):
    assert render_command([str(run.path.parent / "rum")]) == 2
    assert f"give the folder of a finished run (did you mean {run.path}?)\n" in capsys.readouterr().err
