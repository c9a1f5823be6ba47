"""What episodes look like: poses, actions and networks made by hand, whose numbers are known in closed
form.
"""

import math

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from runs_by_hand import rows, write_run

from uavnav.evaluation import BEHAVIOUR_COLUMNS, episodes, fly, on
from uavnav.report import behaviour
from uavnav.report.behaviour import (
    COLUMNS,
    EMPTY_ARENA,
    MEASURES,
    heat,
    measures,
    read,
    retrace,
)
from uavnav.runs import Run
from uavnav.runs.tables import RunError
from uavnav.tasks import layouts
from uavnav.tasks.baselines import BASELINES
from uavnav.tasks.table import make_task
from uavnav.tasks.world import World

WORLD = World()
STOP, FULL_SPEED = 0, 9  # straight ahead, 0 and 9 px


def table(poses=((400, 300),), actions=(STOP,), seed=0, layout=0, mode="greedy"):
    """One episode: poses and actions, of which a single one is repeated."""
    n = max(len(poses), len(actions))
    (x, y), actions = np.array([*poses] * (n // len(poses))).T, [*actions] * (n // len(actions))
    episode = {
        "seed": seed,
        "layout": layout,
        "step": range(1, n + 1),
        "x": x,
        "y": y,
        "heading": 90,
        "clearance": 50.0,
    }
    return pd.DataFrame(episode | {"action": actions})[[*COLUMNS]].astype(COLUMNS).assign(mode=mode)


def drones(names, n_layouts, steps):
    """Episodes of scripted policies on test layouts, the seeds 3 and 4, with their poses."""
    flown = fly(
        {3 + n: BASELINES[name] for n, name in enumerate(names)}, on(make_task(), "test", n_layouts, steps)
    )
    up = torch.full((n_layouts,), 90)
    return retrace(flown.behaviour.assign(mode="sampled"), layouts.load("test")[:n_layouts], up, WORLD)


def turning(*angles, distance=0):
    """The actions that turn by so many degrees, positive to the left."""
    return [angle % 10 * 10 + distance for angle in angles]


def all_layouts(*circles):
    return torch.tensor([circles], dtype=torch.float32).reshape(1, -1, 3)


def one(rows, obstacles=EMPTY_ARENA):
    (row,) = measures(rows, obstacles, WORLD).to_dict("records")
    return row


# -- places --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("circles", "pose", "share"),
    [
        ([(300, 300, 40), (500, 300, 40)], (400, 300), 1.0),  # 60 px to either side
        ([(300, 300, 40)], (400, 300), 0.0),
        ([(300, 300, 40), (310, 320, 40)], (400, 300), 0.0),  # two, on one side
        ([(400, 400, 40), (400, 200, 40)], (400, 300), 1.0),  # ahead and behind count as left and right do
        ([(240, 300, 40), (560, 300, 40)], (400, 300), 1.0),  # exactly 120 px away
        ([(239, 300, 40), (560, 300, 40)], (400, 300), 0.0),  # and one pixel more
        ([(160, 300, 40)], (80, 300), 1.0),  # a wall at 60 px to the left and a circle at 40 px to the right
        ([(80, 300, 40)], (180, 300), 0.0),  # a circle between the wall and the drone
        ([(160, 300, 40)], (300, 300), 0.0),  # a wall that is 280 px away
        ([], (60, 60), 0.0),  # a corner: two walls at right angles
        ([], (400, 300), 0.0),
    ],
)
def test_a_corridor_has_close_bodies_on_opposite_sides(circles, pose, share):
    assert one(table([pose]), all_layouts(*circles))["corridor"] == share


def test_who_stands_in_a_corridor_and_flies_elsewhere_flies_through_none():
    """Four steps between two circles, of which one covers 6 px, and one of 2 px in the open."""
    obstacles, inside, outside = all_layouts((300, 300, 40), (500, 300, 40)), (400, 300), (400, 120)
    found = one(table([inside] * 4 + [outside], [0, 0, 0, 6, 2]), obstacles)
    assert (found["corridor"], found["corridor_path"]) == pytest.approx((0.8, 0.75))
    assert math.isnan(one(table([inside], [0]), obstacles)["corridor_path"])


@pytest.mark.parametrize(("degrees", "share"), [(119, 0.0), (121, 1.0), (180, 1.0), (239, 1.0), (241, 0.0)])
def test_opposite_means_at_least_120_degrees_apart(degrees, share):
    angle = math.radians(degrees)
    circles = all_layouts((500, 300, 40), (400 + 100 * math.cos(angle), 300 + 100 * math.sin(angle), 40))
    assert one(table(), circles)["corridor"] == share


def slow_surroundings(x, y, circles):
    """Distance to the nearest body, and whether the place is a corridor, body by body."""
    bodies = [
        (math.hypot(cx - x, cy - y) - radius, math.degrees(math.atan2(cy - y, cx - x)))
        for cx, cy, radius in circles
    ]
    walls = [(x - 20, 180.0), (780 - x, 0.0), (y - 20, -90.0), (580 - y, 90.0)]
    near = [angle for distance, angle in bodies + walls if distance <= 120]
    corridor = any(120 <= abs(a - b) % 360 <= 240 for a in near for b in near)
    return min(bodies + walls)[0], corridor


def test_episodes_agree_with_a_slow_loop_and_with_the_simulators_clearance():
    obstacles = layouts.load("test")
    flown = drones(["random", "reactive"], 8, 120)
    slow = pd.DataFrame(
        [slow_surroundings(row.x, row.y, obstacles[row.layout].tolist()) for row in flown.itertuples()],
        columns=["clearance", "corridor"],
    ).groupby(flown["seed"])
    assert slow["corridor"].sum().min() > 20
    fast = measures(flown, obstacles, WORLD).set_index("seed")
    assert np.allclose(fast["corridor"], slow["corridor"].mean(), atol=1e-12)
    assert np.allclose(fast["clearance"], slow["clearance"].mean(), atol=1e-3)


def test_places_in_several_chunks_are_those_of_one(monkeypatch):
    rows, obstacles = (
        table([(60 + 17 * n % 700, 60 + 29 * n % 480) for n in range(100)]),
        layouts.load("test"),
    )
    whole = behaviour.corridors(rows, obstacles, WORLD)
    monkeypatch.setattr(behaviour, "CHUNK", 7)
    assert 0 < whole.sum() < 100
    assert (behaviour.corridors(rows, obstacles, WORLD) == whole).all()


QUARTERS = st.integers(200, 2200).map(lambda n: n / 4)  # exact in float32, as is 800 - x


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.tuples(QUARTERS, QUARTERS, st.integers(30, 100)), max_size=6),
    st.lists(st.tuples(QUARTERS, QUARTERS), min_size=1, max_size=9),
)
def test_a_world_and_its_mirror_images_are_alike(circles, poses):
    plain = behaviour.corridors(table(poses), all_layouts(*circles), WORLD)
    for mirror in (lambda x, y, *r: (800 - x, y, *r), lambda x, y, *r: (x, 600 - y, *r)):
        mirrored = (
            table([mirror(*pose) for pose in poses]),
            all_layouts(*(mirror(*circle) for circle in circles)),
        )
        assert (behaviour.corridors(*mirrored, WORLD) == plain).all()


# -- actions -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("angles", "reversals"),
    [
        ((5, -4, 5, -4), 3),
        ((5, 4, 1, 2), 0),
        ((1, 0, -1, 0), 1),
        ((1, 0, 1, -4), 1),
        ((0,) * 4, 0),
        ((-1, 3, 0, -2), 2),
    ],
)
def test_reversals_of_scripted_turns_skip_straight_steps(angles, reversals):
    assert one(table(actions=turning(*angles)))["reversals"] == reversals / 4


def test_a_turn_is_not_compared_with_one_of_another_episode_seed_or_mode():
    left, right = turning(1), turning(-1)
    rows = [table(actions=left), table(actions=right, layout=1), table(actions=left, seed=1)]
    rows.append(table(actions=right, mode="sampled"))
    assert measures(pd.concat(rows), EMPTY_ARENA, WORLD)["reversals"].tolist() == [0, 0, 0]


@settings(max_examples=50, deadline=None)
@given(st.lists(st.lists(st.integers(-4, 5), min_size=1, max_size=9), min_size=1, max_size=3))
def test_reversals_agree_with_a_slow_loop(episodes):
    reversals = 0
    for angles in episodes:
        for now, angle in enumerate(angles):
            before = [earlier for earlier in angles[:now] if earlier]
            reversals += bool(before) and angle * before[-1] < 0
    rows = pd.concat([table(actions=turning(*angles), layout=n) for n, angles in enumerate(episodes)])
    found = one(rows.sample(frac=1, random_state=0))  # in any order
    assert found["reversals"] == pytest.approx(reversals / len(rows))


def test_straight_speed_is_7_and_turning_speed_2():
    actions = [9, 5, *turning(1, -4, 5, distance=2)]
    found = one(table(actions=actions))
    assert (found["straight_speed"], found["turning_speed"]) == (7, 2)
    assert math.isnan(one(table(actions=turning(1)))["straight_speed"])
    assert math.isnan(one(table(actions=[9]))["turning_speed"])


# -- seeds ---------------------------------------------------------------------------------------------------


def test_episodes_weigh_by_their_steps():
    obstacles = all_layouts((300, 300, 40), (500, 300, 40)).expand(2, -1, -1)
    rows = pd.concat([table([(400, 300)]), table([(400, 100)] * 3, layout=1)])
    assert one(rows, obstacles)["corridor"] == 0.25


def test_a_row_for_each_mode_and_seed_that_do_not_see_each_other():
    obstacles = layouts.load("test")
    flown = drones(["random", "random"], 4, 60)
    rows = pd.concat([flown, flown[flown["seed"] == 4].assign(mode="greedy")])
    found = measures(rows, obstacles, WORLD)
    assert {*found.columns} == {"mode", "seed", *MEASURES}
    assert found[["mode", "seed"]].to_numpy().tolist() == [["greedy", 4], ["sampled", 3], ["sampled", 4]]
    for (mode, seed), part in rows.groupby(["mode", "seed"]):
        row = found[(found["mode"] == mode) & (found["seed"] == seed)]
        pd.testing.assert_frame_equal(row.reset_index(drop=True), measures(part, obstacles, WORLD))


def test_no_steps_are_no_rows():
    assert measures(table()[:0], EMPTY_ARENA, WORLD).shape == (0, 2 + len(MEASURES))
    assert heat(table()[:0], WORLD).sum() == 0


def test_heat_weighs_seeds_alike_and_sums_to_1():
    long, short = table([(50, 30)] * 3), table([(50, 30), (799, 599)], seed=1)
    found = heat(pd.concat([long, short]), WORLD)
    assert found.shape == (30, 40)
    assert found[1, 2] == 0.75  # second row from the bottom, third column; pooled it would be 4 / 5
    assert found[29, 39] == 0.25
    assert found.sum() == 1


def test_heat_with_squares_that_do_not_divide_the_window():
    found = heat(table([(800, 600), (0, 0)]), WORLD, square=70)
    assert found.shape == (9, 12)
    assert found[8, 11] == found[0, 0] == 0.5


# -- files ---------------------------------------------------------------------------------------------------


def unevaluated(path, **config):
    """A finished run of DQN's seed 0 that has not flown."""
    return Run(write_run(path, rows(0), **config))


def test_episodes_in_the_empty_arena_are_read_with_poses_from_the_four_headings_and_none_where_there_is_none(
    tmp_path,
):
    """A step of 9 px each way leaves 271 px to the wall above and below, and 291 beside."""
    run = unevaluated(tmp_path / "run")
    assert read(run, in_arena=True) is None
    flown = pd.concat([table(layout=layout, actions=[STOP, FULL_SPEED]) for layout in range(4)])
    flown[[*BEHAVIOUR_COLUMNS, "mode"]].to_parquet(run.path / "arena.parquet")
    found = read(run, in_arena=True)
    assert found["heading"].tolist() == [0, 0, 90, 90, 180, 180, 270, 270]
    assert found["clearance"].tolist() == [280, 280, 280, 271, 280, 280, 280, 271]
    flown.assign(layout=4).to_parquet(run.path / "arena.parquet")
    with pytest.raises(RunError, match=r"arena\.parquet: has layout=4; evaluate the run again"):
        read(run, in_arena=True)


def test_a_file_holds_actions_and_is_read_with_their_poses_and_none_where_there_is_none(tmp_path):
    run = unevaluated(tmp_path / "run")
    assert read(run) is None
    written = table(actions=[FULL_SPEED, *turning(5, distance=2)])
    written[[*BEHAVIOUR_COLUMNS, "mode"]].to_parquet(run.path / "behaviour.parquet")
    found = read(run)
    assert {*found.columns} == {*COLUMNS, "mode"}
    assert found["step"].tolist() == [1, 2]
    assert found["heading"].tolist() == [90, 95]
    assert found["x"].tolist() == pytest.approx([400, 400 + 2 * math.cos(math.radians(95))], abs=1e-4)
    assert found["y"].tolist() == pytest.approx([309, 309 + 2 * math.sin(math.radians(95))], abs=1e-4)
    distances = [
        slow_surroundings(row.x, row.y, layouts.load("test")[0].tolist())[0] for row in found.itertuples()
    ]
    assert found["clearance"].tolist() == pytest.approx(distances, abs=1e-3)


def test_of_the_modes_of_a_file_the_wanted_ones_are_read_as_with_the_others(tmp_path):
    run = unevaluated(tmp_path / "run")
    greedy, sampled = table(actions=[FULL_SPEED] * 3), table(actions=[STOP, FULL_SPEED])
    flown = pd.concat([greedy.assign(mode="greedy"), sampled.assign(mode="sampled")])
    flown[[*BEHAVIOUR_COLUMNS, "mode"]].to_parquet(run.path / "behaviour.parquet")
    both, one = read(run), read(run, modes=["sampled"])
    assert both["mode"].value_counts().to_dict() == {"greedy": 3, "sampled": 2}
    pd.testing.assert_frame_equal(one, both[both["mode"] == "sampled"])
    assert measures(read(run, modes=[]), layouts.load("test"), WORLD).empty


def test_a_file_from_before_poses_were_left_out_is_read_alike(tmp_path):
    run = unevaluated(tmp_path / "run")
    table([(1, 2)]).to_parquet(run.path / "behaviour.parquet")  # whose poses are not looked at
    assert read(run)[["x", "y"]].to_numpy().tolist() == [[400, 300]]


def test_episodes_of_a_run_with_random_headings_begin_with_those_of_its_evaluation(tmp_path):
    run = unevaluated(tmp_path / "run", world={"start_heading": "random"})
    stops = pd.concat([table(layout=layout) for layout in range(10)])
    stops.to_parquet(run.path / "behaviour.parquet")
    begun = episodes.headings(on(make_task(world=World(start_heading="random"))), 200)[:10]
    assert read(run)["heading"].tolist() == begun.tolist()
    assert len(set(begun.tolist())) > 5


@pytest.mark.parametrize("compiled", [False, True])
def test_retraced_episodes_are_where_the_simulator_was_bit_for_bit(compiled, monkeypatch):
    """Random drones and reactive ones, side by side; an episode of 300 steps, of which rounding would
    show.
    """
    monkeypatch.setattr("uavnav.training.machine.episodes", lambda limit: compiled)
    monkeypatch.setattr("uavnav.training.machine.EAGER_STEPS", 3)
    task, parts = on(make_task(), "test", 6, 300), []
    for step in episodes.steps([(0, BASELINES["random"]), (1, BASELINES["reactive"])], task):
        seen = {name: getattr(step.state, name) for name in ("layout", "steps", "x", "y", "heading")}
        more = {"seed": step.episode // 6, "action": step.action, "clearance": step.outcome.clearance}
        parts.append(pd.DataFrame({name: column.numpy() for name, column in (seen | more).items()}))
    there = pd.concat(parts).rename(columns={"steps": "step"}).astype(COLUMNS).assign(mode="sampled")
    found = retrace(there, task.layouts, torch.full((6,), 90), WORLD)
    assert len(found) > 600
    for name in ("step", "x", "y", "heading"):
        assert (found[name].to_numpy() == there[name].to_numpy()).all(), name
    assert np.allclose(found["clearance"], there["clearance"], rtol=0, atol=1e-4)
    # two episodes taken for one
    wrong = retrace(there.assign(seed=0), task.layouts, torch.full((6,), 90), WORLD)
    assert np.abs(wrong["x"].to_numpy() - there["x"].to_numpy()).max() > 100


def with_header(rows, **protocol):
    rows.attrs = protocol
    return rows


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: rows.drop(columns="layout"), "its columns are not a run's, layout is no int64"),
        (lambda rows: rows.astype({"action": "float64"}), "action is no int16"),
        (lambda rows: rows.assign(seed=7), "has seed=7"),
        (lambda rows: rows.assign(mode="best"), "has mode=best"),
        (lambda rows: rows.assign(layout=1000), "has layout=1000"),
        (lambda rows: rows.assign(action=rows["action"] + 100), "has action=100"),
        (
            lambda rows: with_header(rows, layouts="train"),
            "episodes on layouts=train; only those of drones on test",
        ),
    ],
)
def test_a_foreign_table_is_refused_in_one_line(tmp_path, change, message):
    run = unevaluated(tmp_path / "run")
    change(table()).to_parquet(run.path / "behaviour.parquet")
    with pytest.raises(RunError, match=f"behaviour.parquet: .*{message}") as caught:
        read(run)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (
            {"task": "glider"},
            r"behaviour\.parquet: episodes of task=glider; only those of drones on test",
        ),
        (
            {"task": "moving", "world": {"speed_min": 1.0}},
            r"episodes of task=moving; only those of drones on test",
        ),
        ({"world": {"width": 790}}, r"config\.yaml: .*; not a run of this package"),
        ({"world": {"wind": 1}}, r"config\.yaml: .*wind.*; not a run of this package"),
    ],
)
def test_episodes_of_another_world_than_the_drones_are_refused_in_one_line(tmp_path, config, message):
    run = unevaluated(tmp_path / "run", **config)
    table().to_parquet(run.path / "behaviour.parquet")
    with pytest.raises(RunError, match=message) as caught:
        read(run)
    assert "\n" not in str(caught.value)


def test_a_damaged_table_is_refused_in_one_line(tmp_path):
    run = unevaluated(tmp_path / "run")
    (run.path / "behaviour.parquet").write_bytes(b"x" * 100)
    with pytest.raises(
        RunError, match=r"behaviour.parquet: missing or damaged; evaluate the run again"
    ) as caught:
        read(run)
    assert "\n" not in str(caught.value)
