"""Ladders of the paper's world: their layouts, what they count, and the task of each rung."""

import functools
import itertools

import oracle
import pytest
import torch
from posed import agree_with_the_oracle, random_poses

import uavnav
from uavnav import evaluation
from uavnav.runs import metrics
from uavnav.tasks import circles, layouts, slalom
from uavnav.tasks.baselines import BASELINES, straight_ahead
from uavnav.tasks.faults import NAMES, NO_FAULTS
from uavnav.tasks.ladders import LADDERS, measure_of
from uavnav.tasks.moving import Moving
from uavnav.tasks.space import SpaceMoving
from uavnav.tasks.table import EMPTY, make_task

# -- layouts -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("split", layouts.SPLITS)
def test_eight_obstacles_of_the_density_ladder_are_the_papers_layout_files(split):
    all_layouts, header = layouts.read(f"density-8/{split}")
    assert torch.equal(all_layouts, layouts.load(split))
    assert header["sha256"] == layouts.read(split)[1]["sha256"]
    assert (header["split"], header["generator_seed"]) == (
        f"density-8/{split}",
        str(layouts.SPLITS[split].seed),
    )
    assert layouts.check(f"density-8/{split}")[1] == header


def test_each_of_11_densities_has_so_many_obstacles_and_no_set_of_training_in_the_test():
    for k in LADDERS["density"].rungs:
        test, validation = layouts.load(f"density-{k}/test"), layouts.load(f"density-{k}/validation")
        assert test.shape == validation.shape == (1000, k, 3)
        assert k == 0 or not torch.isin(test, validation).all(-1).any()


@pytest.mark.parametrize(
    ("task", "n", "shape"), [("moving", 1000, (4, 5)), ("goal", 100, (5, 3)), ("space", 1000, (4, 4))]
)
def test_every_world_has_layout_files_of_so_many_obstacles_and_the_paper_s_alone_a_slalom(
    task, n, shape, monkeypatch
):
    """Of the goal's the first hundred: for each set a shortest way is searched."""
    monkeypatch.setitem(layouts.SPLITS, "test", layouts.SPLITS["test"]._replace(n=n))
    # such a layout file is not kept for other tests
    monkeypatch.setattr(layouts, "_drawn", layouts._drawn.__wrapped__)
    made = make_task("density-4/test", task=task)
    assert made.layouts.shape == (n, *shape)
    assert made.obstacles(made.start(torch.tensor([0]), torch.tensor([90]))).shape[1] == 4
    with pytest.raises(
        layouts.LayoutError, match=f"a slalom is of task=drone, not of task={task}; give density-8"
    ):
        make_task("slalom-80/test", task=task)


def columns_of(layouts):
    """Lowest and highest edge of each circle that is there [px], from the bottom up, by set and column."""
    for row in layouts.double().tolist():
        for column, x in enumerate((150, 290, 510, 650)):
            places = row[12 * column : 12 * column + 12]
            there = [place for place in places if place[0] != -1000]
            assert all(place == [-1000, -1000, 30] for place in places[len(there) :])
            assert all((place[0], place[2]) == (x, 30) for place in there)
            yield [(place[1] - 30, place[1] + 30) for place in there]


@pytest.mark.parametrize("gap", LADDERS["slalom"].rungs)
def test_each_column_has_one_gap_of_so_many_px_and_none_other_that_lets_a_drone_through(gap):
    layouts = slalom.generate(60, gap, seed=3)
    assert layouts.shape == (60, 48, 3)
    circles.validate(layouts)
    middles = []
    for edges in columns_of(layouts):
        holes = [(low - high, (low + high) / 2) for (_, high), (low, _) in itertools.pairwise(edges)]
        wide = [(size, middle) for size, middle in holes if size > 1e-3 and size >= 60]
        assert len(wide) == 1
        assert wide[0][0] == pytest.approx(gap, abs=1e-3)
        assert edges[0][0] < 20 + 60
        assert edges[-1][1] > 580 - 60
        middles.append(wide[0][1])
    assert 60 + gap / 2 <= min(middles) < 60 + gap / 2 + 30
    assert 540 - gap / 2 - 30 < max(middles) <= 540 - gap / 2


@pytest.mark.parametrize("drawn", oracle.SWITCHES[::3])
def test_at_5000_poses_in_a_slalom_a_place_without_a_circle_is_never_sensed_and_never_hit(drawn):
    task = make_task("slalom-80/test", drawn)
    poses = (*random_poses(5000, 1)[:3], task.layouts.repeat(5, 1, 1))
    assert agree_with_the_oracle(poses, task.world, there=lambda circle: circle[0] != -1000) < 0.05


# -- what they count -----------------------------------------------------------------------------------------


def test_an_episode_across_a_column_and_back_has_two_passages():
    task = make_task(EMPTY)
    state = task.start(torch.tensor([0, 0]), torch.tensor([0, 180]))  # columns are 110 px away on both sides
    counted = torch.zeros(2, dtype=torch.int64)
    for action in (*[9] * 13, *[50] * 36, *[9] * 3):
        before, (state, _) = state, task.step(state, torch.tensor([action, action]))
        counted += slalom.passages(before, state)["passages"]
        assert slalom.passages(before, before)["passages"].sum() == 0
    assert counted.tolist() == [2, 2]


def test_an_evaluation_on_a_slalom_has_a_column_of_passages_and_two_metrics_of_it():
    task = evaluation.on(make_task(EMPTY), "slalom-160/test", 6, 40)
    policies = {0: BASELINES["random"], 1: straight_ahead}
    rows = evaluation.fly_modes({"": policies}, task, measure=slalom.passages).episodes
    assert rows.groupby("seed")["passages"].sum()[1] == 0  # up, between two columns
    own = metrics.own(rows)
    assert list(own.columns) == ["passages_per_1000_steps", "passages_per_episode"]
    flown = rows[rows["seed"] == 0]
    assert own.loc[0, "passages_per_episode"] == flown["passages"].mean()
    assert own.loc[0, "passages_per_1000_steps"] == 1000 * flown["passages"].sum() / flown["steps"].sum()
    assert metrics.own(rows.drop(columns="passages")).empty


def test_a_slalom_s_file_of_any_name_is_what_its_header_generates_and_counts_passages(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, gap in (("rows.safetensors", 80), ("density-12.safetensors", 90)):
        layouts.save(slalom.generate(4, gap, 7), name, seed=7, split=f"slalom-{gap}/train")
        assert len(layouts.check(name)[0]) == 4
        assert measure_of(name) is measure_of(tmp_path / name) is slalom.passages
    layouts.save(slalom.generate(4, 80, 8), "rows.safetensors", seed=7, split="slalom-80/train")
    with pytest.raises(uavnav.LayoutError, match=r"rows.safetensors: is not what seed 7 generates"):
        layouts.check("rows.safetensors")
    layouts.save(layouts.generate(4, 8, 7), "slalom-80.safetensors", seed=7, split="train")
    (tmp_path / "test").write_text("no layouts")  # a split is one of the package, whatever lies here
    assert measure_of("slalom-80.safetensors") is measure_of("test") is None


def test_a_layout_file_that_is_drawn_when_it_is_asked_for_is_ones_own():
    layouts.load("slalom-100/test")[:] = 0
    assert layouts.load("slalom-100/test").any()


# -- the task of a rung --------------------------------------------------------------------------------------


def test_the_rungs_of_faults_of_fields_and_of_speed_are_those_of_the_tasks_own_table():
    assert {name: ladder.rungs for name, ladder in LADDERS.items() if name not in ("density", "slalom")} == {
        "arc": (60, 90, 120, 180),
        "reach": (60, 90, 120, 160),
        "speed": (0, 1, 2, 3, 4, 6),
        "noise": (0, 2, 5, 10, 20),
        "lost": (0, 0.05, 0.1, 0.2, 0.4),
        "late": (0, 1, 2, 4, 8),
        "sticky": (0, 0.1, 0.25, 0.5),
    }


@pytest.mark.parametrize("name", LADDERS)
def test_on_each_rung_a_policys_world_differs_in_the_ladders_field_alone(name):
    own = make_task(EMPTY, {"padding": "zeros"}, max_steps=50)
    for rung in LADDERS[name].rungs:
        task = LADDERS[name].task(own, rung, "validation")
        assert (task.max_steps, task.world.padding, len(task.layouts)) == (50, "zeros", 1000)
        assert task.world.sensor_arc == (rung if name == "arc" else 180)
        assert task.world.sensor_radius == (rung if name == "reach" else 120)
        assert task.faults == (NO_FAULTS.replace(**{name: rung}) if name in NAMES else NO_FAULTS)
        draws = task.draw(3, torch.Generator().manual_seed(0))
        start = task.start(torch.arange(3), torch.full((3,), 90), draws)
        state, outcome = task.step(start, torch.tensor([9, 9, 9]), draws)
        assert outcome.observation.shape == (3, 30)
        if name == "speed":
            assert type(task.task) is Moving
            fastest = task.velocities(state).norm(dim=-1).max().item()
            assert rung * 0.8 <= fastest <= rung + 1e-6 or rung == 0


@pytest.mark.parametrize("name", ["space", "space-moving"])
def test_spheres_of_the_ladder_of_speeds_fly_up_to_6_px_a_step_and_at_0_stand_as_those_of_space(name):
    own, rows = make_task(EMPTY, {"padding": "zeros"}, max_steps=50, task=name), torch.arange(200)
    for rung in LADDERS["speed"].rungs:
        task = LADDERS["speed"].task(own, rung, "test")
        assert (type(task.task), task.max_steps, task.world.padding) == (SpaceMoving, 50, "zeros")
        fastest = task.velocities(task.start(rows, torch.full((200,), 90))).norm(dim=-1).max().item()
        assert rung * 0.99 <= fastest <= rung + 1e-5
    # velocities are sensed by the greatest of training, 2 px a step, and clamped
    sensing = make_task(EMPTY, {"sense_velocity": True, "sensor_radius": 250.0}, task="space-moving")
    fast = LADDERS["speed"].task(sensing, 6, "test")
    velocity = fast.observe(fast.start(rows, torch.full((200,), 90)))[0].reshape(200, 10, -1)[..., 4:]
    assert (velocity.min(), velocity.max()) == (-1, 1)
    still = make_task("test", {"padding": "zeros"}, task="space")
    slow = LADDERS["speed"].task(own, 0, "test")
    both = [one.start(rows, torch.full((200,), 90)) for one in (still, slow)]
    generator = torch.Generator().manual_seed(0)
    for _ in range(10):
        action = torch.randint(100, (200,), generator=generator)
        stepped = [one.step(state, action) for one, state in zip((still, slow), both, strict=True)]
        both = [state for state, _ in stepped]
        assert torch.equal(*(outcome.observation for _, outcome in stepped))


def test_on_all_rungs_of_arc_and_reach_5000_poses_equal_a_slow_loop_whose_proximity_is_that_of_training():
    """Half of them with noise and losses."""
    own = make_task(EMPTY, {"sensor_radius": 100.0}, faults={"noise": 5, "lost": 0.2})
    arenas = {("arc", rung): oracle.Arena(arc=rung, sensor=100) for rung in LADDERS["arc"].rungs}
    arenas |= {("reach", rung): oracle.Arena(sensor=rung, trained=100) for rung in LADDERS["reach"].rungs}
    x, y, heading, circles = random_poses(5000, 3)
    layout, draws = torch.arange(5000), own.draw(5000, torch.Generator().manual_seed(3))
    draws[::2, :10], draws[::2, 10:] = 0, 1
    found = [
        oracle.look(*pose) for pose in zip(*(part.tolist() for part in (x, y, heading, circles)), strict=True)
    ]

    def hear(nth, distance, given):
        return None if given[10 + nth] < 0.2 else distance + 5 * given[nth]

    heard = [functools.partial(hear, given=row) for row in draws.tolist()]
    for (name, rung), arena in arenas.items():
        task = LADDERS[name].task(own, rung, "test").replace(layouts=circles)
        seen = task.remember(task.task.start(layout, heading)._replace(x=x, y=y), draws).seen[:, 0]
        kept = [row for row in range(5000) if not oracle.doubtful(found[row], arena)]
        expected = [oracle.slots_of(found[row], arena=arena, hear=heard[row]) for row in kept]
        assert len(kept) > 4500
        torch.testing.assert_close(seen[kept], torch.tensor(expected).flatten(1), rtol=0, atol=1e-4)


def test_a_proximity_is_1_from_the_reach_of_training_on_and_less_within_it():
    task = (
        LADDERS["reach"]
        .task(make_task(EMPTY), 160, "test")
        .replace(layouts=torch.tensor([[[400.0, 480.0, 30.0]]]))
    )
    state = task.start(torch.tensor([0]), torch.tensor([90]))
    assert task.observe(state)[0][0, :3].tolist() == [0, 1, 1]  # 150 px away, out of the old sensor's reach
    near = task.observe(state._replace(y=torch.tensor([375.0])))[0][0, :3]
    assert near.tolist() == pytest.approx([0, 1, 0.5])  # 75 px away


def test_at_its_own_reach_a_policy_flies_the_very_same_task():
    own = make_task(EMPTY)
    assert LADDERS["reach"].task(own, 120, "test").trained_reach is None
