"""Whether a job of a study lives is what it says itself: engines that lie, wait, or say nothing do not
stop a study.
"""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from uavnav.algorithms.ppo import PPOConfig
from uavnav.cli import worker
from uavnav.evaluation import Protocol
from uavnav.evaluation.verify import _parting as parting
from uavnav.report import mine
from uavnav.runs import PROGRESS, STOP, Run, progress
from uavnav.runs.tables import RunError
from uavnav.studies import Configuration, run
from uavnav.studies.engines import logged
from uavnav.studies.engines.local import Local
from uavnav.studies.run import Runner
from uavnav.training import heartbeat, workers
from uavnav.training.heartbeat import Heartbeat
from uavnav.training.loop import train
from uavnav.training.recorder import Interrupted, Recorder

CONFIG = PPOConfig(
    n_envs=16,
    n_seeds=2,
    total_frames=2_048,
    frames_per_batch=256,
    minibatch_size=64,
    epochs=1,
    hidden=(8,),
    compile="off",
)
FLOWN = Protocol(episodes=2, max_steps=20)


class Engine(Local):
    """This machine's cores, and what each test makes of them."""

    def __init__(self, jobs=2):
        super().__init__(jobs)
        self.given = 0

    def start(self, jobs):
        self.given += len(jobs)
        return super().start(jobs)


class NeverEnds(Engine):
    def ended(self, job):
        return False


class NeverBegins(Engine):
    def start(self, jobs):
        self.given += len(jobs)
        return [None for _ in jobs]

    def ended(self, job):
        return False

    def cancel(self, job):
        pass


class InAQueue(NeverBegins):
    asked = 0

    def queued(self, job):
        self.asked += 1
        return self.asked < 3


class NeverSpeaks(Engine):
    """Its jobs begin, and hang before they say a word."""

    def start(self, jobs):
        return super().start([logged(["-c", "import time; time.sleep(60)"], words[3]) for words in jobs])


class NoMachine(Engine):
    def slots(self):
        return 0


class NoAnswer(Engine):
    def slots(self):
        time.sleep(60)


class Clock:
    """Time that passes only where somebody waits."""

    def __init__(self):
        self.now = 1_000.0

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


@pytest.fixture
def study(tmp_path, warm):
    """Carries one configuration out on an engine; gives the configurations that failed and what was said."""
    engines = []

    def carry_out(engine, config=CONFIG, evaluations=(FLOWN,), **how):
        engines.append(engine)
        said = []
        out = tmp_path / "out" / "ppo" / "tanh"
        configuration = Configuration(config, out, evaluations, study="theirs")
        failed = Runner(tmp_path / "out", [configuration], engine, say=said.append, **how).run()
        return failed, said

    yield carry_out
    for engine in engines:
        engine.close()


@pytest.fixture(scope="module")
def alone(once):
    """The run of one process, the same for all tests and not to be changed."""

    def make(folder):
        train(CONFIG, folder / "run", quiet=True, processes=1)

    return Run(once("liveness", make) / "run")


def impatient(monkeypatch, **seconds):
    for name, value in ({"POLL": 0.05, "SAY": 0.3, "IDLE": 1.0} | seconds).items():
        monkeypatch.setattr(run, f"{name}_SECONDS", value)
    monkeypatch.setattr(heartbeat, "SECONDS", 0.2)


def test_a_study_whose_engine_never_tells_an_end_ends_with_the_same_rows(study, tmp_path):
    failed, said = study(NeverEnds(), seeds_per_worker=1)
    assert failed == []
    assert said[-1].endswith("finished")
    alone = train(CONFIG, tmp_path / "alone", quiet=True, processes=2)
    there = Run(tmp_path / "out" / "ppo" / "tanh")
    assert not parting("episodes", alone.episodes, there.episodes)
    assert not parting("progress", alone.progress, there.progress)


def test_an_evaluation_whose_engine_never_tells_its_end_is_seen_to_end(study, alone, tmp_path):
    shutil.copytree(alone.path, tmp_path / "out" / "ppo" / "tanh")
    failed, _ = study(NeverEnds())
    assert failed == []
    left = {path.name for path in (tmp_path / "out" / "ppo" / "tanh").iterdir()}
    assert "evaluation-test-2-20.parquet" in left
    assert PROGRESS not in left
    assert not [name for name in left if name.startswith(run.EPISODES)]


def test_an_evaluation_that_is_killed_is_given_again_and_one_that_is_refused_is_not(study, alone, tmp_path):
    there = shutil.copytree(alone.path, tmp_path / "out" / "ppo" / "tanh")

    class Killed(Engine):
        def start(self, jobs):
            handles = super().start(jobs)
            if self.given == 1:
                handles[0].kill()
            return handles

    engine = Killed()
    failed, said = study(engine)
    assert (failed, engine.given) == ([], 2)
    assert said[0].endswith("the job of its evaluation is gone; given again")
    (there / "evaluation-test-2-20.parquet").unlink()
    (there / "policy.safetensors").write_bytes(b"damaged")
    engine = Engine()
    (failed,), _ = study(engine)
    assert engine.given == 1
    assert failed.problem.startswith("was not evaluated, see ")


def test_a_job_that_falls_silent_is_ended_and_its_worker_given_again_from_its_snapshot(
    study, alone, tmp_path, monkeypatch
):
    impatient(monkeypatch, SILENT=12.0, IDLE=600.0)
    stops_itself = """
import os, runpy, signal
from uavnav.training.checkpoints import Checkpoints

save = Checkpoints.save

def save_and_stop(*given):
    save(*given)
    os.kill(os.getpid(), signal.SIGSTOP)

Checkpoints.save = save_and_stop
runpy.run_module("uavnav.cli.worker", run_name="__main__", alter_sys=True)
"""

    class Stopped(Engine):
        """Its first job is stopped as soon as it has a snapshot, as by a machine that swaps or is cut off."""

        def start(self, jobs):
            if not self.given:
                (words,) = jobs
                place = words.index("-m")
                words[place : place + 2] = ["-c", stops_itself]
            return super().start(jobs)

    engine = Stopped()
    failed, said = study(engine, evaluations=(), seeds_per_worker=2, checkpoint_seconds=0)
    assert (failed, engine.given) == ([], 2)
    assert any(re.search(r"has been silent for \d\d s and counts as dead", line) for line in said)
    assert any("its job is gone; given again, from its last snapshot" in line for line in said)
    assert not parting("episodes", alone.episodes, Run(tmp_path / "out" / "ppo" / "tanh").episodes)


def test_a_job_that_never_speaks_is_given_four_times_and_then_fails_in_one_line(study, monkeypatch):
    impatient(monkeypatch, BEGIN=0.5, IDLE=60.0)
    engine = NeverSpeaks()
    (failed,), _ = study(engine, seeds_per_worker=2)
    assert engine.given == 1 + run.ATTEMPTS
    assert "its job ended 4 times without a word, see " in failed.problem
    assert "\n" not in failed.problem


def test_a_job_that_an_engine_does_not_begin_is_given_again_as_often_as_needed(study, monkeypatch):
    """As on a cluster whose machines are busy with others' work."""

    class Busy(NeverBegins):
        free = False

        def start(self, jobs):
            self.free = self.given > run.ATTEMPTS
            return Engine.start(self, jobs) if self.free else super().start(jobs)

        def ended(self, job):
            return self.free and Engine.ended(self, job)

        def cancel(self, job):
            return Engine.cancel(self, job) if self.free else None

    impatient(monkeypatch, QUEUE=0.3, IDLE=60.0)
    monkeypatch.setattr(run, "BEGIN_SECONDS", 60.0)
    engine = Busy()

    def begin(self):
        return self.file("log").exists() or engine.free

    monkeypatch.setattr(run.Job, "begun", property(begin))
    failed, said = study(engine, seeds_per_worker=2, evaluations=())
    assert (failed, engine.given) == ([], 2 + run.ATTEMPTS)
    assert sum("has not begun for" in line for line in said) == 1 + run.ATTEMPTS


@pytest.mark.parametrize(
    ("engine", "waits"),
    [(NoMachine(), "waiting for a machine for 1 jobs"), (NeverBegins(), "waiting for 1 jobs to begin")],
)
def test_a_study_says_what_it_waits_for_and_does_not_wait_without_end(engine, waits, tmp_path, monkeypatch):
    impatient(monkeypatch)
    monkeypatch.setattr(run, "time", Clock())
    said = []
    configuration = Configuration(CONFIG, tmp_path / "out" / "ppo" / "tanh")
    with pytest.raises(
        RunError, match=f"no job has lived for 1 s, {waits}; engine=.* has . slots; the same command"
    ):
        Runner(tmp_path / "out", [configuration], engine, seeds_per_worker=2, say=said.append).run()
    assert 2 <= len(said) <= 3
    assert all(waits in line for line in said)


def test_a_study_waits_for_longer_where_its_engine_says_that_jobs_are_queued(study, monkeypatch):
    impatient(monkeypatch)
    monkeypatch.setattr(run, "time", Clock())
    engine = InAQueue()
    with pytest.raises(RunError, match="1 jobs to begin"):
        study(engine, seeds_per_worker=2)
    assert engine.asked == 3


def test_an_engine_that_does_not_answer_for_an_hour_ends_a_study_in_one_line(study, monkeypatch):
    impatient(monkeypatch, ANSWER=0.3)
    with pytest.raises(RunError, match=r"engine=noanswer:? does not answer.*; the same command goes on"):
        study(NoAnswer())


def test_a_job_that_lingers_after_its_last_words_is_ended_and_gives_its_place_free(tmp_path):
    class Lingers(NeverEnds):
        def __init__(self):
            super().__init__()
            self.cancelled = []

        def cancel(self, job):
            self.cancelled.append(job)

    engine, configuration = Lingers(), Configuration(CONFIG, tmp_path / "out" / "ppo" / "tanh")
    carried = Runner(tmp_path / "out", [configuration], engine)
    before, now = (run.Job(run.Work(configuration), None, handle=name) for name in ("before", "now"))
    carried._leaving = [(time.monotonic() - run.SILENT_SECONDS - 1, before), (time.monotonic(), now)]
    carried._end_what_lingers()
    assert engine.cancelled == ["before"]
    assert [job for _, job in carried._leaving] == [now]


def test_an_engine_that_is_slow_now_and_then_ends_no_job(study, monkeypatch):
    class Slow(Engine):
        asked = 0

        def ended(self, job):
            self.asked += 1
            time.sleep(8.0 if self.asked == 1 else 0.0)
            return super().ended(job)

    impatient(monkeypatch, ANSWER=6.0, SAY=60.0, IDLE=600.0)
    engine = Slow()
    failed, said = study(engine, seeds_per_worker=2, evaluations=())
    assert (failed, engine.given) == ([], 1)
    assert len(said) == 1


@pytest.mark.parametrize("missing", [0, 1])
def test_a_study_that_is_stopped_asks_workers_that_train_to_save_and_waits_for_none_that_flies(
    missing, study, tmp_path, monkeypatch
):
    class Busy(Engine):
        def start(self, jobs):
            for words in jobs:
                log = Path(words[3])
                log.touch()
                heartbeat.tell(log.with_suffix(""), CONFIG.frames - missing, CONFIG.frames, None)
            return super().start([["sleep", "60"] for _ in jobs])

    impatient(monkeypatch)
    monkeypatch.setattr(workers, "STOP_SECONDS", 0.1)
    with pytest.raises(Interrupted, match="stopped by SIGTERM"):
        study(Busy(), tell=lambda works: os.kill(os.getpid(), signal.SIGTERM))
    assert len([*tmp_path.rglob(STOP)]) == missing
    assert mine.unfinished([tmp_path]) == {}  # it is the study's


def test_a_check_of_machines_that_lasts_is_told_and_has_an_end(study, monkeypatch):
    class Queue(Engine):
        def check(self, folder):
            time.sleep(60)

    impatient(monkeypatch, SAY=0.2, CHECK=0.7)
    said = []
    configuration = Configuration(CONFIG, Path("unused"))
    monkeypatch.setattr(run.Recorder, "__init__", lambda *anything: None)
    with pytest.raises(RunError, match=r"engine=queue: does not answer for \d+ s; the same command goes on"):
        Runner(Path("unused"), [configuration], Queue(), say=said.append)._check_engine()
    assert 1 <= len(said) <= 3
    why = "its machines are checked, which may wait in a queue"
    assert re.fullmatch(rf"engine=queue: does not answer for \d+ s: {why}", said[0])


@pytest.mark.parametrize(("frames", "hours"), [(1_000, 4), (2_048, 48)])
def test_a_heart_beats_counts_as_stuck_after_4_hours_where_frames_are_missing_and_after_48_where_it_flies(
    frames, hours, tmp_path, monkeypatch
):
    clock, cancelled = [0.0], []
    monkeypatch.setattr(run.time, "monotonic", lambda: clock[0])
    configuration = Configuration(CONFIG, tmp_path / "out" / "ppo" / "tanh")
    carried = Runner(tmp_path / "out", [configuration], NeverBegins(), say=lambda told: None)
    monkeypatch.setattr(carried.engine, "cancel", cancelled.append)
    job = run.Job(run.Work(configuration), workers.Worker(tmp_path / "0.1", CONFIG))
    job.folder.mkdir()
    job.file("log").touch()
    job.given("handle")
    for hour in range(hours + 1):
        clock[0] = hour * 3600.0
        heartbeat.tell(job.folder, frames, 2_048, float(hour))
        assert carried._dead(job) == (hour == hours)
    assert cancelled == ["handle"]


# -- a heartbeat ---------------------------------------------------------------------------------------------


def test_a_heart_beats_while_its_run_is_busy_and_says_how_far_it_is(tmp_path, monkeypatch):
    monkeypatch.setattr(heartbeat, "SECONDS", 0.01)
    with Heartbeat(tmp_path, total=100) as heart:
        before = progress(tmp_path)
        assert (before["frames"], before["total"], before["rate"]) == (0, 100, 0)
        heart.tell(10)
        limit = time.monotonic() + 240
        while progress(tmp_path)["frames"] != 10 and time.monotonic() < limit:
            time.sleep(0.01)
        assert progress(tmp_path)["frames"] == 10
        assert progress(tmp_path)["at"] > before["at"]
    assert not (tmp_path / PROGRESS).exists()
    assert not [thread for thread in threading.enumerate() if thread is heart._thread]


def test_a_heart_feels_that_its_folder_is_gone_and_sees_a_stop(tmp_path, monkeypatch):
    (tmp_path / "run").mkdir()
    heart = Heartbeat(tmp_path / "run", total=1)
    heart.beat()
    assert (heart.gone, heart.asked) == (False, False)
    (tmp_path / "run" / STOP).touch()
    heart.beat()
    assert heart.asked
    (tmp_path / "run").rename(tmp_path / "taken")
    heart.beat()
    assert heart.gone


def test_silence_is_measured_by_whoever_listens_whatever_the_clock_of_the_worker_says(tmp_path, monkeypatch):
    configuration = Configuration(CONFIG, tmp_path)
    job = run.Job(run.Work(configuration), None)
    now = [100.0]
    monkeypatch.setattr(run.time, "monotonic", lambda: now[0])
    job.given("handle")
    now[0] = 900.0
    assert job.silence() == 0  # it has not begun
    job.file("log").touch()
    for clock in (5e9, 1e9, 2e9):  # forth, and back
        (tmp_path / PROGRESS).write_text(json.dumps({"frames": 1, "total": 2, "rate": None, "at": clock}))
        now[0] += 50
        assert job.silence() == 0
    now[0] += 50
    assert job.silence() == 50


def test_the_process_of_an_evaluation_writes_its_status(tmp_path, warm):
    words = [sys.executable, "-m", "uavnav.cli.episodes", str(tmp_path / "ended"), str(tmp_path), "--quiet"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert json.loads((tmp_path / "ended").read_text()) == {"status": 2}
    assert done.stderr.startswith("uavnav evaluate: ")
    with contextlib.suppress(FileNotFoundError):
        assert not (tmp_path / PROGRESS).exists()


def test_the_heart_of_a_worker_beats_while_it_flies(tmp_path, monkeypatch):
    """Evaluations outlast the silence that a study bears."""
    seen = []
    monkeypatch.setattr(worker, "evaluate_run", lambda run, **how: seen.append(progress(run.path)))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(worker, "STOPS", ())
    own = workers.Worker(tmp_path / "0", CONFIG)
    worker.main(own.prepare(1, FLOWN.header()))
    assert workers.last_words(own.file("ended")) == {"finished": CONFIG.frames}
    (told,) = seen
    assert (told["frames"], told["total"]) == (CONFIG.frames, CONFIG.frames)
    assert not (own.folder / PROGRESS).exists()


def test_a_heart_without_a_known_end_is_heard(tmp_path):
    with Heartbeat(tmp_path, total=0):
        assert progress(tmp_path)["total"] == 0


def test_a_run_whose_folder_was_taken_leaves_what_lies_there_now_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(heartbeat, "SECONDS", 60.0)
    recorder = Recorder(tmp_path / "run", CONFIG)

    def lose():
        (tmp_path / "run").rename(tmp_path / "taken")
        recorder.heartbeat.beat()
        (tmp_path / "run").mkdir()
        for name in ("meta.json", PROGRESS, STOP, ".lock"):
            (tmp_path / "run" / name).write_text("another's")
        recorder.tell(256)

    with pytest.raises(RunError, match="is gone"), recorder:
        lose()
    assert {path.read_text() for path in (tmp_path / "run").iterdir()} == {"another's"}
    assert len([*(tmp_path / "run").iterdir()]) == 4
