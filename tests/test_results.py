"""What is committed of results: report, conclusions and the tables of the docs are what the rows of the runs say."""

import io
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from uavnav.report.content import gather
from uavnav.report.docs import BEGIN, END, results, summary
from uavnav.report.page import markdown
from uavnav.runs import Run, paper
from uavnav.runs.metrics import last_episodes, per_seed

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "results"
FLOWN = "empty_"
"""Columns that come of flights at the time of the report: another machine rounds otherwise, and flights diverge."""


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
def test_each_cell_has_20_seeds_of_a_million_frames_of_the_preset_and_was_evaluated_on_200_sets(algorithm, activation):
    run = Run(RESULTS / algorithm / activation)
    assert run.seeds == list(range(20))
    assert run.frames >= 1_000_000
    assert run.meta["beyond_preset"] == {}
    assert len(run.meta["git_commit"]) == 40  # and no + of changes that were not committed
    assert run.evaluation().groupby(["mode", "seed"]).layout.nunique().tolist() == [200] * 40


def test_training_the_study_took_70_minutes_as_the_readme_says():
    took = sum(Run(RESULTS / algorithm / activation).meta["wall_seconds"] for algorithm, activation in paper.TABLES)
    assert took / 60 == pytest.approx(70, abs=1)
    assert "20 seeds each: 70 minutes of training on two cores" in (ROOT / "README.md").read_text()


def test_all_that_is_committed_of_results_takes_less_than_80_mb():
    assert sum(path.stat().st_size for path in RESULTS.rglob("*") if path.is_file()) < 80e6


@pytest.fixture(scope="module")
def content():
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(ROOT)
        patch.setattr("uavnav.report.figures.draw", lambda *anything: [])
        patch.setattr("uavnav.report.content.arena", flown_before)
        patch.setattr("uavnav.report.content.behaviour.overestimation", valued_before)
        patch.setattr("uavnav.report.content.replays.record", lambda cells: {"cells": [], "left_out": []})
        return gather([Path("results")])


def flown_before(crews):
    """The measures in the empty arena that were kept; no steps."""
    kept = pd.read_csv(RESULTS / "tables" / "behaviour.csv")
    found = {}
    for _, algorithm, activation in crews:
        own = kept[(kept.algorithm == algorithm) & (kept.activation == activation)].set_index(["mode", "seed"])
        found["main", algorithm, activation] = own.filter(like=FLOWN), pd.DataFrame()
    return found


def valued_before(run):
    kept = pd.read_csv(RESULTS / "tables" / "overestimation.csv")
    return kept[kept.cell == f"DQN {run.config['activation']}"].drop(columns="cell")


def from_rows(text):
    return [line for line in text.splitlines() if line and line[0] != "!"]


@pytest.mark.slow
def test_the_committed_report_is_what_the_rows_give(content):
    assert from_rows(markdown(content)) == from_rows((RESULTS / "report.md").read_text())


@pytest.mark.slow
def test_the_committed_conclusions_are_what_the_rows_give(content):
    assert from_rows(results(content)) == from_rows((ROOT / "docs" / "results.md").read_text())
    _, _, rest = (ROOT / "README.md").read_text().partition(BEGIN)
    assert from_rows(rest.partition(END)[0]) == from_rows(summary(content))


@pytest.mark.slow
def test_the_committed_tables_are_what_the_rows_give(content):
    for name, table in content.tables.items():
        committed = pd.read_csv(RESULTS / "tables" / f"{name}.csv")
        again = pd.read_csv(io.StringIO(table.to_csv(index=False, float_format="%.6g")))
        assert list(committed.columns) == list(again.columns)
        pd.testing.assert_frame_equal(committed, again, rtol=1e-5)
        numbers = again.select_dtypes(np.number)
        assert not numbers.empty or again.empty, name
