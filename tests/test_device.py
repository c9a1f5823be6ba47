"""Another device than the CPU: torch's `meta` device computes nothing, and refuses what would mix devices."""

import pytest
import torch
from tensordict import TensorDict

from uavnav import dqn, layouts, ppo, probes, simulator
from uavnav.world import World

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
