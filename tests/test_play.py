"""The live window: keys and mouse do what the help says, time passes as it should, and what is saved can be used."""

import dataclasses
import io
import math
import shutil
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

import uavnav
from uavnav import render
from uavnav.algorithms import ppo
from uavnav.envs import drawing
from uavnav.render import Pilot
from uavnav.report import frames
from uavnav.runs.metrics import EPISODE_COLUMNS, METRICS, per_seed
from uavnav.tasks import layouts
from uavnav.tasks.baselines import BASELINES, straight_ahead
from uavnav.tasks.world import World
from uavnav.window import game as rules
from uavnav.window import hud, play
from uavnav.window.game import ALIASES, KEYS, MOUSE, PACES

pygame = pytest.importorskip("pygame")

WORLD = World()
EMPTY = layouts.generate(30, k=0)
STRAIGHT = Pilot("straight", straight_ahead, WORLD)
REACTIVE = Pilot("reactive", BASELINES["reactive"], WORLD)
NAMES = [name for key in KEYS for name in key.names]
SIZES = [hud.DESIGN, (760, 900), (1920, 1080), (640, 480), play.SMALLEST]


def new(*pilots, bank=EMPTY, **how):
    return rules.new(list(pilots), bank, **how)


def fly(game, steps):
    for _ in range(steps):
        game = rules.step(game)
    return game


def press(game, *names):
    for name in names:
        game = rules.release(rules.press(game, name), name)
    return game


def place(game):
    return float(game.state.x), float(game.state.y), int(game.state.heading)


@pytest.fixture
def window(monkeypatch):
    """A window without a screen, to which events are posted; `window(game, *keys)` is the game after them."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    play.open_window(hud.DESIGN)
    pygame.event.clear()

    def after(game, *names, seconds=0.0):
        for name in names:
            for kind in (pygame.KEYDOWN, pygame.KEYUP):
                pygame.event.post(pygame.event.Event(kind, key=pygame.key.key_code(name), mod=0))
        return play.turn(game, seconds)

    yield after
    pygame.display.quit()


def mouse(kind, x, y, button=1):
    """An event at a place of the world [px]."""
    places = hud.arrange(hud.DESIGN, WORLD)
    scale = places.width / WORLD.width
    at = round(places.left + x * scale), round(places.top + (WORLD.height - y) * scale)
    if kind == pygame.MOUSEMOTION:
        return pygame.event.Event(kind, pos=at, rel=(0, 0), buttons=(1, 0, 0))
    return pygame.event.Event(kind, pos=at, button=button)


def drag(x, y, to_x, to_y):
    pygame.event.post(mouse(pygame.MOUSEBUTTONDOWN, x, y))
    pygame.event.post(mouse(pygame.MOUSEMOTION, to_x, to_y))
    pygame.event.post(mouse(pygame.MOUSEBUTTONUP, to_x, to_y))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    config = ppo.PPOConfig(total_frames=256, frames_per_batch=256, compile="off")
    return ppo.train(config, out=tmp_path_factory.mktemp("play") / "run", quiet=True)


# -- keys ------------------------------------------------------------------------------------------------------------

DOES = {
    "left": ("you", lambda was, now: fly(now, 1).state.heading == 95),
    "right": ("you", lambda was, now: fly(now, 1).state.heading == 86),
    "up": ("you", lambda was, now: now.distance == was.distance + 1),
    "down": ("you", lambda was, now: now.distance == was.distance - 1),
    "0": ("policy", lambda was, now: now.pilot == 0 and place(now) == place(was) and now.distance == 9),
    **{str(n): ("you", lambda was, now, n=n: now.pilot == n and place(now) == place(was)) for n in range(1, 10)},
    "tab": ("policy", lambda was, now: now.pilot == was.pilot + 1 and place(now) == place(was)),
    "space": ("policy", lambda was, now: now.paused and place(rules.advance(now, 9)) == place(was)),
    ".": ("policy", lambda was, now: now.paused and now.state.steps == was.state.steps + 1),
    "-": ("policy", lambda was, now: PACES[now.pace] == 0.5),
    "=": ("policy", lambda was, now: PACES[now.pace] == 2),
    "+": ("policy", lambda was, now: PACES[now.pace] == 2),
    "r": ("policy", lambda was, now: now.state.steps == 0 and now.ghosts == was.legs and now.index == 15),
    "return": ("policy", lambda was, now: now.state.steps == 0 and now.ghosts == was.legs and now.index == 15),
    "n": ("policy", lambda was, now: now.index == 16 and now.state.steps == 0 and not now.ghosts),
    "p": ("policy", lambda was, now: now.index == 14),
    "page down": ("policy", lambda was, now: now.index == 25),
    "page up": ("policy", lambda was, now: now.index == 5),
    "e": ("policy", lambda was, now: now.drawing and not press(now, "e").drawing),
    "c": ("drawing", lambda was, now: now.obstacles.shape == (1, 0, 3) and now.own),
    "delete": ("drawing", lambda was, now: now.obstacles.shape == (1, 0, 3) and now.own),
    "b": ("policy", lambda was, now: torch.equal(layouts.load("own.safetensors"), was.obstacles)),
    "k": ("landed", lambda was, now: not now.flights and len(pd.read_parquet(rules.ROWS)) == 1),
    "h": ("policy", lambda was, now: now.help and not press(now, "h").help),
    "f1": ("policy", lambda was, now: now.help),
    "escape": ("policy", lambda was, now: now.closed),
    "q": ("policy", lambda was, now: now.closed),
}
"""For each name of the table: who flies before, and what is true after it was pressed, as the help says."""


def before(kind):
    bank = layouts.generate(30, k=3, seed=5)
    game = new(STRAIGHT, *[REACTIVE] * 8, bank=bank, index=15)
    if kind == "landed":
        return fly(press(new(index=15), "up"), 999)
    if kind == "you":
        return press(game, "0", "up", "up")
    game = fly(game, 2)
    return press(game, "e") if kind == "drawing" else game


def test_every_name_of_the_table_is_a_key_that_pygame_knows_stands_there_once_and_has_a_test(window):
    assert all(pygame.key.name(pygame.key.key_code(name)) == name for name in [*NAMES, *ALIASES, *rules.SHIFTS])
    assert len({*NAMES, *ALIASES}) == len(NAMES) + len(ALIASES)
    assert set(DOES) == set(NAMES)
    assert set(ALIASES.values()) <= set(NAMES)


@pytest.mark.parametrize("name", [*NAMES, *ALIASES])
def test_a_posted_key_does_what_the_help_says(name, window, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    kind, check = DOES[ALIASES.get(name, name)]
    was = before(kind)
    now = window(was, name)
    assert check(was, now)


def test_the_help_of_the_command_and_of_the_window_have_every_line_of_the_table(capsys, monkeypatch):
    lines = [(key.shown, key.does) for key in KEYS if key.shown] + list(MOUSE)
    with pytest.raises(SystemExit):
        play.main(["--help"])
    printed = capsys.readouterr().out
    assert all(f"{shown:12} {does}" in printed for shown, does in lines)
    written = []
    monkeypatch.setattr(hud._Block, "write", lambda self, x, y, words, *rest, **how: written.append(words))
    hud.draw(press(new(), "h"), hud.DESIGN)
    assert all(shown in written and does in written for shown, does in lines)


def test_beneath_the_open_help_the_step_key_does_nothing():
    game = press(fly(new(STRAIGHT), 2), "h", ".")
    assert (int(game.state.steps), game.paused, game.help) == (2, False, True)


def test_the_help_is_printed_on_a_terminal_that_has_ascii_alone(monkeypatch):
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), "ascii"))
    with pytest.raises(SystemExit) as stopped:
        play.main(["--help"])
    sys.stdout.seek(0)
    assert stopped.value.code == 0
    assert "  ? A          turn 5? left" in sys.stdout.read()


def test_with_shift_a_turn_is_one_degree_and_held_keys_turn_in_every_step(window):
    game = press(new(), "up")
    for name in ("left shift", "left"):
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.key.key_code(name), mod=0))
    game = fly(window(game), 3)
    assert game.state.heading == 93
    pygame.event.post(pygame.event.Event(pygame.KEYUP, key=pygame.key.key_code("left shift"), mod=0))
    game = fly(window(game), 3)
    assert game.state.heading == 93 + 15
    pygame.event.post(pygame.event.Event(pygame.WINDOWFOCUSLOST))
    assert fly(window(game), 3).state.heading == 93 + 15


def test_a_tap_shorter_than_a_step_turns_once():
    game = fly(press(new(), "up", "left"), 3)
    assert game.state.heading == 95
    assert game.state.turns == 1


@pytest.mark.parametrize(("keys", "angle", "distance"), [((), 0, 0), (("left",), 5, 0), (("right", "up"), -4, 1)])
def test_keys_become_the_action_of_eqs_11_and_12(keys, angle, distance):
    game = new()
    for name in keys:
        game = rules.press(game, name)
    assert game.choice.action == angle % 10 * 10 + distance


# -- time ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("keys", "steps"), [((), 24), (("-",), 12), (("-",) * 3, 2), (("space",), 0), (("h",), 0)])
def test_in_0_8_seconds_30_steps_a_second_are_24_and_at_a_tenth_2(keys, steps):
    game = press(new(STRAIGHT), *keys)
    for _ in range(32):
        game = rules.advance(game, 0.025)
    assert game.state.steps == steps


def test_a_picture_that_took_5_seconds_is_followed_by_3_steps_and_not_by_150():
    assert rules.advance(new(REACTIVE), 5.0).state.steps == 3


def test_a_person_has_all_the_time_in_the_world_before_the_first_key():
    game = new()
    for _ in range(100):
        game = rules.advance(game, 0.1)
    assert game.state.steps == 0
    assert rules.advance(press(game, "up"), 0.1).state.steps == 3


# -- flights ---------------------------------------------------------------------------------------------------------


def test_nine_px_a_step_by_hand_is_the_row_that_straight_ahead_has_in_an_evaluation():
    game = fly(press(new(index=2, person=7), *["up"] * 9), 1000)
    assert game.ended == "Collided after 28 steps"
    (row,) = game.flights
    (expected,) = uavnav.evaluate_policy(straight_ahead, EMPTY[:1], 1, seed=7).to_dict("records")
    assert list(row) == list(EPISODE_COLUMNS)
    assert row == expected | {"world": 2, "layout": 2, "reward": pytest.approx(27 * 0.09 - 10)}


def test_a_watched_policy_flies_as_it_does_in_a_film(run):
    (pilot,) = render.load_pilots([str(run.path)])
    bank = layouts.load("test")
    film = render.fly(pilot, bank, 3, 60)
    game = fly(new(pilot, bank=bank, index=3), 60)
    points = [(float(state.x), float(state.y)) for state in film.states]
    assert list(game.legs[0].points) == points
    assert float(game.state.reward) == float(film.states[-1].reward)
    assert bool(game.ended) == film.collided


def test_pilots_change_in_flight_and_such_a_flight_is_nobodys():
    game = fly(press(new(STRAIGHT), "0"), 0)
    game = fly(press(game, *["up"] * 5), 10)
    game = fly(press(game, "1"), 5)
    assert [(leg.pilot, len(leg.points)) for leg in game.legs] == [(0, 11), (1, 6)]
    assert game.legs[1].points[0] == game.legs[0].points[-1]
    assert place(game)[1] == 300 + 10 * 5 + 5 * 9
    game = fly(press(game, "0"), 100)
    assert game.ended.startswith("Collided")
    assert not game.flights
    assert "There is no pilot 2" in press(game, "2").message


@pytest.mark.parametrize("how", [{"split": "train"}, {"max_steps": 5}])
def test_flights_of_other_sets_are_not_kept_and_one_that_is_cut_off_is_truncated(how):
    game = fly(press(new(**how), "up"), 300)
    flags = [(row["terminated"], row["truncated"], row["steps"]) for row in game.flights]
    assert flags == ([] if "split" in how else [(False, True, 5)])


def test_a_sampled_policy_flies_the_same_way_again_after_a_reset(run):
    (pilot,) = render.load_pilots([str(run.path)], sampled=True)
    first = fly(new(pilot), 15)
    again = fly(press(first, "r"), 15)
    assert again.legs == first.legs
    assert fly(dataclasses.replace(new(pilot), generator=torch.Generator().manual_seed(1)), 15).legs != first.legs


# -- what is saved ---------------------------------------------------------------------------------------------------


def test_rows_of_three_flights_saved_in_two_goes_are_in_one_file_that_the_report_reads(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    game = new(person=3)
    for index in (0, 1):
        game = fly(press(game, "up", "up"), 300)
        game = press(game, "n")
        assert len(game.flights) == index + 1
    game = press(game, "k")
    assert game.message == "Saved: results/baselines/human.parquet holds 2 flights"
    assert pd.read_parquet("results/baselines/human.parquet").attrs == {"layouts": "test", "max_steps": 10_000}
    assert press(game, "k").message == "No finished flight by hand to save"
    game = press(fly(press(game, "up", "up", "up"), 300), "k")
    found, left_out = frames.baselines([tmp_path / "results"])
    assert left_out == []
    rows = found["human"]
    assert dict(rows.dtypes.astype(str)) == EPISODE_COLUMNS
    assert rows["layout"].tolist() == [0, 1, 2]
    assert rows["steps"].tolist() == [math.ceil(250 / 2)] * 2 + [math.ceil(250 / 3)]
    assert set(rows["seed"]) == {3}
    assert [path.name for path in (tmp_path / "results/baselines").iterdir()] == ["human.parquet"]


def test_one_saved_flight_is_1_flight_and_flights_under_another_cap_leave_the_file_without_one(tmp_path):
    path = tmp_path / "human.parquet"
    game = press(fly(press(new(rows_path=path), "up"), 300), "k")
    assert game.message == f"Saved: {path} holds 1 flight"
    press(fly(press(new(rows_path=path, max_steps=5), "up"), 300), "k")
    rows = pd.read_parquet(path)
    assert rows["steps"].tolist() == [250, 5]
    assert rows.attrs == {}


@pytest.mark.parametrize(
    ("words", "root"),
    [
        (["runs/ppo/relu"], "runs"),
        (["runs/ppo-fast/relu", "other/first"], "runs"),
        (["runs/first"], "runs"),
        (["results/obstacles-4/dqn/tanh"], "results"),
        (["reactive", "theirs.zip", "runs/first"], "runs"),
        (["ppo/relu"], "."),
        (["../runs/ppo/relu"], "../runs"),
        (["/far/runs/ppo/relu"], "/far/runs"),
        ([], "results"),
        (["reactive"], "results"),
    ],
)
def test_flights_by_hand_go_where_a_report_of_the_first_runs_root_looks(words, root):
    assert play.rows_file(words) == Path(root) / "baselines" / "human.parquet"


def test_a_flight_flown_beside_a_run_is_found_by_the_report_of_its_folder(run, window, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(run.path, "runs/ppo/relu")
    press_and_close = iter([lambda game: press(fly(press(game, "0", "up"), 300), "k"), rules.leave])
    monkeypatch.setattr(play, "turn", lambda game, seconds: next(press_and_close)(game))
    assert play.main(["runs/ppo/relu"]) == 0
    found, left_out = frames.baselines([Path("runs")])
    assert (list(found), left_out) == (["human"], [])
    assert found["human"]["terminated"].tolist() == [True]


def test_rows_are_kept_in_memory_when_the_file_is_another_table_and_it_stays_as_it_is(tmp_path):
    path = tmp_path / "human.parquet"
    path.write_bytes(b"not a table")
    game = press(fly(press(new(rows_path=path), "up"), 300), "k")
    assert len(game.flights) == 1
    assert "missing or damaged" in game.message
    assert path.read_bytes() == b"not a table"
    asked = press(game, "escape")
    assert not asked.closed
    assert "1 flight by hand not saved yet" in asked.message
    assert press(asked, "escape").closed


def test_the_windows_x_asks_once_too_and_says_so_above_the_help(window):
    game = press(fly(press(new(), "up"), 300), "h")
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    asked = play.turn(game, 0.0)
    assert (asked.closed, asked.help) == (False, False)
    assert asked.message == "1 flight by hand not saved yet: K saves; once more closes without"
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    assert play.turn(asked, 0.0).closed


def test_an_obstacle_drawn_with_the_mouse_is_saved_loaded_and_flown_into(window, tmp_path, capsys):
    path = tmp_path / "own.safetensors"
    game = window(new(bank=layouts.generate(1, k=4, seed=1), bank_path=path), "e", "c")
    drag(400, 480, 460, 480)
    game = window(game)
    assert game.circle is None
    drag(100, 100, 101, 100)  # hardly moved: the smallest
    drag(700, 100, 500, 300)  # too far: the largest
    drag(430, 330, 431, 330)  # on the start
    game = window(game, "b")
    assert game.message == f"Saved: python -m uavnav.play --layouts {path}"
    bank = layouts.load(path)
    assert bank.shape == (1, 3, 3)
    assert bank[0].numpy() == pytest.approx(np.array([[400, 480, 60], [100, 100, 30], [700, 100, 100]]), abs=1)
    assert press(game, "b").message.endswith("own-2.safetensors")
    by_hand = fly(window(game, "e", *["up"] * 9), 1000)
    assert by_hand.ended == "Collided after 10 steps"  # 300 + 90 + 30 reaches 480 - 60
    assert by_hand.flights == ()
    assert fly(new(STRAIGHT, bank=bank, split=str(path)), 1000).ended == "Collided after 10 steps"
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    assert play.main(["straight", "--layouts", str(path)]) == 0
    assert capsys.readouterr().err == ""


def test_an_obstacle_on_the_start_is_refused_and_a_right_click_takes_one_away(window):
    game = window(new(bank=torch.tensor([[[600.0, 100.0, 50.0], [200.0, 100.0, 50.0]]])), "e")
    drag(430, 330, 470, 330)
    game = window(game)
    assert game.message == "Not there: obstacle 2 of set 0 is nearer than 50 px to the start"
    assert game.obstacles.shape == (1, 2, 3)
    pygame.event.post(mouse(pygame.MOUSEBUTTONDOWN, 620, 110, button=3))
    game = window(game)
    assert game.obstacles.tolist() == [[[200, 100, 50]]]
    pygame.event.post(mouse(pygame.MOUSEBUTTONDOWN, 200, 110, button=3))
    drag(100, 100, 150, 150)
    game = window(press(game, "e"))  # the drawing is over: the mouse does nothing
    assert game.obstacles.tolist() == [[[200, 100, 50]]]


# -- the picture -----------------------------------------------------------------------------------------------------


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


def test_the_action_grid_has_the_best_action_in_the_brightest_colour_and_outlines_it(run):
    (pilot,) = render.load_pilots([str(run.path)])
    game = fly(new(pilot, bank=layouts.load("test")), 4)
    values, action = game.choice.values, game.choice.action
    assert values.shape == (100,)
    assert action == int(values.argmax())
    shades = hud._shades(values)
    assert shades[action] == hud._colours()[255]
    assert shades[int(values.argmin())] == hud._colours()[0]
    picture = np.asarray(hud.draw(game, hud.DESIGN))
    turn, distance = divmod(action, 10)
    column = [5, 4, 3, 2, 1, 0, 9, 8, 7, 6].index(turn)
    left, top = hud.arrange(hud.DESIGN, WORLD).grid
    x, y = left + 26 + 24 * column, top + 24 + 21 * (9 - distance)
    assert tuple(picture[y + 10, x + 10]) == shades[action]
    assert tuple(picture[y, x + 10]) == hud.WHITE
    assert tuple(picture[y - 2, x + 10]) == drawing.INK


def test_the_figures_are_those_of_the_metrics_table_after_a_flight():
    game = fly(press(new(), "up", "up", "up", "left"), 300)
    rows = pd.DataFrame([game.flights[0]])
    expected = per_seed(rows).iloc[0]
    shown = list(hud.figures(game).values())
    wanted = [expected[name] for name in METRICS if name not in ("distance", "speed", "reward")]
    wanted += [expected["distance"], expected["speed"], expected["reward"], -10]
    assert [float(value) for value in shown] == pytest.approx(wanted, abs=0.051)
    assert len(shown) == 8


def test_every_moment_has_a_picture_of_its_own():
    flying = fly(new(STRAIGHT), 3)
    drawing = press(flying, "e")
    moments = [new(), flying, press(flying, "space"), drawing, rules.grab(drawing, 100, 100), fly(flying, 99)]
    moments += [press(flying, "h"), rules.grab(drawing, 420, 320)]
    pictures = [np.asarray(hud.draw(game, (700, 500))) for game in moments]
    assert all(picture.shape == (500, 700, 3) for picture in pictures)
    assert len({picture.tobytes() for picture in pictures}) == len(moments)


# -- the command -----------------------------------------------------------------------------------------------------


def test_the_command_opens_its_window_obeys_and_closes(run, window, tmp_path, capsys):
    out = tmp_path / "some" / "rows.parquet"
    for name in ("0", *["up"] * 9):
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.key.key_code(name), mod=0))
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    assert play.main([str(run.path), "reactive", "--layout", "20", "--out", str(out)]) == 0
    assert capsys.readouterr() == ("", "")
    assert not out.parent.exists()


def test_flights_that_the_x_lost_are_counted_in_the_last_line(window, monkeypatch, capsys):
    game = fly(press(fly(press(new(), "up"), 300), "r", "up"), 300)
    monkeypatch.setattr(rules, "new", lambda *words, **paths: game)
    for _ in range(2):
        pygame.event.post(pygame.event.Event(pygame.QUIT))
    assert play.main([]) == 0
    assert capsys.readouterr() == ("2 flights by hand were not saved\n", "")


def test_ctrl_c_closes_the_window_and_says_what_was_not_saved(window, monkeypatch, capsys):
    def interrupted(game, seconds):
        raise KeyboardInterrupt

    landed = fly(press(new(), "up"), 300)
    monkeypatch.setattr(play, "turn", interrupted)
    monkeypatch.setattr(rules, "new", lambda *words, **paths: landed)
    assert play.main([]) == 0
    assert capsys.readouterr() == ("1 flight by hand was not saved\n", "")


def test_without_the_extra_it_is_one_line_that_says_which_and_status_2(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    assert play.main([]) == 2
    assert capsys.readouterr() == ("", "uavnav.play: needs pygame-ce: pip install 'uavnav[play]'\n")


@pytest.mark.parametrize("driver", ["none such", None])
def test_without_a_screen_it_is_one_line_and_status_2(driver, capsys, monkeypatch):
    pygame.display.quit()
    for variable in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(variable, raising=False)
    if driver:
        monkeypatch.setenv("SDL_VIDEODRIVER", driver)
    monkeypatch.setattr(pygame.display, "get_driver", lambda: "offscreen")
    assert play.main([]) == 2
    printed, err = capsys.readouterr()
    assert (printed, err.count("\n")) == ("", 1)
    assert "no window can be opened" in err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "no policy.safetensors there"),
        (["RUN", "--seed", "9"], "seed=9 is not there"),
        (["--layout", "1000"], "--layout 1000: choose from 0 to 999"),
        (["--layouts", "nowhere"], "no such bank"),
        (["--max-steps", "0"], "--max-steps 0: give at least 1"),
        (["--out", "file/human.parquet"], "file/human.parquet: cannot be written"),
        (["--out", "."], ".: cannot be written"),
        (["--out", "file"], "file: missing or damaged; move it away"),
        (["--bank", "file/own.safetensors"], "file/own.safetensors: cannot be written (Not a directory)"),
        (["--out", "/proc/x/human.parquet"], "/proc/x/human.parquet: cannot be written ("),
        (["--activation", "tanh"], "--activation tanh: runs know their own; give it with a .zip"),
    ],
)
def test_a_wrong_word_is_one_line_and_status_2(run, arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("no table")
    assert play.main([str(run.path) if word == "RUN" else word for word in arguments]) == 2
    printed, err = capsys.readouterr()
    assert message in err
    assert err.startswith("uavnav.play: ")
    assert (printed, err.count("\n")) == ("", 1)
