"""PQN: one rollout of its authors' equations as a slow loop; test_algorithms has what all algorithms keep."""

import pytest
import torch
from batches import rollout
from torch.nn.functional import layer_norm
from torch.nn.utils import clip_grad_norm_

from uavnav.algorithms.pqn import PQNConfig
from uavnav.errors import ConfigError
from uavnav.tasks.seeding import stream

SETTINGS = {"n_envs": 4, "frames_per_batch": 48, "minibatch_size": 12, "epochs": 3, "hidden": (16, 8)}
SETTINGS |= {"lr": 1e-3, "gamma": 0.9, "q_lambda": 0.65, "max_grad_norm": 0.05, "activation": "relu"}


def flown(seed):
    """A rollout [1, 4, 12] of made-up rows, a sixth of which collide and a sixth reach a time limit."""
    random, batch = torch.Generator().manual_seed(seed), rollout(1, 4, 12, seed=seed)
    over = torch.randint(6, (1, 4, 12, 1), generator=random)
    batch["next"] = rollout(1, 4, 12, seed=seed + 1).select("observation")
    batch["next", "reward"] = torch.randn(1, 4, 12, 1, generator=random)
    batch["next", "terminated"], batch["next", "truncated"] = over == 0, over == 1
    batch["next", "done"] = over <= 1
    going = torch.where(over <= 1, batch["next", "observation"], batch["observation"].roll(-1, 2))
    batch["next", "observation"][:, :, :-1] = going[
        :, :, :-1
    ]  # what follows a step is what the next one sees
    return batch.exclude("advantage", "value_target", "action_log_prob")


def q_values(weights, observation):
    """[N, 30] -> [N, 100]: LayerNorm before each ReLU."""
    *hidden, (last, bias) = zip(weights[::2], weights[1::2], strict=True)
    for weight, shift in hidden:
        observation = layer_norm(observation @ weight + shift, weight.shape[1:]).relu()
    return observation @ last + bias


def targets(weights, batch):
    """Q(lambda) backwards in time, environment by environment, as eq. (6) has it."""
    found = torch.zeros(4, 12)
    for world in range(4):
        for step in reversed(range(12)):
            one = batch[0, world, step]["next"]
            best = q_values(weights, one["observation"][None]).max().item()
            ahead = best
            if step < 11 and not one["done"]:
                ahead = 0.65 * found[world, step + 1].item() + 0.35 * best
            found[world, step] = one["reward"].item() + 0.9 * ahead * (not one["terminated"])
    return found


def test_one_rollout_of_updates_equals_a_loop_over_environments_steps_and_minibatches():
    pqn, batch = PQNConfig(**SETTINGS).make(compile=False), flown(seed=0)
    weights = [one.detach()[0].clone().requires_grad_() for one in pqn.network.parameters()]
    first = [one.detach().clone() for one in weights]
    with torch.no_grad():
        expected = targets(weights, batch)
    adam, order = torch.optim.Adam(weights, lr=1e-3, eps=1e-8), stream(0, "minibatches")
    rows, norms = batch[0].flatten(), []
    for _ in range(3):
        for some in torch.randperm(48, generator=order).split(12):
            chosen = q_values(weights, rows["observation"][some])[range(12), rows["action"][some]]
            adam.zero_grad()
            ((chosen - expected.flatten()[some]) ** 2 / 2).mean().backward()
            norms.append(clip_grad_norm_(weights, 0.05).item())
            adam.step()
    row = pqn.learn(batch.clone(), 48)
    assert row["grad_norm"].item() == pytest.approx(sum(norms) / 12, rel=1e-4)
    assert min(norms) > 0.05
    for own, mine, before in zip(pqn.network.parameters(), weights, first, strict=True):
        torch.testing.assert_close(own[0], mine, rtol=1e-5, atol=1e-5)
        assert (mine - before).abs().max() > 1e-3


def test_epsilon_falls_from_1_to_0_05_over_a_tenth_of_the_frames():
    config = PQNConfig(total_frames=1_000_000)
    assert [config.epsilon(frames) for frames in (0, 50_000, 100_000, 10**6)] == pytest.approx(
        [1, 0.525, 0.05, 0.05]
    )
    assert config.final_epsilon == 0.05


def test_a_minibatch_that_divides_no_rollout_is_refused():
    with pytest.raises(ConfigError, match="minibatch_size=100; give a divisor of frames_per_batch=2048"):
        PQNConfig(minibatch_size=100)
