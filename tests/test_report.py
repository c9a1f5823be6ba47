"""The report, on run folders written by hand whose metrics are known in closed form."""

import json
import math
import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
import yaml
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from torch import nn

from uavnav.evaluate import BEHAVIOUR_COLUMNS
from uavnav.networks import mlp
from uavnav.report import SECTIONS, _write_all, conclusions, content, docs, markdown, report
from uavnav.report.__main__ import main
from uavnav.report.cells import BINS, collect, curve, label
from uavnav.report.claims import CLAIMS, PRIMARY, audit
from uavnav.report.content import gather
from uavnav.report.figures import plot
from uavnav.report.studies import of_paper
from uavnav.report.tables import audit_rows, number, overview, table, with_interval
from uavnav.runs import POLICY, paper
from uavnav.runs.metrics import EPISODE_COLUMNS, METRICS, Metric
from uavnav.runs.tables import RunError
from uavnav.training.config import TrainConfig
from uavnav.training.weights import serialize

CONFIG = {"preset": "paper", "total_frames": 1000, "n_worlds": 16, "reward": "eq14", "init": "default", "lr": 1e-4}
BANK = {"n": 10_000, "k": 8, "split": "train", "generator_seed": 0, "sha256": "abc"}


def rows(seed, *episodes):
    """Episodes (frame, steps, stops, full stops, turns, distance, reward[, terminated, truncated]) of one seed."""
    padded = [(*episode, True, False)[:9] for episode in episodes]
    full = [(seed, frame, 0, 0, *counts) for frame, *counts in padded]
    return pd.DataFrame(full, columns=list(EPISODE_COLUMNS)).astype(EPISODE_COLUMNS)


def two(seed, reward):
    """100 steps at 4 px/step and 300 at 8: the mean of speeds is 6, the speed of the means 7; stops 10 and 0 %."""
    return rows(seed, (100, 100, 10, 1, 90, 400, reward), (400, 300, 0, 0, 150, 2400, reward))


def write_run(path, *tables, algorithm="dqn", activation="tanh", seed=0, evaluation=None, meta=None, **changes):
    path.mkdir(parents=True)
    config = {"algorithm": algorithm, "activation": activation, "seed": seed, "n_seeds": len(tables)}
    config |= {"gamma": 0.99} if algorithm == "dqn" else {}
    (path / "config.yaml").write_text(yaml.safe_dump(config | CONFIG | changes))
    facts = {"status": "finished", "frames": 1000, "wall_seconds": 3725.4, "git_commit": "c0ffee", "bank": BANK}
    facts |= {"versions": {"torch": "2.13.0", "world": "1"}, "machine": {"processor": "an abacus", "cores": 2}}
    (path / "meta.json").write_text(json.dumps(facts | (meta or {})))
    pd.concat(tables).to_parquet(path / "episodes.parquet")
    pd.DataFrame({"seed": [seed], "frame": [1000]}).to_parquet(path / "progress.parquet")
    if evaluation is not None:
        evaluation.to_parquet(path / "evaluation.parquet")
    return path


def found(text, *start):
    """The cells after the given first cells, of each line of the report's tables that starts with them."""
    lines = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in text.splitlines() if line[:1] == "|"]
    return [line[len(start) :] for line in lines if line[: len(start)] == list(start)]


def write_results(path):
    """Two seeds of dqn tanh, evaluated on two sets, and one of ppo relu, not evaluated."""
    flown = rows(0, (10, 10, 1, 1, 5, 50, -9.0), (40, 40, 4, 0, 10, 100, 3.0, False, True))
    flights = pd.concat([flown.assign(mode="greedy"), flown.assign(mode="sampled", reward=0.5)])
    write_run(path / "dqn" / "tanh", two(0, -6.0), two(1, -8.0), evaluation=flights)
    write_run(path / "ppo" / "relu", two(0, 5.0), algorithm="ppo", activation="relu")
    return path


REWARD = "−7.00 [−8.00, −6.00]"
MISSING = "all training episodes: missing"
FIGURES = content._figures


@pytest.fixture(autouse=True)
def undrawn(monkeypatch):
    """Without figures, which take most of a report's time; those that are looked at are asked for."""
    monkeypatch.setattr("uavnav.report.content._figures", lambda *anything: [])


@pytest.fixture
def results(tmp_path):
    return write_results(tmp_path / "results")


def said(*folders):
    """report.md, without writing it."""
    return markdown(gather(folders))


def no_policy(*paths):
    return [f"{path}: no policy.safetensors there; give the folder of a finished run" for path in paths]


@pytest.fixture(scope="module")
def text(tmp_path_factory):
    return said(write_results(tmp_path_factory.mktemp("report") / "results"))


def test_speed_6_as_mean_of_ratios_and_7_as_ratio_of_means_over_two_seeds(text):
    means, ratios = found(text, "tanh", "all training episodes")
    assert means[:3] == ["2", "4", "0.0%"]
    shares = [f"{mean} [{mean}, {mean}]" for mean in ("5.00", "0.50", "70.00")]
    assert means[3:] == ["200.0 [200.0, 200.0]", *shares, "1,400.0 [1,400.0, 1,400.0]", "6.00 [6.00, 6.00]", REWARD]
    assert ratios[3:] == [f"{mean} [{mean}, {mean}]" for mean in ("2.50", "0.25", "60.00", "7.00")]


def test_the_interquartile_mean_stands_below_the_mean_with_its_own_interval(tmp_path):
    write_run(tmp_path / "run", *(two(seed, reward) for seed, reward in enumerate([0.0, 1.0, 2.0, 3.0, 94.0])))
    (mean, _), (middle, _) = (found(said(tmp_path), "tanh", PRIMARY + more) for more in ("", ", interquartile mean"))
    assert mean[-1].startswith("20.00 [")
    assert middle[-1].startswith("2.00 [")
    assert mean[:3] == middle[:3] == ["5", "10", "0.0%"]


def test_one_seed_has_no_interval(text):
    means, ratios = found(text, "relu", "all training episodes")
    assert means == ["1", "2", "0.0%", "200.0", "5.00", "0.50", "70.00", "1,400.0", "6.00", "5.00"]
    assert not any("[" in cell for cell in means + ratios)


def test_the_papers_8_rows_stand_beside_ours_as_printed(text):
    assert len(found(text, "tanh", "the paper")) == 4  # two algorithms, two tables each
    assert found(text, "sigmoid", "the paper")[0][3:] == [
        *("211.367", "–", "0.626", "59.983", "797.7136", "4.984", "−5.666")
    ]


def test_evaluation_is_two_readings_with_half_of_the_episodes_cut_off_at_40_steps(text):
    assert found(text, "tanh", "greedy evaluation")[0] == [
        *("1", "2", "50.0% at 40 steps", "25.0", "10.00", "5.00", "37.50", "75.0", "3.75", "−3.00")
    ]
    assert found(text, "tanh", "sampled evaluation")[0][-1] == "0.50"
    assert len(found(text, "relu", "greedy evaluation: missing")) == 2


def test_the_last_100_episodes_are_each_seeds_own(tmp_path):
    early = [(frame, 10, 0, 0, 0, 10, -10.0) for frame in range(1, 51)]
    late = [(frame, 10, 0, 0, 0, 10, 2.0) for frame in range(51, 151)]
    write_run(tmp_path / "run", rows(0, *early, *late))
    text = said(tmp_path)
    assert found(text, "tanh", "all training episodes")[0][-1] == "−2.00"
    assert found(text, "tanh", "last 100 training episodes")[0][1:2] == ["100"]
    assert found(text, "tanh", "last 100 training episodes")[0][-1] == "2.00"


def test_six_missing_cells_are_named_and_have_rows(text):
    names = "dqn sigmoid, dqn relu, dqn leaky_relu, ppo tanh, ppo sigmoid, ppo leaky_relu"
    assert f"No finished run of {names}." in text
    assert len(found(text, "sigmoid", "missing: no finished run")) == 4


def test_runs_of_other_seeds_are_merged_and_of_another_setting_labelled(results):
    write_run(results / "more", two(2, -10.0), seed=2)
    write_run(results / "faster", two(0, -1.0), lr=0.5)
    write_run(results / "rewarded", two(0, -2.0), reward="initial")
    text = said(results)
    merged = found(text, "tanh", "all training episodes")[0]
    assert merged[0] == "3"
    assert merged[-1] == "−8.00 [−10.00, −6.00]"
    assert found(text, "tanh (lr=0.5)", "all training episodes")[0][-1] == "−1.00"
    assert found(text, "tanh (reward=initial)", "all training episodes")[0][-1] == "−2.00"
    usual = "preset=paper, frames=1,000, n_worlds=16, obstacles=8, reward=eq14, init=default"
    assert f"Unless a row says otherwise: {usual}, lr=0.0001 (" in text  # dqn, where lr differs
    assert f"Unless a row says otherwise: {usual} (" in text  # ppo, where nothing does


def test_settings_beyond_the_preset_are_named_even_where_all_runs_share_them(tmp_path):
    write_run(tmp_path / "run", two(0, -1.0), lr=0.25, meta={"beyond_preset": {"lr": 0.25}})
    assert "init=default, lr=0.25 (" in said(tmp_path)


def test_runs_on_other_banks_or_in_another_world_are_not_merged(tmp_path):
    write_run(tmp_path / "a", two(0, -1.0))
    write_run(tmp_path / "b", two(1, -1.0), seed=1, meta={"bank": BANK | {"k": 4, "sha256": "def"}})
    write_run(tmp_path / "c", two(2, -1.0), seed=2, meta={"versions": {"world": "2"}})
    cells, _ = collect([tmp_path])
    assert [len(cell.runs) for cell in cells] == [1, 1, 1]


def test_the_second_run_of_the_same_seed_is_named_and_skipped(results):
    write_run(results / "dqn" / "twin", two(1, 99.0), two(2, 99.0), seed=1)
    gathered = gather([results])
    first, second = results / "dqn" / "tanh", results / "dqn" / "twin"
    twin = f"{second}: its seed 1 is in {first} already, with the same settings"
    assert gathered.left_out == [twin, *no_policy(first, results / "ppo" / "relu")]
    assert found(markdown(gathered), "tanh", "all training episodes")[0][-1] == REWARD


def test_a_run_without_a_policy_is_named_once_and_its_rows_count(results):
    gathered = gather([results])
    assert gathered.left_out == no_policy(results / "dqn" / "tanh", results / "ppo" / "relu")
    assert gathered.replays is None
    assert found(markdown(gathered), "tanh", "all training episodes")[0][-1] == REWARD
    behaved(results / "dqn" / "tanh")  # of whose flights is a table, but no more can be flown
    assert gather([results]).left_out == gathered.left_out


def test_broken_unfinished_and_foreign_folders_are_named_on_stderr_and_in_the_report(results, capsys):
    (write_run(results / "broken", two(0, 1.0), lr=1.0) / "episodes.parquet").write_bytes(b"PAR1")
    (write_run(results / "half", two(0, 1.0), lr=2.0) / "meta.json").write_text('{"status": "running"}')
    write_run(results / "columns", two(0, 1.0).drop(columns="turns"), lr=3.0)
    write_run(results / "seeds", two(7, 1.0), lr=4.0, seed=0)
    write_run(results / "table", two(0, 1.0), lr=5.0, meta={"bank": None})
    (results / "thesis").mkdir()
    (results / "thesis" / "config.yaml").write_text("title: a thesis")
    (results / ".hydra").mkdir()
    (results / ".hydra" / "config.yaml").write_text("hidden: true")
    assert main([str(results)]) == 0
    lines = capsys.readouterr().err.splitlines()
    names = ("broken", "columns", "half", "seeds", "table", "thesis", "dqn/tanh", "ppo/relu")
    text, page = (results / "report.md").read_text(), (results / "report.html").read_text()
    for name, line in zip(names, lines, strict=True):
        assert line.startswith(f"uavnav.report: left out: {results / name}")
        assert f"- {line.removeprefix('uavnav.report: left out: ')}\n" in text
        assert str(results / name) in page
    assert ".hydra" not in text


def test_tables_where_no_run_is_are_named_and_those_of_a_report_are_not(results):
    two(0, 1.0).to_parquet(results / "dqn" / "copy.parquet")
    for name in ("lost", "baselines", "tables"):
        (results / name).mkdir()
    two(0, 1.0).to_parquet(results / "lost" / "episodes.parquet")
    two(0, 1.0).to_parquet(results / "baselines" / "straight.parquet")
    two(0, 1.0).to_parquet(results / "tables" / "mine.parquet")
    cells, left_out = collect([results])
    assert len(cells) == 2
    assert left_out == [
        f"{results / 'dqn' / 'copy.parquet'}: lies where no run is",
        f"{results / 'lost'}: has episodes.parquet and no config.yaml; not a run of this package",
    ]


def test_a_run_that_is_in_no_study_is_named(results):
    strange = write_run(results / "strange", two(0, 1.0), lr=0.5, init="orthogonal")
    line = f"{strange}: in no study; it differs from the main one in init=orthogonal, lr=0.5"
    assert line in gather([results]).left_out


def test_control_c_is_one_line_and_status_130_and_nothing_is_written(results, tmp_path, monkeypatch, capsys):
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.setattr("uavnav.report.markdown", interrupted)
    monkeypatch.setattr("uavnav.report.docs.results", interrupted)
    assert main([str(results)]) == 130
    assert capsys.readouterr().err == "uavnav.report: stopped; no report was written\n"
    monkeypatch.chdir(tmp_path)
    Path("README.md").write_text(f"{BEGIN}\n{END}")
    assert docs.main([str(results)]) == 130
    assert capsys.readouterr().err == "uavnav.report.docs: stopped; nothing was written\n"
    assert sorted(tmp_path.rglob("*")) == [tmp_path / "README.md", *before]


def interrupted(*anything):
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: None, "there is no such folder; give"),
        (lambda path: path.write_text("x"), "is a file; give"),
        (lambda path: path.mkdir(), "holds no run; give"),
        (lambda path: (path / "a").mkdir(parents=True) or (path / "a" / "config.yaml").write_text("[1"), "no run that"),
    ],
)
def test_a_folder_without_runs_is_one_line_and_status_2_and_nothing_is_written(tmp_path, capsys, make, message):
    make(tmp_path / "results")
    before = sorted(tmp_path.rglob("*"))
    assert main([str(tmp_path / "results"), "--out", str(tmp_path / "out")]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert len(printed.err.splitlines()) == 1
    assert printed.err.startswith(f"uavnav.report: {tmp_path / 'results'}: {message}")
    assert sorted(tmp_path.rglob("*")) == before


def test_an_out_that_cannot_be_written_is_a_run_error_and_leaves_nothing(results, tmp_path):
    (tmp_path / "out").write_text("x")
    (tmp_path / "taken" / "report.md").mkdir(parents=True)
    (tmp_path / "half").mkdir()
    (tmp_path / "half" / "figures").write_text("x")  # which come last here: tables/ is not made either
    files = {"tables/a.csv": b"", "figures/b.png": b""}
    before = sorted(tmp_path.rglob("*"))
    for out in ("out", "taken", "half"):
        with pytest.raises(RunError, match="cannot be written"):
            report([results], tmp_path / out) if out != "half" else _write_all(tmp_path / out, files)
    assert sorted(tmp_path.rglob("*")) == before


def test_a_folder_given_twice_is_read_once(results):
    once, twice = gather([results]), gather([results, results, results / "dqn"])
    assert twice.left_out == once.left_out
    assert markdown(once) == markdown(twice)


def test_curves_average_the_episodes_that_ended_in_a_25th_of_the_frames(tmp_path):
    width = 1000 // BINS
    ends = [(1, 1.0), (width, 3.0), (width + 1, 7.0), (1000, 9.0)]
    closed = [(frame, 10, 0, 0, 0, 0, reward) for frame, reward in ends]
    still_open = (1000, 10, 0, 0, 0, 0, 1e6, False, False)
    write_run(tmp_path / "run", rows(0, *closed, still_open), rows(1, (5, 10, 0, 0, 0, 0, 4.0)))
    (cell,), _ = collect([tmp_path])
    means = curve(cell, "reward")
    assert means.index.tolist() == [width / 2, 1.5 * width, 1000 - width / 2]
    assert means[0].tolist() == [2.0, 7.0, 9.0]
    assert means[1].dropna().tolist() == [4.0]


def test_a_panel_holds_a_line_an_activation_with_n_and_the_papers_mean_dashed_in_its_colour(results):
    axes = Figure().subplots()
    cells, _ = collect([results])
    plot(axes, label([cell for cell in cells if cell.algorithm == "dqn"])[0], "reward")
    line, dashed = axes.lines
    assert line.get_label() == "tanh, n = 2"
    assert line.get_ydata().tolist() == [-7.0, -7.0]  # two episodes a seed, in bins of their own
    assert (dashed.get_linestyle(), dashed.get_ydata()) == ("--", [-6.982, -6.982])
    assert dashed.get_color() == line.get_color()
    (band,) = axes.collections
    assert band.get_datalim(axes.transData).intervaly.tolist() == [-8.0, -6.0]


def test_the_report_says_how_runs_were_made(text):
    assert "- versions: torch 2.13.0, world 1\n" in text
    assert "- git commit: c0ffee\n" in text
    assert "- machine: processor an abacus, cores 2\n" in text
    assert "1:02:05" in text  # 3,725 s


def test_an_algorithm_and_an_activation_that_the_paper_has_not_get_rows_too(results):
    write_run(results / "sac", two(0, 1.5), algorithm="sac", activation="mish")
    text = said(results)
    assert "\n## SAC\n" in text
    assert found(text, "mish", "all training episodes")[0][-1] == "1.50"
    assert found(text, "mish", "the paper") == []


def test_a_run_without_a_finished_episode_is_missing_in_every_reading(tmp_path):
    write_run(tmp_path / "run", rows(0, (1000, 10, 0, 0, 0, 0, -1.0, False, False)))
    assert len(found(report([tmp_path]).path.with_suffix(".md").read_text(), "tanh", MISSING)) == 2


def test_tables_of_nothing_still_hold_the_papers_4_rows():
    assert len(table([], "ppo", ratio_of_means=False)) == 1 + 2 * 4
    assert len(paper.TABLES) == 8


def test_it_imports_nothing_that_trains():
    forbidden = [
        "uavnav.algorithms.ppo",
        "uavnav.algorithms.dqn",
        "uavnav.training.learner",
        "uavnav.envs.env",
        "uavnav.training.sampler",
        "torchrl",
    ]
    code = f"import sys, uavnav.report; print([name for name in {forbidden} if name in sys.modules])"
    run = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[1],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    assert run.stdout.strip() == "[]"


# -- a further metric, activation or column ----------------------------------------------------------------------------


def test_a_metric_is_one_line_and_on_the_page_in_the_csv_in_latex_and_in_report_md(results, monkeypatch):
    monkeypatch.setitem(METRICS, "stood", Metric("stood", "stops", 1000.0, unit="‰", better=-1))
    written = report([results])
    page, text = written.path.read_text(), written.path.with_suffix(".md").read_text()
    assert page.count('<th scope="col">stood [‰]</th>') == 4  # two algorithms, means and interquartile means
    assert '<td>50.00 <span class="interval">[50.00, 50.00]</span></td>' in page
    assert '<td>25.00 <span class="interval">[25.00, 25.00]</span></td>' in page  # as a ratio of means
    assert found(text, "tanh", PRIMARY)[0][-1] == "50.00 [50.00, 50.00]"
    assert found(text, "sigmoid", "the paper")[0][-1] == "–"
    csv = pd.read_csv(results / "tables" / "metrics.csv").set_index(["algorithm", "reading", "ratio", "metric"])
    assert csv.loc[("dqn", PRIMARY, "ratio of means", "stood"), "mean"] == 25
    assert "stood [‰]" in (results / "tables" / "paper-dqn.tex").read_text()


def test_runs_from_before_a_column_was_added_are_read_beside_those_that_have_it(results, monkeypatch):
    write_run(results / "new", two(0, 1.0).assign(near=3), activation="sigmoid")
    write_run(results / "columns", two(0, 1.0).drop(columns="turns"), lr=3.0)
    monkeypatch.setitem(EPISODE_COLUMNS, "near", "int64")
    monkeypatch.setitem(METRICS, "near", Metric("near misses per episode", "near"))
    gathered = gather([results])
    (refused,) = [line for line in gathered.left_out if "parquet" in line]
    assert refused.startswith(f"{results / 'columns' / 'episodes.parquet'}: ")
    text = markdown(gathered)
    assert found(text, "tanh", PRIMARY)[0][-2:] == [REWARD, "–"]
    assert found(text, "sigmoid", PRIMARY)[0][-1] == "3.00"


def test_further_activations_change_neither_the_seeds_nor_the_figures_of_the_papers_four(results, monkeypatch):
    for activation in ("tanh", "sigmoid", "relu", "leaky_relu"):
        write_run(results / "four" / activation, two(0, 1.0), two(1, 2.0), activation=activation, lr=0.5)
    write_run(results / "four" / "gelu", two(0, 1.0), activation="gelu", lr=0.5)
    monkeypatch.setattr("uavnav.report.content._figures", FIGURES)
    gathered = gather([results])
    speed, intervals = (next(one for one in gathered.figures if one.name == name) for name in ("speed", "cells-reward"))
    assert "gelu" not in speed.drawn.alt + intervals.drawn.alt
    assert {*gathered.tables["wide"]["activation"]} == {"tanh", "sigmoid", "relu", "leaky_relu", "gelu"}
    assert docs.summary(gathered).count("1 to 2 seeds a cell") == 1  # PPO's relu has one
    text = docs.results(gathered)
    assert found(text, "DQN gelu", PRIMARY) == [["1", "1.00"]]
    assert "after 1,000 frames a seed" in text


# -- the whole of it ---------------------------------------------------------------------------------------------------


def behaved(path):
    """Give a run the steps of two sampled flights: seed 0 straight up, seed 1 turning on the spot."""
    steps = [(0, 0, n, 400.0, 300.0 + 9 * n, 90, 80.0, 9) for n in range(1, 6)]
    steps += [(1, 1, n, 400.0, 300.0, 5 * n % 360, 60.0, 50) for n in range(1, 6)]
    table = pd.DataFrame(steps, columns=list(BEHAVIOUR_COLUMNS)).astype(BEHAVIOUR_COLUMNS)
    table.assign(mode="sampled").to_parquet(path / "behaviour.parquet")


def trained(path, algorithm, action):
    """Give a run of two seeds a network that knows one action."""
    config = TrainConfig(seed=0, n_seeds=2, hidden=(4,))
    network = mlp([30, 4, 100], "tanh", [torch.Generator().manual_seed(seed) for seed in config.seeds], "default")
    with torch.no_grad():
        network[-1].weight.zero_()
        network[-1].bias[:, 0, action] = 50.0
    content = serialize({"policy": nn.ModuleList(network)}, algorithm, config, epsilon=0.05)
    (path / POLICY).write_bytes(content)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A folder with the runs, and the report on it."""
    path = tmp_path_factory.mktemp("whole") / "results"
    flights = rows(0, (10, 10, 1, 1, 5, 50, -9.0), (40, 40, 4, 0, 10, 100, 3.0, False, True)).assign(mode="sampled")
    for algorithm in ("dqn", "ppo"):
        run = write_run(
            path / algorithm, two(0, -6.0), two(1, -8.0), algorithm=algorithm, gamma=0.9, evaluation=flights
        )
        behaved(run)
        trained(run, algorithm, action=9)
    write_run(path / "short", two(0, 5.0), meta={"frames": 500}, gamma=0.9)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("uavnav.report.content._figures", FIGURES)
        return path, report([path], path.parent / "one")


@pytest.mark.slow
def test_two_reports_are_the_same_bytes(whole, monkeypatch):
    path, first = whole
    assert first.left_out == []
    monkeypatch.setattr("uavnav.report.content._figures", FIGURES)
    second = report([path], path.parent / "two")
    files = [
        {
            str(file.relative_to(one.path.parent)): file.read_bytes()
            for file in one.path.parent.rglob("*")
            if file.is_file()
        }
        for one in (first, second)
    ]
    assert sorted(files[0]) == sorted(files[1])
    assert [name for name in files[0] if files[0][name] != files[1][name]] == []


def test_a_report_is_a_page_its_markdown_tables_and_figures_in_two_forms(whole):
    _, written = whole
    assert written.path.name == "report.html"
    out = written.path.parent
    kinds = {"report.html", "report.md", "figures", "tables"}
    assert {file.name for file in out.iterdir()} == kinds
    drawn = {file.stem for file in out.glob("figures/*.svg")}
    assert drawn == {file.stem for file in out.glob("figures/*.png")}
    assert drawn >= {"curves-dqn-reward", "curves-ppo-steps", "cells-reward", "trajectories", "heat", "heat-empty"}
    assert drawn >= {"survival", "improvement", "power", "behaviour", "speed"}
    assert all(file.read_bytes().startswith(b"\x89PNG") for file in out.glob("figures/*.png"))
    page = written.path.read_text()
    assert page.count("data:image/svg+xml;base64,") == len(drawn)
    for section in SECTIONS:
        assert f'id="{section}"' in page
    text = (out / "report.md").read_text()
    for picture in re.findall(r"]\((figures/[^)]*)\)", text):
        assert (out / picture).is_file()
    assert "](figures/curves-dqn-reward.png)" in text


def test_the_tables_are_csv_that_say_what_the_content_says_and_latex(whole):
    path, written = whole
    folder = written.path.parent / "tables"
    gathered = gather([path])
    assert {file.stem for file in folder.glob("*.csv")} == {*gathered.tables}
    metrics = pd.read_csv(folder / "metrics.csv")
    row = metrics.set_index(["algorithm", "reading", "ratio", "metric"]).sort_index()
    assert row.loc["dqn", PRIMARY, "ratio of means", "speed"]["mean"] == 7
    assert row.loc["ppo", PRIMARY, "mean of ratios", "reward"]["mean"] == -7
    behaviour = pd.read_csv(folder / "behaviour.csv").set_index(["cell", "seed"])
    assert behaviour["clearance"].tolist() == [80, 60, 80, 60]
    assert behaviour["reversals"].tolist() == [0] * 4
    assert behaviour.loc["PPO tanh", "empty_straight_speed"].tolist() == [9, 9]
    assert behaviour.loc["DQN tanh", "empty_straight_speed"].tolist() == pytest.approx([9, 9], abs=0.3)  # explores
    overestimated = pd.read_csv(folder / "overestimation.csv")
    assert overestimated["q"].tolist() == pytest.approx([50, 50])
    latex = (folder / "paper-ppo.tex").read_text()
    assert latex.count(r" \\") == 1 + 4 + 2 + 3  # header, the paper's rows, two of tanh, three cells without a run
    assert r"\%" in latex
    assert "_" not in latex.replace(r"\_", "")


def test_no_warning_escapes_a_report_on_few_and_equal_seeds(whole, tmp_path, monkeypatch):
    monkeypatch.setattr("uavnav.report.content._figures", FIGURES)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_run(tmp_path / "open", rows(0, (1000, 10, 0, 0, 0, 0, -1.0, False, False)))
        assert report([tmp_path]).path.is_file()
        gather([whole[0]])


# -- tables in words ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "digits", "shown"),
    [
        (math.nan, 2, "–"),
        (math.inf, 2, "∞"),
        (-math.inf, 2, "−∞"),
        (0.0, 2, "0.00"),
        (-1234.5, 1, "−1,234.5"),
        (0.0004, 2, "0.0004"),
        (-0.0004, 3, "−0.0004"),
        (12.345, 0, "12"),
    ],
)
def test_numbers_for_people(value, digits, shown):
    assert number(value, digits) == shown


def test_an_interval_stands_in_brackets_where_there_is_one():
    assert with_interval(1.0, -2.0, 3.5, 1) == "1.0 [−2.0, 3.5]"
    assert with_interval(1.0, math.nan, math.nan, 1) == "1.0"


def findings_of(*verdicts):
    """The first claims' parts have one verdict each; the other claims have no runs."""
    of = dict(enumerate(verdicts, start=1))
    found = audit(lambda *_, **__: np.empty(0), of_paper)
    return [one._replace(verdict=of.get(one.claim, one.verdict)) for one in found]


def test_the_overview_counts_parts_and_names_the_other_readings_verdicts():
    other = [one._replace(n=8) if one.claim == 1 else one for one in findings_of("contradicted")]
    audits = {"first": findings_of("supported", "contradicted"), "second": other}
    header, first, second, third, *_ = overview(CLAIMS, audits, "first")
    assert header[-1] == "second"
    assert first[2:] == ["supported", "12, 0, 0", "contradicted"]
    assert second[2:] == ["contradicted", "0, 9, 0", "–"]  # of which that reading has no runs
    assert third[2:] == ["undecided", "0, 0, 6", "–"]


def test_a_part_that_a_test_decides_shows_its_p_where_an_interval_would_be():
    (part,) = [one for one in findings_of() if one.claim == 8]
    shown = [audit_rows([part._replace(value=2.0, n=8, p_holm=p)])[1][2] for p in (0.0123, 0.0001, math.nan)]
    assert [one.partition(" ")[2] for one in shown] == ["(p = 0.012)", "(p < 0.001)", ""]


# -- conclusions -------------------------------------------------------------------------------------------------------


def test_the_lead_counts_and_names_the_claims():
    assert conclusions.lead(findings_of("supported", "contradicted", "supported")) == (
        f"Of the paper's {len(CLAIMS)} claims, 2 are supported (1, 3), 1 is contradicted (2) and {len(CLAIMS) - 3} are"
        f" undecided ({', '.join(str(claim.number) for claim in CLAIMS[3:])})."
    )
    assert conclusions.lead(findings_of()).startswith(f"Of the paper's {len(CLAIMS)} claims, 0 are supported, 0 ")


def test_a_sentence_counts_parts_and_says_where_the_paper_speaks_against_itself():
    claim, found = CLAIMS[1], [one for one in findings_of() if one.claim == 2]
    mixed = [one._replace(verdict="contradicted") for one in found[:4]] + found[4:]
    assert conclusions.sentence(claim, mixed) == (
        "4 of 9 parts are contradicted, 5 of 9 parts are undecided. The paper's own tables speak against it in 2: "
        f"{'; '.join(one.text for one in found if one.against_itself)}. {claim.note}"
    )
    assert "speak against" not in conclusions.sentence(CLAIMS[2], [one for one in findings_of() if one.claim == 3])


def test_the_headline_is_the_first_part_with_the_claims_own_verdict():
    found = [one for one in findings_of("supported") if one.claim == 1]
    known = {"value": 3.0, "low": 1.0, "high": 4.5, "n": 8}
    contradicted = found[4]._replace(verdict="contradicted", **known)
    text, *numbers = conclusions.headline([*found[:4], contradicted, *found[5:]])
    assert text == "speed [px a step]: PPO better than DQN, means of four activations"
    assert numbers == ["the paper −0.35", "ours 3.00 [1.00, 4.50]", "claimed > 0", "n = 8"]
    (interaction,) = [one for one in findings_of() if one.claim == 8]
    assert conclusions.headline([interaction])[1:] == ["no runs"]
    assert conclusions.headline([interaction._replace(n=8, p_holm=0.0123)])[-2:] == ["p = 0.012", "n = 8"]


def test_results_put_every_claim_under_its_verdict_with_its_parts(results):
    gathered = gather([results])
    gathered.audits[PRIMARY] = findings_of("supported", "contradicted")
    text = docs.results(gathered)
    holds, rest = text.split("## What holds\n")[1].split("## What does not\n")
    fails, open_ = rest.split("## What cannot be known from this\n")
    assert re.findall(r"^\*\*(\d+)\.", holds, re.MULTILINE) == ["1"]
    assert re.findall(r"^\*\*(\d+)\.", fails, re.MULTILINE) == ["2"]
    assert re.findall(r"^\*\*(\d+)\.", open_, re.MULTILINE) == [str(place) for place in range(3, len(CLAIMS) + 1)]
    assert len(found(holds, "reward per episode: PPO better than DQN, means of four activations")) == 1
    assert conclusions.lead(gathered.findings) in text
    assert docs.results(gathered) == text
    gathered.audits[PRIMARY] = findings_of()
    assert docs.results(gathered).count("No claim.") == 2


def test_the_readmes_block_has_a_row_a_claim(results):
    text = docs.summary(gather([results]))
    assert conclusions.lead(gather([results]).findings) in text
    assert "1 to 2 seeds a cell" in text
    for claim in CLAIMS:
        ((verdict, by),) = found(text, str(claim.number), claim.sentence)
        assert verdict == "undecided"
        assert by.endswith(("no runs", "n = 1", "n = 2"))
    assert "**Not complete:** no finished run of dqn sigmoid," in text
    assert "**Not complete:** no finished run of dqn sigmoid," in docs.results(gather([results]))


BEGIN, END = docs.BEGIN, docs.END


@given(st.text(), st.text(), st.text(), st.text())
def test_between_marks_is_the_new_text_and_around_them_the_old(before, old, new, after):
    text = f"{before}{BEGIN}\n{old}\n{END}{after}"
    if not any(mark in part for mark in (BEGIN, END) for part in (before, old, new, after)):
        replaced = docs.between_marks(text, new)
        assert replaced == f"{before}{BEGIN}\n{new}\n{END}{after}"
        assert docs.between_marks(replaced, new) == replaced


@pytest.mark.parametrize("text", ["", "no marks", BEGIN, END, f"{END}\n{BEGIN}"])
def test_a_text_without_marks_is_refused(text):
    with pytest.raises(RunError, match=f"README.md: has no lines {BEGIN} and {END}; put"):
        docs.between_marks(text, "new")


def test_the_command_writes_the_conclusions_and_nothing_where_the_readme_has_no_marks(results, monkeypatch, capsys):
    monkeypatch.chdir(results.parent)
    Path("docs").mkdir()
    Path("README.md").write_text("# Title\n")
    assert docs.main([]) == 2
    assert capsys.readouterr().err.startswith("uavnav.report.docs: README.md: has no lines")
    assert not Path("docs/results.md").exists()
    Path("README.md").write_text(f"# Title\n{BEGIN}\nold\n{END}\nrest\n")
    assert docs.main(["results"]) == 0
    gathered = gather([Path("results")])
    assert Path("docs/results.md").read_text() == docs.results(gathered)
    assert Path("README.md").read_text() == f"# Title\n{BEGIN}\n{docs.summary(gathered)}\n{END}\nrest\n"
    assert docs.main(["nowhere"]) == 2


def test_a_persons_flights_and_a_policy_from_elsewhere_are_rows_of_all_six_metrics_on_the_page_and_in_report_md(
    results,
):
    flown = rows(0, (100, 100, 10, 0, 50, 400, -6.0), (200, 100, 0, 0, 10, 600, -4.0))
    (results / "baselines").mkdir()
    for who in ("human", "theirs-sampled"):
        flown.to_parquet(results / "baselines" / f"{who}.parquet")
    report([results])
    text = (results / "report.md").read_text()
    for who in ("human", "theirs-sampled"):
        (row,) = found(text, who)
        seeds, flights, cut, steps, *_, speed, reward = row
        assert (seeds, flights, cut, steps, speed, reward) == ("1", "2", "0.0%", "100.0", "5.00", "−5.00")
        assert f">{who}<" in (results / "report.html").read_text()
