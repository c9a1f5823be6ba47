"""Whatever the split, the batch and the actions: what must hold in every step of every episode."""

import math

import oracle
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchrl.envs.utils import step_mdp

import uavnav
from uavnav.tasks import layouts, slalom
from uavnav.tasks.goal import GoalWorld
from uavnav.tasks.table import make_task, name_of

ROUNDING = 1e-3  # [px] of float32 positions and distances
# all that no collision earns
PENALTIES = {
    "eq14": (-0.01, 0.09),
    "additive": (-0.02, 0.09),
    "initial": (0.0, 0.09),
}


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


def disturbed(draw):
    """Faults, and a stack of observations."""
    values = {
        "noise": [0.0, 5.0, 50.0],
        "lost": [0.0, 0.3, 1.0],
        "late": [0, 1, 5],
        "sticky": [0.0, 0.5, 1.0],
    }
    drawn = {name: draw(st.sampled_from(some)) for name, some in values.items()}
    return {"faults": drawn, "stack": draw(st.integers(1, 3))}


SPLITS_ = {"drone": lambda draw, layouts: layouts, "moving": moving, "goal": with_goals, "slalom": gaps}


def circles_of(env, layout, steps):
    """Where the circles (x, y, radius) of a row are."""
    rows, task = env.layouts[layout].tolist(), name_of(env.task)
    if task == "moving":
        return [circle for circle, _ in oracle.drift(rows, steps)]
    return rows[:-1] if task == "goal" else rows


def reached(env, state):
    """Whether each row is at its goal [B]; never where there is none."""
    if name_of(env.task) != "goal":
        return [False] * state.x.numel()
    rows = rows_of(state.x, state.y, state.layout)
    radius = env.task.world.goal_radius
    return [math.dist((x, y), env.layouts[layout, -1, :2].tolist()) <= radius for x, y, layout in rows]


def collided(env, state, after):
    """Whether each row ended at something that it touched, which counts also at a goal [B]."""
    rows = rows_of(after["terminated"], state.x, state.y, state.layout, state.steps)
    return [
        ended and (not there or oracle.clearance(x, y, circles_of(env, layout, steps)) <= 30)
        for (ended, x, y, layout, steps), there in zip(rows, reached(env, state), strict=True)
    ]


@st.composite
def episodes(draw, kind):
    """An environment, and actions [T, *B] for it: stretches of one action each, other rows begin
    elsewhere in them.
    """
    kind, how = (draw(st.sampled_from(sorted(SPLITS_))), disturbed(draw)) if kind == "faults" else (kind, {})
    layouts, task = SPLITS_[kind](draw, draw(splits())), "drone" if kind == "slalom" else kind
    shape = draw(st.sampled_from([[], [1], [3], [2, 2]]))
    action = st.just(9) | st.integers(0, 99)  # far enough straight ahead to meet every wall
    stretches = draw(st.lists(st.tuples(action, st.integers(1, 40)), min_size=1, max_size=4))
    actions = torch.tensor([action for action, times in stretches for _ in range(times)])
    rows = [actions.roll(-11 * row) for row in range(math.prod(shape))]
    actions = torch.stack(rows, 1).reshape(len(actions), *shape)
    how |= {
        "layouts": layouts,
        "reward": draw(st.sampled_from(sorted(PENALTIES))),
        "task": task,
        "world": {
            "start_heading": draw(st.sampled_from(["random", "up"])),
            "slots": draw(st.sampled_from(["nearest", "listed"])),
            "padding": draw(st.sampled_from(["far", "zeros"])),
            **({"sense_velocity": draw(st.booleans())} if task == "moving" else {}),
            **({"goal_radius": draw(st.sampled_from([40.0, 190.0, 300.0]))} if task == "goal" else {}),
        },
        "seeds": draw(st.integers(0, 2**31 - 1)),
    }
    limit = draw(st.sampled_from([None, "a collision", 1, 7, 30]))
    if limit == "a collision":
        limit = first_collision(uavnav.DroneEnv(shape, **how), actions)
    return uavnav.DroneEnv(shape, **how, max_steps=limit), actions


def first_collision(env, actions):
    """The steps of the first episode that ends, where one does: at this time limit, the collision comes
    in the last step.
    """
    for _, _, state, after in drive(env, actions):
        if after["terminated"].any():
            return state.steps[after["terminated"].squeeze(-1)].min().item()
    return None


def drive(env, actions):
    """Yield of each step what was executed, the states before and after it, and what it led to."""
    now = env.reset()
    for action in actions:
        before = env.state
        env.step(now.set("action", action))
        if env.task.remembers:
            given, action = action, env.state.executed
            assert ((action == given) | ((action == before.executed) & (before.steps > 0))).all()
        yield action, before, env.state, now["next"]
        now = env.maybe_reset(step_mdp(now))


def rows_of(*tensors):
    return zip(*(tensor.flatten().tolist() for tensor in tensors), strict=True)


@pytest.mark.parametrize(
    ("kind", "times"), [("drone", 70), ("moving", 25), ("goal", 25), ("slalom", 10), ("faults", 20)]
)
def test_in_every_step_of_every_episode(kind, times):
    """What the functions below are named; to fly costs more than to look, so all look at the same
    episodes.
    """
    settings(max_examples=times, deadline=None, derandomize=True)(given(episodes(kind))(every_step))()


def every_step(episode):
    env, actions = episode
    assert env.observation_spec["observation"].is_in(env.reset()["observation"])
    flown = [[] for _ in range(math.prod(env.batch_size))]
    for action, before, state, after in drive(env, actions):
        hit = collided(env, state, after)
        observations_are_finite_and_within_their_spec_and_rewards_within_minus_10_and_0_09(env, after, hit)
        it_terminates_where_the_oracles_clearance_is_at_most_30_px_and_never_also_at_the_cap(
            env, state, after
        )
        no_step_leads_through_an_obstacle(env, action, before, state, after)
        counts_and_rewards_are_what_the_actions_add_up_to_in_whole_numbers(env, action, after, hit, flown)


def observations_are_finite_and_within_their_spec_and_rewards_within_minus_10_and_0_09(env, after, hit):
    low, high = PENALTIES[env.task.reward]
    assert after["observation"].isfinite().all()
    assert env.observation_spec["observation"].is_in(after["observation"])
    for reward, touched in zip(after["reward"].double().flatten().tolist(), hit, strict=True):
        assert reward == -10 if touched else low - 1e-8 <= reward <= high + 1e-8


def it_terminates_where_the_oracles_clearance_is_at_most_30_px_and_never_also_at_the_cap(env, state, after):
    flags = rows_of(after["terminated"], after["truncated"], after["done"])
    for (x, y, layout, steps), (terminated, truncated, done), there in zip(
        rows_of(state.x, state.y, state.layout, state.steps), flags, reached(env, state), strict=True
    ):
        clearance = oracle.clearance(x, y, circles_of(env, layout, steps))
        if abs(clearance - 30) > ROUNDING:
            assert terminated == (clearance <= 30 or there)
        assert truncated == (steps == env.task.max_steps and not terminated)
        assert done == (terminated or truncated)
        assert terminated or (50 < x < 750 and 50 < y < 550)  # the border squares' 20 px and the drone's 30


def no_step_leads_through_an_obstacle(env, action, before, state, after):
    """Let A and B be the drone's centre before and after a step of s px that ends free, P any place between
    them, and Q the point of some body that is nearest to P. Bodies are closed, so A and B are 30 px or more
    from Q, and for P = (1 - t) A + t B: |QP|^2 = (1 - t) |QA|^2 + t |QB|^2 - t (1 - t) s^2 >= 30^2 - (s /
    2)^2. At 9 px a step no body comes nearer than 29.66 px. For a circle of radius R the same with its
    centre, R + 30 px from A and B, gives sqrt((R + 30)^2 - (s / 2)^2) - R: 29.83 px at the least. Circles
    that move are taken where they are at the step's end, if the drone was free of them there.
    """
    for x, y, to_x, to_y, layout, steps, distance, terminated in rows_of(
        before.x, before.y, state.x, state.y, state.layout, state.steps, action % 10, after["terminated"]
    ):
        assert math.hypot(to_x - x, to_y - y) == pytest.approx(distance, abs=ROUNDING)
        if not distance or terminated:
            continue
        circles = circles_of(env, layout, steps)
        if name_of(env.task) == "moving" and min(oracle.distances(x, y, circles)) < 30:
            continue
        radii = [radius for _, _, radius in circles]
        bounds = [math.sqrt((r + 30) ** 2 - distance**2 / 4) - r for r in radii]
        assert min(bounds, default=30) >= 29.83
        for part in (0.2, 0.5, 0.8):
            place = (x + (to_x - x) * part, y + (to_y - y) * part)
            found = oracle.distances(*place, circles)
            assert min(found) >= math.sqrt(900 - distance**2 / 4) - ROUNDING
            assert all(d >= bound - ROUNDING for d, bound in zip(found, bounds, strict=False))


def counts_and_rewards_are_what_the_actions_add_up_to_in_whole_numbers(env, action, after, hit, flown):
    """flown: of each row what it did since its episode began, to which the step is added."""
    episode = after["episode"].flatten() if env.batch_size else after["episode"][None]
    done = after["done"].flatten().tolist()
    for row, taken in enumerate(action.flatten().tolist()):
        flown[row].append((*oracle.decode(taken), hit[row]))
        counts = {name: episode[name][row].item() for name in episode.keys()}  # noqa: SIM118
        earned = counts.pop("reward")
        layout = counts.pop("layout")
        assert 0 <= layout < len(env.layouts)
        assert counts == counted(flown[row])
        assert earned == pytest.approx(hundredths(flown[row], env.task.reward) / 100, abs=1e-9)
        if done[row]:
            flown[row] = []


def counted(flown):
    return {
        "steps": len(flown),
        "stops": sum(distance == 0 for _, distance, _ in flown),
        "full_stops": sum(distance == turn == 0 for turn, distance, _ in flown),
        "turns": sum(turn != 0 for turn, _, _ in flown),
        "distance": sum(distance for _, distance, _ in flown),
    }


def hundredths(flown, variant):
    """The reward of an episode in whole hundredths: pixels less fines less 1,000 a collision."""
    free = [(turn, distance) for turn, distance, hit in flown if not hit]
    pixels, stops = sum(distance for _, distance in free), sum(distance == 0 for _, distance in free)
    turns = sum(turn != 0 for turn, _ in free)
    straight = [distance for turn, distance in free if turn == 0 and distance > 0]
    earned = {
        "eq14": sum(straight) - (len(free) - len(straight)),
        "additive": pixels - stops - turns,
        "initial": pixels,
    }
    return earned[variant] - 1000 * (len(flown) - len(free))


@pytest.mark.parametrize(("gap", "hit"), [(59.84, False), (59.82, True)])
def test_the_bound_is_attained_a_circle_of_30_px_may_be_passed_0_16_px_too_near_and_not_0_18(gap, hit):
    # Straight up at x = 400, 9 px a step: the circle's centre is beside the middle of step 15, `gap` px to
    # the right.
    task = make_task(torch.tensor([[[400 + gap, 300 + 14.5 * 9, 30.0]]]))
    state = task.start(torch.tensor([0]), torch.tensor([90]))
    collisions = []
    for _ in range(19):
        state, outcome = task.step(state, torch.tensor([9]))
        collisions.append(outcome.terminated.item())
    assert collisions == [hit and step in (14, 15) for step in range(1, 20)]
