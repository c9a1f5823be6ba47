"""Run folders written by hand, whose metrics are known in closed form."""

import json
from types import SimpleNamespace

import pandas as pd
import torch
import yaml
from safetensors.torch import load_file
from torch import nn

from uavnav.algorithms import ALGORITHMS
from uavnav.evaluation import BEHAVIOUR_COLUMNS
from uavnav.networks import mlp
from uavnav.runs import FILES, POLICY
from uavnav.runs.metrics import EPISODE_COLUMNS
from uavnav.tasks.faults import NO_FAULTS
from uavnav.tasks.world import World
from uavnav.training.config import TrainConfig
from uavnav.training.weights import serialize

CONFIG = {
    "preset": "vectorised",
    "total_frames": 1000,
    "n_envs": 16,
    "reward": "eq14",
    "init": "default",
    "lr": 1e-4,
}
CONFIG |= {"task": "drone", "layouts": "train", "gamma": 0.99, "stack": 1, "faults": NO_FAULTS.model_dump()}
LAYOUTS = {"n": "10000", "k": "8", "split": "train", "generator_seed": "0", "sha256": "abc"}


def rows(seed, *episodes):
    """Episodes (frame, steps, stops, full stops, turns, distance, reward[, terminated, truncated]) of one
    seed.
    """
    padded = [(*episode, True, False)[:9] for episode in episodes]
    full = [(seed, frame, 0, 0, *counts) for frame, *counts in padded]
    return pd.DataFrame(full, columns=list(EPISODE_COLUMNS)).astype(EPISODE_COLUMNS)


def two(seed, reward):
    """100 steps at 4 px/step and 300 at 8: the mean of speeds is 6, the speed of the means 7; stops 10
    and 0 %.
    """
    return rows(seed, (100, 100, 10, 1, 90, 400, reward), (400, 300, 0, 0, 150, 2400, reward))


def write_run(
    path, *tables, algorithm="dqn", activation="tanh", seed=0, evaluation=None, meta=None, **changes
):
    path.mkdir(parents=True)
    config = {"algorithm": algorithm, "activation": activation, "seed": seed, "n_seeds": len(tables)}
    config |= CONFIG | {"world": {}} | changes
    if config["task"] == "drone" and isinstance(config["world"], dict):
        config["world"] = World().model_dump() | config["world"]
    (path / "config.yaml").write_text(yaml.safe_dump(config))
    facts = {
        "status": "finished",
        "frames": 1000,
        "wall_seconds": 3725.4,
        "git_commit": "c0ffee",
        "layouts": LAYOUTS,
        "study": "by hand",
    }
    facts |= {
        "versions": {"torch": "2.13.0", "world": "1"},
        "machine": {"processor": "an abacus", "cores": 2},
    }
    (path / "meta.json").write_text(json.dumps(facts | (meta or {})))
    pd.concat(tables).to_parquet(path / "episodes.parquet")
    pd.DataFrame({"seed": [seed], "frame": [1000]}).to_parquet(path / "progress.parquet")
    if evaluation is not None:
        evaluation.to_parquet(path / "evaluation.parquet")
    return path


def found(text, *start):
    """The cells after the given first cells, of each line of the report's tables that starts with them."""
    lines = [
        [cell.strip() for cell in line.strip("| ").split(" | ")]
        for line in text.splitlines()
        if line[:1] == "|"
    ]
    return [line[len(start) :] for line in lines if line[: len(start)] == list(start)]


def write_results(path):
    """Two seeds of dqn tanh, evaluated on two layouts, and one of ppo relu, not evaluated."""
    flown = rows(0, (10, 10, 1, 1, 5, 50, -9.0), (40, 40, 4, 0, 10, 100, 3.0, False, True))
    episodes = pd.concat([flown.assign(mode="greedy"), flown.assign(mode="sampled", reward=0.5)])
    write_run(path / "dqn" / "tanh", two(0, -6.0), two(1, -8.0), evaluation=episodes)
    write_run(path / "ppo" / "relu", two(0, 5.0), algorithm="ppo", activation="relu")
    return path


def policy_bytes(network, algorithm, epsilon=0.05, **settings):
    """A policy file whose algorithm and epsilon are given, and no configuration of its own."""
    kind = type(
        "Config", (TrainConfig,), {"algorithm": algorithm, "final_epsilon": property(lambda self: epsilon)}
    )
    actor = SimpleNamespace(acts=ALGORITHMS[algorithm].acts, head=ALGORITHMS[algorithm].head)
    return serialize({"policy": nn.ModuleList(network)}, kind(**settings), actor)


def behaved(path):
    """Give a run the steps of two sampled episodes, seed 0 straight up, seed 1 turning on the spot, and more
    beside.

    In the empty arena both fly straight at full speed. They expect 50.
    """
    straight = [(seed, layout, 9) for seed in (0, 1) for layout in range(4) for _ in range(5)]
    for name, steps in (("behaviour", [(0, 0, 9)] * 5 + [(1, 1, 50)] * 5), ("arena", straight)):
        table = pd.DataFrame(steps, columns=list(BEHAVIOUR_COLUMNS)).astype(BEHAVIOUR_COLUMNS)
        table.assign(mode="sampled").to_parquet(path / f"{name}.parquet")
    if "algorithm: dqn" in (path / "config.yaml").read_text():
        values = pd.DataFrame({"seed": [0, 1], "q": 50.0, "realised": 40.0, "overestimation": 10.0})
        values.to_parquet(path / "values.parquet")


def trained(path, algorithm, action):
    """Give a run of two seeds a network that knows one action."""
    network = mlp([30, 4, 100], "tanh", [torch.Generator().manual_seed(seed) for seed in (0, 1)], "default")
    with torch.no_grad():
        network[-1].weight.zero_()
        network[-1].bias[:, 0, action] = 50.0
    (path / POLICY).write_bytes(policy_bytes(network, algorithm, seed=0, n_seeds=2, hidden=(4,)))


def _always(network, agent, action):
    """Make one agent prefer an action by far, and whatever it sees."""
    with torch.no_grad():
        network[-1].weight[agent] = 0.0
        network[-1].bias[agent] = torch.linspace(0, 0.99, network[-1].bias.shape[-1])
        network[-1].bias[agent, 0, action] = 50.0


def write_policies(
    path, algorithm="ppo", seed=0, n_seeds=3, prefer=(), n_inputs=30, n_actions=100, **changes
):
    """A finished run of `n_seeds` random networks; `prefer` names the action of those that know but one."""
    generators = [torch.Generator().manual_seed(one) for one in range(seed, seed + n_seeds)]
    network = mlp([n_inputs, 8, n_actions], "tanh", generators, "default")
    with torch.no_grad():
        network[-1].weight.mul_(8.0)  # so that values differ, from action to action and from step to step
    for agent, action in prefer:
        _always(network, agent, action)
    path.mkdir(parents=True)
    settings = {"seed": seed, "n_seeds": n_seeds, "hidden": (8,)} | changes
    (path / POLICY).write_bytes(policy_bytes(network, algorithm, epsilon=0.2, **settings))
    facts = CONFIG | {"world": {}, "algorithm": algorithm, "activation": "tanh"}
    (path / "config.yaml").write_text(yaml.safe_dump(facts | {"seed": seed, "n_seeds": n_seeds} | changes))
    (path / "meta.json").write_text(
        json.dumps({"status": "finished", "frames": 100, "versions": {"world": "1"}, "study": "by hand"})
    )
    counts = [(seed, 10, 0, 0, 10, 0, 0, 0, 90, -10.0, True, False)]
    pd.DataFrame(counts, columns=list(EPISODE_COLUMNS)).astype(EPISODE_COLUMNS).to_parquet(
        path / "episodes.parquet"
    )
    pd.DataFrame({"seed": [seed], "frame": [100]}).to_parquet(path / "progress.parquet")
    return path


def same(a, b):
    """Two folders hold the same run, bit for bit."""
    for name in ("episodes.parquet", "progress.parquet"):
        tables = [
            pd.read_parquet(path / name).drop(columns="frames_per_second", errors="ignore") for path in (a, b)
        ]
        pd.testing.assert_frame_equal(*tables, check_exact=True)
    weights = [load_file(path / "policy.safetensors") for path in (a, b)]
    assert weights[0].keys() == weights[1].keys()
    assert all(torch.equal(weights[0][key], weights[1][key]) for key in weights[0])
    assert sorted(path.name for path in b.iterdir()) == sorted(FILES)
