"""Eq. (14) and its two other forms: every amount of every action, exactly."""

import oracle
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import uavnav
from uavnav.tasks.dynamics import decode
from uavnav.tasks.rewards import BOUNDS, BY_ACTION, KNOWN, REWARDS, Step, bounds_of_returns
from uavnav.tasks.table import EMPTY, make_task

WORLD = uavnav.World()
NAMES = {
    "eq14": {"collision", "penalty", "progress"},
    "additive": {"collision", "progress", "stop", "turn"},
    "initial": {"collision", "progress"},
}


def terms_of(variant, world=WORLD):
    """The terms of all 100 actions, first without and then with a collision: each [2, 100]."""
    action = torch.arange(100).expand(2, 100)
    angle, distance = decode(action, world)
    task = make_task(EMPTY, world)
    state = task.start(torch.zeros_like(action), torch.full_like(action, 90))
    observation, _ = task.observe(state)
    clearance = torch.tensor([[280.0], [0.0]]).expand(2, 100)
    return REWARDS[variant](Step(state, state, action, angle, distance, clearance, observation, world))


def total(terms):
    return sum(terms.values())


def test_there_are_three_variants_and_one_of_a_goal_and_eq14_is_the_first():
    assert list(KNOWN) == ["eq14", "additive", "initial", "goal"]
    assert list(KNOWN.values())[:3] == list(BY_ACTION)
    assert list(REWARDS)[:4] == list(KNOWN)


@pytest.mark.parametrize("variant", NAMES)
def test_the_terms_of_200_cases_add_up_to_the_oracles_reward(variant):
    terms = terms_of(variant)
    assert set(terms) == NAMES[variant]
    assert all(term.dtype == torch.float64 and term.shape == (2, 100) for term in terms.values())
    expected = [[oracle.reward(*oracle.decode(a), hit, variant) for a in range(100)] for hit in (False, True)]
    torch.testing.assert_close(total(terms), torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-15)


@pytest.mark.parametrize("variant", NAMES)
def test_rewards_lie_between_minus_10_and_0_09_px(variant):
    reward = total(terms_of(variant))
    assert reward.min() == -10
    assert reward.max() == 0.09


@pytest.mark.parametrize("variant", NAMES)
def test_a_collision_is_minus_10_whatever_the_action_and_the_only_term(variant):
    terms = terms_of(variant)
    assert (terms["collision"] == torch.tensor([[0.0], [-10.0]])).all()
    assert all((term[1] == 0).all() for name, term in terms.items() if name != "collision")


@pytest.mark.parametrize(
    ("action", "eq14", "additive", "initial"),
    [
        (9, 0.09, 0.09, 0.09),  # straight, 9 px
        (1, 0.01, 0.01, 0.01),  # straight, 1 px
        (0, -0.01, -0.01, 0),  # a full stop
        (10, -0.01, -0.02, 0),  # a turn in place
        (59, -0.01, 0.08, 0.09),  # 5 degrees left, 9 px
        (91, -0.01, 0, 0.01),  # 1 degree right, 1 px
    ],
)
def test_six_actions_earn_what_section_4_2_says_in_three_readings(action, eq14, additive, initial):
    earned = [total(terms_of(variant))[0, action].item() for variant in ("eq14", "additive", "initial")]
    assert earned == pytest.approx([eq14, additive, initial], abs=1e-15)


def test_eq14_pays_in_9_of_100_actions_and_fines_the_other_91():
    reward = total(terms_of("eq14"))[0]
    assert (reward > 0).sum() == 9
    assert (reward == -0.01).sum() == 91


def test_the_amounts_are_the_worlds():
    world = uavnav.World(collision_reward=-3.0, penalty=-0.5, reward_per_pixel=2.0)
    reward = total(terms_of("eq14", world))
    assert (reward[1] == -3).all()
    assert reward[0, [0, 9, 59]].tolist() == [-0.5, 18, -0.5]
    assert total(terms_of("additive", world))[0, [0, 9, 59, 10]].tolist() == [-0.5, 18, 17.5, -1]


# -- bounds --------------------------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(list(NAMES)), *[st.floats(-20, 20).map(lambda number: round(number, 3))] * 3)
def test_bounds_are_the_least_and_the_most_of_all_100_actions_whatever_the_amounts(
    variant, collision, penalty, px
):
    world = uavnav.World(collision_reward=collision, penalty=penalty, reward_per_pixel=px)
    flying, collided = total(terms_of(variant, world))
    bounds = BOUNDS[variant](world)
    assert bounds.flying == pytest.approx((flying.min().item(), flying.max().item()))
    assert bounds.collided == pytest.approx((collided.min().item(), collided.max().item()))


def test_a_return_of_eq14_lies_between_minus_10_and_9_at_a_discount_of_99_percent():
    assert bounds_of_returns("eq14", WORLD, 0.99) == pytest.approx((-10, 9))
    # turning in place for ever
    assert bounds_of_returns("additive", WORLD, 0.999) == pytest.approx((-20, 90))
    assert bounds_of_returns("eq14", WORLD, 1.0) is None
    assert bounds_of_returns("not declared", WORLD, 0.99) is None


@settings(max_examples=30, deadline=None)
@given(
    st.floats(0, 0.999),
    st.lists(st.integers(0, 99), min_size=1, max_size=60),
    st.integers(0, 199),
    st.sampled_from([0.01, -0.01]),  # an award or a fine for each pixel nearer
)
def test_no_episode_to_a_goal_returns_more_or_less_than_its_bounds(gamma, actions, layout, px):
    task = make_task("test", {"reward_per_pixel": px}, task="goal")
    least, most = bounds_of_returns("goal", task.world, gamma)
    state, earned = task.start(torch.tensor(layout), torch.tensor(90)), 0.0
    for n, action in enumerate(actions):
        state, outcome = task.step(state, torch.tensor(action))
        earned += gamma**n * outcome.reward.item()
        if outcome.terminated:
            break
    assert least - 1e-6 <= earned <= most + 1e-6
    assert bounds_of_returns("goal", task.world, 0.99) == pytest.approx((-10, 10.09))


@settings(max_examples=50, deadline=None)
@given(
    st.sampled_from(list(NAMES)),
    st.floats(0, 0.999),
    st.lists(st.integers(0, 99), max_size=60),
    st.booleans(),
)
def test_no_episode_returns_more_or_less_than_its_bounds(variant, gamma, actions, collides):
    flying, collided = total(terms_of(variant))
    rewards = [flying[action].item() for action in actions] + ([collided[0].item()] if collides else [])
    earned = sum(gamma**n * reward for n, reward in enumerate(rewards))
    least, most = bounds_of_returns(variant, WORLD, gamma)
    rest = gamma ** len(rewards) / (1 - gamma)  # of an episode that goes on as well or as badly as it can
    assert earned <= most + 1e-9 if collides else earned + rest * 0.09 <= most + 1e-9
    assert earned >= least - 1e-9
