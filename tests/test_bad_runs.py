"""Runs that are damaged, in use, another's or half-finished, and full disks: one line, and nothing is lost."""

import contextlib
import errno
import os
import shutil
from pathlib import Path
from unittest import mock

import pytest
from bad_input import (
    DAMAGED,
    DQN,
    EMPTY,
    EVALUATE,
    EXECUTED,
    FILE,
    FOLDER,
    LONG,
    NO_RUN,
    NUMBER,
    OVERWRITE,
    PPO,
    REPORT,
    RUN,
    VERIFY,
    Case,
    by_name,
    evaluate,
    half,
    in_the_library,
    make_good,
    on_the_command_line,
    out,
    read_evaluation,
    run,
    save_bank,
    save_picture,
    train_ppo,
    tree,
    verify,
    words,
)
from spoiling import (
    a_file,
    a_folder,
    added,
    cut,
    cut_before,
    flipped,
    in_use,
    meta,
    missing,
    newer_torch,
    nothing,
    pickled,
    put,
    read_only,
    replaced,
    replay_gone,
    reseeded,
    snapshots,
    status,
    table,
    written,
)

from uavnav import ConfigError, LayoutError, PolicyError, RunError, runs
from uavnav.algorithms import dqn
from uavnav.runs import POLICY, Run

RECIPES = Path(__file__).parent.parent / "recipes"

CASES = [
    # a run
    run("", "missing", missing, "no such run folder", RUN),
    run("", "a file", a_file, "no such run folder", RUN),
    Case("run: too long a name", "run", nothing, lambda f: Run(LONG), RunError, LONG, RUN, ["evaluate", LONG]),
    run("config.yaml", "missing", missing, DAMAGED, RUN),
    run("config.yaml", "empty", written(""), "not a run's configuration", RUN),
    run("config.yaml", "a list", written("[1, 2]"), "not a run's configuration", RUN),
    run("config.yaml", "a word", written("tanh"), "not a run's configuration", RUN),
    run("config.yaml", "a syntax error", written("[1"), DAMAGED, RUN),
    run("config.yaml", "not text", written(b"\xff\xfe\x00"), DAMAGED, RUN),
    run("config.yaml", "a date that is none", written("seed: 2001-13-45"), DAMAGED, RUN),
    run("config.yaml", "a thousand brackets", written("[" * 1000), DAMAGED, RUN),
    run("config.yaml", "a command", written(f"!!python/object/apply:os.system ['{EXECUTED}']"), DAMAGED, RUN),
    run(
        "config.yaml", "a command below", written(f"seed: !!python/object/apply:os.system ['{EXECUTED}']"), DAMAGED, RUN
    ),
    run("config.yaml", "no algorithm", replaced("algorithm: ppo\n", ""), "not a run's, its algorithm=None", RUN),
    run("config.yaml", "no seed", replaced("\nseed: 0\n", "\n"), "not a run's, its seed=None", RUN),
    run("config.yaml", "a seed in words", replaced("\nseed: 0\n", "\nseed: zero\n"), "not a run's, its seed=zero", RUN),
    run("config.yaml", "no seeds", replaced("n_seeds: 2", "n_seeds: 0"), "not a run's, its n_seeds=0", RUN),
    run("config.yaml", "cut within a key", cut_before("_radius_max"), DAMAGED, RUN),
    run(
        "config.yaml", "another algorithm", replaced(": ppo", ": sac"), "algorithm=sac; ", "choose from", verify, VERIFY
    ),
    run(
        "config.yaml",
        "dqn's keys",
        replaced(": ppo", ": dqn"),
        "there is no key 'frames_per_batch'",
        "choose from",
        verify,
        VERIFY,
        ConfigError,
    ),
    run(
        "config.yaml",
        "an unknown key",
        added("speed: 3\n"),
        "there is no key 'speed'",
        "choose",
        verify,
        VERIFY,
        ConfigError,
    ),
    run(
        "config.yaml",
        "a key that is a number",
        added("3: 3\n"),
        "there is no key 3",
        "choose",
        verify,
        VERIFY,
        ConfigError,
    ),
    run(
        "config.yaml",
        "a wrong value",
        replaced("gamma: 0.99", "gamma: 9"),
        "gamma=9",
        NUMBER,
        verify,
        VERIFY,
        ConfigError,
    ),
    Case(
        "run/config.yaml: a bank that is gone",
        "run/config.yaml",
        replaced("layouts: train", "layouts: tset"),
        verify,
        LayoutError,
        "layouts='tset': no such bank",
        FILE,
        VERIFY,
    ),
    run("meta.json", "missing", missing, DAMAGED, RUN),
    run("meta.json", "empty", written(""), DAMAGED, RUN),
    run("meta.json", "cut", cut(0.5), DAMAGED, RUN),
    run("meta.json", "not text", written(b"\xff\xfe\x00"), DAMAGED, RUN),
    run("meta.json", "many brackets", written("[" * 100_000), DAMAGED, RUN),
    run("meta.json", "a list", written("[1]"), "not a run's facts", RUN),
    run("meta.json", "no frames", meta(frames=...), "not a run's, its frames=None", RUN),
    run("meta.json", "frames in words", meta(frames="many"), "not a run's, its frames=many", RUN),
    run("", "under way", status("running"), "the run is not finished", "give the same command again"),
    *(
        run(f"{name}.parquet", how, spoil, wrong, OVERWRITE)
        for name in ("episodes", "progress")
        for how, spoil, wrong in (
            ("missing", missing, DAMAGED),
            ("a folder", a_folder, DAMAGED),
            ("empty", written(b""), DAMAGED),
            ("cut", cut(0.7), DAMAGED),
            ("text", written("seed,frame\n0,1\n"), DAMAGED),
            ("a pickle", pickled, DAMAGED),
            ("other columns", table(lambda t: t.rename(columns={"frame": "time"})), "its columns are not"),
            ("words for numbers", table(lambda t: t.astype({"seed": str})), "its columns are not"),
        )
    ),
    Case(
        "run/policy.safetensors: missing",
        "run/policy.safetensors",
        missing,
        evaluate,
        PolicyError,
        "{}/run: no policy.safetensors there",
        "give the folder of a finished run",
        EVALUATE,
    ),
    run(
        "policy.safetensors",
        "cut",
        cut(0.5),
        "not a readable policy",
        "of a finished run",
        evaluate,
        EVALUATE,
        PolicyError,
    ),
    run("policy.safetensors", "cut before a repeat", cut(0.5), DAMAGED, OVERWRITE, verify, VERIFY),
    *(
        run("evaluation.parquet", how, spoil, wrong, "evaluate the run again", read_evaluation, REPORT)
        for how, spoil, wrong in (
            ("cut", cut(0.7), DAMAGED),
            ("no modes", table(lambda t: t.drop(columns="mode")), "its columns are not"),
            ("rewards in words", table(lambda t: t.astype({"reward": str})), "its columns are not"),
        )
    ),
    # where a run is to go
    out("a file", "run", a_file, "out={}/run: is a file", "give a folder"),
    out("below a file", "thesis", nothing, "{}/policy is not", FOLDER, target="policy/run"),
    out("in /proc", "thesis", nothing, "out=/proc/nowhere/run: ", FOLDER, target="/proc/nowhere/run"),
    out("too long a name", "thesis", nothing, "xxx: cannot be written", FOLDER, target=LONG),
    out("in a folder that is read-only", "thesis", read_only, "{} is not", FOLDER, target="new"),
    out(
        "among other files",
        "thesis",
        nothing,
        "out={}/thesis: holds other files",
        "give a new or empty",
        target="thesis",
    ),
    out("over other files", "thesis", nothing, "holds other files", "give a new or empty", "thesis", overwrite=True),
    out("over another program's", "thesis/config.yaml", written("kind: Pod"), NO_RUN, EMPTY, "thesis", overwrite=True),
    out("over another's run", "thesis/config.yaml", written("algorithm: sac"), NO_RUN, EMPTY, "thesis", overwrite=True),
    out(
        "over a damaged config", "run/config.yaml", written("[1"), "{}/run/config.yaml: " + DAMAGED, "", overwrite=True
    ),
    out("a config of keys that are numbers", "run/config.yaml", added("1: 2\n"), "with 1=2, not None", OVERWRITE),
    out("another learning rate", "run", nothing, "holds a run with lr=0.0003, not 0.1", OVERWRITE, lr=0.1),
    out("another network", "run", nothing, "holds a run with hidden=[8], not [9]", OVERWRITE, hidden=[9]),
    out("another algorithm's", "run/config.yaml", replaced(": ppo", ": dqn"), "algorithm=dqn, not ppo", OVERWRITE),
    out("finished, a table gone", "run/episodes.parquet", missing, "{}/run/episodes.parquet: missing", OVERWRITE),
    out("finished, the policy gone", "run/policy.safetensors", missing, "{}/run/policy.safetensors: ", OVERWRITE),
    out("facts cut", "run/meta.json", cut(0.5), "{}/run/meta.json: " + DAMAGED, RUN),
    out("in use", "new", in_use, "another process is writing this run", "wait for it", target="new"),
    out("in use, to be overwritten", "run", in_use, "another process is writing", "wait for it", overwrite=True),
    out("a folder for a lock", "run/.lock", Path.mkdir, "out={}/run: cannot be written", FOLDER, overwrite=True),
    Case(
        "out: another bank than before",
        "run/meta.json",
        meta(bank={"sha256": "0" * 64}),
        train_ppo,
        RunError,
        "the bank layouts=train has changed",
        OVERWRITE,
        ["ppo", *words(PPO), "out={}/run"],
    ),
    # a run that was interrupted
    half("every snapshot cut", snapshots(cut(0.9)), "damaged, its checksum does not match", OVERWRITE),
    half("every snapshot flipped", snapshots(flipped(-4)), "damaged, its checksum does not match", OVERWRITE),
    half("every snapshot empty", snapshots(written(b"")), "damaged, its checksum does not match", OVERWRITE),
    half("its replay gone", replay_gone, "missing or not readable", OVERWRITE),
    half("of another version of torch", newer_torch, "saved with version of torch=", OVERWRITE),
    half("another seed", nothing, "holds a run with seed=0, not 7", OVERWRITE, seed=7),
    half("another seed everywhere", reseeded, "saved with seed=0, not 7", OVERWRITE, seed=7),
    Case(
        "half: read",
        "half",
        nothing,
        lambda f: Run(f / "half"),
        RunError,
        "{}/half: the run is not finished",
        "same command",
        ["verify", "{}/half"],
    ),
]


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return make_good(tmp_path_factory.mktemp("bad input") / "good")


@pytest.fixture
def folder(good, tmp_path, monkeypatch):
    """A copy of the good folder to spoil, and the current directory."""
    monkeypatch.chdir(shutil.copytree(good, tmp_path / "here"))
    return tmp_path / "here"


def test_84_cases_in_the_library_and_84_on_the_command_line_have_names_of_their_own():
    assert len({case.name for case in CASES}) == len(CASES)
    assert sum(case.call is not None for case in CASES) == 84
    assert sum(bool(case.command) for case in CASES) == 84


@pytest.mark.parametrize("case", by_name(case for case in CASES if case.call))
def test_in_the_library_it_is_one_line_of_a_typed_exception_and_nothing_changes(case, folder):
    in_the_library(case, folder)


@pytest.mark.parametrize("case", by_name(case for case in CASES if case.command))
def test_on_the_command_line_it_is_one_line_a_status_and_nothing_changes(case, folder, monkeypatch, capfd):
    on_the_command_line(case, folder, monkeypatch, capfd)


# -- a full disk -----------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def full(name, forever):
    """The disk is full when a file of this name is half-written; and stays so, or only that file is refused."""
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


@pytest.mark.parametrize("forever", [False, True])
@pytest.mark.parametrize("name", ["config.yaml", "meta.json", "state-", "replay-", *runs.FILES[2:]])
def test_a_run_whose_disk_is_full_says_so_in_one_line_and_goes_on_when_there_is_space(tmp_path, name, forever):
    def train(folder):
        return dqn.train(dqn.DQNConfig(**DQN), folder, quiet=True, checkpoint_seconds=0)

    with full(name, forever), pytest.raises(RunError) as refused:
        train(tmp_path / "run")
    message = str(refused.value)
    assert "\n" not in message
    assert name.strip("-") in message or "checkpoint" in message
    assert "No space left on device" in message
    left = {str(path.relative_to(tmp_path / "run")) for path in tmp_path.glob("run/**/*") if path.is_file()}
    assert {path for path in left if not path.startswith("checkpoint/")} <= set(runs.FILES)
    assert not any(path.startswith("checkpoint/.") for path in left)
    again, whole = train(tmp_path / "run"), train(tmp_path / "whole")
    for part in ("episodes.parquet", POLICY):
        assert (again.path / part).read_bytes() == (whole.path / part).read_bytes()


@pytest.mark.parametrize("name", ["evaluation-test-2-5.parquet", "behaviour-test-2-5.parquet"])
def test_an_evaluation_whose_disk_is_full_leaves_the_old_rows(folder, name):
    put(folder / "run" / name, "the old rows")
    before = tree(folder)
    with full(name, True), pytest.raises(RunError, match=rf"{name}: cannot be written .*No space left") as refused:
        evaluate(folder)
    assert "\n" not in str(refused.value)
    after = tree(folder)
    assert after.keys() == before.keys()
    assert after[f"run/{name}"] == b"the old rows"
    assert len(evaluate(folder)) == 2 * 2 * 2
    assert tree(folder)[f"run/{name}"] != b"the old rows"


def test_a_bank_or_a_picture_whose_disk_is_full_is_the_old_one(folder):
    save_picture(folder / "flight.gif")
    before = tree(folder)
    with full("bank", True), pytest.raises(LayoutError, match=r"bank: cannot be written .*No space left"):
        save_bank(folder / "bank")
    with full("flight", True), pytest.raises(ValueError, match=r"flight.gif: cannot be written .*No space left"):
        save_picture(folder / "flight.gif")
    assert tree(folder) == before
