"""Eqs (11) and (12): what each of the 100 actions does to the drone."""

import math

import oracle
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import uavnav
from uavnav.tasks.dynamics import COSINE, SINE, decode, direction, move

WORLD = uavnav.World()
ACTIONS = torch.arange(100)


def test_the_100_actions_are_ten_turns_from_5_left_to_4_right_times_0_to_9_px():
    angle, distance = decode(ACTIONS, WORLD)
    assert angle[::10].tolist() == [0, 1, 2, 3, 4, 5, -4, -3, -2, -1]
    assert distance[:10].tolist() == list(range(10))
    assert list(zip(angle.tolist(), distance.tolist(), strict=True)) == [oracle.decode(a) for a in range(100)]
    assert len(set(zip(angle.tolist(), distance.tolist(), strict=True))) == 100


def test_decoding_keeps_the_shape_and_whole_numbers_of_100_actions():
    for shape in ((), (100,), (4, 25), (2, 5, 10)):
        action = ACTIONS[: math.prod(shape)].reshape(shape)
        for part, flat in zip(decode(action, WORLD), decode(action.flatten(), WORLD), strict=True):
            assert part.shape == shape
            assert part.dtype == torch.int64
            assert torch.equal(part.flatten(), flat)


def test_cosine_and_sine_are_exact_at_multiples_of_90_degrees():
    cosine, sine = direction(torch.tensor([0, 90, 180, 270]))
    assert cosine.tolist() == [1, 0, -1, 0]
    assert sine.tolist() == [0, 1, 0, -1]


def test_cosine_and_sine_of_360_headings_are_within_one_float32_rounding():
    for heading in range(360):
        assert COSINE[heading].item() == pytest.approx(math.cos(math.radians(heading)), abs=6e-8)
        assert SINE[heading].item() == pytest.approx(math.sin(math.radians(heading)), abs=6e-8)
        assert COSINE[heading].item() == -COSINE[(heading + 180) % 360].item()
        assert SINE[heading].item() == -SINE[(heading + 180) % 360].item()


def fly(actions, x=400.0, y=300.0, heading=90):
    x, y, heading = torch.tensor(x), torch.tensor(y), torch.tensor(heading)
    for action in actions:
        x, y, heading = move(x, y, heading, *decode(torch.tensor(action), WORLD))
    return x.item(), y.item(), heading.item()


@pytest.mark.parametrize("turn", range(1, 10))
def test_turning_through_360_degrees_in_place_returns_exactly(turn):
    assert fly([10 * turn] * (360 // math.gcd(360, abs(oracle.decode(10 * turn)[0])))) == (400, 300, 90)


def test_a_polygon_of_72_sides_of_9_px_closes_within_a_hundredth_px():
    x, y, heading = fly([59] * 72)
    assert heading == 90
    assert math.hypot(x - 400, y - 300) < 0.01


def test_left_is_counter_clockwise_and_5_degrees_at_most():
    assert fly([50]) == (400, 300, 95)
    assert fly([60]) == (400, 300, 86)
    assert fly([10], heading=359) == (400, 300, 0)
    assert fly([90], heading=0) == (400, 300, 359)
    assert fly([59])[0] == pytest.approx(400 + 9 * math.cos(math.radians(95)), abs=1e-4)
    assert fly([59])[0] < 400 < fly([69])[0]


def test_the_drone_turns_before_it_moves_9_px():
    # From 85 degrees five to the left is straight up: moving first would shift x by 9 cos 85 = 0.78 px.
    assert fly([59], heading=85) == (400, 309, 90)


@pytest.mark.parametrize(
    ("heading", "end"), [(0, (409, 300)), (90, (400, 309)), (180, (391, 300)), (270, (400, 291))]
)
def test_straight_episode_covers_nine_pixels_a_step_without_drift(heading, end):
    assert fly([9], heading=heading) == (*end, heading)


def test_36000_moves_equal_the_oracle_within_a_ten_thousandth_px():
    heading, action = torch.arange(360)[:, None].expand(360, 100), ACTIONS.expand(360, 100)
    x, y = torch.full((360, 100), 123.5), torch.full((360, 100), 456.25)
    got = torch.stack(move(x, y, heading, *decode(action, WORLD)), -1)
    expected = [[oracle.move(123.5, 456.25, h, *oracle.decode(a)) for a in range(100)] for h in range(360)]
    torch.testing.assert_close(got, torch.tensor(expected), rtol=0, atol=1e-4)


@settings(max_examples=50, deadline=None)
@given(start=st.integers(0, 359), actions=st.lists(st.integers(0, 99), max_size=40))
def test_any_40_turns_add_up_modulo_360(start, actions):
    _, _, heading = fly(actions, heading=start)
    assert heading == (start + sum(oracle.decode(action)[0] for action in actions)) % 360
