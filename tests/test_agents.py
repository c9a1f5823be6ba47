"""Policies that differ in their weights alone act as one network, and each does what it does alone."""

import pytest
import torch
from policies_by_hand import network, untrained

from uavnav.evaluation import episodes, on
from uavnav.evaluation.agents import Policies
from uavnav.networks import made_of, stacked
from uavnav.runs.policies import Policy
from uavnav.tasks.baselines import reactive
from uavnav.tasks.table import EMPTY, make_task


def explores(seed, epsilon=0.3):
    return untrained(seed, greedy=False, acts="epsilon-greedy", epsilon=epsilon)


SIDE_BY_SIDE = [
    *((seed, untrained(seed, greedy=False)) for seed in range(4)),
    (4, reactive),
    *((seed, untrained(seed)) for seed in range(3)),
    *((seed, explores(seed)) for seed in range(3)),
    (9, untrained(9, greedy=False, activation="relu")),
]


@pytest.mark.parametrize("n_layouts", [1, 2, 5, 7])
def test_a_policy_beside_others_acts_as_alone_to_the_last_bit(n_layouts):
    task = on(make_task(EMPTY), episodes=n_layouts, max_steps=80)
    together = [[] for _ in SIDE_BY_SIDE]
    for step in episodes.steps(SIDE_BY_SIDE, task):
        for place, own in enumerate(together):
            mine = step.episode // n_layouts == place
            own.append((step.action[mine], step.state.x[mine], step.outcome.reward[mine]))
    for place, one in enumerate(SIDE_BY_SIDE):
        steps = 0
        for alone, beside in zip(episodes.steps([one], task), together[place], strict=False):
            steps += 1
            there = alone.action, alone.state.x, alone.outcome.reward
            assert all(torch.equal(one, other) for one, other in zip(there, beside, strict=True))
        assert steps > 5


@pytest.fixture
def shapes(monkeypatch):
    """What each product of a network is given."""
    seen, of_agents = [], Policy.of_agents
    monkeypatch.setattr(
        Policy, "of_agents", lambda self, rows: seen.append(tuple(rows.shape)) or of_agents(self, rows)
    )
    return seen


def test_neighbours_whose_networks_are_alike_are_one_product_of_those_that_have_rows(shapes):
    policies = Policies(SIDE_BY_SIDE, 100)
    policies.act(torch.rand(36, 30), [3] * 12)
    assert shapes == [(4, 16, 30), (6, 16, 30), (1, 16, 30)]
    shapes.clear()
    policies.act(torch.rand(45, 30), [3, 0, 5, 8, 0, 1, 0, 0, 1, 1, 9, 17])
    assert shapes == [(3, 16, 30), (4, 16, 30), (1, 17, 30)]


@pytest.mark.parametrize(
    ("other", "products"),
    [
        (untrained(1, activation="relu"), 2),
        (untrained(1, layer_norm=True), 2),
        (untrained(1, sizes=(30, 32, 100)), 2),
        (reactive, 1),
        (untrained(1, greedy=False), 1),
        (explores(1, epsilon=0.5), 1),
    ],
)
def test_policies_are_one_product_if_they_differ_in_weights_and_ways_to_act_alone(other, products, shapes):
    seen, sizes = torch.rand(20, 30), [5, 8, 7]
    flown = [(0, explores(0)), (1, other), (2, explores(2))]
    actions, values = Policies(flown, 100).act(seen, sizes)
    # whoever differs parts its neighbours
    assert len(shapes) == products + (other is reactive or products == 2)
    assert (values is None) == (other is reactive)
    for (seed, one), rows, chosen in zip(flown, seen.split(sizes), actions.split(sizes), strict=True):
        assert torch.equal(chosen, one(rows, torch.Generator().manual_seed(seed)))
    if values is not None:
        for (_, one), rows, behind in zip(flown, seen.split(sizes), values.split(sizes), strict=True):
            torch.testing.assert_close(behind, one.values(rows))


def test_networks_are_put_together_again_only_when_a_policy_has_no_rows_any_more(monkeypatch):
    made = []
    monkeypatch.setattr(
        "uavnav.evaluation.agents.stacked", lambda networks: made.append(len(networks)) or stacked(networks)
    )
    policies = Policies([(seed, untrained(seed)) for seed in range(4)], 100)
    for sizes in ([5, 7, 1, 1], [5, 6, 1, 1], [5, 6, 1, 0], [2, 2, 1, 0], [2, 0, 0, 0]):
        policies.act(torch.rand(sum(sizes), 30), sizes)
    assert made == [4, 3]  # of one policy the network itself acts


def test_actions_of_32_bits_come_back_as_64():
    def counts(seen, generator):
        return torch.arange(len(seen), dtype=torch.int32)

    for policies, sizes in (([(0, counts), (1, reactive)], [3, 2]), ([(0, counts)], [3])):
        actions, _ = Policies(policies, 100).act(torch.rand(sum(sizes), 30), sizes)
        assert (actions.dtype, actions[:3].tolist()) == (torch.int64, [0, 1, 2])


@pytest.mark.parametrize("activation", ["tanh", "rational"])
def test_stacked_networks_give_what_each_gives(activation):
    ones = [network(seed, activation=activation, layer_norm=True) for seed in range(3)]
    seen = torch.rand(3, 5, 30)
    whole = stacked(ones)
    assert made_of(whole) == made_of(ones[0])
    assert torch.equal(whole(seen), torch.cat([one(own[None]) for one, own in zip(ones, seen, strict=True)]))
    assert not any(weight.requires_grad for weight in whole.parameters())


def test_another_network_than_an_mlp_is_made_of_nothing_known():
    assert made_of(torch.nn.Sequential(torch.nn.Linear(30, 100))) is None
    assert made_of(torch.nn.Identity()) is None
