"""The benchmarks' arithmetic on known numbers, their file, and a small run of them; no test judges a speed."""

import itertools
import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from uavnav import DroneEnv
from uavnav.algorithms.dqn import DQNConfig
from uavnav.algorithms.ppo import PPOConfig
from uavnav.bench import __main__ as bench
from uavnav.bench import growth, jobs, parity, peers
from uavnav.bench import report as bench_report
from uavnav.bench.jobs import Clock, Job, JobError, Mark, Stages, rate, whole_run
from uavnav.bench.report import Results, Target, number, ratio, read_sections, write_file


def results_of(**rounds):
    """Results whose measurements found these in their rounds, one process each; `__` stands for a slash."""
    results = Results()
    for name, found in rounds.items():
        results.found[name.replace("__", "/")] = [[one] for one in found]
    return results


# -- rates and whole runs ---------------------------------------------------------------------------------------------


def test_the_rate_is_100_frames_a_second_though_the_first_interval_took_60_seconds():
    marks = [Mark(0, 3.0), *(Mark(100 * n, 63.0 + n) for n in range(1, 9))]
    assert rate(marks) == pytest.approx(100)


def test_a_run_with_a_start_up_of_12_s_at_500_frames_a_second_takes_2012_s_for_a_million():
    found = whole_run([Mark(1000 * n, 12 + 2.0 * n) for n in range(9)], 0, 0)
    assert found == pytest.approx({"startup": 12, "rate": 500, "whole": 2012, "frames": 8000})


def test_dqns_whole_run_counts_50_000_frames_at_the_rate_before_learning_and_the_rest_after():
    before = [Mark(100 * n, 10 + 0.02 * n) for n in range(21)]  # 5,000 frames/s up to frame 2,000
    marks = before + [Mark(2000 + 10 * n, before[-1].at + 5 + 0.02 * n) for n in range(1, 41)]  # 5 s to compile, 500/s
    found = whole_run(marks, 2000, 50_000)
    assert (found["rate_before"], found["rate"]) == pytest.approx((5000, 500))
    assert found["startup"] == pytest.approx(15)
    assert found["whole"] == pytest.approx(15 + 10 + 1900)


def test_the_clock_stops_after_2_steady_seconds_or_500_frames_but_never_before_3_steady_marks(monkeypatch):
    now = itertools.count(100.0)
    monkeypatch.setattr(jobs.time, "time", lambda: next(now))
    slow = Clock(launched=100.0, warm=50, frames=10**6, seconds=2.0)
    assert [slow(frames) for frames in (0, 20, 50, 60, 70)] == [True, True, True, True, False]
    assert slow.marks[0] == Mark(0, 0.0)
    short = Clock(launched=100.0, warm=0, frames=500, seconds=1e9)
    assert [short(frames) for frames in (400, 600, 800)] == [True, True, False]


def test_a_slow_run_is_watched_for_50_frames_though_its_2_seconds_are_over_and_for_70_at_most(monkeypatch):
    now = itertools.count(100.0)
    monkeypatch.setattr(jobs.time, "time", lambda: next(now))
    clock = Clock(launched=100.0, warm=0, frames=70, seconds=2.0, least=50)
    assert [clock(frames) for frames in (0, 10, 20, 30, 49, 50)] == [True] * 5 + [False]
    short = Clock(launched=100.0, warm=0, frames=70, seconds=1e9, least=50)
    assert [short(frames) for frames in (10, 50, 69, 70)] == [True, True, True, False]


def test_stages_count_what_is_called_inside_another_once_and_the_rest_as_other(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(jobs.time, "perf_counter", lambda: now[0])

    class Work:
        def outer(self):
            now[0] += 3
            self.inner()
            now[0] += 1

        def inner(self):
            now[0] += 4

    stages, work = Stages(), Work()
    stages.wrap(Work, "outer", "update")
    stages.wrap(Work, "inner", "buffer")
    stages.wrap(Work, "gone", "advantage")
    work.outer()
    stages.restart()
    work.outer()
    now[0] += 2
    assert stages.shares() == pytest.approx({"update": 0.4, "buffer": 0.4, "other": 0.2})


@pytest.mark.parametrize(("n", "first"), [(20, 0), (20, 5), (20, 7), (20, 19), (3, 1), (0, 0), (20, 99)])
def test_the_first_of_n_good_policies_is_found_where_all_later_ones_are_good(n, first):
    assert jobs._first(n, lambda index: index >= first) == (first if first < n else None)


# -- medians, ratios, targets -----------------------------------------------------------------------------------------


def test_ratios_are_the_median_over_rounds_and_of_medians_where_rounds_differ_in_number():
    assert ratio([10, 40, 30], [10, 10, 15]) == 2
    assert ratio([10, 40, 30], [10, 20]) == 2
    assert ratio([], [1]) is ratio([1], []) is None


def test_results_are_the_mean_over_processes_and_the_median_over_rounds():
    results = Results()
    results.found["training/ppo/sb3/two"] = [
        [{"whole": 1}, {"whole": 3}],
        [{"whole": 9}, {"whole": 9}],
        [{"whole": 5}] * 2,
    ]
    assert results.values("training/ppo/sb3/two", "whole") == [2, 9, 5]
    assert results.median("training/ppo/sb3/two", "whole") == 5
    assert results.median("nothing", "whole") is None


def test_ten_seeds_in_100_s_are_40_times_faster_each_than_one_of_400_s():
    results = results_of(
        training__ppo__sb3__numpy=[{"whole": 400.0}] * 2, training__ppo__uavnav__10=[{"whole": 100.0}] * 2
    )
    assert bench_report.against_sb3("ppo", 10)(results) == 40
    assert bench_report.against_sb3("dqn", 10)(results) is None


@pytest.mark.parametrize(
    ("value", "at_most", "verdict"),
    [
        (8, False, "reached"),
        (20, False, "aim reached"),
        (7.9, False, "**not reached**"),
        (None, False, "not measured"),
        (20, True, "**not reached**"),
        (8, True, "aim reached"),
    ],
)
def test_the_verdict_of_a_least_of_8_and_an_aim_of_20_and_the_other_way_round(value, at_most, verdict):
    assert Target("", "", 8, 8 if at_most else 20, lambda _: None, at_most).verdict(value) == verdict


def test_the_table_of_targets_says_what_was_reached_and_what_was_not(tmp_path):
    worlds = {f"world/compiled/{bench.CORES}": [[{"1": 1e3, "1024": 1.2e6}]], "world/eager/1": [[{"1024": 9e9}]]}
    results = results_of(gymnasium__numpy=[{"rate": 20_000.0}], gymnasium__uavnav=[{"rate": 10_000.0}])
    results.found |= worlds
    results.found["memory/10"] = [[{"peak": 2.5, "tree": 3.0}]]
    text = "\n".join(bench_report.write_targets(results, tmp_path))
    assert "| world, best batch size, two cores | M steps/s | 0.9 | 3 | 1.2 | reached |" in text
    assert "| the same, against the NumPy world | times | 80 | - | 60 | **not reached** |" in text
    assert "against the NumPy world | times | 1 | 3 | 0.5 | **not reached** |" in text
    assert "| memory, DQN, ten seeds of 1 M frames | GB | 4 | 2 | 3 | reached |" in text
    assert text.count("not measured") == 5


@pytest.mark.parametrize(
    ("value", "text"), [(None, "-"), (1234567.8, "1,234,568"), (12.345, "12.3"), (0.01234, "0.0123")]
)
def test_numbers_have_three_digits_that_count(value, text):
    assert number(value) == text


# -- parity -----------------------------------------------------------------------------------------------------------


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
    env = DroneEnv([256], seeds=0)
    torch.manual_seed(0)  # for the actions
    reward = env.rollout(500, break_when_any_done=False)["next", "reward"]
    assert float(reward[:, 100:].mean()) == pytest.approx(parity.FLOOR, abs=0.01)


def test_the_interval_of_a_ratio_of_16_seeds_to_4_covers_the_true_one_in_90_percent_of_2000_draws():
    assert parity.ratio(np.array([3.0, 12.0]), np.array([5.0, 5.0])).value == pytest.approx(1.2)
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


def keep_curves(store, cell, arm, seeds, level):
    for seed in range(seeds):
        path = store.path(cell, arm, seed)
        path.parent.mkdir(parents=True, exist_ok=True)
        frames = np.arange(100, store.frames + 1, 100)  # one after the other, each of 100 frames, as in one world
        flights = {"frame": frames, "steps": 100 / arm.n_worlds, "reward": 100 * (level + 0.002 * seed)}
        table = pd.DataFrame(flights)
        table.attrs["when"] = "2026-11-20, commit 0123"
        table.to_parquet(path)


def test_parity_runs_what_is_missing_ours_and_dqn_first_and_at_most_12_seeds_a_process(tmp_path):
    store, ppo, dqn = parity.Store(tmp_path, 10_000), parity.Cell("ppo", "tanh"), parity.Cell("dqn", "tanh")
    seeds, worlds = {ppo: (3, 2, 1, 1), dqn: (14, 1, 0, 0)}, {"ppo": 16, "dqn": 64}
    keep_curves(store, ppo, parity.Arm("uavnav", 16), 2, level=-0.03)
    todo = store.jobs(list(seeds), worlds, seeds)
    assert [title for title, _, _ in todo] == [
        "dqn tanh, uavnav, 64 worlds, seeds 0 to 11",
        "dqn tanh, uavnav, 64 worlds, seeds 12 to 13",
        "ppo tanh, uavnav, 16 worlds, seeds 2 to 2",
        "ppo tanh, uavnav, 1 world, seeds 0 to 0",
        "dqn tanh, SB3, 64 worlds, seed 0",
        "ppo tanh, SB3, 16 worlds, seed 0",
        "ppo tanh, SB3, 16 worlds, seed 1",
        "ppo tanh, SB3, 1 world, seed 0",
    ]
    assert todo[2][2]["seeds"] == [2]
    assert (todo[-1][2]["seed"], todo[-1][2]["n_envs"]) == (0, 1)
    assert parity.consecutive([0, 1, 3, 4, 5, 6], most=3) == [[0, 1], [3, 4, 5], [6]]


def test_parity_compares_like_with_like_and_the_preset_as_it_is_with_sb3_in_one_world(tmp_path):
    store, cells, worlds = parity.Store(tmp_path, 10_000), parity.CELLS[:1], {"ppo": 16, "dqn": 64}
    mine, theirs, mine_alone, theirs_alone = parity.arms(16)
    keep_curves(store, cells[0], mine, 2, level=-0.03)
    keep_curves(store, cells[0], theirs, 2, level=-0.03)
    keep_curves(store, cells[0], mine_alone, 3, level=0.07)
    keep_curves(store, cells[0], theirs_alone, 1, level=-0.13)
    text = "\n".join(parity.section(store, worlds, "x.png", cells))
    assert "| PPO tanh | 1 | 0.302 ± 0.002 (3) | - (1) | - | not enough seeds yet |" in text
    keep_curves(store, cells[0], theirs_alone, 2, level=-0.13)
    keep_curves(store, parity.Cell("dqn", "tanh"), parity.Arm("uavnav", 64), 2, level=-0.18)
    text = "\n".join(parity.section(store, worlds, "x.png", cells))
    assert "| PPO tanh | 16 | 0.201 ± 0.001 (2) | 0.201 ± 0.001 (2) | 1.00 (0.98 ... 1.02) | equal |" in text
    assert "| PPO tanh | 1 | 0.302 ± 0.002 (3) | 0.101 ± 0.001 (2) | 2.99 (" in text
    assert "| PPO tanh | uavnav, 16 worlds | SB3, 1 world | 1.99 (" in text
    assert "| PPO tanh | uavnav, 16 worlds | uavnav, 1 world | 0.67 (" in text
    assert "| PPO tanh | SB3, 16 worlds | SB3, 1 world | 1.99 (" in text
    assert "| tanh | DQN, uavnav, 64 worlds | PPO, uavnav, 16 worlds | 0.25 (" in text
    assert text.count("| different |") == 5
    (panel,) = parity.draw(store, worlds, cells).axes
    assert len(panel.lines) == 5  # and what random actions earn
    assert panel.get_xlabel() == "frames per seed [thousand]"


def test_seeds_are_printed_with_the_day_and_commit_on_which_they_were_run(tmp_path):
    store, cells, worlds = parity.Store(tmp_path, 10_000), parity.CELLS[:1], {"ppo": 16, "dqn": 64}
    mine, theirs, *_ = parity.arms(16)
    keep_curves(store, cells[0], mine, 2, level=-0.03)
    jobs._keep(pd.read_parquet(store.path(cells[0], mine, 0)), str(store.path(cells[0], theirs, 0)))
    assert store.origins(worlds, cells) == f"2 on 2026-11-20, commit 0123; 1 on {bench_report.when()}"


def test_the_times_in_the_readme_are_those_of_the_benchmarks():
    root = Path(__file__).parent.parent
    lines = read_sections(root / "docs" / "benchmarks.md")["training"].splitlines()
    rows = [line.strip("| ").split(" | ") for line in lines if line.startswith("| ")]
    one, ten, sb3 = (
        next(row[7].removeprefix("0:0") for row in rows if row[0] == name)  # PPO's table is the first
        for name in ("uavnav, 1 seed", "uavnav, 10 seeds", "SB3, alone")
    )
    text = " ".join((root / "README.md").read_text().split())
    assert f"a million frames of PPO take {one} minutes with one seed and {ten} a seed with ten;" in text
    assert f"in a NumPy version of this world, takes {sb3}, and learns the same" in text


def test_the_parity_in_the_docs_is_what_the_rows_give_with_8_seeds_of_ours_and_4_of_sb3_at_least():
    root = Path(__file__).parent.parent
    store = parity.Store(root / "bench", parity.FRAMES)
    worlds = {"ppo": PPOConfig().n_worlds, "dqn": DQNConfig().n_worlds}
    section = "\n".join(parity.section(store, worlds, "benchmarks-parity.png"))
    assert section in read_sections(root / "docs" / "benchmarks.md")["parity"]
    for cell in parity.CELLS:
        for arm in parity.arms(worlds[cell.algorithm]):
            assert len(store.tables(cell, arm)) >= {"uavnav": 8, "sb3": 4}[arm.library]


@pytest.mark.slow
@pytest.mark.parametrize("n_worlds", [1, 16])
@pytest.mark.parametrize("library", ["uavnav", "sb3"])
def test_the_flights_kept_of_2048_frames_fill_all_frames_of_every_world(tmp_path, library, n_worlds):
    path = str(tmp_path / "flights.parquet")
    if library == "sb3":
        pytest.importorskip("stable_baselines3")
        jobs.curves_sb3(time.time(), "ppo", "tanh", 3, n_worlds, 2048, path)
    else:
        settings = {"activation": "tanh", "total_frames": 2048, "n_worlds": n_worlds, "compile": "off"}
        jobs.curves_ours(time.time(), "ppo", [3], [path], **settings)
    flights = pd.read_parquet(path)
    begins = flights.frame - flights.steps * n_worlds
    assert flights.steps.sum() == 2048  # a step of one world is a frame
    assert (flights.frame == 2048).sum() >= n_worlds  # every world's last flight, over or not
    ends = flights.frame.sort_values().tolist()[: len(flights) - n_worlds]
    assert sorted(begins) == [0] * n_worlds + ends  # each flight begins where one ended
    assert -0.6 < flights.reward.sum() / 2048 < 0  # learning has hardly begun


def test_a_seed_that_cannot_be_trained_is_named_and_the_others_are_kept(tmp_path):
    store, said = parity.Store(tmp_path, 300), []
    cell = parity.Cell("ppo", "tanhh")
    failed = parity.train(store, {"ppo": 1}, tmp_path, said.append, {cell: (1, 0, 0, 0)}, at_once=1)
    assert len(failed) == 1
    assert "did you mean tanh?" in failed[0]
    assert len(said) == 1
    assert "\n" not in said[0]


# -- growth -----------------------------------------------------------------------------------------------------------


def test_growth_of_x_to_the_1_5_is_fitted_and_the_largest_between_two_neighbours_is_named():
    assert growth.exponent([(x, 3 * x**1.5) for x in (1.0, 2.0, 8.0)]) == pytest.approx(1.5)
    assert growth.steepest([(1, 1.0), (2, 1.5), (8, 12.0)]) == pytest.approx(1.5)
    assert math.isnan(growth.exponent([(1, 1.0)]))
    assert math.isnan(growth.steepest([(1, 1.0)]))
    assert growth.line([(x, 3.0 + 0.5 * x) for x in (1, 2, 5, 40)]) == pytest.approx((3, 0.5))


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_the_parameters_of_a_hidden_width_of_16_are_those_of_its_networks(algorithm):
    config = jobs._config(algorithm, {"hidden": (16, 16)})
    if algorithm == "ppo":
        from uavnav.algorithms.ppo import make_networks

        networks = make_networks(config)
    else:
        from uavnav.algorithms.dqn import make_network

        networks = [make_network(config)]
    n = sum(part.numel() for network in networks for part in network.parameters())
    assert growth.parameters(algorithm, 16) == n


def test_growth_says_what_is_fixed_and_per_seed_and_that_nothing_or_what_grows_faster_than_linearly():
    rows = {point: {"rate": 1e6 / (60 * point.size), "peak": 0.5} for point in growth.points()}
    text = "\n".join(growth.section(rows, "benchmarks.png"))
    assert "| PPO | seeds: 1, 2, 5, 10, 20, 40 | 1.0, 2.0, 5.0, 10.0, 20.0, 40.0 | 1.00 (1.00) |" in text
    assert "min and 1 min a seed; 0.5 GB and" in text
    assert text.endswith("nothing grows faster than linearly.")
    rows |= {point: {"rate": 1e6 / (60 * point.x**2), "peak": 0.5} for point in rows if point[:2] == ("ppo", "seeds")}
    text = "\n".join(growth.section(rows, "benchmarks.png"))
    assert "Faster than linearly grow: PPO's time with seeds, exponent 2.00 (between 1 to 2, 2 to 5" in text
    panels = growth.draw(rows).axes
    assert [panel.get_ylabel() for panel in panels if panel.get_ylabel()] == [
        "time for 1 M frames a seed [min]",
        "peak memory [GB]",
    ]
    assert panels[-1].get_xlabel() == "parameters a seed"
    assert panels[-1].lines[0].get_xdata()[0] == growth.parameters("ppo", 16)


# -- the file ---------------------------------------------------------------------------------------------------------


def test_a_run_replaces_its_own_sections_keeps_the_others_and_leaves_no_file_aside(tmp_path):
    path = tmp_path / "docs" / "benchmarks.md"
    write_file(path, {"parity": ["equal"], "world": ["slow"]}, 60.0)
    write_file(path, {"world": ["fast"], "targets": ["reached"]}, 61.0)
    sections = read_sections(path)
    assert list(sections) == ["machine", "targets", "world", "parity"]
    assert sections["parity"].endswith("equal")
    assert sections["world"].endswith("fast")
    assert "in 0:01:01" in sections["machine"]
    assert "torch" in sections["parity"].splitlines()[2]
    text = path.read_text()
    assert "slow" not in text
    assert text.startswith("# Benchmarks\n")
    assert os.listdir(path.parent) == ["benchmarks.md"]


def test_a_file_that_cannot_be_finished_stays_as_it_was(tmp_path):
    path = tmp_path / "benchmarks.md"
    path.write_text("before")

    def write(aside):
        aside.write_text("half")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        bench_report.save(path, write)
    assert path.read_text() == "before"
    assert os.listdir(tmp_path) == ["benchmarks.md"]


# -- jobs and the command ---------------------------------------------------------------------------------------------


def test_a_job_that_fails_says_why_in_one_line_and_one_that_takes_too_long_is_ended(tmp_path):
    job = Job("single", {"which": "numpy", "seconds": "soon"}, 1, tmp_path)
    slow = Job("single", {"which": "numpy", "seconds": 600}, 1, tmp_path)
    with pytest.raises(JobError, match="it took longer than 0 s"):
        slow.result(timeout=0.1)
    assert slow._process.returncode is not None
    with pytest.raises(JobError, match="TypeError") as failed:
        job.result(timeout=60)
    assert "\n" not in str(failed.value)
    job.stop()


def test_the_command_measures_two_things_one_thread_each_and_writes_the_file(tmp_path, monkeypatch, capsys):
    def tiny(quick):
        return [
            bench.Measurement("gymnasium/numpy", "single", {"which": "numpy", "seconds": 0.05}),
            bench.Measurement("world/eager/1", "world", {"batches": [4], "compiled": False, "seconds": 0.05}),
            bench.Measurement("training/ppo/sbx/numpy", "sb3", {}, needs="sbx"),
        ]

    monkeypatch.setattr(bench, "plan", lambda quick: [bench.replace(one, rounds=1, expected=1) for one in tiny(quick)])
    real = bench.importlib.util.find_spec
    monkeypatch.setattr(bench.importlib.util, "find_spec", lambda name: None if name == "sbx" else real(name))
    monkeypatch.chdir(tmp_path)
    out = Path("store/quick.md")
    assert bench.main(["--quick", "--store", "store"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4
    assert "gymnasium/numpy: rate" in lines[0]
    assert "training/ppo/sbx/numpy: SBX is not installed: pip install -e '.[bench]'" in lines[2]
    assert lines[3] == f"wrote {out}"
    sections = read_sections(out)
    assert not Path("docs").exists()
    assert list(sections) == ["machine", "targets", "world", "gymnasium", "training"]
    assert "one round each" in sections["world"].splitlines()[2]
    assert "| batch size | eager, 1 thread | times NumPy |" in sections["world"]
    assert "SBX is not installed: pip install -e '.[bench]'" in sections["training"]


STUBS = {
    "world": lambda how: {str(batch): 1e6 for batch in how["batches"]},
    "single": lambda how: {"rate": 1e4},
    "vector": lambda how: {str(batch): 1e4 for batch in how["batches"]},
    "buffer_memory": lambda how: {"frames": 10**6, "peak": 0.6},
    "ours_whole": lambda how: {"whole": 90.0, "frames": 10**6, "peak": 0.6},
    "reach": lambda how: (
        {"seed": how["seed"], "seconds": None, "frames": None}
        if how["seed"] == 3
        else {"seed": how["seed"], "seconds": 20.0 + how["seed"], "frames": 200_000}
    ),
}
"""What each job finds; runs that are watched find the rest."""


def stubbed(one):
    watched = {"startup": 9.0, "rate": 2e3, "rate_before": 1e4, "whole": 600.0, "frames": 60_000, "peak": 0.5}
    watched |= {"shares": {"collection": 0.5, "update": 0.4, "other": 0.1}} if one.arguments.get("stages") else {}
    found = STUBS[one.job](one.arguments) if one.job in STUBS else watched
    return [found | ({"tree": 1.0} if one.sample else {})] * one.copies


@pytest.fixture
def stubs(monkeypatch, tmp_path):
    """The names of what is measured, none of it really."""
    measured = []

    def measure(runner, one, timeout):
        measured.append(one.name)
        return stubbed(one)

    def side_by_side(runner, jobs, *how):
        measured.append([(name, arguments["algorithm"], arguments["n_seeds"]) for name, arguments in jobs])

    def train(store, worlds, cache, say, seeds, at_once):
        keep_curves(store, parity.CELLS[0], parity.Arm("uavnav", worlds["ppo"]), 2, level=-0.03)
        return ["ppo tanh, SB3: failed"]

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(bench.Runner, "measure", measure)
    monkeypatch.setattr(bench.Runner, "_side_by_side", side_by_side)
    monkeypatch.setattr(parity, "train", train)
    real = bench.importlib.util.find_spec
    monkeypatch.setattr(bench.importlib.util, "find_spec", lambda name, *more: name in bench.PEERS or real(name, *more))
    return measured


@pytest.mark.parametrize(
    ("words", "sections"),
    [
        ([], ["machine", "targets", *bench.SECTIONS]),
        (["--quick"], ["machine", "targets", *bench.SECTIONS]),
        (["--only", "stages"], ["machine", "stages"]),
        (["--growth"], ["growth"]),
        (["--whole"], ["whole"]),
        (["--fast"], ["fast"]),
        (["--parity"], ["parity"]),
    ],
)
def test_every_mode_writes_its_sections_to_the_end(stubs, words, sections):
    assert bench.main(words) == 0
    out = Path("bench/quick.md" if "--quick" in words else "docs/benchmarks.md")
    assert list(read_sections(out)) == sections
    assert out.read_text().endswith("\n")
    assert "cut short" not in out.read_text()


def test_quick_compiles_the_graphs_of_1_and_of_5_agents_of_each_algorithm_before_it_measures(stubs, monkeypatch):
    monkeypatch.setattr(bench, "CORES", 2)
    assert bench.main(["--quick"]) == 0
    assert stubs[:2] == [[("ours", algorithm, n_seeds) for n_seeds in (1, 5)] for algorithm in ("ppo", "dqn")]
    assert "training/ppo/uavnav/10" in stubs[2:]
    stubs.clear()
    assert bench.main(["--quick", "--only", "world"]) == 0
    assert stubs == ["world/compiled/2 × 1"]


def test_fast_warms_up_once_and_refreshes_its_row_of_the_targets_and_nothing_else(stubs):
    assert bench.main([]) == 0
    before = read_sections(Path("docs/benchmarks.md"))
    stubs.clear()
    assert bench.main(["--fast"]) == 0
    assert stubs == ["fast/warm-up", *(f"fast/{seed}" for seed in range(5))]
    after = read_sections(Path("docs/benchmarks.md"))
    row = "| PPO `fast`: first policy with a reward of 88.5 | s | 90 | 20 |"
    assert after["targets"] == before["targets"].replace(f"{row} - | not measured |", f"{row} 22 | reached |")
    assert after["targets"] != before["targets"]
    assert "| 3 | not reached | not reached |" in after["fast"]
    assert f"| 0 | 20 | 200,000 | {bench_report.when()} |" in after["fast"]
    stubs.clear()
    assert bench.main(["--fast"]) == 0
    assert stubs == []


@pytest.mark.parametrize("words", [[], ["--growth"], ["--whole"], ["--fast"]])
def test_a_run_that_is_stopped_in_its_third_measurement_writes_what_it_found_and_marks_it(
    stubs, words, monkeypatch, capsys
):
    def measure(runner, one, timeout):
        stubs.append(one.name)
        if len(stubs) == 3:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(10)
        return stubbed(one)

    monkeypatch.setattr(bench.Runner, "measure", measure)
    assert bench.main(words) == 130
    assert len(stubs) == 3
    assert "stopped; what was found so far is in docs/benchmarks.md" in capsys.readouterr().err
    sections = read_sections(Path("docs/benchmarks.md"))
    assert sections
    assert all("cut short" in text for text in sections.values())
    assert "targets" not in sections


def test_a_job_ends_when_the_one_that_started_it_is_killed(tmp_path):
    command = (
        "import sys, time, pathlib; from uavnav.bench.jobs import Job;"
        f"print(Job('single', {{'which': 'numpy', 'seconds': 600}}, 1, pathlib.Path({str(tmp_path)!r}))._process.pid,"
        " flush=True); time.sleep(600)"
    )
    process = subprocess.Popen([sys.executable, "-c", command], stdout=subprocess.PIPE, text=True)
    with process:
        job = Path(f"/proc/{process.stdout.readline().strip()}")
        assert job.exists()
        process.kill()
    for _ in range(300):
        if not job.exists() or (job / "stat").read_text().rpartition(")")[2].split()[0] == "Z":
            break
        time.sleep(0.1)
    else:
        pytest.fail("the job still runs")


def test_of_two_processes_that_meet_the_first_waits_for_the_second(tmp_path):
    command = (
        "import sys, time, pathlib; from uavnav.bench.jobs import _meet; time.sleep(float(sys.argv[1]));"
        f"began = time.time(); _meet(pathlib.Path({str(tmp_path)!r}), '4096', 2); print(began, time.time())"
    )
    both = [
        subprocess.Popen([sys.executable, "-c", command, delay], stdout=subprocess.PIPE, text=True)
        for delay in ("0", "1")
    ]
    spans = [[float(word) for word in process.communicate(timeout=120)[0].split()] for process in both]
    assert max(came for came, _ in spans) < min(went_on for _, went_on in spans)


def test_measurements_that_would_end_too_late_are_left_out_and_named(tmp_path):
    one = bench.Measurement("world/eager/1", "world", {}, expected=61)
    results = bench.Runner(tmp_path, lambda line: None, minutes=1).run([one])
    assert results.missing == {"world/eager/1": "no time was left for it"}
    assert "no time was left" in "\n".join(bench_report.write_sections(results, tmp_path)["world"])


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--only", "wrld"], "(did you mean world?)"),
        (["--parity", "--only", "world"], "leave it out with --parity"),
        (["--parity", "--growth"], "not allowed with"),
        (["--quik"], "--quik"),
        (["--out", "."], "is a folder"),
    ],
)
def test_each_of_5_bad_arguments_ends_in_one_line_and_status_2(words, says, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    try:
        status = bench.main(words)
    except SystemExit as stop:
        status = stop.code
    errors = capsys.readouterr().err
    assert status == 2
    assert errors.startswith("uavnav.bench: ")
    assert errors.count("\n") == 1
    assert says in errors


def test_every_measurement_of_the_plan_names_a_job_and_arguments_that_it_takes():
    import inspect

    for quick in (False, True):
        every = bench.plan(quick)
        assert len({one.name for one in every}) == len(every)
        assert {one.section for one in every} == set(bench.SECTIONS)
        for one in every:
            inspect.signature(getattr(jobs, one.job)).bind(0.0, **one.arguments)
    for point in growth.points():
        inspect.signature(jobs.ours).bind(0.0, **point.arguments)


@pytest.mark.parametrize(
    ("algorithm", "frames", "more"),
    [("ppo", 8192, {}), ("dqn", 40_000, {"learning_starts": 10_000, "frames_per_update": 64})],
)
def test_a_watched_run_of_ours_is_stopped_and_names_its_rates(algorithm, frames, more):
    settings = {"frames_per_batch": 256, "epochs": 1} if algorithm == "ppo" else {}
    found = jobs.ours(0.0, algorithm, 1, 0.0, stages=True, compile="off", **settings, **more)
    assert found["frames"] <= frames
    assert found["rate"] > 0
    assert 0.99 < sum(found["shares"].values()) < 1.01
    assert found["shares"]["collection"] > 0
    assert found["shares"]["update"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_where_the_time_goes_is_taken_of_stable_baselines3_too(algorithm):
    pytest.importorskip("stable_baselines3")
    command = (
        "from uavnav.bench.jobs import sb3; import time, json;"
        f"print(json.dumps(sb3(time.time(), {algorithm!r}, 'numpy', 4096, 1.0, 500, stages=True)['shares']))"
    )  # in a process of its own: what is timed stays wrapped
    result = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=True)
    shares = json.loads(result.stdout)
    assert sum(shares.values()) == pytest.approx(1)
    assert min(shares["collection"], shares["update"], shares["buffer"]) > 0


# -- peers ------------------------------------------------------------------------------------------------------------


def test_stable_baselines3_is_given_the_preset_paper_with_1_and_with_16_parallel_worlds():
    pytest.importorskip("stable_baselines3")
    from uavnav.envs.sb3 import DroneVecEnv

    env = DroneVecEnv(16, seed=0)
    ppo = jobs.make_sb3("stable_baselines3", "ppo", env, 0, 16)
    assert (ppo.n_steps, ppo.batch_size, ppo.n_epochs, ppo.gae_lambda) == (128, 64, 10, 0.95)
    assert (ppo.clip_range(1), ppo.ent_coef, ppo.vf_coef, ppo.max_grad_norm, ppo.learning_rate) == (
        0.2,
        0,
        0.5,
        0.5,
        3e-4,
    )
    dqn = jobs.make_sb3("stable_baselines3", "dqn", env, 0, 16, activation="relu")
    assert (dqn.train_freq.frequency, dqn.gradient_steps, dqn.target_update_interval) == (1, 4, 10_000)
    assert (dqn.learning_starts, dqn.batch_size, dqn.max_grad_norm, dqn.learning_rate) == (50_000, 32, 10, 1e-4)
    alone = jobs.make_sb3("stable_baselines3", "dqn", jobs._make_env("numpy"), 0, buffer_size=100)
    assert (alone.train_freq.frequency, alone.gradient_steps, alone.target_update_interval) == (4, 1, 10_000)
    assert "in_features=30, out_features=64" in repr(dqn.q_net)
    assert "ReLU" in repr(dqn.q_net)
    assert "Tanh" in repr(alone.q_net)


def test_the_single_file_peers_learn_until_they_are_told_to_stop():
    from uavnav.bench.numpy_world import NumpyDroneEnv

    seen = []

    def keep_on(frames):
        seen.append(frames)
        return frames < 128

    peers.ppo(NumpyDroneEnv, 0, keep_on, num_steps=64)
    assert seen == [0, 64, 128]
    seen.clear()
    peers.dqn(NumpyDroneEnv, 0, keep_on, learning_starts=100, buffer_size=120)
    assert seen == list(range(129))


def test_the_benchmarks_start_without_any_peer_installed():
    code = (
        "import sys; sys.modules.update({'stable_baselines3': None, 'sbx': None, 'jax': None});"
        "from uavnav.bench.__main__ import plan; print(len(plan(True)))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(result.stdout) > 20
