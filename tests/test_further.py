"""Studies that lie apart: their tables of made-up rows with known answers."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from runs_by_hand import rows, two, write_run
from scipy import special

from uavnav import stats, studies
from uavnav.errors import ConfigError
from uavnav.evaluation import Protocol
from uavnav.report import activations, ambiguities, horizon, learned, longer, noise
from uavnav.report.apart import Evaluated, evaluations
from uavnav.runs import Run, draws, paper
from uavnav.studies import search
from uavnav.studies.draws import plan

WIDE = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
"""Deviations of five seeds from their mean."""


def five_seeds(reward, algorithm="ppo", settings="fast", frames=1, gamma=0.99, scripted=24.0, **how):
    """How five seeds of a configuration flew: one episode each, all of them to the time limit."""
    config = {"activation": "tanh", "total_frames": frames, "gamma": gamma}
    path = Path(settings, algorithm, "tanh")
    run = SimpleNamespace(path=path, algorithm=algorithm, config=config, frames=frames)
    how = {"layouts": "test", "max_steps": 10, "at": 1.0} | how
    rows = pd.DataFrame({"seed": range(5), "truncated": True})
    return Evaluated(f"{algorithm} tanh", run, how, rows, reward, scripted, reward - scripted)


def test_who_leads_is_chosen_on_validation_layouts_and_its_lead_is_of_test_layouts():
    better = {("fast", "ppo"): 30.0, ("default", "ppo"): 20.0, ("fast", "dqn"): 10.0, ("tuned", "dqn"): 5.0}
    judged = {("fast", "ppo"): 24.0, ("default", "ppo"): 40.0, ("fast", "dqn"): 12.0, ("tuned", "dqn"): 50.0}
    table = longer.table(
        [
            five_seeds(mean + WIDE, algorithm, settings, layouts=layouts)
            for layouts, told in (("validation", better), ("test", judged))
            for (settings, algorithm), mean in told.items()
        ]
    )
    (leader,) = table.query("layouts == 'test' and leads").to_dict("records")
    assert (leader["settings"], leader["algorithm"], leader["value"]) == ("fast", "ppo", 24.0)
    assert leader["lead"] == pytest.approx(24 - 12)  # DQN tuned is better there, but was not chosen
    half = 2.306 * np.sqrt(2.5 / 5 + 2.5 / 5)  # t of 8 degrees of freedom
    assert leader["lead_high"] - leader["lead"] == pytest.approx(half, abs=1e-3)
    assert (leader["gap"], leader["above"], leader["scripted"]) == (0.0, 2, 24.0)
    assert longer.figure(table.query("layouts == 'validation'")).alt.endswith("no data.")


def test_a_gain_is_seed_by_seed_over_the_length_before():
    short, long = 100 + 50 * WIDE, 120 + 50 * WIDE + 0.1 * WIDE[::-1]
    table = longer.table([five_seeds(short), five_seeds(long, frames=3)]).set_index("frames")
    assert table.loc[3, "gain"] == pytest.approx(20)
    assert table.loc[3, "gain_high"] - 20 == pytest.approx(2.776 * 0.1 * np.sqrt(2.5 / 5), abs=1e-3)
    assert (table.loc[1, "trend"], table.loc[3, "trend"]) == ("", "rises")
    assert not table["leads"].any()  # nothing was flown on validation layouts


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [(-9, 9, "saturated"), (1, 9, "saturated"), (1, 11, "rises"), (-11, -1, "falls"), (-11, 1, "open")],
)
def test_a_reward_is_saturated_where_its_change_lies_within_a_tenth_of_it(low, high, said):
    assert longer.trend(stats.Interval((low + high) / 2, low, high, 5), -100.0) == said


def evaluated(path, reward, protocol, **settings):
    """A run of two seeds that flew two test layouts."""
    one = [
        rows(seed, (9, 9, 0, 0, 0, 9, reward + seed), (9, 9, 0, 0, 0, 9, reward + seed)) for seed in (0, 1)
    ]
    episodes = pd.concat([seeds.assign(layout=[0, 1], mode="sampled") for seeds in one], ignore_index=True)
    run = write_run(path, *one, **{"algorithm": "ppo"} | settings)
    kept(run, protocol.file("evaluation"), episodes, protocol)
    return run


def kept(folder, name, episodes, protocol):
    folder.mkdir(parents=True, exist_ok=True)
    episodes.attrs = protocol.header()
    episodes.to_parquet(folder / name)


def test_what_training_with_noise_gains_is_over_training_without_it_under_the_same_noise(tmp_path):
    protocol = Protocol("test", 2, 9, "noise=5")
    for trained, reward in ((0.0, 1.0), (5.0, 4.0)):
        faults = {"noise": trained, "lost": 0.0, "late": 0, "sticky": 0.0}
        evaluated(tmp_path / f"noise/{trained:g}/ppo/tanh", reward, protocol, faults=faults)
    reactive = rows(0, (9, 9, 0, 0, 0, 9, 2.0), (9, 9, 0, 0, 0, 9, 3.0)).assign(layout=[0, 1])
    kept(tmp_path / "noise/baselines", protocol.file("reactive"), reactive, protocol)
    (tmp_path / "noise/baselines/random.parquet").write_bytes(b"damaged")
    found, left_out = evaluations([tmp_path], "noise")
    table = noise.table(found).set_index(["who", "trained"])
    assert [line.split(":")[0] for line in left_out] == [f"{tmp_path}/noise/baselines/random.parquet"]
    assert table.loc[("PPO tanh", 5.0), ["evaluated", "value", "gap", "gain", "above"]].tolist() == [
        5,
        4.5,
        2,
        3,
        2,
    ]
    assert table.loc[("PPO tanh", 0.0), ["evaluated", "value", "gap", "above"]].tolist() == [5, 1.5, -1, 0]
    assert np.isnan(table.loc[("PPO tanh", 0.0), "gain"])
    assert table.loc["reactive", "value"].tolist() == [2.5]


def test_folders_without_these_studies_have_no_tables(tmp_path):
    assert [study.gather([tmp_path]) for study in (ambiguities, activations, learned)] == [({}, [])] * 3
    assert [evaluations([tmp_path], study.STUDY) for study in (longer, noise, horizon)] == [([], [])] * 3
    write_run(tmp_path / "ambiguities/screen/00/dqn/tanh", two(0, 1.0), meta={"status": "running"})
    tables, (line,) = ambiguities.gather([tmp_path])
    assert (tables, "screen/00/dqn/tanh: the run is not finished" in line) == ({}, True)


def test_scripted_policies_without_a_run_are_no_study(tmp_path):
    protocol = Protocol("test", 1, 9)
    kept(tmp_path / "noise/baselines", protocol.file("reactive"), rows(0, (9, 9, 0, 0, 0, 9, 2.0)), protocol)
    write_run(tmp_path / "noise/ppo/tanh", rows(0, (9, 9, 0, 0, 0, 9, 1.0)))  # which has flown no episode
    assert evaluations([tmp_path], "noise") == ([], [])


def test_mahalanobis_distance_by_hand():
    """Seeds at (+-1, 0) and (0, +-2): the pooled covariance is diag(2, 8) / 6 of two groups of four."""
    square = np.array([[1.0, 0], [-1, 0], [0, 2], [0, -2]])
    found = stats.mahalanobis([square, square + 10, np.empty((0, 2))], np.array([1.0, 2.0]))
    by_hand = [np.sqrt((d[0] ** 2 / (4 / 6) + d[1] ** 2 / (16 / 6)) / 1.25) for d in ((1, 2), (9, 8))]
    assert found[:2] == pytest.approx(by_hand)
    assert np.isnan(found[2])


SPREAD = np.array([20, 0.3, 1, 80, 0.1, 0.5])
"""Of seeds, in the paper's metrics."""


def near(rng, n, apart=0.0):
    """Seeds of the paper's configurations that scatter about its numbers, so many deviations apart."""
    printed = {key: np.array([*row.values()]) for key, row in paper.TABLES.items()}
    return {key: row + SPREAD * (apart + rng.normal(size=(n, 6))) for key, row in printed.items()}


def test_the_distance_of_a_draw_is_joint_over_independent_configurations():
    rng, two = np.random.default_rng(0), (("dqn", "tanh"), ("dqn", "sigmoid"))
    seeds = {number: near(rng, 8, apart) for number, apart in ((0, 5.0), (1, 0.0), (2, 20.0))}
    found = draws.distances({number: {key: own[key] for key in two} for number, own in seeds.items()})
    assert found.index.tolist() == [1, 0, 2]
    squares = found["DQN tanh"] ** 2 + found["DQN sigmoid"] ** 2
    assert (found["distance"] ** 2).tolist() == pytest.approx(squares.tolist())


def test_draws_begin_with_what_was_decided_and_more_draws_begin_with_the_same(tmp_path):
    study = studies.read("ambiguities")
    few, many = (plan(study, tmp_path, n).drawn() for n in (3, 40))
    assert many[:3] == few
    assert few[0] == {name: values[0] for name, values in study.draw["choices"].items()}
    for name, values in study.draw["choices"].items():
        assert {one[name] for one in many} == {*values}
    screened = plan(study, tmp_path).screened()
    assert len(screened) == 40 * 2
    assert {one.config.n_seeds for one in screened} == {2}
    assert plan(study, tmp_path).nearest() == []
    with pytest.raises(ConfigError, match="seed=340 is of draws and of what they choose; give fewer seeds"):
        plan(studies.read("ambiguities", seeds=60), tmp_path)
    another = study._replace(draw=study.draw | {"screen": {"algorithm": "dqn", "activation": "gelu"}})
    with pytest.raises(ConfigError, match="screen: dqn gelu: the paper has no such row"):
        plan(another, tmp_path)


def test_configurations_are_trained_in_the_nearest_draws_with_what_their_algorithm_has(tmp_path, monkeypatch):
    draw = {"draws": 3, "nearest": 1, "screen": {"algorithm": "dqn", "n_seeds": 2, "evaluate": False}}
    draw |= {"choices": {"learning_starts": [100, 200, 300], "init": [None, "orthogonal"]}}
    entry = {"algorithm": ["ppo", "dqn"], "evaluate": False}
    study = studies.Study("mine", "", [], {"seed": 9}, [entry], None, None, draw)
    found = plan(study, tmp_path)
    for one in found.screened():
        write_run(one.out, rows(0, (9, 9, 0, 0, 0, 9, 1.0)), rows(1, (9, 9, 0, 0, 0, 9, 1.0)))
    rng = np.random.default_rng(0)
    apart = {"00": 5.0, "01": 0.0, "02": 20.0}
    logged = lambda run: near(rng, 8, apart[run.path.parents[1].name])["dqn", "tanh"]  # noqa: E731
    monkeypatch.setattr(draws, "logged", logged)
    nearest = found.nearest()
    assert [str(one.out.relative_to(tmp_path)) for one in nearest] == [
        "mine/nearest/01/ppo/tanh",
        "mine/nearest/01/dqn/tanh",
    ]
    assert nearest[1].config.learning_starts == found.drawn()[1]["learning_starts"]


def test_a_draw_fits_where_no_configuration_is_rejected():
    rng = np.random.default_rng(0)
    fits = ambiguities.judged(near(rng, 12)).assign(draw=7)
    one_apart = near(rng, 12) | {("ppo", "relu"): near(rng, 12, 9.0)["ppo", "relu"]}
    rejected = ambiguities.judged(one_apart).assign(draw=8)
    few = ambiguities.judged(near(rng, 4)).assign(draw=9)  # four seeds cannot tell
    standing = ambiguities.standing(pd.concat([fits, rejected, few, fits[:4].assign(draw=10)]))
    assert standing.to_dict() == {7: "fits", 8: "rejected", 9: "open", 10: "open"}
    assert rejected.query("verdict == 'rejected'")["part"].tolist() == ["PPO relu"]
    assert fits.set_index("part").loc[ambiguities.PPO_ORDER, "verdict"] == "as printed"
    turned = near(rng, 12) | {("ppo", "tanh"): near(rng, 12)["ppo", "sigmoid"]}
    of_order = ambiguities.judged(turned).set_index("part").loc[ambiguities.PPO_ORDER]
    assert (of_order["value"], of_order["verdict"]) == (0.0, "not as printed")


def test_the_report_has_the_finished_draws_by_what_they_differ_in_and_names_the_other_runs(tmp_path):
    episodes = [rows(seed, *[(9, 20 + seed, 1, 1, 9, 90, 1.0)] * 4) for seed in (0, 1)]
    home = tmp_path / "ambiguities"
    for number, init in (("00", "default"), ("01", "orthogonal"), ("02", "default")):
        meta = {"status": "running"} if number == "02" else {}
        write_run(home / "screen" / number / "dqn" / "tanh", *episodes, init=init, hidden=[64, 64], meta=meta)
    tables, (line,) = ambiguities.gather([tmp_path])
    assert {*tables} == {"draws"}
    assert {*tables["draws"].columns} == {"draw", "init", "DQN tanh", "distance"}
    assert "screen/02/dqn/tanh: the run is not finished" in line


def test_the_surge_of_dqn_with_sigmoid_is_as_printed_where_more_than_half_of_the_rise_is_lost(tmp_path):
    def lost(name, last):
        levels = [-5.0] * 300 + [15.0] * 300 + [last] * 400
        tables = [
            rows(seed, *((1_000 * (n + 1), 9, 0, 0, 0, 9, level + seed) for n, level in enumerate(levels)))
            for seed in range(3)
        ]
        path = write_run(tmp_path / name, *tables, activation="sigmoid", meta={"frames": 10**6})
        return ambiguities.surges([Run(path)]).iloc[0]

    steep, flat = lost("steep", -3.0), lost("flat", 13.0)
    assert (steep["verdict"], flat["verdict"]) == ("as printed", "not as printed")
    # a hundred episodes take 100,000 frames to rise from -5 to 15, a third of the stretch
    top = 15 - 20 / 6
    assert steep["value"] == pytest.approx((top + 3) / (top + 5), abs=0.005)
    assert flat["value"] == pytest.approx((top - 13) / (top + 5), abs=0.005)


def test_the_tuned_settings_of_longer_training_are_those_of_the_best_trials():
    found = studies.configurations(studies.read("longer"), studies.HERE)
    tuning = search.plan(studies.read("tuning"), studies.HERE.parents[1] / "results")
    for one in (one for one in found if one.out.parents[1].name == "tuned"):
        best = tuning.winner(one.config.algorithm).config
        same = {"activation": one.config.activation, "seed": 200, "n_seeds": 20, "total_frames": 10_000_000}
        if one.config.algorithm == "dqn":
            same |= {"exploration_fraction": best.exploration_fraction / 10}
        assert one.config == best.replace(**same, keep_at=[0.1, 0.3])


SEEDS = np.array([-1.0, 1.0] * 10)
"""Deviations of twenty seeds, whose mean's standard error is 0.229."""
NINE = activations.COMPARED


def activations_at(means, scatter=1.0, layer_norm=True, algorithms=("ppo", "dqn")):
    """The nine activations with these means, of both measures."""
    return {
        activations.Where(algorithm, layer_norm, name): dict.fromkeys(
            (activations.REWARD, activations.FINAL), mean + scatter * SEEDS
        )
        for algorithm in algorithms
        for name, mean in zip(NINE, means, strict=True)
    }


@pytest.mark.parametrize(
    ("means", "scatter", "verdict"),
    [
        ([30 + 0.1 * place for place in range(9)], 1.0, "irrelevant"),  # 0.8 apart, of 5.3 that would matter
        ([30.0] * 8 + [20.0], 1.0, "relevant"),
        ([30.0] * 8 + [25.0], 1.0, "open"),  # apart, perhaps by more than 5.3
        ([30.0] * 9, 20.0, "open"),  # seeds scatter too much to tell
        ([30.0] * 8 + [20.0], 20.0, "open"),
    ],
)
def test_the_choice_is_irrelevant_within_the_margin_relevant_beyond_it_and_else_open(means, scatter, verdict):
    table = activations.judged(activations_at(means, scatter)).set_index(
        ["algorithm", "measure", "layer_norm"]
    )
    found = table.loc[("ppo", activations.REWARD, True)]
    assert (found["verdict"], found["margin"], found["n"]) == (verdict, 5.3, 20)
    assert found["value"] == pytest.approx(max(means) - min(means))
    assert table.loc[("ppo", activations.REWARD, False), ["verdict", "n"]].tolist() == ["open", 0]  # no runs


def test_the_largest_difference_has_the_interval_of_all_72_ordered_pairs():
    row = activations.widest([mean + SEEDS for mean in (30.0, 20.0, *[25.0] * 7)], 5.3)
    assert row[:3] == ["relevant", "relu", "leaky_relu"]
    t = special.stdtrit(38, 1 - 0.05 / 72)
    half = t * np.sqrt(2 * 20 / 19 / 20)
    assert row[3:] == pytest.approx([10.0, 10 - half, 10 + half])


def test_one_missing_activation_leaves_the_question_open_and_no_order_is_compared():
    measured = activations_at([30.0] * 9)
    del measured[activations.Where("dqn", True, "silu")]
    table = activations.judged(measured).query("algorithm == 'dqn'")
    assert {*table["verdict"]} == {"open"}
    assert len(activations.carried(measured)) == 0


def test_an_order_that_dqn_turns_round_has_a_tau_of_minus_1():
    up = [10.0 * place for place in range(9)]
    measured = activations_at(up, algorithms=["ppo"]) | activations_at(up[::-1], algorithms=["dqn"])
    found = activations.carried(measured).set_index("measure")
    assert found.loc[activations.REWARD, ["value", "low", "high"]].tolist() == pytest.approx([-1, -1, -1])


def test_runs_of_the_study_become_means_over_seeds_of_training_final_policies_and_probes(tmp_path):
    protocol = Protocol("test", 2, 9, "none")
    evaluated(
        tmp_path / "activations/layer_norm=True/ppo/crelu", 5.0, protocol, activation="crelu", layer_norm=True
    )
    path = tmp_path / "activations/layer_norm=True/ppo/crelu/progress.parquet"
    seeds, frames = [0, 1] * 2, [900, 900, 1000, 1000]
    pd.DataFrame({"seed": seeds, "frame": frames, "dormant": [9, 9, 0.25, 0.75]}).to_parquet(path)
    tables, left_out = activations.gather([tmp_path])
    assert left_out == []
    found = tables["activations"].set_index("measure")["value"]
    assert found.to_dict() == pytest.approx(
        {activations.REWARD: 2 * 5.5, activations.FINAL: 5.5, "dormant [share]": 0.5}
    )
    assert {*tables["activations"]["configuration"]} == {"PPO crelu, LayerNorm"}
    drawn = activations.figure(tables["activations"])
    assert "PPO with LayerNorm, CReLU 11.0" in drawn.alt


# -- horizon and learned -------------------------------------------------------------------------------------


def test_what_a_horizon_gains_is_over_gamma_099_after_as_many_frames_and_steps():
    flown = [five_seeds(100 + WIDE, frames=10), five_seeds(104 + WIDE, frames=10, gamma=0.998, scripted=95.0)]
    later = five_seeds(90 + WIDE, frames=20, gamma=0.998)
    later.rows["truncated"] = [True, True, True, False, False]
    table = horizon.table([*flown, later]).set_index(["frames", "gamma"])
    half = 2.306 * np.sqrt(2.5 / 5 + 2.5 / 5)  # t of 8 degrees of freedom
    found = table.loc[(10, 0.998)]
    assert (found["gain"], found["value"], found["survive"], found["scripted"]) == (4, 104, 100, 95)
    assert found["gain_high"] - found["gain"] == pytest.approx(half, abs=1e-3)
    assert found["high"] - found["value"] == pytest.approx(2.776 * np.sqrt(2.5 / 5), abs=1e-3)
    assert np.isnan(table.loc[[(10, 0.99), (20, 0.998)], "gain"]).all()  # itself, and alone
    assert table["verdict"].tolist() == ["–", "more", "–"]
    assert table.loc[(20, 0.998), "survive"] == pytest.approx(60)
    assert "gamma 0.998: 90" in horizon.figure(table.reset_index()).alt
    six = pd.concat(
        [table.reset_index().assign(gamma=gamma) for gamma in (0.9, 0.95, 0.98, 0.99, 0.995, 0.998)]
    )
    assert "gamma 0.95: 90" in horizon.figure(six).alt


def test_a_learned_policy_is_ahead_where_its_whole_interval_is_above_the_best_scripted_one(tmp_path):
    """Seeds earn 5 and 6, which is 5.5 ± 6.35; under the shield 6 and 8, and the scripted ones less."""
    for shield, rules in ((False, {"reactive": 3.0, "dwa": 5.0}), (True, {"reactive": -8.0, "dwa": -9.0})):
        protocol = Protocol("test", 2, 9, shield=shield)
        if not shield:
            run = evaluated(tmp_path / "learned/drone/ppo/tanh", 5.0, protocol)
            episodes = Run(run).evaluation()
        safe = episodes.assign(reward=lambda own: own["reward"] + 1 + own["seed"], terminated=False)
        kept(run, protocol.file("evaluation"), safe if shield else episodes, protocol)
        for who, reward in rules.items():
            own = rows(0, *[(9, 9, 0, 0, 0, 9, reward)] * 2).assign(layout=[0, 1], danger=[0, 9])
            kept(tmp_path / "learned/baselines", protocol.file(who), own, protocol)
    tables, left_out = learned.gather([tmp_path])
    ahead = tables["learned_ahead"].set_index("shield")
    assert left_out == []
    assert tables["learned_shielded"].round(3).to_dict("records") == [
        {"place": "drone", "who": "PPO best", "value": 5.5, "n": 2, "collisions": 111.111, "left": 0}
        | {"gain": 1.5, "gain_low": -4.853, "gain_high": 7.853}  # ± 12.706 x 0.5
    ]
    assert ahead.loc[False, ["best_scripted", "scripted", "gap", "verdict"]].tolist() == [
        "dwa",
        5.0,
        0.5,
        "open",
    ]
    assert ahead.loc[True, ["best_scripted", "gap", "verdict"]].tolist() == ["reactive", 15.0, "learned"]
    assert ahead.loc[False, "gap_high"] == pytest.approx(0.5 + 12.706 / 2, abs=1e-3)
    danger = tables["learned"].query("measure == 'danger'")
    assert (danger["value"] == 50).all()
    assert {*danger["who"]} == {"reactive", "dwa"}
    shown = learned.listed(tables["learned"], "drone")
    assert {*shown["who"]} == {
        f"{who}{end}" for who in ("PPO best", "reactive", "dwa") for end in ("", " + shield")
    }
    assert (
        learned.figure(tables["learned"]).alt == "The most reward per episode: drone: PPO best + shield 7.00."
    )


def test_pqns_best_is_judged_by_its_greedy_episodes_and_ppos_by_sampled_ones(tmp_path):
    protocol = Protocol("test", 2, 9)
    for algorithm in ("ppo", "pqn"):
        run = evaluated(tmp_path / f"learned/drone/{algorithm}/relu", 5.0, protocol, algorithm=algorithm)
        sampled = Run(run).evaluation()
        greedy = sampled.assign(mode="greedy", reward=sampled["reward"] + 4)
        kept(run, protocol.file("evaluation"), pd.concat([sampled, greedy]), protocol)
    table = learned.gather([tmp_path])[0]["learned"].query("measure == 'reward'").set_index("who")
    assert table["value"].to_dict() == {"PPO best": 5.5, "PQN best": 9.5}
