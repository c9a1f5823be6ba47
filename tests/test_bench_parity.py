"""Parity with Stable-Baselines3: the tables in the docs are what the committed rows give."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from scipy import stats

from uavnav import DroneEnv

ROOT = Path(__file__).parent.parent
FLOOR = -0.23
"""Reward per frame of random actions on the train split; areas are above it."""
MANY = {"ppo": 16, "dqn": 64}
LABELS = {"uavnav": "uavnav", "sb3": "SB3"}


@pytest.fixture(scope="module")
def areas():
    """Of each algorithm, activation, library and number of environments: the areas of its seeds."""
    rows = pd.read_csv(ROOT / "results" / "bench" / "parity.csv")
    keys = ["algorithm", "activation", "library", "n_envs"]
    return {key: group.reward_per_frame.to_numpy() - FLOOR for key, group in rows.groupby(keys)}


def compared(mine, theirs):
    """The ratio of geometric means with Welch's 90 % interval, and whether it lies within 0.8 to 1.25."""
    a, b = np.log(mine), np.log(theirs)
    low, high = np.exp(stats.ttest_ind(a, b, equal_var=False).confidence_interval(0.9))
    verdict = "equal" if low >= 0.8 and high <= 1.25 else "different" if low > 1 or high < 1 else "open"
    return f"{np.exp(a.mean() - b.mean()):.2f} ({low:.2f} ... {high:.2f}) | {verdict} |"


def label(library, n_envs):
    return f"{LABELS[library]}, {n_envs} environment{'s' if n_envs > 1 else ''}"


def expected(areas):
    """The rows of both tables."""
    for algorithm in MANY:
        for activation in ("tanh", "relu"):
            name = f"| {algorithm.upper()} {activation} |"
            for n_envs in (MANY[algorithm], 1):
                mine, theirs = (areas[algorithm, activation, library, n_envs] for library in LABELS)
                spread = [f"{one.mean():.3f} ± {one.std(ddof=1):.3f} ({len(one)})" for one in (mine, theirs)]
                yield f"{name} {n_envs} | {spread[0]} | {spread[1]} | {compared(mine, theirs)}"
            pairs = ("uavnav", "sb3"), ("uavnav", "uavnav"), ("sb3", "sb3")
            for first, second in pairs:
                arms = (first, MANY[algorithm]), (second, 1)
                one, other = (areas[algorithm, activation, *arm] for arm in arms)
                yield f"{name} {label(*arms[0])} | {label(*arms[1])} | {compared(one, other)}"
    for activation in ("tanh", "relu"):
        dqn, ppo = (areas[algorithm, activation, "uavnav", MANY[algorithm]] for algorithm in ("dqn", "ppo"))
        arms = [f"{algorithm.upper()}, {label('uavnav', MANY[algorithm])}" for algorithm in ("dqn", "ppo")]
        yield f"| {activation} | {arms[0]} | {arms[1]} | {compared(dqn, ppo)}"


def test_the_22_rows_of_the_parity_tables_in_the_docs_are_what_128_seeds_give(areas):
    pages = [(ROOT / "docs" / name).read_text() for name in ("benchmarks.md", "archive/speed.md")]
    committed = "".join(page.partition("## Parity")[2] for page in pages).splitlines()
    rows = [line for line in committed if re.match(r"\| (PPO|DQN|tanh|relu)", line)]
    assert sorted(rows) == sorted(expected(areas))
    assert sum(map(len, areas.values())) == 128
    assert min(len(areas[key]) for key in areas if key[2] == "uavnav") >= 8


def test_a_frame_of_random_actions_earns_minus_0_23():
    env = DroneEnv([128], seeds=0)
    torch.manual_seed(0)  # for the actions
    reward = env.rollout(300, break_when_any_done=False)["next", "reward"]
    assert float(reward[:, 100:].mean()) == pytest.approx(FLOOR, abs=0.01)
