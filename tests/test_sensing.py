"""Eqs (9), (10), (13): the sensor against a slow loop over all 136 squares, and against closed forms."""

import math

import oracle
import posed
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from posed import OTHERS, agree_with_the_oracle, poses_in, random_poses
from torch.fx.experimental.proxy_tensor import make_fx

import uavnav
from uavnav.tasks import layouts, sensing
from uavnav.tasks.sensing import sense

WORLD = uavnav.World()
EMPTY = torch.zeros(0, 3)


def test_ten_thousand_random_poses_equal_a_loop_over_136_squares():
    assert agree_with_the_oracle(random_poses(10_000, 1)) < 0.01


@pytest.mark.parametrize(
    "group",
    [
        posed.near_walls,
        posed.near_corners,
        posed.in_contact,
        posed.at_the_edge_of_view,
        posed.axis_headings,
        posed.inside_a_square,
        posed.on_a_circles_centre,
    ],
)
def test_a_thousand_difficult_poses_equal_a_loop_over_136_squares(group):
    assert agree_with_the_oracle(group(1000, torch.Generator().manual_seed(2))) < 0.05


@pytest.mark.parametrize("switches", oracle.SWITCHES[1:])
def test_both_switches_equal_the_loop_on_1000_poses_among_24_circles(switches):
    assert agree_with_the_oracle(random_poses(1000, 3, k=24), uavnav.World(**switches)) < 0.05


@pytest.mark.parametrize(("fields", "arena"), OTHERS)
def test_seven_other_worlds_equal_the_loop_over_all_their_squares_on_1000_poses_each(fields, arena):
    world = uavnav.World(**fields)
    assert agree_with_the_oracle(poses_in(world, 1000), world, oracle.Arena(**arena)) < 0.05


def sense_at(x, y, heading, circles=EMPTY, world=WORLD):
    slots, clearance = sense(
        torch.tensor(float(x)), torch.tensor(float(y)), torch.tensor(heading), torch.as_tensor(circles), world
    )
    return slots.tolist(), clearance.item()


def test_the_empty_arena_shows_ten_far_slots_at_the_start_and_280_px_of_room():
    assert sense_at(400, 300, 90) == ([[0, 0, 1]] * 10, 280)
    assert sense_at(400, 300, 90, world=uavnav.World(padding="zeros")) == ([[0, 0, 0]] * 10, 280)


def test_a_circle_60_px_ahead_left_and_right_reads_one_third():
    for dx, dy, direction in ((0, 1, [0, 1]), (-1, 0, [-1, 0]), (1, 0, [1, 0])):
        slots, clearance = sense_at(400, 300, 90, [[400.0 + 100 * dx, 300.0 + 100 * dy, 40.0]])
        assert slots[0] == pytest.approx([*direction, 1 / 3], abs=1e-6)
        assert slots[1:] == [[0, 0, 1]] * 9
        assert clearance == 60


def test_a_circle_one_degree_behind_is_not_sensed_but_counts_for_the_clearance():
    angle = math.radians(179)
    behind = [[400 + 80 * math.cos(angle), 300 + 80 * math.sin(angle), 45.0]]
    slots, clearance = sense_at(400, 300, 88, behind)
    assert slots == [[0, 0, 1]] * 10
    assert clearance == pytest.approx(35, abs=1e-4)
    assert sense_at(400, 300, 90, behind)[0][0][1] == pytest.approx(math.sin(math.radians(1)), abs=1e-6)


def test_a_circle_at_a_right_angle_is_sensed_in_all_360_headings_with_forward_never_below_0():
    for heading in range(360):
        for side in (-1, 1):
            angle = math.radians(heading + 90 * side)
            slots, _ = sense_at(
                400, 300, heading, [[400 + 100 * math.cos(angle), 300 + 100 * math.sin(angle), 40.0]]
            )
            assert slots[0] == pytest.approx([-side, 0, 1 / 3], abs=1e-5)
            assert slots[0][1] >= 0


def test_a_wall_is_in_view_at_120_px_and_not_at_120_001_px():
    assert sense_at(140, 300, 180)[0] == [[0, 1, 1]] * 2 + [[0, 0, 1]] * 8
    assert sense_at(140.001, 300, 180)[0] == [[0, 0, 1]] * 10


def test_at_30_px_the_distance_reads_0_and_stays_0_inside():
    for y in (50, 40, 20, 10):
        slots, clearance = sense_at(400, y, 270)
        assert slots[0][2] == 0
        assert clearance == max(y - 20, 0)


def test_inside_a_square_and_on_a_circles_centre_the_direction_is_0():
    slots, clearance = sense_at(410, 10, 37)
    assert (slots[0], clearance) == ([0, 0, 0], 0)
    slots, clearance = sense_at(200, 200, 37, [[200.0, 200.0, 64.0]])
    assert (slots[0], clearance) == ([0, 0, 0], -64)


def test_equal_distances_are_listed_by_index_left_square_before_right():
    # On x = 400 squares 20 px to the left and to the right are equally far; the left one has the lower index.
    for y, heading, left in ((520, 90, -1), (80, 270, 1)):
        slots, _ = sense_at(400, y, heading)
        assert slots[0] == slots[1] == pytest.approx([0, 1, 1 / 3], abs=1e-6)
        assert [math.copysign(1, slot[0]) for slot in slots[2:10]] == [left, -left] * 4
        assert all(abs(slots[i][0] + slots[i + 1][0]) < 1e-6 for i in (2, 4, 6, 8))


def test_two_circles_at_64_px_are_listed_in_the_order_of_the_file():
    left, right = [300.0, 300.0, 36.0], [500.0, 300.0, 36.0]
    assert [slot[0] for slot in sense_at(400, 300, 90, [left, right])[0][:2]] == pytest.approx(
        [-1, 1], abs=1e-6
    )
    assert [slot[0] for slot in sense_at(400, 300, 90, [right, left])[0][:2]] == pytest.approx(
        [1, -1], abs=1e-6
    )


def test_a_circle_is_listed_before_a_square_at_the_same_60_px():
    slots, _ = sense_at(400, 520, 90, [[300.0, 520.0, 40.0]])
    assert slots[0] == pytest.approx([-1, 0, 1 / 3], abs=1e-6)


def test_of_12_circles_nearest_drops_the_farthest_and_listed_the_last():
    ahead = [[400.0, 300 + 150 - 5.0 * i, 40.0] for i in range(12)]  # the last is the nearest: 55 px
    distances = [(110 - 5 * i - 30) / 90 for i in range(12)]
    nearest, _ = sense_at(400, 300, 90, ahead)
    listed, _ = sense_at(400, 300, 90, ahead, uavnav.World(slots="listed"))
    assert [slot[2] for slot in nearest] == pytest.approx(distances[::-1][:10], abs=1e-6)
    assert [slot[2] for slot in listed] == pytest.approx(distances[:10], abs=1e-6)


def test_each_of_500_rows_is_bit_identical_alone_and_permuted():
    poses = random_poses(500, 4)
    slots, clearance = sense(*poses, WORLD)
    order = torch.randperm(500, generator=torch.Generator().manual_seed(0))
    permuted = sense(*(part[order] for part in poses), WORLD)
    assert torch.equal(permuted[0], slots[order])
    assert torch.equal(permuted[1], clearance[order])
    for row in range(500):
        alone = sense(*(part[row] for part in poses), WORLD)
        assert torch.equal(alone[0], slots[row])
        assert torch.equal(alone[1], clearance[row])


@pytest.mark.parametrize("shape", [(), (6,), (2, 3), (3, 1, 2)])
@pytest.mark.parametrize("k", [0, 1, 8])
def test_every_batch_shape_gives_ten_triples_and_one_clearance(shape, k):
    n = math.prod(shape)
    x, y, heading, circles = random_poses(n, 5, k)
    slots, clearance = sense(
        x.reshape(shape), y.reshape(shape), heading.reshape(shape), circles.reshape(*shape, k, 3), WORLD
    )
    assert slots.shape == (*shape, 10, 3)
    assert clearance.shape == shape
    assert slots.dtype == clearance.dtype == torch.float32
    flat = sense(x, y, heading, circles, WORLD)
    assert torch.equal(slots.reshape(n, 10, 3), flat[0])
    assert torch.equal(clearance.reshape(n), flat[1])


@settings(max_examples=100, deadline=None)
@given(
    x=st.floats(0, 800, width=32),
    y=st.floats(0, 600, width=32),
    heading=st.integers(0, 359),
    seed=st.integers(0, 1000),
    k=st.integers(0, 30),
)
def test_any_observation_is_within_bounds_nearest_first_with_the_empty_slots_last(x, y, heading, seed, k):
    circles = layouts.generate(1, k, seed)[0]
    slots, clearance = sense(torch.tensor(x), torch.tensor(y), torch.tensor(heading), circles, WORLD)
    right, forward, distance = slots.unbind(-1)
    assert right.abs().max() <= 1
    assert 0 <= forward.min() <= forward.max() <= 1
    assert 0 <= distance.min() <= distance.max() <= 1
    assert (distance.diff() >= 0).all()
    length = torch.hypot(right, forward)
    assert (torch.minimum(length, (length - 1).abs()) < 2e-6).all()  # a direction, or none
    assert (length[1:] <= length[:-1] + 2e-6).all() or clearance <= 0
    assert clearance <= 280


# -- in a graph ----------------------------------------------------------------------------------------------


class Traced(torch.Tensor):
    """Stands for a tensor, as in a graph that is traced."""


@pytest.mark.parametrize(("n", "rows"), [(sensing.FEW, 500), (sensing.FEW + 20, 500), (sensing.FEW, 1500)])
@pytest.mark.parametrize("slots", ["nearest", "listed"])
def test_slots_by_sorting_are_those_by_counting_or_one_by_one_to_the_last_bit_ties_included(slots, n, rows):
    generator = torch.Generator().manual_seed(3)
    directions = torch.randn(2, n, rows, generator=generator).round()  # with some -0.0
    distance = torch.randint(60, (n, rows), generator=generator).float() * 10
    in_view = torch.rand(n, rows, generator=generator) < torch.rand(rows, generator=generator)
    assert {0, 10} <= {*in_view.sum(0).clamp(max=10).tolist()}
    world = uavnav.World(slots=slots)
    of_circles = torch.randn(2, 8, rows, generator=generator)
    candidates = torch.cat([directions, distance[None]])
    by_sorting = sensing.first_in_view(candidates, in_view, world, of_circles)
    in_a_graph = sensing.first_in_view(candidates.as_subclass(Traced), in_view, world, of_circles)
    assert (by_sorting.numbers.shape, by_sorting.distance.shape) == ((4, 10, rows), (10, rows))
    assert (torch.signbit(directions) & (directions == 0)).any()
    filled = by_sorting.distance < torch.inf
    assert torch.equal(filled.sum(0), in_view.sum(0).clamp(max=10))
    for one, other in zip(by_sorting, in_a_graph, strict=True):
        one, other = (torch.where(filled, part.as_subclass(torch.Tensor), 0.0) for part in (one, other))
        assert torch.equal(one.view(torch.int32), other.view(torch.int32))


def test_without_a_circle_the_border_is_sensed_as_beside_circles_out_of_reach():
    x, y, heading, circles = random_poses(200, 4)
    far = torch.tensor([[[10_000.0, 10_000.0, 30.0]]]).expand(len(x), 8, 3)
    for alone, beside in zip(
        sense(x, y, heading, circles[:, :0], WORLD), sense(x, y, heading, far, WORLD), strict=True
    ):
        assert torch.equal(alone, beside)


def test_nothing_sorts_in_a_graph(monkeypatch):
    x, y, heading, circles = random_poses(64, 1)
    alone = sense(x, y, heading, circles, WORLD)
    monkeypatch.setattr(torch.Tensor, "sort", lambda *how, **more: pytest.fail("sorts"))
    with pytest.raises(pytest.fail.Exception, match="sorts"):
        sense(x, y, heading, circles, WORLD)
    traced = make_fx(lambda *poses: sense(*poses, WORLD), tracing_mode="fake", _allow_non_fake_inputs=True)(
        x, y, heading, circles
    )
    for one, other in zip(traced(x, y, heading, circles), alone, strict=True):
        assert torch.equal(one, other)


def test_clearance_alone_is_that_of_the_sensor():
    poses = random_poses(500, 2)
    assert torch.equal(sensing.clearance(poses[0], poses[1], poses[3], WORLD), sense(*poses, WORLD)[1])
