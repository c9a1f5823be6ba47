"""The report's section on worlds: what is measured of flights, what claims are given, and the sentences that follow."""

import numpy as np
import pandas as pd
import pytest

from uavnav.report import worlds
from uavnav.report.cells import of_worlds
from uavnav.report.discussion import ALL, CELLS, NONE, SCATTER, VARIATION
from uavnav.report.worlds import Evidence, Worlds, measured, sentences, summary


def seeds(reward, **more):
    return pd.DataFrame({"reward": reward, "collisions": 1.0, "survival": 9.0} | more, dtype=float)


def test_a_folder_without_the_study_has_no_section(tmp_path):
    assert worlds.gather([tmp_path]) is None


def test_runs_below_a_folder_worlds_are_the_study_and_a_run_of_that_name_is_a_run(tmp_path):
    (tmp_path / "worlds").mkdir()
    assert of_worlds([tmp_path]) == [tmp_path / "worlds"]
    (tmp_path / "worlds" / "config.yaml").touch()
    assert of_worlds([tmp_path]) == []


def test_collisions_are_per_1000_px_and_a_flight_that_reaches_its_goal_is_cut_off_and_does_not_crash():
    flown = pd.DataFrame(
        {
            "seed": [0, 0, 1, 1],
            "steps": [10, 100, 30, 100],
            "reward": [-10.0, 10.0, 2.0, 4.0],
            "distance": [500, 500, 1000, 1000],
            "terminated": [True, True, True, False],
            "truncated": [False, False, False, True],
            "succeeded": [0, 1, 0, 0],
            "shortest": [250.0, 250.0, 500.0, 500.0],
        }
    )
    table = measured(flown, cap=100)
    assert table["reward"].tolist() == [0.0, 3.0]
    assert table["collisions"].tolist() == [1.0, 0.5]
    assert table["survival"].tolist() == [55.0, 65.0]
    assert table["success"].tolist() == [50.0, 0.0]
    assert table["spl"].tolist() == [0.25, 0.0]


def test_scatter_is_the_distance_to_the_cells_median_in_units_of_its_worlds_mean_distance():
    found = Evidence({("drone", "ppo", "tanh"): seeds([1, 2, 3]), ("drone", "ppo", "relu"): seeds([0, 5, 10])})
    usual = (1 + 0 + 1 + 5 + 0 + 5) / 6
    assert found("ppo", "tanh", SCATTER, "drone").tolist() == [1 / usual, 0, 1 / usual]
    assert found("ppo", "relu", SCATTER, ALL).tolist() == [5 / usual, 0, 5 / usual]


def test_a_mean_over_worlds_leaves_the_tuned_presets_out():
    found = Evidence(
        {
            ("drone", "ppo", "tanh"): seeds([1, 2]),
            ("goal", "ppo", "tanh"): seeds([3, 6]),
            ("goal, fast", "ppo", "tanh"): seeds([100, 100]),
        }
    )
    assert found("ppo", "tanh", "reward", ALL).tolist() == [2, 4]
    assert found("ppo", "tanh", "reward", "goal, fast").tolist() == [100, 100]
    assert found("dqn", "tanh", "reward", ALL).size == 0


@pytest.mark.parametrize(("sign", "rho"), [(1, 1.0), (-1, -1.0)])
def test_the_rank_correlation_across_the_cells_of_a_world_is_one_number_a_seed(sign, rho):
    cells = [("ppo", "tanh"), ("ppo", "relu"), ("dqn", "tanh"), ("dqn", "relu")]
    reward = np.array([[1, 4], [2, 3], [3, 2], [4, 1]], dtype=float)  # seeds order cells in opposite ways
    found = Evidence(
        {
            (world, *cell): seeds(own, gradient_variation=sign * 10 * own)
            for world in ("drone", "goal")
            for cell, own in zip(cells, reward, strict=True)
        }
    )
    assert found(CELLS, CELLS, "gradient_variation_explains", ALL) == pytest.approx([rho, rho])
    assert found(CELLS, NONE, "gradient_variation_explains", ALL).tolist() == [0, 0]
    assert VARIATION == "gradient_variation"


def made_up():
    """PPO far above and DQN among random flight in the paper's world, both below the rule where there is a goal."""
    learned = {
        ("drone", "ppo", "tanh"): seeds([40, 41, 42, 43, 44]),
        ("drone", "dqn", "tanh"): seeds([-9, -8, -7, -6, -5]),
        ("goal", "ppo", "tanh"): seeds([4, 4.1, 4.2, 4.3, 4.4]),
        ("goal, fast", "ppo", "tanh"): seeds([5, 5.1, 5.2, 5.3, 5.4]),
    }
    scripted = {
        (world, name): seeds(reward)
        for world, rule in (("drone", 20), ("goal", 10))
        for name, reward in (("random", [-8, -7, -6]), ("straight", [-8]), ("reactive", [rule]))
    }
    return Worlds(learned, scripted, [], pd.DataFrame(), [])


def test_the_sentences_say_who_is_ahead_where_a_rule_beats_all_and_where_random_flight_is_not_passed():
    said = sentences(summary(made_up()))
    assert said[0].startswith("In drone, reward per flight: PPO tanh 42.00 [")
    assert said[0].endswith("the best script, reactive, has 20.00.")
    assert said[1].startswith("In goal, reward per flight: PPO tanh fast 5.20 [")
    assert said[2:] == [
        "A scripted rule still beats every learned cell, its reward above the interval of each, in goal.",
        "A learned cell is above every script, with its whole interval, in drone (PPO tanh).",
        "Every learned cell is above random flight, intervals apart, in goal.",
        "Not every learned cell is above random flight with intervals apart in drone.",
    ]


def test_a_worlds_table_has_cells_and_scripts_and_the_figure_a_panel_a_world():
    found = made_up()
    rows = worlds.table(summary(found), "goal")
    assert [row[0] for row in rows[1:]] == ["PPO tanh", "PPO tanh fast", "random", "straight", "reactive"]
    assert rows[0] == ["who", *worlds.MEASURES.values(), "seeds"]
    assert rows[1][1].startswith("4.20 [4.")
    assert rows[-1][1:] == ["10.00", "1.00", "9.00", "1"]
    drawn = worlds.draw(summary(found))
    assert [axes.get_title("left") for axes in drawn.figure.axes] == ["drone", "goal"]
    assert drawn.alt.startswith("Best reward per flight in each world: drone: 42.0 (95 % interval")
