"""The report's section on more algorithms: made-up cells, numbers known by hand."""

import re

import numpy as np
import pandas as pd
import pytest
from spoiling import put
from test_studies import cell

from uavnav.report import beyond, findings
from uavnav.report.cells import _beside_tuning
from uavnav.report.studies import Rows, sort
from uavnav.runs import run_folders
from uavnav.runs.trials import DIFFERENCE

TRIALS = pd.DataFrame(
    {
        "algorithm": ["ppo"] * 4 + ["sac"] * 2,
        "trial": [0, 1, 2, 3, 0, 1],
        "state": ["finished", "diverged", "finished", "finished", "finished", "finished"],
        "value": [1.0, np.nan, 5.0, 3.0, 2.0, 0.0],
        "settings": ['{"lr": 0.1}', '{"lr": 9.0}', '{"lr": 0.2, "hidden": 64}', "{}", "{}", "{}"],
    }
)


def flights(*of_seeds, mode="sampled"):
    """Two flights a seed, on two sets, with that mean reward."""
    rows = [
        (seed, layout, mean + change) for seed, mean in enumerate(of_seeds) for layout, change in ((0, 1.0), (1, -1.0))
    ]
    table = pd.DataFrame(rows, columns=["seed", "layout", "reward"])
    return table.assign(steps=10, terminated=True, truncated=False, mode=mode)


def cells(**of_seeds):
    return {(name, "tanh"): cell(name, flown=flights(*means)) for name, means in of_seeds.items()}


def compared(rule=20.0):
    found = {"default": cells(ppo=(1.0, 3.0), sac=(9.0, 11.0)), "tuned": cells(ppo=(11.0, 13.0), sac=(8.0, 10.0))}
    return beyond._compared(found, {"reactive": flights(rule, mode="scripted")}, ["ppo", "sac"])


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
    assert (high - low) / 2 == pytest.approx(12.706, abs=1e-3)  # Student's t of one degree of freedom, error 1


@pytest.mark.parametrize(
    ("gap", "said"),
    [
        ((-8.0, -9.0, -7.0), "None passes the hand-written rule; PPO comes nearest: −8.0 [−9.0, −7.0] a flight."),
        ((8.0, 7.0, 9.0), "PPO passes the hand-written rule: 8.0 [7.0, 9.0] a flight."),
        ((1.0, -7.0, 9.0), "Whether PPO, the best, passes the hand-written rule is open: 1.0 [−7.0, 9.0] a flight."),
    ],
)
def test_the_sentence_names_the_best_and_the_gap_to_the_rule(gap, said):
    found = compared()
    found.loc[1, ["gap", "gap_low", "gap_high"]] = gap
    assert beyond.conclusion(found).endswith(said)


def test_without_the_rules_flights_the_sentence_says_so():
    found = compared().assign(gap=np.nan)
    assert beyond.conclusion(found).endswith("No flights of the hand-written rule lie beside them.")


def test_without_runs_of_the_defaults_the_sentence_leaves_them_and_what_tuning_changed_out():
    found = compared()
    said = beyond.conclusion(found[found["settings"] == "tuned"])
    assert said.startswith("Tuned with the same budget: PPO")
    assert "default" not in said
    assert "Tuning" not in said


def test_of_pairs_that_are_told_apart_and_pairs_that_are_not_the_fewer_are_named():
    columns = ["pair", "settings", "value", "low", "high", "n"]
    rows = [["ppo − dqn", -5.0, -7.0, -3.0], ["ppo − sac", 1.0, -1.0, 3.0], ["dqn − sac", 5.0, 1.0, 9.0]]
    found = pd.DataFrame([[pair, "tuned", *numbers, 10] for pair, *numbers in rows], columns=columns)
    how = "Tuned with the same budget"
    assert beyond.told_apart(found) == f"{how}, 2 of 3 pairs are told apart, all but PPO − SAC 1.0 [−1.0, 3.0]."
    assert beyond.told_apart(found[:2]) == f"{how}, 1 of 2 pairs are told apart: DQN above PPO by 5.0 [3.0, 7.0]."
    assert beyond.told_apart(found[1:2]) == f"{how}, 0 of 1 pairs are told apart."
    assert beyond.told_apart(found[:0]) == ""


def test_the_best_so_far_never_falls_and_a_trial_that_diverged_changes_nothing():
    assert beyond.so_far(TRIALS).tolist() == [1.0, 1.0, 5.0, 5.0, 2.0, 2.0]


def test_the_table_of_trials_has_the_default_and_the_best_with_its_settings():
    assert beyond.winners(TRIALS)[1:] == [
        ["PPO", "4", "1", "1.0", "5.0", "2", "lr=0.2, hidden=64"],
        ["SAC", "2", "0", "2.0", "2.0", "0", ""],
    ]


def test_there_is_a_figure_of_cells_of_trials_and_of_what_matters():
    importance = pd.DataFrame({"algorithm": ["ppo"], "setting": ["lr"], "importance": [0.75]})
    numbers = {"tuning": compared(), "tuning_trials": TRIALS.assign(best=beyond.so_far(TRIALS))}
    drawn = beyond.figures(numbers | {"tuning_importance": importance}, {})
    assert [figure.name for figure in drawn] == ["tuning", "tuning-trials", "tuning-importance"]
    assert "PPO tuned 12.0" in drawn[0].drawn.alt
    assert "PPO from 1.00 to 5.00 in 4 trials; SAC from 2.00 to 2.00 in 2 trials" in drawn[1].drawn.alt
    assert "PPO lr 0.75" in drawn[2].drawn.alt
    assert beyond.figures({}, {}) == []


def test_the_two_settings_that_matter_most_are_named_with_their_shares():
    importance = pd.DataFrame(
        {"algorithm": ["ppo"] * 3 + ["sac"], "setting": ["a", "b", "c", "tau"], "importance": [0.1, 0.6, 0.3, 1.0]}
    )
    assert beyond.matters(importance) == (
        "What matters most among the trials (fANOVA): b (60%) and c (30%) for PPO; tau (100%) for SAC."
        " Each share is one estimate from few trials, so near ones tell no order."
    )
    assert beyond.matters(importance[:0]) == ""


def told(default, tuned, rule):
    """The sentences of PPO and DQN with so much reward in a flight of each of ten seeds, give or take one."""
    near = [
        {name: tuple(value + one for one in (-1.0, 1.0) * 5) for name, value in by.items()} for by in (default, tuned)
    ]
    found = {"default": cells(**near[0]), "tuned": cells(**near[1])}
    table = beyond._compared(found, {"reactive": flights(rule, mode="scripted")}, ["ppo", "dqn"])
    numbers = {"tuning": table, "tuning_pairs": beyond._pairs(found, ["ppo", "dqn"])}
    return [re.sub(r"\d+ \(.*?\)", lambda shown: shown[0].split()[0], str(one)) for one in findings.tuned(numbers)]


def test_what_tuning_changes_is_told_of_the_pair_of_each_algorithm_and_of_the_rule():
    assert told({"ppo": 200, "dqn": 100}, {"ppo": 200, "dqn": 400}, rule=500) == [
        "With default settings, PPO earns 100.0 more a test flight than DQN.",
        "Tuned with the same budget, PPO earns 200 less a test flight than DQN.",
        "Tuned, PPO is not told apart from its defaults: 0.0 of reward a test flight.",
        "Tuned, DQN earns 300 more a test flight than with its defaults.",
        "None passes the hand-written rule; DQN comes nearest, 100.0 of reward a test flight behind.",
    ]
    assert told({"ppo": 1, "dqn": 1}, {"ppo": 1, "dqn": 300}, rule=200)[-1] == (
        "DQN, tuned, passes the hand-written rule by 100.0 of reward a test flight."
    )
    assert findings.tuned({}) == []


def test_a_folder_without_tuning_has_no_tables_and_a_damaged_one_a_line(tmp_path):
    assert beyond.tuning([tmp_path], {}) == ({}, [])
    (tmp_path / "tuning").mkdir()
    (tmp_path / "tuning" / "trials.csv").write_text("")
    tables, (line,) = beyond.tuning([tmp_path], {})
    assert tables == {}
    assert line.startswith(f"{tmp_path}/tuning/trials.csv: cannot be read (")


@pytest.mark.parametrize("where", ["tuning", "tuning/tuning"])
def test_a_study_is_found_beside_others_and_in_a_folder_of_its_own_and_its_runs_are_in_no_other_table(where, tmp_path):
    for name in ("trials/000/ppo/tanh", "default/ppo/tanh", "tuned/002/ppo/tanh", "tuned/000/ppo/tanh"):
        put(tmp_path / where / name / "config.yaml", "")
    assert len(_beside_tuning([tmp_path], paths(tmp_path))) == 3
    TRIALS.to_csv(tmp_path / where / "trials.csv", index=False)
    put(tmp_path / "ppo" / "relu" / "config.yaml", "")
    assert [*_beside_tuning([tmp_path], paths(tmp_path)).values()] == [tmp_path / "ppo" / "relu"]
    tables, left_out = beyond.tuning([tmp_path], {})
    assert tables["tuning_trials"]["best"].tolist() == beyond.so_far(TRIALS).tolist()
    read = {line.partition(": no run")[0] for line in left_out}
    assert read == {str(tmp_path / where / name) for name in ("default", "tuned/002/ppo")}  # not the winner before


def test_a_second_study_that_tuned_is_named(tmp_path):
    for name in ("one", "two"):
        put(tmp_path / name / "tuning" / "trials.csv", TRIALS.to_csv(index=False))
    _, lines = beyond.tuning([tmp_path / "one", tmp_path / "two"], {})
    assert lines == [f"{tmp_path}/two/tuning: tuned too; the report shows {tmp_path}/one/tuning"]


def paths(folder):
    return {path.resolve(): path for path in run_folders(folder)[0]}


def test_trials_are_no_runs_and_a_folder_trials_elsewhere_may_hold_some(tmp_path):
    for name in ("tuning/trials/000/ppo/tanh", "trials/ppo/tanh", "tuning/tuned/002/ppo/tanh"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "config.yaml").touch()
    found = [str(path.relative_to(tmp_path)) for path in run_folders(tmp_path)[0]]
    assert found == ["trials/ppo/tanh", "tuning/tuned/002/ppo/tanh"]


# -- activations -------------------------------------------------------------------------------------------------------


def rows(value):
    """Evidence of three seeds around a value of each algorithm and activation."""

    class Made(Rows):
        def __call__(self, algorithm, activation, metric, study="main"):
            assert (metric, study) == ("reward", "many_worlds")
            there = (algorithm, activation) in self.studies.of(study)
            return value(algorithm, activation) + np.array([-0.01, 0.0, 0.01]) if there else np.empty(0)

    return Made


def made(algorithms_, value):
    activations = ("tanh", "sigmoid", "relu", "leaky_relu")
    studies = sort([cell(one, activation) for one in algorithms_ for activation in activations])
    return rows(value)(studies, "", {})


def ahead(algorithm, activation):
    """tanh leads under PPO and A2C, trails under SAC, and is like the others under C51."""
    by = {"ppo": 1.0, "a2c": 1.0, "sac": -1.0}.get(algorithm, 0.0)
    return by if activation == "tanh" else 0.0


def test_a_conclusion_about_activations_carries_over_turns_round_or_stays_open():
    found = beyond.carried(made(("ppo", "dqn", "a2c", "c51", "sac"), ahead))
    value = found.set_index(["conclusion", "algorithm"])["value"]
    assert value["tanh − relu", "ppo"] == pytest.approx(1.0)
    assert value["bounded − unbounded", "sac"] == pytest.approx(-0.5)
    answer, first, *_ = beyond.carries(found).split(". ")
    assert answer == "No conclusion about activations is seen to hold under every algorithm"
    assert (
        first == "Under PPO, tanh is ahead of ReLU; this holds under A2C, turns round under SAC and is open under C51"
    )
    assert "DQN" not in beyond.carries(found)  # which decides nothing
    assert beyond.conclusions(found)[0] == ["reward per frame", "DQN", "PPO", "A2C", "C51", "SAC"]


def test_by_default_an_algorithm_that_was_not_tuned_has_the_reward_of_its_tanh_in_the_comparison_of_activations():
    rows = [["SAC tanh", "greedy", 1.0, 0.0, 2.0], ["SAC tanh", "sampled", 5.0, 4.0, 6.0]]
    further = pd.DataFrame(rows, columns=["who", "mode", "reward", "low", "high"])
    tuning = pd.DataFrame(
        [["a2c", "default", 7.0, 6.0, 8.0], ["a2c", "tuned", 9.0, 8.0, 10.0]],
        columns=["algorithm", "settings", "value", "low", "high"],
    )
    numbers = {"tuning": tuning, "further": further}
    found = {
        (one, which): beyond.reward(numbers, one, which) for one in ("a2c", "sac") for which in ("default", "tuned")
    }
    assert found == {
        ("a2c", "default"): "7.0 [6.0, 8.0]",
        ("a2c", "tuned"): "9.0 [8.0, 10.0]",
        ("sac", "default"): "5.0 [4.0, 6.0]",
        ("sac", "tuned"): "–",
    }
    assert beyond.reward({}, "sac", "default") == "–"


def test_further_algorithms_are_those_beyond_the_papers():
    found = beyond.further(made(("sac", "ppo", "a2c", "dqn"), ahead).studies)
    assert [*dict.fromkeys(algorithm for algorithm, _ in found)] == ["a2c", "sac"]
    assert len(found) == 8


def test_a_conclusion_that_holds_under_every_algorithm_is_not_denied():
    found = beyond.carried(made(("ppo", "dqn", "a2c"), lambda algorithm, activation: float(activation == "tanh")))
    assert beyond.carries(found).startswith("Under DQN and PPO, tanh is ahead of ReLU; this holds under A2C. ")


def test_an_algorithm_no_cell_of_which_is_above_random_flight_is_named():
    columns = ["who", "algorithm", "mode", "reward", "low"]
    scripted = [["random", "", "scripted", -10.0, np.nan], ["reactive", "", "scripted", 400.0, np.nan]]
    learned = [["SAC tanh", "sac", "sampled", -9.0, -10.0], ["SAC relu", "sac", "sampled", -15.0, -16.0]]
    learned += [["SAC tanh", "sac", "greedy", 50.0, 40.0], ["A2C tanh", "a2c", "sampled", 9.0, 2.0]]
    learned += [["A2C relu", "a2c", "sampled", -9.0, -12.0]]
    said = beyond.no_better(pd.DataFrame(scripted + learned, columns=columns))
    assert said.startswith("With default settings, no cell of SAC earns more in test flights than random flight")
    assert "A2C" not in said
    assert beyond.no_better(pd.DataFrame(learned, columns=columns)) == ""


def test_the_papers_algorithms_alone_ask_nothing():
    assert beyond.carried(made(("ppo", "dqn"), ahead)).empty
