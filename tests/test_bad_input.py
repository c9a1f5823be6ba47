"""Every case of the table `bad_input`, in the library and on the command line; and what a full disk
leaves.
"""

import contextlib
import errno
import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from unittest import mock

import pytest
from bad_input import (
    CASES,
    DQN,
    RECIPES,
    YAML_BOMB,
    a_folder,
    a_pipe,
    endless,
    evaluate,
    itself,
    large,
    make_good,
    nothing,
    put,
    replaced,
    save_layouts,
    save_picture,
    tree,
    unfolding,
    written,
)

from uavnav import LayoutError, RunError, runs
from uavnav.__main__ import main
from uavnav.algorithms import dqn
from uavnav.cli import commands, render
from uavnav.report.configurations import collect
from uavnav.runs import POLICY


@pytest.fixture(scope="module")
def good():
    """Of a short path, so that no line is cut."""
    with tempfile.TemporaryDirectory() as scratch:
        yield make_good(Path(scratch) / "good")


@pytest.fixture
def folder(good, monkeypatch):
    """A copy of the good folder to spoil, and the current directory."""
    with tempfile.TemporaryDirectory() as scratch:
        here = Path(shutil.copytree(good, Path(scratch) / "here"))
        monkeypatch.chdir(here)
        yield here


@pytest.fixture
def place(case, good, request, monkeypatch):
    """The good folder itself for a case that spoils nothing: it stays just so."""
    if case.spoil is not nothing:
        return request.getfixturevalue("folder")
    monkeypatch.chdir(good)
    return good


def test_each_case_has_a_name_of_its_own():
    assert len({case.name for case in CASES}) == len(CASES)


def said(case, folder, text):
    """One line with both fragments."""
    assert "\n" not in text
    for fragment in (case.wrong, case.right):
        assert fragment.replace("{}", str(folder)) in text, text


@contextlib.contextmanager
def spoilt(case, folder):
    """Within, the folder is spoilt, and it must stay just so."""
    held = case.spoil(folder / case.part)
    with held or contextlib.nullcontext():
        before = tree(folder)
        yield
        after = tree(folder)
    if case.name.startswith("half"):  # meta.json tells when the run was last tried
        before.pop("half/meta.json"), after.pop("half/meta.json")
    assert after == before


@pytest.mark.filterwarnings("error:.*going on from the one before")
@pytest.mark.parametrize("case", [pytest.param(case, id=case.name) for case in CASES if case.call])
def test_in_the_library_it_is_one_line_of_a_typed_exception_and_nothing_changes(case, place):
    with spoilt(case, place), pytest.raises(case.error) as refused:
        case.call(place)
    assert type(refused.value) is case.error
    said(case, place, str(refused.value))


@pytest.mark.parametrize("case", [pytest.param(case, id=case.name) for case in CASES if case.command])
def test_on_the_command_line_it_is_one_line_a_status_and_nothing_changes(case, place, capfd, monkeypatch):
    monkeypatch.setattr(render, "fly", None)  # nobody flies
    program, *arguments = [word.replace("{}", str(place)) for word in shlex.split(case.command)]
    if program not in commands.COMMANDS:
        program, arguments = "train", [program, *arguments]
    with spoilt(case, place):
        try:
            status = main([program, *arguments])
        except SystemExit as stop:
            status = stop.code
    printed, complained = capfd.readouterr()
    assert status == 2
    assert printed == ""
    assert complained.startswith(f"uavnav {program}: ")
    assert complained.endswith("\n")
    said(case, place, complained[:-1])


@pytest.mark.usefixtures("warm")
@pytest.mark.parametrize(
    ("command", "message"),
    [
        (
            ["-m", "uavnav", "layouts", "--check", "{}/thesis"],
            "uavnav layouts: layouts='{}/thesis': no such layout file; ",
        ),
        (
            ["-m", "uavnav", "evaluate", "{}/thesis"],
            "uavnav evaluate: {}/thesis/config.yaml: missing or damaged; ",
        ),
        ([RECIPES / "dqn.py", "out={}/policy"], "uavnav train: out={}/policy: is a file; give a folder"),
    ],
)
def test_as_a_process_it_is_one_line_too(folder, command, message):
    before = tree(folder)
    words = [str(word).replace("{}", str(folder)) for word in command]
    result = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert result.stdout == ""
    assert result.stderr.startswith(message.replace("{}", str(folder)))
    assert result.stderr.count("\n") == 1
    assert tree(folder) == before


CONTENTS = [b"", bytes(3000), "[" * 100_000, "3", YAML_BOMB]
OF_ANY = [a_folder, a_pipe, endless, large, itself, unfolding, *map(written, CONTENTS)]
"""Eleven ways to damage any file."""


@pytest.mark.parametrize(
    "part", ["config.yaml", "meta.json", "episodes.parquet", "progress.parquet", "evaluation.parquet"]
)
def test_each_damaged_run_costs_one_line_and_the_others_are_told(folder, part, capfd):
    """Between two good runs are those with each kind of damage."""
    damaged = [f"b{number:02}" for number in range(len(OF_ANY))]
    for name, activation in {"a": "tanh", **dict.fromkeys(damaged, "relu"), "c": "elu"}.items():
        run = shutil.copytree(folder / "run", folder / "runs" / name)
        replaced("activation: tanh", f"activation: {activation}")(run / "config.yaml")
    paths = [folder / "runs" / name / part for name in damaged]
    for path, spoil in zip(paths, OF_ANY, strict=True):
        spoil(path)
    assert main(["runs", str(folder / "runs"), "--json"]) == 0
    told, complained = capfd.readouterr()
    read = part in ("config.yaml", "meta.json")
    assert [Path(row["run"]).name for row in json.loads(told)] == ["a", *damaged[read * 11 :], "c"]
    for path, line in zip(paths[: read * 11], complained.splitlines(), strict=True):
        assert line.startswith(f"uavnav runs: left out: {path}: ")
        assert len(line) <= 300
    configurations, left_out = collect([folder / "runs"])
    assert [configuration.activation for configuration in configurations] == ["tanh", "elu"]
    for path, line in zip(paths, left_out, strict=True):
        assert line.startswith(f"{path}: ")
        assert len(line) <= 270


# -- a full disk ---------------------------------------------------------------------------------------------


@contextlib.contextmanager
def full(name, forever):
    """The disk is full when a file of this name is half-written; and stays so, or only that file is
    refused.
    """
    write, out_of_space = Path.write_bytes, []

    def write_half(path, content):
        if path.name.strip(".").startswith(name) or (forever and out_of_space):
            out_of_space.append(path)
            write(path, content[: len(content) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        return write(path, content)

    with mock.patch.object(Path, "write_bytes", write_half):
        yield
    assert out_of_space


def train(folder):
    return dqn.train(dqn.DQNConfig(**DQN), folder, quiet=True, checkpoint_seconds=0)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run whose disk is never full."""
    return train(tmp_path_factory.mktemp("whole") / "run")


@pytest.mark.parametrize("forever", [False, True])
@pytest.mark.parametrize("name", ["config.yaml", "meta.json", "state-", "replay-", *runs.FILES[2:]])
def test_a_run_whose_disk_is_full_says_so_in_one_line_and_goes_on_when_there_is_space(
    tmp_path, whole, name, forever
):
    with full(name, forever), pytest.raises(RunError) as refused:
        train(tmp_path / "run")
    message = str(refused.value)
    assert "\n" not in message
    assert name.strip("-") in message or "checkpoint" in message
    assert "No space left on device" in message
    left = {str(path.relative_to(tmp_path / "run")) for path in tmp_path.glob("run/**/*") if path.is_file()}
    assert {path for path in left if not path.startswith("checkpoint/")} <= set(runs.FILES)
    assert not any(path.startswith("checkpoint/.") for path in left)
    again = train(tmp_path / "run")
    for part in ("episodes.parquet", POLICY):
        assert (again.path / part).read_bytes() == (whole.path / part).read_bytes()


@pytest.mark.parametrize("name", ["evaluation-test-2-5.parquet", "behaviour-test-2-5.parquet"])
def test_an_evaluation_whose_disk_is_full_leaves_the_old_rows(folder, name):
    put(folder / "run" / name, "the old rows")
    before = tree(folder)
    with (
        full(name, True),
        pytest.raises(RunError, match=rf"{name}: cannot be written .*No space left") as refused,
    ):
        evaluate(folder)
    assert "\n" not in str(refused.value)
    after = tree(folder)
    assert after.keys() == before.keys()
    assert after[f"run/{name}"] == b"the old rows"
    assert len(evaluate(folder)) == 2 * 2 * 2
    assert tree(folder)[f"run/{name}"] != b"the old rows"


def test_a_layout_file_or_a_picture_whose_disk_is_full_is_the_old_one(folder):
    save_picture(folder / "episode.gif")
    before = tree(folder)
    with (
        full("layouts", True),
        pytest.raises(LayoutError, match=r"layouts: cannot be written .*No space left"),
    ):
        save_layouts(folder / "layouts")
    with (
        full("episode", True),
        pytest.raises(ValueError, match=r"episode.gif: cannot be written .*No space left"),
    ):
        save_picture(folder / "episode.gif")
    assert tree(folder) == before
