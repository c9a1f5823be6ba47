"""The live window: its picture at any size, and the command that opens it."""

import numpy as np
import pandas as pd
import pytest
from playing import STRAIGHT, WORLD, fly, new, opened, press, pygame

from uavnav.algorithms import ALGORITHMS, ppo
from uavnav.cli import commands, play
from uavnav.envs import drawing
from uavnav.runs.metrics import METRICS, per_seed
from uavnav.tasks import layouts
from uavnav.views import render
from uavnav.views.window import game as rules
from uavnav.views.window import hud, mouse

SIZES = [hud.DESIGN, (760, 900), (1920, 1080), (640, 480), play.SMALLEST]


@pytest.fixture
def window(monkeypatch):
    with opened(monkeypatch) as after:
        yield after


@pytest.fixture(scope="module")
def run(request, trained):
    return trained(getattr(request, "param", "ppo"))


of_every_algorithm = pytest.mark.parametrize("run", ALGORITHMS, indirect=True)


# -- the picture ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", SIZES)
def test_at_five_sizes_everything_is_inside_the_window_and_nothing_covers_the_arena(size):
    places = hud.arrange(size, WORLD)
    arena = places.left, places.top, places.left + places.width, places.top + places.height
    assert places.width * 3 == pytest.approx(places.height * 4, abs=4)
    block = hud.BLOCK * places.unit
    for left, top in (places.facts, places.grid):
        assert left >= arena[2] or top >= arena[3]
        assert min(left, top) >= 0
        if size != play.SMALLEST:
            assert left + block <= size[0] + 1
            assert top + hud.FACTS_HEIGHT * places.unit <= size[1]
    assert min(arena) >= 0
    assert arena[2] <= size[0]
    assert arena[3] <= size[1]
    assert hud.to_world((places.left, places.top), size, WORLD) == (0, 600)
    middle = (places.left + places.width // 2, places.top + places.height // 2)
    assert hud.to_world(middle, size, WORLD) == pytest.approx((400, 300), abs=4)


@pytest.mark.parametrize("size", SIZES)
def test_the_window_shows_the_drone_of_the_pilots_colour_where_it_is(size, window):
    pygame.display.set_mode(size, pygame.RESIZABLE)
    game = fly(new(STRAIGHT), 20)
    play.show(game)
    places = hud.arrange(size, WORLD)
    x, y = places.left + places.width * (400 + 12) / 800, places.top + places.height * (300 - 180) / 600
    assert tuple(pygame.display.get_surface().get_at((round(x), round(y))))[:3] == drawing.PILOTS[1]


@of_every_algorithm
def test_the_action_grid_has_the_best_action_in_the_brightest_colour_and_outlines_it(run):
    (pilot,) = render.load_pilots([str(run.path)], greedy=True)
    game = fly(new(pilot, layouts=layouts.load("test")), 4)
    values, action = game.choice.values, game.choice.action
    assert values.shape == (100,)
    assert action == int(values.argmax())
    shades = hud._shades(values)
    assert shades[action] == (253, 231, 36)  # of viridis, from dark blue to yellow
    assert shades[int(values.argmin())] == (68, 1, 84)
    picture = np.asarray(hud.draw(game, hud.DESIGN))
    turn, distance = divmod(action, 10)
    column = [5, 4, 3, 2, 1, 0, 9, 8, 7, 6].index(turn)
    left, top = hud.arrange(hud.DESIGN, WORLD).grid
    x, y = left + 26 + 24 * column, top + 24 + 21 * (9 - distance)
    assert tuple(picture[y + 10, x + 10]) == shades[action]
    assert tuple(picture[y, x + 10]) == hud.WHITE
    assert tuple(picture[y - 2, x + 10]) == drawing.INK


@pytest.mark.parametrize("greedy", [True, False])
def test_the_window_says_whether_the_pilot_is_greedy_or_sampled_and_nothing_of_a_script(
    run, greedy, monkeypatch
):
    written = []
    monkeypatch.setattr(hud._Block, "write", lambda self, x, y, words, *rest, **how: written.append(words))
    pilots = render.load_pilots([str(run.path), "reactive"], greedy=greedy)
    hud.draw(new(*pilots), hud.DESIGN)
    hud.draw(new(pilots[1]), hud.DESIGN)
    name = f"{run.path.parent.name}/run"
    titles = [
        words for words in written if words.startswith((f"{name},", "reactive,")) or words == "reactive"
    ]
    assert titles[0] == f"{name}, {'greedy' if greedy else 'sampled'}"
    assert set(titles[1:]) == {"reactive"}


def test_the_figures_are_those_of_the_metrics_table_after_an_episode():
    game = fly(press(new(), "up", "up", "up", "left"), 300)
    rows = pd.DataFrame([game.episodes[0]])
    expected = per_seed(rows).iloc[0]
    shown = list(hud.figures(game).values())
    wanted = [expected[name] for name in METRICS if name not in ("distance", "speed", "reward")]
    wanted += [expected["distance"], expected["speed"], expected["reward"], -10]
    assert [float(value) for value in shown] == pytest.approx(wanted, abs=0.051)
    assert len(shown) == 8


def test_every_moment_has_a_picture_of_its_own():
    flying = fly(new(STRAIGHT), 3)
    drawing = press(flying, "e")
    moments = [new(), flying, press(flying, "space"), drawing, mouse.grab(drawing, 100, 100), fly(flying, 99)]
    moments += [press(flying, "h"), mouse.grab(drawing, 420, 320)]
    pictures = [np.asarray(hud.draw(game, (700, 500))) for game in moments]
    assert all(picture.shape == (500, 700, 3) for picture in pictures)
    assert len({picture.tobytes() for picture in pictures}) == len(moments)


# -- the command ---------------------------------------------------------------------------------------------


@of_every_algorithm
def test_the_command_opens_its_window_obeys_and_closes(run, window, tmp_path, capsys):
    out = tmp_path / "some" / "rows.parquet"
    for name in ("0", *["up"] * 9):
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.key.key_code(name), mod=0))
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    assert commands.run("play", [str(run.path), "reactive", "--layout", "20", "--out", str(out)]) == 0
    assert capsys.readouterr() == ("", "")
    assert not out.parent.exists()


def test_the_command_told_after_training_in_3d_opens_its_window(window, tmp_path, capsys):
    config = ppo.PPOConfig(
        task="space", total_frames=64, n_envs=1, frames_per_batch=64, hidden=(8,), epochs=1
    )
    run = ppo.train(config, out=tmp_path / "my run", quiet=True)
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    assert commands.run("play", [str(run.path)]) == 0
    assert capsys.readouterr() == ("", "")


def test_episodes_that_the_x_lost_are_counted_in_the_last_line(window, monkeypatch, capsys):
    game = fly(press(fly(press(new(), "up"), 300), "r", "up"), 300)
    monkeypatch.setattr(rules, "new", lambda *words, **paths: game)
    for _ in range(2):
        pygame.event.post(pygame.event.Event(pygame.QUIT))
    assert commands.run("play", []) == 0
    assert capsys.readouterr() == ("2 episodes by hand were not saved\n", "")


def test_ctrl_c_closes_the_window_and_says_what_was_not_saved(window, monkeypatch, capsys):
    def interrupted(game, seconds):
        raise KeyboardInterrupt

    landed = fly(press(new(), "up"), 300)
    monkeypatch.setattr(play, "turn", interrupted)
    monkeypatch.setattr(rules, "new", lambda *words, **paths: landed)
    assert commands.run("play", []) == 0
    assert capsys.readouterr() == ("1 episode by hand was not saved\n", "")


def test_without_the_extra_it_is_one_line_that_says_which_and_status_2(capsys, monkeypatch):
    monkeypatch.setattr(play, "pygame", None)
    assert commands.run("play", []) == 2
    assert capsys.readouterr() == ("", "uavnav play: needs pygame-ce: pip install 'uavnav[play]'\n")


@pytest.mark.parametrize(
    ("words", "limit"),
    [([], 10_000), (["--task", "goal"], 1_000), (["--task", "goal", "--max-steps", "50"], 50)],
)
def test_an_episode_ends_at_the_cap_that_is_given_or_at_its_tasks_own(
    words, limit, window, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    games = []
    monkeypatch.setattr(play, "play", lambda game: games.append(game) or game)
    assert commands.run("play", words) == 0
    assert games[0].task.max_steps == limit
    assert rules.draw(games[0]).drawing == (not words)  # shortest ways to a goal lead round its circles


@pytest.mark.parametrize("driver", ["none such", None])
def test_without_a_screen_it_is_one_line_and_status_2(driver, capsys, monkeypatch):
    pygame.display.quit()
    for variable in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(variable, raising=False)
    if driver:
        monkeypatch.setenv("SDL_VIDEODRIVER", driver)
    monkeypatch.setattr(pygame.display, "get_driver", lambda: "offscreen")
    assert commands.run("play", []) == 2
    printed, err = capsys.readouterr()
    assert (printed, err.count("\n")) == ("", 1)
    assert "no window can be opened" in err
