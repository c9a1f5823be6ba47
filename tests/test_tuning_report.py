"""The report's section on more algorithms: made-up configurations, numbers known by hand."""

import numpy as np
import pandas as pd
import pytest
from bad_input import put
from made_up import in_study as configuration

from uavnav.report import frames, tables, tuning
from uavnav.report.configurations import _beside_tuning
from uavnav.report.studies import further, sort
from uavnav.runs import run_folders
from uavnav.runs.trials import DIFFERENCE

ACTIVATIONS = ("tanh", "sigmoid", "relu", "leaky_relu")
TRIALS = pd.DataFrame(
    {
        "algorithm": ["ppo"] * 4 + ["sac"] * 2,
        "trial": [0, 1, 2, 3, 0, 1],
        "state": ["finished", "diverged", "finished", "finished", "finished", "finished"],
        "value": [1.0, np.nan, 5.0, 3.0, 2.0, 0.0],
        "settings": ['{"lr": 0.1}', '{"lr": 9.0}', '{"lr": 0.2, "hidden": 64}', "{}", "{}", "{}"],
    }
)


def episodes(*of_seeds, mode="sampled"):
    """Two episodes a seed, on two layouts, with that mean reward."""
    rows = [
        (seed, layout, mean + change)
        for seed, mean in enumerate(of_seeds)
        for layout, change in ((0, 1.0), (1, -1.0))
    ]
    table = pd.DataFrame(rows, columns=["seed", "layout", "reward"])
    return table.assign(steps=10, terminated=True, truncated=False, mode=mode)


def configurations(**of_seeds):
    return {(name, "tanh"): configuration(name, tested=episodes(*means)) for name, means in of_seeds.items()}


def compared(rule=20.0):
    found = {
        "default": configurations(ppo=(1.0, 3.0), sac=(9.0, 11.0)),
        "tuned": configurations(ppo=(11.0, 13.0), sac=(8.0, 10.0)),
    }
    return tuning._compared(found, {"reactive": episodes(rule, mode="scripted")}, ["ppo", "sac"])


def test_default_and_tuned_are_means_over_seeds_with_their_difference_and_the_gap_to_the_rule():
    found = compared().set_index(["algorithm", "settings"])
    assert found["value"].to_dict() == {
        ("ppo", "default"): 2.0,
        ("ppo", "tuned"): 12.0,
        ("ppo", DIFFERENCE): 10.0,
        ("sac", "default"): 10.0,
        ("sac", "tuned"): 9.0,
        ("sac", DIFFERENCE): -1.0,
    }
    assert found["gap"].dropna().to_dict() == {
        ("ppo", "default"): -18.0,
        ("ppo", "tuned"): -8.0,
        ("sac", "default"): -10.0,
        ("sac", "tuned"): -11.0,
    }
    low, high = found.loc[("ppo", "tuned"), ["low", "high"]]
    # Student's t of one degree of freedom, error 1
    assert (high - low) / 2 == pytest.approx(12.706, abs=1e-3)


def test_the_table_of_trials_has_the_default_and_the_best_with_its_settings():
    assert tables.tried(TRIALS)[1:] == [
        ["PPO", "4", "1", "1.0", "5.0", "2", "lr=0.2, hidden=64"],
        ["SAC", "2", "0", "2.0", "2.0", "0", ""],
    ]


def test_a_folder_without_tuning_has_no_tables_and_a_damaged_one_a_line(tmp_path):
    assert tuning.read([tmp_path], {}) == ({}, {}, [])
    (tmp_path / "tuning").mkdir()
    (tmp_path / "tuning" / "trials.csv").write_text("")
    tables, _, (line,) = tuning.read([tmp_path], {})
    assert tables == {}
    assert line.startswith(f"{tmp_path}/tuning/trials.csv: cannot be read (")


@pytest.mark.parametrize("where", ["tuning", "tuning/tuning"])
def test_a_study_is_found_beside_others_and_in_a_folder_of_its_own_and_its_runs_are_in_no_other_table(
    where, tmp_path
):
    for name in ("trials/000/ppo/tanh", "default/ppo/tanh", "tuned/002/ppo/tanh", "tuned/000/ppo/tanh"):
        put(tmp_path / where / name / "config.yaml", "")
    assert len(_beside_tuning([tmp_path], paths(tmp_path))) == 3
    TRIALS.to_csv(tmp_path / where / "trials.csv", index=False)
    put(tmp_path / "ppo" / "relu" / "config.yaml", "")
    assert [*_beside_tuning([tmp_path], paths(tmp_path)).values()] == [tmp_path / "ppo" / "relu"]
    tables, _, left_out = tuning.read([tmp_path], {})
    assert tables["tuning_trials"].equals(TRIALS)
    read = {line.partition(": no run")[0] for line in left_out}
    # not the winner before
    assert read == {str(tmp_path / where / name) for name in ("default", "tuned/002/ppo")}


def test_a_second_study_that_tuned_is_named(tmp_path):
    for name in ("one", "two"):
        put(tmp_path / name / "tuning" / "trials.csv", TRIALS.to_csv(index=False))
    *_, lines = tuning.read([tmp_path / "one", tmp_path / "two"], {})
    assert lines == [f"{tmp_path}/two/tuning: tuned too; the report shows {tmp_path}/one/tuning"]


def paths(folder):
    return {path.resolve(): path for path in run_folders(folder)[0]}


def test_trials_are_no_runs_and_a_folder_trials_elsewhere_may_hold_some(tmp_path):
    for name in ("tuning/trials/000/ppo/tanh", "trials/ppo/tanh", "tuning/tuned/002/ppo/tanh"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "config.yaml").touch()
    found = [str(path.relative_to(tmp_path)) for path in run_folders(tmp_path)[0]]
    assert found == ["trials/ppo/tanh", "tuning/tuned/002/ppo/tanh"]


# -- activations ---------------------------------------------------------------------------------------------


def studies_of(*algorithms):
    return sort([configuration(one, activation) for one in algorithms for activation in ACTIVATIONS])


def evidence(algorithm, activation, metric, study="main"):
    """Three seeds each: tanh leads under PPO and A2C, trails under SAC, and is like the others under C51."""
    assert (metric, study) == ("reward", "vectorised")
    value = {"ppo": 1.0, "a2c": 1.0, "sac": -1.0}.get(algorithm, 0.0) if activation == "tanh" else 0.0
    return value + np.array([-0.01, 0.0, 0.01])


def test_by_default_an_algorithm_that_was_not_tuned_has_reward_of_its_tanh_in_the_comparison_of_activations():
    rows = [["SAC tanh", "greedy", 1.0, 0.0, 2.0], ["SAC tanh", "sampled", 5.0, 4.0, 6.0]]
    further = pd.DataFrame(rows, columns=["who", "mode", "reward", "low", "high"])
    tuning = pd.DataFrame(
        [["a2c", "default", 7.0, 6.0, 8.0], ["a2c", "tuned", 9.0, 8.0, 10.0]],
        columns=["algorithm", "settings", "value", "low", "high"],
    )
    numbers = {"tuning": tuning, "further": further}
    found = {
        (one, which): tables.reward(numbers, one, which)
        for one in ("a2c", "sac")
        for which in ("default", "tuned")
    }
    assert found == {
        ("a2c", "default"): "[7.0](tables/tuning.csv#L2) [6.0, 8.0]",
        ("a2c", "tuned"): "[9.0](tables/tuning.csv#L3) [8.0, 10.0]",
        ("sac", "default"): "[5.0](tables/further.csv#L3) [4.0, 6.0]",
        ("sac", "tuned"): "–",
    }
    assert tables.reward({}, "sac", "default") == "–"


def test_a_difference_of_activations_has_a_value_under_each_algorithm():
    found = frames.carried(studies_of("ppo", "dqn", "a2c", "c51", "sac"), evidence)
    value = found.set_index(["conclusion", "algorithm"])["value"]
    assert value["tanh − relu", "ppo"] == pytest.approx(1.0)
    assert value["bounded − unbounded", "sac"] == pytest.approx(-0.5)
    rows = tables.crossed(found, "conclusion", "algorithm")
    assert rows[0] == ["conclusion", "DQN", "PPO", "A2C", "C51", "SAC", "seeds"]
    assert frames.carried(studies_of("ppo", "dqn"), evidence).empty  # the paper's alone ask nothing


def test_further_algorithms_are_those_beyond_the_papers():
    found = further(studies_of("sac", "ppo", "a2c", "dqn"))
    assert [*dict.fromkeys(algorithm for algorithm, _ in found)] == ["a2c", "sac"]
    assert len(found) == 8
