"""The statistics on data whose answer is known: coverage by simulation, Holm by hand, interactions,
censoring.
"""

import functools
import itertools
import warnings

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import stdtrit
from scipy.stats import bootstrap, t, ttest_1samp, ttest_ind, ttest_rel
from statsmodels.stats.power import TTestIndPower

from uavnav import stats


def test_what_is_drawn_in_small_tables_is_what_one_table_holds(monkeypatch):
    rows = np.random.default_rng(0).normal(size=(3, 2, 11))
    ask = functools.partial(stats.intervals, rows[0], [np.mean, stats.interquartile_mean])
    whole = ask()
    monkeypatch.setattr(stats, "_AT_ONCE", 100)  # nine draws of eleven seeds
    assert ask() == whole


def test_many_studies_are_adjusted_each_by_itself_and_a_missing_p_value_counts_for_none():
    together = stats.holm(np.array([[0.01, 0.04, 0.03], [0.02, np.nan, 0.03], [np.nan, np.nan, np.nan]]))
    expected = [[0.03, 0.06, 0.06], [0.04, np.nan, 0.04], [np.nan] * 3]
    assert together == pytest.approx(np.array(expected), nan_ok=True)
    assert stats.holm([]).tolist() == []


@given(st.lists(st.floats(0, 1), min_size=1, max_size=8))
def test_holms_adjustment_is_the_smallest_level_at_which_he_steps_down_so_far(p_values):
    for place, p in enumerate(p_values):
        before = sorted(p_values)[: sorted(p_values).index(p) + 1]
        expected = min(1, max(one * (len(p_values) - rank) for rank, one in enumerate(before)))
        assert stats.holm(p_values)[place] == pytest.approx(expected)


def test_one_seed_has_a_mean_and_no_interval_and_none_has_neither():
    one = stats.interval([3.0])
    assert (one.value, one.n) == (3.0, 1)
    assert np.isnan([one.low, one.high]).all()
    assert np.isnan(stats.interval([np.nan]).value)
    assert stats.interval([np.nan]).n == 0


def test_equal_seeds_have_an_interval_of_one_point():
    assert stats.interval([2.0] * 5) == (2.0, 2.0, 2.0, 5)


def test_the_95_percent_interval_of_20_normal_seeds_covers_the_mean_in_about_95_percent_of_200_draws():
    rng = np.random.default_rng(0)
    found = [stats.interval(rng.normal(7.0, 2.0, 20), seed=draw) for draw in range(200)]
    covered = np.mean([one.low <= 7.0 <= one.high for one in found])
    assert 0.89 <= covered <= 0.98


@pytest.mark.parametrize("n", [2, 3, 10, 19])
def test_the_interval_of_the_mean_of_few_seeds_is_students(n):
    seeds = np.random.default_rng(n).normal(7.0, 2.0, n)
    known = ttest_1samp(seeds, 0).confidence_interval()
    assert stats.interval(seeds) == pytest.approx((seeds.mean(), known.low, known.high, n))


@pytest.mark.parametrize("means", [[0, 0, 0, 0], [0, 0, 1, 1], [0, 1, 2, 3], [0, 5, 10, 15]])
@pytest.mark.parametrize("turned", [1, -1])
def test_the_interval_of_kendalls_tau_covers_that_of_the_true_means_in_at_least_95_percent(means, turned):
    rng, covered = np.random.default_rng(0), 0
    pairs = list(itertools.combinations(means, 2))
    true = float(np.mean([turned * np.sign(a - b) ** 2 for a, b in pairs]))
    for _ in range(200):
        first, second = (rng.normal(np.array(means)[:, None], 2, size=(4, 10)) for _ in range(2))
        found = stats.concordance(first, turned * second)
        covered += found.low <= true <= found.high
    assert covered / 200 >= 0.95


def test_an_order_of_equal_means_is_wrongly_known_in_at_most_5_percent():
    rng, known = np.random.default_rng(0), 0
    for _ in range(400):
        apart = rng.normal(100 * np.arange(4)[:, None], 2, size=(4, 10))
        known += stats.concordance(apart, rng.normal(0, 2, size=(4, 10)))[1:3] != (-1, 1)
    assert known / 400 <= 0.06  # 18 % if each pair had a test of 5 %


def test_a_difference_of_two_configurations_is_that_of_welchs_test():
    first, second = np.array([1.0, 2.0, 4.0]), np.array([0.5, 0.0, 3.0, -8.0])
    expected = ttest_ind(first, second, equal_var=False)
    found = stats.difference([first], [second])
    assert found.value == pytest.approx(first.mean() - second.mean())
    assert (found.low, found.high) == pytest.approx(tuple(expected.confidence_interval()))
    assert found.n == 3


def test_a_difference_of_two_configurations_from_two_others_weighs_the_mean_of_each_by_a_half():
    rng = np.random.default_rng(0)
    samples = [rng.normal(mean, 1, n) for mean, n in ((3, 5), (9, 6), (1, 4), (7, 7))]
    weights = np.array([0.5, 0.5, -0.5, -0.5])
    value = sum(w * one.mean() for w, one in zip(weights, samples, strict=True))
    known = stats.welch(samples, weights[None])
    half = stdtrit(known.df[0], 0.975) * known.error[0]
    assert stats.difference(samples[:2], samples[2:]) == pytest.approx((value, value - half, value + half, 4))


def test_a_difference_without_scatter_is_a_point_and_of_one_seed_or_none_has_no_interval():
    assert stats.difference([np.full(3, 4.0)], [np.full(2, 1.0)]) == (3.0, 3.0, 3.0, 2)
    one = stats.difference([np.array([4.0])], [np.array([1.0, 3.0])])
    assert one.value == 2
    assert np.isnan([one.low, one.high]).all()
    assert np.isnan(stats.difference([np.empty(0)], [np.array([1.0, 3.0])]).value)
    assert np.isnan(stats.difference([], []).value)


def test_a_slow_loop_over_studies_gives_the_contrasts_of_all_at_once():
    """Of two contrasts of three configurations: a mean against two, and two configurations."""
    rng = np.random.default_rng(0)
    samples = [rng.normal(size=(4, n)) for n in (3, 5, 6)]
    weights = np.array([[1, -0.5, -0.5], [0, 1, -1]])
    found = stats.welch(samples, weights)
    for study in range(4):
        for row, of_row in enumerate(weights):
            parts = [
                w * w * one[study].var(ddof=1) / one.shape[-1] for w, one in zip(of_row, samples, strict=True)
            ]
            df = sum(parts) ** 2 / sum(
                part**2 / (one.shape[-1] - 1) for part, one in zip(parts, samples, strict=True)
            )
            mean = sum(w * one[study].mean() for w, one in zip(of_row, samples, strict=True))
            assert found.value[study, row] == pytest.approx(mean)
            assert found.error[study, row] == pytest.approx(sum(parts) ** 0.5)
            assert found.df[study, row] == pytest.approx(df)


def test_a_paired_contrast_is_students_of_each_seeds_own_and_a_configuration_of_one_seed_is_refused():
    first, second = np.array([1.0, 2.0, 4.0]), np.array([0.5, 0.0, 3.0])
    found, expected = stats.welch([first, second], np.array([[1, -1]]), paired=True), ttest_rel(first, second)
    assert 2 * found.above()[0] == pytest.approx(expected.pvalue)
    assert found.df[0] == 2
    with pytest.raises(
        ValueError, match="a configuration has fewer than two seeds; an error needs at least two"
    ):
        stats.welch([first, second[:1]], np.array([[1, -1]]))


@pytest.mark.parametrize("n", [5, 20])
def test_the_power_of_a_contrast_is_the_share_of_studies_that_find_its_effect(n):
    rng = np.random.default_rng(n)
    found = stats.welch(list(rng.normal([[[0.9]], [[0.0]]], 1, (2, 4000, n))), np.array([[1, -1]]))
    share = np.mean(found.above() < 0.025)
    exact = stats.Contrasts(np.zeros(1), np.full(1, np.sqrt(2 / n)), np.full(1, 2.0 * n - 2))
    assert exact.power(np.array([0.9]), 0.025)[0] == pytest.approx(share, abs=0.02)
    assert exact.power(np.array([1e6]), 1e-6)[0] == 1
    assert exact.power(np.zeros(1), 0.025)[0] == pytest.approx(0.025)


def test_a_number_among_five_seeds_by_hand():
    """Student's t of 4 is 2.776; five seeds of standard deviation 1.581 predict 3 -+ 2.776 * 1.581 *
    sqrt(1.2).
    """
    seeds = np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    found = stats.prediction(seeds, 4.0)
    assert (found.percentile, found.within, found.n) == (70, True, 5)
    assert (found.low, found.high) == pytest.approx((3 - 4.809, 3 + 4.809), abs=1e-3)
    assert not stats.prediction(seeds, 8.0).within
    for none in (stats.prediction(seeds[:1], 1.0), stats.prediction(seeds, np.nan)):
        assert np.isnan([none.percentile, none.low, none.high]).all()
        assert not none.within


def test_the_interquartile_mean_leaves_out_the_outer_quarters():
    assert stats.interquartile_mean(np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1000.0])) == 3.5


def test_intervals_of_many_rows_are_those_of_each_row_alone():
    rng = np.random.default_rng(3)
    rows = [
        *rng.normal(size=(6, 20)),
        rng.normal(size=5),
        np.full(20, 7.0),
        np.array([1.0]),
        np.array([]),
        [0, 0, 1],
    ]
    rows[2][::3] = np.nan
    both = [np.mean, stats.interquartile_mean]
    for row, found in zip(rows, stats.intervals(rows, both), strict=True):
        alone = [stats.interval(row, statistic) for statistic in both]
        assert np.array(found) == pytest.approx(np.array(alone), rel=1e-13, nan_ok=True)
    assert [one[0].n for one in stats.intervals(rows, both)] == [20, 20, 13, 20, 20, 20, 5, 20, 1, 0, 3]
    assert stats.intervals([], both) == []


def test_probability_of_improvement_of_known_configurations():
    table = stats.improvement(
        {"high": np.array([3.0, 4.0, 5.0]), "low": np.array([0.0, 1.0, 2.0]), "one": np.array([2.0])}
        | {"none": np.array([])}
    )
    by_pair = {(row.a, row.b): row for row in table.itertuples()}
    assert by_pair["high", "low"].probability == 1.0
    assert by_pair["low", "one"].probability == pytest.approx(0.5 / 3)  # a tie is half a win
    assert np.isnan(by_pair["low", "one"].p)
    assert np.isnan(by_pair["low", "none"].probability)
    assert by_pair["high", "low"].p == pytest.approx(0.1)  # 2 of the 20 orders are as extreme
    assert by_pair["high", "low"].p_holm == pytest.approx(0.1)


def table_of(means, n=12, scale=None, seed=0):
    rng = np.random.default_rng(seed)
    rows = [
        {
            "algorithm": algorithm,
            "activation": activation,
            "value": scale[algorithm] * (mean + rng.normal(0, 0.5)),
        }
        for (algorithm, activation), mean in means.items()
        for _ in range(n)
    ]
    return pd.DataFrame(rows)


@pytest.fixture
def few_permutations(monkeypatch):
    """Simulations need no far tails."""
    monkeypatch.setattr(stats, "PERMUTATIONS", 499)


def of_order(ppo, dqn):
    """Means by algorithm and activation."""
    return {("ppo", name): mean for name, mean in zip("abcd", ppo, strict=True)} | {
        ("dqn", name): mean for name, mean in zip("abcd", dqn, strict=True)
    }


def false_positives(first, second, n):
    """Share of 60 simulated studies of n seeds a configuration, of spread 1, in which a crossover is
    found.
    """
    rng = np.random.default_rng(0)
    studies = [[[rng.normal(mean, 1, n) for mean in means] for means in (first, second)] for _ in range(60)]
    return np.mean([stats._crossover(*study, rng) < 0.05 for study in studies])


def test_the_same_order_of_activations_at_another_scale_is_no_crossover():
    found = stats.interaction(table_of(of_order(range(4), range(4)), scale={"ppo": 50.0, "dqn": 1.0}))
    assert found.p_ranks == 1.0
    assert found.p_raw < 0.001  # on the raw scale the differences are 50 times as large
    assert found.n == 12


def test_a_reversed_order_of_activations_is_a_crossover_of_smallest_p_12_pairs_and_19999_permutations_give():
    found = stats.interaction(table_of(of_order(range(4), (0, -1, -2, -3)), scale={"ppo": 50.0, "dqn": 1.0}))
    assert found.p_ranks == pytest.approx(12 / 20_000)


def test_two_activations_that_change_places_are_enough():
    table = table_of(of_order((0, 5, 10, 11), (0, 5, 11, 10)), scale={"ppo": 1.0, "dqn": 1.0})
    assert stats.interaction(table).p_ranks < 0.05
    assert stats.interaction(table[~table["activation"].isin(["c"])]).p_ranks == 1.0


@pytest.mark.parametrize("n", [8, 20])
def test_an_equal_order_at_unequal_noise_and_spacing_is_found_to_differ_in_at_most_5_percent(
    n, few_permutations
):
    """Configurations lie up to 100 standard deviations apart under the first algorithm, up to 2 under the
    second.
    """
    assert false_positives((0, 10, 20, 100), (0, 0.2, 0.4, 2.0), n) <= 0.05


def test_where_one_algorithms_activations_are_all_alike_at_most_5_percent_of_studies_find_a_crossover(
    few_permutations,
):
    """The hardest of equal orders: one half of each crossover is certain."""
    assert false_positives((0, 10, 20, 30), (0, 0, 0, 0), 8) <= 0.05


def test_one_sided_p_values_of_two_and_two_seeds_are_those_of_their_six_orders():
    pair = np.array([3.0, 4.0]), np.array([1.0, 2.0])
    [(above, below)] = stats._above_and_below([pair], np.random.default_rng(0))
    assert above == pytest.approx(1 / 6, abs=0.01)
    assert below == 1.0


def test_one_seed_a_configuration_gives_no_test():
    means = {(algorithm, name): 0.0 for algorithm in ("ppo", "dqn") for name in "ab"}
    found = stats.interaction(table_of(means, n=1, scale={"ppo": 1, "dqn": 1}))
    assert np.isnan([found.p_ranks, found.p_raw]).all()
    assert found.n == 1


def test_survival_and_restricted_mean_with_and_without_censoring():
    steps = np.array([10.0, 20.0, 30.0, 40.0])
    assert stats.restricted_mean(steps, np.array([True] * 4), 100) == pytest.approx(25.0)
    censored = stats.restricted_mean(steps, np.array([True, True, False, False]), 100)
    assert censored == pytest.approx(10 + 0.75 * 10 + 0.5 * 80)  # half of them never end
    curve = stats.survival(steps, np.array([True, True, False, False]))
    assert curve.loc[20.0] == pytest.approx(0.5)
    assert curve.loc[40.0] == pytest.approx(0.5)


def test_seeds_needed_for_a_difference_of_one_standard_deviation_are_17_whatever_that_of_the_seeds_is():
    rng = np.random.default_rng(3)
    values = rng.normal(0, 1, 50)
    values = (values - values.mean()) / values.std(ddof=1)
    for seen in (0, 1, 50):
        # Cohen
        assert (
            stats.seeds_needed(values + seen, values, 1)
            == stats.seeds_needed(values + seen, values, -1)
            == 17
        )
        assert stats.seeds_needed(values + seen, values, 0) == np.inf
    assert np.isnan(stats.seeds_needed(values[:1], values, 1))
    assert np.isnan(stats.seeds_needed(values, values, np.nan))


@settings(max_examples=25, deadline=None)
@given(st.floats(0.25, 2.5), st.sampled_from([0.7, 0.8, 0.9]))
def test_seeds_needed_are_those_of_the_solver_of_statsmodels_rounded_up(effect, power):
    values = np.array([-1.0, 0.0, 1.0])  # a standard deviation of 1
    solved = TTestIndPower().solve_power(effect, alpha=0.05, power=power)
    assert stats.seeds_needed(values, values, effect, power) == max(2, np.ceil(solved - 1e-6))


@pytest.mark.parametrize("effect", [5.0, 8.0, 20.0, 50.0, 1e6, 1e12])
def test_seeds_needed_for_differences_too_large_for_that_solver_are_2_or_3(effect):
    values = np.array([-1.0, 0.0, 1.0])
    assert stats.seeds_needed(values, values, effect) == (3 if effect == 5.0 else 2)  # power 0.72 with 2
    assert stats.seeds_needed(np.ones(3), np.zeros(3), effect) == 2  # no spread at all


@pytest.mark.parametrize("effect", [1e-5, 1e-12, 1e-16])
def test_seeds_needed_for_a_tiny_difference_are_infinitely_many(effect):
    values = np.array([-1.0, 0.0, 1.0])
    assert stats.seeds_needed(values, values, effect) == np.inf


def test_where_bca_is_undefined_the_interval_is_of_percentiles_and_no_warning_escapes():
    values = np.array([0.0, 0.0, 0.0, 0.0, 1.0])  # without any one of them, the mean of the middle half is 0
    middle = stats.interquartile_mean
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = stats.interval(values, middle)
        assert stats.interval([1.0, 2.0], middle)[1:3] == (1.0, 2.0)
    options = {"n_resamples": stats.RESAMPLES, "rng": np.random.default_rng(0)}
    with warnings.catch_warnings(action="ignore"):
        assert np.isnan(bootstrap((values,), middle, method="BCa", **options).confidence_interval.low)
    percentiles = bootstrap(
        (values,), middle, method="percentile", **options | {"rng": np.random.default_rng(0)}
    )
    assert (found.low, found.high) == tuple(percentiles.confidence_interval)
    assert found.value == 0
    assert found.low == 0 < found.high


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(-100, 100), min_size=1, max_size=12))
def test_an_interval_of_any_seeds_is_known_from_2_on_without_a_warning(seeds):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for statistic in (np.mean, stats.interquartile_mean):
            found = stats.interval(seeds, statistic)
            assert np.isnan(found.low) == (len(seeds) == 1)
            assert len(seeds) == 1 or found.low <= found.value <= found.high
            resampled = statistic is not np.mean and len(seeds) > 1
            assert not resampled or min(seeds) - 1e-9 <= found.low <= found.high <= max(seeds) + 1e-9


def test_no_test_of_interaction_warns_where_seeds_are_all_alike():
    means = {(algorithm, name): 1.0 for algorithm in ("ppo", "dqn") for name in "abcd"}
    table = pd.DataFrame(
        [(*configuration, mean) for configuration, mean in means.items() for _ in range(3)],
        columns=["algorithm", "activation", "value"],
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = stats.interaction(table)
    assert found.p_ranks == 1.0
    assert found.n == 3


def test_fiellers_interval_of_a_ratio_covers_95_percent_of_correlated_seeds_and_is_exact_where_the_ratio_is():
    rng = np.random.default_rng(0)
    below = 5 + rng.standard_normal((2_000, 6))
    above = 3 + 0.5 * (below - 5) + rng.standard_normal((2_000, 6))
    found = [stats.ratio(*pair) for pair in zip(above, below, strict=True)]
    assert np.mean([one.low <= 0.6 <= one.high for one in found]) == pytest.approx(0.95, abs=0.015)
    exact = stats.ratio(2 * below[0], below[0])
    assert exact[:3] == pytest.approx((2, 2, 2))


def test_a_ratio_to_what_never_varies_has_students_interval():
    seeds = np.array([2.0, 3.0, 7.0])
    found = stats.ratio(seeds, np.full(3, 2.0))
    expected = t.interval(0.95, 2, seeds.mean() / 2, seeds.std(ddof=1) / 2 / 3**0.5)
    assert found[1:3] == pytest.approx(expected)


def test_a_ratio_to_what_may_be_zero_and_of_one_seed_has_no_interval():
    assert np.isnan(stats.ratio(np.array([1.0, 2.0, 3.0]), np.array([-1.0, 1.0, 0.1]))[1:3]).all()
    assert stats.ratio(np.array([1.0]), np.array([2.0])).value == 0.5
    assert np.isnan(stats.ratio(np.array([1.0]), np.array([2.0])).low)
    assert np.isnan(stats.ratio(np.array([]), np.array([])).value)


def test_numbers_taken_together_are_one_more_seed_as_hotelling_has_it():
    """Of one number it is Student's prediction interval; two that vary as one are no two."""
    rng = np.random.default_rng(0)
    seeds = rng.normal(size=(40, 1))
    edge = seeds.mean() + stdtrit(39, 0.975) * seeds.std(ddof=1) * np.sqrt(1 + 1 / 40)
    assert stats.joint(seeds, np.array([edge]))[0] == pytest.approx(0.05)
    assert np.isnan(stats.joint(np.hstack([seeds, 2 * seeds]), np.zeros(2))).all()
    assert np.isnan(stats.joint(seeds[:3], np.zeros(1))).all()
    six = rng.normal(size=(40, 6)) @ rng.normal(size=(6, 6))
    again = [stats.joint(draw[:40], draw[40])[0] for draw in rng.normal(size=(400, 41, 6))]
    assert np.mean(np.array(again) < 0.05) == pytest.approx(0.05, abs=0.025)
    assert stats.joint(six, six.mean(0))[1] == 0
    assert stats.joint(six, six.mean(0) + 1e3) == (pytest.approx(0, abs=1e-9), 1)
