"""What is committed of results: the report and the table of docs/decisions.md are what the rows of the runs say."""

import shutil
from pathlib import Path

import pytest

from uavnav import paper
from uavnav.metrics import last_episodes, per_seed
from uavnav.report import report
from uavnav.runs import Run

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "results"


def spread(values, digits):
    return f"{values.mean():,.{digits}f} ± {values.std():,.{digits}f}".replace("-", "−")


def row(algorithm, activation):
    """A cell's line of the table in docs/decisions.md."""
    run, printed = Run(RESULTS / algorithm / activation), paper.TABLES[algorithm, activation]
    everything, last = per_seed(run.episodes), per_seed(last_episodes(run.episodes))
    entries = [f"{algorithm.upper()} {activation}"]
    for name, digits in (("steps", 0), ("reward", 1)):
        entries.append(f"{printed[name]:,.{digits}f}".replace("-", "−"))
        entries += [spread(table[name], digits) for table in (everything, last)]
    return f"| {' | '.join(entries)} |"


@pytest.mark.parametrize(("algorithm", "activation"), paper.TABLES)
def test_each_row_of_the_decisions_is_what_the_run_says(algorithm, activation):
    assert row(algorithm, activation) in (ROOT / "docs" / "decisions.md").read_text().splitlines()


@pytest.mark.parametrize(("algorithm", "activation"), paper.TABLES)
def test_each_cell_has_three_seeds_of_a_million_frames_of_the_preset_and_was_evaluated_on_200_sets(
    algorithm, activation
):
    run = Run(RESULTS / algorithm / activation)
    assert run.seeds == [0, 1, 2]
    assert run.frames >= 1_000_000
    assert run.meta["beyond_preset"] == {}
    assert len(run.meta["git_commit"]) == 40  # and no + of changes that were not committed
    assert run.evaluation().groupby(["mode", "seed"]).layout.nunique().tolist() == [200] * 6


def test_the_committed_report_is_what_the_rows_give(tmp_path, monkeypatch):
    shutil.copytree(RESULTS, tmp_path / "results", ignore=shutil.ignore_patterns("report.md", "figures"))
    monkeypatch.chdir(tmp_path)
    assert report().path.read_text() == (RESULTS / "report.md").read_text()


def world_row(folder, algorithm):
    """A line of the table on parallel worlds: the first 300,000 frames of tanh."""
    run = Run(RESULTS / folder / algorithm / "tanh")
    episodes = run.episodes[run.episodes["frame"] <= 300_000]
    everything, last = per_seed(episodes), per_seed(last_episodes(episodes))
    entries = [f"{algorithm.upper()}, {run.config['n_worlds']}"]
    for name, digits in (("steps", 0), ("reward", 1)):
        entries += [spread(table[name], digits) for table in (everything, last)]
    return f"| {' | '.join(entries)} |"


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
@pytest.mark.parametrize("folder", [".", "one-world"])
def test_each_row_on_parallel_worlds_is_what_the_run_says(folder, algorithm):
    assert world_row(folder, algorithm) in (ROOT / "docs" / "decisions.md").read_text().splitlines()
