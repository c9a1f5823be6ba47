"""The classics, held to slow loops after their papers, and refused where they cannot see what they need."""

import math
from functools import partial

import numpy as np
import oracle
import pytest
import torch

from uavnav.errors import ConfigError
from uavnav.evaluation import fly, on
from uavnav.tasks import classics, sensed
from uavnav.tasks.moving import MovingWorld
from uavnav.tasks.space import SpaceMovingWorld, SpaceWorld
from uavnav.tasks.table import EMPTY, make_task
from uavnav.tasks.world import World

WORLD, BOX = World(), SpaceWorld()
SENSING = MovingWorld(sense_velocity=True)


def observed(task, n, world=None):
    """What drones sense at n places of the validation split, some of them inside of obstacles."""
    whole, random = make_task("validation", world, task=task), torch.Generator().manual_seed(1)
    state = whole.start(torch.arange(n), torch.randint(360, (n,), generator=random))
    x, y = (50 + torch.rand(n, generator=random) * (side - 100) for side in (800, 600))
    return whole.observe(state._replace(x=x, y=y))[0]


def unit(degrees):
    return np.array([-math.sin(math.radians(degrees)), math.cos(math.radians(degrees))])


def slots_of(row):
    """The filled slots of an observation: direction and distance [px]."""
    return [(np.array(one[:2]), 30 + 90 * one[2]) for one in row[:30].view(10, 3).tolist() if any(one[:2])]


def test_it_steers_by_the_action_whose_displacement_is_nearest_to_the_wanted_one():
    wanted = 12 * torch.rand(200, 2, generator=torch.Generator().manual_seed(0)) - torch.tensor([6, 0])
    for want, action in zip(wanted.numpy(), sensed.steer(wanted, WORLD).tolist(), strict=True):
        off = [np.linalg.norm(d * unit(turn) - want) for turn, d in map(oracle.decode, range(100))]
        assert off[action] == pytest.approx(min(off), abs=1e-5)
    behind = torch.tensor([[1.0, -5.0], [-1.0, -5.0]])
    assert sensed.steer(behind, WORLD).tolist() == [60, 50]  # on the spot, as far as it goes: 4 or 5 degrees
    assert sensed.steer(torch.tensor([0.9, 6.0]), WORLD, tolerance=10).item() == 6


def test_the_potential_pulls_with_1_and_pushes_by_khatibs_equation():
    for row in observed("drone", 200):
        force = np.array([0.0, 1.0])
        for towards, distance in slots_of(row):
            rho = max(distance - 30, 1)
            force -= 1e4 * max(1 / rho - 1 / 50, 0) / rho**2 * towards
        wanted = torch.tensor(9 * force / np.linalg.norm(force), dtype=torch.float32)
        expected = sensed.steer(wanted, WORLD, 5.0)
        assert classics.apf(row, gain=1e4, reach=50.0, tolerance=5.0) == expected


def test_the_histogram_is_that_of_a_loop_over_sectors():
    chosen = []
    for row in observed("goal", 300):
        right, forward, away = row[-3:].tolist()
        near = [one for one in slots_of(row) if one[1] < min(1000 * away, 60) + 30]
        blocked = []
        for sector in range(-90, 91, 5):
            ways = [(math.degrees(math.atan2(*u)), math.degrees(math.asin(min(32 / d, 1)))) for u, d in near]
            blocked.append(any(abs(sector - bearing) <= half for bearing, half in ways))
        aim, best = math.degrees(math.atan2(right, forward)), (math.inf, -90)
        for at, sector in enumerate(range(-90, 91, 5)):
            left = next((n for n in range(1, 38) if at - n >= 0 and blocked[at - n]), 99)
            open_ = next((n for n in range(1, 38) if at + n < 37 and blocked[at + n]), 99)
            middle = abs(left - open_) <= 1 and left < 99
            if not blocked[at] and (min(left, open_) >= 3 or middle):
                apart = abs((sector - aim + 180) % 360 - 180)
                best = min(best, (5 * apart + 2 * abs(sector), sector))
        turn = max(-4, min(5, -best[1]))
        dense = max([max(u @ unit(turn), 0) * (1 - (d - 30) / 60) for u, d in near], default=0)
        pace = round(9 * (1 - dense) * max(0, 1 - abs(best[1]) / 45))
        chosen.append(turn % 10 * 10 + pace)
    world = make_task(EMPTY, task="goal").world
    mine = classics.vfh(observed("goal", 300), world=world, window=60.0, spare=2.0, wide=3)
    assert (mine == torch.tensor(chosen)).float().mean() >= 0.99  # cosines round otherwise
    assert len({*chosen}) > 20


def test_the_dynamic_window_takes_what_is_worth_most_of_what_can_touch_nothing_in_this_step():
    for row in observed("drone", 40):
        worth = np.full(100, -np.inf)
        for action, (turn, distance) in enumerate(map(oracle.decode, range(100))):
            slots = slots_of(row)
            if action == 0 or any(d - distance * (u @ unit(turn)) <= 30.01 for u, d in slots):
                continue
            place, free = np.zeros(2), 0.0
            for third in range(30):
                place = place + 3 * unit(turn / distance * 3 * (third + 0.5)) if distance else place
                if third % 3 == 2:
                    if any(np.linalg.norm(place - u * (d + 30)) < 60 for u, d in slots):
                        break
                    free += 0.1
            worth[action] = 2 * (1 - abs(turn) / 180) + free + 0.5 * distance / 9
        mine = classics.dwa(row, heading=2.0, clear=1.0, speed=0.5, body=30.0).item()
        if np.isfinite(worth).any():
            assert worth[mine] == pytest.approx(worth.max(), abs=1e-3)


@pytest.mark.parametrize("axes", [2, 3])
def test_the_half_space_of_orca_has_no_velocity_that_collides_and_is_tight_at_its_boundary(axes):
    random = np.random.default_rng(0)
    for _ in range(200):
        towards = np.abs(random.normal(size=axes))
        towards /= np.linalg.norm(towards)
        distance, moves = random.uniform(31, 110), random.uniform(-2, 2, axes)
        place, wish = torch.tensor(towards * (distance + 60)), torch.tensor([0.0] * (axes - 1) + [9.0])
        normal, least = classics.half_space(place, torch.tensor(moves), wish.double(), 90.0, 8.0)
        normal, least = normal.numpy(), float(least)
        tried = random.uniform(-12, 12, (400, axes))
        steps = np.linspace(0, 8, 161)[:, None, None]
        apart = np.linalg.norm(steps * (tried - moves) - place.numpy(), axis=-1).min(0)
        allowed = tried @ normal >= least
        assert apart[allowed].min() > 90 - 0.1
        edge = wish.numpy() + (least - normal @ wish.numpy()) * normal  # the boundary's nearest to the wish
        nearest = np.linalg.norm(steps[:, 0] * (edge - moves) - place.numpy(), axis=-1).min()
        assert nearest == pytest.approx(90, abs=0.5)


@pytest.mark.parametrize(
    ("name", "world", "told"),
    [
        ("vfh", BOX, "vfh: its histogram is of a plane, and this task is a box; fly apf or dwa there"),
        ("orca", WORLD, "orca: no velocities are in this task's observation"),
        ("orca", SpaceMovingWorld(), "compare it with a run of task=moving world.sense_velocity=true"),
    ],
)
def test_what_a_scripted_policy_cannot_see_is_refused_in_one_line(name, world, told):
    with pytest.raises(ConfigError, match=told):
        getattr(classics, name)(torch.zeros(2, 50), world=world)


@pytest.mark.parametrize(
    ("name", "task", "world", "least"),
    [
        *[(name, "drone", None, 3.0) for name in ("apf", "vfh", "dwa")],
        *[(name, "goal", None, 7.0) for name in ("apf", "vfh", "dwa")],
        *[("orca", "moving", {"sense_velocity": True}, -3.0), ("apf", "space", None, 0.0)],
    ],
)
def test_on_20_validation_layouts_each_earns_at_least(name, task, world, least):
    whole = on(make_task(EMPTY, world, task=task), "validation", 20, 300)
    policy = partial(getattr(classics, name), world=whole.world)
    assert fly({0: policy}, whole).episodes["reward"].mean() > least
