"""Another device than the CPU: torch's `meta` device computes nothing, and refuses what would mix devices."""

import pytest
import torch
from tensordict import TensorDict

from uavnav.algorithms import dqn, ppo
from uavnav.envs.env import DroneEnv
from uavnav.tasks import layouts, simulator
from uavnav.tasks.world import World
from uavnav.training import probes

WORLD = World()
ALGORITHMS = {"ppo": ppo.PPOConfig(n_seeds=2), "dqn": dqn.DQNConfig(n_seeds=2)}


@pytest.fixture(scope="module")
def meta():
    """The test bank [L, K, 3] and the poses of the probe [P, 30]."""
    return layouts.load("test").to("meta"), probes.poses(WORLD).to("meta")


def test_a_hidden_cpu_tensor_would_be_refused(meta):
    bank, _ = meta
    with pytest.raises(RuntimeError, match="device cpu"):
        bank + torch.rand(bank.shape)


@pytest.mark.parametrize("reward", ["eq14", "additive", "initial"])
def test_a_step_of_the_world_stays_on_its_device(meta, reward):
    bank, _ = meta
    state = simulator.start(
        torch.zeros(2, 5, dtype=torch.int64, device="meta"), torch.full((2, 5), 90, device="meta"), WORLD
    )
    action = torch.full((2, 5), 37, device="meta")
    state, outcome = simulator.step(state, action, bank, WORLD, reward, 10)
    assert {value.device.type for value in (*state, *outcome)} == {"meta"}


def transitions(config):
    """Rows [2, 4, 8] of what both losses need."""
    shape = (2, 4, 8)
    one = torch.rand(*shape, 1, device="meta")
    following = TensorDict(
        {
            "observation": torch.rand(*shape, 30, device="meta"),
            "reward": one,
            "done": one > 0.5,
            "terminated": one > 0.5,
        },
        shape,
        device="meta",
    )
    named = {"action_log_prob": one[..., 0], "advantage": one, "value_target": one, "next": following}
    observation = torch.rand(*shape, 30, device="meta")
    action = torch.zeros(shape, dtype=torch.int64, device="meta")
    return TensorDict({"observation": observation, "action": action, **named}, shape, device="meta")


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_updates_and_diagnostics_stay_on_their_device(meta, algorithm):
    config, (_, poses) = ALGORITHMS[algorithm], meta
    if algorithm == "ppo":
        policy, value = ppo.make_networks(config)
        loss = ppo.make_loss(policy, value, config).to("meta")
        learner = ppo.make_learner(loss, config, compile=False)
    else:
        policy = dqn.make_network(config).to("meta")
        loss = dqn.make_loss(policy, config)
        learner = dqn.make_learner(loss, config, compile=False)
    losses = learner.learn(transitions(config))
    assert all(value.device.type == "meta" for value in losses.values())
    assert all(value.device.type == "meta" for value in probes.units(policy, poses).values())


def collected(env, actor, n_steps):
    """A rollout [A, W, T] by the calls that a collector makes; TorchRL's own asks `meta` for numbers."""
    now, steps = env.root(), []
    for _ in range(n_steps):
        step, now = env.step_and_maybe_reset(actor(now))
        steps.append(step)
    return torch.stack(steps, 2)


def test_ppo_collects_estimates_learns_and_diagnoses_on_one_device(monkeypatch):
    """What `ppo.train` does in an iteration but for the recorder, which reads numbers and takes them to the CPU."""
    monkeypatch.setattr(DroneEnv, "_make_specs", lambda env: None)  # TorchRL's ask for numbers that `meta` has not
    config = ppo.PPOConfig(n_seeds=2, frames_per_batch=128, minibatch_size=64, epochs=1)
    env = DroneEnv([2, config.n_worlds], device="meta", seeds=config.seeds)
    policy, value = ppo.make_networks(config)
    loss = ppo.make_loss(policy, value, config).to("meta")
    batch = collected(env, ppo.SampledPolicy(policy, config, compile=False), 8)
    assert batch.shape == (2, config.n_worlds, 8)
    ppo.estimate(batch, loss, ppo.make_advantage(config))
    losses = ppo.make_learner(loss, config, compile=False).step(ppo.rows(batch).transpose(0, 1))
    moved = ppo.diagnostics(batch, loss, config.clip_epsilon)
    found = [*batch.values(include_nested=True, leaves_only=True), *losses.values(), *moved.values()]
    assert {value.device.type for value in found} == {"meta"}
    assert all(value.shape == (2,) for value in moved.values())
