"""Logs hold what progress.parquet holds, however a run came about, and change nothing of it."""

import getpass
import importlib.util
import os
import platform
import random
import shutil
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from uavnav import ConfigError, RunError
from uavnav.algorithms import dqn, ppo
from uavnav.runs import POLICY, Run
from uavnav.runs.tables import with_reward
from uavnav.training import loggers
from uavnav.training.loggers import Logs, chosen
from uavnav.training.recorder import Interrupted

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("warm_module")]  # many runs in processes of their own

RECIPES = Path(__file__).parent.parent / "recipes"
SHORT = {
    "preset": "vectorised",
    "total_frames": 1536,
    "frames_per_batch": 256,
    "epochs": 1,
    "n_seeds": 2,
    "seed": 3,
    "max_steps": 10,
    "compile": "off",
}
"""Of a run whose seeds end more than 100 episodes."""
BOTH = ["tensorboard", "wandb"]


@pytest.fixture(autouse=True)
def offline(monkeypatch):
    monkeypatch.delenv("WANDB_MODE", raising=False)


def train(out, **how):
    return ppo.train(ppo.PPOConfig(**SHORT), out, quiet=True, **how)


@pytest.fixture(scope="module")
def plain(once, warm_module):
    """The run without any log, once for all processes as the next."""
    return Run(once("plain", lambda folder: train(folder / "run")) / "run")


@pytest.fixture(scope="module")
def logged(once, warm_module):
    """The same with two."""
    return Run(once("logged", lambda folder: train(folder / "run", logger=BOTH)) / "run")


def scalars(run):
    """What TensorBoard reads: (column, seed, frame) -> value."""
    events = EventAccumulator(str(run.path / "tensorboard"), size_guidance={"scalars": 0})
    events.Reload()
    found = {}
    for tag in events.Tags()["scalars"]:
        column, _, seed = tag.partition("/seed ")
        for event in events.Scalars(tag):
            assert (column, int(seed), event.step) not in found
            found[column, int(seed), event.step] = event.value
    return found


def offline_run(folder):
    """The one offline run of Weights & Biases there, once its service has written the last record."""
    (path,) = (folder / "wandb").glob("offline-run-*/run-*.wandb")
    for _ in range(100):
        if any(record.HasField("exit") for record in records(path)):
            return path
        time.sleep(0.1)
    raise AssertionError(f"{path} has no end")


def records(path):
    """Every record of such a file, which lie in blocks of 32 KiB as LevelDB's."""
    from wandb.proto import wandb_internal_pb2

    content, at, part, found = path.read_bytes(), 7, b"", []
    while at + 7 <= len(content):
        left = 32768 - at % 32768
        if left < 7:
            at += left
            continue
        _, length, kind = struct.unpack_from("<IHB", content, at)
        if at + 7 + length > len(content):  # it is being written
            break
        part += content[at + 7 : at + 7 + length]
        at += 7 + length
        if kind in (1, 4):  # whole, or its last part
            found.append(wandb_internal_pb2.Record.FromString(part))
            part = b""
    return found


def history(run):
    """As `scalars`, of Weights & Biases."""
    found = {}
    for record in records(offline_run(run.path)):
        if record.HasField("history"):
            items = {"/".join(item.nested_key) or item.key: item.value_json for item in record.history.item}
            for name, value in items.items():
                column, slash, seed = name.partition("/seed ")
                if slash:
                    key = column, int(seed), int(items[f"{column}/step"])
                    assert key not in found
                    found[key] = float(value)
    return found


def expected(run):
    """What either should hold, from the run's own tables by the slow way."""
    found = {}
    for row in run.progress.to_dict("records"):
        ended = run.episodes.query(
            "(terminated or truncated) and seed == @row['seed'] and frame <= @row['frame']"
        )
        last = ended.sort_values(["frame", "env"], kind="stable")["reward"].tail(100)
        for column, value in {**row, "reward": last.mean()}.items():
            if column not in ("seed", "frame") and np.isfinite(value):
                found[column, row["seed"], row["frame"]] = value
    return found


def assert_logged(run, read, timing=True):
    there, wanted = read(run), expected(run)
    if not timing:
        there, wanted = (
            {k: v for k, v in one.items() if k[0] != "frames_per_second"} for one in (there, wanted)
        )
    assert there.keys() == wanted.keys()
    assert len({column for column, *_ in there}) >= 5
    keys = list(wanted)
    assert [there[key] for key in keys] == pytest.approx([wanted[key] for key in keys], rel=1e-6, abs=1e-12)


READ = [pytest.param(scalars, id="tensorboard"), pytest.param(history, id="wandb")]


@pytest.mark.parametrize("read", READ)
def test_a_log_holds_each_column_of_progress_and_the_recent_reward_of_each_seed(logged, read):
    ended = logged.episodes.query("terminated or truncated")
    assert ended.groupby("seed").size().min() > 100
    assert_logged(logged, read)
    assert {seed for _, seed, _ in read(logged)} == {3, 4}
    assert {frame for *_, frame in read(logged)} == set(range(256, 1537, 256))


def test_a_run_with_logs_is_the_run_without_bit_for_bit(plain, logged):
    for name in ("config.yaml", "episodes.parquet", POLICY):
        assert (logged.path / name).read_bytes() == (plain.path / name).read_bytes()
    pd.testing.assert_frame_equal(
        *(run.progress.drop(columns="frames_per_second") for run in (plain, logged))
    )
    assert {path.name for path in logged.path.iterdir()} - {
        path.name for path in plain.path.iterdir()
    } == set(BOTH)


def test_logging_draws_no_random_number_and_leaves_the_environment(tmp_path, plain):
    def state():
        return (
            random.getstate(),
            str(np.random.get_state()),  # noqa: NPY002
            torch.get_rng_state().tolist(),
            os.environ.get("WANDB_MODE"),
        )

    before = state()
    logs = Logs(BOTH, tmp_path, "ppo", plain.config)
    logs(with_reward(plain.progress, plain.episodes))
    logs.close()
    assert state() == before


def test_weights_and_biases_is_told_the_settings_and_nothing_of_the_machine(logged):
    file = offline_run(logged.path)
    folder, told = file.parent, records(file)
    assert [path for path in folder.iterdir() if path.is_file()] == [file]
    assert not list((folder / "files").rglob("*.*"))  # no requirements, no metadata, no code
    kinds = {record.WhichOneof("record_type") for record in told}
    assert not kinds & {"files", "environment", "output", "output_raw", "stats", "artifact"}
    content = file.read_bytes()
    secrets = [
        socket.gethostname(),
        platform.release(),
        getpass.getuser(),
        sys.executable,
        str(logged.path),
        "numpy",
    ]
    assert not [secret for secret in secrets if len(secret) > 3 and secret.encode() in content]
    assert not [word for word in (b"site-packages", b".py", b"/home", b"/tmp") if word in content]
    (run,) = [record.run for record in told if record.HasField("run")]
    assert (run.project, run.display_name, run.host, run.HasField("git")) == ("uavnav", "ppo tanh", "", False)
    settings = {item.key: item.value_json for record in told for item in record.config.update}
    assert (settings["lr"], settings["activation"], settings["hidden"]) == ("0.0003", '"tanh"', "[64,64]")


def test_of_a_layout_file_its_name_alone_is_logged(tmp_path, plain):
    logs = Logs(["wandb"], tmp_path, "ppo", plain.config | {"layouts": "/somewhere/secret/own.safetensors"})
    logs({"seed": np.zeros(1), "frame": np.zeros(1)})
    logs.close()
    content = offline_run(tmp_path).read_bytes()
    assert b"own.safetensors" in content
    assert b"secret" not in content


@pytest.mark.parametrize("processes", [1, 2])
def test_a_run_that_was_stopped_leaves_one_log_of_the_whole(tmp_path, plain, processes):
    with pytest.raises(Interrupted):
        train(tmp_path / "run", until=768, processes=processes, logger=BOTH)
    run = train(tmp_path / "run", processes=processes, logger=BOTH)
    assert len(list((run.path / "tensorboard").iterdir())) == 1
    for read in (scalars, history):
        assert_logged(run, read)
    if processes == 1:
        pd.testing.assert_frame_equal(
            *(one.progress.drop(columns="frames_per_second") for one in (plain, run))
        )


@pytest.mark.slow
def test_a_worker_that_had_finished_is_logged_too(tmp_path):
    config = ppo.PPOConfig(**SHORT)
    with pytest.raises(Interrupted):
        ppo.train(config, tmp_path / "run", quiet=True, until=768, processes=2)
    worker = tmp_path / "run" / "workers" / "0"
    alone = ppo.train(ppo.PPOConfig(**SHORT | {"n_seeds": 1}), tmp_path / "alone", quiet=True, processes=1)
    shutil.rmtree(worker)
    shutil.copytree(alone.path, worker)
    assert_logged(train(tmp_path / "run", logger="tensorboard"), scalars)


def test_a_finished_run_is_logged_from_its_tables_once(plain, tmp_path):
    run = Run(shutil.copytree(plain.path, tmp_path / "run"))
    before = (run.path / "meta.json").read_bytes()
    assert not train(run.path, logger=BOTH).fresh
    for read in (scalars, history):
        assert_logged(run, read)
    there = sorted(run.path.rglob("*"))
    train(run.path, logger=BOTH)
    assert sorted(run.path.rglob("*")) == there
    assert (run.path / "meta.json").read_bytes() == before


def test_a_run_begun_anew_takes_the_old_logs_away(logged, tmp_path):
    run = train(shutil.copytree(logged.path, tmp_path / "run"), overwrite=True)
    assert not {path.name for path in run.path.iterdir()} & set(BOTH)


def test_dqn_logs_its_losses_from_where_they_begin(tmp_path, monkeypatch):
    monkeypatch.setattr("uavnav.algorithms.replay.LOG_FRAMES", 500)
    config = dqn.DQNConfig(
        n_envs=64, total_frames=1_500, learning_starts=600, frames_per_update=64, hidden=[8], compile="off"
    )
    run = dqn.train(config, tmp_path / "run", quiet=True, logger="tensorboard")
    assert_logged(run, scalars)
    found = scalars(run)
    frames = {
        column: sorted(frame for name, _, frame in found if name == column) for column in ("loss", "epsilon")
    }
    assert len(frames["epsilon"]) == 4
    assert frames["loss"] == frames["epsilon"][1:]


def test_a_log_that_fails_is_left_out_with_one_warning_and_training_goes_on(tmp_path, plain, monkeypatch):
    class Full:
        def log_metrics(self, values, step):
            raise OSError(28, "No space left on device")

        def flush(self):
            pass

    monkeypatch.setitem(loggers.OPEN, "wandb", lambda *what: Full())
    with pytest.warns(UserWarning, match=r"logger=wandb fails and is left out \(.*No space left") as caught:
        run = train(tmp_path / "run", logger=BOTH)
    assert len([one for one in caught if "logger=" in str(one.message)]) == 1
    assert_logged(run, scalars)
    assert run.episodes.equals(plain.episodes)


@pytest.mark.parametrize("processes", [1, 2])
def test_a_log_that_cannot_be_opened_ends_the_run_before_its_first_frame(tmp_path, monkeypatch, processes):
    def refuse(*what):
        raise OSError("no api key\nlong story")

    monkeypatch.setitem(loggers.OPEN, "wandb", refuse)
    with pytest.raises(
        RunError, match=r"^logger=wandb: cannot be opened \(no api key\); give another, or none$"
    ):
        train(tmp_path / "run", logger="wandb", processes=processes)
    assert not list((tmp_path / "run").glob("*.parquet"))
    assert train(tmp_path / "run").fresh


def test_loggers_are_chosen_by_name_one_or_several():
    assert chosen("none") == chosen(["none"]) == chosen([]) == []
    assert chosen("wandb") == ["wandb"]
    assert chosen(["wandb", "tensorboard", "wandb"]) == BOTH


@pytest.mark.parametrize("wrong", ["tensorbord", None, 3, ["wandb", "tensorbord"], {"wandb": 1}])
def test_an_unknown_logger_is_answered_with_the_choices_and_nothing_is_written(wrong, tmp_path):
    with pytest.raises(ConfigError, match=r"^logger=.*; .*choose from none, tensorboard, wandb"):
        train(tmp_path / "run", logger=wrong)
    assert not list(tmp_path.iterdir())


def test_a_logger_that_is_not_installed_names_what_to_install(monkeypatch, tmp_path):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(loggers, "find_spec", lambda name: None if name in BOTH else find_spec(name))
    with pytest.raises(ConfigError, match=r"^logger=tensorboard: .*; pip install 'uavnav\[tensorboard\]'$"):
        train(tmp_path / "run", logger="tensorboard")
    with pytest.raises(ConfigError, match=r"^logger=wandb: .*; pip install 'wandb'$"):
        train(tmp_path / "run", logger="wandb")
    assert not list(tmp_path.iterdir())


def test_the_recipe_takes_several_and_ends_with_the_commands_that_show_them(tmp_path):
    words = [
        "logger=[tensorboard,wandb]",
        "out=mine",
        "total_frames=512",
        "frames_per_batch=256",
        "evaluate=false",
    ]
    command = [sys.executable, RECIPES / "ppo.py", *words]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    (log,) = (tmp_path / "mine" / "wandb").glob("offline-run-*")
    shown = ["tensorboard --logdir mine", f"wandb sync {log.relative_to(tmp_path)}"]
    assert result.stdout.splitlines()[-2:] == [f"see its log: {command}" for command in shown]
    run = Run(tmp_path / "mine")
    for read in (scalars, history):
        assert_logged(run, read)
    assert "logger" not in run.config
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
