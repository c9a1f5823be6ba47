"""The paper's claims, on made-up seeds whose verdicts are known."""

import itertools
import math

import numpy as np
import pytest
from verdict_evidence import evidence, nothing, of_metric, verdicts_of

from uavnav.report import claims
from uavnav.report.claims import ALGORITHMS, CELLS, CLAIMS, SIX, Claim, Part, Region
from uavnav.report.studies import of_paper
from uavnav.report.tables import said
from uavnav.report.verdicts import audit, verdict

pytestmark = [pytest.mark.usefixtures("little_garbage"), pytest.mark.filterwarnings("error")]

BY_NUMBER = {claim.number: claim for claim in CLAIMS}


def of_claim(number, means, **options):
    return audit(evidence(means, **options), of_paper, [BY_NUMBER[number]])


def test_claims_are_numbered_in_their_order_and_no_two_of_their_questions_are_the_same():
    assert [claim.number for claim in CLAIMS] == list(range(1, len(CLAIMS) + 1))
    found = audit(nothing, of_paper)
    assert {finding.claim for finding in found} == set(BY_NUMBER)
    assert len({finding.text for finding in found}) == len(found)


def test_claims_ask_12_9_6_3_1_6_3_1_4_4_and_1_questions():
    counts = [len(claim.parts(nothing)) for claim in CLAIMS]
    assert counts[:11] == [12, 9, 6, 3, 1, 6, 3, 1, 4, 4, 1]


def test_every_question_says_by_itself_what_it_is_about():
    for finding in audit(nothing, of_paper):
        assert not {"the same", "that rise"} & {finding.text[:8], *finding.text.split(", ")}
        assert any(word in finding.text for word in ("PPO", "DQN", "1,000,000 steps")), finding.text


def test_the_note_of_claim_2_is_what_the_papers_table_says():
    own = {finding.text.split()[0]: finding.paper for finding in audit(nothing, of_paper) if "twice" in finding.text}
    assert BY_NUMBER[2].note == (
        f"In its own table the steps are {own['steps']:.2f} and the distance {own['distance']:.2f} times the "
        "runner-up's."
    )


def test_without_runs_all_is_undecided():
    for finding in audit(nothing, of_paper):
        assert said(finding) == "undecided (no runs)"


def test_the_papers_own_tables_speak_against_five_parts():
    """By hand: PPO's mean speed is 4.00 and DQN's 4.35; PPO's sigmoid turns in 60.7 % of its steps, DQN's in 60.0, at
    3.4 against 5.0 px a step; of PPO's cells ReLU stops least (0.074 %), and leaky ReLU is fastest (4.269)."""
    found = [(finding.claim, finding.text) for finding in audit(nothing, of_paper) if finding.against_itself]
    assert found == [
        (1, "speed [px a step]: PPO better than DQN, means of four activations"),
        (1, "turning [%]: PPO's worst activation better than DQN's best"),
        (1, "speed [px a step]: PPO's worst activation better than DQN's best"),
        (2, "full stops [%]: PPO with tanh the best"),
        (2, "speed [px a step]: PPO with tanh the best"),
    ]


def test_the_papers_own_figures_of_some_parts():
    own = {(finding.claim, finding.text): finding.paper for finding in audit(nothing, of_paper)}
    for metric, ratio in (("reward per episode", 88.527 / 43.598), ("steps per episode", 2727.577 / 1730.587)):
        assert own[2, f"{metric}: PPO with tanh about twice the next best"] == pytest.approx(ratio)
    assert own[3, "full stops [%]: DQN with sigmoid the best"] == pytest.approx(1.497 - 0.626)
    assert own[5, "full stops [%]: PPO's ReLU and leaky ReLU both below tanh and sigmoid"] == pytest.approx(0.042)
    assert own[6, "speed [px a step]: PPO with sigmoid the worst"] == pytest.approx(4.12 - 3.428)
    assert [value for (number, _), value in own.items() if number in (8, 11)] == [4, 10]
    assert all(math.isnan(value) for (number, _), value in own.items() if number in (4, 9, 10))


def gaps(metric, ppo, dqn):
    found = of_claim(1, of_metric(metric, ppo, dqn))
    return [finding for finding in found if finding.n]


@pytest.mark.parametrize("metric", SIX)
def test_claim_1_of_means_and_of_ppos_worst_against_dqns_best(metric):
    sign = SIX[metric].better
    better = [20 * sign + value for value in (10, 11, 12, 13)]
    mean, extreme = gaps(metric, better, (10, 11, 12, 13))
    assert (mean.verdict, extreme.verdict) == ("supported", "supported")
    assert (mean.value, extreme.value) == pytest.approx((20, 17))
    mean, extreme = gaps(metric, (10, 11, 12, 13), better)
    assert (mean.value, extreme.value) == pytest.approx((-20, -23))
    assert (mean.verdict, extreme.verdict) == ("contradicted", "contradicted")


def test_claim_1_may_hold_of_means_while_the_worst_loses_to_the_best():
    mean, extreme = gaps("reward", (100, 100, 100, 1), (0, 0, 0, 5))
    assert (mean.verdict, mean.value) == ("supported", pytest.approx(74))
    assert (extreme.verdict, extreme.value) == ("contradicted", pytest.approx(-4))


def test_claim_2_best_in_a_metric_and_twice_the_next():
    found = of_claim(2, of_metric("reward", (40, 10, 20, 5)))
    best, twice = [finding for finding in found if finding.n]
    assert (best.verdict, best.value) == ("supported", pytest.approx(20))
    assert (twice.verdict, twice.value, twice.region) == ("supported", pytest.approx(2), "1.5 to 2.5")


@pytest.mark.parametrize(
    ("tanh", "expected"),
    [
        (28, "contradicted"),
        (30, "undecided"),
        (32, "supported"),
        (48, "supported"),
        (50, "undecided"),
        (52, "contradicted"),
    ],
)
def test_about_twice_is_1_5_to_2_5_times_the_next(tanh, expected):
    found = of_claim(2, of_metric("steps", (tanh, 10, 20, 5)))
    assert found[-2].text == "steps per episode: PPO with tanh about twice the next best"
    assert found[-2].verdict == expected


def test_a_loss_twice_as_large_is_not_twice_as_good():
    found = of_claim(2, of_metric("reward", (-40, -20, -30, -25)))
    best, twice = [finding for finding in found if finding.n]
    assert best.verdict == "contradicted"
    assert twice.verdict == "undecided"
    assert math.isnan(twice.value)


@pytest.mark.parametrize("metric", SIX)
def test_claim_3_of_dqns_sigmoid(metric):
    sign = SIX[metric].better
    for sigmoid, value, expected in ((sign * 9, 4, "supported"), (sign * 3, -2, "contradicted")):
        found = of_claim(3, of_metric(metric, (), [sign * 1, sigmoid, sign * 5, sign * 2]))
        (own,) = [finding for finding in found if finding.n]
        assert (own.value, own.verdict) == (pytest.approx(value), expected)


@pytest.mark.parametrize(
    ("means", "values", "expected"),
    [
        ((-5, 10, -2), (15, 12, 0.8), ["supported", "supported", "supported"]),
        ((-5, 10, 8), (15, 2, 2 / 15), ["supported", "supported", "contradicted"]),
        ((-5, 10, 20), (15, -10, -10 / 15), ["supported", "contradicted", "contradicted"]),
        ((10, 5, 4), (-5, 1, -0.2), ["contradicted", "supported", "contradicted"]),
    ],
)
def test_claim_4_rises_and_loses_half_of_the_rise(means, values, expected):
    rewards = {
        ("dqn", "sigmoid", f"reward_{when}"): m for when, m in zip(("before", "surge", "after"), means, strict=True)
    }
    found = of_claim(4, rewards)
    assert [finding.value for finding in found] == pytest.approx(values)
    assert verdicts_of(found) == expected


def test_claim_4_is_of_the_same_seeds_before_and_after_however_much_seeds_differ():
    """Every seed rises by 1, seeds lie 100 apart: resampled each by themselves no rise would be seen."""
    seeds = 100.0 * np.arange(8)
    rewards = {"reward_before": seeds, "reward_surge": seeds + 1, "reward_after": seeds + 0.25}

    def of_seeds(algorithm, activation, metric, study="main"):
        return rewards.get(metric, np.empty(0)) if (algorithm, activation) == ("dqn", "sigmoid") else np.empty(0)

    found = audit(of_seeds, nothing, [CLAIMS[3]])
    for finding, change in zip(found, (1, 0.75, 0.75), strict=True):
        assert (finding.low, finding.high) == pytest.approx((change, change))
    assert verdicts_of(found) == ["supported"] * 3


def test_claim_4_of_a_reward_that_never_changes_is_no_surge_and_loses_no_share():
    rewards = {("dqn", "sigmoid", f"reward_{when}"): 3.0 for when in ("before", "surge", "after")}
    found = of_claim(4, rewards, spread=0.0)
    assert verdicts_of(found) == ["contradicted", "contradicted", "undecided"]
    assert said(found[2]) == "undecided (n = 8)"


@pytest.mark.parametrize(
    ("stops", "value", "expected"),
    [((4, 3, 1, 2), 1, "supported"), ((4, 1.5, 1, 2), -0.5, "contradicted"), ((4, 2, 1, 2), 0, "undecided")],
)
def test_claim_5_the_worse_of_two_against_the_better_of_the_others(stops, value, expected):
    (found,) = of_claim(5, of_metric("full_stops", stops))
    assert (found.value, found.verdict) == (pytest.approx(value), expected)


@pytest.mark.parametrize("metric", SIX)
def test_claim_6_sigmoid_is_worst_except_in_steps(metric):
    sign = SIX[metric].better
    weakest = [sign * one for one in (10, 2, 5, 6)]
    (found,) = [one for one in of_claim(6, of_metric(metric, weakest)) if one.n]
    expected = (-3, "contradicted") if metric == "steps" else (3, "supported")
    assert (found.value, found.verdict) == (pytest.approx(expected[0]), expected[1])
    second = [sign * one for one in (10, 6, 5, 7)]
    (found,) = [one for one in of_claim(6, of_metric(metric, second)) if one.n]
    expected = (1, "supported") if metric == "steps" else (-1, "contradicted")
    assert (found.value, found.verdict) == (pytest.approx(expected[0]), expected[1])


def test_claim_7_bounded_above_unbounded_and_sigmoid_behind():
    found = of_claim(7, of_metric("reward", (100, 30, 40, 44), (-5, -6, -9, -10)))
    assert [finding.value for finding in found] == pytest.approx([65 - 42, -5.5 + 9.5, 42 - 30])
    assert verdict(found) == "supported"
    found = of_claim(7, of_metric("reward", (30, 60, 40, 44), (-5, -6, -3, -2)))
    assert [finding.value for finding in found] == pytest.approx([45 - 42, -5.5 + 2.5, 42 - 60])
    assert verdicts_of(found) == ["supported", "contradicted", "contradicted"]


def test_claim_8_pairs_of_activations_that_change_places():
    (found,) = of_claim(8, of_metric("reward", (88, 31, 44, 34), (-7, -5, -9, -8)))
    assert (found.verdict, found.region) == ("supported", "p < 0.05")
    assert found.value == 4  # sigmoid and each other, ReLU and leaky ReLU
    assert found.paper == 4  # the same in its tables
    assert 12 / 20_000 <= found.p_holm < 0.01


def test_claim_8_another_scale_alone_is_no_interaction():
    ppo = (88, 31, 44, 34)
    (found,) = of_claim(8, of_metric("reward", ppo, [-20 + value / 50 for value in ppo]), spread=0.01)
    assert (found.verdict, found.value) == ("undecided", 0)
    assert found.p_holm > 0.2


def test_claim_9_of_corridors_and_clearance():
    ppo, dqn = (0.1, 0.1, 0.2, 0.2), (0.4, 0.4, 0.3, 0.3)
    means = of_metric("corridor", ppo, dqn) | of_metric("corridor_flown", dqn, ppo)
    means |= of_metric("clearance", (90,) * 4, (60,) * 4) | of_metric("empty_clearance", (100,) * 4, (140,) * 4)
    found = of_claim(9, means, spread=0.01)
    assert [finding.value for finding in found] == pytest.approx([0.2, -0.2, 30, -40])
    assert verdicts_of(found) == ["supported", "contradicted", "supported", "contradicted"]


def test_claim_10_compares_the_first_reward_with_the_short_study_and_not_with_the_main_one():
    means = {}
    for algorithm, metric, activation in itertools.product(ALGORITHMS, ("stops", "reversals"), ("tanh", "relu")):
        key = (algorithm, activation, metric)
        means |= {(*key, "initial"): 50, (*key, "baseline"): 30 if algorithm == "dqn" else 70, key: 1e6}
    found = of_claim(10, means)
    assert [finding.value for finding in found] == pytest.approx([-20, -20, 20, 20])
    assert verdicts_of(found) == ["contradicted", "contradicted", "supported", "supported"]
    without = {key: mean for key, mean in means.items() if key[-1] != "baseline"}
    assert {finding.n for finding in of_claim(10, without)} == {0}


def hours_of_runs(hours, seeds=20, runs=1):
    """An `Evidence` of cells of so many seeds in so many runs."""

    def found(algorithm, activation, metric, study="main"):
        cell = CELLS.index((algorithm, activation))
        return {"hours": np.full(runs, hours + cell / 1000), "reward": np.zeros(seeds)}.get(metric, np.empty(0))

    return found


@pytest.mark.parametrize(
    ("hours", "expected"), [(10, "supported"), (4.9, "contradicted"), (0.1, "contradicted"), (21, "contradicted")]
)
def test_claim_11_half_to_twice_ten_hours_of_all_runs_together(hours, expected):
    (found,) = audit(hours_of_runs(hours), of_paper, [BY_NUMBER[11]])
    assert (found.verdict, found.n, found.value) == (expected, 20, pytest.approx(hours + 0.0035))


@pytest.mark.parametrize(
    ("seeds", "runs", "expected"), [(1, 1, "undecided"), (7, 7, "undecided"), (8, 1, "contradicted")]
)
def test_claim_11_counts_a_cells_seeds_and_not_all_runs(seeds, runs, expected):
    (found,) = audit(hours_of_runs(0.1, seeds, runs), of_paper, [BY_NUMBER[11]])
    assert (found.n, found.verdict) == (seeds, expected)
    assert found.needed == 8 or expected == "contradicted"


def test_claim_11_without_wall_times_has_no_runs():
    (found,) = audit(hours_of_runs(0.1, runs=0), of_paper, [BY_NUMBER[11]])
    assert said(found) == "undecided (no runs)"


def test_one_function_adds_a_claim():
    def steady(evidence):
        samples = [evidence("dqn", "tanh", "full_stops")]
        return [Part("full stops [%] of DQN with tanh below 1", samples, lambda mean: mean, Region(-1, 1))]

    added = Claim(len(CLAIMS) + 1, "DQN hardly stops.", steady)
    found = audit(evidence({("dqn", "tanh", "full_stops"): 0.3}), of_paper, [*CLAIMS, added])
    assert (found[-1].claim, found[-1].verdict, found[-1].paper) == (added.number, "supported", 1.497)
    assert found[-1].against_itself


def test_rows_of_seeds_for_the_test_of_interaction():
    table = claims.long({("ppo", "tanh"): np.array([1.0, 2.0]), ("dqn", "relu"): np.array([3.0])})
    assert table.to_numpy().tolist() == [["ppo", "tanh", 1.0], ["ppo", "tanh", 2.0], ["dqn", "relu", 3.0]]
