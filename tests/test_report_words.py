"""What the report and the docs say in words: numbers, overviews, conclusions, docs/results.md, the README's table."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from runs_by_hand import found

from uavnav.report import conclusions, docs
from uavnav.report.claims import CLAIMS, PRIMARY
from uavnav.report.content import gather
from uavnav.report.studies import of_paper
from uavnav.report.tables import audit_rows, number, overview, with_interval
from uavnav.report.verdicts import audit
from uavnav.runs.tables import RunError

pytestmark = pytest.mark.usefixtures("little_garbage", "undrawn")

BEGIN, END = docs.BEGIN, docs.END


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
    audits = {PRIMARY: findings_of("supported", "contradicted"), "second": other}
    header, first, second, third, *_ = overview(audits)
    assert header[-1] == "second"
    assert first[2:] == ["supported", "12, 0, 0", "contradicted"]
    assert second[2:] == ["contradicted", "0, 9, 0", "–"]  # of which that reading has no runs
    assert third[2:] == ["undecided", "0, 0, 6", "–"]


def test_a_part_that_a_test_decides_shows_its_p_where_an_interval_would_be():
    (part,) = [one for one in findings_of() if one.claim == 8]
    shown = [audit_rows([part._replace(value=2.0, n=8, p_holm=p)])[1][2] for p in (0.0123, 0.0001, math.nan)]
    assert [one.partition(" ")[2] for one in shown] == ["(p = 0.012)", "(p < 0.001)", ""]


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


def judged(content, *verdicts):
    """A report whose first claims have these verdicts."""
    return replace(content, audits=content.audits | {PRIMARY: findings_of(*verdicts)})


def test_results_put_every_claim_under_its_verdict_with_its_parts(gathered):
    mixed = judged(gathered, "supported", "contradicted")
    text = docs.results(mixed)
    holds, rest = text.split("## What holds\n")[1].split("## What does not\n")
    fails, open_ = rest.split("## What cannot be known from this\n")
    assert re.findall(r"^\*\*(\d+)\.", holds, re.MULTILINE) == ["1"]
    assert re.findall(r"^\*\*(\d+)\.", fails, re.MULTILINE) == ["2"]
    assert re.findall(r"^\*\*(\d+)\.", open_, re.MULTILINE) == [str(place) for place in range(3, len(CLAIMS) + 1)]
    assert len(found(holds, "reward per episode: PPO better than DQN, means of four activations")) == 1
    assert conclusions.lead(mixed.findings) in text
    assert docs.results(mixed) == text
    assert docs.results(judged(gathered)).count("No claim.") == 2


def test_the_readmes_block_has_a_row_a_claim(gathered):
    text = docs.summary(gathered)
    assert conclusions.lead(gathered.findings) in text
    assert "1 to 2 seeds a cell" in text
    for claim in CLAIMS:
        ((verdict, by),) = found(text, str(claim.number), claim.sentence)
        assert verdict == "undecided"
        assert by.endswith(("no runs", "n = 1", "n = 2"))
    assert "**Not complete:** no finished run of dqn sigmoid," in text
    assert "**Not complete:** no finished run of dqn sigmoid," in docs.results(gathered)


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
    content = gather([Path("results")])
    assert Path("docs/results.md").read_text() == docs.results(content)
    assert Path("README.md").read_text() == f"# Title\n{BEGIN}\n{docs.summary(content)}\n{END}\nrest\n"
    assert docs.main(["nowhere"]) == 2
