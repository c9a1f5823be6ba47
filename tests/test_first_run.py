"""What one meets first: what a run says, and no warnings."""

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import uavnav
from uavnav.algorithms.c51 import C51Config
from uavnav.algorithms.dqn import DQNConfig
from uavnav.algorithms.ppo import PPOConfig
from uavnav.algorithms.sac import SACConfig
from uavnav.runs.lately import NOTHING
from uavnav.training import display

PACKAGE = Path(uavnav.__file__).parent
RECIPES = PACKAGE.parent / "recipes"


def python(*words, cwd, **environment):
    return subprocess.run(
        [sys.executable, *map(str, words)],
        cwd=cwd,
        env={**os.environ, "COLUMNS": "100", **environment},
        capture_output=True,
        text=True,
        check=False,
    )


# -- what a run says -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("quiet", [False, True])
def test_where_no_terminal_shows_a_run_it_says_after_five_seconds_of_learning_how_long_it_still_takes(
    quiet, monkeypatch, capsys
):
    clock = [0.0]
    monkeypatch.setattr(display.time, "monotonic", lambda: clock[0])
    config = DQNConfig(n_envs=32, learning_starts=1000, total_frames=80_000)
    with display.Display(config, quiet) as shown:
        meta = {"compiled": False, "threads": 1}
        shown.begin(SimpleNamespace(path=Path("run"), meta=meta, until=None), 0)
        for clock[0], frames in [(0.0, 500), (9.0, 1000), (13.0, 3000), (14.0, 6000), (20.0, 9000)]:
            shown.update(frames, NOTHING)
    lines = [line for line in capsys.readouterr().out.splitlines() if "at this rate" in line]
    # 1,000 frames/s from frame 1,000 on, and 74,000 are left
    assert lines == ([] if quiet else ["about 74 s more at this rate"])


def test_the_pace_of_resumed_workers_counts_from_their_first_word(monkeypatch, capsys):
    clock = [0.0]
    monkeypatch.setattr(display.time, "monotonic", lambda: clock[0])
    with display.Display(PPOConfig(n_seeds=2, total_frames=1_000_000), False) as shown:
        meta = {"compiled": False, "threads": 1}
        shown.begin(SimpleNamespace(path=Path("run"), meta=meta, until=None), 500_000)
        for clock[0], frames in [(0.0, 0), (1.0, 500_000), (7.0, 560_000)]:
            shown.update(frames, NOTHING)
    assert "about 44 s more at this rate" in capsys.readouterr().out  # 10,000 frames/s


def test_a_run_says_what_it_does_how_and_from_where_it_goes_on():
    facts = {"compiled": True, "processes": 2, "threads": 1}
    config = PPOConfig(n_seeds=10, seed=5)
    assert [*display.opening(config, 1_001_472, Path("runs/ppo-paper/tanh"), facts, 81_920)] == [
        "ppo tanh, preset paper: 10 seeds (5 to 14), 1,001,472 frames each in 1 parallel environment,"
        " into runs/ppo-paper/tanh",
        "2 processes of 1 thread, compiled, which takes a while the first time",
        "resumed at 81,920 of 1,001,472",
    ]
    assert len([*display.opening(config, 1_001_472, Path("run"), facts, 0)]) == 2


@pytest.mark.parametrize(
    ("kind", "given", "before"),
    [
        (DQNConfig, {}, 50_000),
        (SACConfig, {}, 20_000),
        (DQNConfig, {"learning_starts": 0, "n_steps": 5, "n_envs": 64}, 320),
        (C51Config, {"preset": "vectorised"}, 50_000),
    ],
)
def test_a_run_that_ends_before_its_first_update_says_so(kind, given, before, tmp_path):
    facts, beyond = {"compiled": True, "threads": 1}, before + kind(**given).n_envs
    for total, words in (
        (before - 65, f", too few to learn (updates begin after {before:,}), into"),
        (beyond, ""),
    ):
        what, _ = display.opening(kind(**given, total_frames=total), 10, tmp_path, facts, 0)
        assert words in what
        assert ("too few" in what) == bool(words)


@pytest.mark.usefixtures("warm")
@pytest.mark.parametrize("processes", [1, 2])
@pytest.mark.parametrize("quiet", [False, True])
def test_training_opens_with_these_lines_unless_it_is_quiet(processes, quiet, tmp_path, capfd):
    config = PPOConfig(n_seeds=2, total_frames=512, n_envs=4, frames_per_batch=512, epochs=1, compile="off")
    uavnav.ppo.train(config, out=tmp_path / "run", quiet=quiet, processes=processes)
    out, err = capfd.readouterr()
    assert err == ""
    if quiet:
        assert out == ""
    else:
        first, second = out.splitlines()[:2]
        assert first == (
            "ppo tanh, preset paper: 2 seeds (0 to 1), 512 frames each in 4 parallel environments, into "
            + str(tmp_path / "run")
        )
        assert second == f"{processes} process{'es' if processes > 1 else ''} of 1 thread, not compiled"


# -- no warnings ---------------------------------------------------------------------------------------------


ONE_BY_ONE = """
import json, sys
sys.path.append(sys.argv[1])
from warm import execute
for words in json.loads(sys.argv[2]):
    for module in [*sys.modules.values()]:
        if isinstance(told := getattr(module, "__warningregistry__", None), dict):
            told.clear()  # what one command has warned of may not hide another's
    try:
        execute(*words)
    except SystemExit as end:
        assert not end.code, words
"""


@pytest.mark.slow
def test_no_command_lets_a_dependency_talk(tmp_path):
    short = ["preset=vectorised", "compile=off", "total_frames=4096", "evaluate=false"]
    small = ["--episodes", 5, "--max-steps", 50]
    recipes = [
        [RECIPES / "ppo.py", *short, "epochs=2", "out=runs/ppo"],
        [
            RECIPES / "dqn.py",
            *short,
            "learning_starts=2000",
            "frames_per_update=16",
            "n_seeds=2",
            "out=runs/dqn",
        ],
    ]
    commands = [
        ["evaluate", "runs/ppo", "random", *small],
        ["render", "runs/ppo", "reactive", "--steps", 20, "--out", "episode.gif"],
        ["verify", "runs/ppo", "--frames", 2048],
        ["export", "runs/ppo", "--out", "policy.pt2"],
        ["layouts", "--n", 5],
        ["report", "runs"],
        ["--help"],
        ["runs"],
    ]
    if importlib.util.find_spec("onnxscript"):
        commands.append(["export", "runs/ppo", "--out", "policy.onnx"])
    if importlib.util.find_spec("av"):
        commands.append(["render", "runs/ppo", "--steps", 20, "--out", "episode.mp4"])
    commands.append(["play", "runs/ppo"])
    words = [
        [str(word) for word in command]
        for command in [*recipes, *(["-m", "uavnav", *command] for command in commands)]
    ]
    screen = {"BROWSER": "true %s", "MPLBACKEND": "agg"}
    result = python("-c", ONE_BY_ONE, Path(__file__).parent, json.dumps(words), cwd=tmp_path, **screen)
    assert (result.returncode, result.stderr) == (0, "")
    assert "Warning" not in result.stdout
