"""Layout files: what ships, how it is distributed, and how a bad file is refused."""

import functools
import math

import pytest
import torch
from safetensors.torch import save_file
from scipy import stats

import uavnav
from uavnav.cli import commands
from uavnav.tasks import circles, goal, layouts
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
def test_the_shipped_layout_files_of_10000_and_1000_and_1000_sets_are_what_their_headers_generate(split):
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


def test_the_command_writes_one_split_of_a_split_and_a_seed(tmp_path, capsys):
    assert write_layouts(["--out", str(tmp_path), "--split", "validation", "--n", "5", "--seed", "9"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["validation.safetensors"]
    all_layouts, header = layouts.read(tmp_path / "validation.safetensors")
    assert torch.equal(all_layouts, layouts.generate(5, 8, seed=9))
    assert (header["split"], header["generator_seed"]) == ("validation", "9")
    capsys.readouterr()
    assert "or all splits would have the same layouts" in refused_in_one_line(["--seed", "3"], capsys)


def refused_in_one_line(arguments, capsys):
    assert write_layouts(arguments) == 2
    out, error = capsys.readouterr()
    assert out == ""
    assert error.count("\n") == 1
    return error


def test_the_command_refuses_in_one_line_and_ends_with_2(tmp_path, capsys):
    assert "n=-1" in refused_in_one_line(["--out", str(tmp_path), "--n", "-1"], capsys)
    assert "n > 0" in refused_in_one_line(["--out", str(tmp_path), "--n", "0"], capsys)
    assert "nowhere" in refused_in_one_line(["--check", str(tmp_path / "nowhere")], capsys)
    layouts.save(layouts.generate(20, 3, seed=5), tmp_path / "layouts", seed=6, split="train")
    assert "not what seed 6 generates" in refused_in_one_line(["--check", str(tmp_path / "layouts")], capsys)


def test_a_folder_that_is_a_file_is_refused_in_one_line(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert str(tmp_path / "file") in refused_in_one_line(
        ["--out", str(tmp_path / "file"), "--n", "1"], capsys
    )


def rewritten(change=lambda all_layouts: all_layouts, name="obstacles", **header):
    def damage(path):
        all_layouts, old = layouts.read(path)
        save_file({name: change(all_layouts).contiguous()}, path, metadata=old | header)

    return damage


def put(column, value):
    def change(layouts):
        layouts[1, 2, column] = value
        return layouts

    return change


def onto_the_start(layouts):
    layouts[3, 1] = torch.tensor([400.0, 420.0, 80.0])  # its edge is 40 px away
    return layouts


def flipped(path):
    data = bytearray(path.read_bytes())
    data[-4] ^= 1  # the lowest bit of the last radius: still a valid number
    path.write_bytes(data)


def a_directory(path):
    path.unlink()
    path.mkdir()


DAMAGES = {
    "missing": (lambda path: path.unlink(), "no such layout file; choose from train, validation, test"),
    "a directory": (a_directory, "no such layout file"),
    "truncated": (lambda path: path.write_bytes(path.read_bytes()[:-5]), "not a readable layout file"),
    "nearly all gone": (lambda path: path.write_bytes(path.read_bytes()[:5]), "not a readable layout file"),
    "empty": (lambda path: path.write_bytes(b""), "not a readable layout file"),
    "not safetensors": (
        lambda path: path.write_text("x,y,radius\n1,2,30\n" * 9),
        "not a readable layout file",
    ),
    "one bit flipped": (flipped, "checksum"),
    "other numbers": (rewritten(put(2, 77.0)), "checksum"),
    "no header": (lambda path: save_file({"obstacles": layouts.load(path)}, path), "world version"),
    "another version": (rewritten(world_version="0"), "world version 0, this is 1"),
    "another tensor": (rewritten(name="circles"), "no tensor `obstacles`"),
    "float64": (rewritten(lambda all_layouts: all_layouts.double()), "float32, not float64"),
    "whole numbers": (rewritten(lambda all_layouts: all_layouts.long()), "float32, not int64"),
    "two axes": (rewritten(lambda all_layouts: all_layouts[0]), "not [4, 3]"),
    "two columns": (rewritten(lambda all_layouts: all_layouts[..., :2]), "not [20, 4, 2]"),
    "no sets": (rewritten(lambda all_layouts: all_layouts[:0]), "not [0, 4, 3]"),
    "nan": (rewritten(put(0, math.nan)), "obstacle 2 of set 1 is not finite"),
    "infinite": (rewritten(put(1, math.inf)), "obstacle 2 of set 1 is not finite"),
    "nan radius": (rewritten(put(2, math.nan)), "obstacle 2 of set 1 is not finite"),
    "too small": (rewritten(put(2, 29.9)), "obstacle 2 of set 1 has a radius outside 30 ... 100 px"),
    "too large": (rewritten(put(2, 100.1)), "obstacle 2 of set 1 has a radius outside 30 ... 100 px"),
    "in the safe zone": (rewritten(onto_the_start), "obstacle 1 of set 3 is nearer than 50 px to the start"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_each_of_22_damaged_files_is_refused_in_one_line_that_says_what_is_wrong(name, tmp_path):
    path = tmp_path / "own.safetensors"
    layouts.save(layouts.generate(20, 4, seed=0), path, seed=0, split="train")
    damage, reason = DAMAGES[name]
    damage(path)
    with pytest.raises(uavnav.LayoutError) as refused:
        layouts.load(path)
    message = str(refused.value)
    assert str(path) in message
    assert reason in message
    assert "\n" not in message


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
def test_a_header_has_the_fields_of_every_world_that_its_sets_were_drawn_by_and_that_are_not_as_usual(
    world, told, tmp_path
):
    kind, path = layouts.KINDS[layouts.kind_of(world)], tmp_path / "own.safetensors"
    all_layouts = kind.generate(3, 4, 7, world)
    layouts.save(all_layouts, path, seed=7, split="train", world=world)
    found, header = layouts.check(path)
    assert torch.equal(found, all_layouts)
    assert {name: header[name] for name in layouts.SHAPES if name in header} == told


@pytest.mark.parametrize("header", [{"generator_seed": "seven"}, {"generator_seed": ""}])
def test_a_header_whose_seed_is_no_number_is_refused_in_one_line(header, tmp_path, capsys):
    path = tmp_path / "own.safetensors"
    layouts.save(layouts.generate(20, 4, seed=0), path, seed=0, split="train")
    rewritten(**header)(path)
    assert str(path) in refused_in_one_line(["--check", str(path)], capsys)


def test_an_invalid_split_is_not_written(tmp_path):
    with pytest.raises(uavnav.LayoutError, match="obstacle 1 of set 3"):
        layouts.save(onto_the_start(layouts.generate(20, 4)), tmp_path / "layouts", seed=0, split="train")
    assert list(tmp_path.iterdir()) == []


def test_a_negative_number_of_sets_or_obstacles_is_refused():
    with pytest.raises(uavnav.LayoutError, match="n=-1"):
        layouts.generate(-1)
    with pytest.raises(uavnav.LayoutError, match="k=-1"):
        layouts.generate(1, -1)


def test_a_world_without_room_for_an_obstacle_or_for_a_way_to_a_goal_is_refused():
    with pytest.raises(uavnav.LayoutError, match="safe_zone=480: an obstacle with a radius of"):
        circles.generate(10, 8, 0, MovingWorld(safe_zone=480.0))
    with pytest.raises(
        uavnav.LayoutError, match="goal_radius=1e-09: ways are measured from place to place; give 5 px"
    ):
        goal.generate(1, 8, 0, goal.GoalWorld(goal_radius=1e-9))
