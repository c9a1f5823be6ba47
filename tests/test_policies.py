"""A stored policy: the same numbers as in training, without unpickling, and damaged files are named."""

import json
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
import torch
from runs_by_hand import write_policies

import uavnav
from uavnav.__main__ import main
from uavnav.algorithms import ppo
from uavnav.runs import POLICY, shipped
from uavnav.runs.paper import TABLES
from uavnav.training.weights import serialize


@pytest.fixture(scope="module", params=["ppo", "dqn"])
def run(request, tmp_path_factory):
    """Of the seeds 4, 5 and 6."""
    folder = tmp_path_factory.mktemp("policies") / request.param
    return uavnav.Run(write_policies(folder, request.param, seed=4, n_seeds=3))


@pytest.mark.parametrize("shape", [(), (5,), (2, 5)])
def test_actions_and_values_have_the_batch_shape(run, shape):
    policy = uavnav.load_policy(run.path, seed=5)
    observation = torch.rand(*shape, 30)
    assert policy.values(observation).shape == (*shape, 100)
    action = policy(observation)
    assert action.shape == shape
    assert action.dtype == torch.int64
    assert torch.equal(action, policy.values(observation).argmax(-1))


def test_each_seed_has_weights_of_its_own_and_the_first_is_the_default(run):
    observation = torch.rand(9, 30)
    values = [uavnav.load_policy(run.path, seed=seed).values(observation) for seed in (4, 5, 6)]
    assert not torch.equal(values[0], values[1])
    assert not torch.equal(values[1], values[2])
    assert torch.equal(uavnav.load_policy(run.path / POLICY).values(observation), values[0])


def test_an_array_or_a_list_is_answered_with_an_array(run):
    policy = uavnav.load_policy(run.path)
    observation = torch.rand(5, 30)
    for given in (observation.numpy(), observation.double().numpy(), observation.tolist()):
        action = policy(given)
        assert isinstance(action, np.ndarray)
        assert (action.dtype, action.tolist()) == (np.int64, policy(observation).tolist())
    assert policy(observation[0].numpy()).shape == ()
    with pytest.raises(uavnav.PolicyError, match=r"shape \[5, 29\]; give \[..., 30\]"):
        policy(observation[:, 1:].numpy())


def test_sampling_follows_its_generator(run):
    policy = uavnav.load_policy(run.path, greedy=False)
    observation = torch.rand(1, 30, generator=torch.Generator().manual_seed(0)).expand(4000, 30)
    draws = [policy(observation, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)]
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])
    greedy = (draws[0] == policy.values(observation).argmax(-1)).float().mean()
    if run.algorithm == "dqn":
        assert abs(greedy - (0.8 + 0.2 / 100)) < 0.02  # epsilon = 0.2
    else:
        assert abs(greedy - torch.softmax(policy.values(observation[0]), -1).max()) < 0.03


def test_both_networks_of_ppo_are_kept():
    trainee = ppo.PPOConfig().make(compile=False)
    content = serialize(trainee.networks(), trainee.config, trainee.actor)
    assert b"policy.0.weight" in content
    assert b"value.4.bias" in content


# -- the task ------------------------------------------------------------------------------------------------

RESULTS = Path(uavnav.__file__).parent.parent / "results"
COMMITTED = sorted(path.relative_to(RESULTS) for path in RESULTS.rglob(POLICY))


def test_every_committed_policy_loads_whatever_version_wrote_its_header():
    assert len(COMMITTED) >= 12
    for path in COMMITTED:
        policy = uavnav.load_policy(RESULTS / path)
        config = uavnav.Run(RESULTS / path.parent).config
        explores = "epsilon-greedy", config.get("epsilon_end")
        how = {"ppo": ("categorical", 0.0), "dqn": explores, "pqn": explores}[policy.algorithm]
        assert (policy.acts, policy.epsilon) == how, path
        assert policy.world == uavnav.World(**config.get("world", {})), path
        assert (policy.reward, policy.head) == (config["reward"], "direct"), path
        assert policy(torch.rand(3, 30)).shape == (3,)


def test_a_committed_run_with_random_headings_comes_back_with_that_world():
    config = uavnav.Run(RESULTS / "sensitivity" / "heading" / "ppo" / "relu").config
    assert uavnav.World(**config["world"]) == uavnav.World(start_heading="random")
    assert uavnav.load_policy(RESULTS / "vectorised" / "ppo" / "relu").world == uavnav.World()


# -- policies that ship --------------------------------------------------------------------------------------


def test_twelve_policies_ship_in_2_mb_each_the_chosen_seed_of_its_run_bit_for_bit():
    paths, rows = shipped.shipped(), {row["run"]: row for row in shipped.rows()}
    paper = {f"{algorithm}-{activation}" for algorithm, activation in TABLES}
    assert paths.keys() == rows.keys() == paper | {"ppo-fast-tanh", "dqn-fast-tanh", "ppo-best", "pqn-best"}
    assert sum(path.stat().st_size for path in shipped.FOLDER.iterdir()) < 2 * 2**20
    data = tomllib.loads((RESULTS.parent / "pyproject.toml").read_text())["tool"]["setuptools"][
        "package-data"
    ]
    there = {path for glob in data["uavnav.runs"] for path in shipped.FOLDER.parent.glob(glob)}
    assert there == {*shipped.FOLDER.iterdir()}
    observation = torch.rand(5, 30)
    for name, said in json.loads(shipped.CHOSEN.read_text()).items():
        policy, own = uavnav.load_policy(name), uavnav.load_policy(RESULTS.parent / said["run"], said["seed"])
        assert torch.equal(policy.values(observation), own.values(observation))
        assert (policy.seed, policy.world, policy.epsilon) == (said["seed"], own.world, own.epsilon)
        row = rows[name]
        parts = [row["algorithm"], *["fast"] * (row["preset"] == "fast"), row["activation"]]
        assert name == ("-".join(parts) if row["preset"] != "best" else f"{row['algorithm']}-best")


def test_a_path_comes_before_a_name_and_a_slip_is_answered_with_the_nearest_and_all(
    run, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert uavnav.load_policy("ppo-tanh").seed != 4
    with pytest.raises(
        uavnav.PolicyError, match=r"\(did you mean ppo-tanh\?\), or one of dqn-fast-tanh, dqn-"
    ):
        uavnav.load_policy("ppo-tanhh")
    for command in ("evaluate", "compare reactive", "render"):
        assert main([*command.split(), "ppo-tahn"]) == 2
        assert "(did you mean ppo-tanh?), or one of dqn-fast-tanh, " in capsys.readouterr().err
    shutil.copytree(run.path, "ppo-tanh")
    assert uavnav.load_policy("ppo-tanh").seed == 4


def test_a_name_flies_wherever_a_run_does(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    short = ["--episodes", "2", "--max-steps", "20"]
    assert main(["evaluate", "dqn-fast-tanh", *short, "--out", "rows"]) == 0
    assert sorted(one.stem for one in (tmp_path / "rows").iterdir()) == [
        f"dqn-fast-tanh-{mode}-test-2-20" for mode in ("greedy", "sampled")
    ]
    assert main(["evaluate", "ppo-tanh", *short, "--across", "sticky", "--json"]) == 0
    assert main(["render", "ppo-tanh", "--steps", "5", "--out", "a.png"]) == 0
    assert "ppo-tanh, sampled: 5 steps" in capsys.readouterr().out
    assert main(["runs"]) == 0  # without a run of one's own
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines() if "shipped" in line]
    assert listed == [*shipped.shipped()]
