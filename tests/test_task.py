"""A task is one thing: its parts travel together, its subclasses fly everywhere, its rewards see a whole
step.
"""

import inspect

import numpy as np
import oracle
import pytest
import torch
from slow_episodes import Narrow, NarrowWorld

import uavnav
from uavnav import DroneEnv, World, load_policy
from uavnav.algorithms import ppo
from uavnav.envs import scalar
from uavnav.envs.gym import DroneGymEnv, DroneVectorEnv
from uavnav.errors import ConfigError
from uavnav.tasks import layouts
from uavnav.tasks.rewards import REWARDS
from uavnav.tasks.table import EMPTY, TASKS, make_task
from uavnav.tasks.table import header as header_of
from uavnav.training import weights
from uavnav.views import render

OTHER = {
    **{
        "border": 10,
        "drone_radius": 25.0,
        "sensor_radius": 100.0,
        "sensor_arc": 270.0,
        "n_slots": 7,
        "penalty": -0.02,
    },
    **{"slots": "listed", "padding": "zeros", "start_heading": "random"},
}
"""Some fields of a world that is not the paper's."""
FIELDS = World.names()


@pytest.fixture
def narrow(monkeypatch):
    """The task as it is once a plugin has put it into the table."""
    monkeypatch.setitem(TASKS, "narrow", Narrow)
    return make_task("test", task="narrow")


def batch(task, n, steps, seed=0):
    """Yield, of each step of n rows on the first n sets: the state before it, its actions, the state
    after, outcome.
    """
    generator = torch.Generator().manual_seed(seed)
    state = task.start(torch.arange(n), torch.randint(360, (n,), generator=generator))
    for _ in range(steps):
        action = torch.randint(100, (n,), generator=generator)
        before = state
        state, outcome = task.step(before, action)
        yield before, action, state, outcome


# -- as one --------------------------------------------------------------------------------------------------


def test_a_header_holds_every_field_of_the_world_the_reward_the_limit_and_the_layout_files_hash():
    header = header_of(make_task("test", OTHER, "additive", 50))
    assert set(header) == {"task", "world", "reward", "max_steps", "stack", "faults", "layouts"}
    assert list(header["world"]) == FIELDS
    assert len(FIELDS) >= 18
    assert header["world"].items() >= OTHER.items()
    assert (header["task"], header["reward"], header["max_steps"]) == ("drone", "additive", 50)
    assert header["layouts"] == layouts.read("test")[1]["sha256"] == header_of(make_task("test"))["layouts"]
    assert header["layouts"] != header_of(make_task("train"))["layouts"]


def test_a_world_is_its_own_class_or_a_mapping_of_some_fields_or_nothing():
    assert make_task("test", OTHER).world == make_task("test", World(**OTHER)).world == World(**OTHER)
    assert make_task("test", {"sensor_arc": 90}).world == World(sensor_arc=90)
    assert make_task("test", {}).world == make_task("test").world == World()


def test_a_whole_task_says_all_that_the_other_arguments_would_say():
    whole = make_task("validation", OTHER, "additive", 7)
    assert make_task("test", World(), "initial", 99, whole) is whole


def test_a_layout_file_that_was_made_for_a_wider_window_flies_in_it_alone():
    wider = World(width=1000)
    all_layouts = layouts.generate(200, 8, seed=3, world=wider)
    assert torch.equal(make_task(all_layouts, wider).layouts, all_layouts)
    with pytest.raises(uavnav.LayoutError, match="is nearer than 50 px to the start"):
        make_task(all_layouts)
    with pytest.raises(
        uavnav.LayoutError, match=r"layouts='test': .* give a layout file that fits this world"
    ):
        make_task("test", wider)


def test_on_another_split_and_limit_a_task_keeps_its_world_its_reward_and_its_class(narrow):
    for task in (make_task("test", OTHER, "additive", 50), narrow.replace(reward="initial")):
        moved = task.on("validation", 9)
        assert torch.equal(moved.layouts, layouts.load("validation"))
        assert (moved.world, moved.reward, type(moved.task)) == (task.world, task.reward, type(task.task))
        assert (moved.max_steps, task.on(EMPTY, None).max_steps) == (9, None)
        assert torch.equal(task.layouts, layouts.load("test"))
    with pytest.raises(uavnav.LayoutError, match="no such layout file"):
        task.on("tset", None)
    with pytest.raises(ValueError, match="max_steps=0"):
        task.on("test", 0)


@pytest.mark.parametrize("kind", [DroneEnv, DroneGymEnv, DroneVectorEnv])
def test_each_of_3_environments_takes_the_parts_of_a_task_or_a_whole_one(kind):
    parameters = inspect.signature(kind.__init__).parameters
    defaults = {name: parameter.default for name, parameter in parameters.items()}
    parts = {"layouts": "train", "world": None, "max_steps": None, "reward": None, "task": "drone"}
    parts |= {"stack": 1, "faults": None}
    assert [name for name in defaults if name in parts] == list(parts)
    assert {name: defaults[name] for name in parts} == parts
    whole = make_task("validation", OTHER, "additive", 7)
    for env in (kind(task=whole), kind(layouts="test", reward="initial", max_steps=99, task=whole)):
        assert (env.task.world, env.task.reward, env.task.max_steps) == (whole.world, "additive", 7)
        assert torch.equal(env.task.layouts, whole.layouts)
    with pytest.raises(
        ValueError, match=r"task='dorne'; did you mean drone\? choose from drone, goal, moving, "
    ):
        kind(task="dorne")


@pytest.mark.parametrize(
    "given", [{"world": OTHER, "reward": "additive", "max_steps": 50}, {"task": "narrow"}]
)
def test_a_policys_file_gives_back_the_task_that_it_was_trained_in(given, narrow, tmp_path):
    config = ppo.PPOConfig(layouts="test", hidden=(4,), **given)
    trainee = config.make(compile=False)
    path = tmp_path / "policy.safetensors"
    path.write_bytes(weights.serialize(trainee.networks(), config, trainee.actor))
    policy, task = load_policy(path), config.make_task()
    (pilot,) = render.load_pilots([str(path)])
    for there in (policy.task, pilot.task):
        assert {**header_of(there), "layouts": policy.layouts} == header_of(task)
        assert type(there.task) is type(task.task)
    assert (policy.world, policy.reward, policy.seed) == (task.world, task.reward, 0)
    assert pilot.mode == "sampled"
    observation, _ = task.observe(task.start(torch.arange(5), torch.full((5,), 90)))
    assert torch.equal(policy.values(observation), trainee.policy(observation[None])[0])


# -- a subclass ----------------------------------------------------------------------------------------------


def test_a_subclass_has_a_world_of_its_own_with_a_field_of_its_own(narrow):
    assert narrow.world == NarrowWorld()
    assert header_of(narrow)["task"] == "narrow"
    assert list(header_of(narrow)["world"]) == [*FIELDS, "fog"]
    config = ppo.PPOConfig(task="narrow", world={"fog": 0.25})
    assert config.world == NarrowWorld(fog=0.25)
    assert type(config.make_task().task) is Narrow
    with pytest.raises(
        uavnav.ConfigError, match=r"there is no key 'world\.fogg'; .*did you mean world\.fog\?"
    ):
        ppo.PPOConfig(task="narrow", world={"fogg": 1})
    with pytest.raises(uavnav.ConfigError, match="give a NarrowWorld"):
        ppo.PPOConfig(task="narrow", world=World())


def flown_alone(task, layout, heading, actions):
    """Observations, clearances, rewards and ends of one episode in plain numbers, from its start on."""
    episode = scalar.fly(task)
    observation = episode.start(layout, heading)
    yield observation, episode.clearance, 0.0, False, False
    for action in actions:
        observation, *rest = episode.step(action)
        yield observation, episode.clearance, *rest


def equal_the_batch(task, steps=60):
    """Whether one drone alone flies as a row of a batch does, bit by bit."""
    actions = np.random.default_rng(5).integers(100, size=steps).tolist()
    state = task.start(torch.tensor([3, 8]), torch.tensor([90, 40]))
    start, *rest = flown_alone(task, 8, 40, actions)
    observation, clearance = task.observe(state)
    assert np.array_equal(start[0], observation[1].numpy())
    assert start[1] == clearance[1].item()
    for action, (observation, clearance, *judged) in zip(actions, rest, strict=True):
        state, outcome = task.step(state, torch.tensor([9, action]))
        assert np.array_equal(observation, outcome.observation[1].numpy())
        assert clearance == outcome.clearance[1].item()
        assert judged == [part[1].item() for part in (outcome.reward, outcome.terminated, outcome.truncated)]


@pytest.mark.parametrize("name", ["observe", "step"])
def test_a_subclass_that_defines_what_no_run_would_call_is_refused(name):
    told = rf"Own\.{name}: runs would never call it; define sense, encode, move or judge instead"
    with pytest.raises(ConfigError, match=told):
        type("Own", (Narrow,), {name: lambda self, *given: None})


def test_a_subclass_flies_alone_as_a_batch_of_one_for_60_steps(narrow):
    assert type(scalar.fly(narrow)) is scalar.BatchOfOne
    equal_the_batch(narrow.on("test", 50))


# -- rewards -------------------------------------------------------------------------------------------------


def roomy(step):
    """A hundredth a pixel of room around the drone."""
    return {
        "collision": step.collided * -10.0,
        "room": torch.where(step.collided, 0.0, 0.01 * step.clearance.double()),
    }


def gentle(step):
    """A thousandth off for each degree of a turn."""
    return {"collision": step.collided * -10.0, "turn": -0.001 * step.angle.abs().double()}


SLOW = {
    "roomy": lambda turn, episode: -10 if episode.terminated else 0.01 * episode.clearance,
    "gentle": lambda turn, episode: -10 * episode.terminated - 0.001 * abs(turn),
}


@pytest.fixture(params=SLOW)
def own(request, monkeypatch):
    """A user's reward by name, and what it pays for a turn and the oracle's episode after a step."""
    monkeypatch.setitem(REWARDS, "roomy", roomy)
    monkeypatch.setitem(REWARDS, "gentle", gentle)
    return request.param, SLOW[request.param]


def test_a_users_reward_pays_300_steps_of_3_rows_of_droneenv_and_gymnasium_as_a_slow_loop_does(own):
    name, slow = own
    env, vector = (
        DroneEnv([3], layouts="test", reward=name, seeds=2),
        DroneVectorEnv(3, layouts="test", reward=name),
    )
    single = DroneGymEnv(layouts="test", reward=name)
    now, layouts, ends = env.reset(), env.layouts.tolist(), 0
    vector.reset(seed=2)
    single.reset(seed=2)
    episodes = [oracle.Episode(layouts, layout, max_steps=None) for layout in env.state.layout.tolist()]
    for actions in np.random.default_rng(1).integers(100, size=(300, 3)):
        now = env.step(now.set("action", torch.as_tensor(actions)))["next"]
        _, reward, *_ = vector.step(actions)
        _, alone, *over, _ = single.step(actions[0])
        assert np.array_equal(reward.astype(np.float32), now["reward"].squeeze(-1).numpy())
        assert alone == pytest.approx(reward[0], abs=1e-12)
        for row, (episode, action) in enumerate(zip(episodes, actions.tolist(), strict=True)):
            episode.step(action)
            episode.at(env.state.x[row].item(), env.state.y[row].item())
            assert now["terminated"][row].item() == episode.terminated
            assert reward[row] == pytest.approx(slow(oracle.decode(action)[0], episode), abs=1e-6)
            if episode.terminated:
                ends += 1
                episode.next_episode()
        if any(over):
            single.reset()
        now = env.maybe_reset(now)
    assert ends > 6


def test_a_users_reward_is_handed_to_the_batch_of_one_and_the_three_built_in_ones_to_the_table(own):
    name, _ = own
    task = make_task("test", reward=name, max_steps=50)
    assert type(scalar.fly(task)) is scalar.BatchOfOne
    equal_the_batch(task)
    for reward in ("eq14", "additive", "initial"):
        assert type(scalar.fly(make_task("test", reward=reward))) is scalar.Episode


def test_another_reward_by_the_name_of_eq14_is_not_taken_for_it(monkeypatch):
    monkeypatch.setitem(REWARDS, "eq14", gentle)
    equal_the_batch(make_task("test"))
    assert type(scalar.fly(make_task("test"))) is scalar.BatchOfOne


def test_a_reward_sees_where_the_drone_was_where_it_is_and_all_that_the_step_led_to(monkeypatch):
    steps = []
    monkeypatch.setitem(REWARDS, "watch", lambda step: steps.append(step) or {"one": torch.ones(4).double()})
    task = make_task("test", reward="watch")
    for before, action, after, outcome in batch(task, 4, 20):
        step = steps.pop()
        assert all(torch.equal(a, b) for a, b in zip(step.before, before, strict=True))
        earlier = after._replace(reward=before.reward)  # what the step earns is not known yet
        assert all(torch.equal(a, b) for a, b in zip(step.after, earlier, strict=True))
        assert torch.equal(after.reward, before.reward + 1)
        turn, distance = zip(*map(oracle.decode, action.tolist()), strict=True)
        assert (step.angle.tolist(), step.distance.tolist()) == (list(turn), list(distance))
        assert torch.equal(step.action, action)
        assert torch.equal(step.collided, outcome.terminated)
        assert torch.equal(step.clearance, outcome.clearance)
        assert torch.equal(step.observation, outcome.observation)
        assert step.world is task.world
