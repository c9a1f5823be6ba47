"""Evaluation: one row a layout, repeatable, censored where it was cut off."""

import functools
import json
import math
import re
import shutil
import subprocess
import sys
import types

import numpy as np
import pandas as pd
import pytest
import torch
from policies_by_hand import write_zip
from runs_by_hand import write_policies

import uavnav
from uavnav.algorithms import ppo
from uavnav.cli import commands
from uavnav.evaluation import BEHAVIOUR_COLUMNS, evaluate_policy, evaluate_run, summary
from uavnav.report import behaviour
from uavnav.runs import Run
from uavnav.runs.evaluations import Protocol, usual
from uavnav.runs.metrics import EPISODE_COLUMNS
from uavnav.runs.paper import TABLES
from uavnav.runs.tables import read_table, write_table
from uavnav.tasks import layouts
from uavnav.tasks.baselines import straight_ahead, uniform_random
from uavnav.tasks.faults import NO_FAULTS, Faults
from uavnav.tasks.protocol import TASK_NAMES
from uavnav.tasks.table import TASKS

fly_command = functools.partial(commands.run, "evaluate")


@pytest.fixture(scope="module", params=["ppo", "dqn"])
def trained(request, tmp_path_factory):
    """A finished run of the seeds 4, 5 and 6 that was not evaluated."""
    folder = tmp_path_factory.mktemp("evaluate") / "run"
    return Run(write_policies(folder, request.param, seed=4, n_seeds=3, layouts="train"))


@pytest.fixture
def run(trained, tmp_path):
    """A copy of it to write in."""
    return Run(shutil.copytree(trained.path, tmp_path / "run"))


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_an_episode_that_never_hits_is_truncated_at_the_limit_and_no_collision():
    rows = evaluate_policy(
        lambda observation, generator: torch.zeros(len(observation), dtype=torch.int64),
        episodes=3,
        max_steps=7,
    )
    assert rows.truncated.all()
    assert not rows.terminated.any()
    assert (rows.full_stops == 7).all()
    assert rows.reward.tolist() == pytest.approx([-0.07] * 3, abs=1e-9)


def test_evaluating_twice_gives_the_same_rows_and_another_seed_others():
    first, second = (evaluate_policy(uniform_random, episodes=50) for _ in range(2))
    assert first.equals(second)
    assert not first.equals(evaluate_policy(uniform_random, episodes=50, seed=1))


@pytest.mark.parametrize("greedy", [True, False])
def test_a_trained_policy_evaluated_twice_gives_the_same_20_rows(trained, greedy):
    policy = uavnav.load_policy(trained.path, seed=5, greedy=greedy)
    first, second = (evaluate_policy(policy, episodes=20, max_steps=100) for _ in range(2))
    pd.testing.assert_frame_equal(first, second, check_exact=True)
    other = evaluate_policy(policy, episodes=20, max_steps=100, seed=1)
    same = first.drop(columns="seed").equals(other.drop(columns="seed"))
    assert same == greedy  # only sampling asks the generator


def test_evaluation_leaves_training_its_files_and_the_global_random_state_alone(run):
    before, state = contents(run.path), torch.get_rng_state()
    evaluate_run(run, episodes=5, max_steps=50)
    assert torch.equal(torch.get_rng_state(), state)
    after = contents(run.path)
    assert {name: after.pop(name) for name in before} == before
    assert sorted(after) == ["behaviour-test-5-50.parquet", "evaluation-test-5-50.parquet"]


@pytest.mark.parametrize("limit", [1, 27, 28])
def test_an_episode_that_the_limit_cuts_off_is_truncated_and_one_that_hits_in_that_step_terminated(limit):
    rows = evaluate_policy(straight_ahead, uavnav.layouts.generate(2, k=0), episodes=2, max_steps=limit)
    assert dict(rows.dtypes.astype(str)) == EPISODE_COLUMNS
    assert rows.layout.tolist() == [0, 1]
    assert rows.steps.tolist() == [limit] * 2
    assert rows.truncated.tolist() == [limit < 28] * 2
    assert rows.terminated.tolist() == [limit == 28] * 2


def test_each_seed_and_mode_of_a_run_has_a_row_a_test_set_and_the_run_reads_them_back(run):
    assert run.evaluation() is None
    rows = evaluate_run(run, episodes=7, max_steps=50)
    assert list(rows.columns) == [*EPISODE_COLUMNS, "mode"]
    assert rows.groupby(["mode", "seed"]).layout.apply(list).tolist() == [list(range(7))] * 6
    assert rows["mode"].unique().tolist() == ["greedy", "sampled"]
    pd.testing.assert_frame_equal(Run(run.path).evaluation(), rows, check_exact=True)
    assert (rows.truncated == ((rows.steps == 50) & ~rows.terminated)).all()
    assert (rows.truncated | rows.terminated).all()


def test_behaviour_is_the_episode_step_by_step_whose_counts_are_the_episodes(run):
    rows = evaluate_run(run, episodes=12, max_steps=90)
    assert list(pd.read_parquet(run.behaviour_file()).columns) == [*BEHAVIOUR_COLUMNS, "mode"]
    episodes = dict(list(behaviour.read(run).groupby(["mode", "seed", "layout"])))
    assert len(episodes) == 2 * 3 * 10  # of the first ten layouts
    collisions = 0
    for row in rows[rows.layout < 10].itertuples():
        episode = episodes[row.mode, row.seed, row.layout]
        assert episode.step.tolist() == list(range(1, row.steps + 1))
        distance, turn = episode.action % 10, episode.action // 10
        assert (distance.sum(), (turn != 0).sum(), (distance == 0).sum()) == (
            row.distance,
            row.turns,
            row.stops,
        )
        assert (episode.action == 0).sum() == row.full_stops
        headings = [90, *episode.heading.tolist()]
        places = [(400, 300), *zip(episode.x.tolist(), episode.y.tolist(), strict=True)]
        for index, (pixels, quotient) in enumerate(zip(distance, turn, strict=True)):
            assert (
                headings[index + 1]
                == (headings[index] + (quotient if quotient <= 5 else quotient - 10)) % 360
            )
            angle, (x, y) = math.radians(headings[index + 1]), places[index]
            ahead = (x + pixels * math.cos(angle), y + pixels * math.sin(angle))
            assert places[index + 1] == pytest.approx(ahead, abs=1e-3)
        assert (episode.clearance.iloc[:-1] > 30).all()
        assert (episode.clearance.iloc[-1] <= 30) == row.terminated
        collisions += row.terminated
    assert collisions >= 5


def test_rows_of_a_baseline_are_kept_where_a_report_looks_for_them(tmp_path):
    arguments = ["random", "--episodes", "5", "--max-steps", "50", "--out", str(tmp_path / "baselines")]
    assert fly_command(arguments) == 0
    rows = pd.read_parquet(tmp_path / "baselines" / "random-test-5-50.parquet")
    assert rows.layout.tolist() == [0, 1, 2, 3, 4]
    assert list(rows.columns) == list(EPISODE_COLUMNS)
    assert rows.attrs == {"layouts": "test", "episodes": 5, "max_steps": 50}


@pytest.mark.parametrize(
    ("words", "file"),
    [([], "random-moving"), (["--task", "goal"], "random-goal"), (["--task", "drone"], "random")],
    ids=["not given", "given", "the paper's"],
)
def test_a_scripted_policy_beside_a_run_flies_the_runs_task_unless_another_is_given(tmp_path, words, file):
    run, out = write_policies(tmp_path / "run", n_seeds=1, task="moving", reward="eq14"), tmp_path / "out"
    brief = ["--episodes", "2", "--max-steps", "5", "--quiet"]
    assert fly_command([str(run), "random", *brief, *words, "--out", str(out)]) == 0
    assert [path.name for path in out.iterdir()] == [f"{file}-test-2-5.parquet"]


@pytest.mark.parametrize(
    ("protocol", "file", "header"),
    [
        (("test", 200, 10_000), "rows", {}),
        (("test", 10, 500), "rows-test-10-500", {"episodes": 10, "max_steps": 500}),
        (("train", 200, 10_000), "rows-train-200-10000", {"layouts": "train"}),
        (("density-12/test", 200, 10_000), "rows-density-12-test-200-10000", {"layouts": "density-12/test"}),
        (("test", 200, 10_000, NO_FAULTS), "rows-test-200-10000-none", {"faults": "none"}),
        (
            ("test", 200, 10_000, Faults(noise=5, lost=0.05)),
            "rows-test-200-10000-noise=5,lost=0.05",
            {"faults": "noise=5,lost=0.05"},
        ),
        (("test", 200, 10_000, None, "moving"), "rows-moving-test-200-10000", {"task": "moving"}),
    ],
)
def test_each_protocol_has_a_file_of_its_own_whose_header_says_it(protocol, file, header):
    protocol = Protocol(*protocol)
    assert protocol.file("rows") == f"{file}.parquet"
    assert protocol.header() == {"layouts": "test", "episodes": 200, "max_steps": 10_000} | header


def test_rows_of_a_policy_of_stable_baselines3_are_kept_greedy_and_sampled(tmp_path, capsys):
    zipped, out = write_zip(tmp_path / "theirs.zip"), tmp_path / "baselines"
    words = [
        str(zipped),
        "random",
        "--activation",
        "relu",
        "--episodes",
        "5",
        "--max-steps",
        "50",
        "--out",
        str(out),
    ]
    assert fly_command(words) == 0
    assert sorted(path.name for path in out.iterdir()) == [
        "random-test-5-50.parquet",
        "theirs-greedy-test-5-50.parquet",
        "theirs-sampled-test-5-50.parquet",
    ]
    for mode in ("greedy", "sampled"):
        rows = read_table(out / f"theirs-{mode}-test-5-50.parquet", EPISODE_COLUMNS, "")
        policy = uavnav.load_policy(zipped, greedy=mode == "greedy", activation="relu")
        pd.testing.assert_frame_equal(rows, evaluate_policy(policy, episodes=5, max_steps=50))
    printed = capsys.readouterr().out
    for word in ("theirs on 5 test layouts", "greedy", "sampled", "theirs-sampled-test-5-50.parquet"):
        assert word in printed, word


@pytest.mark.usefixtures("warm")
def test_the_command_evaluates_a_run_and_a_baseline_prints_a_table_of_each_and_ends_with_0(run):
    command = [
        sys.executable,
        "-m",
        "uavnav",
        "evaluate",
        run.path,
        "reactive",
        "--episodes",
        "5",
        "--max-steps",
        "50",
    ]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    for words in (
        f"{run.algorithm} tanh on 5 test layouts",
        "reactive",
        "3 seeds",
        "1 seed",
        "greedy",
        "sampled",
    ):
        assert words in result.stdout, words
    assert result.stdout.count("reward per episode") == 2
    rows = Run(run.path).evaluation()
    assert rows.groupby(["mode", "seed"]).size().tolist() == [5] * 6
    assert run.behaviour_file().name == "behaviour-test-5-50.parquet"
    assert run.behaviour_file().is_file()


@pytest.mark.parametrize(
    "action",
    [
        lambda n: torch.full((n,), 150),
        lambda n: torch.full((n,), -1),
        lambda n: torch.zeros(n),
        lambda n: torch.zeros(n, 1, dtype=torch.int64),
        lambda n: [0.0] * n,
        lambda n: [[0], [1, 2]],
        lambda n: 3,
    ],
)
def test_a_policy_that_gives_no_actions_is_refused_in_one_line(action):
    with pytest.raises(
        ValueError, match=r"a policy chose .*; it must give whole numbers \[4\] from 0 to 99"
    ) as refused:
        evaluate_policy(lambda observation, generator: action(len(observation)), episodes=4, max_steps=5)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "policy",
    [
        lambda observation: np.full(len(observation), 9),
        lambda observation: [9] * len(observation),
        lambda observation, generator: torch.full((len(observation),), 9, dtype=torch.int32),
    ],
    ids=["an array of one argument", "a list of one argument", "a tensor of two"],
)
def test_a_function_of_one_or_two_arguments_may_give_an_array_a_list_or_a_tensor(policy):
    flown = {"episodes": 4, "max_steps": 30}
    assert evaluate_policy(policy, **flown).equals(evaluate_policy(straight_ahead, **flown))


# -- protocols -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    config = ppo.PPOConfig(n_envs=16, total_frames=64, frames_per_batch=64, hidden=[8], compile="off")
    return ppo.train(config, out=tmp_path_factory.mktemp("protocols") / "run", quiet=True)


def test_layout_files_of_one_name_and_other_obstacles_have_files_of_their_own(tmp_path):
    names = set()
    for folder, seed in (("a", 0), ("b", 0), ("c", 1)):
        path = tmp_path / folder / "own.safetensors"
        layouts.save(layouts.generate(3, 4, seed), path, seed=seed, split="train")
        names.add(Protocol(path, 3, 50).file("evaluation"))
    assert len(names) == 2
    assert all(re.fullmatch(r"evaluation-own-[0-9a-f]{8}-3-50\.parquet", name) for name in names)


def test_another_number_of_episodes_limit_or_split_goes_to_its_own_file_and_replaces_no_other(
    small, tmp_path, monkeypatch
):
    monkeypatch.setattr(Protocol.__new__, "__defaults__", ("test", 4, 9, None, "drone", None, False))
    run = Run(shutil.copytree(small.path, tmp_path / "run"))
    all_layouts = tmp_path / "own"
    layouts.save(layouts.generate(5, 4), all_layouts, seed=0, split="train")
    protocols = [
        ("test", 4, 9),
        ("test", 3, 9),
        ("test", 4, 8),
        ("train", 4, 9),
        ("validation", 4, 9),
        (all_layouts, 4, 9),
    ]
    written = {}
    for protocol in protocols:
        layouts_, episodes, limit = protocol
        rows = evaluate_run(run, episodes, limit, layouts_)
        path = run.path / Protocol(*protocol).file("evaluation")
        pd.testing.assert_frame_equal(pd.read_parquet(path), rows, check_exact=True)
        assert pd.read_parquet(path).attrs == {
            "layouts": str(layouts_),
            "episodes": episodes,
            "max_steps": limit,
        }
        there = contents(run.path)
        assert {name: there[name] for name in written} == written
        written = {name: there[name] for name in there if name.startswith(("evaluation", "behaviour"))}
    assert len(written) == 2 * len(protocols)
    assert Run(run.path).evaluation().attrs == {"layouts": "test", "episodes": 4, "max_steps": 9}


def test_rows_under_the_shield_with_faults_or_on_the_way_are_not_a_runs_evaluation(small, tmp_path):
    run = Run(shutil.copytree(small.path, tmp_path / "run"))
    for other in ({"shield": True}, {"faults": Faults(noise=5.0)}):
        rows = evaluate_run(run, 2, 5, **other)
    rows.attrs = Protocol("test", 2, 5, at=0.5).header()
    write_table(run.path / Protocol("test", 2, 5, at=0.5).file("evaluation"), rows)
    assert len(run.evaluations()) == 3
    assert run.evaluation() is None
    evaluate_run(run, 2, 5, faults=NO_FAULTS)  # as in training
    assert run.evaluation().attrs == {"layouts": "test", "episodes": 2, "max_steps": 5, "faults": "none"}
    assert run.behaviour_file() == run.path / "behaviour-test-2-5-none.parquet"


@pytest.mark.parametrize("task", TASK_NAMES)
def test_the_evaluation_that_is_read_first_is_the_one_that_a_run_has_by_default(task):
    assert usual(task) == Protocol("test", 200, TASKS[task].limit(10_000))


def test_an_evaluation_of_another_protocol_is_read_where_there_is_no_evaluation_parquet(small, tmp_path):
    run = Run(shutil.copytree(small.path, tmp_path / "run"))
    evaluate_run(run, episodes=2, max_steps=5)
    assert run.evaluation().attrs == {"layouts": "test", "episodes": 2, "max_steps": 5}
    assert run.behaviour_file() == run.path / "behaviour-test-2-5.parquet"


def test_the_command_says_in_which_file_the_rows_of_a_protocol_are(small, tmp_path, capsys):
    run = shutil.copytree(small.path, tmp_path / "run")
    assert fly_command([str(run), "--episodes", "3", "--max-steps", "5", "--layouts", "validation"]) == 0
    path = run / "evaluation-validation-3-5.parquet"
    assert f"the rows are in {path}\n" in capsys.readouterr().out
    assert len(pd.read_parquet(path)) == 2 * 3


# -- worlds --------------------------------------------------------------------------------------------------


def test_a_run_is_evaluated_in_the_world_and_with_the_reward_that_it_was_trained_in(tmp_path):
    config = ppo.PPOConfig(
        n_envs=16,
        total_frames=64,
        frames_per_batch=64,
        hidden=[8],
        compile="off",
        reward="additive",
        world={"sensor_arc": 90},
    )
    run = ppo.train(config, out=tmp_path / "run", quiet=True)
    rows = evaluate_run(run, episodes=6, max_steps=40)
    policy = uavnav.load_policy(run.path)
    assert policy.world == uavnav.World(sensor_arc=90)
    greedy = rows[rows["mode"] == "greedy"].drop(columns="mode").reset_index(drop=True)
    own = evaluate_policy(policy, episodes=6, max_steps=40)
    pd.testing.assert_frame_equal(greedy, own, check_exact=True)
    pd.testing.assert_frame_equal(
        own,
        evaluate_policy(
            policy, episodes=6, max_steps=40, world=uavnav.World(sensor_arc=90), reward="additive"
        ),
    )
    other = evaluate_policy(policy, episodes=6, max_steps=40, reward="initial")
    assert (other.reward >= own.reward).all()
    assert (other.reward > own.reward).any()  # no penalties


@pytest.mark.parametrize(
    ("trained_in", "evaluated_in", "beside"),
    [
        ({}, {}, True),
        ({}, {"layouts": "validation"}, True),
        ({"world": {"slots": "listed"}, "reward": "additive"}, {}, True),
        ({"world": {"sensor_arc": 90}}, {}, False),
        ({"reward": "mine"}, {}, False),
        ({"stack": 2}, {}, False),
        ({"layouts": "mine.safetensors"}, {}, False),
        ({"task": "moving"}, {}, False),
        ({"layouts": "slalom-100/train"}, {}, False),
        ({}, {"layouts": "density-12/test"}, False),
        ({"faults": {"noise": 5.0}}, {}, False),
        ({}, {"faults": "noise=5"}, False),
    ],
)
def test_the_papers_column_stands_beside_runs_and_episodes_of_its_place_alone(
    trained_in, evaluated_in, beside
):
    usual = {"activation": "tanh", "layouts": "train", "task": "drone", "reward": "eq14", "world": {}}
    run = types.SimpleNamespace(algorithm="ppo", config=usual | trained_in)
    assert (summary.of_paper(run, evaluated_in) == TABLES["ppo", "tanh"]) == beside
    assert bool(summary.of_paper(run, evaluated_in)) == beside


@pytest.mark.parametrize(
    ("words", "title"),
    [
        ([], "random on 3 test layouts"),
        (["--max-steps", "20"], "random on 3 test layouts, at most 20 steps"),
        (["--faults", "noise=5", "--shield"], "random on 3 test layouts, noise=5, shielded"),
        (["--task", "goal"], "random on 3 test layouts, task goal"),
    ],
)
def test_the_table_says_what_is_unusual_in_how_policies_were_evaluated(words, title, capsys):
    assert fly_command(["random", "--episodes", "3", *words]) == 0
    assert capsys.readouterr().out.splitlines()[0].strip() == title


def test_quiet_prints_nothing_and_json_an_entry_for_each_with_the_means_of_the_rows(run, capsys, tmp_path):
    words = ["random", str(run.path), "--episodes", "3", "--max-steps", "20"]
    assert fly_command([*words, "--quiet", "--out", str(tmp_path)]) == 0
    assert capsys.readouterr() == ("", "")
    assert fly_command([*words, "--json"]) == 0
    scripted, trained = json.loads(capsys.readouterr().out)
    assert (scripted["run"], scripted["seeds"], scripted["episodes"]) == ("random", [0], 3)
    rows = pd.read_parquet(tmp_path / "random-test-3-20.parquet")
    found = scripted["metrics"]["scripted"]["reward"]
    assert found == {"mean": pytest.approx(rows["reward"].mean()), "sd": None}
    assert (trained["run"], trained["seeds"]) == (str(run.path), run.seeds)
    assert list(trained["metrics"]) == ["greedy", "sampled"]
