"""Policies that a run keeps on the way: the same bits as a shorter run's, after a stop and by workers too."""

import shutil

import pytest

from uavnav.algorithms.ppo import PPOConfig
from uavnav.evaluation import evaluate_run
from uavnav.evaluation.verify import verify
from uavnav.runs import POLICY, Run
from uavnav.runs.policies import contents
from uavnav.runs.tables import RunError
from uavnav.training.loop import train
from uavnav.training.recorder import Interrupted

SMALL = {"hidden": (4,), "n_envs": 2, "frames_per_batch": 64, "minibatch_size": 32, "epochs": 1, "n_seeds": 2}


def tensors(path):
    found, header = contents(path)
    return {
        key: one.numpy().tobytes() for key, one in found.items() if key.startswith("policy.")
    }, header.seeds


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    config = PPOConfig(**SMALL, total_frames=640, keep_at=[0.25, 0.5])
    return train(config, out=tmp_path_factory.mktemp("kept") / "run", quiet=True, processes=1)


def test_policies_kept_after_half_of_training_are_those_of_a_run_of_half_the_frames(whole, tmp_path):
    half = train(PPOConfig(**SMALL, total_frames=320), out=tmp_path / "half", quiet=True, processes=1)
    assert tensors(whole.path / "policy-at-0.5.safetensors") == tensors(half.path / POLICY)
    assert tensors(whole.path / "policy-at-0.25.safetensors") != tensors(half.path / POLICY)


def test_a_run_that_was_stopped_before_and_goes_on_keeps_the_same_bits(whole, tmp_path):
    config = PPOConfig(**SMALL, total_frames=640, keep_at=[0.25, 0.5])
    with pytest.raises(Interrupted):
        train(config, out=tmp_path, quiet=True, processes=1, until=250)
    assert not (tmp_path / "policy-at-0.5.safetensors").exists()
    train(config, out=tmp_path, quiet=True, processes=1)
    for name in ("policy-at-0.25.safetensors", "policy-at-0.5.safetensors"):
        assert (tmp_path / name).read_bytes() == (whole.path / name).read_bytes()


@pytest.mark.usefixtures("warm")
def test_workers_keep_the_policies_of_all_seeds(tmp_path):
    config = PPOConfig(**SMALL, total_frames=128, keep_at=[0.5])
    run = train(config, out=tmp_path / "two", quiet=True, processes=2)
    assert tensors(run.path / "policy-at-0.5.safetensors")[1] == [0, 1]


def test_verify_compares_kept_policies(whole, tmp_path):
    run = Run(shutil.copytree(whole.path, tmp_path / "copy"))
    assert "and 16 tensors at 640" in verify(run, quiet=True).lines[0]  # of policy, value and two kept
    shutil.copy(run.path / "policy-at-0.25.safetensors", run.path / "policy-at-0.5.safetensors")
    assert "policy-at-0.5.safetensors: policy.0.bias differs" in verify(run, quiet=True).lines[1]


def test_kept_policies_are_evaluated_into_rows_of_their_own(whole):
    kept, last = (evaluate_run(whole, 3, 40, quiet=True, at=at) for at in (0.25, None))
    assert (whole.path / "evaluation-at-0.25-test-3-40.parquet").is_file()
    assert (kept.attrs.get("at"), last.attrs.get("at")) == (0.25, None)
    assert not kept["reward"].equals(last["reward"])
    with pytest.raises(RunError, match=r"kept no policies at=0.3; train with keep_at=\[0.3\]"):
        evaluate_run(Run(whole.path), 3, 40, quiet=True, at=0.3)
