"""An exported policy says the same numbers to programs that know nothing of this package."""

import functools
import importlib.util
import io
import json
import subprocess
import sys
import zipfile

import onnx
import onnxruntime
import pytest
import torch
from torch import nn

from uavnav import PolicyError, RunError, load_policy
from uavnav.acting import HEADS
from uavnav.algorithms import dqn, ppo
from uavnav.networks import ACTIVATIONS, mlp
from uavnav.runs import export
from uavnav.runs.export import export_policy
from uavnav.runs.policies import Policy
from uavnav.tasks import layouts
from uavnav.tasks.faults import Faults
from uavnav.tasks.table import EMPTY, make_task
from uavnav.tasks.world import World

pytestmark = pytest.mark.slow  # exporters take seconds a policy: not in the quick suite

CLOSE = 1e-5
SHORT = {"preset": "vectorised", "n_seeds": 2, "seed": 4, "total_frames": 512, "compile": "off"}


@pytest.fixture(scope="module", params=["ppo", "dqn"])
def run(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("export") / request.param
    if request.param == "ppo":
        return ppo.train(ppo.PPOConfig(frames_per_batch=512, hidden=[16], **SHORT), folder, quiet=True)
    return dqn.train(dqn.DQNConfig(activation="relu", learning_starts=64, **SHORT), folder, quiet=True)


@pytest.fixture(scope="module")
def exported(run, tmp_path_factory):
    """Of seed 5, by suffix: a file alone in a folder, written at the first call."""

    @functools.cache
    def written(suffix):
        return export_policy(
            load_policy(run.path, seed=5), tmp_path_factory.mktemp("exported") / f"policy{suffix}"
        )

    return written


def untrained(activation):
    """A network whose values differ by more than rounding."""
    network = mlp([30, 64, 64, 100], activation, [torch.Generator().manual_seed(0)], "default")
    return nn.Sequential(*map(export._alone, network))


def by_onnxruntime(path, observation):
    session = onnxruntime.InferenceSession(path)
    return torch.as_tensor(session.run(["values"], {"observation": observation.numpy()})[0])


def by_torch(path, observation):
    with torch.no_grad():
        return torch.export.load(path).module()(observation)


READ = {".onnx": by_onnxruntime, ".pt2": by_torch}


@pytest.mark.parametrize("suffix", READ)
def test_it_gives_the_values_and_the_greedy_actions_for_any_number_of_rows(run, exported, suffix):
    policy, path = load_policy(run.path, seed=5), exported(suffix)
    for rows in (1, 2, 500):
        observation = torch.rand(rows, 30, generator=torch.Generator().manual_seed(rows))
        values = READ[suffix](path, observation)
        assert values.shape == (rows, 100)
        assert (values - policy.values(observation)).abs().max() <= CLOSE
        assert torch.equal(values.argmax(-1), policy(observation))
    assert [file.name for file in path.parent.iterdir()] == [path.name]


class Beside(nn.ModuleList):
    """The values of several networks, one behind the other."""

    def forward(self, observation):
        return torch.cat([network(observation) for network in self], -1)


@pytest.mark.parametrize("suffix", READ)
def test_every_activation_goes_into_a_file(suffix, tmp_path):
    """Into the same one, as an export takes seconds: 100 values of each."""
    network = nn.Sequential(Beside(map(untrained, ACTIVATIONS)))
    policy = Policy(network, "ppo", True, make_task(EMPTY), "categorical", "direct")
    observation = 4 * torch.randn(200, 30)
    values = READ[suffix](export_policy(policy, tmp_path / f"policy{suffix}"), observation)
    off = (values - policy.values(observation)).abs().amax(0).reshape(len(ACTIVATIONS), 100).amax(1)
    assert {name: one for name, one in zip(ACTIVATIONS, off.tolist(), strict=True) if not one <= CLOSE} == {}


def test_onnx_is_three_products_two_activations_and_says_what_it_is(run, exported):
    model = onnx.load(exported(".onnx"))
    onnx.checker.check_model(model)
    hidden = {"ppo": ["Gemm", "Tanh"], "dqn": ["Gemm", "Relu", "Gemm", "Relu"]}[run.algorithm]
    assert [node.op_type for node in model.graph.node] == [*hidden, "Gemm"]
    (prop,) = model.metadata_props
    assert prop.key == "uavnav"
    assert json.loads(prop.value) == facts(run)


def facts(run):
    own = {
        "ppo": {"values": "logits", "acts": "categorical", "epsilon": 0.0},
        "dqn": {"values": "Q values", "acts": "epsilon-greedy", "epsilon": 0.05},
    }[run.algorithm]
    task = {
        "task": "drone",
        "world": World().model_dump(),
        "reward": "eq14",
        "max_steps": None,
        "stack": 1,
        "faults": Faults().model_dump(),
    }
    all_layouts = layouts.checksum(layouts.load("train"))
    return {"algorithm": run.algorithm, **own, **task, "layouts": all_layouts, "world_version": "1"}


def test_a_policy_trained_with_a_sensor_of_90_degrees_says_so_in_its_metadata(tmp_path):
    config = ppo.PPOConfig(
        frames_per_batch=512, hidden=[16], world={"sensor_arc": 90}, reward="additive", max_steps=70, **SHORT
    )
    run = ppo.train(config, tmp_path / "run", quiet=True)
    model = onnx.load(export_policy(load_policy(run.path), tmp_path / "policy.onnx"))
    said = {"uavnav.json": ""}
    torch.export.load(export_policy(load_policy(run.path), tmp_path / "policy.pt2"), extra_files=said)
    for text in (model.metadata_props[0].value, said["uavnav.json"]):
        found = json.loads(text)
        assert found["world"] == World(sensor_arc=90.0).model_dump()
        assert (found["task"], found["reward"], found["max_steps"]) == ("drone", "additive", 70)


def test_an_archive_of_torch_says_what_it_is_and_pickles_no_weight(run, exported):
    path = exported(".pt2")
    said = {"uavnav.json": ""}
    torch.export.load(path, extra_files=said)
    assert json.loads(said["uavnav.json"]) == facts(run)
    with zipfile.ZipFile(path) as archive:
        (name,) = [name for name in archive.namelist() if name.endswith("weights_config.json")]
        entries = json.loads(archive.read(name))["config"].values()
    assert len(entries) == 2 * len(load_policy(run.path).network[::2])
    assert not any(entry["use_pickle"] for entry in entries)


SENSED = {"sense_velocity": True}


@pytest.mark.parametrize(
    ("suffix", "task", "size", "world"),
    [
        (".onnx", "drone", 30, {}),
        (".pt2", "goal", 33, {}),
        (".pt2", "space", 40, {}),
        (".onnx", "moving", 50, SENSED),
        (".onnx", "space-moving", 70, SENSED),
    ],
)
def test_values_are_those_after_the_head_whose_largest_is_the_greedy_action(
    tmp_path, suffix, task, size, world, monkeypatch
):
    """As of a distribution of values: 100 actions with 3 numbers each. In each world as many numbers go in;
    the rest is the same in all, so that each has one kind of file.
    """
    monkeypatch.setitem(HEADS, "mean-of-3", lambda outputs: outputs.unflatten(-1, (100, 3)).mean(-1))
    network = mlp([size, 16, 300], "relu", [torch.Generator().manual_seed(3)], "default")
    policy = Policy(network, "dqn", True, make_task(EMPTY, world, task=task), "epsilon-greedy", "mean-of-3")
    observation = torch.rand(50, size)
    values = READ[suffix](export_policy(policy, tmp_path / f"policy{suffix}"), observation)
    assert values.shape == (50, 100)
    assert (values - policy.values(observation)).abs().max() <= CLOSE
    assert torch.equal(values.argmax(-1), policy(observation))


@pytest.mark.parametrize("suffix", READ)
def test_a_file_tells_nothing_of_the_machine_that_wrote_it(exported, suffix):
    path = exported(suffix)
    content = path.read_bytes()
    parts = [content]
    if suffix == ".pt2":
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            parts = [archive.read(name) for name in archive.namelist()]
    for part in parts:
        assert b"site-packages" not in part
        assert b".py" not in part
        assert str(path.parent).encode() not in part


@pytest.mark.usefixtures("warm")
def test_the_command_writes_the_named_seed(run, tmp_path):
    command = [
        sys.executable,
        "-m",
        "uavnav",
        "export",
        run.path,
        "--seed",
        "5",
        "--out",
        tmp_path / "policy.onnx",
    ]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout == f"{tmp_path / 'policy.onnx'}: observation [N, 30] -> values [N, 100]\n"
    observation = torch.rand(9, 30)
    values = by_onnxruntime(tmp_path / "policy.onnx", observation)
    assert (values - load_policy(run.path, seed=5).values(observation)).abs().max() <= CLOSE
    assert (values - load_policy(run.path, seed=4).values(observation)).abs().max() > CLOSE


def test_what_cannot_be_written_is_one_line_and_no_file(run, tmp_path, monkeypatch):
    policy = load_policy(run.path)
    with pytest.raises(
        PolicyError,
        match=r"policy\.pt: its suffix says .*; did you mean \.pt2\? choose from \.onnx, \.pt2",
    ):
        export_policy(policy, tmp_path / "policy.pt")
    with pytest.raises(RunError, match=r"policy\.pt2: cannot be written"):
        export_policy(policy, tmp_path / "nowhere" / "policy.pt2")
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(export, "find_spec", lambda name: None if name == "onnx" else find_spec(name))
    with pytest.raises(PolicyError, match=r"onnx is not installed; pip install 'uavnav\[onnx\]'"):
        export_policy(policy, tmp_path / "policy.onnx")
    assert not list(tmp_path.iterdir())
