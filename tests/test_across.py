"""Policies across ladders: what is flown, what is judged, what is kept and drawn."""

import functools
import json
import re

import numpy as np
import pandas as pd
import pytest

from uavnav.__main__ import main
from uavnav.algorithms import ppo
from uavnav.evaluation import across, evaluate_policy, summary
from uavnav.runs import Run
from uavnav.runs.metrics import PER_EPISODE
from uavnav.runs.tables import RunError
from uavnav.tasks.baselines import BASELINES
from uavnav.tasks.ladders import LADDERS
from uavnav.tasks.protocol import GROUPS, LADDER_NAMES, SPLITS, USUAL
from uavnav.tasks.table import EMPTY, make_task
from uavnav.tasks.task import Task
from uavnav.tasks.world import World


def scripted(name):
    return across.Flyer(name, {"scripted": {0: BASELINES[name]}})


def test_the_command_knows_the_ladders_without_torch_by_their_names():
    assert tuple(LADDERS) == LADDER_NAMES == GROUPS["all"]
    assert set(GROUPS["faults"]) < set(LADDERS)


def test_a_ladder_is_judged_by_reward_collisions_per_1000_px_and_episodes_still_up():
    rows = pd.DataFrame(
        {
            "seed": [0, 0, 1, 1],
            "mode": "sampled",
            "rung": 2.0,
            "reward": [1.0, 3.0, 4.0, 4.0],
            "distance": [1000, 3000, 500, 500],
            "terminated": [True, False, True, True],
            "truncated": [False, True, False, False],
        }
    )
    table = across.judged({"mine": rows}).set_index("measure")
    assert table["value"].to_dict() == {
        "reward": 3.0,
        "collisions": pytest.approx((0.25 + 2.0) / 2),
        "survive": 25.0,
    }
    assert set(table["n"]) == {2}


def test_the_interval_of_one_seed_is_over_its_episodes_and_of_several_over_seeds():
    rows = pd.DataFrame({"seed": 0, "mode": "sampled", "rung": 2.0, "reward": [1.0, 3.0] * 50})
    rows = rows.assign(distance=1000, terminated=[True, False] * 50, truncated=[False, True] * 50)
    table = across.judged({"mine": rows}, of_one_seed=True).set_index("measure")
    assert set(zip(table["n"], table["over"], strict=True)) == {(100, "episodes")}
    half = 1.96 * 1.0 / 100**0.5  # of a mean of 100 that are 1 or 3
    assert table.loc["reward", ["low", "high"]].tolist() == pytest.approx([2 - half, 2 + half], abs=0.05)
    assert table.loc["collisions", ["low", "high"]].tolist() == pytest.approx([0.402, 0.598], abs=0.025)
    both = pd.concat([rows, rows.assign(seed=1, reward=4.0)])
    table = across.judged({"mine": both}, of_one_seed=True).set_index("measure")
    half = 12.706  # Student's t of one degree of freedom; the seeds are 2 and 4
    assert table.loc["reward", ["n", "value", "over"]].tolist() == [2, 3.0, "seeds"]
    assert table.loc["reward", ["low", "high"]].tolist() == pytest.approx([3 - half, 3 + half], abs=1e-3)


def test_an_episode_that_reaches_its_goal_has_not_collided():
    rows = pd.DataFrame(
        {"seed": 0, "mode": "sampled", "rung": 0.0, "reward": [9.0, -10.0], "distance": [500, 500]}
        | {"terminated": True, "truncated": False, "succeeded": [1, 0]}
    )
    assert across.judged({"mine": rows}).set_index("measure")["value"]["collisions"] == 1.0


def test_on_the_slalom_passages_per_1000_steps_and_per_episode_are_judged_and_drawn_too():
    rows = pd.DataFrame({"seed": [0, 0, 1], "mode": "sampled", "rung": 80.0, "reward": 1.0, "distance": 900})
    rows = rows.assign(terminated=True, truncated=False, steps=[100, 300, 500], passages=[1, 3, 4])
    table = across.judged({"mine": rows})
    found = table.set_index("measure")
    assert [*found.index] == [*PER_EPISODE, "passages_per_1000_steps", "passages_per_episode"]
    assert found.loc["passages_per_1000_steps", "value"] == (1000 * 4 / 400 + 1000 * 4 / 500) / 2
    assert found.loc["passages_per_episode", "value"] == (2 + 4) / 2
    titles = [
        axes.get_title("left")
        for axes in across.draw(table, LADDERS["slalom"], dict.fromkeys(table["name"], "ppo")).figure.axes
    ]
    assert titles == [*PER_EPISODE.values(), "passages per 1,000 steps", "passages per episode"]


def test_straight_episode_meets_obstacles_the_sooner_the_more_there_are():
    rows = across.climb(scripted("straight"), LADDERS["density"], episodes=10, max_steps=100)
    flown = rows.groupby("rung")["distance"].mean()
    assert list(flown.index) == list(LADDERS["density"].rungs)
    assert flown[0.0] == 28 * 9  # 250 px from the start to where the drone touches the border
    assert flown[20.0] < flown[8.0] < flown[0.0]
    assert len(rows) == 11 * 10


def test_with_a_goal_reactive_flies_all_11_densities_and_reaches_5_of_5_goals_where_nothing_is_in_its_way(
    monkeypatch,
):
    monkeypatch.setitem(SPLITS, "test", SPLITS["test"]._replace(n=5))
    task = make_task(EMPTY, {"goal_radius": 41.0}, task="goal")  # whose layouts no other test draws
    rows = across.climb(scripted("reactive"), LADDERS["density"], 5, 120, scripted=task)
    reached = rows.groupby("rung")["succeeded"].sum()
    assert [*reached.index] == [*LADDERS["density"].rungs]
    assert reached[0.0] == 5


def test_the_ladder_speed_is_not_for_a_plugins_task_whose_own_functions_it_would_lose():
    class Slow(Task):
        pass

    own = make_task(task=Slow(World(), EMPTY))
    assert [LADDERS[name].fits(own) for name in ("density", "speed", "noise")] == [True, False, True]
    assert LADDERS["speed"].fits(make_task(EMPTY))


@pytest.mark.parametrize("columns", [40, 80, 200])
def test_no_number_of_a_table_is_cut_off_whatever_the_width_of_the_terminal(columns, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    measures = [*PER_EPISODE, "passages_per_1000_steps", "passages_per_episode"]
    who = ["runs/ppo/of_a_long_name", "sampled", 160.0]
    rows = [(*who, measure, 10, 123.4, 99.5, 145.6, "seeds") for measure in measures]
    table = pd.DataFrame(
        rows, columns=["name", "mode", "rung", "measure", "n", "value", "low", "high", "over"]
    )
    summary.show(across.shown(table, "slalom"))
    out = capsys.readouterr().out
    assert out.count(" 123.4") == out.count("[99.5,145.6]") == len(measures)


def test_a_ladder_of_circles_is_left_out_for_who_flies_in_a_box_and_alone_it_is_refused(tmp_path):
    config = ppo.PPOConfig(
        task="space", n_envs=16, hidden=(4,), total_frames=64, frames_per_batch=64, epochs=1, compile="off"
    )
    run = ppo.train(config, out=tmp_path / "run", quiet=True)
    told = []
    fly = functools.partial(
        across.across, [across.of_run("mine", run)], episodes=1, max_steps=2, out=tmp_path, quiet=True
    )
    fly(["density", "sticky"], tell=told.append)
    fit = "arc, reach, speed, noise, lost, late, sticky fit"
    assert told == [f"left out: the ladder density, which the task of mine does not have; {fit}"]
    assert [path.name for path in tmp_path.glob("*.svg")] == ["across-sticky-1-2.svg"]
    with pytest.raises(
        RunError, match="--across density: no ladder of these tasks; give some of arc, reach, s"
    ):
        fly(["density"], tell=told.append)


@pytest.mark.parametrize("name", ["late", "density", "reach", "speed"])
def test_a_scripted_policy_reads_distances_right_where_a_sensor_reaches_less_far(name):
    near = make_task(EMPTY, {"sensor_radius": 90.0})
    ladder = LADDERS[name]._replace(rungs=LADDERS[name].rungs[:1])
    rows = across.climb(scripted("reactive"), ladder, episodes=20, max_steps=200, scripted=near)
    assert not rows["terminated"].any()


def test_scripted_policies_are_left_out_where_a_run_chooses_among_other_turns(tmp_path):
    small = {"total_frames": 64, "n_envs": 2, "frames_per_batch": 64, "hidden": (8,), "epochs": 1}
    run = ppo.train(ppo.PPOConfig(**small, world={"n_turns": 4}), tmp_path / "run", quiet=True)
    said = []
    found = across.across([across.of_run("mine", run)], ["sticky"], 2, 20, None, True, said.append)
    assert said == ["left out: the scripted policies, which choose among 10 turns and 10 distances"]
    assert {one["name"] for one in found} == {"mine"}


def test_without_a_run_scripted_policies_fly_the_world_that_is_named(tmp_path, capsys):
    words = ["evaluate", "straight", "--task", "space", "--across", "sticky", "density", "--episodes", "2"]
    assert main([*words, "--max-steps", "5", "--json", "--out", str(tmp_path / "new" / "folder")]) == 0
    printed, err = capsys.readouterr()
    assert err.startswith("left out: the ladder density, which the task of straight")
    told = json.loads(printed)
    assert {one["ladder"] for one in told} == {"sticky"}
    assert {(one["over"], one["n"]) for one in told} == {("episodes", 2)}  # of one seed
    assert (tmp_path / "new" / "folder" / "across-sticky-2-5.png").exists()
    assert main([*words, "--layouts", "train"]) == 2
    assert (
        "--layouts train: --across and --transfer fly on test layouts of their own" in capsys.readouterr().err
    )


def test_the_first_rung_of_noise_is_the_evaluation_itself():
    ladder = LADDERS["noise"]._replace(rungs=LADDERS["noise"].rungs[:1])
    rows = across.climb(scripted("reactive"), ladder, episodes=5, max_steps=60)
    own = evaluate_policy(BASELINES["reactive"], "test", 5, 60)
    pd.testing.assert_frame_equal(rows[own.columns], own, check_exact=True)
    assert rows["truncated"].all()  # the rule is safe where echoes are exact


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    config = ppo.PPOConfig(total_frames=64, n_envs=2, frames_per_batch=64, hidden=(8,), epochs=1, n_seeds=2)
    return ppo.train(config, out=tmp_path_factory.mktemp("across") / "mine", quiet=True)


def test_a_run_keeps_a_row_an_episode_and_a_figure_a_ladder_and_stays_the_run_it_was(run, capsys):
    words = [
        "evaluate",
        str(run.path),
        "--across",
        "arc",
        "sticky",
        "--episodes",
        "2",
        "--max-steps",
        "20",
        "--json",
    ]
    assert main(words) == 0
    said = json.loads(capsys.readouterr().out)
    assert {one["ladder"] for one in said} == {"arc", "sticky"}
    assert {one["name"] for one in said} == {str(run.path), *USUAL}
    kept = pd.read_parquet(run.path / "across-arc-2-20.parquet")
    assert len(kept) == 4 * 2 * 2 * 2  # rungs, modes, seeds, sets
    assert kept.attrs == {"ladder": "arc", "episodes": 2, "max_steps": 20}
    assert (run.path / "across-sticky-2-20.png").read_bytes()[:4] == b"\x89PNG"
    assert Run(run.path).evaluations() == []


@pytest.mark.parametrize(("given", "limits"), [(None, (2000, 1000)), (1500, (1500, 1500))])
def test_each_run_flies_by_the_limit_of_its_own_task_unless_one_is_given(
    given, limits, run, tmp_path, monkeypatch
):
    config = ppo.PPOConfig(task="goal", total_frames=64, n_envs=2, frames_per_batch=64, hidden=(8,), epochs=1)
    goal = ppo.train(config, out=tmp_path / "goal", quiet=True)
    flown, told, climb = {}, [], across.climb

    def short(who, ladder, episodes, max_steps, *others):
        flown[who.name] = max_steps
        return climb(who, ladder, episodes, 2, *others)

    monkeypatch.setattr(across, "climb", short)
    both = [across.of_run("plain", run), across.of_run("goal", goal)]
    across.across(both, ["sticky"], 1, given, tmp_path, quiet=True, tell=told.append)
    assert (flown["plain"], flown["goal"], flown["reactive"]) == (*limits, limits[0])
    assert pd.read_parquet(goal.path / f"across-sticky-1-{limits[1]}.parquet").attrs["max_steps"] == limits[1]
    assert (tmp_path / f"across-sticky-1-{limits[0]}.png").exists()
    limits = "random 2,000, straight 2,000, reactive 2,000"
    differ = f"time limits differ (plain 2,000, goal 1,000, {limits}); --max-steps gives all the same"
    assert told == ([] if given else [differ])


def test_a_ladder_says_first_that_2_episodes_are_a_sketch_and_how_long_it_will_take(tmp_path, capsys):
    words = ["evaluate", "straight", "--across", "sticky", "--episodes", "2", "--max-steps", "5"]
    assert main([*words, "--out", str(tmp_path)]) == 0
    out, err = capsys.readouterr()
    assert "95 % intervals over 2 episodes, a sketch" in " ".join(out.split())
    sketch, long = err.splitlines()
    assert sketch == "--episodes 2 is a sketch; give 20 or more for intervals to trust"
    assert re.fullmatch(r"about \d+ s more, as the first rung took: 24 episodes on 4 rungs", long)


def test_orca_senses_velocities_across_a_ladder_too(tmp_path):
    words = ["evaluate", "orca", "--task", "moving", "--across", "speed", "--alone", "--episodes", "1"]
    assert main([*words, "--max-steps", "5", "--out", str(tmp_path)]) == 0


def test_the_figure_says_its_rewards_in_words_and_leaves_the_greedy_episodes_out():
    ladder = LADDERS["arc"]
    table = pd.DataFrame(
        [
            ["mine", mode, rung, measure, 2, float(rung), rung - 1.0, rung + 1.0]
            for mode in ("greedy", "sampled")
            for rung in ladder.rungs
            for measure in PER_EPISODE
        ],
        columns=["name", "mode", "rung", "measure", "n", "value", "low", "high"],
    )
    drawn = across.draw(table, ladder, {"mine": "ppo"})
    assert drawn.alt == "Reward per episode from 60 to 180 of sensor's arc [degrees]: mine: 60.0 to 180.0."
    assert all(len(axes.lines) == 1 for axes in drawn.figure.axes)
    assert np.isfinite(drawn.figure.axes[0].lines[0].get_ydata()).all()


def test_alone_a_run_flies_as_in_training_with_no_scripted_policy_beside_and_no_figure(run, capsys):
    words = [
        "evaluate",
        str(run.path),
        "--across",
        "sticky",
        "--alone",
        "--episodes",
        "2",
        "--max-steps",
        "9",
    ]
    assert main([*words, "--json"]) == 0
    assert {(one["name"], one["mode"]) for one in json.loads(capsys.readouterr().out)} == {
        (str(run.path), "sampled")
    }
    assert [path.name for path in run.path.glob("across-sticky-2-9.*")] == ["across-sticky-2-9.parquet"]
    alone = pd.read_parquet(run.path / "across-sticky-2-9.parquet")
    words.remove("--alone")
    assert main([*words, "--quiet"]) == 0
    beside = pd.read_parquet(run.path / "across-sticky-2-9.parquet")
    pd.testing.assert_frame_equal(alone, beside[beside["mode"] == "sampled"].reset_index(drop=True))
    assert main(["evaluate", str(run.path), "--alone"]) == 2
    assert capsys.readouterr().err.endswith("--alone: only --across adds scripted policies; leave it out\n")
