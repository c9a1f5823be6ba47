"""The rule of the audit, on made-up seeds whose verdicts are known."""

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from verdict_evidence import EIGHT, evidence, nothing, of_metric, verdicts_of

from uavnav import stats
from uavnav.report import claims, verdicts
from uavnav.report.claims import CLAIMS, POSITIVE, Claim, Part, Region
from uavnav.report.studies import of_paper
from uavnav.report.tables import said
from uavnav.report.verdicts import ALPHA, audit, verdict
from uavnav.runs import paper

pytestmark = [pytest.mark.usefixtures("little_garbage"), pytest.mark.filterwarnings("error")]


@pytest.fixture
def few_draws(monkeypatch):
    """Simulations need no far tails."""
    verdicts._drawn_means.cache_clear()
    monkeypatch.setattr(verdicts, "DRAWS", 999)
    yield
    verdicts._drawn_means.cache_clear()


def from_samples(*samples, statistic=lambda mean: mean, region=POSITIVE, test=None):
    """A claim of one part on given seeds."""
    part = Part("a part", [np.asarray(one, dtype=np.float64) for one in samples], statistic, region, test=test)
    return Claim(1, "A claim.", lambda _: [part])


def ask(*claims_, **options):
    return audit(nothing, nothing, claims_, **options)


def one(*samples, **options):
    (finding,) = ask(from_samples(*samples, **options))
    return finding


# -- the rule ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mean", "region", "expected"),
    [
        (5.0, POSITIVE, "supported"),
        (-5.0, POSITIVE, "contradicted"),
        (0.1, POSITIVE, "undecided"),
        (2.0, Region(0, 4), "supported"),
        (4.0, Region(0, 4), "undecided"),
        (0.0, Region(0, 4), "undecided"),
        (9.0, Region(0, 4), "contradicted"),
        (-9.0, Region(0, 4), "contradicted"),
    ],
)
def test_an_interval_inside_supports_one_outside_contradicts_and_one_across_an_edge_decides_nothing(
    mean, region, expected
):
    found = one(mean + EIGHT, region=region)
    assert found.verdict == expected
    assert found.low < found.value < found.high
    assert found.value == pytest.approx(mean)
    assert (found.n, found.confidence) == (8, 0.95)


@pytest.mark.parametrize(("n", "expected"), [(2, "undecided"), (7, "undecided"), (8, "supported")])
def test_seven_seeds_never_give_a_verdict_and_eight_do(n, expected):
    found = one(100 + EIGHT[:n])
    assert found.verdict == expected
    assert found.p_holm < 0.05
    if n < 8:
        assert found.needed == 8
        assert said(found) == f"undecided (n = {n}, at least 8 seeds needed)"


def test_one_cell_with_seven_seeds_is_enough_to_decide_nothing():
    found = one(100 + EIGHT, EIGHT[:7], statistic=lambda a, b: a - b)
    assert (found.n, found.verdict) == (7, "undecided")


def test_of_the_papers_own_numbers_seven_seeds_decide_nothing_and_eight_all_as_its_tables_do():
    means = {(*cell, metric): value for cell, row in paper.TABLES.items() for metric, value in row.items()}
    for n in (7, 8):
        found = audit(evidence(means, EIGHT[:n], spread=1e-4), of_paper)
        assert {finding.n for finding in found} == {0, n}
        for finding in (finding for finding in found if finding.n):
            as_printed = "contradicted" if finding.against_itself else "supported"
            assert finding.verdict == (as_printed if n == 8 else "undecided")


def test_one_seed_has_a_value_without_interval_p_or_verdict_and_at_least_eight_are_needed():
    found = one([3.0])
    assert (found.value, found.n, found.verdict) == (3.0, 1, "undecided")
    assert np.isnan([found.low, found.high, found.p_holm]).all()
    assert found.needed == 8


@pytest.mark.parametrize(("n", "needed"), [(2, 8), (7, 8), (8, math.nan)])
def test_of_fewer_than_eight_seeds_eight_are_needed_also_for_a_test_and_where_nothing_is_defined(n, needed):
    by_test = one(EIGHT[:n], test=lambda samples: 0.2)
    undefined = one(EIGHT[:n], statistic=lambda mean: mean * np.nan)
    assert [by_test.needed, undefined.needed] == pytest.approx([needed] * 2, nan_ok=True)


def test_no_seeds_are_undecided_for_want_of_runs():
    for found in ask(from_samples([]), from_samples(EIGHT, [], statistic=lambda a, b: a - b)):
        assert np.isnan([found.value, found.low, found.p_holm, found.needed]).all()
        assert said(found) == "undecided (no runs)"


def test_equal_seeds_are_decided_by_their_value_and_on_the_edge_they_are_outside():
    assert one([1.0] * 8).verdict == "supported"
    assert one([-1.0] * 8).verdict == "contradicted"
    assert one([0.0] * 8).verdict == "contradicted"
    assert one([0.0] * 7).needed == math.inf


def test_the_interval_decides_and_not_the_value():
    """The better of two resampled cells is better than that of their means: a bootstrap of extremes is not centred."""
    found = one(EIGHT + 1, statistic=lambda mean: np.where(np.ndim(mean), mean - 20, mean))
    assert found.value == 1
    assert found.high < 0
    assert found.verdict == "contradicted"


def test_two_cells_of_the_same_seeds_are_still_drawn_apart():
    found = one(EIGHT, EIGHT, statistic=lambda a, b: a - b)
    assert found.low < 0 < found.high
    assert found.verdict == "undecided"
    assert said(found) == "undecided (n = 8, no number of seeds would do)"


def test_the_same_seeds_give_the_same_findings_and_another_stream_nearly_the_same():
    (first,), (again,), (other,) = (ask(from_samples(0.7 + EIGHT**3), seed=seed) for seed in (0, 0, 1))
    assert repr(first) == repr(again)
    assert first.p_holm != other.p_holm
    assert (first.low, first.high) == pytest.approx((other.low, other.high), abs=0.1)


def test_of_two_questions_without_an_effect_about_one_in_twenty_times_either_is_decided(few_draws):
    """By simulation with 20 seeds, of which percentile intervals are a little narrow."""
    rng = np.random.default_rng(0)
    pairs = [ask(*(from_samples(rng.normal(0, 1, 20)) for _ in range(2))) for _ in range(300)]
    wrong = np.mean([any(verdict != "undecided" for verdict in verdicts_of(pair)) for pair in pairs])
    assert 0.02 < wrong < 0.1


def test_findings_are_the_same_whatever_the_last_bits_of_the_seeds_are():
    """Sums of floats differ from processor to processor: two equal cells differ by nothing or by 1e-16."""
    seeds = np.array([0.1, 0.7, 1.3, 0.2, 0.9, 0.4, 0.3, 0.8])
    samples = [seeds, np.nextafter(seeds, 2)], [np.nextafter(seeds, -2), seeds]
    first, second = (one(*pair, statistic=lambda a, b: a - b) for pair in samples)
    assert first.p_holm == second.p_holm
    assert first.value == second.value == 0
    assert first.needed == second.needed == math.inf


@pytest.mark.slow
def test_of_four_equal_cells_the_first_is_contradicted_as_the_worst_more_often_than_a_difference_of_means():
    """What claim 6's note says: of 6,000 studies 1.9 and 0.15 % at the level 0.0023; here of 1,000."""
    rng = np.random.default_rng(2)
    statistics = {"worst": claims._below_worst, "difference": claims.halves}
    contradicted = dict.fromkeys(statistics, 0)
    for _ in range(1000):
        cells = list(rng.normal(size=(4, 20)))
        for name, statistic in statistics.items():
            draws = verdicts._draw(Part(name, cells, statistic), 0)
            p = verdicts._p_value(Part(name, cells, statistic), draws)
            contradicted[name] += p < 0.0023 and np.median(draws) < 0
    assert 8 <= contradicted["worst"] <= 35
    assert contradicted["difference"] <= 6
    assert "1.9 % of studies" in CLAIMS[5].note
    assert "0.15 %" in CLAIMS[5].note


def test_statistics_of_nothing_defined_are_undecided_and_say_no_number_of_seeds():
    found = one(EIGHT, statistic=lambda mean: mean * np.nan)
    assert found.verdict == "undecided"
    assert (found.low, found.high, found.p_holm) == (-math.inf, math.inf, 1.0)
    assert said(found) == "undecided (n = 8)"


# -- Holm -------------------------------------------------------------------------------------------------------------


def test_levels_of_four_parts_by_hand():
    """0.001 < 0.05 / 4 and 0.012 < 0.05 / 3; 0.04 > 0.05 / 2 fails, and so does what comes after."""
    found = verdicts._levels([0.04, 0.001, math.nan, 0.045, 0.012])
    assert found == pytest.approx([0.025, 0.0125, math.nan, 0.025, 0.05 / 3], nan_ok=True)


def test_three_parts_adjusted_by_hand():
    """Draws are counted: of 20,000 so many are below zero; every p is twice that and one more, over 20,001."""
    samples = [EIGHT + 0.8, EIGHT + 1.2, EIGHT + 0.2]
    parts = [from_samples(one).parts(nothing)[0] for one in samples]
    below = [int((verdicts._draw(part, 0) <= 0).sum()) for part in parts]
    p = [2 * (count + 1) / 20_001 for count in below]
    found = ask(*map(from_samples, samples))
    assert 3 * p[1] < 2 * p[0] < 0.05 < p[2]
    expected = [2 * p[0], 3 * p[1], p[2]]
    assert [finding.p_holm for finding in found] == pytest.approx(expected)
    assert [finding.confidence for finding in found] == pytest.approx([1 - 0.05 / 2, 1 - 0.05 / 3, 0.95])


SAMPLES = st.tuples(st.floats(-1.5, 1.5), st.integers(0, 999), st.integers(2, 12)).map(
    lambda drawn: drawn[0] + np.random.default_rng(drawn[1]).normal(0, 1, drawn[2])
)


PROPERTY = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@PROPERTY
@given(st.lists(SAMPLES, min_size=1, max_size=6), st.sampled_from([POSITIVE, Region(-0.5, 0.5)]))
def test_p_is_below_5_percent_exactly_where_the_interval_shown_excludes_the_regions_edges(few_draws, samples, region):
    parts = [from_samples(sample, region=region) for sample in samples]
    own = [verdicts._p_value(part, verdicts._draw(part, 0)) for claim in parts for part in claim.parts(nothing)]
    found = ask(*parts)
    assert [finding.p_holm for finding in found] == stats.holm(own).tolist()
    for finding in found:
        inside = region.low < finding.low and finding.high < region.high
        outside = finding.high <= region.low or region.high <= finding.low
        assert (inside or outside) == (finding.p_holm < ALPHA)
        decided = "supported" if inside else "contradicted" if outside else "undecided"
        assert finding.verdict == (decided if finding.n >= 8 else "undecided")


@PROPERTY
@given(SAMPLES, st.lists(SAMPLES, max_size=4))
def test_more_questions_never_make_a_p_value_smaller_or_an_interval_narrower(few_draws, sample, others):
    alone, among = one(sample), ask(*map(from_samples, [sample, *others]))[0]
    assert among.p_holm >= alone.p_holm - 1e-12
    assert among.low <= alone.low
    assert alone.high <= among.high


def test_parts_of_every_claim_are_one_family_without_those_that_have_no_runs():
    means = of_metric("full_stops", (3.0, 2.0, 1.0, 1.5))
    family = [finding for finding in audit(evidence(means), of_paper) if not math.isnan(finding.p_holm)]
    assert [finding.claim for finding in family] == [2, 5, 6]
    assert verdicts_of(family) == ["contradicted", "supported", "contradicted"]
    assert sorted(finding.confidence for finding in family) == pytest.approx([0.95, 1 - 0.05 / 2, 1 - 0.05 / 3])


def test_a_p_of_as_few_draws_as_there_are_is_a_bound():
    """No draw of the first is below zero: with twice as many draws its p might be half as large."""
    sure, unsure, none = ask(from_samples(9 + EIGHT), from_samples(0.8 + EIGHT), from_samples([1.0]))
    assert (sure.p_is_bound, unsure.p_is_bound, none.p_is_bound) == (True, False, False)
    assert sure.p_holm == pytest.approx(2 * 2 / 20_001)
    assert verdicts.p_shown(sure) == "< 0.001"
    assert verdicts.p_shown(sure._replace(p_holm=50 * 2 / 20_001)) == "≤ 0.005"
    assert verdicts.p_shown(sure._replace(p_holm=0.0052)) == "≤ 0.006"
    assert verdicts.p_shown(unsure._replace(p_holm=0.0052)) == "0.005"
    assert verdicts.p_shown(none) == "–"


# -- the seeds needed -------------------------------------------------------------------------------------------------


def test_with_the_seeds_needed_about_80_percent_of_draws_decide(few_draws):
    rng = np.random.default_rng(7)
    pilot = rng.normal(0, 1, 8)
    pilot = 0.55 + (pilot - pilot.mean()) / pilot.std()
    needed = one(pilot).needed
    assert needed == pytest.approx((1.96 + 0.84) ** 2 / 0.55**2, rel=0.1)  # about 26
    drawn = [one(rng.normal(0.55, 1, int(needed))).verdict for _ in range(200)]
    assert 0.7 < drawn.count("supported") / 200 < 0.9
    assert drawn.count("contradicted") == 0


def test_half_the_distance_to_the_edge_takes_four_times_the_seeds():
    far, near = one(0.5 + EIGHT, region=Region(0, 4)), one(0.25 + EIGHT, region=Region(0, 4))
    assert {far.verdict, near.verdict} == {"undecided"}
    assert near.needed / far.needed == pytest.approx(4, rel=0.05)


# -- a test in place of an interval -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("p", "expected"), [(0.01, "supported"), (0.2, "undecided"), (1.0, "undecided")])
def test_a_test_supports_or_leaves_undecided_and_never_contradicts(p, expected):
    found = one(EIGHT - 9, test=lambda samples: p)
    assert (found.verdict, found.p_holm, found.region) == (expected, p, "p < 0.05")
    assert np.isnan([found.low, found.high, found.needed]).all()
    assert not found.against_itself


# -- claims -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        (["supported", "supported"], "supported"),
        (["supported", "undecided"], "undecided"),
        (["supported", "contradicted"], "contradicted"),
        (["undecided", "contradicted"], "contradicted"),
        (["undecided"], "undecided"),
        ([], "undecided"),
    ],
)
def test_a_claim_is_contradicted_by_one_part_and_supported_by_all(parts, expected):
    finding = one(EIGHT)
    assert verdict([finding._replace(verdict=part) for part in parts]) == expected
