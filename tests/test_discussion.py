"""Claims 12 to 16 on made-up seeds: a study that is as the paper says, one that is the other way round, one in which
nothing differs."""

import numpy as np
import pytest
from verdict_evidence import EIGHT

from uavnav.report import discussion
from uavnav.report.discussion import CELLS, DISCUSSION, SCATTER, SLOPE, VARIATION, at, nothing_printed, slopes
from uavnav.report.verdicts import DOES_NOT, NO_RUNS, OPEN, REPLICATES, audit, grade, of_claim

ORDER = {"sac": 2.0, "dqn": 1.0, "ppo": 0.0, "a2c": 0.0, "c51": 0.0}
"""How the paper has algorithms in dense, narrow and 3D places."""


def as_claimed(sign, without=()):
    """Evidence of the claims' truth (sign 1), of its reverse (-1), or of no difference (0); without: some studies."""

    def found(algorithm, activation, metric, study="main"):
        if study in without:
            return np.empty(0)
        noise = 0.1 * np.roll(EIGHT, sum(map(ord, algorithm + activation + metric + study)))
        if algorithm == CELLS:
            return -sign * 0.5 * (activation == CELLS) + noise * (activation == CELLS)
        if metric in (VARIATION, SCATTER):
            return 1.0 + sign * 0.5 * (activation == "relu") + noise
        return 5.0 + sign * ORDER[algorithm] + noise

    return found


def grades(evidence):
    findings = audit(evidence, nothing_printed, DISCUSSION)
    return {claim.number: grade(of_claim(findings, claim.number)) for claim in DISCUSSION}


@pytest.mark.parametrize("number", range(12, 17))
def test_a_study_as_the_paper_says_replicates_its_claim_and_a_reversed_one_does_not(number):
    true, reversed_, none = (grades(as_claimed(sign))[number] for sign in (1, -1, 0))
    assert (true.name, true.replicating) == (REPLICATES, true.counting)
    assert (reversed_.name, reversed_.replicating) == (DOES_NOT, 0)
    assert none.name == OPEN
    assert true.counting == {12: 4, 13: 16, 14: 1, 15: 2, 16: 12}[number]


def test_worlds_that_nobody_has_flown_leave_their_claims_open_and_the_others_as_they_are():
    found = grades(as_claimed(1, without=("space", "space-moving")))
    assert {number: one.name for number, one in found.items() if one.name != REPLICATES} == {14: OPEN, 15: OPEN}
    findings = audit(as_claimed(1, without=("space",)), nothing_printed, DISCUSSION)
    assert of_claim(findings, 14)[0].standing == NO_RUNS


def test_half_of_claim_15_is_replicated_in_part():
    def found(algorithm, activation, metric, study="main"):
        order = {"sac": 2.0, "dqn": 0.0, "ppo": 1.0}
        return order.get(algorithm, 0) + as_claimed(0)(algorithm, activation, metric, study)

    assert str(grades(found)[15]) == "in part (1 of 2)"


def test_slopes_are_those_of_least_squares_and_the_one_of_own_rungs_is_of_ppo_minus_dqn():
    rungs = (0, 4, 8, 16, 20)
    values = np.array([3.0, 1.0, 4.0, 1.0, 5.0])
    assert slopes(rungs) @ values == pytest.approx(np.polyfit(rungs, values, 1)[0])
    (part,) = [part for part in DISCUSSION[0].parts if "trained among" in part.text]
    means = [
        (0.0 if algorithm == "dqn" else 20.0 - rung) for rung in rungs for algorithm in ("dqn", "ppo") for _ in range(2)
    ]
    assert np.array(part.weights[0]) @ means == pytest.approx(1.0)  # PPO loses 1 an obstacle more than DQN
    assert part.beside


def test_the_parts_ask_the_rungs_that_the_claims_name():
    terms = {term for claim in DISCUSSION for part in claim.parts for term in part.terms}
    metrics = {term.metric for term in terms}
    assert {at("reward", "density", rung) for rung in (16, 18, 20)} | {SLOPE} <= metrics
    for name in discussion.PASSAGES:
        assert {at(name, "slalom", gap) for gap in (100, 90, 80, 70)} <= metrics
    counted = {term for claim in DISCUSSION for part in claim.parts if not part.beside for term in part.terms}
    assert {term.study for term in counted if " at slalom" in term.metric} == {"drone", "slalom-100"}
