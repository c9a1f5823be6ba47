"""The hand-written prose: every block holds over the committed tables, and none is shown where it does
not.
"""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest
from tied import LINK, WORDS, too_long, untied
from verdict_evidence import evidence as seeds_around
from verdict_evidence import of_metric, of_paper_per_frame

from uavnav.report import evidence, frames, tables, whys
from uavnav.report.claims import CLAIMS, EVERY, TRAINING
from uavnav.report.page import FURTHER, SECTIONS, page
from uavnav.report.quotes import STUDY, Quotes, Untrue, block, prose
from uavnav.report.templating import inline, listed, plain
from uavnav.report.verdicts import audit
from uavnav.runs import paper

RESULTS = Path(__file__).parent.parent / "results"
BLOCKS = sorted(STUDY.blocks)


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
    for ends in (
        ("low", "high"),
        ("ratio_low", "ratio_high"),
        ("gap_low", "gap_high"),
        ("gain_low", "gain_high"),
    ):
        if {*ends} <= {*table.columns}:
            turned[[*ends]] = -table[[*reversed(ends)]].to_numpy()
    return turned


SOURCE = Path(STUDY.filename).read_text()
SIGNED = [
    name
    for name in BLOCKS
    if re.search(
        r"\"[+−]\"|self\.scripted_policy\(",
        re.search(rf"block {name} %}}(.*?)endblock", SOURCE, re.DOTALL)[1],
    )
]


@pytest.mark.parametrize("name", SIGNED)
def test_no_sentence_with_a_sign_holds_over_rows_of_the_other_sign(name, numbers):
    turned = Quotes({key: negated(table) for key, table in numbers.items()})
    with pytest.raises(Untrue):
        block(name, turned)


def test_all_but_a_few_claims_and_all_whys_have_a_sentence_with_a_sign():
    unsigned = {name for name in BLOCKS if name.startswith(("claim_", "why_"))} - {*SIGNED}
    assert unsigned == {"claim_2", "claim_5", "claim_11"}


def test_every_claim_question_and_section_has_its_sentence():
    assert {f"claim_{claim.number}" for claim in EVERY} <= {*BLOCKS}
    assert {f"why_{question.name}" for question in whys.QUESTIONS} <= {*BLOCKS}
    drawn = (path.stem.replace("-", "_") for path in (RESULTS / "figures").glob("*.svg"))
    assert {f"figure_{name}" for name in drawn} <= {*BLOCKS}
    usual = {f"of_{section}" for section in SECTIONS.keys() - FURTHER.keys()}
    assert usual - {*BLOCKS} == {"of_verdicts", "of_methods", "of_rows"}


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


@pytest.mark.parametrize("column", ["settings", "pair"])
def test_a_check_of_a_column_that_is_not_there_is_untrue_and_names_its_sentence(column, numbers):
    less = numbers | {"tuning_pairs": numbers["tuning_pairs"].drop(columns=column)}
    with pytest.raises(Untrue, match=rf"^tuned_pairs: .*'{column}'"):
        block("tuned_pairs", Quotes(less))
    assert prose(less)["tuned_pairs"] == ""


def test_a_claim_has_these_grades_in_its_columns_and_no_others(numbers):
    quotes = Quotes(numbers)
    assert quotes.grade(2, "does not", "does not", "open", "–") == ""
    for other in (("does not", "open", "open", "–"), ("does not", "does not", "open", "open")):
        with pytest.raises(Untrue):
            quotes.grade(2, *other)


def test_a_part_that_does_not_count_is_never_what_a_sentence_shows(numbers):
    quotes = Quotes(numbers)
    assert quotes.claim(1, "+").startswith("[")
    for number, text in (
        (6, "reward: PPO with sigmoid worse than each other activation"),  # too small for 40 seeds
        (3, "speed: DQN with sigmoid better than each other activation"),  # the paper contradicts itself
    ):
        with pytest.raises(Untrue, match="does not count"):
            quotes.claim(number, "", text=text)
    with pytest.raises(Untrue, match="no part"):
        quotes.claim(5, "")


def test_a_folder_of_a_few_runs_has_no_sentence_of_the_study(gathered, numbers):
    assert {*gathered.said.values()} == {""}
    text = page(gathered, {}, Path("results"))
    assert "<h1>DQN against PPO, four activation functions: what replicates of the paper</h1>" in text
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
    assert inline(line) == 'A <a href="#row-a-2">5 &lt; 6</a> &amp; <a href="c">b</a>.'
    assert plain(line) == "A 5 < 6 & b."
    marked = "**so [b](c)**, `a*b`, *very*, leaky_relu_2"
    assert inline(marked) == (
        '<strong>so <a href="c">b</a></strong>, <code>a*b</code>, <em>very</em>, leaky_relu_2'
    )
    assert plain(marked) == "so b, a*b, very, leaky_relu_2"
    assert inline("[a](javascript:b)") == "[a](javascript:b)"  # no address of a page
    assert listed("- a\n- b") == ["a", "b"]
    assert listed("") == []


def test_the_papers_seven_contradictions_need_no_run_of_ours(numbers):
    ours = seeds_around(of_metric("reward", [0.1] * 4, [0.0] * 4), spread=0.001)
    assert frames.verdicts({TRAINING: audit(ours, of_paper_per_frame)})["claim"].nunique() == len(CLAIMS)
    _, *rows = evidence.against_itself(numbers)
    assert [(number, text.partition(":")[0]) for number, text, _ in rows] == [
        *(("1", "speed"), ("1", "turning"), ("1", "speed"), ("2", "full stops"), ("2", "speed")),
        *(("7", "steps"), ("7", "distance")),
    ]
    assert [LINK.sub(r"\1", shown) for *_, shown in rows[:2]] == ["−0.35", "−0.74"]


def test_the_table_of_rewards_has_the_papers_ours_in_training_and_on_unseen_layouts_and_the_scripted_policys(
    numbers,
):
    header, *rows, rule = tables.rewards(numbers)
    assert header[1:] == ["the paper, 1 run", "training, SB3's log", "unseen layouts, sampled"]
    assert [row[0] for row in rows] == [
        f"{algorithm} {name}"
        for algorithm in ("PPO", "DQN")
        for name in ("tanh", "sigmoid", "ReLU", "leaky ReLU")
    ]
    shown = [LINK.sub(r"\1", cell) for cell in rows[0][1:]]
    assert shown == ["88.5", "69.2 [60.7, 78.7]", "155 [120, 190]"]
    assert [untied(" ".join(row[2:]), RESULTS) for row in (*rows, rule)] == [[]] * 9
    assert LINK.sub(r"\1", rule[-1]) == "428"
    nothing = {"metrics": numbers["metrics"][:0], "gaps": numbers["gaps"][:0]}
    assert [row[1:] for row in tables.rewards(nothing)[1:]][-2:] == [["−7.4", "–", "–"], ["–"] * 3]
