"""What every task keeps, a user's own too: add one to the table, and all of this asks it too."""

import json

import gymnasium
import numpy as np
import pytest
import torch
from slow_episodes import KINDS, Narrow, slow_episodes, take_over
from torchrl.envs.utils import check_env_specs

import uavnav
from uavnav import DroneEnv, evaluation
from uavnav.tasks import protocol
from uavnav.tasks.baselines import BASELINES
from uavnav.tasks.faults import NAMES
from uavnav.tasks.state import State, at
from uavnav.tasks.table import TASKS, header, make_task, name_of
from uavnav.tasks.wrapper import WrappedTask

ALL = {"noise": 5.0, "lost": 0.2, "late": 2, "sticky": 0.25}
AROUND = {"bare": {}, "stack": {"stack": 3}, "faults": {"faults": ALL}, "both": {"stack": 2, "faults": ALL}}
SENSED = {"sense_velocity": True}
CASES = [*((name, {}) for name in TASKS), ("moving", SENSED), ("space-moving", SENSED), ("narrow", {})]

of_every_task = pytest.mark.parametrize(
    ("name", "fields"), CASES, ids=[name + "+" * len(own) for name, own in CASES]
)
whatever_is_around = pytest.mark.parametrize("around", AROUND)


@pytest.fixture(autouse=True)
def narrow(monkeypatch):
    """A user's task is in the table, as a plugin puts it there."""
    monkeypatch.setitem(TASKS, "narrow", Narrow)


def made(name, fields, around="bare", **how):
    return make_task("test", fields, task=name, **AROUND[around], **how)


def env_of(name, fields, around="bare", shape=(2, 3), **how):
    task = made(name, fields, around, **{"max_steps": 15, **how})
    return DroneEnv(shape, task=task, seeds=list(range(4, 4 + shape[0])))


def actions(task, shape, steps, seed=0):
    """A third at random, else straight ahead at full speed: far enough to meet something."""
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.randint(task.world.n_actions, (steps, *shape), generator=generator)
    return torch.where(
        torch.rand(steps, *shape, generator=generator) < 0.33, drawn, task.world.n_distances - 1
    )


def states(task, n, generator):
    """Rows anywhere, at any moment of an episode, and the draws that put them there."""
    heading, layout = (torch.randint(most, (n,), generator=generator) for most in (360, 1000))
    state = task.task.start(layout, heading)
    axes = {
        axis: size * torch.rand(n, generator=generator)
        for axis, size in zip("xyz", task.world.size, strict=False)
    }
    state = state._replace(**axes, steps=torch.randint(1, 14, (n,), generator=generator))
    return task.remember(state, task.draw(n, generator))


def rolled(env, steps, seed=0):
    """What random flight through several episodes sees and earns [T, *B, n]."""
    root, found = env.root(), []
    for action in actions(env.task, env.batch_size, steps, seed):
        step, root = env.step_and_maybe_reset(root.set("action", action))
        found.append(
            torch.cat([root["observation"], step["next", "observation"], step["next", "reward"]], -1)
        )
    return torch.stack(found)


def equal(one, other):
    return all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


# -- the functions -------------------------------------------------------------------------------------------


@of_every_task
@whatever_is_around
def test_a_batch_gives_each_row_what_it_gives_alone_to_the_last_bit(name, fields, around):
    task, generator = made(name, fields, around, max_steps=10), torch.Generator().manual_seed(0)
    before, action = states(task, 12, generator), torch.randint(100, (12,), generator=generator)
    draws = task.draw(12, generator)
    after, outcome = task.step(before, action, draws)
    observation, clearance = task.observe(after)
    assert torch.equal(observation, outcome.observation)
    assert torch.equal(clearance, outcome.clearance)
    for row in range(12):
        alone, found = task.step(at(before, row), action[row], draws[row])
        assert equal((*at(after, row), *(part[row] for part in outcome)), (*alone, *found))
    square, found = task.step(
        type(before)(*(part.unflatten(0, (3, 4)) for part in before)),
        action.reshape(3, 4),
        draws.unflatten(0, (3, 4)),
    )
    assert equal((part.flatten(0, 1) for part in (*square, *found)), (*after, *outcome))


@of_every_task
def test_with_nothing_set_the_wrapper_is_its_task_to_the_last_bit(name, fields):
    task = made(name, fields, max_steps=15)
    for wrapped in (WrappedTask(task.task), made(name, fields, max_steps=15, faults=dict.fromkeys(NAMES, 0))):
        assert (wrapped.n_draws, wrapped.remembers, wrapped.state_class) == (0, False, task.task.STATE)
        layout, heading = torch.arange(20), torch.arange(20) * 18
        mine, bare = wrapped.start(layout, heading), task.task.start(layout, heading)
        for action in actions(task, (20,), 30):
            assert type(mine) is type(bare)
            assert equal((*mine, *wrapped.observe(mine)), (*bare, *task.task.observe(bare)))
            (mine, found), (bare, expected) = wrapped.step(mine, action), task.task.step(bare, action)
            assert equal(found, expected)


@of_every_task
@whatever_is_around
def test_shapes_types_ends_and_counts_are_what_they_are_said_to_be_in_every_step(name, fields, around):
    task, generator = made(name, fields, around, max_steps=12), torch.Generator().manual_seed(1)
    low = torch.tensor(task.world.observation_low).repeat(task.stack)
    size, n = task.stack * task.world.observation_size, 40
    assert task.observation_size == len(low) == size
    state = task.start(torch.arange(n), torch.arange(n) * 9, task.draw(n, generator))
    assert isinstance(state, tuple)
    assert {*State._fields} <= {*task.STATE._fields} <= {*state._fields}
    types, ended = [part.dtype for part in state], 0
    for action in actions(task, (n,), 12):
        before, (state, outcome) = state, task.step(state, action, task.draw(n, generator))
        assert [part.dtype for part in state] == types
        assert (outcome.observation.shape, outcome.observation.dtype) == ((n, size), torch.float32)
        assert ((outcome.observation >= low) & (outcome.observation <= 1)).all()
        judged = [part.dtype for part in (outcome.reward, outcome.terminated, outcome.truncated)]
        assert judged == [torch.float64, torch.bool, torch.bool]
        assert torch.equal(outcome.truncated, (state.steps == 12) & ~outcome.terminated)
        assert (outcome.terminated | (outcome.clearance > task.world.drone_radius)).all()
        assert torch.equal(state.steps, before.steps + 1)
        assert torch.equal(state.reward, before.reward + outcome.reward)
        assert (
            (state.full_stops <= state.stops) & (state.stops <= state.steps) & (state.turns <= state.steps)
        ).all()
        assert {part.shape for part in task.info(state).values()} == {(n,)}
        assert task.obstacles(state).shape[:-1] == task.velocities(state).shape[:-1]
        assert task.marks(state).shape[::2] == (n, 3)
        ended += outcome.terminated.sum().item()
    assert ended > 0
    task.try_out()


@of_every_task
def test_a_task_comes_back_from_its_header_in_json(name, fields):
    task = made(name, {**fields, "padding": "zeros"}, "both", max_steps=9)
    found = json.loads(json.dumps(header(task)))
    del found["layouts"]
    again = make_task("test", found.pop("world"), **found)
    assert (type(again.task), again.world, again.faults) == (TASKS[name], task.world, task.faults)
    assert header(again) == header(task)
    assert name_of(again) == name_of(again.task) == name


def test_the_names_that_commands_show_without_torch_are_those_of_the_tasks():
    assert (*TASKS,) == (*protocol.TASK_NAMES, "narrow")
    assert {*KINDS} == {*protocol.TASK_NAMES}


# -- the shells ----------------------------------------------------------------------------------------------


@of_every_task
@pytest.mark.parametrize("around", ["bare", "both"])
def test_torchrl_finds_nothing_wrong_and_an_ended_episode_is_followed_by_one_on_the_next_set(
    name, fields, around
):
    env = env_of(name, fields, around)
    check_env_specs(env)
    assert env.observation_spec["observation"].shape == (2, 3, env.task.observation_size)
    now, ends = env.reset(), 0
    for action in actions(env.task, (2, 3), 40):
        before = env.state.layout
        step, now = env.step_and_maybe_reset(now.set("action", action))
        assert env.observation_spec.is_in(now.select("observation", "episode"))
        done = step["next", "done"].squeeze(-1)
        assert torch.equal(step["next", "episode", "layout"], before)
        assert torch.equal(now["episode", "layout"], torch.where(done, (before + 1) % 1000, before))
        assert not now["episode", "steps"][done].any()
        assert torch.equal(now["observation"], env.task.observe(env.state)[0])
        ends += done.sum().item()
    assert ends > 5


@of_every_task
@pytest.mark.parametrize("around", ["bare", "both"])
def test_a_seed_flies_the_same_twice_among_others_as_alone_and_in_one_go_as_apart(name, fields, around):
    fields = {**fields, "start_heading": "random"}
    among, again = (env_of(name, fields, around, (3, 2)) for _ in range(2))
    alone = DroneEnv([1, 2], task=among.task, seeds=[5])
    now, apart, own = among.reset(), again.reset(), alone.reset()
    for action in actions(among.task, (3, 2), 30):
        assert torch.equal(now["observation"], apart["observation"])
        assert torch.equal(now["observation"][1], own["observation"][0])
        step, now = among.step_and_maybe_reset(now.set("action", action))
        after = again.step(apart.set("action", action))["next"]
        by_itself, own = alone.step_and_maybe_reset(own.set("action", action[1:2]))
        assert (step["next"] == after).all()
        assert (step["next"][1] == by_itself["next"][0]).all()
        apart = again.maybe_reset(after)
    assert equal(among.state, again.state)
    assert equal((part[1] for part in among.state), (part[0] for part in alone.state))
    headings = [DroneEnv([1, 20], task=among.task, seeds=[seed]).state.heading for seed in (5, 5, 6)]
    assert torch.equal(headings[0], headings[1])
    assert not torch.equal(headings[0], headings[2])


@of_every_task
@whatever_is_around
def test_an_environment_goes_on_from_its_state_bit_for_bit(name, fields, around):
    fields = {**fields, "start_heading": "random"}
    env, again = env_of(name, fields, around), env_of(name, fields, around)
    again.set_seed(9)  # of which nothing is left
    rolled(env, 20)
    kept = env.state_dict()
    streams = {"first_faults", "faults"} if env.task.n_draws else set()
    assert {*kept} == {"state", "observation", "headings"} | streams
    assert {*kept["state"]} == {*env.task.STATE._fields} | (
        {"seen", "executed"} if env.task.remembers else set()
    )
    rest = rolled(env, 20, seed=9)
    again.load_state_dict(kept)
    assert torch.equal(rolled(again, 20, seed=9), rest)
    if streams:
        again.load_state_dict(kept | {"first_faults": kept["faults"], "faults": kept["first_faults"]})
        assert not torch.equal(rolled(again, 20, seed=9), rest)


@of_every_task
@whatever_is_around
def test_all_three_environments_fly_the_same_45_steps_and_say_where_everything_is(name, fields, around):
    """By name and fields, as users make them; a slow loop says where the drone and the obstacles are."""
    fields = {**fields, "start_heading": "random"}
    how = {"layouts": "test", "task": name, "max_steps": 20, **AROUND[around]}
    one = gymnasium.make("uavnav/Drone-v0", **how, **fields)
    many = gymnasium.make_vec("uavnav/Drone-v0", num_envs=3, **how, **fields)
    env = DroneEnv([3], seeds=[3, 8, 9], task=made(name, fields, around, max_steps=20))
    (alone, info), (seen, infos), now = one.reset(seed=3), many.reset(seed=[3, 8, 9]), env.reset()
    assert one.observation_space.shape == many.single_observation_space.shape == (env.task.observation_size,)
    for action in actions(env.task, (3,), 45, seed=4).tolist():
        assert np.array_equal(now["observation"].numpy(), seen)
        np.testing.assert_allclose(alone, seen[0], rtol=0, atol=1e-6)
        assert one.observation_space.contains(alone)
        assert {key: infos[key][0] for key in info} == pytest.approx(info, abs=1e-4)
        state = env.state
        assert np.array_equal(one.unwrapped.obstacles, env.task.obstacles(state)[0].numpy())
        assert np.array_equal(many.unwrapped.velocities, env.task.velocities(state).numpy())
        step, now = env.step_and_maybe_reset(now.set("action", torch.tensor(action)))
        alone, earned, *ends, info = one.step(action[0])
        seen, reward, over, capped, infos = many.step(np.array(action))
        assert (earned, ends) == (pytest.approx(reward[0], abs=1e-6), [over[0], capped[0]])
        assert np.array_equal(step["next", "terminated"].squeeze(-1).numpy(), over)
        assert np.array_equal(step["next", "reward"].squeeze(-1).numpy(), reward.astype(np.float32))
        if any(ends):
            np.testing.assert_allclose(alone, infos["final_obs"][0], rtol=0, atol=1e-6)
            alone, info = one.reset()
    _, info = one.reset(options={"layout": 7})
    assert info["layout"] == 7
    assert many.reset(options={"layout": [7, 8, 9]})[1]["layout"].tolist() == [7, 8, 9]


@of_every_task
def test_where_drone_and_obstacles_are_is_what_a_slow_loop_says(name, fields):
    if name not in KINDS:
        pytest.skip("the oracle of a user's task is its user's")
    task = made(name, fields)
    layout, heading = torch.tensor([3, 8]), torch.tensor([90, 40])
    state, episodes = task.start(layout, heading), slow_episodes(task, layout.tolist(), heading.tolist())
    for action in actions(task, (2,), 25, seed=1):
        state, _ = task.step(state, action)
        info, around, moves = task.info(state), task.obstacles(state).tolist(), task.velocities(state)
        for row, episode in enumerate(episodes):
            episode.step(action[row].item())
            take_over(episode, state, row)
            told = {"x", "y", "z", "heading", "pitch", "layout"} & {*vars(episode)} | {"steps"} & {*info}
            assert {one: info[one][row] for one in told} == {one: getattr(episode, one) for one in told}
            assert info.get("yaw", info["heading"])[row] == episode.heading
            assert np.array(around[row]) == pytest.approx(np.array(episode.obstacles()), abs=1e-4)
            drifted = (
                episode.drift(episode.layouts[episode.layout], episode.steps) if "moving" in name else []
            )
            expected = [velocity for _, velocity in drifted] or 0
            np.testing.assert_allclose(moves[row], expected, atol=1e-6)


@of_every_task
@pytest.mark.parametrize("script", BASELINES)
def test_every_scripted_policy_flies_whatever_is_sensed(name, fields, script):
    rows = evaluation.fly(
        {0: BASELINES[script]}, evaluation.on(made(name, fields, "stack"), "test", 3, 5)
    ).episodes
    assert rows["steps"].between(1, 5).all()


def test_a_task_without_a_wrapper_is_wrapped_where_it_is_given():
    bare = made("narrow", {}).task
    for env in (DroneEnv([2], task=bare, stack=2), uavnav.gym.DroneGymEnv(task=bare, stack=2)):
        assert (type(env.task), env.task.stack, name_of(env.task)) == (WrappedTask, 2, "narrow")
