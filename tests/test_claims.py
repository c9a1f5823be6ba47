"""The paper's claims, on made-up seeds whose verdicts are known."""

import itertools
import math

import numpy as np
import pytest
from verdict_evidence import evidence, nothing, of_metric, of_paper_per_frame, verdicts_of

from uavnav.report import claims
from uavnav.report.claims import ALGORITHMS, CELLS, CLAIMS, SIX, Claim, Part, Term
from uavnav.report.studies import of_paper
from uavnav.report.verdicts import AGAINST_ITSELF, audit, grade

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


def test_claims_ask_12_9_6_3_1_6_7_4_8_6_and_1_questions():
    assert [len(claim.parts) for claim in CLAIMS] == [12, 9, 6, 3, 1, 6, 7, 4, 8, 6, 1]


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
        np.array([of_paper("ppo", one, metric)[0] for metric in ("steps", "distance")]) for one in ("tanh", "relu")
    )
    steps, distance = tanh / relu
    assert (
        BY_NUMBER[2].note
        == f"In its own table the steps are {steps:.2f} and the distance {distance:.2f} times the runner-up's."
    )


def against_itself(paper):
    means = {(*cell, metric): 0.0 for cell in CELLS for metric in SIX}
    return [(one.claim, one.text) for one in audit(evidence(means), paper) if one.standing == AGAINST_ITSELF and one.n]


def test_the_papers_printed_tables_speak_against_seven_parts():
    """By hand: PPO's mean speed is 4.00 and DQN's 4.35; PPO's sigmoid turns in 60.7 % of its steps, DQN's in 60.0, at
    3.4 against 5.0 px a step; of PPO's cells ReLU stops least (0.074 %), and leaky ReLU is fastest (4.269); DQN's ReLU
    and leaky ReLU fly 208 steps and 767 px, its tanh and sigmoid 185 and 724."""
    assert against_itself(of_paper) == [
        (1, "speed: PPO better than DQN, means of four activations"),
        (1, "turning: each PPO cell better than each DQN cell"),
        (1, "speed: each PPO cell better than each DQN cell"),
        (2, "full stops: PPO with tanh better than each other activation"),
        (2, "speed: PPO with tanh better than each other activation"),
        (7, "steps: DQN's tanh and sigmoid above its ReLU and leaky ReLU"),
        (7, "distance: DQN's tanh and sigmoid above its ReLU and leaky ReLU"),
    ]


def test_per_frame_two_of_these_hold_and_two_others_do_not():
    """By hand: distance / steps is 4.36 for PPO and 3.81 for DQN, 4.07 for DQN's tanh and 3.77 for its sigmoid, 4.69
    for PPO's tanh; a frame of PPO's tanh earns 0.0325, which is 1.29 times the 0.0252 of ReLU."""
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
    per_frame = {(finding.claim, finding.text): finding.paper for finding in audit(nothing, of_paper_per_frame)}
    assert own[3, "full stops: DQN with sigmoid better than each other activation"] == pytest.approx(1.497 - 0.626)
    stops = "full stops: PPO's ReLU and leaky ReLU each below its tanh and its sigmoid"
    assert own[5, stops] == per_frame[5, stops] == pytest.approx(0.13 - 0.088)
    assert own[6, "speed: PPO with sigmoid worse than each other activation"] == pytest.approx(4.12 - 3.428)
    assert own[6, "steps: PPO with sigmoid above at least one other activation"] == pytest.approx(1538.434 - 1444.961)
    sigmoid = [
        (8, f"reward: {word} the mean of its three others") for word in ("DQN's sigmoid above", "PPO's sigmoid below")
    ]
    assert [own[one] for one in sigmoid] == pytest.approx([1.669, 24.191], abs=1e-3)
    assert per_frame[sigmoid[1]] == pytest.approx(
        (88.527 / 2727.577 + 43.598 / 1730.587 + 33.8 / 1444.961) / 3 - 31.117 / 1538.434
    )
    twice = "reward: PPO with tanh at least 1.5 times each other activation"
    assert own[2, twice] == pytest.approx(88.527 - 1.5 * 43.598)
    assert [value for (number, _), value in own.items() if number == 11] == [10]
    assert all(math.isnan(value) for (number, _), value in own.items() if number in (4, 9, 10))


@pytest.mark.parametrize("metric", SIX)
def test_claim_1_of_means_and_of_every_ppo_cell_against_every_dqn_cell(metric):
    sign = SIX[metric].better
    better = [20 * sign + value for value in (10, 11, 12, 13)]
    mean, each = known(1, of_metric(metric, better, (10, 11, 12, 13)))
    assert (mean.verdict, each.verdict) == ("replicates", "replicates")
    assert (mean.value, each.value) == pytest.approx((20, 17))
    mean, each = known(1, of_metric(metric, (10, 11, 12, 13), better))
    assert (mean.value, each.value) == pytest.approx((-20, -23))
    assert (mean.verdict, each.verdict) == ("reverses", "reverses")


def test_claim_1_may_hold_of_means_while_the_worst_loses_to_the_best():
    mean, each = known(1, of_metric("reward", (100, 100, 100, 1), (0, 0, 0, 5)))
    assert (mean.verdict, mean.value) == ("replicates", pytest.approx(74))
    assert (each.verdict, each.value, each.nearest) == (
        "reverses",
        pytest.approx(-4),
        "PPO leaky ReLU against DQN leaky ReLU",
    )


@pytest.mark.parametrize(("tanh", "expected"), [(28, "reverses"), (30, "open"), (32, "replicates"), (80, "replicates")])
def test_claim_2_about_twice_is_1_5_times_each_other(tanh, expected):
    best, twice = known(2, of_metric("steps", (tanh, 10, 20, 5)))
    assert (best.verdict, best.value) == ("replicates", pytest.approx(tanh - 20))
    assert (twice.verdict, twice.value) == (expected, pytest.approx(tanh - 30))


@pytest.mark.parametrize("rewards", [(-40, -20, -30, -25), (-10, -20, -30, -25)])
def test_claim_2_a_loss_is_never_so_many_times_another(rewards):
    assert known(2, of_metric("reward", rewards))[1].verdict == "reverses"


@pytest.mark.parametrize("metric", SIX)
def test_claim_3_of_dqns_sigmoid(metric):
    sign = SIX[metric].better
    for sigmoid, value, expected in ((sign * 9, 4, "replicates"), (sign * 3, -2, "reverses")):
        (own,) = known(3, of_metric(metric, (), [sign * 1, sigmoid, sign * 5, sign * 2]))
        assert (own.value, own.verdict) == (pytest.approx(value), expected)


@pytest.mark.parametrize(
    ("means", "values", "expected"),
    [
        ((-5, 10, -2), (15, 12, 12 - 7.5), ["replicates", "replicates", "replicates"]),
        ((-5, 10, 8), (15, 2, 2 - 7.5), ["replicates", "replicates", "reverses"]),
        ((-5, 10, 20), (15, -10, -17.5), ["replicates", "reverses", "reverses"]),
        ((10, 5, 4), (-5, 1, 1 + 2.5), ["reverses", "replicates", "replicates"]),
    ],
)
def test_claim_4_rises_and_loses_more_than_half_of_the_rise(means, values, expected):
    rewards = {
        ("dqn", "sigmoid", f"reward_{when}"): m for when, m in zip(("before", "surge", "after"), means, strict=True)
    }
    found = of_claim(4, rewards)
    assert [finding.value for finding in found] == pytest.approx(values)
    assert verdicts_of(found) == expected


def test_claim_4_is_of_the_same_seeds_before_and_after_however_much_seeds_differ():
    """Every seed rises by 1 or a little more, seeds lie 100 apart: taken as independent no rise would be seen."""
    seeds, wobble = 100.0 * np.arange(8), 0.01 * np.arange(8)
    rewards = {"reward_before": seeds, "reward_surge": seeds + 1 + wobble, "reward_after": seeds + 0.25}

    def of_seeds(algorithm, activation, metric, study="main"):
        return rewards.get(metric, np.empty(0)) if (algorithm, activation) == ("dqn", "sigmoid") else np.empty(0)

    found = audit(of_seeds, nothing, [CLAIMS[3]])
    assert [finding.value for finding in found] == pytest.approx([1.035, 0.785, 0.785 - 1.035 / 2])
    assert verdicts_of(found) == ["replicates"] * 3


@pytest.mark.parametrize(
    ("stops", "value", "expected"),
    [((4, 3, 1, 2), 1, "replicates"), ((4, 1.5, 1, 2), -0.5, "reverses"), ((4, 2, 1, 2), 0, "open")],
)
def test_claim_5_each_of_two_against_each_of_the_others(stops, value, expected):
    (found,) = of_claim(5, of_metric("full_stops", stops))
    assert (found.value, found.verdict) == (pytest.approx(value), expected)


def test_claim_5_is_degenerate_where_an_activation_never_stops():
    stops = evidence(of_metric("full_stops", (4, 3, 1, 2)))

    def relu_never_stops(*term, study="main"):
        return 0 * stops(*term) if term[1] == "relu" else stops(*term)

    (found,) = audit(relu_never_stops, of_paper, [CLAIMS[4]])
    assert (found.verdict, found.standing, str(grade([found]))) == ("degenerate", "degenerate", "open")


@pytest.mark.parametrize("metric", SIX)
def test_claim_6_sigmoid_is_below_each_other_except_in_steps(metric):
    sign = SIX[metric].better
    (found,) = known(6, of_metric(metric, [sign * one for one in (10, 2, 5, 6)]))
    expected = (-3, "reverses") if metric == "steps" else (3, "replicates")
    assert (found.value, found.verdict) == (pytest.approx(expected[0]), expected[1])
    (found,) = known(6, of_metric(metric, [sign * one for one in (10, 6, 5, 7)]))
    expected = (1, "replicates") if metric == "steps" else (-1, "reverses")
    assert (found.value, found.verdict) == (pytest.approx(expected[0]), expected[1])


def test_claim_7_bounded_above_unbounded_and_sigmoid_behind():
    found = known(7, of_metric("reward", (100, 30, 40, 44), (-5, -6, -9, -10)))
    assert [finding.value for finding in found] == pytest.approx([65 - 42, -5.5 + 9.5, 42 - 30])
    assert str(grade(found)) == "replicates"
    found = known(7, of_metric("reward", (30, 60, 40, 44), (-5, -6, -3, -2)))
    assert verdicts_of(found) == ["replicates", "reverses", "reverses"]
    assert str(grade(found)) == "in part (1 of 3)"


def test_claim_8_sigmoid_is_ahead_in_dqn_and_behind_in_ppo_and_families_stand_beside_it():
    found = of_claim(8, of_metric("reward", (88, 31, 44, 34), (-7, -5, -9, -8)))
    assert [finding.value for finding in found] == pytest.approx([3, 24 + 1 / 3, 2.5, 20.5])
    assert [finding.standing for finding in found] == ["counts", "counts", *["beside the claim"] * 2]
    assert str(grade(found)) == "replicates"


def test_claim_8_another_scale_alone_is_no_interaction():
    ppo = (88, 31, 44, 34)
    found = of_claim(8, of_metric("reward", ppo, [-20 + value / 50 for value in ppo]), spread=0.01)
    assert str(grade(found)) == "in part (1 of 2)"
    assert verdicts_of(found)[0] == "reverses"


def test_claim_9_of_corridors_and_clearance():
    ppo, dqn = (0.1, 0.1, 0.2, 0.2), (0.4, 0.4, 0.3, 0.3)
    means = of_metric("corridor", ppo, dqn) | of_metric("corridor_flown", dqn, ppo)
    means |= of_metric("clearance", (90,) * 4, (60,) * 4) | of_metric("empty_clearance", (100,) * 4, (140,) * 4)
    means |= of_metric("corridor_early", dqn, ppo) | of_metric("clearance_by_layout", (90,) * 4, (60,) * 4)
    found = known(9, means, spread=0.01)
    assert [finding.value for finding in found] == pytest.approx([0.2, -0.2, 30, -40, -0.2, 30])
    assert verdicts_of(found) == ["replicates", "reverses", "replicates", "reverses", "reverses", "replicates"]


def test_claim_10_compares_the_first_reward_with_the_short_study_and_not_with_the_main_one():
    means = {}
    metrics = ("full_stops", "turns", "reversals")
    for algorithm, metric, activation in itertools.product(ALGORITHMS, metrics, ("tanh", "relu")):
        key = (algorithm, activation, metric)
        means |= {(*key, "initial"): 50, (*key, "baseline"): 30 if algorithm == "dqn" else 70, key: 1e6}
    found = of_claim(10, means)
    assert [finding.value for finding in found] == pytest.approx([-20] * 3 + [20] * 3)
    assert str(grade(found)) == "in part (3 of 6)"
    without = {key: mean for key, mean in means.items() if key[-1] != "baseline"}
    assert {finding.n for finding in of_claim(10, without)} == {0}


def test_claim_11_is_context_whatever_the_hours():
    hours = {(*cell, "hours"): 0.1 for cell in CELLS}
    (found,) = of_claim(11, hours, of_paper)
    assert (found.paper, found.value, found.ratio) == pytest.approx((10, 0.1, 0.01))
    assert str(grade([found])) == "context"
    assert str(grade(of_claim(11, {}))) == "context"


def test_one_line_adds_a_claim():
    terms = (Term("dqn", "tanh", "full_stops"), Term("dqn", "relu", "full_stops"))
    part = Part("full stops: DQN with tanh below ReLU", terms, ((-1.0, 1.0),))
    added = Claim(len(CLAIMS) + 1, "DQN with tanh stops less than with ReLU.", (part,))
    found = audit(evidence(of_metric("full_stops", (), (1, 5, 4, 5))), of_paper, [*CLAIMS, added])
    assert (found[-1].claim, found[-1].verdict) == (added.number, "replicates")
    assert (found[-1].paper, found[-1].value) == pytest.approx((3.881 - 1.497, 3))


def test_rows_of_seeds_for_the_test_of_interaction():
    table = claims.long({("ppo", "tanh"): np.array([1.0, 2.0]), ("dqn", "relu"): np.array([3.0])})
    assert table.to_numpy().tolist() == [["ppo", "tanh", 1.0], ["ppo", "tanh", 2.0], ["dqn", "relu", 3.0]]
