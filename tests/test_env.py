"""DroneEnv: TorchRL's protocol, whole episodes against the oracle, seeds, resets and counts."""

import itertools
import math

import oracle
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs, step_mdp

import uavnav
from uavnav.acting import Actor
from uavnav.envs import env as torchrl_env
from uavnav.networks import mlp
from uavnav.tasks import layouts
from uavnav.tasks.seeding import stream

COUNTS = ("steps", "stops", "full_stops", "turns", "distance")
STRAIGHT = 9  # no turn, 9 px


@pytest.fixture(scope="module")
def all_layouts():
    return layouts.load("test")


def actions_of(env, steps, seed=0):
    """Uniform random actions [steps, *B]."""
    return torch.randint(100, (steps, *env.batch_size), generator=torch.Generator().manual_seed(seed))


def step_then_reset(env, now):
    env.step(now)
    after = now["next"], env.state
    return *after, env.maybe_reset(step_mdp(now))


def at_once(env, now):
    now, following = env.step_and_maybe_reset(now)
    return now["next"], None, following


DRIVERS = [step_then_reset, at_once]


def drive(env, actions, driver=at_once):
    """Yield what each step led to, the state there (None where the driver hides it), and what follows."""
    now = env.reset()
    for action in actions:
        after, state, now = driver(env, now.set("action", action))
        yield after, state, now


def close(got, expected):
    torch.testing.assert_close(got, torch.tensor(expected), rtol=0, atol=1e-4)


def episodes_of(env, **how):
    all_layouts = env.layouts.tolist()
    state = env.state
    return [
        oracle.Episode(all_layouts, layout, heading, max_steps=env.task.max_steps, **how)
        for layout, heading in zip(state.layout.tolist(), state.heading.tolist(), strict=True)
    ]


def judge(episode, after, row):
    """One row's step against the oracle's; whether it was too near a threshold to compare what is sensed."""
    assert after["terminated"][row].item() == episode.terminated
    assert after["truncated"][row].item() == episode.truncated
    assert after["done"][row].item() == (episode.terminated or episode.truncated)
    assert after["reward"][row].item() == pytest.approx(episode.reward, abs=1e-6)
    found = after["episode"][row]
    assert {name: found[name].item() for name in COUNTS} == {name: getattr(episode, name) for name in COUNTS}
    assert found["layout"].item() == episode.layout
    assert found["reward"].item() == pytest.approx(episode.total, abs=1e-9)
    doubtful = oracle.doubtful(episode.found)
    if not doubtful:
        close(after["observation"][row], sum(episode.slots, ()))
    return doubtful


@pytest.mark.parametrize("shape", [[], [3], [2, 3]])
def test_torchrl_finds_no_fault_in_the_specs_of_three_batch_shapes(shape):
    env = uavnav.DroneEnv(shape)
    check_env_specs(env)
    assert env.observation_spec["observation"].shape == (*shape, 30)
    assert env.action_spec.n == 100


# The ways to step are bit-identical, as another test shows, so that each meets the oracle with one time
# limit.
@pytest.mark.parametrize("variant", ["eq14", "additive", "initial"])
@pytest.mark.parametrize(("driver", "max_steps"), [(step_then_reset, None), (at_once, 40)])
def test_300_steps_of_4_rows_equal_the_oracle_through_collisions_caps_and_the_last_of_7_layouts(
    all_layouts, driver, variant, max_steps
):
    env = uavnav.DroneEnv([4], layouts=all_layouts[:7], reward=variant, max_steps=max_steps, seeds=7)
    episodes = episodes_of(env, variant=variant)
    collisions, limits, doubts, firsts = 0, 0, 0, 0
    actions = actions_of(env, 300)
    for action, (after, state, following) in zip(actions, drive(env, actions, driver), strict=True):
        places = state or env.state
        for row, episode in enumerate(episodes):
            episode.step(action[row].item())
            done = episode.terminated or episode.truncated
            if state is not None or not done:
                episode.at(places.x[row].item(), places.y[row].item())
                assert places.heading[row].item() == episode.heading
            doubts += judge(episode, after, row)
            collisions, limits = collisions + episode.terminated, limits + episode.truncated
            if done:
                episode.next_episode()
                firsts += episode.layout == 0
                close(following["observation"][row], sum(episode.slots, ()))
                assert following["episode", "steps"][row] == 0
                assert following["episode", "layout"][row] == episode.layout
            assert env.state.layout[row] == episode.layout
            assert env.state.steps[row] == episode.steps
            assert not following["done"][row]
    assert collisions >= 5
    assert (limits >= 5) == (max_steps is not None)
    assert firsts >= 2
    assert doubts < 24  # of 1,200 poses, which an episode strings together


def same_rows(env, rows, other, actions):
    """Rows of one environment and the whole of another, under the same actions, bit by bit."""
    for (after, _, now), (also, _, then) in zip(
        drive(env, actions), drive(other, actions[:, rows]), strict=True
    ):
        assert (after[rows] == also).all()
        assert (now[rows] == then).all()
    assert all(torch.equal(a[rows], b) for a, b in zip(env.state, other.state, strict=True))


def test_adding_worlds_up_to_64_keeps_the_places_of_the_earlier_ones():
    places = uavnav.DroneEnv([2, 64], seeds=[3, 4]).state.layout
    for worlds in (1, 2, 15, 16, 17, 32):
        assert torch.equal(uavnav.DroneEnv([2, worlds], seeds=[3, 4]).state.layout, places[:, :worlds])
        assert torch.equal(uavnav.DroneEnv([worlds], seeds=4).state.layout, places[1, :worlds])
    assert torch.equal(uavnav.DroneEnv([], seeds=3).state.layout, places[0, 0])
    assert len(set(places.flatten().tolist())) > 120


def test_setting_seed_6_again_repeats_the_episode(all_layouts):
    env = uavnav.DroneEnv([4], layouts=all_layouts, world=uavnav.World(start_heading="random"), seeds=2)
    actions = actions_of(env, 100)
    episodes = []
    for _ in range(2):
        env.set_seed(6)
        episodes.append(torch.stack([after for after, _, _ in drive(env, actions)]))
    fresh = uavnav.DroneEnv([4], layouts=all_layouts, world=uavnav.World(start_heading="random"), seeds=6)
    episodes.append(torch.stack([after for after, _, _ in drive(fresh, actions)]))
    assert (episodes[0] == episodes[1]).all()
    assert (episodes[0] == episodes[2]).all()


def test_a_masked_reset_restarts_2_of_5_rows_and_leaves_the_others_bit_identical(all_layouts):
    env = uavnav.DroneEnv([5], layouts=all_layouts)
    for _, _, now in drive(env, actions_of(env, 20)):
        before, seen = env.state, now.clone()
    mask = torch.tensor([False, True, False, False, True])
    after = env.reset(now.set("_reset", mask[:, None]))
    for old, new in zip(before, env.state, strict=True):
        assert torch.equal(old[~mask], new[~mask])
    assert torch.equal(after["observation"][~mask], seen["observation"][~mask])
    assert torch.equal(env.state.layout[mask], before.layout[mask] + 1)
    assert env.state.steps[mask].tolist() == [0, 0]
    assert env.state.x[mask].tolist() == [400, 400]


@pytest.mark.parametrize(
    ("limit", "terminated", "truncated"), [(27, False, True), (28, True, False), (29, True, False)]
)
@pytest.mark.parametrize("driver", DRIVERS)
def test_a_limit_of_27_truncates_and_the_collision_in_step_28_terminates_even_at_the_limit(
    driver, limit, terminated, truncated
):
    env = uavnav.DroneEnv([1], layouts=layouts.generate(1, 0), max_steps=limit)
    *early, (last, _, following) = drive(env, torch.full((min(limit, 28), 1), STRAIGHT), driver)
    assert not any(after["done"].item() for after, _, _ in early)
    assert last["done"].item()
    assert last["terminated"].item() == terminated
    assert last["truncated"].item() == truncated
    assert last["reward"].item() == pytest.approx(-10 if terminated else 0.09)
    assert env.state.steps.item() == 0
    assert not following["truncated"].item()


@pytest.mark.parametrize("task", ["drone", "moving", "goal", "space", "space-moving"])
def test_random_start_headings_are_whole_degrees_from_0_to_359_and_reproducible(task):
    how = {"layouts": "test", "task": task, "world": {"start_heading": "random"}}
    envs = [uavnav.DroneEnv([2, 500], **how, seeds=seeds) for seeds in ([1, 2], [1, 2], [3, 4])]
    starts = []
    for _ in range(3):
        for env in envs:
            env.reset()
        first, again, other = (env.state.heading for env in envs)
        starts.append(first)
        assert torch.equal(first, again)
        assert (first == other).float().mean() < 0.02
        assert (first[0] == first[1]).float().mean() < 0.02
        assert first.dtype == torch.int64
        assert 0 <= first.min() < 5
        assert 354 < first.max() <= 359
        assert first.double().mean().item() == pytest.approx(179.5, abs=4 * 104 / math.sqrt(1000))
    assert all((one == new).float().mean() < 0.02 for one, new in itertools.pairwise(starts))


@pytest.mark.parametrize("driver", DRIVERS)
def test_no_tensor_of_the_first_40_steps_is_changed_by_later_ones(all_layouts, driver):
    env = uavnav.DroneEnv([4], layouts=all_layouts, max_steps=15)
    episode = drive(env, actions_of(env, 120), driver)
    kept = []
    for after, _, now in episode:
        if len(kept) < 40:
            kept.append([part for td in (after, now) for part in (td, td.clone())] + [env.state])
            kept[-1].append([field.clone() for field in env.state])
    for after, after_then, now, now_then, state, state_then in kept:
        assert (after == after_then).all()
        assert all(
            (now[key] == now_then[key]).all()
            for key in now_then.keys(True, True)
            if key in now.keys(True, True)
        )
        assert all(torch.equal(a, b) for a, b in zip(state, state_then, strict=True))


@pytest.mark.parametrize("action", [-1, 100])
def test_step_refuses_an_action_outside_0_to_99(action):
    env = uavnav.DroneEnv([2])
    with pytest.raises(ValueError, match="0 to 99"):
        env.step(env.reset().set("action", torch.tensor([5, action])))


def test_the_first_reset_of_a_restored_environment_leaves_it_where_it_was_and_the_second_begins_anew(
    all_layouts,
):
    env = uavnav.DroneEnv([2, 4], layouts=all_layouts, seeds=[1, 2])
    list(drive(env, actions_of(env, 20)))
    saved = env.state_dict()
    env.load_state_dict(saved)
    assert torch.equal(env.reset()["observation"], saved["observation"])
    assert torch.equal(env.state.steps, saved["state"]["steps"])
    assert (env.reset()["episode", "steps"] == 0).all()
    assert torch.equal(env.state.layout, (saved["state"]["layout"] + 1) % 1000)


@pytest.mark.parametrize("how", [{"faults": {"noise": 5}}, {"world": uavnav.World(start_heading="random")}])
def test_a_state_taken_between_a_step_and_its_reset_goes_on_to_the_same_starts(how):
    first, second = (uavnav.DroneEnv([1, 3], layouts="test", seeds=[seed], **how) for seed in (4, 5))
    there = first.reset()
    for _ in range(28):  # straight on: 28 steps lead to the wall, or to an obstacle before it
        there = first.step(there.set("action", torch.full((1, 3), 9)))["next"]
    second.load_state_dict(first.state_dict())
    over = there.clone().set("_reset", torch.ones(1, 3, 1, dtype=torch.bool))
    starts = [env.reset(over.clone())["observation"] for env in (first, second)]
    assert torch.equal(*starts)
    assert torch.equal(first.state.heading, second.state.heading)


def test_the_first_reset_after_a_step_begins_anew_though_none_came_before():
    for driver in DRIVERS:
        env = uavnav.DroneEnv([3], layouts="test")
        first = env.state.layout
        driver(env, env.root().set("action", torch.full((3,), STRAIGHT)))
        assert torch.equal(env.reset()["episode", "layout"], first + 1)
        assert env.state.y.tolist() == [300] * 3


@pytest.mark.compiled
def test_50_compiled_steps_equal_the_eager_ones():
    eager, compiled = (uavnav.DroneEnv([2, 3], max_steps=20, seeds=[1, 2]) for _ in range(2))
    assert compiled.compile() is compiled
    actions = actions_of(eager, 50)
    for (after, _, now), (also, _, then) in zip(drive(eager, actions), drive(compiled, actions), strict=True):
        for key in after.keys(True, True):
            torch.testing.assert_close(also[key], after[key], rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(then["observation"], now["observation"], rtol=1e-5, atol=1e-6)
    assert len(compiled._advance._graphs) == 1
    assert compiled.eager() is compiled
    compiled.set_seed(1)
    same_rows(uavnav.DroneEnv([2, 3], max_steps=20, seeds=[1, 2]), slice(None), compiled, actions)


@pytest.mark.compiled
@pytest.mark.parametrize(
    "how",
    [
        {"max_steps": 20},
        {"task": "goal", "stack": 2, "max_steps": 30, "world": {"start_heading": "random"}}
        | {"faults": {"noise": 5.0, "late": 2, "sticky": 0.2}},
    ],
    ids=["paper", "goal with faults"],
)
def test_32_steps_as_one_graph_are_those_of_32_calls_and_the_next_batch_goes_on_from_there(how):
    """Batches [2, 3, 32] of `rollout` and of the collector, leaf by leaf and bit by bit."""
    found = []
    for whole in (True, False):
        env = uavnav.DroneEnv([2, 3], seeds=[1, 2], **how).compile()
        network = mlp(
            [env.task.observation_size, 16, 100], "tanh", [stream(0, "w"), stream(1, "w")], "default"
        )
        actor = Actor(network, [1, 2], "categorical", "direct", compile=True)
        batches = []
        if whole:
            batches.append(env.rollout(32, actor, break_when_any_done=False))
            batches.append(env.steps(actor, 32))
            assert env.whole(actor)  # none of them ran one by one
        else:
            now, steps = env.reset(), []
            for _ in range(64):
                step, now = env.step_and_maybe_reset(actor(now))
                steps.append(step)
            batches = [torch.stack(part, 2) for part in (steps[:32], steps[32:])]
        found.append((batches, env.state_dict()))
    (together, state), (one_by_one, other) = found
    for batch, same in zip(together, one_by_one, strict=True):
        assert batch.shape == (2, 3, 32)
        assert {*batch.keys(True, True)} == {*same.keys(True, True)}
        for key, leaf in same.items(True, True):
            assert batch[key].dtype == leaf.dtype
            assert torch.equal(batch[key], leaf), key
    assert together[0]["next", "done"].any()
    for name, field in other["state"].items():
        assert torch.equal(state["state"][name], field)


def test_without_tensordicts_private_constructor_50_steps_are_the_same(all_layouts, monkeypatch):
    usual, other = (uavnav.DroneEnv([2, 3], layouts=all_layouts, seeds=[1, 2]) for _ in range(2))
    expected = [after for after, _, _ in drive(usual, actions_of(usual, 50))]
    monkeypatch.setattr(torchrl_env, "unchecked", TensorDict)
    found = [after for after, _, _ in drive(other, actions_of(other, 50))]
    assert all((one == another).all() for one, another in zip(found, expected, strict=True))
