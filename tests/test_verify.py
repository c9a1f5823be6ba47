"""Runs are repeated and compared: the same bit for bit, or told where they part first."""

import functools
import json
import os
import re
import shutil
import signal

import pandas as pd
import pytest
from safetensors import safe_open
from safetensors.torch import save_file

from uavnav.algorithms import ppo
from uavnav.cli import commands
from uavnav.evaluation import verify
from uavnav.runs import POLICY, Run
from uavnav.training import loop
from uavnav.training.recorder import Recorder

verify_command = functools.partial(commands.run, "verify")

ALGORITHMS = ["ppo", "dqn"]


@pytest.fixture(params=ALGORITHMS)
def trained(request, of_two):
    return of_two(request.param)[1]


@pytest.fixture
def known(of_two, monkeypatch):
    """The repeat of a whole run is a copy of it, as the first test here shows that it would be; others are
    flown.
    """
    train, there = verify.train, {config: run.path for config, run in map(of_two, ALGORITHMS)}

    def repeat(config, out, **how):
        if config in there and "until" not in how:
            return Run(shutil.copytree(there[config], out))
        return train(config, out=out, **how)

    monkeypatch.setattr(verify, "train", repeat)


@pytest.fixture
def run(of_two, known, tmp_path):
    """The folder of a copy of PPO's, to be doctored."""
    return shutil.copytree(of_two("ppo")[1].path, tmp_path / "run")


@pytest.fixture
def verdict(capsys):
    """What the command says of a folder: status and lines."""

    def judge(folder, *arguments):
        status = verify_command([str(folder), *arguments])
        out, err = capsys.readouterr()
        assert err == ""
        lines = out.splitlines()
        return status, lines[next(i for i, line in enumerate(lines) if line.startswith(str(folder))) :]

    return judge


def edit(path, change, **header):
    """Doctor a table, a JSON file or a file of weights, whose header says what is given."""
    if path.suffix == ".json":
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))
    elif path.suffix == ".parquet":
        table = pd.read_parquet(path)
        change(table)
        table.to_parquet(path, index=False)
    else:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            told = json.loads(file.metadata()["uavnav"]) | header
        change(tensors)
        save_file(
            {name: one.contiguous() for name, one in tensors.items()}, path, {"uavnav": json.dumps(told)}
        )


def setting(row, column, value):
    """A change of one number of a table; value: it, or what it becomes."""

    def change(table):
        index = len(table) + row if row < 0 else row
        table.loc[index, column] = value(table.loc[index, column]) if callable(value) else value

    return change


def unchanged(content):
    pass


def test_a_repeat_of_the_whole_run_is_the_same_bit_for_bit_and_ends_with_0(trained, verdict):
    before = {path.name: path.read_bytes() for path in trained.path.iterdir()}
    status, lines = verdict(trained.path)
    n = len(trained.episodes)
    tensors = {"ppo": 12, "dqn": 6}[trained.algorithm]  # three layers of weights and biases a network
    assert lines == [
        f"{trained.path}: the same, bit for bit: {n} episodes, {len(trained.progress)} rows of progress"
        f" and {tensors} tensors at 1,024 frames per seed"
    ]
    assert status == 0
    assert {path.name: path.read_bytes() for path in trained.path.iterdir()} == before


@pytest.mark.parametrize(
    ("frames", "reached"), [(1, {"ppo": 512, "dqn": 64}), (500, {"ppo": 512, "dqn": 512})]
)
def test_a_repeat_of_the_first_frames_compares_the_episodes_that_ended_by_then(
    trained, verdict, frames, reached
):
    reached = reached[trained.algorithm]
    status, lines = verdict(trained.path, "--frames", str(frames))
    ended = trained.episodes[trained.episodes.terminated & (trained.episodes.frame <= reached)]
    progress = trained.progress[trained.progress.frame <= reached]
    assert lines == [
        f"{trained.path}: the same, bit for bit: {len(ended)} episodes, {len(progress)} rows of progress"
        f" at {reached} frames per seed"
    ]
    assert status == 0


@pytest.mark.usefixtures("known")
@pytest.mark.parametrize("frames", ["1024", "5000"])
def test_the_frames_of_the_whole_run_and_more_are_the_whole_run(trained, verdict, frames):
    status, lines = verdict(trained.path, "--frames", frames)
    assert status == 0
    assert lines[0].endswith("tensors at 1,024 frames per seed")


@pytest.mark.parametrize("arguments", [[], ["--frames", "512"]])
def test_one_changed_reward_is_not_the_same_and_named_by_row_seed_frame_and_column(run, verdict, arguments):
    row = Run(run).episodes.iloc[3]
    edit(run / "episodes.parquet", setting(3, "reward", -20.5))
    assert verdict(run, *arguments) == (
        1,
        [
            f"{run}: not the same",
            f"  episodes: row 3 (seed {row.seed}, frame {row.frame}) is the first with another reward:"
            f" -20.5 then, {row.reward} now",
        ],
    )


def cut(tensors):
    tensors["policy.0.bias"] = tensors["policy.0.bias"][..., :9]


PARTED = {
    "a row too few": (
        "episodes.parquet",
        lambda rows: rows.drop(index=len(rows) - 1, inplace=True),
        "N rows then, N n",
    ),
    "a loss of the last row": (
        "progress.parquet",
        setting(-1, "grad_norm", lambda old: old + 1e-6),
        "progress: row N (seed 1, frame 1,024) is the first with another grad_norm: ",
    ),
    "a column of NaN": (
        "progress.parquet",
        lambda rows: rows.__setitem__("grad_norm", float("nan")),
        "the first with another grad_norm: nan then",
    ),
    "a column more": (
        "progress.parquet",
        lambda rows: rows.insert(0, "extra", 1.0),
        "progress: other columns",
    ),
    "a weight": (
        POLICY,
        lambda tensors: tensors["policy.2.weight"][1, 5].add_(0.5),
        "weights: policy.2.weight differs by up to 0.5",
    ),
    "a shape": (POLICY, cut, "weights: policy.0.bias is float32 [2, 1, 9] then, float32 [2, 1, 64] now"),
    "a tensor less": (POLICY, lambda tensors: tensors.pop("policy.0.bias"), "weights: other tensors"),
}


@pytest.mark.parametrize("what", PARTED)
def test_another_table_or_weight_is_not_the_same_and_is_named(what, run, verdict):
    name, change, said = PARTED[what]
    edit(run / name, change)
    status, (first, line) = verdict(run)
    assert (status, first) == (1, f"{run}: not the same")
    assert re.search(re.escape(said).replace("N", r"\d+"), line), line


def test_of_a_file_with_the_weights_of_one_seed_these_are_compared_and_no_shorter_file_passes(run, verdict):
    def first(tensors):
        tensors.update({name: tensor[:1] for name, tensor in tensors.items()})

    edit(run / POLICY, first)  # its header names two seeds
    assert verdict(run)[1][1].startswith(
        "  weights: policy.0.bias is float32 [1, 1, 64] then, float32 [2, 1, 64] now"
    )
    seeds = Run(run).seeds
    edit(run / POLICY, unchanged, seeds=seeds[:1])
    status, (line,) = verdict(run)
    assert status == 0
    assert line.endswith(" tensors of 1 of its 2 seeds at 1,024 frames per seed")
    edit(run / POLICY, unchanged, seeds=seeds[1:])
    assert verdict(run)[0] == 1


@pytest.mark.parametrize("seeds", [[], [99]])
def test_weights_of_seeds_that_the_run_has_not_are_not_the_same(run, verdict, seeds):
    edit(run / POLICY, unchanged, seeds=seeds)
    assert verdict(run) == (
        1,
        [f"{run}: not the same", f"  weights: of the seeds {seeds} then, {Run(run).seeds} now"],
    )


def test_a_run_without_its_policy_is_compared_by_its_rows_and_says_so(run, verdict):
    (run / POLICY).unlink()
    status, lines = verdict(run)
    assert status == 0
    assert lines[0].startswith(f"{run}: the same, bit for bit: ")
    assert lines[0].endswith(" rows of progress at 1,024 frames per seed")
    assert lines[1:] == ["  weights: not compared, no policy.safetensors there; the run's command makes it"]


def test_another_seed_in_config_yaml_is_another_run_from_row_0_on_in_rows_and_weights(run, verdict):
    path = run / "config.yaml"
    path.write_text(path.read_text().replace("\nseed: 0\n", "\nseed: 3\n"))
    status, lines = verdict(run)
    assert status == 1
    assert lines[0] == f"{run}: not the same"
    assert [line.split(":")[0] for line in lines[1:]] == ["  episodes", "  progress", "  weights"]
    assert "row 0 (seed 0, " in lines[1]
    assert "is the first with another seed: 0 then, 3 now" in lines[1]


@pytest.mark.parametrize("arguments", [[], ["--frames", "512"]])
def test_where_a_run_parts_the_versions_and_plugins_that_differ_are_named_and_no_others(
    run, verdict, arguments, monkeypatch
):
    def older(meta):
        meta["versions"]["torch"] = "1.0.0"
        meta["plugins"] = {"mine": "0" * 64}

    edit(run / "meta.json", older)
    monkeypatch.setitem(verify.plugins.LOADED, "mine", "1" * 64)
    monkeypatch.setattr(verify, "train", loop.train)  # whose facts are those of now
    assert verdict(run, *arguments)[0] == 0  # another version alone leaves the same run the same
    edit(run / "episodes.parquet", setting(0, "steps", lambda old: old + 1))
    status, (_, parted, version, plugin) = verdict(run, *arguments)
    assert status == 1
    assert "is the first with another steps: " in parted
    assert version.startswith("  versions.torch: 1.0.0 then, 2.")
    assert plugin == f"  plugins.mine: {'0' * 64} then, {'1' * 64} now"


@pytest.mark.parametrize("arguments", [[], ["--frames", "900"]])
def test_an_interrupted_repeat_compares_nothing_and_ends_with_130(tmp_path, monkeypatch, capsys, arguments):
    config = ppo.PPOConfig(n_envs=16, total_frames=1024, frames_per_batch=256, epochs=1, compile="off")
    run = ppo.train(config, out=tmp_path / "run", quiet=True)
    original = Recorder.checkpoint

    def interrupt(self, frames, *parts):
        if frames == 512:
            os.kill(os.getpid(), signal.SIGINT)
        original(self, frames, *parts)

    monkeypatch.setattr(Recorder, "checkpoint", interrupt)
    assert verify_command([str(run.path), *arguments]) == 130
    out, err = capsys.readouterr()
    assert "same" not in out
    assert err == "uavnav verify: stopped, nothing was compared\n"


def test_columns_that_a_folder_leaves_out_are_named_and_all_others_are_compared(run, verdict):
    edit(run / "episodes.parquet", lambda table: table.drop(columns=["env", "layout"], inplace=True))
    n = len(Run(run).episodes)
    status, lines = verdict(run)
    assert (status, f": {n} episodes, " in lines[0]) == (0, True)
    assert lines[1] == "  episodes: not compared, as the folder leaves them out: env, layout"
    edit(run / "episodes.parquet", setting(3, "distance", lambda old: old + 1))
    status, lines = verdict(run)
    assert (status, "the first with another distance" in lines[1]) == (1, True)


@pytest.mark.parametrize("frames", [512, 1024])
def test_rows_of_progress_before_the_first_that_a_folder_keeps_are_left_out_and_said_so(run, verdict, frames):
    edit(run / "progress.parquet", lambda rows: rows.drop(rows[rows.frame < 1024].index, inplace=True))
    kept = len(Run(run).progress)
    status, lines = verdict(run, "--frames", str(frames))
    assert status == 0
    assert f" {kept if frames == 1024 else 0} rows of progress" in lines[0]
    assert lines[1] == "  progress: not compared before frame 1,024, as the folder leaves those rows out"
    edit(run / "progress.parquet", setting(-1, "grad_norm", lambda old: old + 1e-6))
    assert verdict(run)[0] == 1


def test_a_run_is_repeated_in_as_many_processes_and_threads_as_it_had(tmp_path, monkeypatch):
    """Sums of two threads round otherwise. Four seeds in one process would have two threads by default."""
    config = ppo.PPOConfig(
        n_seeds=4, n_envs=4, total_frames=64, frames_per_batch=64, minibatch_size=64, epochs=1, compile="off"
    )
    monkeypatch.setattr("uavnav.training.machine.cores", lambda: 2)
    by_default, run = (
        ppo.train(config, out=tmp_path / str(threads), quiet=True, threads=threads) for threads in (None, 1)
    )
    assert (by_default.meta["threads"], run.meta["threads"]) == (2, 1)
    told, train = [], verify.train
    monkeypatch.setattr(verify, "train", lambda *args, **how: told.append(how) or train(*args, **how))
    assert verify.verify(run, quiet=True).same
    assert told == [{"out": told[0]["out"], "quiet": True, "processes": 1, "threads": 1}]
