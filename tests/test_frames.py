"""The report's tables of numbers, on made-up configurations: each is what the statistics say of values
known by hand.
"""

import itertools
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from made_up import NO_STUDIES, configuration, episodes, run
from scipy.stats import kendalltau, ttest_1samp

from uavnav import stats
from uavnav.report import frames, tables
from uavnav.report.claims import PRIMARY
from uavnav.report.configurations import read_as
from uavnav.report.studies import evidence_of, of_paper
from uavnav.report.verdicts import audit
from uavnav.runs import paper
from uavnav.runs.definitions import ALL, DEFINITIONS, EVALUATIONS, LOG_CURVE, PER_FRAME, TOTALS
from uavnav.tasks.protocol import MAX_STEPS

SPREAD = (-1.0, 0.0, 1.0)


def own_episodes(*rows):
    """From (seed, steps, distance, reward[, terminated, truncated]); half of the steps turn."""
    made = episodes("seed steps distance reward terminated truncated", *rows)
    return made.assign(frame=10, turns=made["steps"] // 2)


def of_rewards(rewards, key=("ppo", "tanh"), frames=100, **more):
    """A seed for each reward, with one episode of 100 steps at 4 px."""
    return configuration(
        own_episodes(*((seed, 100, 400, reward) for seed, reward in enumerate(rewards))),
        key,
        frames=frames,
        **more,
    )


def configurations(**means):
    """Configurations by `ppo_tanh` and so on: three seeds around a mean."""
    keys = {name: tuple(name.split("_", 1)) for name in means}
    return {
        keys[name]: of_rewards([mean + one for one in SPREAD], keys[name]) for name, mean in means.items()
    }


# -- values and estimates ------------------------------------------------------------------------------------


def test_a_row_for_each_seed_metric_and_reading():
    one = configuration(
        own_episodes((0, 100, 400, -6.0), (0, 300, 2400, -2.0), (1, 400, 800, 3.0)),
        ("dqn", "tanh"),
        frames=400,
    )
    found = frames.per_seed_values({("dqn", "tanh"): one})
    assert [*found] == ["algorithm", "activation", "definition", "metric", "seed", "value"]
    keyed = found.set_index(["definition", "metric", "seed"])["value"].sort_index()
    assert keyed[PER_FRAME, "reward"].tolist() == [-8 / 400, 3 / 400]
    assert keyed[PER_FRAME, "speed"].tolist() == keyed[TOTALS, "speed"].tolist() == [7, 2]
    assert keyed[ALL, "speed"].tolist() == [6, 2]
    assert keyed[ALL, "reward"].tolist() == [-4, 3]
    assert {*found["definition"]} == {*DEFINITIONS} - {*EVALUATIONS}  # there is none
    assert frames.per_seed_values({}).shape == (0, 6)


def test_estimates_are_the_statistics_of_the_seeds_beside_the_papers_number():
    rewards = [80.0, 90.0, 120.0, 70.0, 200.0]
    values = frames.per_seed_values(
        {("ppo", "tanh"): of_rewards(rewards), ("ppo", "mish"): of_rewards([1.0], ("ppo", "mish"))}
    )
    found = frames.estimates(values).set_index(["activation", "definition", "metric"])
    row = found.loc["tanh", ALL, "reward"]
    mean, middle = stats.interval(rewards), stats.interval(rewards, stats.interquartile_mean)
    assert row[["mean", "low", "high", "n"]].tolist() == [112, mean.low, mean.high, 5]
    assert row[["interquartile_mean", "iqm_low", "iqm_high"]].tolist() == [*middle[:3]]
    assert middle.value == pytest.approx((80 + 90 + 120) / 3)
    assert row["paper"] == 88.527
    assert found.loc["tanh", PER_FRAME, "reward"][["mean", "paper"]].tolist() == [1.12, 88.527 / 2727.577]
    alone = found.loc["mish", ALL, "reward"]
    assert (alone["mean"], alone["n"]) == (1, 1)
    assert alone[["low", "high", "paper"]].isna().all()


def test_estimates_of_nothing_are_no_rows():
    found = frames.estimates(frames.per_seed_values({}))
    assert (len(found), found.columns[0], found.columns[-1]) == (0, "algorithm", "paper")


# -- comparisons ---------------------------------------------------------------------------------------------


def test_every_pair_of_configurations_and_how_probably_the_first_is_better():
    found = frames.improvement(configurations(ppo_tanh=10, ppo_relu=0, dqn_tanh=10)).set_index(["a", "b"])[
        "probability"
    ]
    assert found.to_dict() == {
        ("PPO tanh", "PPO relu"): 1,
        ("PPO tanh", "DQN tanh"): 0.5,
        ("PPO relu", "DQN tanh"): 0,
    }


def test_interactions_by_metric_and_definition_of_the_papers_configurations_alone():
    means = {
        f"{algorithm}_{activation}": 20 * place for place, (algorithm, activation) in enumerate(paper.TABLES)
    }
    found = frames.interactions(frames.per_seed_values(configurations(**means, ppo_mish=1e6))).set_index(
        ["definition", "metric"]
    )
    assert len(found) == 6
    row = found.loc[PRIMARY, "reward"]
    assert row["n"] == 3
    assert row["p_ranks"] > 0.5  # the same order in both
    assert np.isnan(found.loc["sampled evaluation", "reward"]["p_ranks"])


def test_a_report_on_further_studies_alone_says_nothing_of_interactions():
    found = frames.interactions(frames.per_seed_values({}))
    assert found["n"].tolist() == [0] * 6
    assert found["p_ranks"].isna().all()


def test_seeds_that_find_the_papers_difference_are_of_pairs_within_an_algorithm():
    study = configurations(ppo_tanh=1, ppo_relu=0, dqn_tanh=5, dqn_sigmoid=5, ppo_mish=9)
    found = frames.power(study)
    assert found[["pair", "n"]].to_numpy().tolist() == [
        ["DQN: tanh and sigmoid", 3],
        ["PPO: tanh and relu", 3],
    ]
    seeds = [frames.of_seeds(study["ppo", one], PRIMARY) for one in ("tanh", "relu")]
    effect = 88.527 / 2727.577 - 43.598 / 1730.587
    assert found["seeds"][1] == stats.seeds_needed(*seeds, effect) > 17
    assert frames.power({}).shape == (0, 3)


# -- survival ------------------------------------------------------------------------------------------------


def test_a_limit_censors_and_the_restricted_mean_is_the_area_below_the_curve():
    """Seed 0 collides at 10 and 20 steps and is cut off at 30 and 40, so that half of it never ends; seed 1
    collides at 100 and 300 steps: a mean of 200.
    """
    cut = (False, True)
    first = [(0, 10, 0, 0.0), (0, 20, 0, 0.0), (0, 30, 0, 0.0, *cut), (0, 40, 0, 0.0, *cut)]
    tested = own_episodes(*first, (1, 100, 0, 0.0), (1, 300, 0, 0.0)).assign(mode="sampled")
    one = of_rewards(
        [0.0, 0.0], tested=pd.concat([tested, own_episodes((0, 9999, 0, 0.0)).assign(mode="greedy")])
    )
    curves, table = frames.survival(
        {("ppo", "tanh"): one, ("ppo", "relu"): of_rewards([0.0], ("ppo", "relu"))}, {}
    )
    (row,) = table.to_dict("records")
    of_first = 10 + 0.75 * 10 + 0.5 * (MAX_STEPS - 20)
    assert row["restricted_mean"] == pytest.approx((of_first + 200) / 2)
    assert (row["configuration"], row["n"], row["episodes"]) == ("PPO tanh", 2, 6)
    assert row["truncated"] == pytest.approx(2 / 6)
    interval = ttest_1samp([200, of_first], 0).confidence_interval()
    assert (row["low"], row["high"]) == pytest.approx(tuple(interval))
    assert [*curves] == ["PPO tanh"]
    assert curves["PPO tanh"].loc[20.0] == pytest.approx(4 / 6)
    naive = tested.groupby("seed")["steps"].mean().mean()
    assert row["restricted_mean"] > 10 * naive  # as if a time limit were a collision
    assert frames.survival({}, {})[1].shape == (0, 7)


# -- sensitivity ---------------------------------------------------------------------------------------------


def studies(baseline, **switches):
    named = {name.replace("__", "="): found for name, found in switches.items()}
    return NO_STUDIES._replace(baseline=baseline, switches=named)


def flips(table):
    return {(row.switch, row.conclusion): row.flips for row in table.itertuples()}


def test_a_switch_flips_a_conclusion_if_its_interval_lies_wholly_on_the_other_side_of_zero():
    base = configurations(ppo_tanh=10, ppo_relu=0)
    found = frames.sensitivity(
        studies(
            base,
            slots__same=configurations(ppo_tanh=20, ppo_relu=0),
            slots__flipped=configurations(ppo_tanh=0, ppo_relu=10),
            slots__unclear=configurations(ppo_tanh=0, ppo_relu=0.5),
        )
    )
    (conclusion,) = set(found["conclusion"])
    assert conclusion == "PPO: tanh above ReLU"
    by = flips(found)
    assert by["default", conclusion] == ""
    assert by["slots=same", conclusion] == "no"
    assert by["slots=flipped", conclusion] == "yes"
    assert by["slots=unclear", conclusion] == "sign"
    assert found["value"].tolist() == pytest.approx([0.1, 0.2, -0.1, -0.005])
    assert found["n"].tolist() == [3] * 4
    unclear = found[found["switch"] == "slots=unclear"].iloc[0]
    assert unclear["low"] < 0 < unclear["high"]


def test_an_unclear_conclusion_cannot_be_flipped_and_one_seed_neither():
    found = frames.sensitivity(
        studies(configurations(ppo_tanh=0.1, ppo_relu=0), a__b=configurations(ppo_tanh=0, ppo_relu=10))
    )
    assert flips(found)["a=b", "PPO: tanh above ReLU"] == "sign"
    base = {
        key: of_rewards([mean], key) for key, mean in {("ppo", "tanh"): 9.0, ("ppo", "relu"): 0.0}.items()
    }
    other = {
        key: of_rewards([mean], key) for key, mean in {("ppo", "tanh"): 0.0, ("ppo", "relu"): 9.0}.items()
    }
    assert flips(frames.sensitivity(studies(base, a__b=other)))["a=b", "PPO: tanh above ReLU"] == "sign"


def test_an_algorithm_that_a_switch_does_not_touch_is_taken_as_decided():
    base = configurations(ppo_tanh=50, ppo_relu=30, dqn_tanh=-5, dqn_relu=-7)
    found = frames.sensitivity(studies(base, n_envs__1=configurations(dqn_tanh=99, dqn_relu=77)))
    values = found.set_index(["switch", "conclusion"])["value"]
    assert values["default", "PPO above DQN"] == pytest.approx(0.46)
    assert values["n_envs=1", "PPO above DQN"] == pytest.approx(0.40 - 0.88)
    assert values["n_envs=1", "DQN: tanh above ReLU"] == pytest.approx(0.22)
    assert ("n_envs=1", "PPO: tanh above ReLU") not in values  # nothing of it was changed
    by = flips(found)
    assert by["n_envs=1", "PPO above DQN"] == "yes"
    assert by["n_envs=1", "DQN: tanh above ReLU"] == "no"


def test_without_a_study_as_decided_nothing_is_compared():
    found = frames.sensitivity(studies({}, a__b=configurations(ppo_tanh=1)))
    assert [*found] == ["switch", "conclusion", "value", "low", "high", "n", "flips"]
    assert len(found) == 0
    alone = frames.sensitivity(studies({}, a__b=configurations(ppo_tanh=9, ppo_relu=0)))
    assert alone["flips"].tolist() == [""]


# -- tuned ---------------------------------------------------------------------------------------------------


def evaluated(**means):
    """Configurations as of `configurations` that were evaluated, with the same rewards."""
    return {
        key: replace(one, evaluation=one.episodes.assign(mode="sampled"))
        for key, one in configurations(**means).items()
    }


def test_ppo_minus_dqn_tuned_is_of_the_activations_that_both_have_and_of_the_same_in_the_main_study():
    tuned = evaluated(ppo_tanh=30, ppo_relu=50, dqn_relu=10, dqn_sigmoid=99)
    main = evaluated(ppo_tanh=1, ppo_relu=5, dqn_tanh=99, dqn_relu=25)
    winners = evaluated(ppo_tanh=7, dqn_tanh=4, sac_tanh=99)
    found = frames.by_default(NO_STUDIES._replace(main=main, tuned=tuned), winners)
    assert found[["settings", "activations", "value", "n"]].to_numpy().tolist() == [
        ["preset fast", "relu", 40, 3],
        ["main study", "relu", -20, 3],
        ["tuned", "tanh", 3, 3],
        ["preset fast − tuned", "relu", 37, 3],
    ]
    one, other, both = (found["high"] - found["value"])[[0, 2, 3]]
    assert max(one, other) < both < one + other  # errors of independent seeds add in squares
    assert (found["low"] <= found["value"]).all()
    shown = tables.listed(found, "by_default")
    assert [row[-1].partition(" [")[0] for row in shown[1:]] == ["40.0", "−20.0", "3.0", "37.0"]


def test_without_an_activation_of_both_nothing_is_said_of_tuned():
    found = frames.by_default(NO_STUDIES._replace(tuned=evaluated(ppo_tanh=30, dqn_relu=10)), {})
    assert found["n"].tolist() == [0, 0]
    assert all(row[1:] == ["", "0", "–"] for row in tables.listed(found, "by_default")[1:])
    unevaluated = frames.by_default(NO_STUDIES._replace(tuned=configurations(ppo_tanh=1, dqn_tanh=2)), {})
    assert unevaluated["value"].isna().all()


# -- the rest ------------------------------------------------------------------------------------------------


def test_wall_times_stand_beside_their_own_machine_even_where_a_run_has_none():
    runs = [
        run([0], machine={"processor": "unknown time"}),
        run([1, 2], machine={"processor": "an abacus"}, wall_seconds=7200),
        run([3], wall_seconds=60),
    ]
    found = frames.speed({("ppo", "tanh"): of_rewards([0.0] * 4, runs=runs)})
    assert found.to_numpy().tolist() == [
        ["PPO tanh", 3600, 2, "an abacus"],
        ["PPO tanh", 60, 1, "not known"],
    ]


def test_diagnostics_are_of_the_last_tenth_and_columns_that_a_run_lacks_have_no_row():
    progress = pd.DataFrame(
        {"seed": [0, 0, 0, 1, 1], "frame": [900, 901, 1000, 950, 1], "dormant": [9.0, 0.2, 0.4, 0.1, 9.0]}
    )
    found = frames.diagnostics(
        {("ppo", "tanh"): of_rewards([0, 0], runs=[run([0, 1], progress)], frames=1000)}
    )
    (row,) = found.to_dict("records")
    assert (row["configuration"], row["diagnostic"], row["n"]) == ("PPO tanh", "dormant", 2)
    assert row["value"] == pytest.approx(0.2)
    interval = ttest_1samp([0.3, 0.1], 0).confidence_interval()
    assert (row["low"], row["high"]) == pytest.approx(tuple(interval))


def test_episodes_of_the_main_study_by_configuration():
    table = pd.DataFrame({"mode": ["greedy"], "seed": [0], "corridor": [0.5]})
    found = frames.watched({("main", "ppo", "leaky_relu"): table, ("initial", "ppo", "tanh"): table})
    assert found["configuration"].tolist() == ["PPO leaky_relu"]
    assert len(frames.watched({})) == 0


def test_baselines_are_read_and_a_foreign_file_is_named(tmp_path):
    folder = tmp_path / "baselines"
    folder.mkdir()
    own_episodes((0, 10, 90, -9.0)).to_parquet(folder / "straight.parquet")
    (folder / "damaged.parquet").write_bytes(b"PAR1")
    pd.DataFrame({"price": [1.0]}).to_parquet(folder / "foreign.parquet")
    (folder / "notes.txt").write_text("x")
    found, left_out = frames.baselines([tmp_path, tmp_path / "nowhere"])
    assert [*found] == ["straight"]
    assert found["straight"]["reward"].tolist() == [-9]
    damaged, foreign = left_out
    assert damaged.startswith(f"{folder / 'damaged.parquet'}: missing or damaged")
    assert foreign.startswith(f"{folder / 'foreign.parquet'}: its columns are not a run's")


def test_a_claims_grade_in_a_column_counts_its_parts_and_says_how_many_seeds_are_behind_it():
    finding = audit(lambda *_, **__: np.empty(0), of_paper)[0]
    one = finding._replace(claim=1, verdict="replicates", standing="counts", n=40)
    unevaluated = one._replace(claim=2, verdict="open", standing="no runs", n=0)
    audits = {"first": [one, one, unevaluated], "second": [one, one._replace(verdict="reverses", n=5)]}
    found = frames.grades(audits)
    assert found.to_numpy().tolist() == [
        [1, "first", "replicates", 2, 2, 40, 40],
        [1, "second", "in part", 1, 2, 5, 40],
    ]
    assert frames.verdicts(audits)["column"].tolist() == ["first"] * 3 + ["second"] * 2


def test_one_run_a_configuration_names_the_best_and_gives_the_papers_order_as_often_as_all_draws_do():
    rng = np.random.default_rng(0)
    four = {
        one: rng.normal(place, 1.5, 7) for place, one in enumerate(("sigmoid", "leaky_relu", "relu", "tanh"))
    }
    rows = [("ppo", one, PER_FRAME, "reward", own) for one, own in four.items()]
    values = pd.DataFrame(
        [(*key, seed, value) for *key, own in rows for seed, value in enumerate(own)],
        columns=["algorithm", "activation", "definition", "metric", "seed", "value"],
    )
    found = frames.one_run(values).set_index("what")["share"]
    draws = [dict(zip(four, drawn, strict=True)) for drawn in itertools.product(*four.values())]
    for one in four:
        assert found[f"{one} is best"] == pytest.approx(
            np.mean([max(own, key=own.get) == one for own in draws])
        )
    order = ["tanh", "relu", "leaky_relu", "sigmoid"]  # 0.0325, 0.0252, 0.0234 and 0.0202 a frame
    in_order = [all(own[a] > own[b] for a, b in itertools.pairwise(order)) for own in draws]
    assert 0 < found["the paper's order"] == pytest.approx(np.mean(in_order))
    assert frames.one_run(values[values["activation"] != "relu"]).empty


def test_seeds_that_pass_the_scripted_policy_are_counted_by_algorithm_and_mode():
    gaps = pd.DataFrame(
        [
            ("reactive", "", "scripted", 1, np.nan),
            ("a", "ppo", "sampled", 40, 0.05),
            ("b", "ppo", "sampled", 40, 0.025),
        ],
        columns=["who", "algorithm", "mode", "n", "above"],
    )
    assert frames.passing(gaps).to_numpy().tolist() == [["ppo", "sampled", 3, 80]]


def test_each_of_the_papers_numbers_is_held_against_one_more_seed_in_its_own_reading():
    def evidence(algorithm, activation, metric, study="main"):
        return (
            np.array([0.02, 0.03, 0.04])
            if (algorithm, activation, metric) == ("ppo", "tanh", "reward")
            else np.empty(0)
        )

    found = frames.predictions({PER_FRAME: evidence, ALL: evidence})
    assert len(found) == 2 * 48
    known = found[found["n"] > 0].set_index("definition")
    assert known["paper"].to_dict() == pytest.approx({PER_FRAME: 88.527 / 2727.577, ALL: 88.527})
    assert known["within"].to_dict() == {PER_FRAME: True, ALL: False}
    assert known["percentile"].to_dict() == pytest.approx({PER_FRAME: 200 / 3, ALL: 100})


@pytest.mark.parametrize(
    ("counts", "said"),
    [((), "0 seeds"), ((1, 1), "1 seed"), ((3, 3), "3 seeds"), ((10, 1, 5), "1 to 10 seeds")],
)
def test_how_many_seeds_there_are_in_words(counts, said):
    assert frames.least_to_most(counts, "seed") == said


def test_a_definition_is_worked_out_once(monkeypatch):
    asked = []
    monkeypatch.setattr(
        "uavnav.report.configurations.per_frame", lambda rows, n: asked.append(n) or rows[["seed", "reward"]]
    )
    (one,) = configurations(ppo_tanh=3).values()
    first = read_as(one, PER_FRAME)
    assert read_as(one, PER_FRAME) is first
    assert len(asked) == 1
    other = replace(one, episodes=one.episodes.assign(reward=5.0))  # other rows are read anew
    assert (read_as(other, PER_FRAME)["reward"] == 5).all()
    assert len(asked) == 2


# -- gaps to `reactive`, effects, peaks, fits, sizes of studies ----------------------------------------------

KEY = ("dqn", "sigmoid")


def on_sets(*rows):
    """From (seed, layout, steps, reward, cut off)."""
    made = episodes("seed layout steps reward truncated", *rows)
    return made.assign(terminated=~made["truncated"])


def in_stretches(*seeds, frames=1_000_000, key=KEY, **more):
    """A configuration from the rewards of each seed's ten stretches of 100,000 frames, each one episode."""
    rows = [
        (seed, (place + 1) * 100_000, 100_000, reward - 10)
        for seed, rewards in enumerate(seeds)
        for place, reward in enumerate(rewards)
    ]
    return configuration(
        episodes("seed frame steps reward", *rows), key, frames=frames, n_envs=1, n_seeds=len(seeds), **more
    )


REACTIVE = on_sets((0, 0, 100, 40.0, True), (0, 1, 100, 60.0, True))


def test_the_gap_is_each_seeds_mean_over_the_layouts_that_reactive_flew_with_students_interval():
    """Seed 0 is 10 and 30 below `reactive`, seed 1 20 above and 0: gaps of -20 and 10, which differ by 30."""
    mine = [
        (0, 0, 100, 30.0, True),
        (0, 1, 50, 30.0, False),
        (1, 0, 100, 60.0, True),
        (1, 1, 100, 60.0, True),
    ]
    greedy = [(0, 0, 100, 40.0, True)]
    tested = pd.concat([on_sets(*mine).assign(mode="sampled"), on_sets(*greedy).assign(mode="greedy")])
    reactive, first, second = frames.gaps(
        {KEY: in_stretches([0.0], tested=tested)}, {"reactive": REACTIVE}
    ).to_dict("records")
    assert (
        reactive["who"],
        reactive["reward"],
        reactive["truncated"],
        reactive["per_frame"],
        reactive["limit"],
    ) == (
        "reactive",
        50,
        1,
        0.5,
        100,
    )
    assert np.isnan([reactive["gap"], reactive["above"], reactive["low"]]).all()
    assert (first["mode"], first["gap"], first["n"], first["above"]) == ("greedy", 0, 1, 0)
    assert np.isnan(first["gap_low"])
    assert (second["who"], second["mode"], second["n"], second["episodes"]) == (
        "DQN sigmoid",
        "sampled",
        2,
        4,
    )
    assert (second["reward"], second["truncated"], second["gap"], second["above"]) == (45, 0.75, -5, 0.5)
    half = 12.706 * 15  # t with one degree of freedom, times 30 / 2
    assert (second["gap_low"], second["gap_high"]) == pytest.approx((-5 - half, -5 + half), rel=1e-4)
    assert second["per_frame"] == pytest.approx((60 / 150 + 120 / 200) / 2)


@pytest.mark.parametrize(
    "mine",
    [
        [(0, 0, 40, 30.0, True)],  # below another time limit
        [(0, 2, 100, 30.0, True)],  # on a layout that `reactive` did not fly
    ],
)
def test_episodes_of_another_test_have_no_gap(mine):
    own = in_stretches([0.0], tested=on_sets(*mine).assign(mode="sampled"))
    found = frames.gaps({KEY: own}, {"reactive": REACTIVE})
    assert found["gap"].isna().all()
    assert found["reward"].tolist() == [50, 30]
    assert frames.gaps({KEY: own}, {})["gap"].isna().all()
    assert frames.gaps({}, {}).empty


def test_an_effect_is_the_setting_minus_as_decided_over_the_activations_of_both():
    def of(*rewards, activation="tanh"):
        return in_stretches(*([reward] * 10 for reward in rewards), key=("dqn", activation))

    usual = {("dqn", "tanh"): of(0.0, 200.0), ("dqn", "relu"): of(50.0, 150.0, activation="relu")}
    switch = {("dqn", "tanh"): of(600.0, 1000.0), ("ppo", "tanh"): of(9.0, 9.0)}
    found = frames.effects(NO_STUDIES._replace(baseline=usual, switches={"n_steps=5": switch}))
    (row,) = found.to_dict("records")
    expected = stats.difference([np.array([0.006, 0.01])], [np.array([0.0, 0.002])])
    assert (row["switch"], row["algorithm"], row["frames"], row["n"]) == ("n_steps=5", "dqn", 1_000_000, 2)
    assert (row["value"], row["low"], row["high"]) == pytest.approx(expected[:3])
    assert row["value"] == pytest.approx(0.007)
    both = frames.effects(NO_STUDIES._replace(main=usual, vectorised={("dqn", "tanh"): of(0.0, 0.0)}))
    assert both[["switch", "algorithm", "value"]].to_numpy().tolist() == [
        ["many environments", "dqn", pytest.approx(-0.001)]
    ]
    assert frames.effects(NO_STUDIES).empty


def test_a_configuration_that_rises_by_100_and_falls_by_75_loses_three_quarters_and_peaks_where_it_is_best():
    """Rewards of 0 a stretch of 100,000 frames, 100 in the next three, 25 at the end; others up to 1.4
    times it.
    """
    seed = np.array([0, 0, 0, 100, 100, 101, 25, 25, 25, 25.0])
    times = (1, 1.1, 1.2, 1.3, 1.4)
    logged = {"reward_before": -5.0, "reward_surge": 15.0, "reward_after": 3.0}

    def log(algorithm, activation, metric):
        """By the log the first four lose 60 % of the rise, the last one loses 45 %."""
        return np.array([logged[metric]] * 4 + [6.0 if metric == "reward_after" else logged[metric]])

    def peaks(one):
        studies = NO_STUDIES._replace(main={KEY: one})
        training = evidence_of(studies, PER_FRAME, {})
        return frames.peaks(studies.main, {PER_FRAME: training, LOG_CURVE: log})

    found = peaks(in_stretches(*(seed * one for one in times))).set_index("measure")
    assert found.loc["surge, SB3's log", "value"] == 15
    assert found.loc["lost, SB3's log", "value"] == pytest.approx((15 - 3.6) / 20)
    assert found.loc["seeds that lose half, SB3's log", ["value", "n"]].tolist() == [4, 5]
    assert found.loc["lost", "value"] == pytest.approx((301 / 3 - 25) / (301 / 3))
    # the share is the same in both
    assert found.loc["lost", "low"] == pytest.approx(found.loc["lost", "high"])
    # the first of the stretches of 40,000 frames within
    assert found.loc["peak", "value"] == pytest.approx(540_000)
    assert peaks(in_stretches(seed, frames=600_000)).empty


def test_numbers_within_are_counted_for_all_configurations_and_for_and_those_without_seeds_are_left_out():
    """A number of 10 in an interval of 4 scores 4 / 10; one 3 beside an interval of 6 scores (6 + 40 x 3)
    / 10.
    """
    rows = [
        ("ppo", "tanh", 10.0, 8.0, 12.0, True, 8),
        ("ppo", "tanh", -10.0, -7.0, -1.0, False, 8),
        ("dqn", "relu", 10.0, 7.0, 13.0, True, 8),
        ("dqn", "tanh", 10.0, np.nan, np.nan, False, 0),
    ]
    columns = ["algorithm", "activation", "paper", "low", "high", "within", "n"]
    table = pd.DataFrame(rows, columns=columns).assign(definition="per frame", metric="reward")
    no_seeds = {"per frame": lambda *term: np.empty(0)}
    found = frames.fits(table, no_seeds).set_index("configuration")
    assert found[["within", "numbers"]].T.to_dict("list") == {
        "all configurations": [2, 3],
        "DQN relu": [1, 1],
        "PPO tanh": [1, 2],
    }
    assert found["score"].round(9).to_dict() == {
        "all configurations": 4.533333333,
        "DQN relu": 0.6,
        "PPO tanh": 6.5,
    }
    assert found[["p", "farther"]].isna().all(axis=None)
    assert frames.fits(table[:0], no_seeds).empty


def test_each_study_has_a_row_a_configuration_and_the_main_one_those_of_the_papers_activations():
    key, other = ("ppo", "tanh"), ("ppo", "mish")
    main = {key: in_stretches([0.0], [0.0], key=key), other: in_stretches([0.0], key=other)}
    found = frames.sizes(
        NO_STUDIES._replace(
            main=main, switches={"k=4": {other: in_stretches([0.0], key=other, frames=300_000)}}
        )
    )
    assert found.to_numpy().tolist() == [["main", *key, 2, 1_000_000, 1], ["k=4", *other, 1, 300_000, 1]]


# -- one environment a seed against many: studies with known scatter, open episodes and order ----------------

FRAMES = 1_000_000


def in_envs(n_envs=1, **configurations):
    """Configurations of DQN, an activation each, from (reward in the last 100,000 frames, steps of each open
    episode) a seed.

    Whatever is not open is one episode of all frames until then; each open episode earns nothing.
    """
    made = {}
    for activation, seeds in configurations.items():
        rows = []
        for seed, (reward, *open_episodes) in enumerate(seeds):
            rows.append((seed, FRAMES - 100_000, 800_000, -10.0))
            rows.append((seed, FRAMES, 100_000 // n_envs, reward - 10))
            rows += [(seed, FRAMES, steps, 0.0, False) for steps in open_episodes]
        key = ("dqn", activation)
        made[key] = configuration(
            episodes("seed frame steps reward terminated", *rows), key, frames=FRAMES, n_envs=n_envs
        )
    return made


def worlds(one, many):
    return frames.one_against_many(NO_STUDIES._replace(main=one, vectorised=many)).set_index("measure")


def spread(middle, half):
    """Five seeds whose standard deviation is `half`."""
    return [(middle + half * one,) for one in (-1.0, -1.0, 0.0, 1.0, 1.0)]


def test_scatter_is_the_difference_of_standard_deviations_late_in_training_mean_over_activations():
    one = in_envs(tanh=spread(5e3, 1000.0), relu=spread(9e3, 3000.0))
    many = in_envs(16, tanh=spread(0.0, 500.0), relu=spread(3e3, 500.0), sigmoid=spread(0.0, 9e9))
    row = worlds(one, many).loc["scatter"]
    scale = stats.deviations(
        np.array([-1.0, -1.0, 0.0, 1.0, 1.0])
    ).mean()  # the jackknife's, of a deviation of 1
    assert scale == pytest.approx(1, abs=0.1)
    assert row["value"] == pytest.approx(scale * (0.01 + 0.03 - 0.005 - 0.005) / 2)
    assert (row["algorithm"], row["n"]) == ("dqn", 5)
    assert row["low"] < row["value"] < row["high"]


def test_open_episodes_are_those_of_each_seed_that_no_crash_ended():
    one = in_envs(tanh=[(0.0, 600_000), (0.0, 200_000), (0.0,)])
    many = in_envs(16, tanh=[(0.0, 30_000, 10_000), (0.0, 20_000, 20_000), (0.0, 40_000)])
    found = worlds(one, many)
    assert found.loc["longest", "value"] == pytest.approx(
        (600_000 + 200_000 + 0 - 30_000 - 20_000 - 40_000) / 3
    )
    assert found.loc["open", "value"] == pytest.approx((0.6 + 0.2 + 0 - 3 * 0.04) / 3)


def test_the_order_is_kendalls_tau_of_the_activations_means():
    rewards = {"tanh": 4e4, "sigmoid": 1e4, "relu": 3e4, "leaky_relu": 2e4}
    one = in_envs(**{name: spread(own, 1.0) for name, own in rewards.items()})
    row = worlds(one, one).loc["order"]
    assert row[["value", "low", "high"]].tolist() == pytest.approx([1, 1, 1])
    turned = in_envs(16, **{name: spread(-own, 1.0) for name, own in rewards.items()})
    assert worlds(one, turned).loc["order", ["value", "low", "high"]].tolist() == pytest.approx([-1, -1, -1])


def test_without_a_study_in_one_world_there_is_nothing_to_compare():
    main = in_envs(16, tanh=spread(0.0, 1.0))
    assert frames.one_against_many(NO_STUDIES._replace(main=main)).empty
    assert [*frames.one_against_many(NO_STUDIES)] == ["measure", "algorithm", "value", "low", "high", "n"]


def test_the_jackknifes_deviations_are_a_slow_loops_and_their_mean_is_nearly_the_standard_deviation():
    seeds = np.random.default_rng(0).normal(3, 2, size=12)
    slow = [
        12 * np.std(seeds, ddof=1) - 11 * np.std([*seeds[:i], *seeds[i + 1 :]], ddof=1) for i in range(12)
    ]
    assert stats.deviations(seeds) == pytest.approx(slow)
    assert stats.deviations(seeds).mean() == pytest.approx(seeds.std(ddof=1), rel=0.05)
    assert np.isnan(stats.deviations(np.array([1.0, 2.0]))).all()
    assert stats.deviations(np.full(5, 7.0)).tolist() == [0.0] * 5


@pytest.mark.parametrize("n", [20, 40])
def test_the_interval_of_a_difference_of_deviations_covers_it_in_about_95_percent_of_400_draws(n):
    rng, covered = np.random.default_rng(n), 0
    for _ in range(400):
        first, second = rng.normal(0, 5, size=(4, n)), rng.normal(0, 2, size=(4, 20))
        found = stats.difference([*map(stats.deviations, first)], [*map(stats.deviations, second)])
        covered += found.low <= 3 <= found.high
    assert 0.91 <= covered / 400 <= 0.98


def test_kendalls_tau_is_scipys_and_its_interval_takes_pairs_that_are_not_told_apart_both_ways():
    rng = np.random.default_rng(2)
    first = [rng.normal(mean, 0.1, size=20) for mean in (0, 3, 1, 2)]
    second = [rng.normal(mean, 0.1, size=40) for mean in (0, 3, 2, 1)]
    found = stats.concordance(first, second)
    expected = kendalltau([own.mean() for own in first], [own.mean() for own in second]).statistic
    assert (found.value, found.n) == (pytest.approx(expected), 20)
    assert found[1:3] == (pytest.approx(2 / 3), pytest.approx(2 / 3))  # every pair is told apart in both
    near = [first[0], first[1], first[2], first[2] + 0.01 * rng.normal(size=20)]
    assert stats.concordance(near, second)[1:3] == (pytest.approx(2 / 3), pytest.approx(1))
    wide = stats.concordance([100 * rng.normal(size=20) + own for own in first], second)
    assert wide[1:3] == (-1, 1)


def test_one_configuration_or_one_seed_has_no_order_and_equal_means_leave_it_open():
    two = [np.array([1.0, 2.0]), np.array([3.0, 4.0])]
    for first in (two[:1], [np.array([1.0]), two[1]]):
        assert np.isnan(stats.concordance(first, two[: len(first)])[:3]).all()
    assert stats.concordance([two[0], two[0]], two) == (0, -1, 1, 2)
    assert np.isnan(stats.concordance([np.array([np.nan, 2.0]), two[1]], two)[:3]).all()


def test_nobody_is_said_to_pass_a_scripted_policy_that_did_not_fly():
    gaps = pd.DataFrame({"algorithm": ["", "ppo"], "mode": "sampled", "above": [np.nan, np.nan], "n": [1, 3]})
    assert frames.passing(gaps).empty
