"""An evaluation that would take long is flown by two processes, half of the seeds each."""

import multiprocessing
import os

import pytest
from runs_by_hand import write_policies

from uavnav.evaluation import evaluate_run
from uavnav.runs import Run
from uavnav.tasks.faults import Faults
from uavnav.training import machine

FILES = ("evaluation-test-12-300.parquet", "behaviour-test-12-300.parquet")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return Run(write_policies(tmp_path_factory.mktemp("halves") / "run", seed=4))


@pytest.fixture
def flown(run, monkeypatch):
    """What is in the files of an evaluation: 12 layouts, 300 steps; so many forks are started."""
    monkeypatch.setattr(machine, "MANY", 3 * 2 * 12 * 300)
    original = machine.forked

    def fly(forks, faults=None):
        started = []
        monkeypatch.setattr(machine, "forks", lambda: bool(forks))
        monkeypatch.setattr(machine, "forked", lambda work: original(started.append(work) or work))
        evaluate_run(run, episodes=12, max_steps=300, quiet=True, faults=faults)
        assert len(started) == forks
        names = [name.replace(".parquet", f"-{faults}.parquet") if faults else name for name in FILES]
        return [(run.path / name).read_bytes() for name in names]

    return fly


@pytest.mark.parametrize("faults", [None, Faults(noise=5.0, sticky=0.1)])
def test_two_halves_leave_the_same_bytes_as_one_process(flown, faults):
    assert flown(1, faults) == flown(0, faults)


def test_a_half_whose_process_fails_is_evaluated_here(flown, monkeypatch):
    alone = flown(0)
    monkeypatch.setattr(machine, "_do", lambda *given: None)
    assert flown(1) == alone


def test_the_work_of_a_fork_is_done_by_another_process():
    with machine.forked(os.getpid) as found:
        assert found() not in (os.getpid(), None)


def test_where_no_fork_can_be_started_its_work_is_done_here(monkeypatch):
    def start(process):
        raise BlockingIOError("no more processes")

    monkeypatch.setattr(multiprocessing.get_context("fork").Process, "start", start)
    with machine.forked(os.getpid) as found:
        assert found() == os.getpid()


def test_what_goes_wrong_in_a_fork_is_raised_here(capfd):
    def work():
        raise ValueError("a policy chose 100")

    with machine.forked(work) as found, pytest.raises(ValueError, match="a policy chose 100"):
        found()
    assert capfd.readouterr().err == ""
