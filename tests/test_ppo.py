"""PPO: closed forms, TorchRL's own loss, and Stable-Baselines3's own update."""

import numpy as np
import peers
import pytest
import stable_baselines3
import torch
from batches import rollout
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch.distributions import Categorical
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import ClipPPOLoss, PPOLoss
from torchrl.objectives.value import GAE

from uavnav.algorithms import ppo as algorithm
from uavnav.algorithms.ppo import PPOConfig, estimate_advantages, make_networks, train
from uavnav.tasks.seeding import Streams
from uavnav.training.recorder import Interrupted

CLOSE = {"rtol": 1e-5, "atol": 1e-5}


def gae(rewards, values, terminated, truncated, gamma=0.9, lmbda=0.8):
    """Advantages of one world as PPO's; values has one more entry than rewards."""
    steps = len(rewards)
    done = torch.tensor(terminated) | torch.tensor(truncated)
    batch = TensorDict(
        {
            "observation": torch.tensor(values[:steps])[None, None, :, None],
            "next": {
                "observation": torch.tensor(values[1:])[None, None, :, None],
                "reward": torch.tensor(rewards)[None, None, :, None],
                "done": done[None, None, :, None],
                "terminated": torch.tensor(terminated)[None, None, :, None],
            },
        },
        [1, 1, steps],
    )
    estimate_advantages(batch, lambda observation: observation, gamma, lmbda)  # of its own value
    torch.testing.assert_close(batch["value_target"], batch["advantage"] + batch["state_value"])
    return batch["advantage"].flatten().tolist()


NO = [False, False, False]


def test_gae_of_three_steps_is_the_sum_by_hand():
    d0, d1, d2 = 1 + 0.9 * 5 - 4, 2 + 0.9 * 6 - 5, 3 + 0.9 * 7 - 6
    expected = [d0 + 0.72 * (d1 + 0.72 * d2), d1 + 0.72 * d2, d2]
    assert gae([1.0, 2.0, 3.0], [4.0, 5.0, 6.0, 7.0], NO, NO) == pytest.approx(expected, abs=1e-6)


def test_a_collision_cuts_both_the_value_and_the_sum():
    expected_1 = 2 - 5.0
    got = gae([1.0, 2.0, 3.0], [4.0, 5.0, 6.0, 7.0], [False, True, False], NO)
    assert got == pytest.approx([1 + 0.9 * 5 - 4 + 0.72 * expected_1, expected_1, 3 + 0.9 * 7 - 6], abs=1e-6)


def test_a_truncation_bootstraps_the_value_and_cuts_the_sum():
    expected_1 = 2 + 0.9 * 6 - 5.0
    got = gae([1.0, 2.0, 3.0], [4.0, 5.0, 6.0, 7.0], NO, [False, True, False])
    assert got == pytest.approx([1 + 0.9 * 5 - 4 + 0.72 * expected_1, expected_1, 3 + 0.9 * 7 - 6], abs=1e-6)
    taken_for_a_collision = gae([1.0, 2.0, 3.0], [4.0, 5.0, 6.0, 7.0], [False, True, False], NO)
    assert abs(got[1] - taken_for_a_collision[1]) > 5  # the negative control: 0.9 x V(s') = 5.4


@pytest.mark.parametrize("shape", [(1, 1, 64), (3, 2, 16)])
def test_advantages_and_targets_are_torchrls_own_bit_for_bit(shape):
    generator = torch.Generator().manual_seed(0)
    reward, value, after = torch.randn(3, *shape, 1, generator=generator)
    terminated, truncated = torch.rand(2, *shape, 1, generator=generator) < 0.1
    following = {"reward": reward, "observation": after / 2, "terminated": terminated}
    following["done"] = terminated | truncated
    ours = TensorDict({"observation": value / 2, "next": following}, shape)
    torchrls = ours.clone()
    torchrls["state_value"], torchrls["next", "state_value"] = value, after
    estimate_advantages(ours, lambda observation: 2 * observation, 0.99, 0.95)
    GAE(gamma=0.99, lmbda=0.95, value_network=None, vectorized=False)(torchrls)
    assert 0 < following["done"].sum() < ours.numel()
    for name in ("advantage", "value_target"):
        assert torch.equal(ours[name], torchrls[name])


# -- an iteration, against Stable-Baselines3's ---------------------------------------------------------------


def test_12_minibatches_of_a_rollout_in_the_same_order_equal_sb3s_train(monkeypatch):
    """Two worlds of 64 steps, three epochs of four minibatches: weights within 1e-5, with ratios and
    norms clipped.
    """
    shared = {"ent_coef": 0.02, "max_grad_norm": 1.5, "learning_rate": 3e-3, "n_epochs": 3, "batch_size": 32}
    theirs = peers.on_policy(stable_baselines3.PPO, "tanh", steps=64, max_steps=24, **shared)
    config = PPOConfig(
        activation="tanh",
        n_envs=2,
        frames_per_batch=128,
        minibatch_size=32,
        epochs=3,
        entropy_coeff=0.02,
        max_grad_norm=1.5,
        lr=3e-3,
    )
    ours = config.make(compile=False)
    pairs = peers.actor_critic(ours.policy, ours.value, theirs)
    before = [own.clone() for own, _ in pairs]
    for own, sb3 in pairs:
        sb3.data.copy_(own)
    batch, buffer = peers.rollout(theirs, 128), theirs.rollout_buffer
    done, terminated = batch["next", "done"], batch["next", "terminated"]
    assert (done & ~terminated).sum() >= 2
    assert terminated.sum() >= 1
    norms, step = [], ours.learner.step

    def watch(minibatch):
        losses = step(minibatch)
        norms.append(losses["grad_norm"].item())
        return losses

    ours.learner.step = watch
    ours.learn(batch, 128)
    torch.testing.assert_close(batch["action_log_prob"][0].T, torch.as_tensor(buffer.log_probs), **CLOSE)
    torch.testing.assert_close(batch["advantage"][0, ..., 0].T, torch.as_tensor(buffer.advantages), **CLOSE)
    torch.testing.assert_close(batch["value_target"][0, ..., 0].T, torch.as_tensor(buffer.returns), **CLOSE)
    order = Streams([0], "minibatches")
    with monkeypatch.context() as patch:
        patch.setattr(
            np.random, "permutation", lambda n: order.draw(torch.randperm, n, device="cpu")[0].numpy()
        )
        theirs._current_progress_remaining = 1.0
        theirs.train()
    assert len(norms) == 12
    assert min(norms) < config.max_grad_norm < max(norms)
    assert theirs.logger.name_to_value["train/clip_fraction"] > 0.05
    for (own, sb3), first in zip(pairs, before, strict=True):
        torch.testing.assert_close(own, sb3.detach(), **CLOSE)
        assert (own - first).abs().max() > 1e-3


def test_train_takes_one_thread_and_gives_its_callers_3_back(tmp_path):
    config = PPOConfig(total_frames=128, frames_per_batch=64, n_envs=2, epochs=1, compile="off")
    try:
        torch.set_num_threads(3)
        with pytest.raises(Interrupted):
            train(config, out=tmp_path / "run", quiet=True, until=64)
        assert torch.get_num_threads() == 3
        assert train(config, out=tmp_path / "run", quiet=True).meta["threads"] == 1
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(1)


@pytest.mark.parametrize("clip", [0.2, 1.0, None])
def test_the_losses_of_one_agent_and_their_gradients_are_those_of_torchrls_own(clip):
    """TorchRL's ClipPPOLoss, or where nothing is clipped its PPOLoss, on ratios far from 1."""
    config = PPOConfig(clip_epsilon=clip, entropy_coeff=0.01, critic_coeff=0.7, hidden=(16,))
    policy, value = make_networks(config)
    logits = TensorDictModule(policy, in_keys=["observation"], out_keys=["logits"])
    actor = ProbabilisticActor(
        logits, in_keys=["logits"], distribution_class=Categorical, return_log_prob=True
    )
    critic = TensorDictModule(value, in_keys=["observation"], out_keys=["state_value"])
    how = {"entropy_coeff": 0.01, "critic_coeff": 0.7, "loss_critic_type": "l2", "normalize_advantage": True}
    how |= {"normalize_advantage_exclude_dims": (0,), "reduction": "none", "functional": False}
    theirs = (
        PPOLoss(actor, critic, **how)
        if clip is None
        else ClipPPOLoss(actor, critic, clip_epsilon=clip, **how)
    )
    batch, parameters = rollout(1, 64), [*policy.parameters(), *value.parameters()]
    found, expected = algorithm.PPOLoss(policy, value, config)(batch), theirs(batch)
    for name, own in found.items():
        torch.testing.assert_close(own.squeeze(-1), expected[name].reshape(1, 64), **CLOSE)
    gradients = (
        torch.autograd.grad(sum(one[name].mean() for name in found), parameters) for one in (found, expected)
    )
    for ours, torchrls in zip(*gradients, strict=True):
        torch.testing.assert_close(ours, torchrls, **CLOSE)
    ratio = (actor.get_dist(batch).log_prob(batch["action"]) - batch["action_log_prob"]).exp()
    assert ((ratio - 1).abs() > 1).sum() >= 4
