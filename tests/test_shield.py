"""The shield: the nearest action that touches nothing that is sensed, as a loop over actions has it."""

import math
from pathlib import Path

import oracle
import pytest
import torch

from uavnav.evaluation import evaluate_policy, fly, on
from uavnav.runs.policies import load_policy
from uavnav.tasks.baselines import reactive, straight_ahead
from uavnav.tasks.shield import shield, shielded
from uavnav.tasks.state import at
from uavnav.tasks.table import EMPTY, make_task
from uavnav.tasks.world import World

WORLD, RESULTS = World(), Path(__file__).parent.parent / "results"


def nearest(action, row):
    """The nearest of 100 actions after which every sensed point, or what lies behind it, is farther than 30
    px.
    """
    found = []
    for other in range(100):
        turn, distance = oracle.decode(other)
        right, forward = -math.sin(math.radians(turn)), math.cos(math.radians(turn))
        left = [
            30 + 90 * near - distance * (right * x + forward * y)
            for x, y, near in row.view(10, 3).tolist()
            if x or y
        ]
        if min(left, default=99) > 30.01:
            own = oracle.decode(action)
            found.append(((turn - own[0]) ** 2 + (distance - own[1]) ** 2, other))
    return min(found)[1]


def near(n):
    """The state and the observations of n places that are 30 to 40 px from something."""
    task, random = make_task("validation"), torch.Generator().manual_seed(4)
    state = task.start(torch.arange(60 * n) % 1000, torch.randint(360, (60 * n,), generator=random))
    x, y = (50 + torch.rand(60 * n, generator=random) * (side - 100) for side in (800, 600))
    observation, clearance = task.observe(state._replace(x=x, y=y))
    close = ((clearance > 30.1) & (clearance < 40)).nonzero().flatten()[:n]
    return at(state._replace(x=x, y=y), close), observation[close]


def test_the_action_is_the_nearest_in_degrees_and_px_that_cannot_collide():
    _, observation = near(100)
    action = torch.randint(100, (100,), generator=torch.Generator().manual_seed(0))
    mine = shield(action, observation, WORLD)
    assert mine.tolist() == [nearest(int(one), row) for one, row in zip(action, observation, strict=True)]
    assert 0.05 < (mine != action).float().mean() < 0.9


def test_of_1400_steps_beside_obstacles_it_lets_those_collide_that_touch_what_is_not_in_view():
    state, observation = near(200)
    task, hits = make_task("validation"), {True: 0, False: 0}
    for action in range(9, 100, 14):
        asked = torch.full((200,), action)
        for kept, chosen in ((False, asked), (True, shield(asked, observation, WORLD))):
            hits[kept] += int((task.sense(task.move(state, chosen)[0])[1] <= 30).sum())
    assert hits[False] > 50
    assert hits[True] <= 0.1 * hits[False]  # bodies a few degrees behind the drone's sides


def test_a_wall_ahead_at_36_px_leaves_5_px_and_turns_are_kept():
    wall = torch.tensor([[0.0, 1.0, 6 / 90], *[[0.0, 0.0, 1.0]] * 9]).flatten()
    assert shield(torch.tensor(9), wall, WORLD) == 5
    assert shield(torch.tensor(59), wall, WORLD) == 56  # 5 degrees to the left, 6 px: cos 5 degrees x 6 < 6
    assert shield(torch.tensor(3), wall, WORLD) == 3
    empty = torch.tensor([[0.0, 0.0, 1.0]] * 10).flatten()
    assert shield(torch.arange(100), empty.expand(100, 30), WORLD).tolist() == [*range(100)]


def test_a_body_that_comes_nearer_is_expected_where_its_velocity_is_sensed():
    world = make_task(EMPTY, {"sense_velocity": True}, task="moving").world
    body = torch.tensor([[0.0, 1.0, 6 / 90, 0.0, -1.0], *[[0.0, 0.0, 1.0, 0.0, 0.0]] * 9]).flatten()
    assert shield(torch.tensor(9), body, world) == 3  # 2 px a step towards the drone: 6 - 2 - 3 > 0


def test_straight_ahead_under_the_shield_collides_with_nothing_and_reactive_is_as_it_is():
    rows = evaluate_policy(shielded(straight_ahead, WORLD), episodes=30, max_steps=200)
    assert rows["truncated"].all()
    free, kept = (
        evaluate_policy(one, episodes=20, max_steps=200) for one in (reactive, shielded(reactive, WORLD))
    )
    assert free.equals(kept)


def test_in_a_box_straight_ahead_under_the_shield_collides_with_nothing():
    task = on(make_task(EMPTY, task="space"), "validation", 20, 200)
    ahead = shielded(lambda seen, generator: torch.full(seen.shape[:-1], 3), task.world)
    assert fly({0: ahead}, task).episodes["truncated"].all()


@pytest.mark.parametrize("greedy", [True, False])
def test_a_trained_policy_under_the_shield_is_flown_as_it_is_called(greedy):
    policy = load_policy(RESULTS / "vectorised/dqn/tanh", greedy=greedy).shielded()
    as_function = lambda seen, generator: policy(seen, generator)  # noqa: E731
    rows = evaluate_policy(policy, episodes=20, max_steps=300)
    assert rows.equals(evaluate_policy(as_function, episodes=20, max_steps=300))
    bare = evaluate_policy(
        load_policy(RESULTS / "vectorised/dqn/tanh", greedy=greedy), episodes=20, max_steps=300
    )
    assert rows["terminated"].sum() < bare["terminated"].sum()
