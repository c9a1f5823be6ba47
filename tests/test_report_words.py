"""What the report and the docs say in words: numbers, overviews, conclusions, docs/results.md, the
README's table.
"""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from runs_by_hand import found
from tied import first_screen, too_long

from uavnav.report import docs, evidence, frames
from uavnav.report.claims import CLAIMS, COLUMNS, LOG, PRIMARY, TRAINING
from uavnav.report.content import gather
from uavnav.report.page import markdown, page
from uavnav.report.studies import of_paper
from uavnav.report.tables import (
    LISTED,
    crossed,
    digits,
    listed,
    number,
    operating,
    predictions,
    said,
    with_interval,
)
from uavnav.report.verdicts import audit
from uavnav.runs.tables import RunError

pytestmark = pytest.mark.usefixtures("little_garbage", "undrawn")

BEGIN, END = "<!-- results -->", "<!-- end of results -->"


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


def test_a_table_of_a_frame_has_formats_by_header_and_leaves_unknown_intervals_out(monkeypatch):
    frame = pd.DataFrame(
        {"who": ["a", "b"], "x": [-1234.5, 0.0004], "low": [-2000.0, math.nan], "p": [0.5, math.nan]}
    )
    columns = {"who": "{who}", "x": "{x:.1f} [{low:.1f}, {high:.1f}]", "p": "{p:.0%}"}
    monkeypatch.setitem(LISTED, "mine", columns)
    assert listed(frame.assign(high=frame["low"]), "mine") == [
        ["who", "x", "p"],
        ["a", "−1,234.5 [−2,000.0, −2,000.0]", "50%"],
        ["b", "0.0004", "–"],
    ]


def test_a_crossed_table_has_a_row_and_a_column_a_value_in_order_and_dashes_where_nothing_is_known():
    frame = pd.DataFrame(
        [
            ("x", "ppo", 1.0, 0.0, 2.0, 9, "yes"),
            ("x", "dqn", 0.5, math.nan, math.nan, 5, ""),
            ("y", "dqn", 12.0, 1.0, 20.0, 7, ""),
        ],
        columns=["row", "algorithm", "value", "low", "high", "n", "flips"],
    )
    assert crossed(frame, "row", "algorithm", 1) == [
        ["row", "PPO", "DQN", "seeds"],
        ["x", "1.0 [0.0, 2.0] – flips", "0.5", "5"],
        ["y", "–", "12.0 [1.0, 20.0]", "7"],
    ]
    assert crossed(frame, "row", "algorithm", None, {"dqn": "its", "other": "no"})[:2] == [
        ["row", "its", "seeds"],
        ["x", "0.500", "5"],
    ]


def findings_of(*verdicts):
    """The first claims' parts have one verdict each, and all of them count; the other claims have no runs."""
    of = dict(enumerate(verdicts, start=1))
    found = audit(lambda *_, **__: np.empty(0), of_paper)
    return [
        one._replace(verdict=of[one.claim], standing="counts", n=8) if one.claim in of else one
        for one in found
    ]


def judged(content, *verdicts):
    """A report whose first claims have these verdicts in training; by the log the first one reverses."""
    audits = {column: [] for column in COLUMNS} | {
        TRAINING: findings_of(*verdicts),
        LOG: findings_of("reverses"),
    }
    tables = {"verdicts": frames.verdicts(audits), "grades": frames.grades(audits)}
    return replace(content, tables=content.tables | tables)


def test_the_table_of_claims_has_a_grade_a_column_and_a_dash_where_it_cannot_answer(gathered):
    rows = evidence.rows(judged(gathered, "replicates", "absent"))
    header, first, second, third, *_ = evidence.table(rows)
    assert header[2:] == [*COLUMNS]
    assert first[2:] == [
        "[replicates](tables/grades.csv#L2) 12/12, n\u00a0=\u00a08",
        "[does not](tables/grades.csv#L3) 0/12, n\u00a0=\u00a08",
        *("–", "–"),
    ]
    assert second[2:] == ["[does not](tables/grades.csv#L4) 0/9, n\u00a0=\u00a08", *["–"] * 3]
    assert third[2:] == ["–"] * 4


def test_a_part_says_why_it_does_not_count_and_how_many_seeds_it_would_take():
    part = findings_of("replicates")[0]._replace(n=8, to_detect=25.0, to_equal=60.0)
    for changes, expected in (
        ({}, "replicates"),
        ({"less_than_half": True}, "replicates, less than half"),
        ({"verdict": "open"}, "open (about 60 seeds would show absence)"),
        ({"verdict": "open", "to_equal": math.inf}, "open (more than 10,000 seeds would show absence)"),
        (
            {"standing": "the paper's effect is too small"},
            "the paper's effect is too small for n = 8 (about 25 seeds needed); ours: replicates",
        ),
        ({"standing": "the paper contradicts itself"}, "the paper contradicts itself; ours: replicates"),
        ({"standing": "degenerate", "verdict": "degenerate"}, "degenerate"),
        ({"standing": "too few seeds", "n": 3}, "open (n = 3, at least 5 seeds needed)"),
        ({"standing": "no runs"}, "no runs"),
    ):
        assert said(part._replace(**changes)._asdict()) == expected


def test_a_row_of_the_audit_has_ours_and_its_ratio_to_the_papers_with_intervals():
    known = {
        "paper": 4.0,
        "value": 2.0,
        "low": 1.0,
        "high": 3.0,
        "ratio": 0.5,
        "ratio_low": 0.25,
        "ratio_high": 0.75,
    }
    part = findings_of("replicates")[0]._replace(**known, n=8, p_holm=0.0123, nearest="A against B")
    assert listed(pd.DataFrame([part]), "verdicts")[1][1:] == [
        *("4.0", "2.0 [1.0, 3.0] (A against B)", "0.50 [0.25, 0.75]", "0.012", "8", "replicates")
    ]
    assert listed(pd.DataFrame([part._replace(p_holm=0.0001)]), "verdicts")[1][4] == "< 0.001"


@pytest.mark.parametrize(
    ("width", "expected"), [(250.0, 0), (20.0, 0), (2.0, 1), (0.2, 2), (0.003, 4), (1e-9, 6)]
)
def test_an_interval_is_shown_with_two_significant_digits(width, expected):
    assert digits({"value": width, "low": width, "high": 2 * width}) == expected


def test_rows_of_how_often_the_rule_errs_and_of_the_papers_numbers_as_one_more_seed():
    grades = ("replicates", "in part", "smaller", "does not", "open")
    shares = pd.DataFrame(
        [
            (claim, "no difference", grade, share, column)
            for claim, column in ((2, "one"), (1, "one"), (1, "other"))
            for grade, share in zip(grades, (0.001, 0.02, 0, 0.97, 0.009), strict=True)
        ],
        columns=["claim", "truth", "grade", "share", "column"],
    )
    assert operating(shares) == [
        ["", "column", "if the truth were", *grades],
        *(
            [claim, column, "no difference", "0.1%", "2.0%", "0.0%", "97.0%", "0.9%"]
            for claim, column in (("1", "one"), ("1", "other"), ("2", "one"))
        ),
    ]
    seeds = {("ppo", "tanh", "steps"): np.arange(2720.0, 2731.0)}
    found = frames.predictions({PRIMARY: lambda *term: seeds.get(term, np.empty(0))})
    tanh = next(row for row in predictions(found, PRIMARY) if row[0] == "PPO tanh")
    assert tanh[:3] == ["PPO tanh", "11", "2,727.6 [2,717.3, 2,732.7] within"]
    assert {*tanh[3:]} == {"–"}


def test_results_have_a_row_a_claim_and_the_readmes_block_has_none(gathered):
    content = judged(gathered, "replicates", "absent")
    text, short = docs.results(content), docs.block(content, "README.md")
    rows = {claim.number: found(text, str(claim.number), claim.sentence) for claim in CLAIMS}
    assert [len(row) for row in rows.values()] == [1] * len(CLAIMS)
    assert rows[1][0][0].startswith("[replicates](../results/tables/grades.csv#L2) 12/12")
    assert not any(claim.sentence in short for claim in CLAIMS)
    # of two configurations, one a claim's, there is no mean of four
    for one in (text, short):
        assert "**Not complete:** 2 of the paper's 8 configurations have finished; dqn sigmoid," in one
        assert found(one, "PPO ReLU")[0][0] == "43.6"
        assert too_long(one) == []
    assert docs.results(gathered) == docs.results(gathered)


def test_results_are_shorter_than_100_lines_and_leave_the_parts_of_claims_to_the_report(gathered):
    content = judged(gathered, "replicates", "absent")  # of the first two claims
    text, report = docs.results(content), markdown(content)
    assert text.count("\n") < 100
    for claim in CLAIMS[:2]:
        texts = [part.text for part in claim.asks(TRAINING)]
        assert all(one in report for one in texts)
        assert not any(one in text for one in texts)
    headings = re.findall(r"^## (.*)$", text, flags=re.MULTILINE)
    assert headings == ["The paper's claims", "More"]


def test_the_first_screen_of_the_page_has_no_sentence_of_more_than_25_words(gathered):
    text = page(gathered, {}, Path("results"))
    shown = first_screen(text)
    assert any(one.startswith("PPO outperforms DQN") for one in shown)
    assert [one for part in shown for one in too_long(part)] == []


@given(st.text(), st.text(), st.text(), st.text())
def test_between_marks_is_the_new_text_and_around_them_the_old(before, old, new, after):
    text = f"{before}{BEGIN}\n{old}\n{END}{after}"
    if not any(mark in part for mark in (BEGIN, END) for part in (before, old, new, after)):
        replaced = docs.between_marks(text, new)
        assert replaced == f"{before}{BEGIN}\n{new}\n{END}{after}"
        assert docs.between_marks(replaced, new) == replaced


MEASURED = """
|  | frames/s | 1 M frames | per seed | peak [GB] |
| --- | --: | --: | --: | --: |
| PPO, uavnav, 1 seed | 20,000 | 0:00:50 | 0:00:50 | 0.61 |
| PPO, uavnav, 10 seeds | 15,000 | 0:11:07 | 0:01:07 | 1.21 |
| PPO, uavnav, 10 seeds in 16 environments | 65,000 | 0:02:44 | 0:00:16 | 1.32 |
| PPO, SB3 | 1,800 | 0:09:00 | 0:09:00 | 0.45 |
| SAC, uavnav, 10 seeds in 64 environments | 9,000 | 0:20:00 | 0:02:00 | 2.5 |

|  | frames | must be | peak [GB] |
| --- | --: | --: | --: |
| SAC | 1,000,000 | 4: reached | 3.13 |
"""


def test_what_a_million_frames_of_ten_seeds_cost_is_taken_from_the_benchmarks(results):
    assert docs.costs(MEASURED) == {"ppo": ("0:02:44", "1.32"), "sac": ("0:20:00", "3.13")}
    assert docs.costs("") == {}
    content = gather([results], lambda configurations: {"configurations": [], "left_out": []})
    lines = docs.block(content, "docs/algorithms.md", MEASURED).splitlines()
    (ppo,), (c51,) = ([line for line in lines if line.startswith(f"| [{name}]")] for name in ("PPO", "C51"))
    assert " | 0:02:44 | 1.32 | – | – | " in ppo
    assert " | – | – | – | – | " in c51


@pytest.mark.parametrize("text", ["", "no marks", BEGIN, END, f"{END}\n{BEGIN}"])
def test_a_text_without_marks_is_refused(text):
    with pytest.raises(RunError, match=f"README.md: has no lines {BEGIN} and {END}; put"):
        docs.between_marks(text, "new")


def test_the_command_writes_the_conclusions_and_nothing_where_the_readme_has_no_marks(
    results, monkeypatch, capsys
):
    monkeypatch.chdir(results.parent)
    Path("docs").mkdir()
    Path("README.md").write_text("# Title\n")
    assert docs.main([]) == 2
    assert capsys.readouterr().err.startswith("uavnav.report.docs: README.md: has no lines")
    assert not Path("docs/results.md").exists()
    for marked in docs.BLOCKS:
        Path(marked).write_text(f"# Title\n{BEGIN}\nold\n{END}\nrest\n")
    Path("docs/benchmarks.md").write_text(MEASURED)
    assert docs.main(["results"]) == 0
    content = gather([Path("results")])
    assert Path("docs/results.md").read_text() == docs.results(content)
    for where in docs.BLOCKS:
        new = docs.block(content, where, MEASURED)
        assert Path(where).read_text() == f"# Title\n{BEGIN}\n{new}\n{END}\nrest\n"
    assert docs.main(["nowhere"]) == 2
