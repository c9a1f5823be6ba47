"""Seeds spread over workers: the same rows and weights as each worker by itself, however often it is
stopped.
"""

import contextlib
import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest
import torch
from runs_by_hand import same

from uavnav import networks
from uavnav.algorithms.c51 import C51Config
from uavnav.algorithms.dqn import DQNConfig
from uavnav.algorithms.dqn import train as train_dqn
from uavnav.algorithms.ppo import PPOConfig, train
from uavnav.algorithms.sac import SACConfig
from uavnav.cli import worker
from uavnav.errors import ConfigError
from uavnav.evaluation.verify import verify
from uavnav.runs import FILES, Run, run_folders
from uavnav.runs.policies import load_policy
from uavnav.runs.tables import RunError
from uavnav.training import machine, workers
from uavnav.training.recorder import Interrupted

pytestmark = pytest.mark.usefixtures("warm_module")

SMALL = {"preset": "vectorised", "total_frames": 1024, "frames_per_batch": 256, "epochs": 2, "compile": "off"}


def test_ten_seeds_from_5_in_4_processes_are_3_3_2_2(tmp_path):
    found = workers.split(PPOConfig(seed=5, n_seeds=10), tmp_path, 4)
    assert [worker.config.seeds for worker in found] == [[5, 6, 7], [8, 9, 10], [11, 12], [13, 14]]
    assert [worker.folder for worker in found] == [tmp_path / "workers" / str(number) for number in range(4)]


def test_a_worker_that_is_given_again_has_the_next_name_and_is_found_by_it(tmp_path):
    config = PPOConfig(n_seeds=11)
    for name in ("0", "0.1", "0.2"):
        first, *_, last = workers.split(config, tmp_path, 11)
        first.take()
        last.take()
        assert first.folder == tmp_path / "workers" / name
        (first.folder / "stop").touch()
        (first.folder / f"kept {name}").touch()
    assert {path.name for path in workers.split(config, tmp_path, 11)[0].folder.iterdir()} == {
        *("stop", "kept 0", "kept 0.1", "kept 0.2")
    }
    assert {path.name for path in (tmp_path / "workers").iterdir()} == {"0.2", "10.2"}


@pytest.fixture(scope="module")
def spread_run(once, warm_module):
    """And the frames that it told, each with the number of its seeds' rewards; the same for all processes."""

    def make(folder):
        told = []
        how = {"quiet": True, "processes": 2}
        how["tell"] = lambda frames, rewards: told.append((frames, len(rewards)))
        train(PPOConfig(n_seeds=3, **SMALL), folder / "run", **how)
        (folder / "told.json").write_text(json.dumps(told))

    folder = once("spread", make)
    return Run(folder / "run"), json.loads((folder / "told.json").read_text())


def test_a_spread_run_holds_the_rows_and_weights_of_its_workers(spread_run, tmp_path):
    run, _ = spread_run
    first = train(PPOConfig(n_seeds=2, **SMALL), tmp_path / "first", quiet=True)
    last = train(PPOConfig(seed=2, **SMALL), tmp_path / "last", quiet=True)
    for seed, part in ((0, first), (1, first), (2, last)):
        for name in ("episodes", "progress"):
            mine, theirs = (
                getattr(one, name).query(f"seed == {seed}").reset_index(drop=True) for one in (run, part)
            )
            assert len(mine) > 0
            pd.testing.assert_frame_equal(
                mine.drop(columns="frames_per_second", errors="ignore"),
                theirs.drop(columns="frames_per_second", errors="ignore"),
            )
        observation = torch.rand(5, 30)
        assert torch.equal(
            load_policy(run.path, seed).values(observation), load_policy(part.path, seed).values(observation)
        )
    assert run.meta["processes"] == 2
    assert run.seeds == [0, 1, 2]
    assert {path.name for path in run.path.iterdir()} == {*FILES}


@pytest.mark.slow
def test_its_rows_are_in_the_order_in_which_one_process_would_have_noted_them(spread_run, tmp_path):
    run, _ = spread_run
    whole = train(PPOConfig(n_seeds=3, **SMALL), tmp_path / "whole", quiet=True)
    n = len(whole.episodes[whole.episodes["frame"] <= 256])  # until the first update they fly alike
    columns = ["seed", "frame", "env", "layout"]
    pd.testing.assert_frame_equal(run.episodes[columns][:n], whole.episodes[columns][:n])
    assert run.progress["seed"].tolist() == whole.progress["seed"].tolist()
    assert run.progress["frame"].tolist() == whole.progress["frame"].tolist()


def test_it_tells_how_far_all_seeds_are(spread_run):
    _, told = spread_run
    frames = [frames for frames, _ in told]
    assert frames == sorted(frames)
    assert frames[-1] == 1024
    assert told[-1][1] == 3


@pytest.mark.parametrize("until", [512, 1024])  # also behind the last frame, before the run is written
def test_a_spread_run_that_is_stopped_and_resumed_is_the_run_that_was_not(until, spread_run, tmp_path):
    config = PPOConfig(n_seeds=3, **SMALL)
    with pytest.raises(Interrupted, match=f"saved at {until:,} of 1,024 frames") as stop:
        train(config, tmp_path / "run", quiet=True, processes=2, until=until)
    assert stop.value.wanted
    there = tmp_path / "run" / "workers"
    assert sorted(path.name for path in there.iterdir() if path.is_dir()) == ["0", "1"]
    assert run_folders(tmp_path)[0] == [tmp_path / "run"]  # a report takes no worker for a run
    (there / "0" / "stop").touch()  # as a study that was stopped leaves it
    same(spread_run[0].path, train(config, tmp_path / "run", quiet=True).path)


@pytest.mark.slow
def test_verify_repeats_it_in_as_many_processes(spread_run):
    run = spread_run[0]
    assert verify(run, quiet=True).same
    verdict = verify(run, frames=300, quiet=True)
    assert verdict.same
    assert "at 512 frames per seed" in verdict.lines[0]


COMMAND = """
from uavnav.algorithms.ppo import PPOConfig, train
config = PPOConfig(n_envs=16, n_seeds=3, total_frames=400_000, frames_per_batch=256, epochs=2, compile="off")
train(config, {out!r}, quiet=True, processes=2, checkpoint_seconds={seconds})
"""


def started(out, checkpoint_seconds=0):
    """A run in two workers, both at work; with 0 seconds between snapshots, both with one."""
    command = COMMAND.format(out=str(out), seconds=checkpoint_seconds)
    process = subprocess.Popen([sys.executable, "-c", command], stderr=subprocess.PIPE, text=True)
    sign = "meta.json" if checkpoint_seconds else "checkpoint/state-*"
    while len({path.parents[sign.count("/")] for path in out.glob(f"workers/*/{sign}")}) < 2:
        assert process.poll() is None
        time.sleep(0.05)
    return process


def locked(out):
    """Whether a process still writes as a worker."""
    return bool(list(out.glob("workers/*/.lock")))


def holders(out):
    """The processes of the workers, in the order of their seeds: each holds its lock open."""
    held = {}
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it may end meanwhile
            for link in (process / "fd").iterdir():
                with contextlib.suppress(OSError):  # or close it
                    held[os.readlink(link)] = int(process.name)
    return [held[str(lock)] for lock in sorted(out.glob("workers/*/.lock")) if str(lock) in held]


def saved(out):
    """The frames of each worker's newest snapshot."""
    states = [path.glob("checkpoint/state-*") for path in sorted(out.glob("workers/*")) if path.is_dir()]
    return [max(int(state.name.split("-")[1]) for state in found) for found in states]


@pytest.mark.slow
@pytest.mark.parametrize("whom", ["the run", "every process"])
def test_a_signal_saves_all_workers_as_the_run_says(whom, tmp_path):
    process = started(tmp_path / "run", checkpoint_seconds=3600)
    for member in (process.pid, *(holders(tmp_path / "run") if whom == "every process" else ())):
        os.kill(member, signal.SIGTERM)
    _, said = process.communicate(timeout=240)
    frames = saved(tmp_path / "run")
    assert len(frames) == 2
    assert f"stopped by SIGTERM and saved at {min(frames):,} of 400,128 frames" in said
    assert not locked(tmp_path / "run")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "says"), [(signal.SIGTERM, "saved at"), (signal.SIGKILL, "ended without a word")]
)
def test_when_one_of_two_workers_is_ended_the_other_is_saved_and_ends_too(tmp_path, number, says):
    process = started(tmp_path / "run")
    os.kill(holders(tmp_path / "run")[1], number)
    _, said = process.communicate(timeout=240)
    assert says in said
    assert len(saved(tmp_path / "run")) == 2
    assert max(saved(tmp_path / "run")) < 400_000


@pytest.mark.slow
def test_a_worker_that_does_not_end_when_it_is_asked_to_is_killed_and_said_not_to_be_saved(
    tmp_path, monkeypatch
):
    config = PPOConfig(n_seeds=2, **SMALL | {"total_frames": 400_000})
    monkeypatch.setattr(workers, "STOP_SECONDS", 3.0)
    monkeypatch.setattr(workers, "END_SECONDS", 1.0)

    def stop_one(frames, rewards):
        if len(there := holders(tmp_path / "run")) == 2:
            os.kill(there[1], signal.SIGSTOP)
            os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(Interrupted, match=r"workers/1: not saved"):
        train(config, tmp_path / "run", quiet=True, processes=2, checkpoint_seconds=3600, tell=stop_one)
    assert [*tmp_path.glob("run/workers/0/checkpoint/state-*")]
    assert not holders(tmp_path / "run")


@pytest.mark.slow
def test_no_worker_outlives_a_run_that_was_killed(tmp_path):
    process = started(tmp_path / "run")
    process.kill()
    process.communicate(timeout=240)
    for _ in range(600):
        if not locked(tmp_path / "run"):
            break
        time.sleep(0.1)
    assert not locked(tmp_path / "run")
    assert len(saved(tmp_path / "run")) == 2


@pytest.mark.slow
def test_a_run_whose_processes_are_killed_again_and_again_ends_with_the_same_bits(tmp_path):
    """At moments by chance: the run alone, one of its workers, or all of them."""
    config = {
        "n_envs": 16,
        "n_seeds": 3,
        "total_frames": 10_240,
        "frames_per_batch": 256,
        "epochs": 2,
        "compile": "off",
    }
    command, out, chance = COMMAND.replace("400_000", "10_240"), tmp_path / "run", random.Random(0)
    for whom in (slice(1), slice(1, 2), slice(3), slice(1)):
        process = subprocess.Popen([sys.executable, "-c", command.format(out=str(out), seconds=0.1)])
        while process.poll() is None and len(holders(out)) < 2:
            time.sleep(0.05)
        time.sleep(chance.uniform(0.0, 1.5))
        for member in [process.pid, *holders(out)][whom]:
            with contextlib.suppress(ProcessLookupError):  # it has just ended
                os.kill(member, signal.SIGKILL)
        process.wait(240)
    run = train(PPOConfig(**config), out, quiet=True, processes=2)
    same(train(PPOConfig(**config), tmp_path / "whole", quiet=True, processes=2).path, run.path)


@pytest.mark.slow
def test_what_ails_one_worker_ends_the_run_in_one_line(spread_run, tmp_path):
    config = PPOConfig(n_seeds=3, **SMALL)
    with pytest.raises(Interrupted):
        train(config, tmp_path / "run", quiet=True, processes=2, until=512)
    for state in (tmp_path / "run").glob("workers/1/checkpoint/state-*"):
        state.write_bytes(state.read_bytes()[:-1])
    with pytest.raises(RunError, match=r"workers/1.*damaged.*overwrite=true") as error:
        train(config, tmp_path / "run", quiet=True)
    assert "\n" not in str(error.value)
    same(spread_run[0].path, train(config, tmp_path / "run", quiet=True, overwrite=True, processes=2).path)


@pytest.mark.parametrize("disk", ["well", "full"])
def test_what_a_worker_stumbles_over_is_said_in_one_line_also_where_it_cannot_be_written(
    disk, tmp_path, monkeypatch, capsys
):
    def stumble(*given, **how):
        if disk == "full":
            monkeypatch.setattr(worker.files, "write", lambda *given: Path("/dev/full").write_bytes(b"."))
        raise TypeError("no number")

    monkeypatch.setattr(worker, "STOPS", ())
    monkeypatch.setattr(worker.loop, "alone", stumble)
    own, status = workers.Worker(tmp_path / "0", PPOConfig(**SMALL)), 0
    try:
        worker.main(own.prepare(1))
    except SystemExit as end:
        status = end.code
    assert own.problem(status).startswith(
        f"{own.folder}: " + {"well": "TypeError: no", "full": "cannot be w"}[disk]
    )
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.slow
def test_dqn_spreads_as_well_also_before_its_first_row_and_its_memory_is_counted_for_all_seeds(tmp_path):
    settings = {"n_envs": 64, "n_seeds": 2, "total_frames": 640, "learning_starts": 128, "compile": "off"}
    run = train_dqn(DQNConfig(**settings), tmp_path / "run", quiet=True, processes=2)
    assert run.progress["seed"].unique().tolist() == [0, 1]
    assert run.progress["frame"].min() > 64
    assert verify(run, frames=64, quiet=True).same  # a snapshot of two empty tables
    with pytest.raises(ConfigError, match="n_seeds=1000: the buffer would take"):
        train_dqn(DQNConfig(n_seeds=1000, compile="off"), tmp_path / "large", quiet=True, processes=2)
    assert not (tmp_path / "large").exists()


@pytest.mark.parametrize(
    ("config", "outputs"),
    [
        (PPOConfig(hidden=[200_000, 200_000]), "100"),
        (SACConfig(hidden=[200_000, 200_000]), "100"),
        (C51Config(n_atoms=10**7), "1,000,000,000"),
    ],
)
def test_networks_larger_than_the_machines_memory_are_refused_before_they_are_made(config, outputs):
    with pytest.raises(
        ConfigError, match=rf"n_seeds=1: networks of {outputs} outputs would take at least [\d,.]+ GiB"
    ):
        config.check_machine()


def test_a_network_is_counted_with_its_moments_its_target_and_those_beside_it():
    told = []
    for config in (PPOConfig, DQNConfig, SACConfig):
        with pytest.raises(ConfigError) as refused:
            config(hidden=[200_000, 200_000]).check_machine()
        told.append(float(re.search(r"at least ([\d,.]+) GiB", str(refused.value))[1].replace(",", "")))
    assert told == pytest.approx([told[0], told[0] * 4 / 3, told[0] * 11 / 3], abs=0.2)


def test_a_projection_larger_than_the_machines_memory_is_refused():
    with pytest.raises(
        ConfigError, match="n_atoms=20000, batch_size=1000: the projection of a target would take at"
    ):
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


@pytest.mark.parametrize("processes", [0, -1, 4, 2.5, True])
def test_processes_are_a_whole_number_up_to_the_number_of_seeds(processes, tmp_path):
    with pytest.raises(ConfigError, match=r"processes=.*; give a whole number from 1 to n_seeds=3"):
        train(PPOConfig(n_seeds=3, **SMALL), tmp_path / "run", quiet=True, processes=processes)
    assert not (tmp_path / "run").exists()


def test_an_activation_of_ones_own_in_two_processes_is_refused_before_anything_is_written(
    tmp_path, monkeypatch
):
    monkeypatch.setitem(networks.ACTIVATIONS, "mine", torch.sin)
    line = "processes=2: activation=mine is known only to this process; give processes=1"
    with pytest.raises(ConfigError, match=line):
        train(PPOConfig(n_seeds=2, activation="mine", **SMALL), tmp_path / "run", quiet=True, processes=2)
    assert not (tmp_path / "run").exists()


def test_a_spread_run_took_as_long_as_the_slower_of_its_workers(tmp_path, monkeypatch):
    read = workers.Run

    def timed(folder):
        run = read(folder)
        run.meta["wall_seconds"] = {"0": 80.0, "1": 100.0}[folder.stem]
        return run

    monkeypatch.setattr(workers, "Run", timed)
    run = train(PPOConfig(n_seeds=2, **SMALL), tmp_path / "run", quiet=True, processes=2)
    assert run.meta["wall_seconds"] == 100.0
