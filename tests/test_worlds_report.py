"""The report's section on worlds: what is measured of episodes, what claims are given, and the sentences
that follow.
"""

import shlex
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from bad_input import put
from runs_by_hand import rows, two, write_run

from uavnav import evaluation
from uavnav.cli import commands
from uavnav.colours import PILOTS
from uavnav.evaluation import Protocol
from uavnav.evaluation.scripted import SEEDS, rows_of_scripted
from uavnav.report import tables, worlds
from uavnav.report.claims import ALL_TASKS, NONE, RANKED, SCATTER, VARIATION, at
from uavnav.report.configurations import apart
from uavnav.report.worlds import Evidence, Worlds, leaders, measured, summary
from uavnav.tasks.faults import Faults
from uavnav.tasks.ladders import LADDERS
from uavnav.tasks.protocol import USUAL

NOTHING = {}, {}, pd.DataFrame()
"""Of scripted policies, rungs and runs."""


def seeds(reward, **more):
    return pd.DataFrame({"reward": reward, "collisions": 1.0, "survival": 9.0} | more, dtype=float)


def test_a_folder_without_the_study_has_no_section(tmp_path):
    assert worlds.gather([tmp_path]) == (None, [])
    put(tmp_path / "worlds" / "ppo" / "tanh" / "config.yaml", "algorithm: ppo")
    found, (line,) = worlds.gather([tmp_path])
    assert found is None
    assert "worlds/ppo/tanh" in line


def test_runs_below_a_folder_worlds_are_the_study_and_a_run_of_that_name_is_a_run(tmp_path):
    (tmp_path / "worlds").mkdir()
    assert apart([tmp_path], "worlds") == [tmp_path / "worlds"]
    (tmp_path / "worlds" / "config.yaml").touch()
    assert apart([tmp_path], "worlds") == []


def test_collisions_are_per_1000_px_and_an_episode_that_reaches_its_goal_is_cut_off_and_does_not_crash():
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
    table = measured(flown, limit=100)
    assert table["reward"].tolist() == [0.0, 3.0]
    assert table["collisions"].tolist() == [1.0, 0.5]
    assert table["survival"].tolist() == [55.0, 65.0]
    assert table["success"].tolist() == [50.0, 0.0]
    assert table["spl"].tolist() == [0.25, 0.0]


def test_where_success_is_measured_no_restricted_mean_of_survival_is_shown():
    found = Worlds(
        {("goal", "ppo", "tanh"): seeds([1, 2], success=50.0), ("drone", "ppo", "tanh"): seeds([1, 2])},
        *NOTHING,
    )
    shown = summary(found).groupby("task")["metric"].agg(set)
    assert "survival" in shown["drone"]
    assert "survival" not in shown["goal"]


def test_scatter_is_the_distance_to_the_configurations_median_in_units_of_its_worlds_mean_distance():
    found = Evidence(
        {("drone", "ppo", "tanh"): seeds([1, 2, 3]), ("drone", "ppo", "relu"): seeds([0, 5, 10])}
    )
    usual = (1 + 0 + 1 + 5 + 0 + 5) / 6
    assert found("ppo", "tanh", SCATTER, "drone").tolist() == [1 / usual, 0, 1 / usual]
    assert found("ppo", "relu", SCATTER, ALL_TASKS).tolist() == [5 / usual, 0, 5 / usual]


def test_a_mean_over_worlds_leaves_the_tuned_presets_out_and_asks_for_runs_in_each_world():
    found = Evidence(
        {
            ("drone", "ppo", "tanh"): seeds([1, 2]),
            ("goal", "ppo", "tanh"): seeds([3, 6]),
            ("goal, fast", "ppo", "tanh"): seeds([100, 100]),
            ("goal", "c51", "tanh"): seeds([7, 8]),
        }
    )
    assert found("ppo", "tanh", "reward", ALL_TASKS).tolist() == [2, 4]
    assert found("ppo", "tanh", "reward", "goal, fast").tolist() == [100, 100]
    assert found("c51", "tanh", "reward", "goal").tolist() == [7, 8]
    assert found("c51", "tanh", "reward", ALL_TASKS).size == 0
    assert found("dqn", "tanh", "reward", ALL_TASKS).size == 0


@pytest.mark.parametrize(("sign", "rho"), [(1, 1.0), (-1, -1.0)])
def test_the_rank_correlation_across_the_configurations_of_a_world_is_one_number_a_seed(sign, rho):
    configurations = [("ppo", "tanh"), ("ppo", "relu"), ("dqn", "tanh"), ("dqn", "relu")]
    # seeds order configurations in opposite ways
    reward = np.array([[1, 4], [2, 3], [3, 2], [4, 1]], dtype=float)
    found = Evidence(
        {
            (world, *configuration): seeds(own, gradient_variation=sign * 10 * own)
            for world in ("drone", "goal")
            for configuration, own in zip(configurations, reward, strict=True)
        }
    )
    assert found(RANKED, RANKED, "gradient_variation_explains", ALL_TASKS) == pytest.approx([rho, rho])
    assert found(RANKED, NONE, "gradient_variation_explains", ALL_TASKS).tolist() == [0, 0]
    assert VARIATION == "gradient_variation"


def made_up():
    """PPO far above and DQN among random policies in the paper's task, both below `reactive` where there is
    a goal.
    """
    learned = {
        ("drone", "ppo", "tanh"): seeds([40, 41, 42, 43, 44]),
        ("drone", "dqn", "tanh"): seeds([-9, -8, -7, -6, -5]),
        ("goal", "ppo", "tanh"): seeds([4, 4.1, 4.2, 4.3, 4.4]),
        ("moving", "ppo", "tanh"): seeds([4, 6, 8, 10, 12]),
        ("goal, fast", "ppo", "tanh"): seeds([5, 5.1, 5.2, 5.3, 5.4], greedy=7.0),
    }
    scripted = {
        (world, name): seeds(reward)
        for world, who in (("drone", 20), ("goal", 10), ("moving", 9))
        for name, reward in (("random", [-8, -7, -6]), ("straight", [-8]), ("reactive", [who]))
    }
    return Worlds(learned, scripted, *NOTHING[1:])


def test_the_leaders_are_who_is_ahead_in_each_world_and_who_is_no_better_than_random():
    found = leaders(summary(made_up()))
    assert found[["task", "best", "best_scripted", "ahead", "chance"]].to_numpy().tolist() == [
        ["drone", "PPO tanh", "reactive", "a configuration", "DQN tanh"],
        ["goal", "PPO tanh fast", "reactive", "a scripted policy", ""],
        ["moving", "PPO tanh", "reactive", "neither", ""],
    ]
    assert tables.listed(found, "leaders")[1][:5] == [
        "drone",
        "PPO tanh",
        "42.00 [40.04, 43.96]",
        "reactive",
        "20.00",
    ]
    alone = made_up()._replace(scripted={})
    assert {*leaders(summary(alone))["ahead"]} == {""}


def test_a_worlds_table_has_configurations_and_scripted_policies():
    found = made_up()
    rows = tables.crossed(summary(found).query("task == 'goal'"), "who", "metric", 2, worlds.LABELS)
    assert [row[0] for row in rows[1:]] == ["PPO tanh", "PPO tanh fast", "random", "straight", "reactive"]
    assert rows[0] == ["who", *worlds.MEASURES.values(), "seeds"]
    assert rows[1][1].startswith("4.20 [4.")
    assert [row[2] for row in rows[1:]] == ["–", "7.00 [7.00, 7.00]", "–", "–", "–"]
    assert rows[-1][1:] == ["10.00", "–", "1.00", "9.00", "1"]


# -- rows of scripted policies -------------------------------------------------------------------------------

GOAL = Protocol(max_steps=1000, task="goal")


def test_a_ladder_is_drawn_for_configurations_of_the_papers_world_and_for_scripted_policies_rung_by_rung():
    rungs = LADDERS["density"].rungs
    flown = {at("reward", "density", rung): 100.0 - rung for rung in rungs}
    learned = {
        ("drone", "ppo", "tanh"): seeds([40, 41], **flown),
        ("moving", "dqn", "tanh"): seeds([40, 41], **flown),
    }
    # one rung was not flown
    scripted = {("density", rung): {"reactive": seeds([50.0 + rung])} for rung in rungs[1:]}
    climbed = worlds.ladder(Worlds(learned, {}, scripted, *NOTHING[2:]), "density")
    drawn = worlds.figure(climbed, "density")
    lines = {line.get_label(): line for line in drawn.figure.axes[0].lines}
    assert [*lines] == ["PPO", "reactive"]
    assert lines["PPO"].get_xydata().tolist() == [[rung, 100.0 - rung] for rung in rungs]
    assert lines["reactive"].get_xydata().tolist() == [[rung, 50.0 + rung] for rung in rungs[1:]]
    assert worlds.ladder(Worlds(learned, *NOTHING), "slalom").empty
    own = learned["drone", "ppo", "tanh"]
    seven = [("drone", one, "tanh") for one in ("ppo", "dqn", "a2c", "c51", "sac")]
    seven += [("drone, fast", one, "tanh") for one in ("ppo", "dqn")]
    all_of_them = Worlds(dict.fromkeys(seven, own), {}, scripted, *NOTHING[2:])
    drawn = worlds.figure(worlds.ladder(all_of_them, "density"), "density")
    lines = {line.get_label(): line for line in drawn.figure.axes[0].lines}
    assert (lines["PPO"].get_color(), lines["DQN"].get_color()) == (PILOTS["ppo"], PILOTS["dqn"])
    assert len({line.get_color() for line in lines.values()}) == len(lines) == 8


def keep(folder, who, protocol=GOAL, reward=3.0, **header):
    """Two episodes of a script, as a command would have kept them, but for the header."""
    folder.mkdir(parents=True, exist_ok=True)
    flown = rows(0, (10, 10, 1, 1, 5, 50, reward), (40, 30, 4, 0, 10, 100, reward))
    flown.attrs = {"layouts": "test", "episodes": 200, "max_steps": 1000, "task": "goal"} | header
    flown.to_parquet(folder / protocol.file(who))
    return flown


def test_rows_of_another_limit_or_task_are_refused_in_one_line_and_the_others_are_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # a line shortens long paths
    folder = Path("mine")
    flown = keep(folder, "straight")
    keep(folder, "random", max_steps=2000)
    keep(folder, "reactive", task="moving")
    found, left_out = rows_of_scripted([folder], GOAL)
    assert found.keys() == {"straight"}
    pd.testing.assert_frame_equal(found["straight"], flown)
    start = "mine/random-goal-test-200-1000.parquet: its rows are of max_steps=2000, not of max_steps=1000; "
    command = f"uavnav evaluate random --max-steps 1000 --task goal --seeds {SEEDS} --out mine"
    assert left_out[0] == f"{start}write them with {command}"
    assert "task=moving, not of" in left_out[1]
    assert len(left_out) == 2


def test_rows_of_scripted_policies_are_of_the_first_folder_with_them_and_a_damaged_file_is_named(tmp_path):
    mine, theirs = tmp_path / "mine", tmp_path / "theirs"
    keep(theirs, "straight", reward=1.0)
    keep(mine, "straight", reward=2.0)
    keep(theirs, "reactive", reward=4.0)
    (mine / GOAL.file("random")).write_text("no rows")
    found, (line,) = rows_of_scripted([mine, theirs], GOAL)
    assert {who: own["reward"].mean() for who, own in found.items()} == {"straight": 2.0, "reactive": 4.0}
    assert line.startswith(
        f"{mine / GOAL.file('random')}: missing or damaged; write them with uavnav evaluate random "
    )


def test_the_command_that_the_line_of_missing_rows_names_writes_them(tmp_path):
    protocol = Protocol("density-4/test", 3, 20, Faults(noise=5))
    _, (line,) = rows_of_scripted([tmp_path / "rows"], protocol)
    start, words = line.split("; write them with uavnav evaluate ")
    assert start == f"{tmp_path}/rows: no rows of random, straight, reactive"
    assert commands.run("evaluate", [*shlex.split(words), "--quiet"]) == 0
    found, left_out = rows_of_scripted([tmp_path / "rows"], protocol)
    assert ([*found], left_out) == ([*USUAL], [])
    assert {who: own["seed"].nunique() for who, own in found.items()} == {
        "random": SEEDS,
        "straight": 1,
        "reactive": 1,
    }
    assert found["random"].groupby("seed")["reward"].sum().nunique() > 1


def test_a_task_lacks_scripted_policies_whose_rows_are_missing_and_nobody_flies(tmp_path, monkeypatch):
    monkeypatch.setattr(evaluation, "fly_modes", None)
    episodes = [rows(seed, (9, 9, 1, 1, 5, 50, 1.0 + seed), (9, 9, 1, 1, 5, 50, 3.0)) for seed in (0, 1)]
    flown = pd.concat(episodes, ignore_index=True)
    for task, limit, world in (("drone", 2000, {}), ("goal", 1000, {}), ("drone", 2000, {"sensor_arc": 90})):
        path = tmp_path / "worlds" / "paper" / f"{task}{len(world)}"
        reward = "goal" if task == "goal" else "eq14"
        write_run(path, two(0, -6.0), two(1, -8.0), task=task, world=world, reward=reward)
        modes = [flown.assign(mode="greedy", reward=5.0), flown.assign(mode="sampled")]
        pd.concat(modes).to_parquet(path / f"evaluation-test-200-{limit}.parquet")
        (path / "episodes.parquet").unlink()  # training's, which a repository may leave out
    keep(tmp_path / "worlds" / "baselines", "straight", reward=4.0)
    found, left_out = worlds.gather([tmp_path])
    assert [*found.scripted] == [("goal", "straight")]
    assert found.scripted["goal", "straight"]["reward"].tolist() == [4.0]
    assert found.seeds["goal", "dqn", "tanh"][["reward", "greedy"]].to_numpy().tolist() == [
        [2.0, 5.0],
        [2.5, 5.0],
    ]
    home = tmp_path / "worlds" / "baselines"
    assert left_out == [
        f"{home}: no rows of random, straight, reactive; write them with uavnav evaluate random straight "
        "reactive"
        f" --max-steps 2000 --seeds 10 --out {home}",
        "drone, sensor_arc=90.0: no rows of scripted policies, which fly only with the usual settings of a"
        " task",
        f"{home}: no rows of random, reactive; write them with uavnav evaluate random reactive"
        f" --max-steps 1000 --task goal --seeds 10 --out {home}",
    ]
    ahead = leaders(summary(found)).set_index("task")[["best", "value", "best_scripted", "scripted"]]
    assert ahead.loc["drone"].tolist()[:3] == ["DQN tanh", 2.25, ""]
    assert ahead.loc["goal"].tolist()[2:] == ["straight", 4.0]


def test_scripted_policies_of_a_rung_are_read_from_its_own_rows_and_a_run_tells_how_it_was_made(tmp_path):
    path, home = tmp_path / "worlds" / "paper" / "drone", tmp_path / "worlds" / "baselines"
    write_run(path, two(0, -6.0), two(1, -8.0))
    flown = pd.concat([rows(seed, (9, 9, 1, 1, 5, 50, 1.0 + seed)) for seed in (0, 1)], ignore_index=True)
    flown.assign(mode="sampled").to_parquet(path / "evaluation-test-200-2000.parquet")
    climbed = [flown.assign(mode="sampled", rung=float(rung)) for rung in LADDERS["density"].rungs]
    pd.concat(climbed, ignore_index=True).to_parquet(path / "across-density-200-2000.parquet")
    home.mkdir()
    for rung in (0, 4):
        own = rows(0, (10, 10, 1, 1, 5, 50, 100.0 - rung))
        own.attrs = {"layouts": f"density-{rung}/test", "episodes": 200, "max_steps": 2000}
        own.to_parquet(home / f"reactive-density-{rung}-test-200-2000.parquet")
    found, left_out = worlds.gather([tmp_path])
    assert {rung for _, rung in found.rungs} == {*LADDERS["density"].rungs}
    scripted = {rung: own["reactive"]["reward"].tolist() for (_, rung), own in found.rungs.items() if own}
    assert scripted == {0: [100.0], 4: [96.0]}
    assert sum("--layouts density-" in line for line in left_out) == 11
    (made,) = found.runs.to_dict("records")
    told = {
        "run": str(path),
        "task": "drone",
        "seeds": 2,
        "git_commit": "c0ffee",
        "processor": "an abacus",
        "cores": 2,
    }
    assert told.items() <= made.items()
