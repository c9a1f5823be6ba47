"""`uavnav train` and the recipes: they train, say where the run is, and answer a wrong word before any
work.
"""

import json
import shlex
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
import yaml

from uavnav import evaluation
from uavnav.__main__ import main
from uavnav.algorithms.a2c import A2CConfig
from uavnav.algorithms.ppo import PPOConfig
from uavnav.cli import commands
from uavnav.evaluation import evaluate_policy, scripted, summary
from uavnav.runs import Run
from uavnav.runs.evaluations import usual
from uavnav.runs.metrics import per_seed
from uavnav.runs.tables import RunError
from uavnav.tasks.baselines import BASELINES
from uavnav.tasks.table import make_task
from uavnav.training.loop import train
from uavnav.training.recorder import Recorder

RECIPES = Path(__file__).parent.parent / "recipes"
RESULTS = RECIPES.parent / "results"
SMALL_BATCHES = ["frames_per_batch=64", "minibatch_size=64", "compile=off"]
SHORT = {
    "ppo": ["total_frames=512", "frames_per_batch=256", "epochs=1", "anneal_lr=true", "evaluate=false"],
    "dqn": ["total_frames=512", "learning_starts=250", "anneal_lr=true", "evaluate=false"],
    "a2c": ["total_frames=500", "evaluate=false"],
    "sac": ["total_frames=512", "learning_starts=400", "evaluate=false"],
    "c51": ["total_frames=512", "learning_starts=400", "evaluate=false"],
    "pqn": ["total_frames=512", "frames_per_batch=256", "epochs=1", "evaluate=false"],
}


@pytest.fixture
def recipe(tmp_path, monkeypatch, capfd):
    """Runs `uavnav train` in an empty folder, in this process: (status, what it printed, what it
    complained).
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")

    def run(name, *arguments):
        try:
            status = main(["train", name, *arguments])
        except SystemExit as stop:
            status = stop.code
        return (status, *capfd.readouterr())

    return run


def process(folder, name, *arguments):
    """A recipe as a process of its own."""
    command = [sys.executable, RECIPES / f"{name}.py", *arguments]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    return result.returncode, result.stdout, result.stderr


@pytest.mark.parametrize("algorithm", list(SHORT))
def test_a_short_run_prints_its_table_beside_the_papers_and_where_it_is(recipe, tmp_path, algorithm):
    status, out, err = recipe(algorithm, "activation=relu", "n_seeds=2", *SHORT[algorithm])
    assert (status, err) == (0, "")
    (folder,) = (tmp_path / "runs" / f"{algorithm}-paper").iterdir()
    assert folder.name.startswith("relu-")
    run = Run(folder)
    assert run.config["n_seeds"] == 2
    assert str(folder.relative_to(tmp_path)) in out
    for words in (
        "steps",
        "full stops [%]",
        "turning [%]",
        "distance [px]",
        "speed [px a step]",
        "reward",
        "per frame",
        "log curve",
        "all training",
        "1 parallel environment",
        "2 seeds",
    ):
        assert words in out, words
    # its steps (1730.587, 205.576), or none
    of_the_paper = {"ppo": "1,730.6", "dqn": "205.6"}.get(algorithm, "")
    assert of_the_paper in out
    assert ("paper ┃" in out) == bool(of_the_paper)
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


def test_a_finished_run_says_so_in_one_line_and_exits_0(recipe):
    recipe("ppo", "out=mine", *SHORT["ppo"])
    status, out, err = recipe("ppo", "out=mine", *SHORT["ppo"])
    assert status == 0
    assert err == ""
    assert out == "mine: this run is already finished; overwrite=true starts it anew\n"


@pytest.mark.slow
def test_after_training_it_says_what_to_do_next_in_commands_that_run_as_they_stand(
    recipe, tmp_path, monkeypatch
):
    evaluate = evaluation.evaluate_run
    monkeypatch.setattr(evaluation, "evaluate_run", lambda run, **how: evaluate(run, 2, 20, **how))
    _, out, _ = recipe("a2c", "out=runs/my own", *SHORT["a2c"])
    last = out.splitlines()[-3:]
    assert last[:2] == [
        "watch it:     uavnav play 'runs/my own'",
        "compare it:   uavnav compare 'runs/my own' reactive",
    ]
    watch, beside, longer = [shlex.split(line.partition(":")[2])[1:] for line in last]
    commands.parse(*watch[:1], watch[1:])
    assert main(beside) == 0
    assert main([*longer, "evaluate=false"]) == 0
    run = Run(tmp_path / "runs" / "my own")
    config = {"total_frames": 2 * run.config["total_frames"]}
    assert Run(tmp_path / longer[-1].removeprefix("out=")).config == run.config | config


def test_the_end_is_a_sentence_beside_the_scripted_policy_where_that_flies_the_same():
    rows = pd.DataFrame(
        {"mode": ["sampled"] * 4 + ["greedy"], "truncated": [True] * 3 + [False] * 2, "reward": [312.4] * 5}
    )
    rows.attrs["max_steps"] = 10_000
    words = "sampled, 75% of episodes reach the limit of 10,000 steps; reward 312"
    assert summary.verdict(rows, PPOConfig()) == f"{words}, the scripted policy 428"
    assert summary.verdict(rows, PPOConfig(reward="initial")) == words
    goal = rows.assign(succeeded=[1, 1, 1, 1, 0])
    assert summary.verdict(goal, PPOConfig(task="goal")).startswith(
        "sampled, 100% of episodes reach the goal; "
    )


def test_what_the_scripted_policy_earns_is_the_mean_of_its_committed_rows():
    for task, folder in (("drone", "."), ("goal", "worlds")):
        rows = pd.read_parquet(
            RESULTS / folder / "baselines" / usual(task)._replace(task=task).file("reactive")
        )
        assert scripted.REWARDS[task] == round(rows["reward"].mean(), 2)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["moving", "space", "space-moving"])
def test_in_other_tasks_it_is_that_of_rows_of_2000_steps_and_of_whoever_is_still_open_after_them(task):
    rows = pd.read_parquet(RESULTS / f"worlds/baselines/reactive-{task}-test-200-2000.parquet")
    up = rows.loc[rows["truncated"], "layout"].tolist()
    whole = evaluate_policy(
        BASELINES["reactive"], make_task("test", task=task).layouts[up], len(up), task=task
    )
    earned = rows.loc[rows["terminated"], "reward"].sum() + whole["reward"].sum()
    assert scripted.REWARDS[task] == pytest.approx(earned / len(rows), abs=0.005)


def test_quiet_prints_nothing_and_json_the_numbers_of_the_tables_and_nothing_else(recipe, tmp_path):
    words = ["n_seeds=2", "activation=relu,tanh", "out='${activation}'", *SHORT["a2c"]]
    assert recipe("a2c", "-m", "--quiet", *words) == (0, "", "")
    status, out, err = recipe("a2c", "--json", "-m", *words)
    assert (status, err) == (0, "")
    found = json.loads(out)
    assert [(one["run"], one["activation"], one["seeds"]) for one in found] == [
        ("relu", "relu", [0, 1]),
        ("tanh", "tanh", [0, 1]),
    ]
    for one in found:
        rewards = per_seed(Run(tmp_path / one["run"]).episodes)["reward"]
        expected = {"mean": pytest.approx(rewards.mean()), "sd": pytest.approx(rewards.std())}
        assert one["metrics"]["all training episodes"]["reward"] == expected
        assert list(one["metrics"]) == ["per frame", "log curve", "all training episodes"]


def test_a_sweep_trains_each_activation_into_its_own_folder(recipe, tmp_path):
    status, _, err = recipe("ppo", "-m", "activation=relu,tanh", "seed=3", *SHORT["ppo"])
    assert (status, err) == (0, "")
    for activation in ("relu", "tanh"):
        (folder,) = (tmp_path / "runs" / "ppo-paper").glob(f"{activation}-*")
        run = Run(folder)
        assert run.config["activation"] == activation
        assert set(run.episodes.seed) == {3}
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


@pytest.mark.usefixtures("warm")
@pytest.mark.parametrize("algorithm", ["ppo", "dqn", "a2c"])
def test_a_recipe_is_uavnav_train_bit_for_bit(recipe, tmp_path, algorithm):
    """PPO's and DQN's write the training out; A2C's calls the command."""
    short = [*SHORT[algorithm], "n_seeds=2", "world.sensor_arc=90", "compile=off"]
    assert recipe(algorithm, "out=one", *short)[0] == 0
    assert process(tmp_path, algorithm, "out=other", *short)[0] == 0
    one, other = (Run(tmp_path / name) for name in ("one", "other"))
    assert one.config == other.config
    assert one.config["world"]["sensor_arc"] == 90.0
    for name in ("episodes.parquet", "policy.safetensors"):
        assert (one.path / name).read_bytes() == (other.path / name).read_bytes()
    rows = (run.progress.drop(columns="frames_per_second") for run in (one, other))
    pd.testing.assert_frame_equal(*rows, check_exact=True)


def test_the_recipes_of_later_algorithms_are_a2cs_but_for_the_name():
    first, *others = (
        (RECIPES / f"{name}.py").read_text().rpartition('"""')[2].replace(f'"{name}"', "NAME")
        for name in SHORT
        if name not in ("ppo", "dqn")
    )
    assert {*others} == {first}


def test_a_recipe_does_not_go_on_with_a_run_of_several_processes(tmp_path, monkeypatch):
    monkeypatch.setattr(Recorder, "processes", lambda recorder, number: 2)
    with pytest.raises(RunError, match=r"began in 2 processes; uavnav train a2c goes on with it"):
        train(A2CConfig(total_frames=160), tmp_path / "run", fit=lambda recorder, quiet, tell: None)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "words",
    ["--cfg job preset=vectorised-2.3 activation=relu", "preset=vectorised-2.3 -c job activation=relu"],
)
def test_cfg_job_shows_every_setting_and_trains_nothing(recipe, tmp_path, words):
    status, out, _ = recipe("dqn", *words.split())
    assert status == 0
    shown = yaml.safe_load(out)
    assert shown["learning_starts"] == 100
    assert shown["preset"] == "vectorised-2.3"
    assert shown["activation"] == "relu"
    assert shown["total_frames"] == 1_000_000
    assert not list(tmp_path.iterdir())


def test_as_a_process_a_short_run_leaves_its_folder_and_no_warning(tmp_path):
    """Without the fixture `warm`: a process that imports everything itself."""
    status, out, err = process(tmp_path, "ppo", "activation=tanh", "out=mine", *SHORT["ppo"])
    assert (status, err) == (0, "")
    assert "the run is in mine" in out
    assert "arn" not in out.replace("learn", "")


def test_in_the_folder_that_one_stands_in_a_run_ends_with_what_to_do_next(recipe):
    status, out, err = recipe("a2c", "out=.", *SHORT["a2c"])
    assert (status, err) == (0, "")
    assert "uavnav compare . reactive" in out


def test_a_run_that_diverges_says_so_though_nothing_is_evaluated(recipe, tmp_path):
    words = ["lr=1e38", "max_grad_norm=null", "out=run", "evaluate=false", "total_frames=128", "epochs=2"]
    for _ in range(2):
        status, _, err = recipe("ppo", "--quiet", *words, *SMALL_BATCHES)
        assert (status, err.count("\n")) == (2, 1)
        assert "is not finite, it diverged" in err


def test_of_a_sweep_the_configurations_beside_one_that_diverges_are_trained_and_evaluated(
    recipe, tmp_path, monkeypatch
):
    evaluate = evaluation.evaluate_run
    monkeypatch.setattr("uavnav.cli.train.evaluate_run", lambda run, **how: evaluate(run, 2, 20, **how))
    sizes = ["total_frames=128", "epochs=2", *SMALL_BATCHES]
    for _ in range(2):
        status, _, err = recipe(
            "ppo", "-m", "--quiet", "lr=1e38,1e-3", "max_grad_norm=null", "out=runs/${lr}", *sizes
        )
        assert status == 2
        assert err.count("\n") == 1
        assert "is not finite, it diverged" in err
    assert (Run(tmp_path / "runs" / "0.001").path / "evaluation-test-2-20.parquet").exists()
