"""The worlds in 3D, in use: what learns in them, scripted policies and pictures."""

import functools

import numpy as np
import pytest
import space_by_hand as by_hand
import torch
from policies_by_hand import untrained

from uavnav import evaluation, load_policy
from uavnav.algorithms import a2c, c51, dqn, sac
from uavnav.envs import drawing
from uavnav.evaluation.repeats import pose_of
from uavnav.tasks import baselines, space
from uavnav.tasks.baselines import BASELINES, suited
from uavnav.tasks.rewards import bounds_of_returns
from uavnav.tasks.space import SpaceMovingWorld, SpaceWorld
from uavnav.tasks.table import make_task
from uavnav.training import probes
from uavnav.views import render

SENSED = {"sense_velocity": True}


# -- what learns in it ---------------------------------------------------------------------------------------


def test_a_return_lies_between_the_worst_collision_and_9_px_a_step():
    assert SpaceWorld().distances == (0, 3, 6, 9)
    assert bounds_of_returns("eq14", SpaceWorld(), 0.99) == pytest.approx((-10, 9))


def test_a_pose_that_comes_again_has_the_same_place_yaw_and_pitch():
    task = make_task("test", task="space")
    assert pose_of(task.start(torch.tensor(0), torch.tensor(90))) == ["x", "y", "heading", "z", "pitch"]
    assert pose_of(make_task("test").start(torch.tensor(0), torch.tensor(90))) == ["x", "y", "heading"]
    assert probes.poses(task).shape == (512, 40)


def test_an_episode_that_goes_round_in_pitch_too_is_counted_to_its_limit_as_if_it_were_flown():
    greedy = untrained(task=make_task(task="space"), sizes=(40, 8, 100))
    task = evaluation.on(greedy.task, "test", 10, 2000)
    assert evaluation._repeatable(greedy, task)
    counted = evaluation.fly({0: greedy}, task).episodes
    flown = evaluation.fly({0: lambda observation, generator: greedy(observation)}, task).episodes
    assert counted.equals(flown)


@pytest.mark.parametrize(
    ("module", "kind", "settings"),
    [
        (a2c, a2c.A2CConfig, {}),
        (dqn, dqn.DQNConfig, {"learning_starts": 32, "batch_size": 8}),
        (c51, c51.C51Config, {"learning_starts": 32, "batch_size": 8}),
        (sac, sac.SACConfig, {"learning_starts": 32, "batch_size": 8}),
    ],
)
def test_each_kind_of_algorithm_takes_the_size_of_the_observation_from_the_task(
    module, kind, settings, tmp_path
):
    given = {
        "task": "space-moving",
        "world": SENSED,
        "total_frames": 128,
        "n_envs": 4,
        "hidden": (8,),
        "max_steps": 9,
    }
    run = module.train(kind(**given, **settings), out=tmp_path / "run", quiet=True)
    assert load_policy(run.path)(torch.zeros(3, 70)).shape == (3,)


def test_fields_are_the_boxs_and_those_of_moving_obstacles_where_they_move():
    names = [set(kind.names()) for kind in (SpaceWorld, SpaceMovingWorld)]
    assert names[1] - names[0] == {"speed_min", "speed_max", "sense_velocity"}
    assert (SpaceMovingWorld().n_actions, SpaceMovingWorld(**SENSED).observation_size) == (100, 70)


# -- scripted policies ---------------------------------------------------------------------------------------


def test_names_of_scripted_policies_stand_for_those_of_the_box():
    still, moving_, paper = (
        make_task("test", task="space"),
        make_task("test", SENSED, task="space-moving"),
        make_task(),
    )
    assert suited(BASELINES["random"], still) is BASELINES["random"]
    assert suited(BASELINES["straight"], still)(torch.zeros(2, 40), None).tolist() == [3, 3]
    assert suited(BASELINES["straight"], paper) is BASELINES["straight"]
    assert suited(BASELINES["reactive"], still).func is BASELINES["reactive"]
    rule = suited(BASELINES["reactive"], moving_)
    assert (rule.func, rule.keywords) == (baselines.dodge_in_the_box, {"world": moving_.world})


def test_among_spheres_that_stand_still_reactive_never_collides_and_flies_on():
    task = evaluation.on(make_task("test", task="space"), "test", 30, 400)
    rows = evaluation.fly({0: suited(BASELINES["reactive"], task)}, task).episodes
    assert rows["truncated"].all()
    assert rows["distance"].mean() > 1000
    assert rows["reward"].tolist() == pytest.approx((0.01 * rows["distance"] - 0.01 * rows["turns"]).tolist())


@pytest.mark.parametrize("fields", [{}, SENSED])
def test_among_moving_spheres_the_policy_that_dodges_lasts_twice_as_long_as_the_one_for_a_still_box(fields):
    task = evaluation.on(make_task("test", fields, task="space-moving"), "test", 30, 300)
    still = functools.partial(BASELINES["reactive"], world=task.world)
    rules = suited(BASELINES["reactive"], task), still, BASELINES["random"]
    dodges, stands, random = (evaluation.fly({0: rule}, task).episodes["steps"].mean() for rule in rules)
    assert dodges > 1.7 * stands > 1.7 * random


@pytest.mark.parametrize(
    ("slot", "turns"), [((0, 0, 1, 0.3), True), ((0, 0.8, 0.6, 0.06), True), ((0, 0, 1, 0.9), False)]
)
def test_both_turn_from_what_is_close_ahead_and_fly_on_where_it_is_far(slot, turns):
    seen = torch.tensor([0.0, 0.0, 0.0, 1.0]).repeat(10)
    seen[:4] = torch.tensor(slot)
    yaw, pitch, _ = space.decode(baselines.dodge_in_the_box(seen), SpaceWorld())
    assert bool(yaw or pitch) == turns
    near = slot[3] * 90 - 9 * slot[2] <= 0
    assert BASELINES["reactive"](seen, None, SpaceWorld()).item() == (40 if near else 3)


# -- pictures ------------------------------------------------------------------------------------------------


def test_a_picture_shows_the_slice_through_the_drone_from_above_and_from_the_side():
    task = make_task(torch.tensor([[[600.0, 300.0, 300.0, 50.0], [150.0, 450.0, 500.0, 60.0]]]), task="space")
    picture = drawing.draw_state(by_hand.at(task, (400, 200, 350), 0, 0), task)
    assert picture.shape == (600, 800 + 8 + 800, 3)

    def colour(x, up, view):
        return tuple(int(part) for part in picture[599 - up, x + 808 * view])

    assert colour(410, 190, 0) == colour(410, 340, 1) == drawing.DRONE
    for view in (0, 1):
        assert colour(5, 300, view) == colour(795, 300, view) == colour(300, 5, view) == drawing.BORDER
    # 50 px above it: no slice, a pale silhouette ...
    assert drawing.GROUND != colour(600, 300, 0) != drawing.OBSTACLE
    assert drawing.GROUND != colour(600, 300, 1) != drawing.OBSTACLE  # ... and so 100 px beside it
    assert colour(700, 100, 0) == drawing.GROUND
    cut = drawing.draw_state(by_hand.at(task, (400, 300, 330), 90, 0), task)
    for view, up in ((0, 300 + 39), (1, 300 + 49)):  # sqrt(50^2 - 30^2) = 40 px, and 50 px
        assert tuple(cut[599 - up, 600 + 808 * view]) == drawing.OBSTACLE
    assert tuple(cut[599 - 342, 600]) != drawing.OBSTACLE


def test_a_film_of_an_episode_in_3d_has_both_views_and_a_trail_in_each():
    task = make_task(torch.empty(1, 0, 4), task="space")
    climb = functools.partial(_always, action=4 + 3)
    flown = render.fly(render.Pilot("climbs", climb, task), task.layouts, 0, 12)
    film = render.Film([flown], task.layouts[0], 320)
    assert film[0].shape[1] == 320
    assert (film[0] != film[-1]).any()
    left, right = np.hsplit(np.abs(film[0].astype(int) - film[-1]).sum(-1) > 0, [160])
    assert left.any()
    assert right.any()


def _always(observation, generator=None, action=0):
    return torch.full((len(observation),), action)
