"""The command line: the table of commands, help without torch, and one place for every fact that help
tells.
"""

import dataclasses
import importlib
import os
import re
import shlex
import signal
import sys
import tomllib
from pathlib import Path

import pytest
from pages import ALL, CONFIGS, table

import uavnav
from uavnav import settings
from uavnav.__main__ import ALLOCATOR, TRAINS, main
from uavnav.algorithms import ALGORITHMS
from uavnav.cli import commands, help, terminal
from uavnav.cli.help.render import render
from uavnav.cli.train import Command
from uavnav.errors import Parser
from uavnav.runs import LOG_FOLDERS
from uavnav.tasks.world import World
from uavnav.training.recorder import Interrupted

PACKAGE = Path(uavnav.__file__).parent
PAGE = ALL["docs/commands.md"]


def told(words, capsys):
    """What a command prints that ends well: its help, or what it was asked."""
    try:
        status = main(shlex.split(words))
    except SystemExit as stop:
        status = stop.code
    out, err = capsys.readouterr()
    assert (status, err) == (0, "")
    return out


# -- the table -----------------------------------------------------------------------------------------------


def test_the_table_holds_each_module_that_is_a_command_and_each_is_of_one_kind():
    with_main = [path for path in PACKAGE.rglob("*.py") if "\ndef main(" in path.read_text()]
    there = {".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in with_main}
    others = {
        "uavnav.__main__",
        "uavnav.report.docs",
        "uavnav.bench.jobs",
        "uavnav.evaluation.choose",
        "uavnav.cli.episodes",
        "uavnav.cli.worker",
    }
    assert {f"uavnav.cli.{name}" for name in commands.COMMANDS} == there - others
    for name in commands.COMMANDS:
        assert callable(importlib.import_module(f"uavnav.cli.{name}").main)


@pytest.mark.parametrize("words", ["", "--help", "-h"])
def test_uavnav_alone_shows_every_command_with_its_line_and_an_example_of_each_kind(words, capsys):
    lines = told(words, capsys).splitlines()
    width = max(map(len, commands.COMMANDS))
    assert lines[0].startswith(f"uavnav {uavnav.__version__}: ")
    for name, one in commands.COMMANDS.items():
        assert f"  {name:{width}}  {one.what}" in lines
    for kind, (example, _) in commands.KINDS.items():
        assert {f"{kind}:", example} <= {line.strip() for line in lines}
    assert max(map(len, lines)) <= 120


def test_the_version_is_that_of_the_package(capsys):
    assert told("--version", capsys) == f"{uavnav.__version__}\n"


def test_the_wheel_has_the_command_and_what_it_reads():
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())
    assert project["project"]["scripts"] == {"uavnav": "uavnav.__main__:main"}
    data = project["tool"]["setuptools"]["package-data"]["uavnav.cli.help"]
    assert set(map(help.text_of, ALGORITHMS)) <= {path for one in data for path in help.HERE.glob(one)}
    folders = {path.parent.relative_to(PACKAGE.parent).as_posix() for path in PACKAGE.rglob("*.py")}
    assert {name.replace(".", "/") for name in project["tool"]["setuptools"]["packages"]} == folders


@pytest.mark.parametrize(
    ("started", "platform", "allocator", "begins_again"),
    [
        ("python -m uavnav train ppo --cfg job", "linux", None, True),
        ("python -m uavnav train ppo --cfg job", "linux", "of the user's", False),
        ("python -m uavnav train ppo --cfg job", "darwin", None, False),
        ("python flights.py --fast", "linux", None, False),
        ("python -m uavnav --version", "linux", None, False),
    ],
)
def test_training_begins_its_process_again_with_an_allocator_that_keeps_more_blocks(
    started, platform, allocator, begins_again, monkeypatch, capsys
):
    assert {*TRAINS} < {*commands.COMMANDS}
    words = started.split()
    monkeypatch.setattr(sys, "orig_argv", words)
    monkeypatch.setattr(sys, "argv", ["uavnav", *(words[3:] or ["train", "ppo", "--cfg", "job"])])
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setenv("GLIBC_TUNABLES", allocator or "")
    if allocator is None:
        monkeypatch.delenv("GLIBC_TUNABLES")
    calls = []
    monkeypatch.setattr(os, "execv", lambda path, argv: calls.append((path, argv)))
    main()
    assert calls == ([(sys.executable, [sys.executable, *words[1:]])] if begins_again else [])
    assert os.environ.get("GLIBC_TUNABLES") == (ALLOCATOR if begins_again else allocator)
    assert f"`GLIBC_TUNABLES={ALLOCATOR}`" in ALL["docs/troubleshooting.md"]


@pytest.mark.parametrize("words", [["evalute"], ["evalute", "runs/ppo/tanh"]])
def test_an_unknown_command_is_one_line_with_the_nearest_and_status_2(words, capsys):
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    nearest = "uavnav: there is no command 'evalute'; did you mean evaluate? choose from bench, compare, "
    assert err.startswith(nearest)
    assert err.count("\n") == 1


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_name_of_an_algorithm_is_answered_with_the_command_that_trains_it(name, capsys):
    assert main([name, "activation=relu"]) == 2
    line = f"uavnav: there is no command '{name}'; it is an algorithm: uavnav train {name}\n"
    assert capsys.readouterr() == ("", line)


def test_a_command_after_uavnav_runs_with_the_words_after_it(capsys):
    assert told("layouts --check test", capsys).startswith("test: 1000 layouts of 8 obstacles")


# -- help ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted({*commands.COMMANDS} - {"train"}))
def test_the_help_of_a_command_says_what_it_does_explains_each_argument_and_ends_with_an_example(
    name, capsys, monkeypatch
):
    monkeypatch.setenv("COLUMNS", "80")
    parser = Parser(prog=f"uavnav {name}")
    commands.COMMANDS[name].add_to(parser)
    text = told(f"{name} --help", capsys)
    assert text.startswith(f"usage: uavnav {name} ")
    assert f"\n{commands.COMMANDS[name].what}\n" in text
    for action in parser._actions:
        assert action.help, action.option_strings or action.dest
    (example,) = re.findall(rf"^example: uavnav {name} (.*)$", text, re.MULTILINE)
    parser.parse_args(shlex.split(example))


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_help_of_an_algorithm_is_what_its_configuration_says(name, capsys):
    kept = help.text_of(name).read_text(encoding="utf-8")
    assert kept == render(CONFIGS[name], World, Command), "make help writes it"
    assert told(f"train {name} --help", capsys) == told(f"train activation=relu -h {name}", capsys) == kept


def test_the_help_of_an_algorithm_in_a_task_has_the_keys_of_its_world(capsys):
    with_task = told("train ppo task=moving --help", capsys)
    assert re.search(r"world\.speed_max=2\.0 +\[px a step\] of the fastest obstacle", with_task)
    assert "speed_max" not in told("train ppo --help", capsys)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_each_key_has_one_line_of_meaning_with_its_default_and_its_choices(name):
    lines = help.text_of(name).read_text(encoding="utf-8").splitlines()
    found = {line.partition("=")[0].strip(): line for line in lines if re.match(r"  [\w.]+=", line)}
    parts = {"world": "world.sensor_arc", "faults": "faults.noise"}
    given = [*(parts.get(line.name, line.name) for line in settings.lines(CONFIGS[name])), "logger"]
    assert set(given) <= set(found)
    assert all(re.search(r"=\S+ {2,}\S", line) for line in found.values())
    assert found["gamma"].split() == ["gamma=0.99", "discount", "of", "a", "step;", "0", "to", "1"]
    assert found["n_envs"].startswith("  n_envs=1 ")  # of the default preset
    assert found["total_frames"].startswith("  total_frames=1000000 ")
    assert "[frames per seed] " in found["total_frames"]
    assert re.search(r"=180\.0 +\[degrees\] of the sensor", found["world.sensor_arc"])
    assert found["reward"].endswith("; additive, eq14, goal, initial")
    assert found["preset"].endswith(f"; {', '.join(sorted(CONFIGS[name].PRESETS))}")
    assert all(logger in found["logger"] for logger in LOG_FOLDERS)


def test_uavnav_train_alone_lists_the_algorithms_each_with_its_title(capsys):
    text = told("train", capsys)
    assert "\n  dqn  Deep Q-Network, sec. 3.2; " in text
    assert text == told("train --help", capsys)
    assert re.findall(r"^  (\w+)  ", text, re.MULTILINE) == list(ALGORITHMS)


# -- the page ------------------------------------------------------------------------------------------------


def test_the_page_has_each_exit_status_of_the_code():
    source = "".join(path.read_text() for path in PACKAGE.rglob("*.py"))
    found = re.findall(r"^ +return (\d+)(?: if| else|$)", source, re.MULTILINE)
    returned = {int(one) for one in found} & {0, 1, 2, 130}
    stopped = [Interrupted("", number, 0, wanted=False).status for number in (signal.SIGINT, signal.SIGTERM)]
    rows = table(PAGE.split("## Exit status")[1], "| status | meaning |")
    told_there = {int(one) for row in rows for one in row[0].split(", ")}
    assert told_there == {*returned, 1, terminal.UNREAD, *stopped}


def test_the_help_of_a_study_has_its_keys_those_of_its_engines_and_its_files(capsys):
    from uavnav import studies
    from uavnav.cli import study
    from uavnav.studies import engines

    assert list(commands.STUDY_KEYS) == study.Keys.names()
    text = " ".join(told("study --help", capsys).split())
    own = [
        item.name
        for name, kind in engines.ENGINES.items()
        for item in dataclasses.fields(
            getattr(importlib.import_module(f"uavnav.studies.engines.{name}"), kind)
        )
    ]
    assert all(word in text for word in [*engines.ENGINES, *own, *studies.names()])


@pytest.mark.parametrize(
    ("flag", "said"), [("", True), ("--quiet", False), ("--json", False), ("--cfg=job", False)]
)
def test_training_says_a_line_before_torch_is_loaded(flag, said, capsys):
    words = ["ppo", "-m", "activation=relu,elu", "preset=fast", *([flag] if flag else [])]
    commands._say_at_once(commands.parse("train", words))
    assert capsys.readouterr().out == "ppo relu, elu, preset fast: loading torch …\n" * said
    commands._say_at_once(commands.parse("train", ["pqn", "preset=best", *([flag] if flag else [])]))
    assert capsys.readouterr().out == "pqn, preset best: loading torch …\n" * said
