"""A2C: returns by hand, and Stable-Baselines3's own update; see test_algorithms for what all algorithms
keep.
"""

import peers
import pytest
import stable_baselines3
import torch

import uavnav
from uavnav.algorithms.a2c import A2CConfig, train

CLOSE = {"rtol": 1e-5, "atol": 1e-5}


def test_the_targets_of_5_steps_are_the_returns_by_hand_and_a_limit_bootstraps_its_own_last_observation():
    """Straight ahead at 9 px: 0.09 a step, the time limit after the third; lambda = 1, so that V enters
    at the ends alone.
    """
    a2c = A2CConfig(n_envs=1, lr=0.0, max_steps=3).make(compile=False)
    env = uavnav.DroneEnv([1, 1], max_steps=3)
    batch = env.rollout(5, lambda td: td.set("action", torch.full((1, 1), 9)), break_when_any_done=False)
    assert batch["next", "truncated"].flatten().tolist() == [False, False, True, False, False]
    a2c.learn(batch, 5)
    with torch.no_grad():
        at_limit, at_end = a2c.value(batch["next", "observation"]).flatten()[[2, 4]].tolist()
        values = a2c.value(batch["observation"]).flatten()
    expected = [
        0.09 * (1 + 0.99 + 0.99**2) + 0.99**3 * at_limit,
        0.09 * 1.99 + 0.99**2 * at_limit,
        0.09 + 0.99 * at_limit,
    ]
    expected += [0.09 * 1.99 + 0.99**2 * at_end, 0.09 + 0.99 * at_end]
    assert batch["value_target"].flatten().tolist() == pytest.approx(expected, abs=1e-5)
    torch.testing.assert_close(batch["advantage"].flatten(), torch.tensor(expected) - values, **CLOSE)
    assert abs(0.99 * at_limit) > 1e-3  # what a collision would have left out


# -- an update, against Stable-Baselines3's ------------------------------------------------------------------


def test_one_update_of_a_rollout_from_sb3s_own_weights_equals_sb3s_train():
    """Two worlds of 40 steps, time limits and a collision among them: weights within 1e-5, with the norm
    clipped to 0.1.
    """
    shared = {"ent_coef": 0.02, "vf_coef": 0.7, "max_grad_norm": 0.1, "gamma": 0.9}
    shared |= {"learning_rate": 2e-2, "rms_prop_eps": 1e-4}
    theirs = peers.on_policy(stable_baselines3.A2C, "relu", steps=40, max_steps=12, **shared)
    config = A2CConfig(
        activation="relu",
        n_envs=2,
        n_steps=40,
        entropy_coeff=0.02,
        critic_coeff=0.7,
        max_grad_norm=0.1,
        lr=2e-2,
        rms_eps=1e-4,
        gamma=0.9,
        total_frames=80,
    )
    ours = config.make(compile=False)
    pairs = peers.actor_critic(ours.policy, ours.value, theirs)
    with torch.no_grad():
        for own, sb3 in pairs:
            own.copy_(sb3)
    before = [own.clone() for own, _ in pairs]
    batch, buffer = peers.rollout(theirs, 80), theirs.rollout_buffer
    done, terminated = batch["next", "done"], batch["next", "terminated"]
    assert (done & ~terminated).sum() >= 4
    assert terminated.sum() >= 1
    row = ours.learn(batch, 80)
    torch.testing.assert_close(batch["advantage"][0, ..., 0].T, torch.as_tensor(buffer.advantages), **CLOSE)
    torch.testing.assert_close(batch["value_target"][0, ..., 0].T, torch.as_tensor(buffer.returns), **CLOSE)
    theirs._current_progress_remaining = 1.0
    theirs.train()
    assert row["grad_norm"].item() > 5 * 0.1
    said = theirs.logger.name_to_value
    assert row["loss_objective"].item() == pytest.approx(said["train/policy_loss"], abs=1e-5)
    assert row["loss_critic"].item() == pytest.approx(0.7 * said["train/value_loss"], abs=1e-5)
    assert row["loss_entropy"].item() == pytest.approx(0.02 * said["train/entropy_loss"], abs=1e-5)
    for (own, sb3), first in zip(pairs, before, strict=True):
        torch.testing.assert_close(own, sb3.detach(), **CLOSE)
        assert (own - first).abs().max() > 1e-3


# -- its settings and its runs -------------------------------------------------------------------------------


def test_a_row_of_progress_comes_with_the_first_rollout_past_each_2_000_frames_and_with_the_last(tmp_path):
    config = A2CConfig(n_envs=16, total_frames=4_800, n_seeds=2, hidden=(8,), compile="off")
    progress = train(config, out=tmp_path / "run", quiet=True).progress
    assert progress.frame.tolist() == [2_000, 2_000, 4_000, 4_000, 4_800, 4_800]
    assert progress.seed.tolist() == [0, 1] * 3
    assert progress[["loss_objective", "loss_critic", "grad_norm", "entropy"]].notna().all(axis=None)
