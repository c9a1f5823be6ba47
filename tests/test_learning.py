"""Algorithms learn: their policies beat the random and the straight-ahead one on sets never trained on."""

import numpy as np
import pytest

import uavnav
from uavnav.algorithms import a2c, c51, dqn, ppo, sac
from uavnav.evaluation import evaluate_policy
from uavnav.tasks.baselines import straight_ahead, uniform_random

EPISODES = 100
MAX_STEPS = 500

PPO_SETTINGS = {
    "n_seeds": 2,
    "n_envs": 64,
    "total_frames": 80_000,
    "minibatch_size": 256,
    "epochs": 4,
    "lr": 1e-3,
    "compile": "off",
}
A2C_SETTINGS = {"n_seeds": 2, "n_envs": 64, "total_frames": 80_000, "lr": 2e-3, "compile": "off"}
DQN_SETTINGS = {
    "activation": "relu",
    "n_seeds": 2,
    "n_envs": 32,
    "total_frames": 60_000,
    "learning_starts": 2_000,
    "frames_per_update": 16,
    "batch_size": 128,
    "target_update_frames": 1_000,
    "exploration_fraction": 0.2,
    "lr": 1e-3,
    "compile": "off",
}
SAC_SETTINGS = {
    "activation": "relu",
    "n_seeds": 2,
    "n_envs": 64,
    "total_frames": 40_000,
    "learning_starts": 2_000,
    "frames_per_update": 16,
    "batch_size": 128,
    "lr": 1e-3,
    "gamma": 0.95,
    "tau": 0.02,
    "target_entropy": 0.4,
    "compile": "off",
}
C51_SETTINGS = DQN_SETTINGS | {
    "total_frames": 16_000,
    "learning_starts": 1_000,
    "frames_per_update": 32,
    "target_update_frames": 500,
    "lr": 2e-3,
    "gamma": 0.98,
    "n_steps": 5,
    "double": True,
    "n_atoms": 21,
}


def interval(policy):
    """95 % interval of the mean reward over 100 test sets of 8 obstacles."""
    rewards = evaluate_policy(policy, layouts="test", episodes=EPISODES, max_steps=MAX_STEPS).reward
    half = 1.96 * rewards.std() / np.sqrt(EPISODES)
    return rewards.mean() - half, rewards.mean() + half


@pytest.fixture(scope="module")
def best_baseline():
    """The upper end of the better of the two baselines' intervals."""
    return max(interval(policy)[1] for policy in (uniform_random, straight_ahead))


def beats(run, best_baseline, greedy=True):
    return [interval(uavnav.load_policy(run.path, seed=seed, greedy=greedy))[0] > best_baseline for seed in (0, 1)]


def test_two_seeds_of_ppo_beat_random_and_straight_ahead(tmp_path, best_baseline):
    run = ppo.train(ppo.PPOConfig(**PPO_SETTINGS), out=tmp_path / "run", quiet=True)
    assert beats(run, best_baseline) == [True, True]


def test_two_seeds_of_a2c_beat_random_and_straight_ahead(tmp_path, best_baseline):
    run = a2c.train(a2c.A2CConfig(**A2C_SETTINGS), out=tmp_path / "run", quiet=True)
    assert beats(run, best_baseline) == [True, True]


@pytest.mark.slow
def test_two_seeds_of_dqn_beat_random_and_straight_ahead(tmp_path, best_baseline):
    run = dqn.train(dqn.DQNConfig(**DQN_SETTINGS), out=tmp_path / "run", quiet=True)
    assert beats(run, best_baseline) == [True, True]


@pytest.mark.slow
def test_two_seeds_of_sac_as_they_act_in_training_beat_random_and_straight_ahead(tmp_path, best_baseline):
    run = sac.train(sac.SACConfig(**SAC_SETTINGS), out=tmp_path / "run", quiet=True)
    assert beats(run, best_baseline, greedy=False) == [True, True]


@pytest.mark.slow
def test_two_seeds_of_c51_beat_random_and_straight_ahead(tmp_path, best_baseline):
    run = c51.train(c51.C51Config(**C51_SETTINGS), out=tmp_path / "run", quiet=True)
    assert beats(run, best_baseline) == [True, True]


# Without a learning rate a policy stays what it was at the start, so that these controls need few frames.


def test_without_a_learning_rate_ppo_fails(tmp_path, best_baseline):
    config = ppo.PPOConfig(**PPO_SETTINGS | {"lr": 0.0, "total_frames": 8_192})
    assert beats(ppo.train(config, out=tmp_path / "run", quiet=True), best_baseline) == [False, False]


def test_without_a_learning_rate_a2c_fails(tmp_path, best_baseline):
    config = a2c.A2CConfig(**A2C_SETTINGS | {"lr": 0.0, "total_frames": 8_320})
    assert beats(a2c.train(config, out=tmp_path / "run", quiet=True), best_baseline) == [False, False]


def test_without_a_learning_rate_dqn_fails(tmp_path, best_baseline):
    config = dqn.DQNConfig(**DQN_SETTINGS | {"lr": 0.0, "total_frames": 8_192})
    assert beats(dqn.train(config, out=tmp_path / "run", quiet=True), best_baseline) == [False, False]


def test_without_a_learning_rate_sac_fails(tmp_path, best_baseline):
    config = sac.SACConfig(**SAC_SETTINGS | {"lr": 0.0, "total_frames": 4_096})
    assert beats(sac.train(config, out=tmp_path / "run", quiet=True), best_baseline, greedy=False) == [False, False]


def test_without_a_learning_rate_c51_fails(tmp_path, best_baseline):
    config = c51.C51Config(**C51_SETTINGS | {"lr": 0.0, "total_frames": 2_048})
    assert beats(c51.train(config, out=tmp_path / "run", quiet=True), best_baseline) == [False, False]
