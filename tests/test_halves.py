"""An evaluation that would take long is flown by two processes, half of the seeds each."""

import subprocess
import sys

import pytest
import torch

from uavnav import ppo
from uavnav.evaluate import evaluate_run
from uavnav.networks import ACTIVATIONS
from uavnav.tasks.faults import Faults
from uavnav.training import machine

SHORT = {"total_frames": 64, "n_worlds": 4, "frames_per_batch": 64, "minibatch_size": 64, "epochs": 1, "compile": "off"}
FILES = ("evaluation-test-12-300.parquet", "behaviour-test-12-300.parquet")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    config = ppo.PPOConfig(seed=4, n_seeds=3, **SHORT)
    return ppo.train(config, out=tmp_path_factory.mktemp("halves") / "run", quiet=True)


@pytest.fixture
def flown(monkeypatch):
    """What is in the files of an evaluation of a run: 12 sets, 300 steps; and how many processes were started."""
    started = []

    class Popen(subprocess.Popen):
        def __init__(self, *words, **how):
            started.append(self)
            super().__init__(*words, **how)

    def fly(run, cores, faults=None):
        monkeypatch.setattr(machine, "cores", lambda: cores)
        monkeypatch.setattr(machine, "MANY", 3 * 2 * 12 * 300)
        monkeypatch.setattr(subprocess, "Popen", Popen)
        evaluate_run(run, episodes=12, max_steps=300, quiet=True, faults=faults)
        monkeypatch.undo()
        names = [name.replace(".parquet", f"-{faults}.parquet") if faults else name for name in FILES]
        return [(run.path / name).read_bytes() for name in names], len(started)

    return fly


@pytest.mark.parametrize("faults", [None, Faults(noise=5.0, sticky=0.1)])
def test_two_halves_leave_the_same_bytes_as_one_process(run, flown, faults):
    alone, none = flown(run, 1, faults)
    halves, one = flown(run, 2, faults)
    assert (none, one) == (0, 1)
    assert halves == alone


def test_a_half_whose_process_fails_is_flown_here(run, flown, monkeypatch):
    alone, _ = flown(run, 1)
    monkeypatch.setattr(sys, "executable", "false")
    assert flown(run, 2) == (alone, 1)


def test_what_this_process_alone_knows_is_flown_here(flown, monkeypatch, tmp_path):
    monkeypatch.setitem(ACTIVATIONS, "own", torch.sin)
    run = ppo.train(ppo.PPOConfig(activation="own", n_seeds=3, **SHORT), out=tmp_path / "run", quiet=True)
    _, started = flown(run, 2)
    assert started == 0
