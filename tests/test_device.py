"""Another device than the CPU: torch's `meta` device computes nothing, and refuses what would mix devices."""

import pytest
import torch
from batches import rollout, transitions

from uavnav.acting import Actor
from uavnav.algorithms import a2c, dqn, ppo, sac
from uavnav.algorithms.rollout import minibatches
from uavnav.envs.env import DroneEnv
from uavnav.tasks.seeding import Streams
from uavnav.tasks.table import make_task
from uavnav.training import probes

ALGORITHMS = {
    "ppo": ppo.PPOConfig(preset="vectorised", n_seeds=2),
    "dqn": dqn.DQNConfig(preset="vectorised", n_seeds=2),
    "a2c": a2c.A2CConfig(preset="vectorised", n_seeds=2),
    "sac": sac.SACConfig(preset="vectorised", n_seeds=2),
}


@pytest.fixture(scope="module")
def meta():
    """The paper's task on the test split [L, K, 3], and the poses of the probe [P, 30]."""
    task = make_task("test", max_steps=10)
    return task.replace(layouts=task.layouts.to("meta")), probes.poses(task).to("meta")


def test_a_hidden_cpu_tensor_would_be_refused(meta):
    layouts = meta[0].layouts
    with pytest.raises(RuntimeError, match="device cpu"):
        layouts + torch.rand(layouts.shape)


@pytest.mark.parametrize("reward", ["eq14", "additive", "initial"])
def test_a_step_of_the_world_stays_on_its_device(meta, reward):
    task = meta[0].replace(reward=reward)
    state = task.start(
        torch.zeros(2, 5, dtype=torch.int64, device="meta"), torch.full((2, 5), 90, device="meta")
    )
    state, outcome = task.step(state, torch.full((2, 5), 37, device="meta"))
    assert {value.device.type for value in (*state, *outcome)} == {"meta"}


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_updates_and_diagnostics_stay_on_their_device(meta, algorithm):
    config, (_, poses) = ALGORITHMS[algorithm], meta
    module = {"ppo": ppo, "dqn": dqn, "a2c": a2c, "sac": sac}[algorithm]
    if algorithm == "dqn":
        policy = dqn.make_network(config).to("meta")
        loss = dqn.make_loss(policy, config)
    else:
        policy, other = (sac if algorithm == "sac" else ppo).make_networks(config)
        make_loss = {"ppo": ppo.PPOLoss, "a2c": a2c.make_loss, "sac": sac.SACLoss}[algorithm]
        loss = make_loss(policy, other, config).to("meta")
    batch = rollout(2, 4, 8).update(transitions(2, 4, 8)).to("meta")
    losses = module.make_learner(loss, config, compile=False).learn(batch)
    assert all(value.device.type == "meta" for value in losses.values())
    assert all(value.device.type == "meta" for value in probes.units(policy, poses).values())


def collected(env, actor, n_steps):
    """A rollout [A, W, T] by the calls that a collector makes; TorchRL's own asks `meta` for numbers."""
    now, steps = env.root(), []
    for _ in range(n_steps):
        step, now = env.step_and_maybe_reset(actor(now))
        steps.append(step)
    return torch.stack(steps, 2)


@pytest.fixture
def unspecified(monkeypatch):
    """An environment without TorchRL's specs, which ask for numbers that `meta` has not."""
    monkeypatch.setattr(DroneEnv, "_make_specs", lambda env: None)


def test_ppo_collects_estimates_learns_and_diagnoses_on_one_device(unspecified):
    """What an iteration does but for the recorder, which takes numbers to the CPU."""
    config = ppo.PPOConfig(preset="vectorised", n_seeds=2, frames_per_batch=128, minibatch_size=64, epochs=1)
    env = DroneEnv([2, config.n_envs], device="meta", seeds=config.seeds, task=config.make_task())
    policy, value = ppo.make_networks(config)
    loss = ppo.PPOLoss(policy, value, config).to("meta")
    batch = collected(env, Actor(policy, config.seeds, ppo.HOW.acts, ppo.HOW.head, compile=False), 8)
    assert batch.shape == (2, config.n_envs, 8)
    ppo.estimate(batch, policy, value, config)
    drawn = minibatches(batch, Streams(config.seeds, "minibatches"), 64, ppo.LEARNED)
    losses = ppo.make_learner(loss, config, compile=False).learn(drawn)
    moved = ppo.diagnostics(batch, policy, config.clip_epsilon)
    found = [*batch.values(include_nested=True, leaves_only=True), *losses.values(), *moved.values()]
    assert {value.device.type for value in found} == {"meta"}
    assert all(value.shape == (2,) for value in moved.values())


def test_two_iterations_of_a2c_collect_and_learn_on_one_device(unspecified):
    config = a2c.A2CConfig(preset="vectorised", n_seeds=2)
    object.__setattr__(config, "device", "meta")  # as a configuration it is refused, for it has no numbers
    env = DroneEnv([2, config.n_envs], device="meta", seeds=config.seeds, task=config.make_task())
    trainee = config.make(compile=False)
    for frames in (80, 2 * a2c.LOG_FRAMES):
        batch = collected(env, trainee.actor, 5)
        row = trainee.learn(batch, frames)
    found = [
        *batch.values(include_nested=True, leaves_only=True),
        *row.values(),
        *trainee.policy.parameters(),
    ]
    assert {value.device.type for value in found} == {"meta"}
    assert {tuple(value.shape) for value in row.values()} == {(2,)}


def test_dqn_acts_on_one_device_whose_epsilon_too_lies_there(unspecified):
    config = dqn.DQNConfig(preset="vectorised", n_seeds=2)
    env = DroneEnv([2, config.n_envs], device="meta", seeds=config.seeds, task=config.make_task())
    network = dqn.make_network(config).to("meta")
    actor = Actor(network, config.seeds, "epsilon-greedy", config.head, compile=False, epsilon=config.epsilon)
    batch = collected(env, actor, 1)
    assert {value.device.type for value in (*actor.draw(1, 4), *batch.values(True, True))} == {"meta"}
