"""Parity: learning curves of ours and of Stable-Baselines3, their comparison, and the rows that are committed."""

import shutil
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from uavnav import DroneEnv
from uavnav.bench import ours, parity, peers
from uavnav.bench.page import read_sections
from uavnav.bench.parity import Arm, Cell, Store
from uavnav.bench.results import when
from uavnav.report import cells

ROOT = Path(__file__).parent.parent


# -- curves and ratios ------------------------------------------------------------------------------------------------


def test_a_curve_spreads_each_flights_reward_over_the_frames_that_it_took():
    flights = pd.DataFrame({"frame": [10, 40, 40, 44], "steps": [5, 15, 20, 4], "reward": [-10.0, 30.0, 40.0, 8.0]})
    # frames 0 to 10 and 10 to 40 in one world, 0 to 40 in the other, and 36 to 44, half of them after the last stretch
    assert parity.curve(flights, 40, n_worlds=2, bins=4).tolist() == pytest.approx([0, 2, 2, 2.4])
    assert parity.curve(flights, 40, n_worlds=2, bins=1).tolist() == pytest.approx([64 / 40])


@pytest.mark.parametrize("n_worlds", [1, 7])
def test_the_area_of_flights_that_fill_all_frames_is_their_reward_a_frame_above_what_random_actions_earn(n_worlds):
    rng = np.random.default_rng(n_worlds)
    steps = [rng.permutation([1, 2, 3, 30, 64]) for _ in range(n_worlds)]
    ends = np.concatenate([np.cumsum(one) * n_worlds for one in steps])
    flights = pd.DataFrame({"frame": ends, "steps": np.concatenate(steps), "reward": rng.normal(size=5 * n_worlds)})
    (area,) = parity.areas(parity.curve(flights, 100 * n_worlds, n_worlds)[None])
    assert area == pytest.approx(flights.reward.sum() / (100 * n_worlds) - parity.FLOOR)


def test_a_frame_of_random_actions_earns_minus_0_23():
    env = DroneEnv([128], seeds=0)
    torch.manual_seed(0)  # for the actions
    reward = env.rollout(300, break_when_any_done=False)["next", "reward"]
    assert float(reward[:, 100:].mean()) == pytest.approx(parity.FLOOR, abs=0.01)


def test_the_interval_of_a_ratio_of_16_seeds_to_4_covers_the_true_one_in_90_percent_of_2000_draws():
    assert parity.ratio(np.array([3.0, 12.0]), np.array([4.0, 6.25])).value == pytest.approx(1.2)
    rng = np.random.default_rng(0)
    pairs = [(rng.normal(6, 0.2, 16), rng.normal(5, 0.4, 4)) for _ in range(2000)]
    found = [parity.ratio(*pair) for pair in pairs]
    assert np.mean([one.low <= 1.2 <= one.high for one in found]) == pytest.approx(0.9, abs=0.02)
    assert all(one.low < one.value < one.high for one in found)


def test_intervals_are_the_same_only_within_0_8_to_1_25():
    assert parity.Ratio(1, 0.8, 1.25).verdict == "equal"
    assert parity.Ratio(1, 0.79, 1.0).verdict == "open"
    assert parity.Ratio(1, 1.0, 1.26).verdict == "open"
    assert parity.Ratio(1.3, 1.01, 1.6).verdict == "different"
    assert parity.Ratio(0.8, 0.7, 0.99).verdict == "different"


# -- the rows ---------------------------------------------------------------------------------------------------------


def keep_curves(store, cell, arm, seeds, level):
    for seed in range(seeds):
        frames = np.arange(100, store.frames + 1, 100)  # one after the other, each of 100 frames, as in one world
        flights = {"frame": frames, "steps": 100 / arm.n_worlds, "reward": 100 * (level + 0.002 * seed)}
        table = pd.DataFrame(flights)
        table.attrs["when"] = "2026-11-20, commit 0123"
        path = store.path(cell, arm, seed)
        path.parent.mkdir(parents=True, exist_ok=True)
        table.to_parquet(path)


PPO, DQN = Cell("ppo", "tanh"), Cell("dqn", "tanh")


@pytest.fixture
def store(tmp_path, monkeypatch):
    """A folder for two problems, PPO with 16 worlds and DQN with 64 in the preset, of 10,000 frames a seed."""
    monkeypatch.setattr(parity, "CELLS", [PPO, DQN])
    monkeypatch.setattr(parity, "preset_worlds", {"ppo": 16, "dqn": 64}.get)
    monkeypatch.setattr(parity, "CORES", 2)
    return Store(tmp_path, 10_000)


def test_parity_runs_what_is_missing_ours_first_and_two_seeds_of_sb3_side_by_side(store, monkeypatch):
    monkeypatch.setattr(parity, "SEEDS", {"uavnav": (3, 1), "sb3": (3, 0)})
    keep_curves(store, PPO, Arm("uavnav", 16), 2, level=-0.03)
    todo = store.plan()
    assert [one.name.removeprefix("parity/") for one in todo] == [
        "PPO tanh, uavnav, 16 worlds, seeds from 2",
        "PPO tanh, uavnav, 1 world, seeds from 0",
        "DQN tanh, uavnav, 64 worlds, seeds from 0",
        "DQN tanh, uavnav, 1 world, seeds from 0",
        "PPO tanh, SB3, 16 worlds, seeds from 0",
        "PPO tanh, SB3, 16 worlds, seeds from 2",
        "DQN tanh, SB3, 64 worlds, seeds from 0",
        "DQN tanh, SB3, 64 worlds, seeds from 2",
    ]
    (mine,), (theirs, other), (last,) = (todo[n].processes for n in (0, 4, 5))
    assert (mine["seed"], len(mine["paths"])) == (2, 1)
    assert [run["seed"] for run in (theirs, other, last)] == [0, 1, 2]
    assert (theirs["n_worlds"], theirs["total_frames"]) == (16, 10_000)
    assert theirs["path"] == str(store.path(PPO, Arm("sb3", 16), 0))


def test_parity_compares_like_with_like_and_the_preset_as_it_is_with_sb3_in_one_world(store):
    mine, theirs, mine_alone, theirs_alone = parity.arms("ppo")
    keep_curves(store, PPO, mine, 2, level=-0.03)
    keep_curves(store, PPO, theirs, 2, level=-0.03)
    keep_curves(store, PPO, mine_alone, 3, level=0.07)
    keep_curves(store, PPO, theirs_alone, 1, level=-0.13)
    text = "\n".join(parity.section(store))
    assert "| PPO tanh | 1 | 0.302 ± 0.002 (3) | - (1) | - | not enough seeds yet |" in text
    keep_curves(store, PPO, theirs_alone, 2, level=-0.13)
    keep_curves(store, DQN, Arm("uavnav", 64), 2, level=-0.18)
    text = "\n".join(parity.section(store))
    assert "| PPO tanh | 16 | 0.201 ± 0.001 (2) | 0.201 ± 0.001 (2) | 1.00 (0.98 ... 1.02) | equal |" in text
    assert "| PPO tanh | 1 | 0.302 ± 0.002 (3) | 0.101 ± 0.001 (2) | 2.99 (" in text
    assert "| PPO tanh | uavnav, 16 worlds | SB3, 1 world | 1.99 (" in text
    assert "| PPO tanh | uavnav, 16 worlds | uavnav, 1 world | 0.67 (" in text
    assert "| PPO tanh | SB3, 16 worlds | SB3, 1 world | 1.99 (" in text
    assert "| tanh | DQN, uavnav, 64 worlds | PPO, uavnav, 16 worlds | 0.25 (" in text
    assert text.count("| different |") == 5


def test_the_figure_has_a_curve_for_each_arm_and_a_line_for_random_actions(store):
    for arm in parity.arms("ppo"):
        keep_curves(store, PPO, arm, 2, level=-0.03)
    panel, _ = parity.draw(store).axes
    assert len(panel.lines) == 5
    assert panel.get_xlabel() == "frames per seed [thousand]"


def test_seeds_are_printed_with_the_day_and_commit_on_which_they_were_run(store):
    mine, theirs, *_ = parity.arms("ppo")
    keep_curves(store, PPO, mine, 2, level=-0.03)
    ours.keep(pd.read_parquet(store.path(PPO, mine, 0)), str(store.path(PPO, theirs, 0)))
    assert store.origins() == f"2 on 2026-11-20, commit 0123; 1 on {when()}"


@pytest.mark.slow
@pytest.mark.parametrize("n_worlds", [1, 16])
@pytest.mark.parametrize("library", ["uavnav", "sb3"])
def test_the_flights_kept_of_2048_frames_fill_all_frames_of_every_world(tmp_path, library, n_worlds):
    path = str(tmp_path / "flights.parquet")
    settings = {"activation": "tanh", "seed": 3, "total_frames": 2048, "n_worlds": n_worlds}
    if library == "sb3":
        pytest.importorskip("stable_baselines3")
        peers.curves(time.time(), "ppo", path=path, **settings)
    else:
        ours.curves(time.time(), "ppo", [path], compile="off", epochs=1, **settings)
    flights = pd.read_parquet(path)
    begins = flights.frame - flights.steps * n_worlds
    assert flights.steps.sum() == 2048  # a step of one world is a frame
    assert (flights.frame == 2048).sum() >= n_worlds  # every world's last flight, over or not
    ends = flights.frame.sort_values().tolist()[: len(flights) - n_worlds]
    assert sorted(begins) == [0] * n_worlds + ends  # each flight begins where one ended
    assert -0.6 < flights.reward.sum() / 2048 < 0  # learning has hardly begun


# -- what is committed ------------------------------------------------------------------------------------------------


def test_the_parity_tables_in_the_docs_are_what_the_rows_give():
    def rows(lines):
        return [line for line in lines if line.startswith("|")]

    committed = read_sections(ROOT / "docs" / "benchmarks.md")["parity"].splitlines()
    assert rows(committed) == rows(parity.section(Store(ROOT / "results" / "bench")))


def test_the_committed_rows_have_8_seeds_of_ours_and_4_of_sb3_at_least():
    store = Store(ROOT / "results" / "bench")
    for cell in parity.CELLS:
        for arm in parity.arms(cell.algorithm):
            assert len(store.tables(cell, arm)) >= {"uavnav": 8, "sb3": 4}[arm.library]


def test_a_report_takes_no_row_of_the_benchmarks_for_a_run(tmp_path):
    shutil.copytree(ROOT / "results" / "heading" / "ppo" / "tanh", tmp_path / "ppo" / "tanh")
    keep_curves(Store(tmp_path / "bench"), PPO, Arm("sb3", 1), 1, level=0.0)
    (cell,), left_out = cells.collect([tmp_path])
    assert (cell.algorithm, left_out) == ("ppo", [])
