"""The findings in sentences: words follow made-up numbers, each number is in the row that the sentence names."""

import functools

import numpy as np
import pandas as pd
import pytest
from tied import LINK, too_long, untied
from verdict_evidence import evidence, of_metric, of_paper_per_frame

from uavnav.report import findings, frames, headline
from uavnav.report.claims import CLAIMS, PRIMARY
from uavnav.report.findings import Sentence
from uavnav.report.studies import of_paper
from uavnav.report.verdicts import audit, grade, of_claim
from uavnav.runs import paper
from uavnav.runs.readings import ALL, LOG_CURVE, SAMPLED

NUMBERED = ["value", "low", "high", "n"]
LEAD = 0.0610  # PPO's over DQN in the paper's tables, reward per frame


def verdicts(ppo=(), dqn=(), spread=0.001):
    """Of cells with these rewards per frame, in the order tanh, sigmoid, ReLU, leaky ReLU; none: no runs."""
    found = evidence(of_metric("reward", ppo, dqn) if ppo else {}, spread=spread)
    audits = {PRIMARY: audit(found, of_paper_per_frame), ALL: audit(found, functools.partial(of_paper, reading=ALL))}
    return frames.verdicts(audits)


def numbers(**tables):
    """The report's tables with nothing in them, but for these."""
    empty = {
        "cells": [["main", *cell, 8, 1_000_000, 1] for cell in paper.TABLES],
        "effects": [],
        "worlds": [],
        "peaks": [],
        "gaps": [],
        "fits": [],
    }
    columns = {
        "cells": ["study", "algorithm", "activation", "seeds", "frames", "worlds"],
        "effects": ["switch", "algorithm", "frames", *NUMBERED],
        "worlds": ["measure", "algorithm", *NUMBERED],
        "peaks": ["cell", "measure", *NUMBERED],
        "gaps": headline.gaps({}, {}).columns,
        "fits": ["reading", "cell", "within", "numbers", "score"],
    }
    made = {
        name: tables[name]
        if isinstance(tables.get(name), pd.DataFrame)
        else pd.DataFrame(tables.get(name, rows), columns=columns[name])
        for name, rows in empty.items()
    }
    return made | {"verdicts": tables.get("verdicts", NO_RUNS)}


NO_RUNS = verdicts()


def said(**tables):
    """The findings, without how many claims replicate, which every verdict changes."""
    told = [str(one) for one in findings.findings(numbers(**tables))]
    return [one for one in told if not one.startswith("Of the paper's 11 claims, ")]


def flown(*rewards, rule=428.0):
    """Rewards of test flights of PPO's and DQN's cells, of the rule and of the gap's half width."""
    rows = [["reactive", "", "scripted", 10_000, 1, 200, 1.0, rule, np.nan, np.nan, 0.04, *[np.nan] * 4]]
    for who, mode, reward, half in rewards:
        gap = reward - rule
        own = [reward, reward - half, reward + half, 0.02, gap, gap - half, gap + half, 0.1]
        rows.append([who, who[:3].lower(), mode, 10_000, 20, 4000, 0.4, *own])
    return rows


# -- who is ahead ------------------------------------------------------------------------------------------------------


def test_ppo_is_ahead_by_half_of_the_papers_lead():
    first, *_ = said(verdicts=verdicts([LEAD / 2] * 4, [0.0] * 4))
    assert first.startswith("PPO leads DQN, by 50 % (49 to 51 %) of its lead in the paper.")


def test_dqn_ahead_is_ppo_behind():
    first, *_ = said(verdicts=verdicts([0.0] * 4, [LEAD] * 4))
    assert first.startswith("In the paper, PPO leads DQN; here it trails, by 100 % (99 to 101 %) of that lead.")


def test_equal_cells_are_less_than_half_of_the_papers_lead_where_many_seeds_agree_and_not_told_apart_where_few_do():
    first, *_ = said(verdicts=verdicts([0.0061] * 4, [0.0] * 4, spread=0.02))
    assert first == ("In the paper, PPO leads DQN; here by less than half of that: 10 % (−9 to 29 %).")
    first, *_ = said(verdicts=verdicts([0.0061] * 4, [0.0] * 4, spread=0.06))
    assert first == ("In the paper, PPO leads DQN; here not told apart: 10 % (−40 to 60 %) of that lead.")


def test_the_best_activation_of_each_algorithm_and_sigmoid_in_ppo_are_findings_of_their_own():
    ours = verdicts([0.02, 0.05, 0.02, 0.02], [-0.02, -0.01, -0.02, -0.02])
    _, tanh, sigmoid, others = said(verdicts=ours)
    assert tanh.startswith("In the paper, PPO with tanh leads PPO's best other activation; here it trails, by 413 % (")
    assert sigmoid.startswith("DQN with sigmoid leads DQN's best other activation, by 118 % (")
    assert others.startswith(
        "In the paper, the mean of PPO's other activations leads PPO with sigmoid; here it trails, by 442 % ("
    )


def test_without_runs_nothing_is_found():
    assert findings.findings(numbers()) == []


def test_the_first_finding_is_how_many_claims_replicate():
    """PPO's lead as in the paper, and four equal activations: rewards alone, so the other claims have no runs."""
    first = str(findings.findings(numbers(verdicts=verdicts([LEAD] * 4, [0.0] * 4)))[0])
    assert first == "Of the paper's 11 claims, 1 replicates and 5 do not."


# -- targets, times, readings, the rule, worlds ------------------------------------------------------------------------


TARGETS = "learning from one step than from 5"


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (
            0.05,
            f"In a side study of 5 seeds, DQN earns 50 (40 to 60) less reward in 1,000 frames {TARGETS}.",
        ),
        (
            -0.05,
            f"In a side study of 5 seeds, DQN earns 50 (40 to 60) more reward in 1,000 frames {TARGETS}.",
        ),
        (
            0.005,
            "DQN learning from one step or from 5 is not told apart: 5 (−5 to 15) of reward in 1,000 frames.",
        ),
    ],
)
def test_what_targets_of_one_step_cost(value, expected):
    rows = [["n_steps=5", "dqn", 300_032, value, value - 0.01, value + 0.01, 5]]
    assert said(effects=[["init=orthogonal", "dqn", 300_032, 1.0, 0.9, 1.1, 5], *rows]) == [expected]
    assert said(effects=[["n_steps=5", "dqn", 300_032, value, np.nan, np.nan, 1]]) == []


@pytest.mark.parametrize(
    ("lost", "expected"),
    [
        (0.6, "By the end, DQN with sigmoid has lost 60 % (50 to 70 %) of what it had gained."),
        (-0.6, "DQN with sigmoid gains on until the end, by 60 % (50 to 70 %) of what it had gained."),
        (0.05, "By the end, DQN with sigmoid is not seen to have lost: 5 % (−5 to 15 %) of what it had gained."),
    ],
)
def test_where_dqn_with_sigmoid_peaks_and_what_it_loses(lost, expected):
    rows = [["DQN tanh", "peak", 1.0, 0.0, 2.0, 8], ["DQN sigmoid", "peak", 450_100.0, 399_600.0, 500_400.0, 8]]
    rows.append(["DQN sigmoid", "lost", lost, lost - 0.1, lost + 0.1, 8])
    assert said(peaks=rows) == ["DQN with sigmoid earns most at frame 450,000 (400,000 to 500,000).", expected]


def test_the_reading_of_the_least_score_is_named_and_the_cells_that_fit_least():
    rows = [
        [SAMPLED, "all cells", 47, 48, 0.5],  # no reading of training
        [PRIMARY, "all cells", 45, 48, 2.5],  # more numbers, in wider intervals
        [LOG_CURVE, "all cells", 43, 48, 1.5],
        [LOG_CURVE, "DQN tanh", 2, 6, 1.5],
        [LOG_CURVE, "PPO leaky_relu", 2, 6, 1.5],
        [LOG_CURVE, "PPO relu", 6, 6, 1.5],
    ]
    assert said(fits=rows) == [
        "The paper's numbers look most like means of Stable-Baselines3's log: 43 of 48 lie where 95 % of our single"
        " seeds would.",
        "The worst fits are DQN with tanh and PPO with leaky ReLU: 2 of 6 each; this reading was chosen after the"
        " runs.",
    ]
    assert said(fits=[[PRIMARY, "all cells", 48, 48, 1.0], [PRIMARY, "PPO relu", 6, 6, 1.0]])[1:] == []
    assert said(fits=[[PRIMARY, "all cells", 5, 6, 1.0], [PRIMARY, "PPO relu", 5, 6, 1.0]]) == []  # of one cell


@pytest.mark.parametrize(
    ("reward", "opening", "number"),
    [
        (228.0, "A hand-written rule earns", "200 (150 to 250)"),
        (628.0, "The best sampled policy, PPO with sigmoid, earns", "200 (150 to 250)"),
        (
            448.0,
            "A hand-written rule and the best sampled policy, PPO with sigmoid, are not told apart",
            "20 (−30 to 70)",
        ),
    ],
)
def test_the_best_cell_beside_the_rule(reward, opening, number):
    rows = flown(
        ("PPO sigmoid", "sampled", reward, 50), ("DQN tanh", "sampled", 20.0, 9), ("PPO relu", "greedy", 999.0, 9)
    )
    (sentence,) = said(gaps=rows)
    assert sentence.startswith(opening)
    assert number in sentence
    assert said(gaps=rows[:1]) == []
    unpaired = pd.DataFrame(rows, columns=headline.gaps({}, {}).columns).assign(gap_low=np.nan, gap_high=np.nan)
    assert said(gaps=unpaired) == []


def test_many_worlds_are_a_finding_where_there_are_some_beside_one():
    rows = [
        ["many worlds", "ppo", 1_001_472, 0.012, 0.010, 0.014, 20],
        ["many worlds", "dqn", 10**6, 0.0, -0.001, 0.001, 20],
    ]
    assert [str(one) for one in findings.more_worlds(numbers(effects=rows))] == [
        "PPO earns 12.0 (10.0 to 14.0) more reward in 1,000 frames in many worlds a seed than in one.",
        "DQN in many worlds a seed is not told apart from DQN in one: 0.0 (−1.0 to 1.0) of reward in 1,000 frames.",
    ]


def of_worlds(sign):
    """PPO's rows of the table `worlds`, all above zero, below it, or across."""
    ends = {"scatter": (0.012, 0.0174, 0.022), "longest": (3e4, 41_234.0, 52_468.0)}
    ends |= {"open": (0.08, 0.12, 0.16), "order": (0.2, 0.8, 1.0)}
    return [
        [name, "ppo", (sign or 1) * value, *(sorted((sign * low, sign * high)) if sign else (-high, high)), 20]
        for name, (low, value, high) in ends.items()
    ]


@pytest.mark.parametrize(
    ("sign", "expected"),
    [
        (
            1,
            [
                "PPO's seeds scatter by 17 (12 to 22) more late reward in 1,000 frames in one world than in many.",
                "A PPO seed's longest open flight is 41,234 (30,000 to 52,468) steps longer in one world than in many.",
                "Flights open at the end hold 12 % (8 to 16 %) more of PPO's frames in one world than in many.",
                "PPO's activations keep nearly the same order in one world and many: ranks correlate by 0.80 (0.20 to"
                " 1.00).",
            ],
        ),
        (
            -1,
            [
                "PPO's seeds scatter by 17 (12 to 22) less late reward in 1,000 frames in one world than in many.",
                "A PPO seed's longest open flight is 41,234 (30,000 to 52,468) steps shorter in one world than in"
                " many.",
                "Flights open at the end hold 12 % (8 to 16 %) less of PPO's frames in one world than in many.",
                "PPO's activations turn their order round in many worlds: ranks anticorrelate by 0.80 (0.20 to 1.00).",
            ],
        ),
        (
            0,
            [
                "One world and many are not told apart in the scatter of PPO's seeds: 17 (−22 to 22) of late reward"
                " in 1,000 frames.",
                "One world and many are not told apart in the longest open flight of a PPO seed: 41,234 (−52,468 to"
                " 52,468) steps.",
                "One world and many are not told apart in the share of PPO's frames in open flights: 12 % (−16 to"
                " 16 %).",
                "It is open whether PPO's activations keep their order in one world and many: ranks correlate by 0.8"
                " (−1.0 to 1.0).",
            ],
        ),
    ],
)
def test_scatter_open_flights_and_order_are_findings_beside_the_mean(sign, expected):
    assert [str(one) for one in findings.more_worlds(numbers(worlds=of_worlds(sign)))] == expected


def test_the_study_is_said_with_its_seeds_frames_and_worlds():
    assert str(findings.study(numbers())) == (
        "Each cell (algorithm and activation) has 8 seeds of 1,000,000 frames, each seed in one world at a"
        " time, the default of Stable-Baselines3."
    )
    sizes = numbers()["cells"].assign(worlds=[64] * 4 + [16] * 4, seeds=1, frames=[1_000_000] * 4 + [1_001_472] * 4)
    assert str(findings.study(numbers(cells=sizes))) == (
        "Each cell (algorithm and activation) has 1 seed of 1,000,000 to 1,001,472 frames, each seed in 16 to 64"
        " parallel worlds (one is the default of Stable-Baselines3)."
    )


# -- tables of sentences -----------------------------------------------------------------------------------------------


def test_the_flights_are_the_rules_and_those_of_each_algorithms_best_cell_the_highest_reward_first():
    rows = flown(
        ("PPO sigmoid", "sampled", 228.0, 50),
        ("PPO relu", "sampled", 217.0, 40),
        ("PPO relu", "greedy", 500.0, 40),
        ("DQN leaky_relu", "sampled", 20.0, 9),
    )
    _, *shown = findings.flights(numbers(gaps=rows), "results/")
    assert [row[0] for row in shown] == [
        *("PPO with ReLU, greedy", "a hand-written rule (`reactive`)", "PPO with sigmoid, sampled"),
        "DQN with leaky ReLU, sampled",
    ]
    assert shown[1] == ["a hand-written rule (`reactive`)", "[428](results/tables/gaps.csv#L2)", "–", "100%"]
    assert shown[2][1:] == ["[228 (178 to 278)](results/tables/gaps.csv#L3)", "−200 (−250 to −150)", "40%"]
    assert findings.flights(numbers()) == [["test flights", "reward", "gap to the rule", "still flying at the limit"]]


def test_a_claims_sentence_says_more_or_less_and_so_for_the_paper():
    ours = numbers(verdicts=verdicts([0.02, 0.05, 0.02, 0.02], [-0.02, -0.01, -0.02, -0.02]))
    sentences = {claim.number: str(findings.of_claim(ours, claim)) for claim in CLAIMS}
    assert sentences[1].startswith("PPO earns 45.0 (44.")
    assert sentences[1].endswith(") more reward in 1,000 frames than DQN; in the paper, 61.1 more.")
    assert sentences[2].startswith("PPO with tanh earns 30.0 (")
    assert sentences[2].endswith(
        ") less reward in 1,000 frames than PPO's best other activation; in the paper, 7.3 more."
    )
    assert sentences[6].endswith(
        ") more reward in 1,000 frames than PPO's worst other activation; in the paper, 3.2 less."
    )
    assert sentences[9] == "No finished run."


def test_each_claim_has_a_row_with_its_bar_and_its_sentence():
    ours = verdicts([LEAD] * 4, [0.0] * 4)
    found = audit(evidence(of_metric("reward", [LEAD] * 4, [0.0] * 4), spread=0.001), of_paper_per_frame)
    grades = {claim.number: grade(of_claim(found, claim.number)) for claim in CLAIMS}
    _, first, *_, last = findings.claims(numbers(verdicts=ours), grades)
    assert first[:3] == ["1", CLAIMS[0].sentence, "▰▰ replicates"]
    assert last[2:] == ["– context", "No finished run."]


def test_the_papers_seven_contradictions_need_no_run_of_ours():
    _, *rows = findings.against_itself(numbers())
    assert [(number, text.partition(":")[0]) for number, text, _ in rows] == [
        *(("1", "speed"), ("1", "turning"), ("1", "speed"), ("2", "full stops"), ("2", "speed")),
        *(("7", "steps"), ("7", "distance")),
    ]
    assert [LINK.sub(r"\1", shown) for *_, shown in rows[:2]] == ["−0.35", "−0.74"]


# -- every number in its row -------------------------------------------------------------------------------------------

EXAMPLES = [
    numbers(
        verdicts=decided,
        effects=[
            ["n_steps=5", "dqn", 300_032, sign * 0.05, sign * 0.05 - 0.01, sign * 0.05 + 0.01, 5],
            ["many worlds", "ppo", 10**6, sign * 0.05, sign * 0.05 - 0.01, sign * 0.05 + 0.01, 5],
        ],
        worlds=of_worlds(sign),
        peaks=[
            ["DQN sigmoid", "peak", 450_100.0, 399_600.0, 500_400.0, 8],
            ["DQN sigmoid", "lost", sign * 0.6, sign * 0.6 - 0.1, sign * 0.6 + 0.1, 8],
        ],
        gaps=flown(("PPO leaky_relu", "sampled", 428 + 200.0 * sign, 50), ("DQN sigmoid", "greedy", -20.25, 9.5)),
        fits=[
            [reading, "all cells", 20, 48, 3.0],
            [reading, "DQN leaky_relu", 2, 6, 3.0],
            [reading, "PPO leaky_relu", 2, 6, 3.0],
        ],
    )
    for decided in (
        verdicts([0.02, 0.05, 0.02, 0.02], [-0.02, -0.01, -0.02, -0.02]),
        verdicts([0.05, 0.01, 0.02, 0.02], [0.02, 0.01, 0.02, 0.02]),
        verdicts([0.0061] * 4, [0.0] * 4, 0.02),
        verdicts([0.0061] * 4, [0.0] * 4, 0.06),
    )
    for reading in findings.READ_AS
    for sign in (-1, 0, 1)
]


def write(tables, folder):
    (folder / "tables").mkdir()
    for name, table in tables.items():
        table.to_csv(folder / "tables" / f"{name}.csv", index=False, float_format="%.6g")


def test_every_number_of_every_sentence_is_in_the_row_that_it_links_to_and_no_sentence_is_longer_than_25_words(
    tmp_path,
):
    for place, example in enumerate(EXAMPLES):
        folder = tmp_path / str(place)
        folder.mkdir()
        write(example, folder)
        told = [findings.study(example), *findings.findings(example), *findings.more_worlds(example)]
        told += [findings.of_claim(example, claim) for claim in CLAIMS]
        assert len(told) == 1 + 16 + len(CLAIMS)
        for one in told:
            assert untied(one.markdown(), folder) == [], str(one)
            assert too_long(one.markdown()) == []
        for row in [*findings.flights(example), *findings.against_itself(example)]:
            assert untied(" | ".join(row), folder) == []


def test_a_number_from_another_row_and_a_changed_one_are_found(tmp_path):
    example = EXAMPLES[0]
    write(example, tmp_path)
    first, second = findings.findings(example)[2:4]
    assert untied(first.markdown(), tmp_path) == []
    assert untied(first._replace(row=second.row).markdown(), tmp_path) != []
    changed = first._replace(number=f"9{first.number}")
    assert untied(changed.markdown(), tmp_path) != []
    assert untied(str(first), tmp_path) != []  # without its link
    assert untied("A link to [50](tables/effects.csv#L2) and 77 beside it.", tmp_path) == ["77"]
    assert too_long("word " * 25) == []
    assert too_long("word " * 26) != []


def test_a_sentence_is_plain_or_has_its_number_as_a_link():
    one = Sentence("It is ", "5", ".", "gaps", 0)
    assert str(one) == "It is 5."
    assert one.markdown("../results/") == "It is [5](../results/tables/gaps.csv#L2)."
    assert one._replace(row=None).markdown() == "It is [5](tables/gaps.csv)."
    assert one._replace(number="").markdown() == "It is ."
