"""SAC: losses and 100 updates against plain PyTorch written from the paper, agents apart, temperatures,
targets.
"""

import copy
import math

import pytest
import torch
from batches import transitions
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import DiscreteSACLoss

from uavnav import graph
from uavnav.algorithms.sac import SACConfig, SACLoss, make_learner, make_networks, train
from uavnav.errors import ConfigError

CLOSE = {"rtol": 1e-5, "atol": 1e-5}


def made(config, dtype=torch.float32):
    """Policy, twins and loss, with targets and temperatures that differ from where they begin."""
    policy, twins = (network.to(dtype) for network in make_networks(config))
    loss = SACLoss(policy, twins, config).to(dtype)
    with torch.no_grad():
        for target in loss.target_twins.parameters():
            target.mul_(0.5)
        loss.log_alpha.copy_(-0.7 * torch.tensor([[1.0 + seed] for seed in config.seeds]))
    return policy, twins, loss


def alone(network, agent):
    """One agent's layers as PyTorch's own modules."""
    layers = []
    for layer in network:
        if hasattr(layer, "weight"):
            linear = nn.Linear(*layer.weight.shape[1:], dtype=layer.weight.dtype)
            linear.weight.data, linear.bias.data = (
                layer.weight[agent].detach().T.clone(),
                layer.bias[agent, 0].detach(),
            )
            layers.append(linear)
        else:
            layers.append(nn.ReLU())
    return nn.Sequential(*copy.deepcopy(layers))


class Plain:
    """Christodoulou (2019), equations (10) to (12) and the twins of its section 4, for one agent in plain
    PyTorch.

    All three gradients are taken at the weights before the step, and the temperature's loss is of log alpha.
    """

    def __init__(self, policy, twins, loss, agent, config):
        self.policy, self.config = alone(policy, agent), config
        self.q = [alone(network, agent) for network in (twins.first, twins.second)]
        self.target = copy.deepcopy(self.q)
        for network in self.target:
            for value in network.parameters():
                value.data.mul_(0.5)
        self.log_alpha = loss.log_alpha[agent].detach().clone().requires_grad_()
        parameters = [
            *self.policy.parameters(),
            *self.q[0].parameters(),
            *self.q[1].parameters(),
            self.log_alpha,
        ]
        self.adam = torch.optim.Adam(parameters, lr=config.lr, eps=config.adam_eps)
        self.entropy = -config.target_entropy * math.log(1 / 100)

    def losses(self, batch):
        """Of policy, Q networks and temperature: a number a row each."""
        alpha, following = self.log_alpha.exp().detach(), batch["next"]
        with torch.no_grad():
            log_next = self.policy(following["observation"]).log_softmax(-1)
            least = torch.min(*(network(following["observation"]) for network in self.target))
            value = (log_next.exp() * (least - alpha * log_next)).sum(-1)
            goes_on = (~following["terminated"][:, 0]).to(value.dtype)
            y = following["reward"][:, 0] + self.config.gamma * goes_on * value
        values = [network(batch["observation"]) for network in self.q]
        chosen = [value.gather(1, batch["action"][:, None])[:, 0] for value in values]
        log_pi = self.policy(batch["observation"]).log_softmax(-1)
        least = torch.min(*values).detach()
        entropy = -(log_pi.exp() * log_pi).sum(-1).detach()
        return (
            (log_pi.exp() * (alpha * log_pi - least)).sum(-1),
            sum((value - y).square() for value in chosen),
            self.log_alpha * (entropy - self.entropy),
        )

    def step(self, batch):
        self.adam.zero_grad()
        sum(part.mean() for part in self.losses(batch)).backward()
        self.adam.step()
        for target, network in zip(self.target, self.q, strict=True):
            for old, new in zip(target.parameters(), network.parameters(), strict=True):
                old.data = (1 - self.config.tau) * old.data + self.config.tau * new.data


def assert_same(network, plain, agent, **close):
    layers = [layer for layer in network if hasattr(layer, "weight")]
    for layer, linear in zip(layers, (one for one in plain if isinstance(one, nn.Linear)), strict=True):
        torch.testing.assert_close(layer.weight[agent], linear.weight.T, **close)
        torch.testing.assert_close(layer.bias[agent, 0], linear.bias, **close)


def test_the_three_losses_of_each_row_are_those_of_the_equations():
    config = SACConfig(n_seeds=2, activation="relu", gamma=0.9, target_entropy=0.5, hidden=[16])
    policy, twins, loss = made(config, torch.float64)
    batch = transitions(2, 40, dtype=torch.float64)
    found = loss(batch.clone())
    for agent in range(2):
        plain = Plain(policy, twins, loss, agent, config)
        for name, expected in zip(("actor", "qvalue", "alpha"), plain.losses(batch[agent]), strict=True):
            torch.testing.assert_close(found[f"loss_{name}"][agent], expected, **CLOSE)
            assert expected.std() > 1e-3


def test_100_updates_of_2_agents_are_those_of_plain_pytorch():
    """Compiled ones are as eager ones; see test_algorithms."""
    config = SACConfig(
        n_seeds=2, activation="relu", lr=1e-3, tau=0.05, target_entropy=0.6, gamma=0.9, hidden=[16]
    )
    policy, twins, loss = made(config)
    plain = [Plain(policy, twins, loss, agent, config) for agent in range(2)]
    before = loss.log_alpha.detach().clone()
    learner, batches = make_learner(loss, config, compile=False), transitions(2, 100, 32)
    learner.learn(batches)
    for agent, one in enumerate(plain):
        for index in range(100):
            one.step(batches[agent, index])
        assert_same(policy, one.policy, agent, rtol=1e-4, atol=1e-4)
        for name, network, old in zip(("first", "second"), one.q, one.target, strict=True):
            assert_same(getattr(twins, name), network, agent, rtol=1e-4, atol=1e-4)
            assert_same(getattr(loss.target_twins, name), old, agent, rtol=1e-4, atol=1e-4)
            assert (old[0].weight - network[0].weight).abs().max() > 1e-3  # it follows, and is not there
        torch.testing.assert_close(loss.log_alpha[agent], one.log_alpha, **CLOSE)
    assert (loss.log_alpha - before).abs().min() > 1e-2


def test_a_compiled_update_asks_each_of_the_six_networks_once(monkeypatch):
    """Policy and twins at s, policy and targets at s'."""
    asked = []

    def counted(given):
        found = once(given)
        asked.extend(len(one.find_nodes(op="call_function", target=layer)) for one in (given, found))
        return found

    once, layer = graph.fx_graph_cse, torch.ops.aten.baddbmm.default
    monkeypatch.setattr(graph, "fx_graph_cse", counted)
    monkeypatch.setattr(graph, "standalone_compile", lambda traced, *given, **how: traced)
    config = SACConfig(hidden=[16])
    make_learner(made(config)[2], config, compile=True).learn(transitions(1, 1, 8))
    assert asked == [2 * 6, 2 * 6]


def test_the_loss_is_torchrls_own_where_there_is_one_agent():
    """TorchRL's module itself, with one temperature and the same weights in its copies of the Q network."""
    config = SACConfig(hidden=[16], target_entropy=0.7)
    policy, twins, loss = made(config)
    own = copy.deepcopy(loss)
    logits = TensorDictModule(policy, in_keys=["observation"], out_keys=["logits"])
    theirs = DiscreteSACLoss(
        ProbabilisticActor(logits, in_keys=["logits"], distribution_class=Categorical),
        TensorDictModule(twins.first, in_keys=["observation"], out_keys=["action_value"]),
        action_space="categorical",
        loss_function="l2",
        target_entropy=0.7 * math.log(100),
        reduction="none",
        scalar_output_mode="exclude",
        alpha_init=math.exp(loss.log_alpha.item()),
    )
    theirs.make_value_estimator(gamma=config.gamma)
    with torch.no_grad():
        for kind, both in (("", own.twins), ("target_", own.target_twins)):
            there = getattr(theirs, f"{kind}qvalue_network_params")["module"]
            for index, network in enumerate((both.first, both.second)):
                for key, value in TensorDict.from_module(network).items(True, True):
                    there[key][index].copy_(value)
    batch = transitions(1, 32)
    ours, expected = loss(batch.clone()), theirs(batch.clone())
    for name in ("loss_actor", "loss_qvalue", "loss_alpha"):
        torch.testing.assert_close(ours[name], expected[name], **CLOSE)


def test_the_temperature_takes_the_policys_entropy_to_its_target():
    """Two agents with rewards of their own: after 150 updates, each entropy is within 0.3 nat of 0.4 ln
    100 = 1.84.
    """
    config = SACConfig(
        n_seeds=2, hidden=[16], lr=2e-2, tau=0.05, gamma=0.0, target_entropy=0.4, activation="relu"
    )
    policy, twins = make_networks(config)
    loss = SACLoss(policy, twins, config)
    batch, learner, found = transitions(2, 64), make_learner(loss, config, compile=False), []
    for _ in range(6):
        learner.learn(batch[:, None].expand(2, 25, 64))
        with torch.no_grad():
            log_pi = policy(batch["observation"]).log_softmax(-1)
        found.append(-(log_pi.exp() * log_pi).sum(-1).mean(-1))
    assert found[0].min() > 2.5
    assert found[-1].tolist() == pytest.approx([0.4 * math.log(100)] * 2, abs=0.3)
    assert loss.log_alpha[0].item() != loss.log_alpha[1].item()


# -- its settings and its runs -------------------------------------------------------------------------------


def test_its_buffer_and_rounds_of_updates_are_checked_as_dqns():
    with pytest.raises(ConfigError, match=r"n_envs=6; give a multiple or a divisor of frames_per_update=4"):
        SACConfig(n_envs=6)
    with pytest.raises(ConfigError, match=r"buffer_size=8; give more than n_envs=64"):
        SACConfig(buffer_size=8, n_envs=64)
    assert (SACConfig(n_envs=1).frames_per_iteration, SACConfig(n_envs=64).frames_per_iteration) == (4, 64)
    assert (SACConfig(n_envs=64).updates_per_step, SACConfig(max_steps=9).keeps_next_observations) == (
        16,
        True,
    )


def test_the_untrained_policy_acts_almost_at_random_and_no_weight_moves_before_learning_starts(tmp_path):
    config = SACConfig(total_frames=4_000, learning_starts=4_000, n_envs=16, n_seeds=2, compile="off")
    run = train(config, out=tmp_path / "run", quiet=True)
    counts = run.episodes.sum()
    assert abs(counts.turns / counts.steps - 0.9) < 0.03
    progress = run.progress.set_index("seed")
    assert (progress.alpha == 1).all()
    assert (progress.entropy > 0.98 * math.log(100)).all()
    assert "loss_actor" not in progress or progress.loss_actor.isna().all()
