"""The live window's rules: keys and mouse do what the help says, time passes as it should, rows are kept."""

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
from playing import EMPTY, REACTIVE, STRAIGHT, click, drag, fly, new, opened, place, press, pygame

import uavnav
from uavnav.algorithms import ALGORITHMS
from uavnav.cli import commands, play
from uavnav.runs.metrics import EPISODE_COLUMNS
from uavnav.tasks import layouts
from uavnav.tasks.baselines import straight_ahead
from uavnav.views import render
from uavnav.views.window import game as rules
from uavnav.views.window import hud, keys
from uavnav.views.window.game import PACES
from uavnav.views.window.table import ALIASES, KEYS, MOUSE, ROWS

NAMES = [name for key in KEYS for name in key.names]


@pytest.fixture
def window(monkeypatch):
    with opened(monkeypatch) as after:
        yield after


@pytest.fixture(scope="module", params=list(ALGORITHMS))
def run(request, trained):
    return trained(request.param)


# -- keys ----------------------------------------------------------------------------------------------------

DOES = {
    "left": ("you", lambda was, now: fly(now, 1).state.heading == 95),
    "right": ("you", lambda was, now: fly(now, 1).state.heading == 86),
    # nothing in 2D
    "t": (
        "you",
        lambda was, now: fly(now, 1).state.heading == 90 and now.choice == was.choice,
    ),
    "g": ("you", lambda was, now: fly(now, 1).state.heading == 90 and now.choice == was.choice),
    "up": ("you", lambda was, now: now.distance == was.distance + 1),
    "down": ("you", lambda was, now: now.distance == was.distance - 1),
    "0": ("policy", lambda was, now: now.pilot == 0 and place(now) == place(was) and now.distance == 9),
    **{
        str(n): ("you", lambda was, now, n=n: now.pilot == n and place(now) == place(was))
        for n in range(1, 10)
    },
    "tab": ("policy", lambda was, now: now.pilot == was.pilot + 1 and place(now) == place(was)),
    "space": ("policy", lambda was, now: now.paused and place(rules.advance(now, 9)) == place(was)),
    ".": ("policy", lambda was, now: now.paused and now.state.steps == was.state.steps + 1),
    "-": ("policy", lambda was, now: PACES[now.pace] == 0.5),
    "=": ("policy", lambda was, now: PACES[now.pace] == 2),
    "+": ("policy", lambda was, now: PACES[now.pace] == 2),
    "r": ("policy", lambda was, now: now.state.steps == 0 and now.ghosts == was.legs and now.index == 15),
    "return": (
        "policy",
        lambda was, now: now.state.steps == 0 and now.ghosts == was.legs and now.index == 15,
    ),
    "n": ("policy", lambda was, now: now.index == 16 and now.state.steps == 0 and not now.ghosts),
    "p": ("policy", lambda was, now: now.index == 14),
    "page down": ("policy", lambda was, now: now.index == 25),
    "page up": ("policy", lambda was, now: now.index == 5),
    "e": ("policy", lambda was, now: now.drawing and not press(now, "e").drawing),
    "c": ("drawing", lambda was, now: now.obstacles.shape == (1, 0, 3) and now.own),
    "delete": ("drawing", lambda was, now: now.obstacles.shape == (1, 0, 3) and now.own),
    "b": ("policy", lambda was, now: torch.equal(layouts.load("own.safetensors"), was.obstacles)),
    "k": ("landed", lambda was, now: not now.episodes and len(pd.read_parquet(ROWS)) == 1),
    "h": ("policy", lambda was, now: now.help and not press(now, "h").help),
    "f1": ("policy", lambda was, now: now.help),
    "escape": ("policy", lambda was, now: now.closed),
    "q": ("policy", lambda was, now: now.closed),
}
"""For each name of the table: who flies before, and what is true after it was pressed, as the help says."""


def before(kind):
    all_layouts = layouts.generate(30, k=3, seed=5)
    game = new(STRAIGHT, *[REACTIVE] * 8, layouts=all_layouts, index=15)
    if kind == "landed":
        return fly(press(new(index=15), "up"), 999)
    if kind == "you":
        return press(game, "0", "up", "up")
    game = fly(game, 2)
    return press(game, "e") if kind == "drawing" else game


def test_every_name_of_the_table_is_a_key_that_pygame_knows_stands_there_once_and_has_a_test(window):
    assert all(
        pygame.key.name(pygame.key.key_code(name)) == name for name in [*NAMES, *ALIASES, *rules.SHIFTS]
    )
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
        commands.run("play", ["--help"])
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
        commands.run("play", ["--help"])
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


@pytest.mark.parametrize(
    ("names", "angle", "distance"), [((), 0, 0), (("left",), 5, 0), (("right", "up"), -4, 1)]
)
def test_keys_become_the_action_of_eqs_11_and_12(names, angle, distance):
    game = new()
    for name in names:
        game = keys.press(game, name)
    assert game.choice.action == angle % 10 * 10 + distance


# -- time ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("names", "steps"), [((), 24), (("-",), 12), (("-",) * 3, 2), (("space",), 0), (("h",), 0)]
)
def test_in_0_8_seconds_30_steps_a_second_are_24_and_at_a_tenth_2(names, steps):
    game = press(new(STRAIGHT), *names)
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


# -- episodes ------------------------------------------------------------------------------------------------


def test_nine_px_a_step_by_hand_is_the_row_that_straight_ahead_has_in_an_evaluation():
    game = fly(press(new(index=2, person=7), *["up"] * 9), 1000)
    assert game.ended == "Collided after 28 steps"
    (row,) = game.episodes
    (expected,) = uavnav.evaluate_policy(straight_ahead, EMPTY[:1], 1, seed=7).to_dict("records")
    assert list(row) == list(EPISODE_COLUMNS)
    assert row == expected | {"env": 2, "layout": 2, "reward": pytest.approx(27 * 0.09 - 10)}


def test_a_watched_policy_flies_as_it_does_in_a_film(run):
    (pilot,) = render.load_pilots([str(run.path)], greedy=True)
    all_layouts = layouts.load("test")
    film = render.fly(pilot, all_layouts, 3, 60)
    game = fly(new(pilot, layouts=all_layouts, index=3), 60)
    points = [(float(state.x), float(state.y)) for state in film.states]
    assert list(game.legs[0].points) == points
    assert float(game.state.reward) == float(film.states[-1].reward)
    assert game.ended.startswith("Collided") == (film.ended == "collided")


def test_pilots_change_in_mid_episode_and_such_an_episode_is_nobodys():
    game = fly(press(new(STRAIGHT), "0"), 0)
    game = fly(press(game, *["up"] * 5), 10)
    game = fly(press(game, "1"), 5)
    assert [(leg.pilot, len(leg.points)) for leg in game.legs] == [(0, 11), (1, 6)]
    assert game.legs[1].points[0] == game.legs[0].points[-1]
    assert place(game)[1] == 300 + 10 * 5 + 5 * 9
    game = fly(press(game, "0"), 100)
    assert game.ended.startswith("Collided")
    assert not game.episodes
    assert "There is no pilot 2" in press(game, "2").message


@pytest.mark.parametrize("how", [{"split": "train"}, {"max_steps": 5}])
def test_episodes_of_other_sets_are_not_kept_and_one_that_is_cut_off_is_truncated(how):
    game = fly(press(new(**how), "up"), 300)
    flags = [(row["terminated"], row["truncated"], row["steps"]) for row in game.episodes]
    assert flags == ([] if "split" in how else [(False, True, 5)])


def test_a_pilot_is_sampled_as_in_training_and_flies_the_same_way_again_after_a_reset(run):
    (pilot,) = render.load_pilots([str(run.path)])
    assert pilot.mode == "sampled"
    first = fly(new(pilot), 15)
    again = fly(press(first, "r"), 15)
    assert again.legs == first.legs
    assert (
        fly(dataclasses.replace(new(pilot), generator=torch.Generator().manual_seed(1)), 15).legs
        != first.legs
    )


# -- what is saved -------------------------------------------------------------------------------------------


def test_rows_of_three_episodes_saved_in_two_goes_are_in_one_file_that_the_report_reads(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    game = new(person=3)
    for index in (0, 1):
        game = fly(press(game, "up", "up"), 300)
        game = press(game, "n")
        assert len(game.episodes) == index + 1
    game = press(game, "k")
    assert game.message == "Saved: results/baselines/human.parquet holds 2 episodes"
    assert pd.read_parquet("results/baselines/human.parquet").attrs == {
        "layouts": "test",
        "max_steps": 10_000,
    }
    assert press(game, "k").message == "No finished episode by hand to save"
    game = press(fly(press(game, "up", "up", "up"), 300), "k")
    from uavnav.report import frames

    found, left_out = frames.baselines([tmp_path / "results"])
    assert left_out == []
    rows = found["human"]
    assert dict(rows.dtypes.astype(str)) == EPISODE_COLUMNS
    assert rows["layout"].tolist() == [0, 1, 2]
    assert rows["steps"].tolist() == [math.ceil(250 / 2)] * 2 + [math.ceil(250 / 3)]
    assert set(rows["seed"]) == {3}
    assert [path.name for path in (tmp_path / "results/baselines").iterdir()] == ["human.parquet"]


def test_one_saved_episode_is_1_episode_and_episodes_under_another_cap_leave_the_file_without_one(tmp_path):
    path = tmp_path / "human.parquet"
    game = press(fly(press(new(rows_path=path), "up"), 300), "k")
    assert game.message == f"Saved: {path} holds 1 episode"
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
        (["results/sensitivity/obstacles-4/dqn/tanh"], "results"),
        (["reactive", "theirs.zip", "runs/first"], "runs"),
        (["ppo/relu"], "."),
        (["../runs/ppo/relu"], "../runs"),
        (["/far/runs/ppo/relu"], "/far/runs"),
        ([], "results"),
        (["reactive"], "results"),
    ],
)
def test_episodes_by_hand_go_where_a_report_of_the_first_runs_root_looks(words, root):
    assert play.rows_file(words) == Path(root) / "baselines" / "human.parquet"


def test_an_episode_flown_beside_a_run_is_found_by_the_report_of_its_folder(
    run, window, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(run.path, "runs/ppo/relu")
    press_and_close = iter([lambda game: press(fly(press(game, "0", "up"), 300), "k"), rules.leave])
    monkeypatch.setattr(play, "turn", lambda game, seconds: next(press_and_close)(game))
    assert commands.run("play", ["runs/ppo/relu"]) == 0
    from uavnav.report import frames

    found, left_out = frames.baselines([Path("runs")])
    assert (list(found), left_out) == (["human"], [])
    assert found["human"]["terminated"].tolist() == [True]


def test_rows_are_kept_in_memory_when_the_file_is_another_table_and_it_stays_as_it_is(tmp_path):
    path = tmp_path / "human.parquet"
    path.write_bytes(b"not a table")
    game = press(fly(press(new(rows_path=path), "up"), 300), "k")
    assert len(game.episodes) == 1
    assert "missing or damaged" in game.message
    assert path.read_bytes() == b"not a table"
    asked = press(game, "escape")
    assert not asked.closed
    assert "1 episode by hand not saved yet" in asked.message
    assert press(asked, "escape").closed


def test_the_windows_x_asks_once_too_and_says_so_above_the_help(window):
    game = press(fly(press(new(), "up"), 300), "h")
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    asked = play.turn(game, 0.0)
    assert (asked.closed, asked.help) == (False, False)
    assert asked.message == "1 episode by hand not saved yet: K saves; once more closes without"
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    assert play.turn(asked, 0.0).closed


def test_an_obstacle_drawn_with_the_mouse_is_saved_loaded_and_flown_into(window, tmp_path, capsys):
    path = tmp_path / "own.safetensors"
    game = window(new(layouts=layouts.generate(1, k=4, seed=1), drawn_path=path), "e", "c")
    drag(400, 480, 460, 480)
    game = window(game)
    assert game.circle is None
    drag(100, 100, 101, 100)  # hardly moved: the smallest
    drag(700, 100, 500, 300)  # too far: the largest
    drag(430, 330, 431, 330)  # on the start
    game = window(game, "b")
    assert game.message == f"Saved: uavnav play --layouts {path}"
    all_layouts = layouts.load(path)
    assert all_layouts.shape == (1, 3, 3)
    assert all_layouts[0].numpy() == pytest.approx(
        np.array([[400, 480, 60], [100, 100, 30], [700, 100, 100]]), abs=1
    )
    assert press(game, "b").message.endswith("own-2.safetensors")
    by_hand = fly(window(game, "e", *["up"] * 9), 1000)
    assert by_hand.ended == "Collided after 10 steps"  # 300 + 90 + 30 reaches 480 - 60
    assert by_hand.episodes == ()
    assert fly(new(STRAIGHT, layouts=all_layouts, split=str(path)), 1000).ended == "Collided after 10 steps"
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    assert commands.run("play", ["straight", "--layouts", str(path)]) == 0
    assert capsys.readouterr().err == ""


def test_an_obstacle_on_the_start_is_refused_and_a_right_click_takes_one_away(window):
    game = window(new(layouts=torch.tensor([[[600.0, 100.0, 50.0], [200.0, 100.0, 50.0]]])), "e")
    drag(430, 330, 470, 330)
    game = window(game)
    assert game.message == "Not there: obstacle 2 of set 0 is nearer than 50 px to the start"
    assert game.obstacles.shape == (1, 2, 3)
    pygame.event.post(click(pygame.MOUSEBUTTONDOWN, 620, 110, button=3))
    game = window(game)
    assert game.obstacles.tolist() == [[[200, 100, 50]]]
    pygame.event.post(click(pygame.MOUSEBUTTONDOWN, 200, 110, button=3))
    drag(100, 100, 150, 150)
    game = window(press(game, "e"))  # the drawing is over: the mouse does nothing
    assert game.obstacles.tolist() == [[[200, 100, 50]]]
