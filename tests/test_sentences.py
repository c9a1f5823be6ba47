"""The hand-written prose: every block holds over the committed tables, and none is shown where it does
not.
"""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest
from tied import LINK, too_long, untied
from verdict_evidence import evidence as seeds_around
from verdict_evidence import of_metric, of_paper_per_frame

from uavnav.report import evidence, frames, tables, whys
from uavnav.report.claims import CLAIMS, EVERY, PRIMARY
from uavnav.report.page import SECTIONS, linked, listed, page, plain, said
from uavnav.report.quotes import STUDY, Quotes, Untrue, block, prose
from uavnav.report.verdicts import audit
from uavnav.runs import paper

RESULTS = Path(__file__).parent.parent / "results"
BLOCKS = sorted(STUDY.blocks)
WORDS = {"5", "6", "8", "16", "20", "26", "48", "0.001", "0.03", "10,000", "300,000", "600,000", "100,000"}
"""Numbers of settings, and of how many there are, which no row holds."""


@pytest.fixture(scope="module")
def numbers():
    return {
        path.stem: pd.read_csv(path, keep_default_na=True) for path in (RESULTS / "tables").glob("*.csv")
    } | {"sensitivity": pd.read_csv(RESULTS / "tables" / "sensitivity.csv").fillna({"flips": ""})}


@pytest.mark.parametrize("name", BLOCKS)
def test_each_sentence_holds_over_the_committed_rows_and_each_of_its_numbers_is_in_a_row_that_it_links_to(
    name, numbers
):
    text = block(name, Quotes(numbers))
    assert untied(re.sub(r"\b[23]D\b", "", text), RESULTS, WORDS) == []
    assert too_long(text) == []


def negated(table):
    """With every effect on the other side of zero."""
    turned = table.copy()
    for ends in (("low", "high"), ("ratio_low", "ratio_high"), ("gap_low", "gap_high")):
        if {*ends} <= {*table.columns}:
            turned[[*ends]] = -table[[*reversed(ends)]].to_numpy()
    return turned


SOURCE = Path(STUDY.filename).read_text()
SIGNED = [
    name
    for name in BLOCKS
    if re.search(r"\"[+−]\"|self\.rule\(", re.search(rf"block {name} %}}(.*?)endblock", SOURCE, re.DOTALL)[1])
]


@pytest.mark.parametrize("name", SIGNED)
def test_no_sentence_with_a_sign_holds_over_rows_of_the_other_sign(name, numbers):
    turned = Quotes({key: negated(table) for key, table in numbers.items()})
    with pytest.raises(Untrue):
        block(name, turned)


def test_all_but_a_few_claims_and_all_whys_have_a_sentence_with_a_sign():
    unsigned = {name for name in BLOCKS if name.startswith(("claim_", "why_"))} - {*SIGNED}
    assert unsigned == {"claim_11"}


def test_every_claim_question_and_section_has_its_sentence():
    assert {f"claim_{claim.number}" for claim in EVERY} <= {*BLOCKS}
    assert {f"why_{question.name}" for question in whys.QUESTIONS} <= {*BLOCKS}
    assert {f"of_{section}" for section in SECTIONS} - {*BLOCKS} == {"of_verdicts", "of_methods"}


MADE = pd.DataFrame(
    [("a", 2.0, 1.0, 3.0), ("b", -0.02, -0.03, -0.01), ("c", 1.0, -1.0, 3.0), ("d", 5.0, None, None)],
    columns=["who", "value", "low", "high"],
)


@pytest.mark.parametrize(
    ("who", "sign", "more", "shown"),
    [
        ("a", "+", {}, "[2.0 (1.0 to 3.0)](tables/made.csv#L2)"),
        ("b", "−", {"times": 1000}, "[20 (10 to 30)](tables/made.csv#L3)"),
        ("b", "−", {"times": 100, "unit": " %"}, "[2 % (1 to 3 %)](tables/made.csv#L3)"),
        ("c", "0", {}, "[1.0 (−1.0 to 3.0)](tables/made.csv#L4)"),
        ("d", "", {"places": 0}, "[5](tables/made.csv#L5)"),
    ],
)
def test_a_quote_is_the_number_of_its_row_with_its_interval_and_a_link(who, sign, more, shown):
    quotes = Quotes({"made": MADE})
    assert quotes.quote("made", sign, who=who, **more) == shown
    for other in {"+", "−", "0"} - {sign}:
        with pytest.raises(Untrue):
            quotes.quote("made", other, who=who)


def test_a_quote_of_no_row_of_two_rows_and_of_no_table_is_untrue():
    quotes = Quotes({"made": pd.concat([MADE, MADE[:1]]), "empty": MADE[:0]})
    for name, who in (("made", "e"), ("made", "a"), ("empty", "a"), ("other", "a")):
        with pytest.raises(Untrue):
            quotes.quote(name, "+", who=who)
    with pytest.raises(Untrue):
        quotes.check(MADE["value"].max() == 2)


def test_claims_of_a_grade_are_these_and_no_others(numbers):
    quotes = Quotes(numbers)
    assert quotes.graded("does not", 2, 6, 12, 14, 15) == "5"
    with pytest.raises(Untrue):
        quotes.graded("does not", 2, 6)


def test_a_folder_of_a_few_runs_has_no_sentence_of_the_study(gathered, numbers):
    assert {*said(gathered).values()} == {""}
    text = page(gathered, {}, Path("results"))
    assert "<h1>DQN against PPO, four activation functions: what holds of the paper</h1>" in text
    for name, words in prose(numbers).items():
        for line in listed(words):
            assert plain(line) not in text, name
    empty = {name: table[:0] for name, table in numbers.items()}
    assert {*prose(empty).values()} == {*prose({}).values()} == {""}


def test_the_prose_is_of_the_study_that_answers_for_the_paper_alone_whose_runs_name_it(gathered):
    for study, answers in (("paper", True), ("vectorised", False), ("", False)):
        main = {key: SimpleNamespace(study=study) for key in paper.TABLES}
        whole = replace(gathered, studies=gathered.studies._replace(main=main))
        assert whole.of_the_study == answers
        less = replace(gathered, studies=gathered.studies._replace(main=dict([*main.items()][1:])))
        assert not less.of_the_study


def test_a_line_of_markdown_has_its_links_on_a_page_and_nothing_else_of_it_is_html():
    line = "A [5 < 6](tables/a.csv#L2) & [b](c)."
    assert linked(line) == 'A <a href="tables/a.csv#L2">5 &lt; 6</a> &amp; <a href="c">b</a>.'
    assert plain(line) == "A 5 < 6 & b."
    assert listed("- a\n- b") == ["a", "b"]
    assert listed("") == []


def test_the_papers_seven_contradictions_need_no_run_of_ours(numbers):
    ours = seeds_around(of_metric("reward", [0.1] * 4, [0.0] * 4), spread=0.001)
    assert frames.verdicts({PRIMARY: audit(ours, of_paper_per_frame)})["claim"].nunique() == len(CLAIMS)
    _, *rows = evidence.against_itself(numbers)
    assert [(number, text.partition(":")[0]) for number, text, _ in rows] == [
        *(("1", "speed"), ("1", "turning"), ("1", "speed"), ("2", "full stops"), ("2", "speed")),
        *(("7", "steps"), ("7", "distance")),
    ]
    assert [LINK.sub(r"\1", shown) for *_, shown in rows[:2]] == ["−0.35", "−0.74"]


def test_episodes_are_the_rules_and_those_of_each_algorithms_best_configuration_the_highest_reward_first():
    columns = frames.gaps({}, {}).columns
    rows = [["reactive", "", "scripted", 10_000, 1, 200, 1.0, 428.0, None, None, 0.04, *[None] * 4]]
    for who, mode, reward, half in (
        ("PPO sigmoid", "sampled", 228.0, 50),
        ("PPO relu", "sampled", 217.0, 40),
        ("PPO relu", "greedy", 500.0, 40),
        ("DQN leaky_relu", "sampled", 20.0, 9),
    ):
        gap = reward - 428.0
        own = [reward, reward - half, reward + half, 0.02, gap, gap - half, gap + half, 0.1]
        rows.append([who, who[:3].lower(), mode, 10_000, 20, 4000, 0.4, *own])
    _, *shown = tables.episodes(pd.DataFrame(rows, columns=columns), "results/")
    assert [row[0] for row in shown] == [
        *("PPO with ReLU, greedy", "a scripted policy (`reactive`)", "PPO with sigmoid, sampled"),
        "DQN with leaky ReLU, sampled",
    ]
    assert shown[1] == ["a scripted policy (`reactive`)", "[428](results/tables/gaps.csv#L2)", "–", "100%"]
    assert shown[2][1:] == ["[228 (178 to 278)](results/tables/gaps.csv#L3)", "−200 (−250 to −150)", "40%"]
    nothing = tables.episodes(pd.DataFrame(columns=columns))
    assert nothing == [["test episodes", "reward", "gap to the rule", "still flying at the limit"]]
