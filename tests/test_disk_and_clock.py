"""A disk that is full or read-only, a folder that goes away, a second process, and a clock that is set back.

Each is one line; the same command then goes on, and ends with the bits of a run that nothing befell. A test
that needs a disk of its own mounts one, and is skipped where that is not allowed.
"""

import contextlib
import functools
import itertools
import json
import shutil
import subprocess
import sys
import time

import pandas as pd
import pytest
import yaml
from warm import FIRST

from uavnav import RunError
from uavnav.__main__ import main
from uavnav.algorithms import ppo
from uavnav.cli import runs as listing
from uavnav.errors import MOST
from uavnav.evaluation import evaluate_run
from uavnav.runs import POLICY, PROGRESS, Run
from uavnav.training import heartbeat, workers
from uavnav.training.recorder import Interrupted, Recorder

pytestmark = pytest.mark.usefixtures("warm_module")

SMALL = {"total_frames": 256, "n_envs": 2, "hidden": [4], "compile": "off", "n_seeds": 2}
SMALL |= {"frames_per_batch": 64, "minibatch_size": 32, "epochs": 1}
LONGER = 2_048 if sys.platform == "linux" else 4_096
"""Frames of a run in two processes. Each says 20 times a second how far it is. Where `FIRST` cannot tell it
to, it does so twice a second, and the run is longer.
"""
WORDS = [f"{key}={value}".replace(" ", "") for key, value in SMALL.items()]
HOUR = 3600.0


class Disk:
    """Four megabytes that a test fills, or makes read-only."""

    def __init__(self, path):
        self.path, self._frozen = path, False

    def fill(self):
        with contextlib.suppress(OSError), open(self.path / "ballast", "wb", buffering=0) as ballast:
            while True:
                ballast.write(bytes(4096))

    def free(self):
        (self.path / "ballast").unlink()

    def freeze(self):
        """By a mount of the disk over itself: what is open for writing would forbid another."""
        mount("--bind", self.path, self.path)
        mount("-o", "remount,bind,ro", self.path)
        self._frozen = True

    def thaw(self):
        subprocess.run(["umount", "-l", self.path], check=True)
        self._frozen = False

    def close(self):
        for _ in range(1 + self._frozen):
            subprocess.run(["umount", "-l", self.path], check=False)


def mount(*words):
    subprocess.run(["mount", *words], check=True, capture_output=True)


@pytest.fixture
def disk(tmp_path):
    path = tmp_path / "disk"
    path.mkdir()
    try:
        mount("-t", "tmpfs", "-o", "size=4m", "tmpfs", path)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no disk can be mounted here: {error}")
    found = Disk(path)
    yield found
    found.close()


TROUBLES = {"full": (Disk.fill, Disk.free), "read-only": (Disk.freeze, Disk.thaw)}


def train(folder, processes=1, **how):
    frames = {"total_frames": LONGER} if processes > 1 else {}
    return ppo.train(ppo.PPOConfig(**SMALL | frames), folder, quiet=True, processes=processes, **how)


@pytest.fixture(scope="module", autouse=True)
def often():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(FIRST, "from uavnav.training import heartbeat; heartbeat.WATCHED_SECONDS = 0.05")
        patch.setattr(workers, "POLL_SECONDS", 0.02)
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The run that nothing befell, by its number of processes; the first was evaluated for 5 steps, as long
    as a report then flies the scripted policy.
    """
    folder = tmp_path_factory.mktemp("whole")
    runs = {n: train(folder / str(n), processes=n) for n in (1, 2)}
    evaluate_run(runs[1], episodes=3, max_steps=5, quiet=True)
    return {n: run.path for n, run in runs.items()}


def assert_same(path, whole):
    for name in ("episodes.parquet", POLICY):
        assert (path / name).read_bytes() == (whole / name).read_bytes()
    rows = (Run(one).progress.drop(columns="frames_per_second") for one in (path, whole))
    pd.testing.assert_frame_equal(*rows, check_exact=True)


def one_line(error, fragment, capfd):
    assert "\n" not in str(error.value)
    assert len(str(error.value)) <= MOST
    assert fragment in str(error.value)
    assert "Traceback" not in capfd.readouterr().err  # of a worker


def asides(folder):
    return [path for path in folder.rglob(".*") if path.name != ".lock"]


@contextlib.contextmanager
def once(act, frames=64):
    """What a run is told to call: it acts when so many frames are over."""
    acted = []

    def tell(now, rewards):
        if now >= frames and not acted:
            acted.append(now)
            act()

    yield tell
    assert acted


TWO = functools.partial(pytest.param, 2, marks=pytest.mark.slow)
"""Two processes, which take half a minute: each value of the other parameters once, not each combination."""


# -- a full and a read-only disk -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("processes", "seconds", "trouble"),
    [*itertools.product([1], [0, 3600], TROUBLES), TWO(0, "full"), TWO(3600, "read-only")],
)
def test_a_run_whose_disk_gets_full_or_read_only_says_so_in_one_line_and_goes_on_later(
    trouble, processes, seconds, disk, whole, capfd
):
    begin, end = TROUBLES[trouble]
    how = {"processes": processes, "checkpoint_seconds": seconds}
    with once(lambda: begin(disk)) as tell, pytest.raises(RunError) as refused:
        train(disk.path / "run", tell=tell, **how)
    one_line(refused, "cannot be written", capfd)
    end(disk)
    assert not asides(disk.path)
    assert json.loads((disk.path / "run" / "meta.json").read_text())["status"] != "finished"
    assert_same(train(disk.path / "run", **how).path, whole[processes])
    assert not (disk.path / "run" / "checkpoint").exists()


COMMANDS = {
    "train": (["train", "ppo", *WORDS, "evaluate=false", "out={}/new"], "new/" + POLICY),
    "evaluate": (
        ["evaluate", "{}/run", "--episodes", "2", "--max-steps", "5"],
        "run/evaluation-test-2-5.parquet",
    ),
    "evaluate, a script": (
        ["evaluate", "reactive", "--episodes", "2", "--max-steps", "5", "--out", "{}/new"],
        "new/reactive-test-2-5.parquet",
    ),
    "report": (["report", "{}/run", "--out", "{}/new"], "new/report.html"),
    "layouts": (["layouts", "--split", "test", "--n", "200", "--out", "{}/new"], "new/test.safetensors"),
    "render": (["render", "{}/run", "--steps", "2", "--out", "{}/new.png"], "new.png"),
    "study": (["study", "{}/study.yaml", "out={}/new", "report=false", "--quiet"], "new/ppo/tanh/" + POLICY),
}


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("command", "trouble"),
    [
        *((name, "full") for name in COMMANDS if name != "study"),
        pytest.param("study", "full", marks=pytest.mark.slow),
        ("train", "read-only"),
        ("report", "read-only"),
    ],
)
def test_a_command_on_such_a_disk_is_one_line_and_leaves_nothing_half_written(
    trouble, command, disk, whole, capfd
):
    begin, end = TROUBLES[trouble]
    words, leaves = COMMANDS[command]
    words = [word.replace("{}", str(disk.path)) for word in words]
    run = shutil.copytree(whole[1], disk.path / "run")
    configuration = {"algorithm": "ppo", **SMALL, "hidden": [[4]], "evaluate": False}
    (disk.path / "study.yaml").write_text(yaml.safe_dump({"configurations": [configuration]}))
    begin(disk)
    assert main(words) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith(f"uavnav {words[0]}: ")
    assert len(line) <= MOST + 30
    end(disk)
    assert not asides(disk.path)
    assert not (disk.path / leaves).exists()
    assert_same(run, whole[1])
    assert main(words) == 0
    assert (disk.path / leaves).exists()


# -- a folder that goes away ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("processes", "seconds", "told"),
    [*itertools.product([1], [0, 3600], [0.01, 3600.0]), TWO(0, 0.01), TWO(3600, 3600.0)],
)
def test_a_run_whose_folder_is_removed_says_so_in_one_line_and_begins_anew(
    processes, seconds, told, tmp_path, whole, monkeypatch, capfd
):
    monkeypatch.setattr(heartbeat, "SECONDS", told)
    folder, how = tmp_path / "run", {"processes": processes, "checkpoint_seconds": seconds}

    def remove():
        folder.rename(tmp_path / "removed")  # at once, whoever is writing there
        shutil.rmtree(tmp_path / "removed")

    with once(remove) as tell, pytest.raises(RunError) as refused:
        train(folder, tell=tell, **how)
    one_line(refused, f"{folder.parent.name}/{folder.name}", capfd)
    assert_same(train(folder, **how).path, whole[processes])


@pytest.mark.parametrize(("processes", "seconds"), [(1, 0), (1, 3600), TWO(0)])
def test_a_run_whose_folder_is_renamed_says_so_in_one_line_and_goes_on_under_the_old_name(
    processes, seconds, tmp_path, whole, capfd
):
    folder, other = tmp_path / "run", tmp_path / "other"
    how = {"processes": processes, "checkpoint_seconds": seconds}
    with once(lambda: folder.rename(other)) as tell, pytest.raises(RunError) as refused:
        train(folder, tell=tell, **how)
    one_line(refused, f"{folder.parent.name}/{folder.name}", capfd)
    assert not asides(tmp_path)
    shutil.rmtree(folder, ignore_errors=True)
    other.rename(folder)
    assert_same(train(folder, **how).path, whole[processes])


# -- two processes -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("processes", [1, 2])
def test_a_second_process_with_the_folder_of_the_first_is_refused_in_one_line_and_the_first_ends_as_ever(
    processes, tmp_path, whole
):
    said = []

    def second():
        words = [sys.executable, "-m", "uavnav", "train", "ppo", *WORDS, f"out={tmp_path / 'run'}"]
        words += [f"total_frames={LONGER}"] if processes > 1 else []
        said.append(subprocess.run(words, capture_output=True, text=True, check=False))

    with once(second) as tell:
        run = train(tmp_path / "run", tell=tell, processes=processes)
    (line,) = said[0].stderr.splitlines()
    assert said[0].returncode == 2
    assert "another process is writing this run; wait for it" in line
    assert len(line) <= MOST + 30
    assert_same(run.path, whole[processes])


# -- a clock that is set -------------------------------------------------------------------------------------


@pytest.fixture
def clock(monkeypatch):
    """The time of day, which a test sets; what measures durations is not set."""
    real, offset = time.time, [0.0]
    monkeypatch.setattr(time, "time", lambda: real() + offset[0])

    def turn(seconds):
        offset[0] += seconds

    return turn


def test_a_run_whose_clock_goes_an_hour_back_and_forth_has_a_positive_time_and_rate(
    clock, tmp_path, whole, monkeypatch
):
    monkeypatch.setattr(heartbeat, "SECONDS", 0.01)
    rates, turns = [], [-HOUR, HOUR, -HOUR, HOUR]

    def tell(frames, rewards):
        with contextlib.suppress(FileNotFoundError):  # before the first word
            rates.append(json.loads((tmp_path / "run" / PROGRESS).read_text())["rate"])
        clock(turns.pop())

    run = train(tmp_path / "run", tell=tell, checkpoint_seconds=0)
    assert not turns
    assert 0 < run.meta["wall_seconds"] < HOUR
    assert all(rate is None or rate > 0 for rate in rates)
    assert (run.progress["frames_per_second"] > 0).all()
    assert_same(run.path, whole[1])


@pytest.fixture
def under_way(tmp_path):
    """The folder of a run that was stopped, with the word that it runs."""
    with pytest.raises(Interrupted):
        train(tmp_path / "run", until=64)
    meta = tmp_path / "run" / "meta.json"
    meta.write_text(json.dumps(json.loads(meta.read_text()) | {"status": "running"}))
    return tmp_path / "run"


@pytest.mark.parametrize(
    ("seconds", "status"), [(0, "running"), (30, "running"), (-HOUR, "stopped"), (HOUR, "stopped")]
)
def test_a_run_that_was_heard_an_hour_ago_or_in_an_hour_does_not_run_and_no_age_is_negative(
    seconds, status, under_way
):
    now = time.time()
    (under_way / PROGRESS).write_text(
        json.dumps({"frames": 64, "total": 256, "rate": 10.0, "at": now + seconds})
    )
    found = listing.row(under_way, now)
    assert found["status"] == status
    assert listing.row(under_way, now - HOUR)["age"] == 0
    assert found.get("seconds_left", 1) > 0


def test_a_snapshot_is_due_by_the_time_that_passes_and_not_by_the_clock(clock, tmp_path):
    config = ppo.PPOConfig(**SMALL)
    with Recorder(tmp_path / "run", config, checkpoint_seconds=600) as own:
        clock(HOUR)
        own.checkpoint(64, {})
        clock(-2 * HOUR)
        own.checkpoint(128, {})
    assert not (tmp_path / "run" / "checkpoint").exists()


def test_an_episode_that_is_evaluated_while_the_clock_is_set_has_the_same_rows(clock, whole, tmp_path):
    run = Run(shutil.copytree(whole[1], tmp_path / "run"))
    before = evaluate_run(run, episodes=2, max_steps=5, quiet=True)
    clock(-HOUR)
    assert evaluate_run(run, episodes=2, max_steps=5, quiet=True).equals(before)
