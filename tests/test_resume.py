"""Stopped at any moment and resumed, a run ends as if it had never stopped, bit for bit."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest
import torch
from bad_input import cut, doctored, flipped, state_facts, written
from runs_by_hand import same
from torchrl.data import LazyTensorStorage, ReplayBuffer

from uavnav import files
from uavnav.algorithms import dqn, ppo
from uavnav.envs.env import DroneEnv
from uavnav.runs import STOP, Run
from uavnav.runs.tables import RunError
from uavnav.training import checkpoints
from uavnav.training.recorder import Interrupted, Recorder

PACKAGE = Path(files.__file__).parent
ALGORITHMS = {
    "ppo": (
        ppo.train,
        ppo.PPOConfig(
            n_envs=64,
            n_seeds=2,
            total_frames=3072,
            frames_per_batch=512,
            minibatch_size=128,
            epochs=2,
            compile="off",
        ),
    ),
    "dqn": (
        dqn.train,
        dqn.DQNConfig(
            n_envs=64,
            n_seeds=2,
            total_frames=2048,
            learning_starts=256,
            frames_per_update=16,
            target_update_frames=512,
            lr=1e-3,
            compile="off",
        ),
    ),
    "dqn, a small ring": (
        dqn.train,
        dqn.DQNConfig(
            n_envs=64,
            n_seeds=2,
            total_frames=2048,
            learning_starts=64,
            frames_per_update=16,
            buffer_size=200,
            world={"start_heading": "random"},
            compile="off",
        ),
    ),
}


RINGS = ["dqn", pytest.param("dqn, a small ring", marks=pytest.mark.slow)]
of_ppo, of_dqn = (pytest.mark.parametrize("whole", [name], indirect=True) for name in ("ppo", "dqn"))
"""Marks of tests of what is the same for all algorithms."""


@pytest.fixture(scope="module", params=["ppo", *RINGS])
def whole(request, once):
    """An uninterrupted run, the same for all processes and not to be changed."""
    train, config = ALGORITHMS[request.param]
    folder = once(f"whole-{request.param}", lambda folder: train(config, out=folder / "run", quiet=True))
    return train, config, Run(folder / "run")


def stop_at(monkeypatch, frames, how):
    """Let `how(recorder)` happen when a run has so many frames behind it."""
    original = Recorder.checkpoint

    def checkpoint(self, now, parts, replay=None):
        if now >= frames:
            how(self)
        original(self, now, parts, replay)

    monkeypatch.setattr(Recorder, "checkpoint", checkpoint)


def interrupted(whole, folder, frames, number=signal.SIGINT):
    """A copy of the run, stopped by a signal after so many frames."""
    train, config, _ = whole
    with pytest.MonkeyPatch.context() as patch:
        stop_at(patch, frames, lambda recorder: os.kill(os.getpid(), number))
        with pytest.raises(Interrupted, match="the same command goes on from there") as stop:
            train(config, out=folder, quiet=True)
    assert stop.value.status == 128 + number
    assert json.loads((folder / "meta.json").read_text())["status"] == "interrupted"


@pytest.fixture(scope="module")
def stopped(whole, once):
    """Puts into a folder a copy of the run that was stopped after so many frames; each is trained once."""
    _, _, run = whole

    def copy(folder, *stops):
        def make(there):
            if len(stops) > 1:
                copy(there / "run", *stops[:-1])
            interrupted(whole, there / "run", stops[-1])

        name = "-".join(map(str, (run.path.parent.name, *stops)))
        return shutil.copytree(once(name, make) / "run", folder)

    return copy


def test_a_run_stopped_three_times_by_signals_and_resumed_ends_the_same(whole, tmp_path):
    train, config, run = whole
    before = signal.getsignal(signal.SIGINT)  # ignored, where the tests run behind a shell
    for number, frames in ((signal.SIGINT, 16), (signal.SIGTERM, 1000), (signal.SIGINT, 1600)):
        interrupted(whole, tmp_path / "run", frames, number)
    resumed = train(config, out=tmp_path / "run", quiet=True)
    same(run.path, resumed.path)
    assert signal.getsignal(signal.SIGINT) is before


def test_the_first_ctrl_c_on_a_terminal_says_what_happens_and_elsewhere_nothing(
    whole, tmp_path, monkeypatch, capfd
):
    interrupted(whole, tmp_path / "run", 16)
    assert capfd.readouterr().err == ""
    monkeypatch.setattr(type(sys.stderr), "isatty", lambda self: self is sys.stderr)
    interrupted(whole, tmp_path / "again", 16)
    assert capfd.readouterr().err.count("stopping: the run is saved after this iteration") == 1


class Killed(BaseException):
    """Stands for kill -9: nothing after it is run by the code under test."""


@pytest.mark.parametrize("survives", ["nothing", "a chunk", "half a file"])
def test_a_run_killed_while_it_saves_goes_on_from_the_snapshot_before(
    whole, stopped, tmp_path, monkeypatch, survives
):
    train, config, run = whole
    folder = stopped(tmp_path / "run", 1000)
    before = sorted(path.name for path in (folder / "checkpoint").iterdir())
    replace = os.replace

    def kill(source, target):
        name = Path(target).name
        if survives == "a chunk" and name.startswith("replay"):
            return replace(source, target)
        if name.startswith(("state", "replay")):
            if survives == "half a file":
                content = Path(source).read_bytes()
                Path(source).write_bytes(content[: len(content) // 2])
            raise Killed
        return replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", kill)
        with pytest.raises(Killed):
            train(config, out=folder, quiet=True, checkpoint_seconds=0)
    assert set(before) <= {path.name for path in (folder / "checkpoint").iterdir()}
    same(run.path, train(config, out=folder, quiet=True).path)


@pytest.fixture
def two_states(stopped, tmp_path):
    """A run stopped at 1000 and again at 1600 frames: two states in its checkpoint."""
    folder = stopped(tmp_path / "run", 1000, 1600)
    states = sorted((folder / "checkpoint").glob("state-*"))
    assert len(states) == 2
    return folder, states


@pytest.mark.parametrize("whole", RINGS, indirect=True)
def test_a_missing_chunk_of_the_newest_snapshot_falls_back_to_the_older(whole, two_states):
    train, config, run = whole
    folder, _ = two_states
    sorted((folder / "checkpoint").glob("replay-*"))[-1].unlink()
    with pytest.warns(UserWarning, match="missing or not readable; going on from the one before"):
        resumed = train(config, out=folder, quiet=True)
    same(run.path, resumed.path)


@of_dqn
def test_a_snapshot_whose_parts_are_others_is_refused_in_one_line(whole, stopped, tmp_path, monkeypatch):
    train, config, _ = whole
    stopped(tmp_path / "run", 1000)
    then = DroneEnv.state_dict
    monkeypatch.setattr(DroneEnv, "state_dict", lambda self: then(self) | {"late": torch.zeros(1)})
    with pytest.raises(
        RunError, match="its env is of another version, and there is no other; overwrite=true starts"
    ):
        train(config, out=tmp_path / "run", quiet=True)


def tensor(prefix, change):
    """Another first tensor whose name begins so, or none."""

    def doctor(tensors, header):
        name = next(name for name in sorted(tensors) if name.startswith(prefix))
        value = tensors.pop(name)
        if change is not None:
            tensors[name] = change(value).contiguous()

    return doctor


WRONG = {
    "no chunks": lambda tensors, header: {key: header[key] for key in header if key != "chunks"},
    "chunks elsewhere": lambda tensors, header: header | {"chunks": ["../../../../../../../../etc/passwd"]},
    "chunks that are numbers": lambda tensors, header: header | {"chunks": [3]},
    "a chunk that is a word": lambda tensors, header: header | {"chunks": "replay"},
    "a chunk of another name": lambda tensors, header: header | {"chunks": ["replay-0-0.safetensors"]},
    "facts a list": lambda tensors, header: header | {"facts": [1]},
    "identity a list": lambda tensors, header: header | {"identity": [1]},
    "a world that is a number": lambda tensors, header: (
        header | {"identity": header["identity"] | {"world": 3}}
    ),
    "a header of brackets": lambda tensors, header: "[" * 50_000,
    "frames a word": state_facts(frames="many"),
    "frames without end": state_facts(frames=10**20),
    "frames of another run": state_facts(frames=10**9),
    "wall time a word": state_facts(wall_seconds="long"),
    "columns a list": state_facts(columns=[]),
    "columns of one table": state_facts(columns={"episodes": []}),
    "columns that are not there": state_facts(columns={"episodes": ["seed", "height"], "progress": []}),
    "a column of numbers": state_facts(columns={"episodes": [3], "progress": []}),
    "a part missing": tensor("parts/env/observation", None),
    "a shape of another": tensor("parts/learner/state/params", lambda value: value[None]),
    "a type of another": tensor("parts/learner/state/params", lambda value: value.double()),
    "no state of a generator": tensor("parts/actions/generators", torch.zeros_like),
    "a column of two axes": tensor("episodes/frame", lambda value: value[:, None]),
    "another seed": tensor("episodes/seed", lambda value: value + 7),
}


DAMAGE = {"cut": cut(0.9), "flipped": flipped(-4), "empty": written(b"")}
ANY = DAMAGE | {name: doctored(change) for name, change in WRONG.items()}


@of_dqn
@pytest.mark.parametrize("kind", ANY)
def test_a_snapshot_that_is_damaged_or_not_this_runs_is_named_and_the_older_one_is_used(
    whole, two_states, monkeypatch, kind
):
    train, config, run = whole
    folder, states = two_states
    ANY[kind](states[-1])
    (newest,) = {*folder.glob("checkpoint/state-*")} - {states[0]}
    opened, read = [], files.read
    monkeypatch.setattr(
        files, "read", lambda path, *most: opened.append(Path(path).resolve()) or read(path, *most)
    )
    with (
        pytest.warns(UserWarning, match="going on from the one before") as warned,
        pytest.raises(Interrupted) as stop,
    ):
        train(config, out=folder, quiet=True, until=1.0)  # an iteration
    assert stop.value.frames == 1024 + 64
    assert "stopped by until=1 and saved at 1,088 of " in str(stop.value)
    said = str(warned[0].message)
    assert newest.stem[-7:] in said  # a long path is shortened
    assert ("its checksum does not match" in said) == (kind in DAMAGE)
    assert "\n" not in said
    assert len(said) < 330
    assert all(path.is_relative_to(folder.resolve()) or path.is_relative_to(PACKAGE) for path in opened)
    if kind == "cut":  # all go on from the same snapshot
        same(run.path, train(config, out=folder, quiet=True).path)


def test_a_chunk_of_other_rows_is_not_taken(whole, two_states):
    train, config, run = whole
    folder, states = two_states

    def others(tensors, header):  # PPO has none
        return header | {"chunks": header["chunks"][:1] * 2 or [f"replay-{0:012}-{0:032}.safetensors"]}

    doctored(others)(states[-1])
    with pytest.warns(UserWarning, match="going on from the one before"):
        resumed = train(config, out=folder, quiet=True)
    same(run.path, resumed.path)


def test_only_two_states_are_kept_and_a_chunk_is_written_once(whole, tmp_path, monkeypatch):
    train, config, _ = whole
    written = []
    original = checkpoints.Checkpoints._write

    def write(self, stem, tensors, header):
        written.append(stem)
        return original(self, stem, tensors, header)

    monkeypatch.setattr(checkpoints.Checkpoints, "_write", write)
    kept = []
    stop_at(monkeypatch, 0, lambda recorder: kept.append(len(list(recorder.path.glob("checkpoint/state-*")))))
    monkeypatch.setattr("uavnav.training.recorder.CHECKPOINT_SHARE", 1e9)  # a snapshot after every iteration
    train(config, out=tmp_path / "run", quiet=True, checkpoint_seconds=0)
    assert max(kept) == 2
    chunks = [stem for stem in written if stem.startswith("replay")]
    assert len(chunks) == len(set(chunks))
    assert bool(chunks) == (config.algorithm == "dqn")


RECIPES = Path(__file__).parent.parent / "recipes"
COMMANDS = {
    "ppo": [
        "preset=vectorised",
        "total_frames=8192",
        "frames_per_batch=512",
        "epochs=4",
        "n_seeds=2",
        "compile=off",
    ],
    "dqn": [
        "preset=vectorised",
        "total_frames=6144",
        "learning_starts=512",
        "frames_per_update=8",
        "n_seeds=2",
        "compile=off",
    ],
}


def start(algorithm, folder):
    words = [*COMMANDS[algorithm], f"out={folder}", "checkpoint_seconds=0.2", "evaluate=false"]
    return subprocess.Popen(
        [sys.executable, RECIPES / f"{algorithm}.py", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for(condition, process):
    deadline = time.monotonic() + 240
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.slow
@pytest.mark.usefixtures("warm")
@pytest.mark.parametrize("algorithm", list(COMMANDS))
def test_a_process_killed_twice_and_stopped_once_ends_as_one_that_never_was(algorithm, tmp_path):
    folder = tmp_path / "run"
    seen = set()
    for number in (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM):
        process = start(algorithm, folder)
        states = lambda: {path.name for path in folder.glob("checkpoint/state-*")}  # noqa: E731
        wait_for(lambda: len(states() - seen) >= 1, process)  # noqa: B023
        process.send_signal(number)
        _, err = process.communicate(timeout=240)
        seen = states()
        if number == signal.SIGTERM:
            assert process.returncode == 128 + signal.SIGTERM
            assert "stopped by SIGTERM and saved at" in err
            assert err.count("\n") == 1
        else:
            assert process.returncode == -signal.SIGKILL
    process = start(algorithm, folder)
    out, err = process.communicate(timeout=240)
    assert (process.returncode, err) == (0, "")
    assert f"the run is in {folder}" in out
    process = start(algorithm, tmp_path / "whole")
    assert process.wait(timeout=240) == 0, process.communicate()
    process.communicate()
    same(tmp_path / "whole", folder)
    shutil.rmtree(folder)


def test_a_file_that_a_kill_left_half_written_keeps_no_run_out_of_its_folder(tmp_path):
    half = tmp_path / "run" / ".config.yaml.7.aside"
    half.parent.mkdir()
    half.write_text("algor")
    config = ppo.PPOConfig(n_envs=4, total_frames=16, frames_per_batch=16, minibatch_size=16, compile="off")
    assert ppo.train(config, out=half.parent, quiet=True).frames == 16


def test_a_resume_repeats_the_threads_that_the_run_began_with(tmp_path, monkeypatch):
    config = ppo.PPOConfig(
        n_envs=16, n_seeds=4, total_frames=500, frames_per_batch=256, epochs=1, compile="off"
    )
    monkeypatch.setattr("uavnav.training.machine.threads", lambda config, processes: 2)
    with pytest.raises(Interrupted, match="saved at 256 of 512 frames"):
        ppo.train(config, out=tmp_path / "run", quiet=True, until=256)
    monkeypatch.setattr("uavnav.training.machine.threads", lambda config, processes: 1)
    before = torch.get_num_threads()
    run = ppo.train(config, out=tmp_path / "run", quiet=True)
    assert run.meta["threads"] == 2
    assert torch.get_num_threads() == before


@of_dqn
def test_a_damaged_snapshot_is_put_aside_and_does_not_count_among_the_two_that_are_kept(whole, two_states):
    folder, states = two_states
    flipped(-4)(states[-1])
    with pytest.warns(UserWarning, match="going on from the one before"):
        interrupted(whole, folder, 1200)
    kept = sorted(path.name for path in (folder / "checkpoint").glob("state-*"))
    assert [int(name.split("-")[1]) >= 1000 for name in kept] == [True, True]
    assert states[-1].name not in kept
    assert (folder / "checkpoint" / f"damaged-{states[-1].name}").is_file()
    train, config, run = whole
    flipped(-4)(folder / "checkpoint" / kept[-1])
    with pytest.warns(UserWarning, match="going on from the one before"):
        same(run.path, train(config, out=folder, quiet=True).path)


@of_ppo
def test_a_start_that_another_process_overtook_leaves_the_finished_run_as_it_is(whole, tmp_path):
    train, config, run = whole
    late = Recorder(tmp_path / "run", config)
    finished = train(config, out=tmp_path / "run", quiet=True)
    with pytest.raises(RunError, match="was finished by another process meanwhile"), late:
        pass
    same(run.path, finished.path)


@of_ppo
def test_a_stop_that_another_process_asked_for_counts_once(whole, tmp_path):
    train, config, run = whole
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / STOP).touch()
    with pytest.raises(Interrupted) as stop:
        train(config, out=folder, quiet=True)
    assert stop.value.status == 128 + signal.SIGTERM
    same(run.path, train(config, out=folder, quiet=True).path)


def test_chunks_that_hold_no_row_of_the_ring_any_more_are_deleted(tmp_path):
    """A ring of 100 rows, saved after 100, 200, ... 1,000: the last two states need two chunks of a
    hundred rows.
    """
    replay = ReplayBuffer(storage=LazyTensorStorage(100))
    saved = checkpoints.Checkpoints(tmp_path / "checkpoint", {})
    for frames in range(100, 1001, 100):
        replay.extend(torch.arange(frames - 100.0, frames)[:, None, None])
        saved.save(frames, {"n": torch.tensor(frames)}, {"frames": frames}, replay)
    kept = sorted(int(path.name.split("-")[1]) for path in (tmp_path / "checkpoint").glob("replay-*"))
    assert kept == [800, 900]
    for damaged in (False, True):
        if damaged:
            flipped(-4)(sorted((tmp_path / "checkpoint").glob("state-*"))[-1])
        again = ReplayBuffer(storage=LazyTensorStorage(100))
        with warnings.catch_warnings(action="ignore"):
            frames = checkpoints.Checkpoints(tmp_path / "checkpoint", {}).load(again).facts["frames"]
        assert frames == 1000 - 100 * damaged
        assert again[:].flatten().tolist() == [*range(frames - 100, frames)]


def test_a_ring_written_in_many_small_chunks_and_overwritten_between_snapshots_is_refilled_as_it_was(
    tmp_path, monkeypatch
):
    """A chunk of one row is shorter than the gap to where the ring begins."""
    monkeypatch.setattr(checkpoints, "CHUNK_BYTES", 1)
    train, config = ALGORITHMS["dqn, a small ring"]
    whole = train(config, out=tmp_path / "whole", quiet=True)
    for frames in (192, 1024):  # the first snapshot is at 192, the second after more than four rings
        with pytest.raises(Interrupted):
            train(config, out=tmp_path / "run", quiet=True, until=frames)
    assert len(list((tmp_path / "run" / "checkpoint").glob("replay-*"))) > 200
    train(config, out=tmp_path / "run", quiet=True)
    same(whole.path, tmp_path / "run")
