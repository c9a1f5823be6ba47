"""Which configurations belong to which study, and what each metric definition says of them: made-up
configurations, numbers known by hand.
"""

import itertools

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up import episodes, in_study, run

from uavnav.report.claims import PRIMARY
from uavnav.report.configurations import windowed
from uavnav.report.studies import (
    Studies,
    evidence_of,
    hours,
    in_none,
    of_paper,
    paper_configurations,
    sort,
    wide,
)
from uavnav.runs import paper
from uavnav.runs.definitions import ALL, LOG_CURVE, TOTALS
from uavnav.runs.metrics import LAST

IN_ONE = {"preset": "paper", "n_envs": 1}
SHORT = {"total_frames": 300_000, "frames": 300_000, "exploration_fraction": 1 / 3}
LISTED = {"world.slots": "listed"}
ACTIVATIONS = ("tanh", "sigmoid", "relu", "leaky_relu")


def own_episodes(*rows):
    return episodes("seed frame steps stops turns distance reward terminated truncated", *rows)


def configuration(algorithm="ppo", activation="tanh", rows=(), **changes):
    return in_study(algorithm, activation, own_episodes(*rows), **changes)


def grid(algorithms=("ppo", "dqn"), activations=ACTIVATIONS, **changes):
    return [configuration(*key, **changes) for key in itertools.product(algorithms, activations)]


# -- sort ----------------------------------------------------------------------------------------------------


def in_many(*algorithms, **changes):
    return grid(algorithms or ("ppo", "dqn"), study="vectorised", **changes)


def test_a_run_goes_where_the_study_that_its_meta_json_names_belongs():
    found = sort(
        [
            *in_many(),
            *grid(study="paper", **IN_ONE),
            configuration(study="initial", **SHORT),
            configuration(study="initial", reward="initial", **SHORT),
            configuration("dqn", "elu", study="wide", **SHORT),
            configuration("dqn", study="tuned", preset="fast", lr=1.0, **LISTED),
            configuration("a2c", study="algorithms", n_envs=8),
        ]
    )
    assert [*found.main] == [*paper.TABLES]
    assert {one.settings["n_envs"] for one in found.main.values()} == {1}
    assert [*found.vectorised] == [*paper.TABLES, ("a2c", "tanh")]
    assert {*found.baseline} == {("dqn", "elu"), ("ppo", "tanh")}
    assert [*found.initial] == [("ppo", "tanh")]
    assert [*found.tuned] == [("dqn", "tanh")]
    assert (found.switches, found.why, found.others) == ({}, {}, [])
    assert found.of("initial") == found.initial
    assert found.of("gamma=0.9") == {}


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        (LISTED, "world.slots=listed"),
        (LISTED | SHORT, "world.slots=listed"),
        ({"reward": "additive"} | SHORT, "reward=additive"),
        ({"obstacles": 4, "layouts": "def"}, "obstacles=4"),
        ({"n_envs": 1024}, "n_envs=1,024"),
        ({"gamma": 0.9}, "gamma=0.9"),
    ],
)
@pytest.mark.parametrize(("study", "place"), [("sensitivity", "switches"), ("why", "why")])
def test_a_study_of_one_setting_at_a_time_has_its_configurations_by_the_setting(study, place, changes, name):
    found = sort(
        [
            *in_many(),
            configuration(study=study, **changes),
            configuration("dqn", "relu", study=study, **changes),
        ]
    )
    assert {key: [*configurations] for key, configurations in getattr(found, place).items()} == {
        name: [("dqn", "relu"), ("ppo", "tanh")]
    }
    assert (len(found.main), found.baseline, found.initial, found.others) == (8, {}, {}, [])


def test_configurations_of_such_a_study_change_nothing_are_baseline_and_those_that_change_two_are_in_none():
    strange = configuration(study="why", **LISTED, reward="initial")
    strange.runs[0].path = "results/strange"
    found = sort([*in_many(), strange, configuration(study="why", **SHORT)])
    assert [*found.baseline] == [("ppo", "tanh")]
    assert in_none(found) == [
        "results/strange: in no study; it differs from the main one in reward=initial, world.slots=listed"
    ]
    assert in_none(sort(in_many())) == []


def test_runs_that_no_study_takes_are_named_where_the_main_one_lacks_their_algorithm_too():
    dqn = grid(("dqn",), study="paper", **IN_ONE)
    for number, one in enumerate(dqn):
        one.runs[0].path = f"results/{number}"
    assert in_none(sort([*in_many("ppo"), *dqn])) == [f"results/{number}: in no study" for number in range(4)]


def test_of_two_rewards_the_usual_one_is_the_presets():
    of_paper, first = (
        configuration(study="initial", reward=reward, **SHORT) for reward in ("eq14", "initial")
    )
    first.runs[0].meta |= {"beyond_preset": {"reward": "initial"}}
    found = sort([first, of_paper])
    assert (found.baseline, found.initial) == ({("ppo", "tanh"): of_paper}, {("ppo", "tanh"): first})


def test_the_second_of_two_configurations_for_one_place_is_among_the_others():
    twin = configuration(study="vectorised", lr=0.5)
    assert sort([*in_many(), twin]).others == [twin]


@pytest.mark.parametrize("study", ["", "mine"])
def test_runs_of_no_known_study_are_compared_where_most_of_an_algorithms_agree(study):
    """Of PPO three agree and one has another rate; of DQN the configuration of more seeds counts."""
    mine = [
        *grid(["ppo"], ["tanh", "relu", "elu"], study=study),
        configuration(activation="sigmoid", lr=0.5, study=study),
    ]
    mine += [
        configuration("dqn", n_seeds=1, study=study),
        configuration("dqn", "relu", lr=0.5, n_seeds=3, study=study),
    ]
    found = sort(mine)
    assert [*found.main] == [("dqn", "relu"), ("ppo", "tanh"), ("ppo", "relu"), ("ppo", "elu")]
    assert found.others == [mine[3], mine[4]]
    assert (found.vectorised, found.switches, found.why, found.baseline, found.tuned) == ({}, {}, {}, {}, {})


def test_a_run_of_ones_own_beside_the_study_is_in_it_where_its_settings_are_the_same():
    own, other = configuration(activation="mish"), configuration(activation="gelu", lr=0.5)
    found = sort([*in_many(), own, other])
    assert [activation for algorithm, activation in found.main if algorithm == "ppo"] == [
        *ACTIVATIONS,
        "mish",
    ]
    assert found.others == [other]


def test_more_activations_are_shown_beside_the_papers_of_the_longest_study_that_has_some():
    short = grid(activations=("tanh", "gelu"), study="wide", **SHORT)
    found = sort([*in_many(), *short])
    assert [*wide(found)] == [("dqn", "tanh"), ("ppo", "tanh"), ("dqn", "gelu"), ("ppo", "gelu")]
    assert [*paper_configurations(wide(found))] == [("dqn", "tanh"), ("ppo", "tanh")]
    both = sort([*in_many(), *short, configuration(activation="mish")])
    assert wide(both) is both.main
    assert wide(sort(in_many())) == {}


@settings(max_examples=30, deadline=None)
@given(st.randoms(use_true_random=False))
def test_the_order_in_which_runs_are_found_changes_nothing(random):
    configurations = [
        *in_many(),
        *grid(study="paper", **IN_ONE),
        configuration(study="wide", **SHORT),
        configuration("trpo"),
    ]
    configurations += [
        configuration(study="sensitivity", **LISTED),
        configuration("a2c"),
        configuration("a2c", "relu", lr=0.5),
    ]
    shuffled = random.sample(configurations, len(configurations))
    assert sort(shuffled) == sort(configurations)
    assert [*sort(shuffled).main] == [*sort(configurations).main]


def test_a_study_in_one_world_that_lacks_one_of_the_papers_configurations_is_not_yet_the_main_one():
    alone = grid(study="paper", **IN_ONE)
    found = sort([*in_many(), *alone[1:]])
    assert {one.settings["n_envs"] for one in found.main.values()} == {16}
    assert (found.vectorised, found.others) == ({}, alone[1:])


def test_without_a_run_in_one_world_the_study_in_many_is_the_main_one_and_the_other_way_round():
    assert (len(sort(in_many()).main), sort(in_many()).vectorised) == (8, {})
    alone = sort(grid(study="paper", **IN_ONE))
    assert (len(alone.main), alone.vectorised, alone.others) == (8, {}, [])


def test_no_configurations_are_no_studies():
    assert sort([]) == Studies({}, {}, {}, {}, {}, {}, {}, [])


# -- readings ------------------------------------------------------------------------------------------------

KEY = ("dqn", "sigmoid")


def rows_of(one, definition=PRIMARY, episodes=None):
    return evidence_of(sort([one]), definition, episodes or {})


def test_each_definition_gives_one_number_a_seed():
    """Seed 0 flies at 4 and 8 px a step, in 100 and 300 steps; seed 1 once at 2, and once more without an
    end.
    """
    first = [(0, 100, 100, 10, 90, 400, -6.0), (0, 400, 300, 0, 150, 2400, -2.0)]
    second = [(1, 50, 50, 5, 5, 100, 3.0), (1, 99, 49, 0, 0, 0, 1e6, False, False)]
    tested = pd.concat(
        [
            own_episodes((0, 9, 9, 0, 9, 81, 7.0)).assign(mode="greedy"),
            own_episodes((1, 9, 10, 0, 0, 80, 5.0, False, True)).assign(mode="sampled"),
        ]
    )
    one = configuration(*KEY, rows=first + second, tested=tested)
    evidence = rows_of(one, ALL)
    assert evidence(*KEY, "reward").tolist() == [-4, 3]
    assert evidence(*KEY, "speed").tolist() == [6, 2]
    assert evidence(*KEY, "stops").tolist() == [5, 10]
    assert evidence(*KEY, "turns").tolist() == [70, 10]
    assert rows_of(one, TOTALS)(*KEY, "speed").tolist() == [7, 2]
    assert rows_of(one, TOTALS)(*KEY, "reward").tolist() == [-4, 3]
    assert rows_of(one)(*KEY, "reward").tolist() == [-8e-6, (3 + 1e6) / 1e6]
    assert rows_of(one)(*KEY, "steps").tolist() == [200, 99]  # per collision
    assert rows_of(one, LOG_CURVE)(*KEY, "reward").shape == (0,)  # it logs every fourth episode
    assert rows_of(one, "greedy evaluation")(*KEY, "speed").tolist() == [9]
    assert rows_of(one, "sampled evaluation")(*KEY, "reward").tolist() == [5]
    assert rows_of(one, f"last {LAST} training episodes")(*KEY, "reward").tolist() == [-4, 3]


def test_the_last_100_episodes_leave_out_those_before():
    early = [(0, frame, 10, 0, 0, 10, -9.0) for frame in range(1, 51)]
    late = [(0, frame, 10, 0, 0, 10, 2.0) for frame in range(51, 51 + LAST)]
    one = configuration(*KEY, rows=early + late)
    assert rows_of(one, f"last {LAST} training episodes")(*KEY, "reward").tolist() == [2]


def test_what_is_not_there_has_no_seeds():
    evidence = rows_of(configuration(*KEY, rows=[(0, 9, 9, 0, 0, 9, 1.0)]))
    for asked in (
        ("ppo", "tanh", "reward"),
        (*KEY, "corridor"),
        (*KEY, "reward", "initial"),
        (*KEY, "hours", "baseline"),
    ):
        assert evidence(*asked).shape == (0,)
        assert evidence(*asked).dtype == np.float64
    assert rows_of(configuration(*KEY, rows=[(0, 9, 9, 0, 0, 9, 1.0)]), "greedy evaluation")(
        *KEY, "reward"
    ).shape == (0,)


def test_an_episode_counts_in_the_frames_that_it_lasted_and_its_collision_at_its_end():
    """It earns 1 a frame to frame 300,000, where it collides, and 2 a frame from there on, up in the air
    at the end.
    """
    first = (0, 300_000, 300_000, 0, 0, 9, 300_000.0 - 10)
    evidence = rows_of(
        configuration(*KEY, n_envs=1, rows=[first, (0, 1_000_000, 700_000, 0, 0, 9, 1.4e6, False, False)])
    )
    assert evidence(*KEY, "reward_before").tolist() == pytest.approx([1 - 10 / 300_000])
    assert evidence(*KEY, "reward_surge").tolist() == pytest.approx([2])
    assert evidence(*KEY, "reward_after").tolist() == pytest.approx([2])


@pytest.mark.parametrize(("task", "expected"), [("drone", [0.21, 0.01]), ("goal", [0.11, 0.11])])
def test_a_collision_is_booked_in_its_last_frame_and_with_goals_all_reward_is_spread(task, expected):
    """100 frames bring 11; of the drone's, 21 came on the way and -10 in the last."""
    one = configuration(rows=[(0, 100, 100, 0, 0, 9, 11.0)], n_envs=1, task=task)
    assert windowed(one, [(0, 50), (50, 100)]).loc[0].tolist() == pytest.approx(expected)


def test_frame_300000_is_before_the_surge_and_300001_in_it():
    for end, before, surge in ((300_000, -10, 0), (300_001, 0, -10)):
        evidence = rows_of(configuration(*KEY, n_envs=1, rows=[(0, end, end, 0, 0, 9, -10.0)]))
        assert 300_000 * evidence(*KEY, "reward_before") == pytest.approx(before)
        assert 300_000 * evidence(*KEY, "reward_surge") == pytest.approx(surge)


def test_a_run_that_ends_before_700000_frames_has_no_time_after_a_surge():
    own = configuration(*KEY, rows=[(0, 9, 9, 0, 0, 9, 1.0)], frames=699_999, total_frames=699_999)
    assert rows_of(own)(*KEY, "reward_before").shape == (0,)


@pytest.mark.parametrize(
    "definition", [f"last {LAST} training episodes", "greedy evaluation", "sampled evaluation"]
)
def test_no_other_definition_has_a_time_before_and_after(definition):
    assert rows_of(configuration(*KEY, rows=[(0, 9, 9, 0, 0, 9, 1.0)]), definition)(
        *KEY, "reward_before"
    ).shape == (0,)


def test_episodes_are_those_of_the_definitions_mode_and_study():
    table = pd.DataFrame(
        {
            "mode": ["greedy", "sampled", "sampled"],
            "seed": [0, 0, 1],
            "corridor": [0.9, 0.1, np.nan],
            "empty_x": 3.0,
        }
    )
    short = table.assign(corridor=0.5)
    studies = sort([*grid(["dqn"]), configuration(*KEY, study="wide", **SHORT)])
    episodes = {("main", *KEY): table, ("baseline", *KEY): short}
    training, greedy = (evidence_of(studies, one, episodes) for one in (PRIMARY, "greedy evaluation"))
    assert training(*KEY, "corridor").tolist() == [0.1]  # of the seed that has one
    assert training(*KEY, "corridor", study="baseline").tolist() == [0.5, 0.5]
    assert greedy(*KEY, "corridor").tolist() == [0.9]
    assert training(*KEY, "empty_x").tolist() == [3, 3]


def test_hours_are_of_one_seed_and_a_million_frames_whatever_a_run_holds():
    """An hour for 4 seeds of 500,000 frames is half an hour for one of a million; a run without a time
    has none.
    """
    one = configuration(*KEY, n_seeds=4, wall=3600, frames=500_000)
    one.runs.append(run([9], frames=500_000))
    assert hours(one).tolist() == [0.5]
    assert one.n_seeds == 5
    assert rows_of(one)(*KEY, "hours").tolist() == [0.5]
    assert rows_of(one, "greedy evaluation")(*KEY, "hours").size == 0  # that took no training


def test_the_papers_tables_are_one_number_a_configuration_and_ten_hours():
    assert of_paper("dqn", "relu", "reward").tolist() == [-7.616]
    assert of_paper("dqn", "relu", "hours").tolist() == [10]
    for asked in (("dqn", "mish", "reward"), ("dqn", "relu", "stops"), ("dqn", "relu", "reward", "initial")):
        assert of_paper(*asked).shape == (0,)
