"""Layout files: what ships and how it is distributed; how a bad file is refused: `bad_input`."""

import functools
import math

import pytest
import torch
from scipy import stats

import uavnav
from uavnav.cli import commands
from uavnav.tasks import circles, goal, layouts, moving
from uavnav.tasks.goal import GoalWorld
from uavnav.tasks.moving import MovingWorld
from uavnav.tasks.space import SpaceWorld

write_layouts = functools.partial(commands.run, "layouts")

SHAPES = {"train": (10_000, 8, 3), "validation": (1_000, 8, 3), "test": (1_000, 8, 3)}
SEEDS = {"train": 0, "validation": 2, "test": 1}


@pytest.fixture(scope="module")
def train():
    return layouts.load("train")


@pytest.fixture(scope="module")
def obstacles(train):
    """All 80,000 obstacles of the training split: x, y, radius and the distance of the centre to the
    start, in px.
    """
    x, y, radius = train.double().reshape(-1, 3).T.numpy()
    return x, y, radius, ((x - 400) ** 2 + (y - 300) ** 2) ** 0.5


@pytest.mark.parametrize("split", SHAPES)
def test_the_shipped_layout_files_of_10000_and_1000_and_1000_layouts_are_what_their_headers_generate(split):
    all_layouts, header = layouts.read(split)
    assert all_layouts.shape == SHAPES[split]
    assert all_layouts.dtype == torch.float32
    assert header["split"] == split
    assert header["world_version"] == "1"
    assert (int(header["n"]), int(header["k"])) == SHAPES[split][:2]
    assert (
        layouts.SPLITS[split]
        == (SHAPES[split][0], SEEDS[split])
        == (int(header["n"]), int(header["generator_seed"]))
    )
    assert torch.equal(all_layouts, layouts.generate(SHAPES[split][0], 8, SEEDS[split]))
    assert layouts.check(split)[1] == header
    assert torch.equal(all_layouts, layouts.load(split))


def test_no_obstacle_of_96000_is_in_two_of_the_three_splits_or_twice_in_one(train):
    everything = torch.cat([train, layouts.load("validation"), layouts.load("test")]).reshape(-1, 3)
    assert len(torch.unique(everything, dim=0)) == 96_000


def test_radii_are_uniform_from_30_to_100_px(obstacles):
    _, _, radius, _ = obstacles
    assert 30 <= radius.min() < 30.01
    assert 99.99 < radius.max() <= 100
    assert radius.mean() == pytest.approx(65, abs=4 * 70 / math.sqrt(12 * len(radius)))
    assert stats.kstest(radius, stats.uniform(30, 70).cdf).pvalue > 0.01


def test_centres_are_uniform_where_the_safe_zone_of_150_px_does_not_reach(obstacles):
    x, y, _, _ = obstacles
    assert min(x.min(), y.min()) >= 0
    assert x.max() <= 800
    assert y.max() <= 600
    assert stats.kstest(x[abs(y - 300) > 150], stats.uniform(0, 800).cdf).pvalue > 0.01
    assert stats.kstest(y[abs(x - 400) > 150], stats.uniform(0, 600).cdf).pvalue > 0.01


def test_centres_within_200_px_of_the_start_are_as_many_as_redrawing_gives(obstacles):
    # A centre is uniform over the window without the disc of radius + 50 px, whatever the radius.
    _, _, radius, distance = obstacles
    hole = math.pi * (radius + 50) ** 2
    chance = (math.pi * 200**2 - hole) / (800 * 600 - hole)
    error = (chance * (1 - chance)).sum() ** 0.5
    assert (distance < 200).sum() == pytest.approx(chance.sum(), abs=4 * error)


def test_every_edge_is_at_least_50_px_from_the_start(obstacles):
    _, _, radius, distance = obstacles
    assert 50 <= (distance - radius).min() < 50.2


def test_the_seed_alone_decides_five_sets():
    all_layouts = layouts.generate(5, 8, seed=3)
    assert torch.equal(all_layouts, layouts.generate(5, 8, seed=3))
    assert not torch.isin(all_layouts, layouts.generate(5, 8, seed=4)).any()


def test_five_layouts_have_eight_obstacles_of_seed_0_where_nothing_else_is_said():
    assert torch.equal(layouts.generate(5), layouts.generate(5, 8, 0))


def test_obstacles_and_layouts_are_bounded_in_all():
    for n, k in ((circles.MOST_OBSTACLES // 2 + 1, 2), (circles.MOST_OBSTACLES + 1, 0)):
        with pytest.raises(uavnav.LayoutError, match=f"n={n}, k={k}; give at most"):
            circles.generate(n, k)


def test_radii_of_30_and_100_px_and_centres_on_the_windows_edge_are_valid_and_beyond_are_not():
    corners = torch.tensor([[[0, 0, 30, 0, 0], [800, 600, 100, 0, 0]]], dtype=torch.float32)
    moving.validate(corners)
    for place, value in ((2, 29.99), (2, 100.01), (0, -0.01), (1, 600.01)):
        wrong = corners.clone()
        wrong[0, 0, place] = value
        with pytest.raises(uavnav.LayoutError):
            moving.validate(wrong)


def test_no_obstacle_at_all_is_a_valid_split(tmp_path):
    empty = layouts.generate(4, 0, seed=0)
    assert empty.shape == (4, 0, 3)
    layouts.save(empty, tmp_path / "empty.safetensors", seed=0, split="test")
    assert torch.equal(layouts.load(tmp_path / "empty.safetensors"), empty)


def test_a_layout_file_saved_and_read_again_is_bit_identical_with_six_entries_in_its_header(tmp_path):
    all_layouts = layouts.generate(7, 5, seed=9)
    path = tmp_path / "new folder" / "mine.safetensors"
    layouts.save(all_layouts, path, seed=9, split="train")
    again, header = layouts.read(path)
    assert torch.equal(again, all_layouts)
    assert {key: header[key] for key in ("world_version", "generator_seed", "n", "k", "split")} == {
        "world_version": "1",
        "generator_seed": "9",
        "n": "7",
        "k": "5",
        "split": "train",
    }
    assert len(header) == 6
    assert [file.name for file in path.parent.iterdir()] == ["mine.safetensors"]
    assert torch.equal(layouts.load(str(path)), all_layouts)


def test_the_command_writes_three_layout_files_and_checks_them(tmp_path, capsys):
    assert write_layouts(["--out", str(tmp_path), "--n", "20", "--k", "3"]) == 0
    assert capsys.readouterr().out.count("\n") == 3
    for split, seed in SEEDS.items():
        assert torch.equal(layouts.load(tmp_path / f"{split}.safetensors"), layouts.generate(20, 3, seed))
    assert write_layouts(["--check", str(tmp_path / "train.safetensors"), *SHAPES]) == 0
    assert capsys.readouterr().out.count("as generated by seed") == 4


def test_the_command_writes_one_split_of_a_split_and_a_seed(tmp_path):
    assert write_layouts(["--out", str(tmp_path), "--split", "validation", "--n", "5", "--seed", "9"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["validation.safetensors"]
    all_layouts, header = layouts.read(tmp_path / "validation.safetensors")
    assert torch.equal(all_layouts, layouts.generate(5, 8, seed=9))
    assert (header["split"], header["generator_seed"]) == ("validation", "9")


DRAWN_BY = [
    (uavnav.World(obstacle_radius_max=50.0), {"obstacle_radius_max": "50.0"}),
    (uavnav.World(width=1600, safe_zone=80.0), {"width": "1600", "safe_zone": "80.0"}),
    (MovingWorld(obstacle_radius_min=50), {"obstacle_radius_min": "50.0"}),
    (GoalWorld(height=900), {"height": "900"}),
    (uavnav.World(height=300, sensor_radius=90.0), {"height": "300", "sensor_radius": "90.0"}),
    (SpaceWorld(depth=400), {"depth": "400"}),
    (MovingWorld(speed_max=3.0), {}),
]


@pytest.mark.parametrize(("world", "told"), DRAWN_BY)
def test_a_header_has_the_fields_of_every_world_that_its_layouts_were_drawn_by_and_that_are_not_as_usual(
    world, told, tmp_path
):
    kind, path = layouts.KINDS[layouts.kind_of(world)], tmp_path / "own.safetensors"
    all_layouts = kind.generate(3, 4, 7, world)
    layouts.save(all_layouts, path, seed=7, split="train", world=world)
    found, header = layouts.check(path)
    assert torch.equal(found, all_layouts)
    assert {name: header[name] for name in layouts.SHAPES if name in header} == told


def test_a_wrong_file_with_the_name_of_its_split_is_no_rung_and_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    layouts.save(layouts.generate(3, 4, seed=1), "mine", seed=0, split="mine")
    with pytest.raises(uavnav.LayoutError, match="mine: is not what seed 0 generates; generate it anew"):
        layouts.check("mine")


def test_an_invalid_split_is_not_written(tmp_path):
    all_layouts = layouts.generate(20, 4)
    all_layouts[3, 1] = torch.tensor([400.0, 420.0, 80.0])  # its edge is 40 px from the start
    with pytest.raises(uavnav.LayoutError, match="obstacle 1 of layout 3"):
        layouts.save(all_layouts, tmp_path / "layouts", seed=0, split="train")
    assert list(tmp_path.iterdir()) == []


def test_a_world_without_room_for_an_obstacle_or_for_a_way_to_a_goal_is_refused():
    with pytest.raises(uavnav.LayoutError, match="safe_zone=480: an obstacle with a radius of"):
        circles.generate(10, 8, 0, MovingWorld(safe_zone=480.0))
    with pytest.raises(
        uavnav.LayoutError, match="goal_radius=1e-09: ways are measured from place to place; give 5 px"
    ):
        goal.generate(1, 8, 0, goal.GoalWorld(goal_radius=1e-9))


@pytest.mark.filterwarnings("error")
def test_a_split_of_goals_that_is_refused_does_not_first_say_how_long_it_takes():
    with pytest.raises(uavnav.LayoutError, match="goal_radius=3: ways are measured"):
        layouts.load("train", goal.GoalWorld(goal_radius=3))
    with pytest.raises(UserWarning, match="10,000 layouts with goals are drawn"):  # the negative control
        layouts.load("train", goal.GoalWorld(goal_radius=30))
