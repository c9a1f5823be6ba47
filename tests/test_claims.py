"""The paper's claims, on made-up seeds whose verdicts are known."""

import functools
import itertools
import math

import numpy as np
import pytest
from verdict_evidence import EIGHT, evidence, nothing, of_metric, of_paper_per_frame, verdicts_of

from uavnav.report import claims
from uavnav.report.claims import (
    CLAIMS,
    COLUMNS,
    CONFIGURATIONS,
    DISCUSSION,
    EVERY,
    PAIR,
    PRINTED,
    RANKED,
    SCATTER,
    SIX,
    SLOPE,
    VARIATION,
    Claim,
    Part,
    Term,
    asked,
    at,
    slopes,
)
from uavnav.report.studies import of_paper
from uavnav.report.verdicts import AGAINST_ITSELF, DOES_NOT, NO_RUNS, OPEN, REPLICATES, audit, effects, grade
from uavnav.report.verdicts import of_claim as parts_of

pytestmark = pytest.mark.filterwarnings("error")

BY_NUMBER = {claim.number: claim for claim in CLAIMS}


def of_claim(number, means, paper=nothing, **options):
    return audit(evidence(means, **options), paper, [BY_NUMBER[number]])


def known(number, means, **options):
    """The findings that have seeds, by the metric that their text begins with."""
    return [finding for finding in of_claim(number, means, **options) if finding.n]


def test_claims_are_numbered_in_their_order_and_no_two_questions_of_a_claim_are_the_same():
    assert [claim.number for claim in CLAIMS] == list(range(1, len(CLAIMS) + 1))
    found = [(finding.claim, finding.text) for finding in audit(nothing, of_paper)]
    assert len({*found}) == len(found)


def test_training_and_its_log_are_not_asked_how_final_policies_fly_and_other_settings_are_asked_five_claims():
    training, log, final, other = (
        {claim.number: claim.parts for claim in asked(EVERY, column)} for column in COLUMNS
    )
    assert training == log
    assert {number for number, parts in final.items() if training.get(number) != parts} == {9, 10}
    assert {*other} == {1, 12, 13, 14, 15}


def test_the_part_that_a_sentence_is_about_is_one_that_its_column_asks():
    for claim in EVERY:
        parts = claim.asks(claim.column)
        assert claim.shown is None or not parts[claim.shown].beside or claim.number == 11


def test_the_eight_differences_that_the_paper_prints_are_above_zero_in_its_own_tables():
    for column in [*COLUMNS][:2]:
        printed = functools.partial(of_paper, definition=COLUMNS[column])
        own = [
            float(np.min(effects(EVERY[number - 1].asks(column)[place], printed)))
            for number, place in PRINTED.values()
        ]
        assert min(own) > 0
    assert own == pytest.approx([56.178, 36.783, 1.316, 1.669, 44.929, 24.191, 21.123, 1.187], abs=1e-3)


def test_every_question_says_by_itself_what_it_is_about():
    for finding in audit(nothing, of_paper):
        assert any(word in finding.text for word in ("PPO", "DQN", "1,000,000 steps")), finding.text


def test_the_weights_of_every_contrast_sum_to_zero_but_where_the_claim_says_how_many_times_or_hours():
    for part in (part for claim in CLAIMS for part in claim.parts):
        sums = np.sum(part.weights, axis=1)
        expected = [1, *[1 - 1.5] * 3] if "1.5 times" in part.text else [1] if "hours" in part.text else 0
        assert sums == pytest.approx(np.broadcast_to(expected, sums.shape))


def test_the_note_of_claim_2_is_what_the_papers_table_says():
    tanh, relu = (
        np.array([of_paper("ppo", one, metric)[0] for metric in ("steps", "distance")])
        for one in ("tanh", "relu")
    )
    steps, distance = tanh / relu
    assert (
        BY_NUMBER[2].note
        == f"In its own table the steps are {steps:.2f} and the distance {distance:.2f} times the "
        f"runner-up's."
    )


def against_itself(paper):
    means = {(*configuration, metric): 0.0 for configuration in CONFIGURATIONS for metric in SIX}
    return [
        (one.claim, one.text)
        for one in audit(evidence(means), paper)
        if one.standing == AGAINST_ITSELF and one.n
    ]


def test_the_papers_printed_tables_speak_against_seven_parts():
    """By hand: PPO's mean speed is 4.00 and DQN's 4.35; PPO's sigmoid turns in 60.7 % of its steps, DQN's in
    60.0, at 3.4 against 5.0 px a step; of PPO's configurations ReLU stops least (0.074 %), and leaky ReLU is
    fastest (4.269); DQN's ReLU and leaky ReLU fly 208 steps and 767 px, its tanh and sigmoid 185 and 724.
    """
    assert against_itself(of_paper) == [
        (1, "speed: PPO better than DQN, means of four activations"),
        (1, "turning: each PPO configuration better than each DQN configuration"),
        (1, "speed: each PPO configuration better than each DQN configuration"),
        (2, "full stops: PPO with tanh better than each other activation"),
        (2, "speed: PPO with tanh better than each other activation"),
        (7, "steps: DQN's tanh and sigmoid above its ReLU and leaky ReLU"),
        (7, "distance: DQN's tanh and sigmoid above its ReLU and leaky ReLU"),
    ]


def test_per_frame_two_of_these_hold_and_two_others_do_not():
    """By hand: distance / steps is 4.36 for PPO and 3.81 for DQN, 4.07 for DQN's tanh and 3.77 for its
    sigmoid, 4.69 for PPO's tanh; a frame of PPO's tanh earns 0.0325, which is 1.29 times the 0.0252 of ReLU.
    """
    printed, per_frame = against_itself(of_paper), against_itself(of_paper_per_frame)
    assert [one for one in per_frame if one not in printed] == [
        (2, "reward: PPO with tanh at least 1.5 times each other activation"),
        (3, "speed: DQN with sigmoid better than each other activation"),
    ]
    assert [one for one in printed if one not in per_frame] == [
        (1, "speed: PPO better than DQN, means of four activations"),
        (2, "speed: PPO with tanh better than each other activation"),
    ]


def test_the_papers_own_effects_of_some_parts():
    own = {(finding.claim, finding.text): finding.paper for finding in audit(nothing, of_paper)}
    per_frame = {
        (finding.claim, finding.text): finding.paper for finding in audit(nothing, of_paper_per_frame)
    }
    assert own[3, "full stops: DQN with sigmoid better than each other activation"] == pytest.approx(
        1.497 - 0.626
    )
    stops = "full stops: PPO's ReLU and leaky ReLU each below its tanh and its sigmoid"
    assert own[5, stops] == per_frame[5, stops] == pytest.approx(0.13 - 0.088)
    assert own[6, "speed: PPO with sigmoid worse than each other activation"] == pytest.approx(4.12 - 3.428)
    assert own[6, "steps: PPO with sigmoid above at least one other activation"] == pytest.approx(
        1538.434 - 1444.961
    )
    sigmoid = [
        (8, f"reward: {word} the mean of its three others")
        for word in ("DQN's sigmoid above", "PPO's sigmoid below")
    ]
    assert [own[one] for one in sigmoid] == pytest.approx([1.669, 24.191], abs=1e-3)
    assert per_frame[sigmoid[1]] == pytest.approx(
        (88.527 / 2727.577 + 43.598 / 1730.587 + 33.8 / 1444.961) / 3 - 31.117 / 1538.434
    )
    twice = "reward: PPO with tanh at least 1.5 times each other activation"
    assert own[2, twice] == pytest.approx(88.527 - 1.5 * 43.598)
    assert [value for (number, _), value in own.items() if number == 11] == [10]
    assert all(math.isnan(value) for (number, _), value in own.items() if number in (4, 9, 10))


YES, NO, OPEN_ = "replicates", "reverses", "open"


def of_each_metric():
    """Claims 1, 3 and 6 of each of the six metrics, and of the other way round."""
    for metric, one in SIX.items():
        sign, four = one.better, (10, 11, 12, 13)
        better = [20 * sign + value for value in four]
        yield 1, of_metric(metric, better, four), [(20, YES), (17, YES)]
        yield 1, of_metric(metric, four, better), [(-20, NO), (-23, NO)]
        yield 3, of_metric(metric, (), [sign * value for value in (1, 9, 5, 2)]), [(4, YES)]
        yield 3, of_metric(metric, (), [sign * value for value in (1, 3, 5, 2)]), [(-2, NO)]
        least, second = ([sign * value for value in values] for values in ((10, 2, 5, 6), (10, 6, 5, 7)))
        yield 6, of_metric(metric, least), [(-3, NO) if metric == "steps" else (3, YES)]
        yield 6, of_metric(metric, second), [(1, YES) if metric == "steps" else (-1, NO)]


def surge(before, between, after):
    times = {"before": before, "surge": between, "after": after}
    return {("dqn", "sigmoid", f"reward_{when}"): mean for when, mean in times.items()}


def corridors():
    ppo, dqn = (0.1, 0.1, 0.2, 0.2), (0.4, 0.4, 0.3, 0.3)
    means = of_metric("corridor", ppo, dqn) | of_metric("corridor_path", dqn, ppo)
    means |= of_metric("corridor_first", ppo, dqn) | of_metric("clearance", (90,) * 4, (60,) * 4)
    means |= of_metric("empty_clearance", (100,) * 4, (140,) * 4)
    return (
        means | of_metric("corridor_early", dqn, ppo) | of_metric("clearance_by_layout", (90,) * 4, (60,) * 4)
    )


def first_reward():
    """Under the first reward DQN is worse than in the shorter study, PPO better; the main study plays no
    part.
    """
    means = {}
    for metric, activation in itertools.product(("stops", "full_stops", "turns", "reversals"), PAIR):
        for algorithm, short in (("dqn", 30), ("ppo", 70)):
            key = (algorithm, activation, metric)
            means |= {(*key, "initial"): 50, (*key, "baseline"): short, key: 1e6}
    return means


PPO = (88, 31, 44, 34)
CASES = [
    *of_each_metric(),
    # means; the worst and the best
    (
        1,
        of_metric("reward", (100, 100, 100, 1), (0, 0, 0, 5)),
        [(74, YES), (-4, NO)],
    ),
    # about twice is 1.5 times each other, and a loss is never so many times another
    (2, of_metric("steps", (28, 10, 20, 5)), [(8, YES), (-2, NO)]),
    (2, of_metric("steps", (30, 10, 20, 5)), [(10, YES), (0, OPEN_)]),
    (2, of_metric("steps", (32, 10, 20, 5)), [(12, YES), (2, YES)]),
    (2, of_metric("steps", (80, 10, 20, 5)), [(60, YES), (50, YES)]),
    (2, of_metric("reward", (-40, -20, -30, -25)), [(-20, NO), (-40, NO)]),
    (2, of_metric("reward", (-10, -20, -30, -25)), [(10, YES), (-10, NO)]),
    # a rise, of which more than half is lost
    (4, surge(-5, 10, -2), [(15, YES), (12, YES), (4.5, YES)]),
    (4, surge(-5, 10, 8), [(15, YES), (2, YES), (-5.5, NO)]),
    (4, surge(-5, 10, 20), [(15, YES), (-10, NO), (-17.5, NO)]),
    (4, surge(10, 5, 4), [(-5, NO), (1, YES), (3.5, YES)]),
    (5, of_metric("full_stops", (4, 3, 1, 2)), [(1, YES)]),
    (5, of_metric("full_stops", (4, 1.5, 1, 2)), [(-0.5, NO)]),
    (5, of_metric("full_stops", (4, 2, 1, 2)), [(0, OPEN_)]),
    (7, of_metric("reward", (100, 30, 40, 44), (-5, -6, -9, -10)), [(23, YES), (4, YES), (12, YES)]),
    (7, of_metric("reward", (30, 60, 40, 44), (-5, -6, -3, -2)), [(3, YES), (-3, NO), (-18, NO)]),
    (8, of_metric("reward", PPO, (-7, -5, -9, -8)), [(3, YES), (24 + 1 / 3, YES), (2.5, YES), (20.5, YES)]),
    (9, corridors(), [(0.2, YES), (30, YES), (-40, NO), (-0.2, NO), (0.2, YES), (-0.2, NO), (30, YES)]),
    (10, first_reward(), [(-20, NO)] * 4 + [(20, YES)] * 4),
]


@pytest.mark.parametrize(("number", "means", "expected"), CASES)
def test_the_parts_of_a_claim_have_their_effects_in_the_claimed_direction(number, means, expected):
    found = known(number, means, spread=0.01 if number == 9 else 0.1)
    assert [finding.value for finding in found] == pytest.approx([value for value, _ in expected])
    assert verdicts_of(found) == [verdict for _, verdict in expected]


def test_the_worst_and_the_best_configurations_are_named():
    _, each = known(1, of_metric("reward", (100, 100, 100, 1), (0, 0, 0, 5)))
    assert each.nearest == "PPO leaky ReLU against DQN leaky ReLU"


@pytest.mark.parametrize(
    ("number", "means", "graded"),
    [
        (7, of_metric("reward", (100, 30, 40, 44), (-5, -6, -9, -10)), "in part (3 of 7)"),
        (7, of_metric("reward", (30, 60, 40, 44), (-5, -6, -3, -2)), "in part (1 of 7)"),
        (8, of_metric("reward", PPO, (-7, -5, -9, -8)), "replicates"),
        # another scale alone
        (
            8,
            of_metric("reward", PPO, [-20 + value / 50 for value in PPO]),
            "in part (1 of 2)",
        ),
        (9, corridors(), "in part (2 of 3)"),
        (10, first_reward(), "in part (4 of 8)"),
        (11, {(*configuration, "hours"): 0.1 for configuration in CONFIGURATIONS}, "context"),
        (11, {}, "context"),
    ],
)
def test_the_grade_of_a_claim_is_of_the_parts_that_count(number, means, graded):
    found = of_claim(number, means, spread=0.01)
    assert str(grade(found)) == graded
    assert all(
        finding.standing == "no part of the grade"
        for finding in found
        if number == 8 and "ReLU" in finding.text
    )


def test_claim_4_is_of_the_same_seeds_before_and_after_however_much_seeds_differ():
    """Every seed rises by 1 or a little more, seeds lie 100 apart: taken as independent no rise would be
    seen.
    """
    seeds, wobble = 100.0 * np.arange(8), 0.01 * np.arange(8)
    rewards = {"reward_before": seeds, "reward_surge": seeds + 1 + wobble, "reward_after": seeds + 0.25}

    def of_seeds(algorithm, activation, metric, study="main"):
        return (
            rewards.get(metric, np.empty(0)) if (algorithm, activation) == ("dqn", "sigmoid") else np.empty(0)
        )

    found = audit(of_seeds, nothing, [CLAIMS[3]])
    assert [finding.value for finding in found] == pytest.approx([1.035, 0.785, 0.785 - 1.035 / 2])
    assert verdicts_of(found) == ["replicates"] * 3


def test_claim_5_is_degenerate_where_an_activation_never_stops():
    stops = evidence(of_metric("full_stops", (4, 3, 1, 2)))

    def relu_never_stops(*term, study="main"):
        return 0 * stops(*term) if term[1] == "relu" else stops(*term)

    (found,) = audit(relu_never_stops, of_paper, [CLAIMS[4]])
    assert (found.verdict, found.standing, str(grade([found]))) == ("degenerate", "degenerate", "open")


def test_claim_10_is_not_asked_of_the_main_study():
    without = {key: mean for key, mean in first_reward().items() if key[-1] != "baseline"}
    assert {finding.n for finding in of_claim(10, without)} == {0}


def test_claim_11_is_our_hours_to_the_papers_ten():
    (found,) = of_claim(11, {(*configuration, "hours"): 0.1 for configuration in CONFIGURATIONS}, of_paper)
    assert (found.paper, found.value, found.ratio) == pytest.approx((10, 0.1, 0.01))


def test_one_line_adds_a_claim():
    terms = (Term("dqn", "tanh", "full_stops"), Term("dqn", "relu", "full_stops"))
    part = Part("full stops: DQN with tanh below ReLU", terms, ((-1.0, 1.0),))
    added = Claim(len(CLAIMS) + 1, "DQN with tanh stops less than with ReLU.", (part,))
    found = audit(evidence(of_metric("full_stops", (), (1, 5, 4, 5))), of_paper, [*CLAIMS, added])
    assert (found[-1].claim, found[-1].verdict) == (added.number, "replicates")
    assert (found[-1].paper, found[-1].value) == pytest.approx((3.881 - 1.497, 3))


# -- claims 12 to 16: a study as the paper says, the other way round, or in which nothing differs ------------

ORDER = {"sac": 2.0, "dqn": 1.0, "ppo": 0.0, "a2c": 0.0, "c51": 0.0}
"""How the paper has algorithms in dense, narrow and 3D places."""


def as_claimed(sign, without=()):
    """Evidence of the claims' truth (sign 1), of its reverse (-1), or of no difference (0); without: some
    studies.
    """

    def found(algorithm, activation, metric, study="main"):
        if study in without:
            return np.empty(0)
        noise = 0.1 * np.roll(EIGHT, sum(map(ord, algorithm + activation + metric + study)))
        if algorithm == RANKED:
            return -sign * 0.5 * (activation == RANKED) + noise * (activation == RANKED)
        if metric in (VARIATION, SCATTER):
            return 1.0 + sign * 0.5 * (activation == "relu") + noise
        return 5.0 + sign * ORDER[algorithm] + noise

    return found


def grades(evidence):
    findings = audit(evidence, nothing, DISCUSSION)
    return {claim.number: grade(parts_of(findings, claim.number)) for claim in DISCUSSION}


@pytest.mark.parametrize("number", range(12, 17))
def test_a_study_as_the_paper_says_replicates_its_claim_and_a_reversed_one_does_not(number):
    true, reversed_, none = (grades(as_claimed(sign))[number] for sign in (1, -1, 0))
    assert (true.name, true.replicating) == (REPLICATES, true.counting)
    assert (reversed_.name, reversed_.replicating) == (DOES_NOT, 0)
    assert none.name == OPEN
    assert true.counting == {12: 4, 13: 2, 14: 1, 15: 2, 16: 12}[number]


def test_tasks_without_evaluations_leave_their_claims_open_and_the_others_as_they_are():
    found = grades(as_claimed(1, without=("space", "space-moving")))
    assert {number: one.name for number, one in found.items() if one.name != REPLICATES} == {
        14: OPEN,
        15: OPEN,
    }
    findings = audit(as_claimed(1, without=("space",)), nothing, DISCUSSION)
    assert parts_of(findings, 14)[0].standing == NO_RUNS


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
        (0.0 if algorithm == "dqn" else 20.0 - rung)
        for rung in rungs
        for algorithm in ("dqn", "ppo")
        for _ in range(2)
    ]
    assert np.array(part.weights[0]) @ means == pytest.approx(1.0)  # PPO loses 1 an obstacle more than DQN
    assert part.beside


def test_the_parts_ask_the_rungs_that_the_claims_name():
    terms = {term for claim in DISCUSSION for part in claim.parts for term in part.terms}
    metrics = {term.metric for term in terms}
    assert {at("reward", "density", rung) for rung in (16, 18, 20)} | {SLOPE} <= metrics
    for name in claims.PASSAGES:
        assert {at(name, "slalom", gap) for gap in (100, 90, 80, 70)} <= metrics
    counted = [part.terms for part in DISCUSSION[1].parts if not part.beside]
    assert [{(term.metric, term.study) for term in terms} for terms in counted] == [
        {("passages_per_1000_steps at slalom 100", world)} for world in ("drone", "slalom-100")
    ]


def test_other_settings_are_asked_the_same_of_policies_of_the_preset():
    here, there = (claim_14.asks(column) for claim_14 in DISCUSSION[2:3] for column in [*COLUMNS][2:])
    assert [one.text for one in here] == [one.text for one in there]
    assert [{term.study for term in one.terms} for one in there] == [{"space, fast"}]
