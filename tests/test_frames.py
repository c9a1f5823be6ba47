"""The report's tables of numbers, on made-up cells: each is what the statistics say of values known by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from uavnav import stats
from uavnav.report import frames, tables
from uavnav.report.cells import EMPTY, Cell, read_as
from uavnav.report.claims import PRIMARY
from uavnav.report.studies import Studies, of_paper
from uavnav.report.verdicts import audit
from uavnav.runs import paper
from uavnav.runs.metrics import EPISODE_COLUMNS
from uavnav.runs.readings import ALL, EVALUATIONS, PER_FRAME, READINGS, TOTALS

SPREAD = (-1.0, 0.0, 1.0)


def episodes(*rows):
    """From (seed, steps, distance, reward[, terminated, truncated]); half of the steps turn."""
    full = []
    for seed, steps, distance, reward, *ends in rows:
        full.append((seed, 10, 0, 0, steps, 0, 0, steps / 2, distance, reward, *(ends or (True, False))))
    return pd.DataFrame(full, columns=list(EPISODE_COLUMNS)).astype(EPISODE_COLUMNS)


def run(seeds=(0,), progress=None, **meta):
    return SimpleNamespace(seeds=[*seeds], meta=meta, frames=1_000_000, progress=progress)


def cell(rewards, algorithm="ppo", activation="tanh", flown=EMPTY, runs=None, frames=100):
    """A seed for each reward, with one episode of 100 steps at 4 px."""
    rows = [(seed, 100, 400, reward) for seed, reward in enumerate(rewards)]
    runs = runs or [run(range(len(rewards)))]
    return Cell(algorithm, activation, {"frames": frames}, runs, episodes(*rows), flown)


def cells(**means):
    """Cells by `ppo_tanh` and so on: three seeds around a mean."""
    keys = {name: tuple(name.split("_", 1)) for name in means}
    return {keys[name]: cell([mean + one for one in SPREAD], *keys[name]) for name, mean in means.items()}


# -- values and estimates ---------------------------------------------------------------------------------------------


def test_a_row_for_each_seed_metric_and_reading():
    rows = episodes((0, 100, 400, -6.0), (0, 300, 2400, -2.0), (1, 400, 800, 3.0))
    one = Cell("dqn", "tanh", {"frames": 400}, [run([0, 1])], rows, EMPTY)
    found = frames.per_seed_values({("dqn", "tanh"): one})
    assert [*found] == ["algorithm", "activation", "reading", "metric", "seed", "value"]
    keyed = found.set_index(["reading", "metric", "seed"])["value"].sort_index()
    assert keyed[PER_FRAME, "reward"].tolist() == [-8 / 400, 3 / 400]
    assert keyed[PER_FRAME, "speed"].tolist() == keyed[TOTALS, "speed"].tolist() == [7, 2]
    assert keyed[ALL, "speed"].tolist() == [6, 2]
    assert keyed[ALL, "reward"].tolist() == [-4, 3]
    assert {*found["reading"]} == {*READINGS} - {*EVALUATIONS}  # there is none
    assert frames.per_seed_values({}).shape == (0, 6)


def test_estimates_are_the_statistics_of_the_seeds_beside_the_papers_number():
    rewards = [80.0, 90.0, 120.0, 70.0, 200.0]
    values = frames.per_seed_values({("ppo", "tanh"): cell(rewards), ("ppo", "mish"): cell([1.0], activation="mish")})
    found = frames.estimates(values).set_index(["activation", "reading", "metric"])
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


# -- comparisons ------------------------------------------------------------------------------------------------------


def test_every_pair_of_cells_and_how_probably_the_first_is_better():
    found = frames.improvement(cells(ppo_tanh=10, ppo_relu=0, dqn_tanh=10)).set_index(["a", "b"])["probability"]
    assert found.to_dict() == {
        ("PPO tanh", "PPO relu"): 1,
        ("PPO tanh", "DQN tanh"): 0.5,
        ("PPO relu", "DQN tanh"): 0,
    }


def test_interactions_by_metric_and_reading_of_the_papers_cells_alone():
    means = {f"{algorithm}_{activation}": 20 * place for place, (algorithm, activation) in enumerate(paper.TABLES)}
    found = frames.interactions(cells(**means, ppo_mish=1e6)).set_index(["reading", "metric"])
    assert len(found) == 6
    row = found.loc[PRIMARY, "reward"]
    assert row["n"] == 3
    assert row["p_ranks"] > 0.5  # the same order in both
    assert np.isnan(found.loc["sampled evaluation", "reward"]["p_ranks"])


def test_seeds_that_find_the_papers_difference_are_of_pairs_within_an_algorithm():
    study = cells(ppo_tanh=1, ppo_relu=0, dqn_tanh=5, dqn_sigmoid=5, ppo_mish=9)
    found = frames.power(study)
    assert found[["pair", "n"]].to_numpy().tolist() == [["DQN: tanh and sigmoid", 3], ["PPO: tanh and relu", 3]]
    seeds = [frames.of_seeds(study["ppo", one], PRIMARY) for one in ("tanh", "relu")]
    effect = 88.527 / 2727.577 - 43.598 / 1730.587
    assert found["seeds"][1] == stats.seeds_needed(*seeds, effect) > 17
    assert frames.power({}).shape == (0, 3)


# -- survival ---------------------------------------------------------------------------------------------------------


def test_a_cap_censors_and_the_restricted_mean_is_the_area_below_the_curve():
    """Seed 0 collides at 10 and 20 steps and is cut off at 30 and 40, so that half of it never ends; seed 1 collides
    at 100 and 300 steps: a mean of 200."""
    cut = (False, True)
    first = [(0, 10, 0, 0.0), (0, 20, 0, 0.0), (0, 30, 0, 0.0, *cut), (0, 40, 0, 0.0, *cut)]
    flown = episodes(*first, (1, 100, 0, 0.0), (1, 300, 0, 0.0)).assign(mode="sampled")
    one = cell([0.0, 0.0], flown=pd.concat([flown, episodes((0, 9999, 0, 0.0)).assign(mode="greedy")]))
    curves, table = frames.survival({("ppo", "tanh"): one, ("ppo", "relu"): cell([0.0], activation="relu")}, {})
    (row,) = table.to_dict("records")
    of_first = 10 + 0.75 * 10 + 0.5 * (frames.CAP - 20)
    assert row["restricted_mean"] == pytest.approx((of_first + 200) / 2)
    assert (row["cell"], row["n"], row["episodes"]) == ("PPO tanh", 2, 6)
    assert row["cut_off"] == pytest.approx(2 / 6)
    assert (row["low"], row["high"]) == pytest.approx((200, of_first))
    assert [*curves] == ["PPO tanh"]
    assert curves["PPO tanh"].loc[20.0] == pytest.approx(4 / 6)
    naive = flown.groupby("seed")["steps"].mean().mean()
    assert row["restricted_mean"] > 10 * naive  # as if a cap were a collision
    assert frames.survival({}, {})[1].shape == (0, 7)


# -- sensitivity ------------------------------------------------------------------------------------------------------


def studies(baseline, **switches):
    named = {name.replace("__", "="): found for name, found in switches.items()}
    return Studies({}, {}, baseline, {}, named, {}, {}, [])


def flips(table):
    return {(row.switch, row.conclusion): row.flips for row in table.itertuples()}


def test_a_switch_flips_a_conclusion_if_its_interval_lies_wholly_on_the_other_side_of_zero():
    base = cells(ppo_tanh=10, ppo_relu=0)
    found = frames.sensitivity(
        studies(
            base,
            slots__same=cells(ppo_tanh=20, ppo_relu=0),
            slots__flipped=cells(ppo_tanh=0, ppo_relu=10),
            slots__unclear=cells(ppo_tanh=0, ppo_relu=0.5),
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
    found = frames.sensitivity(studies(cells(ppo_tanh=0.1, ppo_relu=0), a__b=cells(ppo_tanh=0, ppo_relu=10)))
    assert flips(found)["a=b", "PPO: tanh above ReLU"] == "sign"
    base = {key: cell([mean], *key) for key, mean in {("ppo", "tanh"): 9.0, ("ppo", "relu"): 0.0}.items()}
    other = {key: cell([mean], *key) for key, mean in {("ppo", "tanh"): 0.0, ("ppo", "relu"): 9.0}.items()}
    assert flips(frames.sensitivity(studies(base, a__b=other)))["a=b", "PPO: tanh above ReLU"] == "sign"


def test_an_algorithm_that_a_switch_does_not_touch_is_taken_as_decided():
    base = cells(ppo_tanh=50, ppo_relu=30, dqn_tanh=-5, dqn_relu=-7)
    found = frames.sensitivity(studies(base, n_envs__1=cells(dqn_tanh=99, dqn_relu=77)))
    values = found.set_index(["switch", "conclusion"])["value"]
    assert values["default", "PPO above DQN"] == pytest.approx(0.46)
    assert values["n_envs=1", "PPO above DQN"] == pytest.approx(0.40 - 0.88)
    assert values["n_envs=1", "DQN: tanh above ReLU"] == pytest.approx(0.22)
    assert ("n_envs=1", "PPO: tanh above ReLU") not in values  # nothing of it was changed
    by = flips(found)
    assert by["n_envs=1", "PPO above DQN"] == "yes"
    assert by["n_envs=1", "DQN: tanh above ReLU"] == "no"


def test_without_a_study_as_decided_nothing_is_compared():
    found = frames.sensitivity(studies({}, a__b=cells(ppo_tanh=1)))
    assert [*found] == ["switch", "conclusion", "value", "low", "high", "n", "flips"]
    assert len(found) == 0
    alone = frames.sensitivity(studies({}, a__b=cells(ppo_tanh=9, ppo_relu=0)))
    assert alone["flips"].tolist() == [""]


# -- tuned ------------------------------------------------------------------------------------------------------------


def evaluated(**means):
    """Cells as of `cells` that were evaluated, with the same rewards."""
    return {key: replace(one, evaluation=one.episodes.assign(mode="sampled")) for key, one in cells(**means).items()}


def test_ppo_minus_dqn_tuned_is_of_the_activations_that_both_have_and_of_the_same_in_the_main_study():
    tuned = evaluated(ppo_tanh=30, ppo_relu=50, dqn_relu=10, dqn_sigmoid=99)
    main = evaluated(ppo_tanh=1, ppo_relu=5, dqn_tanh=99, dqn_relu=25)
    found = frames.by_default(Studies(main, {}, {}, {}, {}, {}, tuned, []))
    assert found[["settings", "activations", "value", "n"]].to_numpy().tolist() == [
        ["preset fast", "relu", 40, 3],
        ["main study", "relu", -20, 3],
    ]
    assert (found["low"] <= found["value"]).all()
    shown = tables.listed(found, tables.BY_DEFAULT)
    assert [row[-1].partition(" [")[0] for row in shown[1:]] == ["40.0", "−20.0"]


def test_without_an_activation_of_both_nothing_is_said_of_tuned():
    found = frames.by_default(Studies({}, {}, {}, {}, {}, {}, evaluated(ppo_tanh=30, dqn_relu=10), []))
    assert found["n"].tolist() == [0, 0]
    assert all(row[1:] == ["", "0", "–"] for row in tables.listed(found, tables.BY_DEFAULT)[1:])
    unevaluated = frames.by_default(Studies({}, {}, {}, {}, {}, {}, cells(ppo_tanh=1, dqn_tanh=2), []))
    assert unevaluated["value"].isna().all()


# -- the rest ---------------------------------------------------------------------------------------------------------


def test_wall_times_stand_beside_their_own_machine_even_where_a_run_has_none():
    runs = [
        run([0], machine={"processor": "unknown time"}),
        run([1, 2], machine={"processor": "an abacus"}, wall_seconds=7200),
        run([3], wall_seconds=60, machine="a slide rule"),
    ]
    found = frames.speed({("ppo", "tanh"): cell([0.0] * 4, runs=runs)})
    assert found.to_numpy().tolist() == [["PPO tanh", 3600, 2, "an abacus"], ["PPO tanh", 60, 1, "a slide rule"]]


def test_diagnostics_are_of_the_last_tenth_and_columns_that_a_run_lacks_have_no_row():
    progress = pd.DataFrame(
        {"seed": [0, 0, 0, 1, 1], "frame": [900, 901, 1000, 950, 1], "dormant": [9.0, 0.2, 0.4, 0.1, 9.0]}
    )
    found = frames.diagnostics({("ppo", "tanh"): cell([0, 0], runs=[run([0, 1], progress)], frames=1000)})
    (row,) = found.to_dict("records")
    assert (row["cell"], row["diagnostic"], row["n"]) == ("PPO tanh", "dormant", 2)
    assert row["value"] == pytest.approx(0.2)
    assert (row["low"], row["high"]) == pytest.approx((0.1, 0.3))


def test_flights_of_the_main_study_by_cell():
    table = pd.DataFrame({"mode": ["greedy"], "seed": [0], "corridor": [0.5]})
    found = frames.flown({("main", "ppo", "leaky_relu"): table, ("initial", "ppo", "tanh"): table})
    assert found["cell"].tolist() == ["PPO leaky_relu"]
    assert len(frames.flown({})) == 0


def test_baselines_are_read_and_a_foreign_file_is_named(tmp_path):
    folder = tmp_path / "baselines"
    folder.mkdir()
    episodes((0, 10, 90, -9.0)).to_parquet(folder / "straight.parquet")
    (folder / "damaged.parquet").write_bytes(b"PAR1")
    pd.DataFrame({"price": [1.0]}).to_parquet(folder / "foreign.parquet")
    (folder / "notes.txt").write_text("x")
    found, left_out = frames.baselines([tmp_path, tmp_path / "nowhere"])
    assert [*found] == ["straight"]
    assert found["straight"]["reward"].tolist() == [-9]
    damaged, foreign = left_out
    assert damaged.startswith(f"{folder / 'damaged.parquet'}: missing or damaged")
    assert foreign.startswith(f"{folder / 'foreign.parquet'}: its columns are not a run's")


def test_a_claims_grade_stands_beside_each_of_its_parts_in_every_reading():
    finding = audit(lambda *_, **__: np.empty(0), of_paper)[0]
    one = finding._replace(claim=1, verdict="replicates", standing="counts")
    audits = {
        "first": [one, one, one._replace(claim=2, verdict="open")],
        "second": [one, one._replace(verdict="reverses")],
    }
    found = frames.verdicts(audits)
    assert found["grade_of_claim"].tolist() == ["replicates", "replicates", "open", *["in part (1 of 2)"] * 2]
    assert found["reading"].tolist() == ["first"] * 3 + ["second"] * 2


def test_each_of_the_papers_numbers_is_held_against_one_more_seed_in_its_own_reading():
    def evidence(algorithm, activation, metric, study="main"):
        return (
            np.array([0.02, 0.03, 0.04])
            if (algorithm, activation, metric) == ("ppo", "tanh", "reward")
            else np.empty(0)
        )

    found = frames.predictions({PER_FRAME: evidence, ALL: evidence})
    assert len(found) == 2 * 48
    known = found[found["n"] > 0].set_index("reading")
    assert known["paper"].to_dict() == pytest.approx({PER_FRAME: 88.527 / 2727.577, ALL: 88.527})
    assert known["within"].to_dict() == {PER_FRAME: True, ALL: False}
    assert known["percentile"].to_dict() == pytest.approx({PER_FRAME: 200 / 3, ALL: 100})


def test_the_first_rules_verdicts_are_read_where_they_were_kept(tmp_path):
    assert frames.first_rule(tmp_path).empty
    (tmp_path / "tables").mkdir()
    (tmp_path / "tables" / "first_rule.csv").write_text(
        "claim,text,paper,value,low,high,p_holm,n,verdict,verdict_of_claim\n"
        "1,a part,1664,813.1,748.8,877.8,0.005,20,supported,contradicted\n"
    )
    assert frames.first_rule(tmp_path)["text"].tolist() == ["a part"]


@pytest.mark.parametrize(
    ("counts", "said"), [((), "0 seeds"), ((1, 1), "1 seed"), ((3, 3), "3 seeds"), ((10, 1, 5), "1 to 10 seeds")]
)
def test_how_many_seeds_there_are_in_words(counts, said):
    assert frames.least_to_most(counts, "seed") == said


def test_a_reading_is_worked_out_once_and_known_under_a_label_too(monkeypatch):
    asked = []
    monkeypatch.setattr("uavnav.report.cells.per_frame", lambda rows, n: asked.append(n) or rows[["seed", "reward"]])
    (one,) = cells(ppo_tanh=3).values()
    first = read_as(one, PER_FRAME)
    assert read_as(one, PER_FRAME) is first
    assert read_as(one.labelled("tanh (k=4)"), PER_FRAME) is first
    assert len(asked) == 1
    other = replace(one, episodes=one.episodes.assign(reward=5.0))  # other rows are read anew
    assert (read_as(other, PER_FRAME)["reward"] == 5).all()
    assert len(asked) == 2
