"""What one meets first: what a run says, and no warnings."""

import importlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import uavnav
from uavnav.algorithms.c51 import C51Config
from uavnav.algorithms.dqn import DQNConfig
from uavnav.algorithms.ppo import PPOConfig
from uavnav.algorithms.sac import SACConfig
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

RATES = {("ppo", 1): 19_762, ("ppo", 10): 64_829, ("dqn", 1): 17_802, ("dqn", 10): 62_120}
"""Frames/s of all seeds together, compiled, when the estimate was made; a new measurement need not change
it.
"""


@pytest.mark.parametrize(("algorithm", "n_seeds"), RATES)
def test_the_estimate_gives_the_measured_rates_back(algorithm, n_seeds):
    config = {"ppo": PPOConfig, "dqn": DQNConfig}[algorithm](n_seeds=n_seeds)
    found = display.seconds(config, 1_000_000, processes=min(n_seeds, 2), compiled=True)
    assert found == pytest.approx(1_000_000 * n_seeds / RATES[algorithm, n_seeds], rel=0.01)


def test_estimate_of_fast_gives_eight_seconds_for_the_first_command_of_the_docs_and_the_rate_of_five_seeds():
    found = display.seconds(PPOConfig(preset="fast"), 200_000, processes=1, compiled=True)
    assert found == pytest.approx(8, rel=0.01)
    text = (PACKAGE.parent / "docs" / "archive" / "speed.md").read_text()
    assert re.search(r"200,000 frames of PPO\b[^.]*\b15 s\b", text)
    run = uavnav.Run(PACKAGE.parent / "results" / "algorithms" / "fast" / "ppo" / "tanh")
    rate = run.frames / run.meta["wall_seconds"]
    found = display.seconds(PPOConfig(preset="fast", n_seeds=5), run.frames, processes=2, compiled=True)
    assert found == pytest.approx(run.frames / rate, rel=0.2)


def test_a_run_whose_rate_is_not_known_says_after_five_seconds_of_learning_how_long_it_still_takes(
    monkeypatch, capsys
):
    clock = [0.0]
    monkeypatch.setattr(display.time, "monotonic", lambda: clock[0])
    config = DQNConfig(n_envs=32, learning_starts=1000, total_frames=80_000)
    with display.Display(config, quiet=False) as shown:
        shown.begin(Path("run"), {"compiled": False, "threads": 1})
        for clock[0], frames in [(0.0, 500), (9.0, 1000), (13.0, 3000), (14.0, 6000), (20.0, 9000)]:
            shown.update(frames, [0.0])
    lines = [line for line in capsys.readouterr().out.splitlines() if "at this rate" in line]
    # 1,000 frames/s from frame 1,000 on, and 74,000 are left
    assert lines == ["about 70 s more at this rate"]


@pytest.mark.parametrize(
    "given", [{"epochs": 3}, {"n_envs": 32}, {"hidden": (256, 256)}, {"preset": "fast", "lr": 1}]
)
def test_there_is_no_estimate_of_what_was_not_measured(given, tmp_path):
    config = PPOConfig(**given)
    assert display.seconds(config, 1_000_000, processes=1, compiled=True) is None
    _, how = display.opening(config, 1_000_000, tmp_path, {"compiled": True, "threads": 1})
    assert how.endswith("1 process of 1 thread: the bar tells how long")


def test_a_run_says_what_it_does_how_and_about_how_long():
    facts = {"compiled": True, "processes": 2, "threads": 1}
    what, how = display.opening(PPOConfig(n_seeds=10, seed=5), 1_001_472, Path("runs/ppo/tanh"), facts)
    assert what == (
        "ppo tanh, preset vectorised: 10 seeds (5 to 14), 1,001,472 frames each in 16 parallel environments,"
        " into runs/ppo/tanh"
    )
    assert how == (
        "compiled (takes 3 s, or 15 to 30 s the first time), 2 processes of 1 thread: about 3 min on the "
        "two cores of"
        " docs/benchmarks.md"
    )


@pytest.mark.parametrize(
    ("kind", "given", "before"),
    [
        (DQNConfig, {}, 50_000),
        (SACConfig, {}, 20_000),
        (DQNConfig, {"learning_starts": 0, "n_steps": 5}, 320),
        (C51Config, {"preset": "paper"}, 50_000),
    ],
)
def test_a_run_that_ends_before_its_first_update_says_so(kind, given, before, tmp_path):
    facts, beyond = {"compiled": True, "threads": 1}, before + kind(**given).n_envs
    for total, words in (
        (before - 65, f", too few to learn (updates begin after {before:,}), into"),
        (beyond, ""),
    ):
        what, _ = display.opening(kind(**given, total_frames=total), 10, tmp_path, facts)
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
            "ppo tanh, preset vectorised: 2 seeds (0 to 1), 512 frames each in 4 parallel environments, into "
            + str(tmp_path / "run")
        )
        assert second.startswith(
            f"not compiled, {processes} process{'es' if processes > 1 else ''} of 1 thread: "
        )


# -- no warnings ---------------------------------------------------------------------------------------------


ONE_BY_ONE = """
import json, sys
sys.path.append(sys.argv[1])
from warm import execute
for words in json.loads(sys.argv[2]):
    for module in [*sys.modules.values()]:
        if isinstance(told := getattr(module, "__warningregistry__", None), dict):
            told.clear()  # what one command has warned of may not hide another's
    if words[2:3] == ["play"]:  # the first event closes the window
        import pygame
        from uavnav.cli import commands, play
        show = play.show
        play.show = lambda game: (show(game), pygame.event.post(pygame.event.Event(pygame.QUIT)))
        assert commands.run("play", words[3:]) == 0
        continue
    try:
        execute(*words)
    except SystemExit as end:
        assert not end.code, words
"""


@pytest.mark.slow
def test_no_command_lets_a_dependency_talk(tmp_path):
    short = ["compile=off", "total_frames=4096", "evaluate=false"]
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
        ["render", "runs/ppo", "reactive", "--steps", 20, "--out", "flight.gif"],
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
        commands.append(["render", "runs/ppo", "--steps", 20, "--out", "flight.mp4"])
    if importlib.util.find_spec("pygame"):
        commands.append(["play", "runs/ppo"])
    words = [
        [str(word) for word in command]
        for command in [*recipes, *(["-m", "uavnav", *command] for command in commands)]
    ]
    screen = {"SDL_VIDEODRIVER": "dummy", "MPLBACKEND": "agg"}
    result = python("-c", ONE_BY_ONE, Path(__file__).parent, json.dumps(words), cwd=tmp_path, **screen)
    assert (result.returncode, result.stderr) == (0, "")
    assert "Warning" not in result.stdout
