"""The report, on run folders written by hand whose metrics are known in closed form."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
import yaml
from matplotlib.figure import Figure

from uavnav import paper
from uavnav.metrics import EPISODE_COLUMNS
from uavnav.report import report
from uavnav.report.__main__ import main
from uavnav.report.cells import BINS, collect, curve, label
from uavnav.report.figures import plot
from uavnav.report.tables import table
from uavnav.runs import RunError

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


@pytest.fixture
def results(tmp_path, monkeypatch):
    """Without drawing, which takes most of a report's time."""
    monkeypatch.setattr("uavnav.report.draw", lambda cells: b"")
    return write_results(tmp_path / "results")


@pytest.fixture(scope="module")
def text(tmp_path_factory):
    return report([write_results(tmp_path_factory.mktemp("report") / "results")]).path.read_text()


def test_speed_6_as_mean_of_ratios_and_7_as_ratio_of_means_over_two_seeds(text):
    means, ratios = found(text, "tanh", "all training episodes")
    assert means[:3] == ["2", "4", "0.0%"]
    shares = [f"{mean} ± 0.000" for mean in ("5.000", "0.500", "70.000")]
    assert means[3:] == ["200.0 ± 0.0", *shares, "1,400.0 ± 0.0", "6.000 ± 0.000", "-7.000 ± 1.414"]
    assert ratios[3:] == [f"{mean} ± 0.000" for mean in ("2.500", "0.250", "60.000", "7.000")]


def test_one_seed_has_no_spread(text):
    means, ratios = found(text, "relu", "all training episodes")
    assert means == ["1", "2", "0.0%", "200.0", "5.000", "0.500", "70.000", "1,400.0", "6.000", "5.000"]
    assert not any("±" in cell for cell in means + ratios)


def test_the_papers_8_rows_stand_beside_ours_as_printed(text):
    assert len(found(text, "tanh", "the paper")) == 4  # two algorithms, two tables each
    assert found(text, "sigmoid", "the paper")[0][3:] == [
        *("211.367", "-", "0.626", "59.983", "797.7136", "4.984", "-5.666")
    ]


def test_evaluation_is_two_readings_with_half_of_the_episodes_cut_off_at_40_steps(text):
    assert found(text, "tanh", "greedy evaluation")[0] == [
        *("1", "2", "50.0% at 40 steps", "25.0", "10.000", "5.000", "37.500", "75.0", "3.750", "-3.000")
    ]
    assert found(text, "tanh", "sampled evaluation")[0][-1] == "0.500"
    assert len(found(text, "relu", "greedy evaluation: missing")) == 2


def test_the_last_100_episodes_are_each_seeds_own(tmp_path):
    early = [(frame, 10, 0, 0, 0, 10, -10.0) for frame in range(1, 51)]
    late = [(frame, 10, 0, 0, 0, 10, 2.0) for frame in range(51, 151)]
    write_run(tmp_path / "run", rows(0, *early, *late))
    text = report([tmp_path]).path.read_text()
    assert found(text, "tanh", "all training episodes")[0][-1] == "-2.000"
    assert found(text, "tanh", "last 100 training episodes")[0][1:2] == ["100"]
    assert found(text, "tanh", "last 100 training episodes")[0][-1] == "2.000"


def test_six_missing_cells_are_named_and_have_rows(text):
    names = "dqn sigmoid, dqn relu, dqn leaky_relu, ppo tanh, ppo sigmoid, ppo leaky_relu"
    assert f"No finished run of {names}." in text
    assert len(found(text, "sigmoid", "missing: no finished run")) == 4


def test_runs_of_other_seeds_are_merged_and_of_another_setting_labelled(results):
    write_run(results / "more", two(2, -10.0), seed=2)
    write_run(results / "faster", two(0, -1.0), lr=0.5)
    write_run(results / "rewarded", two(0, -2.0), reward="initial")
    text = report([results]).path.read_text()
    merged = found(text, "tanh", "all training episodes")[0]
    assert (merged[0], merged[-1]) == ("3", "-8.000 ± 2.000")
    assert found(text, "tanh (lr=0.5)", "all training episodes")[0][-1] == "-1.000"
    assert found(text, "tanh (reward=initial)", "all training episodes")[0][-1] == "-2.000"
    usual = "preset=paper, frames=1,000, n_worlds=16, obstacles=8, reward=eq14, init=default"
    assert f"Unless a row says otherwise: {usual}, lr=0.0001 (" in text  # dqn, where lr differs
    assert f"Unless a row says otherwise: {usual} (" in text  # ppo, where nothing does


def test_settings_beyond_the_preset_are_named_even_where_all_runs_share_them(tmp_path):
    write_run(tmp_path / "run", two(0, -1.0), lr=0.25, meta={"beyond_preset": {"lr": 0.25}})
    assert "init=default, lr=0.25 (" in report([tmp_path]).path.read_text()


def test_runs_on_other_banks_or_in_another_world_are_not_merged(tmp_path):
    write_run(tmp_path / "a", two(0, -1.0))
    write_run(tmp_path / "b", two(1, -1.0), seed=1, meta={"bank": BANK | {"k": 4, "sha256": "def"}})
    write_run(tmp_path / "c", two(2, -1.0), seed=2, meta={"versions": {"world": "2"}})
    cells, _ = collect([tmp_path])
    assert [len(cell.runs) for cell in cells] == [1, 1, 1]


def test_the_second_run_of_the_same_seed_is_named_and_skipped(results):
    write_run(results / "dqn" / "twin", two(1, 99.0), two(2, 99.0), seed=1)
    written = report([results])
    first, second = results / "dqn" / "tanh", results / "dqn" / "twin"
    assert written.left_out == [f"{second}: its seed 1 is in {first} already, with the same settings"]
    assert found(written.path.read_text(), "tanh", "all training episodes")[0][-1] == "-7.000 ± 1.414"


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
    assert len(lines) == 6
    text = (results / "report.md").read_text()
    for name, line in zip(("broken", "columns", "half", "seeds", "table", "thesis"), lines, strict=True):
        assert line.startswith(f"uavnav.report: left out: {results / name}")
        assert f"- {line.removeprefix('uavnav.report: left out: ')}\n" in text
    assert ".hydra" not in text


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
    before = sorted(tmp_path.rglob("*"))
    for out in ("out", "taken"):
        with pytest.raises(RunError, match="cannot be written"):
            report([results], tmp_path / out)
    assert sorted(tmp_path.rglob("*")) == before


def test_two_reports_are_the_same_bytes(tmp_path):
    results = write_results(tmp_path / "results")
    names = ("report.md", "figures/dqn.png", "figures/ppo.png")
    first, second = (report([results], tmp_path / name).path.parent for name in ("one", "two"))
    assert sorted(str(path.relative_to(first)) for path in first.rglob("*") if path.is_file()) == sorted(names)
    assert (first / "figures" / "dqn.png").read_bytes().startswith(b"\x89PNG")
    for name in names:
        assert (first / name).read_bytes() == (second / name).read_bytes()


def test_a_folder_given_twice_is_read_once(results, tmp_path):
    once, twice = report([results], tmp_path / "one"), report([results, results / "dqn"], tmp_path / "two")
    assert twice.left_out == []
    assert once.path.read_text() == twice.path.read_text()


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


def test_the_report_says_how_runs_were_made_and_shows_figures_with_words_for_them(text):
    assert "- versions: torch 2.13.0, world 1\n" in text
    assert "- git commit: c0ffee\n" in text
    assert "- machine: processor an abacus, cores 2\n" in text
    assert "1:02:05" in text  # 3,725 s
    assert "![dqn: reward per episode and steps per episode in training against frames per seed" in text
    assert "tanh reward -7.0, steps 300.0](figures/dqn.png)" in text


def test_an_algorithm_and_an_activation_that_the_paper_has_not_get_rows_too(results):
    write_run(results / "sac", two(0, 1.5), algorithm="sac", activation="mish")
    text = report([results]).path.read_text()
    assert "\n## SAC\n" in text
    assert found(text, "mish", "all training episodes")[0][-1] == "1.500"
    assert found(text, "mish", "the paper") == []


def test_a_run_without_a_finished_episode_is_missing_in_every_reading(tmp_path):
    write_run(tmp_path / "run", rows(0, (1000, 10, 0, 0, 0, 0, -1.0, False, False)))
    assert len(found(report([tmp_path]).path.read_text(), "tanh", "all training episodes: missing")) == 2


def test_tables_of_nothing_still_hold_the_papers_4_rows():
    assert len(table([], "ppo", ratio_of_means=False)) == 1 + 2 * 4
    assert len(paper.TABLES) == 8


def test_it_imports_nothing_that_trains():
    forbidden = ["uavnav.ppo", "uavnav.dqn", "uavnav.learner", "uavnav.env", "uavnav.replay", "torchrl"]
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


def test_cells_of_other_settings_have_a_figure_of_their_own(tmp_path):
    write_run(tmp_path / "usual", two(0, -1.0))
    write_run(tmp_path / "again", two(0, -1.0), activation="relu")
    write_run(tmp_path / "other", two(0, -1.0), n_worlds=1)
    text = report([tmp_path]).path.read_text()
    assert "](figures/ppo.png)" in text or "](figures/dqn.png)" in text
    assert text.count("-other-settings.png)") == 1
    assert len(list(tmp_path.glob("figures/*-other-settings.png"))) == 1
    assert "Cells with other settings are in the second figure." in text
