"""Seeds spread over processes: the same rows and weights as each share by itself, however often it is stopped."""

import contextlib
import inspect
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest
import torch
from safetensors.torch import load_file

from uavnav import networks
from uavnav.algorithms.c51 import C51Config
from uavnav.algorithms.dqn import DQNConfig
from uavnav.algorithms.dqn import train as train_dqn
from uavnav.algorithms.ppo import PPOConfig, train
from uavnav.algorithms.sac import SACConfig
from uavnav.errors import ConfigError
from uavnav.evaluation.verify import verify
from uavnav.runs import POLICY
from uavnav.runs.policies import load_policy
from uavnav.runs.tables import RunError
from uavnav.training import machine
from uavnav.training.recorder import Interrupted
from uavnav.training.workers import split, wall_seconds

pytestmark = pytest.mark.usefixtures("warm_module")

SMALL = {"total_frames": 1024, "frames_per_batch": 256, "epochs": 2, "compile": "off"}


def rows(run):
    return run.progress.drop(columns="frames_per_second")


def assert_same(one, other):
    pd.testing.assert_frame_equal(one.episodes, other.episodes)
    pd.testing.assert_frame_equal(rows(one), rows(other))
    theirs = load_file(other.path / POLICY)
    for name, tensor in load_file(one.path / POLICY).items():
        assert torch.equal(tensor, theirs[name])


def test_ten_seeds_from_5_in_4_processes_are_3_3_2_2(tmp_path):
    shares = split(PPOConfig(seed=5, n_seeds=10), tmp_path, 4)
    assert [config.seeds for config in shares.values()] == [[5, 6, 7], [8, 9, 10], [11, 12], [13, 14]]
    assert [path.name for path in shares] == ["seeds-5-7", "seeds-8-10", "seeds-11-12", "seeds-13-14"]


@pytest.fixture(scope="module")
def spread_run(tmp_path_factory):
    told = []
    config = PPOConfig(n_seeds=3, **SMALL)
    run = train(
        config, tmp_path_factory.mktemp("spread") / "run", quiet=True, processes=2, tell=lambda *now: told.append(now)
    )
    return run, told


def test_a_spread_run_holds_the_rows_and_weights_of_its_shares(spread_run, tmp_path):
    run, _ = spread_run
    first = train(PPOConfig(n_seeds=2, **SMALL), tmp_path / "first", quiet=True)
    last = train(PPOConfig(seed=2, **SMALL), tmp_path / "last", quiet=True)
    for seed, share in ((0, first), (1, first), (2, last)):
        for name in ("episodes", "progress"):
            mine, theirs = (getattr(one, name).query(f"seed == {seed}").reset_index(drop=True) for one in (run, share))
            assert len(mine) > 0
            pd.testing.assert_frame_equal(
                mine.drop(columns="frames_per_second", errors="ignore"),
                theirs.drop(columns="frames_per_second", errors="ignore"),
            )
        observation = torch.rand(5, 30)
        assert torch.equal(
            load_policy(run.path, seed).values(observation), load_policy(share.path, seed).values(observation)
        )
    assert run.meta["processes"] == 2
    assert run.seeds == [0, 1, 2]
    assert not (run.path / "checkpoint").exists()


@pytest.mark.slow
def test_its_rows_are_in_the_order_in_which_one_process_would_have_noted_them(spread_run, tmp_path):
    run, _ = spread_run
    whole = train(PPOConfig(n_seeds=3, **SMALL), tmp_path / "whole", quiet=True)
    n = len(whole.episodes[whole.episodes["frame"] <= 256])  # until the first update they fly alike
    columns = ["seed", "frame", "env", "layout"]
    pd.testing.assert_frame_equal(run.episodes[columns][:n], whole.episodes[columns][:n])
    assert run.progress["seed"].tolist() == whole.progress["seed"].tolist()
    assert run.progress["frame"].tolist() == whole.progress["frame"].tolist()


def test_100_s_beside_80_s_of_which_20_were_alone_and_50_s_after_a_pause_of_an_hour_are_170_s():
    def share(ended, took):
        return {"ended": f"2026-11-24T{ended}+00:00", "wall_seconds": took}

    together = [share("12:01:40", 100.0), share("12:02:00", 80.0)]
    assert wall_seconds(together) == 120
    assert wall_seconds([share("13:02:50", 50.0), *together]) == 170
    assert wall_seconds([share("12:01:40", 100.0), share("12:01:30", 10.0)]) == 100


def test_it_tells_how_far_all_seeds_are(spread_run):
    _, told = spread_run
    frames = [frames for frames, _ in told]
    assert frames == sorted(frames)
    assert frames[-1] == 1024
    assert len(told[-1][1]) == 3


def test_a_spread_run_that_is_stopped_and_resumed_is_the_run_that_was_not(spread_run, tmp_path):
    config = PPOConfig(n_seeds=3, **SMALL)
    with pytest.raises(Interrupted, match="saved at 512 of 1,024 frames") as stop:
        train(config, tmp_path / "run", quiet=True, processes=2, until=512)
    assert stop.value.wanted
    assert sorted(path.name for path in (tmp_path / "run" / "checkpoint").iterdir()) == ["seeds-0-1", "seeds-2-2"]
    (tmp_path / "run" / "checkpoint" / "seeds-0-1" / "stop").touch()  # as a study that was stopped leaves it
    assert_same(train(config, tmp_path / "run", quiet=True), spread_run[0])


@pytest.mark.slow
def test_verify_repeats_it_in_as_many_processes(spread_run):
    run = spread_run[0]
    assert verify(run, quiet=True).same
    verdict = verify(run, frames=300, quiet=True)
    assert verdict.same
    assert "at 512 frames per seed" in verdict.lines[0]


COMMAND = """
from uavnav.algorithms.ppo import PPOConfig, train
config = PPOConfig(n_seeds=3, total_frames=400_000, frames_per_batch=256, epochs=2, compile="off")
train(config, {out!r}, quiet=True, processes=2, checkpoint_seconds={seconds})
"""


def started(out, checkpoint_seconds=0):
    """A run in two processes, both at work; with 0 seconds between snapshots, both with one."""
    command = COMMAND.format(out=str(out), seconds=checkpoint_seconds)
    process = subprocess.Popen([sys.executable, "-c", command], stderr=subprocess.PIPE, text=True)
    sign = "meta.json" if checkpoint_seconds else "checkpoint/state-*"
    while len({path.parent for path in out.glob(f"checkpoint/seeds-*/{sign}")}) < 2:
        assert process.poll() is None
        time.sleep(0.05)
    return process


def locked(out):
    """Whether a process still writes a share."""
    return bool(list(out.glob("checkpoint/seeds-*/.lock")))


@pytest.mark.slow
def test_a_signal_is_passed_on_and_every_share_is_saved(tmp_path):
    process = started(tmp_path / "run")
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=60)
    assert "Interrupted" in said
    assert "stopped by SIGTERM and saved at" in said
    assert not locked(tmp_path / "run")


def holders(out):
    """The processes that write the shares, in the order of their seeds: each holds its share's lock open."""
    held = {}
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        with contextlib.suppress(OSError):
            held[os.readlink(link)] = int(link.parts[2])
    return [held[str(lock)] for lock in sorted(out.glob("checkpoint/seeds-*/.lock"))]


def saved(out):
    """The frames of each share's newest snapshot."""
    states = [path.glob("checkpoint/state-*") for path in sorted(out.glob("checkpoint/seeds-*"))]
    return [max(int(state.name.split("-")[1]) for state in found) for found in states]


@pytest.mark.slow
def test_a_signal_to_every_process_of_a_run_saves_both_shares_as_it_says(tmp_path):
    process = started(tmp_path / "run", checkpoint_seconds=3600)
    for member in (process.pid, *holders(tmp_path / "run")):
        os.kill(member, signal.SIGTERM)
    _, said = process.communicate(timeout=60)
    frames = saved(tmp_path / "run")
    assert len(frames) == 2
    assert f"stopped by SIGTERM and saved at {min(frames):,} of 400,000 frames" in said
    assert not locked(tmp_path / "run")


@pytest.mark.slow
@pytest.mark.parametrize(("number", "says"), [(signal.SIGTERM, "saved at"), (signal.SIGKILL, "ended without a word")])
def test_when_one_of_two_shares_is_ended_the_other_is_saved_and_ends_too(tmp_path, number, says):
    process = started(tmp_path / "run")
    os.kill(holders(tmp_path / "run")[1], number)
    _, said = process.communicate(timeout=60)
    assert says in said
    assert len(saved(tmp_path / "run")) == 2
    assert max(saved(tmp_path / "run")) < 400_000


@pytest.mark.slow
def test_a_share_that_is_killed_while_all_stop_is_said_not_to_be_saved(tmp_path):
    process = started(tmp_path / "run", checkpoint_seconds=3600)
    share = holders(tmp_path / "run")[1]
    os.kill(share, signal.SIGSTOP)
    process.send_signal(signal.SIGTERM)
    time.sleep(1)
    os.kill(share, signal.SIGKILL)
    _, said = process.communicate(timeout=60)
    assert "seeds-2-2: not saved" in said
    assert "saved at" not in said


@pytest.mark.slow
def test_no_share_outlives_a_run_that_was_killed(tmp_path):
    process = started(tmp_path / "run")
    process.kill()
    process.communicate(timeout=60)
    for _ in range(600):
        if not locked(tmp_path / "run"):
            break
        time.sleep(0.1)
    assert not locked(tmp_path / "run")
    assert len(list((tmp_path / "run").glob("checkpoint/seeds-*/checkpoint/state-*"))) >= 2


@pytest.mark.slow
def test_what_ails_one_share_ends_the_run_in_one_line(spread_run, tmp_path):
    config = PPOConfig(n_seeds=3, **SMALL)
    with pytest.raises(Interrupted):
        train(config, tmp_path / "run", quiet=True, processes=2, until=512)
    for state in (tmp_path / "run").glob("checkpoint/seeds-2-2/checkpoint/state-*"):
        state.write_bytes(state.read_bytes()[:-1])
    with pytest.raises(RunError, match=r"seeds-2-2.*damaged.*overwrite=true") as error:
        train(config, tmp_path / "run", quiet=True)
    assert "\n" not in str(error.value)
    assert_same(train(config, tmp_path / "run", quiet=True, overwrite=True, processes=2), spread_run[0])


@pytest.mark.slow
def test_dqn_spreads_as_well_and_its_memory_is_counted_for_all_seeds(tmp_path):
    settings = {"n_seeds": 2, "total_frames": 640, "learning_starts": 128, "compile": "off"}
    run = train_dqn(DQNConfig(**settings), tmp_path / "run", quiet=True, processes=2)
    assert run.progress["seed"].unique().tolist() == [0, 1]
    with pytest.raises(ConfigError, match="n_seeds=1000: the buffer would take"):
        train_dqn(DQNConfig(n_seeds=1000, compile="off"), tmp_path / "large", quiet=True, processes=2)
    assert not (tmp_path / "large").exists()


@pytest.mark.parametrize(
    ("config", "outputs"),
    [
        (PPOConfig(hidden=[200_000, 200_000]), "100"),
        (SACConfig(hidden=[200_000, 200_000]), "100"),
        (C51Config(n_atoms=10**8), "10,000,000,000"),
    ],
)
def test_networks_larger_than_the_machines_memory_are_refused_before_they_are_made(config, outputs):
    with pytest.raises(ConfigError, match=rf"n_seeds=1: networks of {outputs} outputs would take at least [\d,.]+ GiB"):
        config.check_machine()


def test_a_network_is_counted_with_its_moments_its_target_and_those_beside_it():
    told = []
    for config in (PPOConfig, DQNConfig, SACConfig):
        with pytest.raises(ConfigError) as refused:
            config(hidden=[200_000, 200_000]).check_machine()
        told.append(float(re.search(r"at least ([\d,.]+) GiB", str(refused.value))[1].replace(",", "")))
    assert told == pytest.approx([told[0], told[0] * 4 / 3, told[0] * 11 / 3], abs=0.2)


def test_a_projection_larger_than_the_machines_memory_is_refused():
    with pytest.raises(ConfigError, match="n_atoms=20000, batch_size=1000: the projection of a target would take at"):
        C51Config(n_atoms=20_000, batch_size=1000, hidden=[2]).check_machine()


def test_only_runs_that_are_compiled_are_spread_by_themselves(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(4)))
    assert machine.processes(PPOConfig(n_seeds=10)) == 4
    assert machine.processes(PPOConfig(n_seeds=3)) == 3
    assert machine.processes(PPOConfig(n_seeds=10, compile="off")) == 1
    assert machine.processes(PPOConfig(n_seeds=10, total_frames=1000)) == 1
    assert machine.processes(PPOConfig(n_seeds=10, total_frames=1000, compile="on")) == 4


def test_an_activation_of_ones_own_stays_in_the_process_that_knows_it(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    monkeypatch.setitem(networks.ACTIVATIONS, "mine", torch.sin)
    assert machine.processes(PPOConfig(n_seeds=10, activation="mine")) == 1
    monkeypatch.setitem(networks.ACTIVATIONS, "tanh", torch.sin)
    assert machine.processes(PPOConfig(n_seeds=10, activation="tanh")) == 1


@pytest.mark.parametrize("function", [train, train_dqn])
def test_training_shows_the_9_arguments_that_it_takes(function):
    names = ["config", "out", "overwrite", "quiet", "checkpoint_seconds", "until", "tell", "processes", "logger"]
    assert list(inspect.signature(function).parameters) == names
    assert inspect.signature(function).parameters["config"].annotation == "TrainConfig"


@pytest.mark.parametrize("processes", [0, -1, 4, 2.5, True])
def test_processes_are_a_whole_number_up_to_the_number_of_seeds(processes, tmp_path):
    with pytest.raises(ConfigError, match=r"processes=.*; give a whole number from 1 to n_seeds=3"):
        train(PPOConfig(n_seeds=3, **SMALL), tmp_path / "run", quiet=True, processes=processes)
    assert not (tmp_path / "run").exists()


def test_an_activation_of_ones_own_in_two_processes_is_refused_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setitem(networks.ACTIVATIONS, "mine", torch.sin)
    with pytest.raises(ConfigError, match="activation=mine is known to this process alone; give processes=1"):
        train(PPOConfig(n_seeds=2, activation="mine", **SMALL), tmp_path / "run", quiet=True, processes=2)
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_snapshot_without_any_row_yet_is_two_empty_tables(tmp_path):
    """DQN's first row of progress comes at 4,992 frames."""
    run = train_dqn(DQNConfig(n_seeds=2, total_frames=640, compile="off"), tmp_path / "run", quiet=True, processes=2)
    verdict = verify(run, frames=64, quiet=True)
    assert verdict.same


@pytest.mark.slow
def test_a_report_beside_a_run_under_way_does_not_take_its_shares_for_runs(tmp_path):
    from uavnav.runs import run_folders

    with pytest.raises(Interrupted):
        train(PPOConfig(n_seeds=3, **SMALL), tmp_path / "run", quiet=True, processes=2, until=512)
    assert run_folders(tmp_path)[0] == [tmp_path / "run"]
