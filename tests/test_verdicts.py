"""The rule of the audit, on made-up seeds whose verdicts are known."""

import dataclasses
import functools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from verdict_evidence import EIGHT, of_paper_per_frame, verdicts_of

from uavnav import stats
from uavnav.report import operating, verdicts
from uavnav.report.claims import CLAIMS, COLUMNS, SIX, Claim, Part, Term, asked
from uavnav.report.operating import EQUAL, TABLES, characteristics
from uavnav.report.studies import of_paper
from uavnav.report.verdicts import ALPHA, audit, effects, grade, judge
from uavnav.runs import paper

pytestmark = pytest.mark.filterwarnings("error")

NAMES = ("tanh", "sigmoid", "relu", "leaky_relu")


def terms(count):
    return tuple(Term("ppo", name, "reward") for name in NAMES[:count])


ONE = Part("mean above zero", terms(1), ((1.0,),))
TWO = Part("tanh above sigmoid", terms(2), ((1.0, -1.0),))
BEST = Part("tanh best of four", terms(4), ((1, -1, 0, 0), (1, 0, -1, 0), (1, 0, 0, -1)))
SOMEBODY = dataclasses.replace(BEST, text="tanh above somebody", every=False)


def ask(*questions, paper_effects=()):
    """The findings of a claim of parts with their samples; the paper's first mean of a part is its
    effect, others 0.
    """
    parts, numbers = [], {}
    for place, (part, samples) in enumerate(questions):
        own = tuple(term._replace(metric=f"{term.metric}{place}") for term in part.terms)
        parts.append(dataclasses.replace(part, text=f"{place} {part.text}", terms=own))
        numbers |= {term: np.asarray(one, dtype=np.float64) for term, one in zip(own, samples, strict=True)}
    printed = {
        term: np.array([effect * (term == part.terms[0])])
        for part, effect in zip(parts, paper_effects, strict=False)
        for term in part.terms
    }
    claim = Claim(1, "A claim.", tuple(parts))
    return audit(
        lambda *term: numbers[Term(*term)], lambda *term: printed.get(Term(*term), np.empty(0)), [claim]
    )


def one(part, *samples, effect=None):
    (finding,) = ask((part, samples), paper_effects=() if effect is None else (effect,))
    return finding


# -- a part's verdict ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mean", "effect", "expected", "less"),
    [
        (5.0, None, "replicates", False),
        (-5.0, None, "reverses", False),
        (0.1, None, "open", False),  # without a printed number nothing is absent
        (0.1, 10.0, "absent", False),
        (0.1, 1.0, "open", False),  # half of it is within the interval
        (5.0, 6.0, "replicates", False),
        (-0.5, 1.6, "smaller", False),  # from -1.4 to 0.4: below half, and below its negative too
        (2.0, 10.0, "replicates", True),
        (-2.0, 10.0, "reverses", True),
        (-9.0, 10.0, "reverses", False),
    ],
)
def test_the_interval_gives_the_verdict_and_half_of_the_papers_effect_bounds_absence(
    mean, effect, expected, less
):
    found = one(ONE, mean + EIGHT, effect=effect)
    assert (found.verdict, found.less_than_half) == (expected, less)
    assert found.low < found.value < found.high
    assert (found.n, found.confidence, found.standing) == (
        8,
        0.95,
        "the paper's effect is too small" if effect == 1 else "counts",
    )


def test_the_interval_and_p_are_those_of_students_and_welchs_tests():
    from scipy.stats import ttest_1samp, ttest_ind

    first, second = 1.0 + EIGHT, 3 * np.arange(6.0)
    alone, welch = ttest_1samp(first, 0), ttest_ind(first, second, equal_var=False)
    for found, test in ((one(ONE, first), alone), (one(TWO, first, second), welch)):
        assert found.p_holm == pytest.approx(test.pvalue)
        assert (found.low, found.high) == pytest.approx(tuple(test.confidence_interval()))


def test_the_ratio_is_ours_to_the_papers_with_the_interval_scaled():
    found = one(ONE, 5 + EIGHT, effect=10.0)
    assert (found.ratio, found.ratio_low, found.ratio_high) == pytest.approx(
        (0.5, found.low / 10, found.high / 10)
    )
    assert math.isnan(one(ONE, 5 + EIGHT).ratio)


@pytest.mark.parametrize(
    ("n", "expected"), [(1, "too few seeds"), (4, "too few seeds"), (5, "counts"), (0, "no runs")]
)
def test_four_seeds_in_a_configuration_decide_nothing_and_five_do(n, expected):
    found = one(TWO, 100 + EIGHT, EIGHT[:n])
    assert (found.n, found.standing, found.verdict) == (n, expected, "replicates" if n == 5 else "open")
    assert math.isnan(found.low) == (n < 5)
    assert math.isnan(found.value) == (n == 0)


def test_a_measure_that_never_varies_on_one_side_is_degenerate_and_counts_for_nothing():
    found = one(TWO, EIGHT, np.zeros(8), effect=1.0)
    assert (found.verdict, found.standing, str(grade([found]))) == ("degenerate", "degenerate", "open")
    beside = Part("two against two", terms(4), ((0.5, 0.5, -0.5, -0.5),))
    # one of two configurations varies
    assert one(beside, 9 + EIGHT, np.zeros(8), EIGHT, EIGHT).verdict == "replicates"


def test_the_best_of_four_has_to_be_above_each_and_the_largest_p_counts():
    from scipy.stats import ttest_ind

    others = [EIGHT - 9, EIGHT[::-1] - 2, EIGHT - 5]
    found = one(BEST, EIGHT, *others)
    tests = [ttest_ind(EIGHT, other, equal_var=False) for other in others]
    each, of_three = ([test.confidence_interval(1 - level) for test in tests] for level in (0.05, 0.05 / 3))
    assert found.low == pytest.approx(min(one.low for one in each))
    assert found.high == pytest.approx(min(one.high for one in of_three))
    p = tests[1].pvalue
    assert (found.value, found.p_holm, found.verdict) == (pytest.approx(2), pytest.approx(p), "replicates")
    assert found.nearest == "PPO tanh against PPO ReLU"


def test_somebody_above_it_is_holm_over_three():
    from scipy.stats import ttest_ind

    others = [EIGHT - 9, EIGHT[::-1] + 2, EIGHT - 5]
    p = ttest_ind(EIGHT, others[1], equal_var=False).pvalue
    assert one(BEST, EIGHT, *others).p_holm == pytest.approx(3 * p)
    assert one(BEST, EIGHT, *others).verdict == "reverses"
    above = [EIGHT + 9, EIGHT[::-1] - 2, EIGHT + 5]
    found = one(SOMEBODY, EIGHT, *above)
    tests = [ttest_ind(EIGHT, other, equal_var=False) for other in above]
    each, of_three = ([test.confidence_interval(1 - level) for test in tests] for level in (0.05, 0.05 / 3))
    assert found.low == pytest.approx(max(one.low for one in of_three))
    assert found.high == pytest.approx(max(one.high for one in each))
    assert (found.value, found.p_holm, found.verdict) == (
        pytest.approx(2),
        pytest.approx(3 * p),
        "replicates",
    )


def test_the_best_by_less_than_half_of_the_papers_margin_and_by_nothing_of_it():
    third = 2.0 + EIGHT[::-1] / 10
    assert one(BEST, 3 + EIGHT / 10, third, third - 9, third - 9, effect=10.0).less_than_half
    assert one(BEST, 2 + EIGHT / 10, third, third - 9, third - 9, effect=10.0).verdict == "absent"
    assert one(BEST, 2 + EIGHT / 10, third - 9, third - 9, third - 9, effect=10.0).verdict == "replicates"


def test_findings_are_the_same_whatever_the_last_bits_of_the_seeds_are():
    """Sums of floats differ from processor to processor: two equal configurations differ by nothing or by
    1e-16.
    """
    seeds = np.array([0.1, 0.7, 1.3, 0.2, 0.9, 0.4, 0.3, 0.8])
    first, second = (
        one(TWO, *pair) for pair in ((seeds, np.nextafter(seeds, 2)), (np.nextafter(seeds, -2), seeds))
    )
    assert first.value == second.value == 0
    assert first.p_holm == second.p_holm == 1


SAMPLES = st.tuples(st.floats(-1.5, 1.5), st.integers(0, 999), st.integers(5, 12)).map(
    lambda drawn: drawn[0] + np.random.default_rng(drawn[1]).normal(0, 1, drawn[2])
)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.sampled_from([BEST, SOMEBODY]), st.tuples(*[SAMPLES] * 4)), min_size=1, max_size=4)
)
def test_p_is_below_5_percent_exactly_where_the_interval_shown_excludes_zero(questions):
    for found in ask(*questions):
        side = "replicates" if found.low > 0 else "reverses" if found.high < 0 else "open"
        assert found.verdict == side
        assert (found.p_holm < ALPHA) == (side != "open")


# -- Holm within a claim -------------------------------------------------------------------------------------


def test_three_parts_of_a_claim_are_adjusted_by_hand():
    samples = [EIGHT + 1.1, EIGHT + 1.3, EIGHT + 0.2]
    p = [one(ONE, sample).p_holm for sample in samples]
    found = ask(*((ONE, [sample]) for sample in samples))
    assert 3 * p[1] < 2 * p[0] < 0.05 < 0.3 < p[2]
    assert [finding.p_holm for finding in found] == pytest.approx([2 * p[0], 3 * p[1], p[2]])
    assert [1 - finding.confidence for finding in found] == pytest.approx([0.05 / 2, 0.05 / 3, 0.05])
    failed = ask(*((ONE, [sample]) for sample in (EIGHT + 0.2, EIGHT + 0.1)))
    assert [1 - finding.confidence for finding in failed] == pytest.approx([0.025, 0.025])


def test_parts_that_do_not_count_are_judged_by_themselves_and_take_no_level_from_others():
    small, itself = (ONE, [EIGHT + 0.5]), (ONE, [EIGHT + 2])
    found = ask((ONE, [EIGHT + 1]), small, itself, paper_effects=(5.0, 0.5, -1.0))
    assert [finding.standing for finding in found] == [
        "counts",
        "the paper's effect is too small",
        "the paper contradicts itself",
    ]
    for finding, (part, samples) in zip(found, [(ONE, [EIGHT + 1]), small, itself], strict=True):
        assert finding.p_holm == pytest.approx(one(part, *samples).p_holm)
        assert finding.confidence == 0.95


# -- power and seeds needed ----------------------------------------------------------------------------------


def test_power_is_that_of_the_t_test():
    from statsmodels.stats.power import TTestIndPower

    seeds = EIGHT / EIGHT.std(ddof=1)
    found = one(TWO, seeds, -seeds, effect=1.2)
    # of both sides, of which the wrong one adds little
    assert found.power == pytest.approx(TTestIndPower().power(1.2, 8, 0.05), abs=1e-3)
    assert found.standing == "the paper's effect is too small"


def test_seeds_needed_come_of_the_papers_effect_and_never_of_ours():
    seeds = EIGHT / EIGHT.std(ddof=1)
    needed = {
        (finding.to_detect, finding.to_equal)
        for mean in (0, 1, 50)
        for finding in [one(TWO, seeds + mean, -seeds, effect=1.0)]
    }
    assert needed == {(17.0, 70.0)}  # Cohen's 17; by 2 (1.645 + 1.282)^2 / 0.5^2 = 69


def test_with_the_seeds_needed_80_percent_of_studies_find_the_effect_and_its_absence():
    rng = np.random.default_rng(0)
    for part, count in ((TWO, 2), (BEST, 4), (SOMEBODY, 4)):
        means = np.array([0.8, 0, -0.2, -1][:count])
        found = stats.welch(list(rng.normal(size=(count, 40))), np.array(part.weights))
        found = found._replace(
            error=np.full_like(found.error, np.sqrt(2 / 40)), df=np.full_like(found.df, 78.0)
        )
        printed = np.array(part.weights) @ means
        detect, equal = verdicts._needed(part, found, printed, ALPHA, 40)
        samples = [mean + rng.normal(size=(1000, int(detect))) for mean in means]
        share = np.mean(judge([part], [samples], [printed]).verdicts == "replicates")
        assert 0.77 < share < (0.84 if count == 2 else 0.95), (part.text, detect)
        none = [rng.normal(size=(1000, int(equal))) for _ in means]
        assert 0.77 < np.mean(judge([part], [none], [printed]).verdicts == "absent") < 0.97, (
            part.text,
            equal,
        )


# -- errors of both kinds ------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [5, 10, 20, 40])
@pytest.mark.parametrize(("part", "count"), [(TWO, 2), (BEST, 4), (SOMEBODY, 4)])
def test_an_effect_that_is_not_there_is_decided_in_at_most_5_percent_of_studies(part, count, n):
    """The effect is 1 and the paper's: absent in at most 5 %. It is 0: a direction in at most 5 %."""
    rng = np.random.default_rng(n)
    samples = list(rng.normal(size=(count, 2000, n)))
    judged = judge([part], [samples], [np.full(len(part.weights), np.nan)])
    assert np.isin(judged.verdicts, ("replicates", "reverses")).mean() <= 0.06
    scale = 4 / n**0.5  # half an effect of this is as far from zero as absence may be
    samples[0] = samples[0] + scale / 2
    judged = judge([part], [samples], [np.full(len(part.weights), scale)])
    assert (judged.verdicts == "absent").mean() <= 0.06


# -- grades --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        (["replicates", "replicates"], "replicates"),
        (["replicates", "open"], "in part (1 of 2)"),
        (["replicates", "reverses"], "in part (1 of 2)"),
        (["open", "reverses"], "does not"),
        (["absent"], "does not"),
        (["smaller", "open"], "smaller"),
        (["smaller", "replicates"], "in part (1 of 2)"),
        (["smaller", "reverses"], "does not"),
        (["open", "open"], "open"),
    ],
)
def test_a_grade_counts_the_parts_that_replicate(parts, expected):
    finding = one(ONE, EIGHT)
    found = [finding._replace(verdict=verdict) for verdict in parts]
    assert str(grade(found)) == expected
    small = finding._replace(verdict="reverses", standing="the paper's effect is too small")
    assert str(grade([*found, small])) == expected


@pytest.mark.parametrize("standing", ["no runs", "too few seeds"])
def test_a_claim_of_which_a_part_waits_for_its_runs_replicates_in_part_at_most(standing):
    finding = one(ONE, EIGHT)
    waits = finding._replace(standing=standing, verdict="open")
    assert str(grade([finding._replace(verdict="replicates"), waits])) == "in part (1 of 2)"
    assert str(grade([finding._replace(verdict="absent"), waits])) == "does not"


def test_a_part_is_smaller_if_its_interval_as_adjusted_lies_below_half_of_the_papers_effect():
    """Of 8 seeds with a standard deviation of 10: 5.9 is the upper end alone, 7.5 as one of two parts."""
    seeds = 10 * EIGHT / EIGHT.std(ddof=1) - 2.5
    alone = one(ONE, seeds, effect=14.0)
    first, second = ask((ONE, [seeds]), (ONE, [seeds]), paper_effects=(14.0, 14.0))
    assert (alone.standing, alone.verdict, round(alone.high, 1)) == ("counts", "smaller", 5.9)
    assert (first.standing, first.verdict, round(first.high, 1)) == ("counts", "open", 7.5)
    assert second.verdict == "open"
    assert one(ONE, seeds, effect=11.0).verdict == "open"  # and 5.9 is not below half of 11


def test_a_claim_of_which_nothing_counts_is_open_and_one_of_context_is_context():
    finding = one(ONE, 9 + EIGHT)
    assert str(grade([finding._replace(standing="the paper's effect is too small")])) == "open"
    assert str(grade([finding._replace(standing="no part of the grade")])) == "context"


PRINTED = {
    (*configuration, metric): value
    for configuration, row in paper.TABLES.items()
    for metric, value in row.items()
}


def scattered(means, share):
    """Seeds that scatter by a share of each mean."""

    def found(algorithm, activation, metric, study="main"):
        mean = means.get((algorithm, activation, metric)) if study == "main" else None
        if mean is None:
            return np.empty(0)
        return mean + share * abs(mean) * np.roll(EIGHT, sum(map(ord, algorithm + activation + metric)))

    return found


AS_CLAIMED = {
    ("dqn", "sigmoid", f"reward_{when}"): mean for when, mean in (("before", -5), ("surge", 15), ("after", 1))
}
AS_CLAIMED |= {
    (*configuration, metric): low + sign * (configuration[0] == "ppo")
    for metric, low, sign in (("corridor", 0.4, -0.3), ("clearance", 60, 30), ("empty_clearance", 100, 40))
    for configuration in paper.TABLES
}
"""What a paper says without a number: the surge of claim 4, and claim 9."""


@pytest.mark.parametrize("column", [*COLUMNS][:3])
def test_a_perfect_replication_is_graded_as_one_in_each_column_that_can_answer(column):
    printed = functools.partial(of_paper, definition=COLUMNS[column])
    numbers = {key: printed(*key)[0] for key in PRINTED} | AS_CLAIMED
    found = audit(scattered(numbers, 1e-4), printed, asked(CLAIMS, column))
    grades = {one.claim: grade(verdicts.of_claim(found, one.claim)) for one in found if one.n}
    expected = (1, 2, 3, 4, 5, 6, 7, 8) + (9,) * (column == "final policies")
    assert {number: one.name for number, one in grades.items()} == dict.fromkeys(expected, "replicates")
    assert {round(one.ratio, 2) for one in found if one.standing == "counts" and one.ratio > 0} == {1.0}


def test_ppo_above_dqn_with_other_settings_replicates_claim_1_there():
    """As in the paper's tables, with the preset of tanh and sigmoid and the winners of tanh."""

    def elsewhere(algorithm, activation, metric, study="main"):
        own = -SIX[metric].better if algorithm == "dqn" else 0
        return own + 0.1 * np.roll(EIGHT, len(activation)) if study in ("fast", "tuned") else np.empty(0)

    found = audit(elsewhere, of_paper, asked(CLAIMS, "other settings"))
    assert {one.claim for one in found} == {1}
    assert grade(found) == ("replicates", 12, 12)


def test_a_study_of_equal_configurations_replicates_nothing_and_a_mirrored_one_reverses_all():
    equal = dict.fromkeys(PRINTED, 1.0)
    found = audit(scattered(equal, 1e-4), of_paper)
    for claim in (1, 2, 3, 5, 6, 8):
        assert str(grade(verdicts.of_claim(found, claim))) == "does not"
    assert {one.verdict for one in found if one.standing == "counts"} <= {"absent", "reverses"}
    mirrored = {key: -value for key, value in PRINTED.items()}
    found = [one for one in audit(scattered(mirrored, 1e-4), of_paper) if one.standing == "counts"]
    assert {*verdicts_of(one for one in found if "at least one" not in one.text)} == {"reverses"}


# -- operating characteristics -------------------------------------------------------------------------------


def test_seeds_that_scatter_by_2_percent_show_claim_5_if_it_is_true_and_not_if_nothing_differs():
    """The other claims with the scatter of our seeds: see test_results."""
    table = characteristics(scattered(PRINTED, 0.02), of_paper, CLAIMS[4:5])
    shares = table.set_index(["truth", "grade"])["share"]
    assert shares[TABLES, "replicates"] > 0.75
    assert shares[TABLES, "does not"] < 0.01
    assert shares[EQUAL, "replicates"] <= 0.05


def test_claims_without_printed_numbers_have_the_second_truth_alone_and_context_has_none():
    windows = {("dqn", "sigmoid", f"reward_{when}"): 7.0 for when in ("before", "surge", "after")}
    means = (
        windows
        | {(*configuration, "corridor"): 0.3 for configuration in paper.TABLES}
        | {("ppo", "tanh", "hours"): 1.0}
    )
    table = characteristics(scattered(means, 0.1), of_paper)
    assert {*zip(table["claim"], table["truth"], strict=True)} == {(4, EQUAL), (9, EQUAL)}
    shares = table.set_index(["claim", "grade"])["share"]
    assert shares[4, "replicates"] <= 0.01
    assert 0.005 < shares[9, "in part"] < 0.05  # one part of a side of 2.5 %, the others without runs


def test_simulated_studies_are_the_same_for_the_same_seed_and_scatter_as_ours():
    own = scattered(PRINTED, 0.02)
    pd_first, again = (characteristics(own, of_paper, CLAIMS[1:2]) for _ in range(2))
    assert pd_first.equals(again)
    part = CLAIMS[2].parts[-1]
    seeds = {term: own(*term) for term in part.terms}
    means = dict.fromkeys(part.terms, 7.0)
    (drawn,) = operating._studies([part], seeds, means, np.random.default_rng(0))
    for term, one_ in zip(part.terms, drawn, strict=True):
        assert one_.mean() == pytest.approx(7, abs=0.01)
        assert one_.var() == pytest.approx(seeds[term].var(ddof=1), rel=0.05)


def test_many_studies_judged_at_once_are_those_judged_one_by_one():
    rng = np.random.default_rng(0)
    claim = CLAIMS[5]
    printed = [effects(part, of_paper_per_frame) for part in claim.parts]
    samples = [
        [of_paper_per_frame(*term)[0] * (1 + 0.05 * rng.normal(size=(7, 6))) for term in part.terms]
        for part in claim.parts
    ]
    together = judge(claim.parts, samples, printed)
    for study in range(7):
        alone = judge(claim.parts, [[one_[study] for one_ in of] for of in samples], printed)
        assert alone.verdicts.tolist() == together.verdicts[study].tolist()
        assert alone.standings.tolist() == together.standings[study].tolist()
        assert alone.p_holm == pytest.approx(together.p_holm[study])
        assert str(alone.grades) == together.grades[study]
