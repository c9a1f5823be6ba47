"""C51: its projection, its loss by hand and as TorchRL has it, each agent alone, its support, and a
dueling run.
"""

import numpy as np
import pytest
import torch
from batches import transitions
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.modules import DistributionalQValueActor
from torchrl.objectives import DistributionalDQNLoss

from uavnav import load_policy
from uavnav.__main__ import main
from uavnav.algorithms.c51 import C51Config, project, train
from uavnav.algorithms.dqn import make_network
from uavnav.errors import ConfigError
from uavnav.evaluation.agents import Agents
from uavnav.runs.export import export_policy
from uavnav.runs.policies import PolicyError
from uavnav.tasks.rewards import BOUNDS, REWARDS

SMALL = {"hidden": (8,), "n_atoms": 7, "activation": "relu"}


def far(*shape, dtype=torch.float64):
    """Made-up transitions with rewards far beyond the support."""
    batch = transitions(*shape, dtype=dtype)
    batch["next", "reward"] *= 6
    return batch


def made(config):
    """A network and its loss in double precision, whose target network is another one."""
    network, other = (
        make_network(one).double() for one in (config, C51Config(seed=9, **SMALL, dueling=config.dueling))
    )
    loss = config.make_loss(network).double()
    for target, value in zip(
        loss.target_value_network_params.values(True, True),
        TensorDict.from_module(other).values(True, True),
        strict=True,
    ):
        target.data.copy_(value.data.expand_as(target))
    return network, other, loss


def slowly_projected(probabilities, places, atoms):
    """The algorithm of the paper, atom by atom: floor, ceiling and their shares."""
    result, dz = np.zeros(len(atoms)), (atoms[-1] - atoms[0]) / (len(atoms) - 1)
    for probability, place in zip(probabilities, places, strict=True):
        b = (min(max(place, atoms[0]), atoms[-1]) - atoms[0]) / dz
        low = min(int(np.floor(b)), len(atoms) - 2)
        result[low] += probability * (low + 1 - b)
        result[low + 1] += probability * (b - low)
    return result


@settings(max_examples=60, deadline=None)
@given(
    st.integers(2, 60),
    st.floats(-50, 10),
    st.floats(0.1, 100),
    st.floats(-30, 30),
    st.floats(0, 1),
    st.integers(0, 2**31),
)
def test_the_projection_is_that_of_a_slow_loop_and_keeps_mass_and_a_mean_within_the_support(
    n, least, width, reward, gamma, seed
):
    atoms = torch.linspace(least, least + width, n, dtype=torch.float64)
    probabilities = torch.rand(
        3, n, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)
    ).softmax(-1)
    places = (reward + gamma * atoms).expand(3, n)
    found = project(probabilities, places, atoms)
    for row, one, there in zip(found, probabilities, places, strict=True):
        np.testing.assert_allclose(
            row, slowly_projected(one.numpy(), there.numpy(), atoms.numpy()), atol=1e-9
        )
    torch.testing.assert_close(found.sum(-1), torch.ones(3, dtype=torch.float64))
    mean = (probabilities * places.clamp(atoms[0], atoms[-1])).sum(-1)
    torch.testing.assert_close((found * atoms).sum(-1), mean, atol=1e-6, rtol=0)


def test_an_atom_that_lands_on_an_atom_stays_whole():
    atoms = torch.linspace(-1, 1, 5)
    assert project(torch.eye(5), atoms.expand(5, 5), atoms).equal(torch.eye(5))
    assert project(torch.eye(5), atoms.expand(5, 5) + 0.5, atoms)[1].tolist() == [0, 0, 1, 0, 0]
    assert project(torch.eye(5), atoms.expand(5, 5) + 9, atoms)[0].tolist() == [0, 0, 0, 0, 1]


@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize("dueling", [False, True])
def test_the_loss_of_each_row_is_the_cross_entropy_by_hand(double, dueling):
    """Under a time limit, each row says after how many of its two steps it bootstraps."""
    config = C51Config(**SMALL, gamma=0.9, n_steps=2, max_steps=9, double=double, dueling=dueling)
    network, other, loss = made(config)
    steps = torch.arange(40).reshape(1, 40, 1) % 2 + 1
    batch = far(1, 40).set("steps_to_next_obs", steps)
    atoms = np.linspace(-10, 0.09 / (1 - 0.9), 7)

    def distributions(one, observation):
        """[actions, atoms], the combination of the two streams written out."""
        outputs = one(observation[:, None])[0, 0].reshape(-1, 7)
        outputs = outputs[0] + outputs[1:] - outputs[1:].mean(0) if dueling else outputs
        return outputs.softmax(-1).detach().numpy()

    with torch.no_grad():
        found, chosen = loss(batch)["loss"][0], set()
    for row in range(40):
        before, after = batch["observation"][:, row], batch["next", "observation"][:, row]
        best = (distributions(network if double else other, after) * atoms).sum(-1).argmax()
        chosen.add((best == (distributions(network, after) * atoms).sum(-1).argmax()).item())
        gamma = 0.0 if batch["next", "terminated"][0, row] else 0.9 ** steps[0, row].item()
        places = batch["next", "reward"][0, row].item() + gamma * atoms
        target = slowly_projected(distributions(other, after)[best], places, atoms)
        expected = -(target * np.log(distributions(network, before)[batch["action"][0, row]])).sum()
        assert found[row].item() == pytest.approx(expected, abs=1e-5)  # the atoms are float32
    assert chosen == {double}  # the two networks never agree on the best action


def test_for_one_agent_it_is_torchrls_own_loss_and_gradient():
    """Theirs is always double, wants float32 and [rows, atoms, actions]."""
    config = C51Config(**SMALL, gamma=0.9, double=True)
    network, _, ours = made(config)
    batch = far(1, 200, dtype=torch.float32)
    ours = ours.float()

    def logits(observation):
        return network(observation[None])[0].unflatten(-1, (-1, 7)).mT

    class Theirs(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.network = network

        def forward(self, observation):
            return logits(observation)

    actor = DistributionalQValueActor(
        Theirs(), ours.atoms, in_keys=["observation"], action_space="categorical"
    )
    theirs = DistributionalDQNLoss(actor, gamma=0.9, delay_value=True, reduction="none")
    targets = [
        [
            value
            for _, value in sorted(one.target_value_network_params.flatten_keys().items())
            if value.ndim == 3
        ]
        for one in (theirs, ours)
    ]
    for there, here in zip(*targets, strict=True):
        there.data.copy_(here.data)
    rows = batch[0].clone()
    rows["action"] = rows["action"][:, None]
    expected, found = theirs(rows)["loss"], ours(batch)["loss"][0]
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
    gradients = [torch.autograd.grad(one.mean(), list(network.parameters())) for one in (expected, found)]
    for there, here in zip(*gradients, strict=True):
        assert there.abs().max() > 1e-4
        torch.testing.assert_close(here, there, rtol=1e-4, atol=1e-6)


def test_a_target_of_fewer_steps_has_another_gradient():
    config = C51Config(**SMALL, n_steps=5, max_steps=9, dueling=True)
    batch, loss = far(1, 16), made(config)[2]
    own, later = (
        torch.autograd.grad(
            loss(batch.clone().set("steps_to_next_obs", torch.full((1, 16, 1), steps)))["loss"].mean(),
            list(loss.parameters()),
        )
        for steps in (2, 5)
    )
    for one, other in zip(own, later, strict=True):
        assert (one - other).abs().max() > 1e-6


# -- its settings --------------------------------------------------------------------------------------------


def test_the_support_follows_from_gamma_the_reward_and_the_world_unless_it_is_given():
    assert C51Config().support == (-10, 9)
    assert C51Config(gamma=0.98).support == (-10, 4.5)
    assert C51Config(world={"collision_reward": -0.5}).support == pytest.approx((-1, 9))
    assert C51Config(v_max=20.0).support == pytest.approx((-10, 20))
    assert C51Config(gamma=1.0, v_min=-1, v_max=2).support == (-1, 2)


def test_a_reward_without_bounds_needs_a_support_and_a_support_has_an_order(monkeypatch):
    monkeypatch.setitem(REWARDS, "mine", REWARDS["eq14"])
    for given_, line in (
        (
            {"reward": "mine"},
            "reward=mine, gamma=0.99: it declares no bounds of returns; give v_min and v_max",
        ),
        ({"reward": "mine", "v_min": -1}, "give v_min and v_max"),
        ({"gamma": 1.0}, "reward=eq14, gamma=1: it declares no bounds of returns; give v_min and v_max"),
        ({"v_min": 9.5}, "v_min=9.5, v_max=9; give a v_min below v_max"),
        (
            {"v_max": 1e300},
            r"v_min=-10, v_max=1e\+300; give a v_min below v_max, both finite and with room for 51",
        ),
        (
            {"v_min": -3e38, "v_max": 3e38},
            r"v_min=-3e\+38, v_max=3e\+38; give a v_min below v_max, both finite",
        ),
        ({"v_min": 8.99999999}, "v_min=9, v_max=9; give a v_min below v_max"),
        ({"v_min": 1e8, "v_max": 1e8 + 8}, r"v_min=1e\+08, v_max=1e\+08; .* room for 51 atoms"),
        ({"n_atoms": 1}, "n_atoms=1; give a number of at least 2"),
    ):
        with pytest.raises(ConfigError, match=line):
            C51Config(**given_)
    assert C51Config(reward="mine", v_min=-1, v_max=1).head == "distribution -1.0 1.0 51"


@pytest.mark.parametrize("bounded", [True, False])
def test_it_trains_where_the_tasks_reward_has_bounds_and_where_its_support_is_given(
    bounded, tmp_path, monkeypatch
):
    if not bounded:
        monkeypatch.delitem(BOUNDS, "goal")
    given_ = {} if bounded else {"v_min": -20, "v_max": 20}
    words = [
        "train",
        "c51",
        "task=goal",
        "total_frames=64",
        "n_envs=4",
        "learning_starts=8",
        "buffer_size=64",
    ]
    words += [f"{name}={value}" for name, value in given_.items()]
    assert main([*words, "hidden=[4]", "evaluate=false", f"out={tmp_path}", "--quiet"]) == 0
    assert load_policy(tmp_path).task.reward == "goal"


# -- a run whose head has two parts --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Two seeds of rainbow-lite under a time limit."""
    settings = {"n_seeds": 2, "n_envs": 8, "total_frames": 320, "learning_starts": 64, "frames_per_update": 8}
    settings |= {"max_steps": 12, "compile": "off", **SMALL, "preset": "rainbow-lite"}
    return train(C51Config(**settings), tmp_path_factory.mktemp("rainbow") / "run", quiet=True)


def test_a_dueling_distribution_is_read_by_policies_agents_and_files(run, tmp_path):
    observation = torch.rand(20, 30)
    policies = [load_policy(run.path, seed, greedy=True) for seed in (0, 1)]
    assert policies[0].network[-1].weight.shape == (1, 8, 101 * 7)
    for policy in policies:
        outputs = policy.network(observation[None])[0].detach().reshape(20, 101, 7)
        logits = outputs[:, :1] + outputs[:, 1:] - outputs[:, 1:].mean(1, keepdim=True)
        expected = (logits.softmax(-1) * torch.linspace(-10, 9, 7)).sum(-1)
        torch.testing.assert_close(policy.values(observation), expected, rtol=1e-4, atol=1e-4)
        assert -10 < expected.min() < expected.max() < 9
    actions, _ = Agents([*enumerate(policies)]).act(observation, [10, 10])
    alone = [policy(part) for policy, part in zip(policies, observation.split(10), strict=True)]
    assert torch.equal(actions, torch.cat(alone))
    archive = torch.export.load(export_policy(policies[1], tmp_path / "policy.pt2")).module()
    torch.testing.assert_close(archive(observation), policies[1].values(observation), rtol=1e-4, atol=1e-4)
    assert {*run.progress.columns} >= {"dormant", "saturated", "effective_rank", "q_value"}


def test_a_head_whose_numbers_do_not_fit_the_weights_is_one_line(run, tmp_path):
    content = (run.path / "policy.safetensors").read_bytes()
    head = load_policy(run.path).head.encode()
    for wrong in (head[:-1] + b"6", head[:-1] + b"x", head[:-1] + b"0"):
        path = tmp_path / "policy.safetensors"
        path.write_bytes(content.replace(head, wrong))
        with pytest.raises(PolicyError, match="its tensors do not fit its header"):
            load_policy(path)
