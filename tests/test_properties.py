"""Whatever the layouts and the actions: what must hold in every step of every episode."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from slow_episodes import slow_episodes, take_over

from uavnav.tasks import layouts, slalom
from uavnav.tasks.goal import GoalWorld
from uavnav.tasks.state import COUNTS
from uavnav.tasks.table import make_task


@st.composite
def splits(draw):
    """[n, k, 3] px: up to 3 layouts of 0 to 20 circles anywhere in the window, pushed out of the safe
    zone.
    """
    n, k = draw(st.integers(1, 3)), draw(st.just(0) | st.integers(0, 20))
    number = lambda low, high: st.floats(low, high, width=32)  # noqa: E731
    rows = draw(
        st.lists(st.tuples(number(0, 800), number(0, 600), number(30, 100)), min_size=n * k, max_size=n * k)
    )
    all_layouts = torch.tensor([pushed(*row) for row in rows], dtype=torch.float32).reshape(n, k, 3)
    layouts.validate(all_layouts)
    return all_layouts


def pushed(x, y, radius):
    dx, dy = x - 400, y - 300
    distance = math.hypot(dx, dy)
    if distance - radius >= 50.01:
        return x, y, radius
    dx, dy = (dx / distance, dy / distance) if distance > 0 else (1.0, 0.0)
    return 400 + (radius + 50.01) * dx, 300 + (radius + 50.01) * dy, radius


def moving(draw, layouts):
    """The same with velocities, each part at most 2 px a step."""
    part = st.floats(-2, 2, width=32)
    rows = draw(
        st.lists(st.tuples(part, part), min_size=layouts[..., 0].numel(), max_size=layouts[..., 0].numel())
    )
    return torch.cat([layouts, torch.tensor(rows, dtype=torch.float32).reshape(*layouts.shape[:2], 2)], -1)


def with_goals(draw, all_layouts):
    """As many layouts of the goals' own split, where a goal has room."""
    goals = layouts.load("test", GoalWorld())
    return goals[[draw(st.integers(0, len(goals) - 1)) for _ in all_layouts]]


def gaps(draw, layouts):
    """As many layouts of four columns of circles, in 48 places."""
    return slalom.generate(len(layouts), draw(st.integers(1, slalom.WIDEST)), draw(st.integers(0, 1000)))


OBSTACLES = {"drone": lambda draw, layouts: layouts, "moving": moving, "goal": with_goals, "slalom": gaps}


@st.composite
def flights(draw, kind):
    """A task, start headings of a drone in each of its layouts, and the actions of each: stretches of one
    action, which others begin elsewhere.
    """
    all_layouts, name = OBSTACLES[kind](draw, draw(splits())), "drone" if kind == "slalom" else kind
    n = len(all_layouts)
    fields = {
        "slots": draw(st.sampled_from(["nearest", "listed"])),
        "padding": draw(st.sampled_from(["far", "zeros"])),
    }
    fields |= {"sense_velocity": draw(st.booleans())} if name == "moving" else {}
    fields |= {"goal_radius": draw(st.sampled_from([40.0, 190.0, 300.0]))} if name == "goal" else {}
    reward = draw(st.sampled_from([None, "eq14", "additive", "initial"]))
    limit = draw(st.sampled_from([None, 1, 30]))
    action = st.just(9) | st.integers(0, 99)  # far enough straight ahead to meet every wall
    stretches = draw(st.lists(st.tuples(action, st.integers(8, 40)), min_size=2, max_size=4))
    actions = torch.tensor([action for action, times in stretches for _ in range(times)])
    headings = draw(st.lists(st.just(90) | st.integers(0, 359), min_size=n, max_size=n))
    task = make_task(all_layouts, fields, reward, limit, task=name)
    return task, headings, torch.stack([actions.roll(-11 * row) for row in range(n)], 1)


@pytest.mark.parametrize(("kind", "times"), [("drone", 15), ("moving", 10), ("goal", 15), ("slalom", 5)])
def test_every_step_is_that_of_a_slow_loop(kind, times):
    settings(max_examples=times, deadline=None, derandomize=True)(given(flights(kind))(every_step))()


def every_step(flight):
    task, headings, actions = flight
    rows = torch.arange(len(headings))
    state, episodes = task.start(rows, torch.tensor(headings)), slow_episodes(task, rows.tolist(), headings)
    for episode in episodes:
        episode.radius = getattr(task.world, "goal_radius", None)
    up = {*rows.tolist()}
    for action in actions:
        state, outcome = task.step(state, action)
        for row in sorted(up):
            episode, over = episodes[row], [part[row].item() for part in outcome[-2:]]
            episode.step(action[row].item())
            take_over(episode, state, row)
            assert all(getattr(state, name)[row] == getattr(episode, name) for name in COUNTS[:-1])
            if not episode.doubtful():
                assert over == [episode.terminated, episode.truncated]
                assert outcome.reward[row].item() == pytest.approx(episode.reward, abs=2e-5)
                sensed = torch.tensor(sum(episode.slots, ()))
                torch.testing.assert_close(outcome.observation[row], sensed, rtol=0, atol=1e-4)
            if any(over):
                up.remove(row)
