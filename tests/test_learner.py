"""The learner by itself: Adam, clipping, and many updates in one compiled call."""

import copy

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torch.nn.utils import clip_grad_norm_

from uavnav.algorithms import dqn, ppo
from uavnav.algorithms.dqn import DQNConfig
from uavnav.algorithms.ppo import PPOConfig
from uavnav.training.learner import Learner


class Losses(nn.Module):
    """What a loss module looks like to the learner, on one weight [A, 3]: two losses a row."""

    def __init__(self, agents):
        super().__init__()
        self.weight = nn.Parameter(torch.arange(1.0, 3 * agents + 1).reshape(agents, 3))
        self.register_buffer("scale", torch.tensor(2.0))

    def forward(self, batch):
        error = (batch["x"] * self.weight[:, None]).sum(-1) - batch["y"]
        return {"squared": self.scale * error.square(), "absolute": error.abs()}


def rows(*shape):
    generator = torch.Generator().manual_seed(0)
    return TensorDict(
        {"x": torch.rand(*shape, 3, generator=generator), "y": torch.rand(*shape, generator=generator)}, shape
    )


def learner(loss, max_grad_norm=1.0, compile=False):
    return Learner(loss, ["squared", "absolute"], lr=0.1, eps=1e-5, max_grad_norm=max_grad_norm, compile=compile)


@pytest.mark.parametrize("max_grad_norm", [0.5, 100.0])
def test_twenty_updates_are_torchs_adam_and_clipping_agent_by_agent(max_grad_norm):
    loss, batches = Losses(2), rows(2, 20, 8)
    mine = learner(copy.deepcopy(loss), max_grad_norm)
    found = mine.learn(batches)
    for agent in range(2):
        theirs = Losses(1)
        theirs.weight.data.copy_(loss.weight.data[agent : agent + 1])
        optimizer = torch.optim.Adam(theirs.parameters(), lr=0.1, eps=1e-5)
        norms = []
        for batch in batches[agent : agent + 1].unbind(1):
            optimizer.zero_grad()
            sum(part.mean() for part in theirs(batch).values()).backward()
            norms.append(clip_grad_norm_(theirs.parameters(), max_grad_norm))
            optimizer.step()
        torch.testing.assert_close(mine.objective.loss.weight[agent], theirs.weight[0], rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(found["grad_norm"][agent], torch.stack(norms).mean(), rtol=1e-4, atol=1e-5)


def test_losses_are_each_agents_means_over_its_rows_and_over_the_minibatches():
    loss, batches = Losses(2), rows(2, 3, 8)
    mine = learner(loss)
    mine.lr = 0.0
    expected = {
        name: value.mean((1, 2))
        for name, value in loss(batches.flatten(1, 2)).items()
        for value in [value.reshape(2, 3, 8)]
    }
    found = mine.learn(batches)
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value)


def test_a_saved_learner_goes_on_as_the_one_that_was_saved():
    one, other = learner(Losses(2)), learner(Losses(2))
    one.learn(rows(2, 5, 8))
    other.load_state_dict(one.state_dict())
    for each in (one, other):
        each.learn(rows(2, 3, 8))
    assert torch.equal(one.objective.loss.weight, other.objective.loss.weight)
    assert one.steps == other.steps == 8


def ppo_batches(agents, n):
    generator = torch.Generator().manual_seed(1)
    shape = (agents, n, 16)
    return TensorDict(
        {
            "observation": torch.rand(*shape, 30, generator=generator),
            "action": torch.randint(0, 100, shape, generator=generator),
            "action_log_prob": -4.6 + 0.1 * torch.randn(shape, generator=generator),
            "advantage": torch.randn(*shape, 1, generator=generator),
            "value_target": torch.randn(*shape, 1, generator=generator),
        },
        shape,
    )


def dqn_batches(agents, n):
    generator = torch.Generator().manual_seed(1)
    shape = (agents, n, 16)
    ended = torch.rand(*shape, 1, generator=generator) < 0.2
    following = {
        "observation": torch.rand(*shape, 30, generator=generator),
        "reward": torch.randn(*shape, 1, generator=generator),
        "done": ended,
        "terminated": ended,
    }
    return TensorDict(
        {
            "observation": torch.rand(*shape, 30, generator=generator),
            "action": torch.randint(0, 100, shape, generator=generator),
            "next": following,
        },
        shape,
    )


def ppo_learner(compile):
    config = PPOConfig(n_seeds=2, lr=1e-2)
    return ppo.make_learner(ppo.make_loss(*ppo.make_networks(config), config), config, compile)


def dqn_learner(compile):
    config = DQNConfig(n_seeds=2, lr=1e-2)
    loss = dqn.make_loss(dqn.make_network(config), config)
    dqn.HardUpdate(loss, value_network_update_interval=5)  # without one the loss warns
    return dqn.make_learner(loss, config, compile)


@pytest.mark.slow
@pytest.mark.compiled
@pytest.mark.parametrize(("make", "batches"), [(ppo_learner, ppo_batches), (dqn_learner, dqn_batches)])
def test_five_compiled_updates_in_one_call_are_five_eager_ones_twice_over(make, batches):
    """The second call begins with other weights, targets and moments than the graph was traced with."""
    eager, compiled = make(compile=False), make(compile=True)
    for _ in range(2):
        losses = [each.learn(batches(2, 5)) for each in (eager, compiled)]
        for name, value in losses[0].items():
            torch.testing.assert_close(losses[1][name], value, rtol=1e-4, atol=1e-5)
        for name, value in eager.parameters.items():
            torch.testing.assert_close(compiled.parameters[name], value, rtol=1e-4, atol=1e-5)
        assert compiled.steps == eager.steps
        for each in (eager, compiled):  # as a renewed target network
            for buffer in each.buffers.values():
                if buffer.ndim > 1:
                    buffer.mul_(0.5)
