"""Algorithms learn: their policies beat the random and the straight-ahead one on sets never trained on."""

import numpy as np
import pytest
from policies_by_hand import untrained

import uavnav
from uavnav.algorithms import ALGORITHMS
from uavnav.evaluation import fly, on
from uavnav.tasks.baselines import straight_ahead, uniform_random
from uavnav.tasks.table import make_task
from uavnav.training.loop import train

EPISODES = 100
MAX_STEPS = 500

OF_DQN = {
    "activation": "relu",
    "n_envs": 32,
    "total_frames": 60_000,
    "learning_starts": 2_000,
    "frames_per_update": 16,
    "batch_size": 128,
    "target_update_frames": 1_000,
    "exploration_fraction": 0.2,
    "lr": 1e-3,
}
SETTINGS = {
    "ppo": {"n_envs": 64, "total_frames": 40_960, "minibatch_size": 256, "epochs": 4, "lr": 1e-3},
    "a2c": {"n_envs": 64, "total_frames": 80_000, "lr": 2e-3},
    "dqn": OF_DQN,
    "sac": {
        "activation": "relu",
        "n_envs": 64,
        "total_frames": 40_000,
        "learning_starts": 2_000,
        "frames_per_update": 16,
        "batch_size": 128,
        "lr": 1e-3,
        "gamma": 0.95,
        "tau": 0.02,
        "target_entropy": 0.4,
    },
    "c51": OF_DQN
    | {
        "total_frames": 16_000,
        "learning_starts": 1_000,
        "frames_per_update": 32,
        "target_update_frames": 500,
        "lr": 2e-3,
        "gamma": 0.98,
        "n_steps": 5,
        "double": True,
        "n_atoms": 21,
    },
}
SETTINGS["pqn"] = {"n_envs": 64, "total_frames": 60_000, "minibatch_size": 128, "epochs": 4, "lr": 1e-3}
SLOW = [
    pytest.param(name, marks=pytest.mark.slow) if name in ("dqn", "sac", "c51") else name for name in SETTINGS
]


def intervals(*policies):
    """95 % intervals of the mean reward over 100 test layouts of 8 obstacles."""
    task = on(make_task(), "test", EPISODES, MAX_STEPS)
    rewards = fly(dict(enumerate(policies)), task).episodes.groupby("seed").reward
    half = 1.96 * rewards.std() / np.sqrt(EPISODES)
    return rewards.mean() - half, rewards.mean() + half


@pytest.fixture(scope="module")
def best_baseline():
    """The upper end of the better of the two baselines' intervals."""
    return intervals(uniform_random, straight_ahead)[1].max()


@pytest.mark.parametrize("algorithm", SLOW)
def test_two_seeds_beat_random_and_straight_ahead(algorithm, tmp_path, best_baseline):
    """SAC flies as it acts in training."""
    config = ALGORITHMS[algorithm].config(**SETTINGS[algorithm], n_seeds=2, compile="off")
    run = train(config, out=tmp_path / "run", quiet=True)
    policies = [uavnav.load_policy(run.path, seed=seed, greedy=algorithm != "sac") for seed in (0, 1)]
    assert (intervals(*policies)[0] > best_baseline).all()


@pytest.mark.parametrize("greedy", [True, False])
def test_policies_of_random_weights_do_not(greedy, best_baseline):
    assert (intervals(untrained(0, greedy), untrained(1, greedy))[0] <= best_baseline).all()
