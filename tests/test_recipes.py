"""The recipes' command lines: they train, say where the run is, and answer a wrong word before any work."""

import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from uavnav.runs import Run

RECIPES = Path(__file__).parent.parent / "recipes"
SHORT = {
    "ppo": ["total_frames=1e3", "frames_per_batch=512", "epochs=1", "evaluate=false"],
    "dqn": ["total_frames=1e3", "learning_starts=500", "evaluate=false"],
}


@pytest.fixture
def recipe(tmp_path, monkeypatch, capfd):
    """Runs a recipe in an empty folder, in this process: (status, what it printed, what it complained)."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(RECIPES))
    monkeypatch.setenv("COLUMNS", "100")

    def run(algorithm, *arguments):
        from launch import launch

        import uavnav

        module = getattr(uavnav, algorithm)
        monkeypatch.setattr(sys, "argv", [f"recipes/{algorithm}.py", *arguments])
        status = 0
        try:
            launch(module.ALGORITHM, module.PRESETS, module.train)
        except SystemExit as stop:
            status = stop.code
        out, err = capfd.readouterr()
        return (1, out, err + status + "\n") if isinstance(status, str) else (status, out, err)

    return run


@pytest.mark.parametrize("algorithm", ["ppo", "dqn"])
def test_a_short_run_prints_its_table_beside_the_papers_and_where_it_is(recipe, tmp_path, algorithm):
    status, out, err = recipe(algorithm, "activation=relu", "n_seeds=2", *SHORT[algorithm])
    assert (status, err) == (0, "")
    run = Run(tmp_path / "runs" / algorithm / "relu")
    assert run.config["n_seeds"] == 2
    assert f"runs/{algorithm}/relu" in out
    for words in (
        "steps per episode",
        "full stops [%]",
        "turning [%]",
        "distance per episode [px]",
        "speed [px a step]",
        "reward per episode",
        "all episodes",
        "last 100",
        "paper",
        "ratio of means",
        {"ppo": "16 parallel worlds", "dqn": "64 parallel worlds"}[algorithm],
        "2 seeds",
    ):
        assert words in out, words
    assert {"ppo": "1,730.6", "dqn": "205.6"}[algorithm] in out  # the paper's steps (1730.587, 205.576)
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]  # Hydra writes nothing of its own


def test_a_finished_run_says_so_in_one_line_and_exits_0(recipe):
    recipe("ppo", "out=mine", *SHORT["ppo"])
    status, out, err = recipe("ppo", "out=mine", *SHORT["ppo"])
    assert status == 0
    assert err == ""
    assert out == "mine: this run is already finished; overwrite=true starts it anew\n"


def test_a_sweep_trains_each_activation_into_its_own_folder(recipe, tmp_path):
    status, _, err = recipe("ppo", "-m", "activation=relu,tanh", "seed=3", *SHORT["ppo"])
    assert (status, err) == (0, "")
    for activation in ("relu", "tanh"):
        run = Run(tmp_path / "runs" / "ppo" / activation)
        assert run.config["activation"] == activation
        assert set(run.episodes.seed) == {3}
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


@pytest.mark.parametrize(
    "words", ["--cfg job preset=paper-2.3 activation=relu", "preset=paper-2.3 -c job activation=relu"]
)
def test_cfg_job_shows_every_setting_and_trains_nothing(recipe, tmp_path, words):
    status, out, _ = recipe("dqn", *words.split())
    assert status == 0
    shown = yaml.safe_load(out)
    assert shown["learning_starts"] == 100
    assert shown["preset"] == "paper-2.3"
    assert shown["activation"] == "relu"
    assert shown["total_frames"] == 1_000_000
    assert not list(tmp_path.iterdir())


WRONG = {
    "activation=rleu": "ppo: activation=rleu; choose from elu, .* (did you mean relu?)",
    "activatoin=relu": "ppo: there is no key 'activatoin'; choose from activation, .*out.* (did you mean activation?)",
    "+speed=3": "ppo: there is no key 'speed'; choose from ",
    "preset=papr": "ppo: preset=papr; choose from fast, paper (did you mean paper?)",
    "total_frames=1.5": "ppo: total_frames=1.5; give a whole number",
    "n_seeds=two": "ppo: n_seeds=two; give a whole number",
    "n_seeds=0": "ppo: n_seeds=0; give a number of at least 1",
    "overwrite=2": "ppo: overwrite=2; choose from false, true",
    "layouts=nowhere": "ppo: layouts='nowhere': no such bank; choose from train, test or a file's path",
    "out=/proc/nowhere": "ppo: out=/proc/nowhere: ",
    "device=gpu": "ppo: device=gpu; choose cpu, or a device that this machine has",
    "relu": "ppo: 'relu' is no setting; settings are key=value: activation=tanh",
    "=3": "ppo: '=3' is no setting; ",
    "hidden=[64": "ppo: hidden=[64: its value cannot be read; in a shell quote brackets and blanks: 'hidden=[64,64]'",
    "--activation tanh": "ppo: there is no flag --activation; settings are key=value: activation=tanh",
    "--n-seeds=4": "ppo: there is no flag --n-seeds; settings are key=value: n_seeds=4",
    "--helpp": "ppo: there is no flag --helpp (did you mean --help?); settings are key=value: activation=tanh",
    "--cfg everything": "ppo: argument --cfg/-c: invalid choice: 'everything' (choose from 'job', .*; --help says more",
    "--run -m": "ppo: Only one of --run, --multirun, --cfg, ",
    "-m activation=tanh,rleu": "ppo: activation=rleu; choose from ",
    "-m activation=tanh,relu out=one": "ppo: out=one: two runs of the sweep would share it",
    "activation=tanh,relu -m out=one": "ppo: out=one: two runs of the sweep would share it",
    "-m hydra/launcher=nowhere": "ppo: hydra/launcher=nowhere: not installed; ray, .*pip install 'uavnav[scale]'",
}


@pytest.mark.parametrize("words", WRONG)
def test_a_wrong_word_is_one_line_a_status_and_no_folder(recipe, tmp_path, words):
    status, out, err = recipe("ppo", *words.split(), "total_frames=1e3" if "total_frames" not in words else "seed=0")
    assert status == 1
    assert out == ""
    assert err.count("\n") == 1
    for part in WRONG[words].split(".*"):
        assert part in err
    assert not list(tmp_path.iterdir())


def test_as_a_process_a_wrong_word_ends_with_status_1_and_no_traceback(tmp_path):
    result = subprocess.run(
        [sys.executable, RECIPES / "dqn.py", "activation=rleu"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 1
    assert result.stdout == ""
    assert result.stderr.startswith("dqn: activation=rleu; choose from ")
    assert result.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_as_a_process_a_short_run_leaves_its_folder_and_no_warning(tmp_path):
    command = [sys.executable, RECIPES / "ppo.py", "activation=tanh", "out=mine", *SHORT["ppo"]]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    assert "the run is in mine" in result.stdout
    assert "arn" not in result.stdout.replace("learn", "")
