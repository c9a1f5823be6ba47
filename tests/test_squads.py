"""Policies that differ in their weights alone act as one product, and each does what it does alone."""

import pytest
import torch

from uavnav.evaluation import flights, on
from uavnav.evaluation.squads import Squads
from uavnav.networks import made_of, mlp, stacked
from uavnav.runs.policies import Policy
from uavnav.tasks.baselines import reactive
from uavnav.tasks.simulator import EMPTY, make_task


def network(seed=0, sizes=(30, 64, 64, 100), activation="tanh", **how):
    return mlp(sizes, activation, [torch.Generator().manual_seed(seed)], "default", **how)


def policy(seed=0, greedy=False, acts="categorical", epsilon=0.0, **how):
    return Policy(network(seed, **how), "ppo", greedy, make_task(EMPTY), acts, "direct", epsilon, seed)


CREW = [
    *((seed, policy(seed)) for seed in range(4)),
    (4, reactive),
    *((seed, policy(seed, True)) for seed in range(3)),
    *((seed, policy(seed, acts="epsilon-greedy", epsilon=0.3)) for seed in range(3)),
    (9, policy(9, activation="relu")),
]


@pytest.mark.parametrize("n_layouts", [1, 2, 5, 7])
def test_whoever_flies_beside_others_flies_as_alone_to_the_last_bit(n_layouts):
    task = on(make_task(EMPTY), episodes=n_layouts, max_steps=80)
    together = [[] for _ in CREW]
    for step in flights.fly(CREW, task):
        for place, own in enumerate(together):
            mine = step.flight // n_layouts == place
            own.append((step.action[mine], step.state.x[mine], step.outcome.reward[mine]))
    for place, flyer in enumerate(CREW):
        steps = 0
        for alone, beside in zip(flights.fly([flyer], task), together[place], strict=False):
            steps += 1
            there = alone.action, alone.state.x, alone.outcome.reward
            assert all(torch.equal(one, other) for one, other in zip(there, beside, strict=True))
        assert steps > 5


def test_flyers_of_one_kind_whose_rows_fill_up_to_as_many_are_one_product(monkeypatch):
    shapes, of_agents = [], Policy.of_agents

    def counted(self, seen):
        shapes.append(tuple(seen.shape))
        return of_agents(self, seen)

    monkeypatch.setattr(Policy, "of_agents", counted)
    squads = Squads(CREW, 100)
    squads.act(torch.rand(36, 30), [3] * 12)
    assert shapes == [(7, 3, 30), (3, 16, 30), (1, 3, 30)]  # of 1 to 3 rows, only greedy ones fill up
    shapes.clear()
    squads.act(torch.rand(45, 30), [3, 0, 5, 8, 0, 1, 0, 0, 1, 1, 9, 17])
    assert shapes == [(1, 3, 30), (4, 16, 30), (2, 1, 30), (1, 32, 30)]


@pytest.mark.parametrize(
    "other", [policy(1, activation="relu"), policy(1, layer_norm=True), policy(1, sizes=(30, 32, 100)), reactive]
)
def test_policies_whose_networks_differ_in_more_than_weights_act_apart(other):
    squads = Squads([(0, policy()), (1, other)], 100)
    squads.act(torch.rand(4, 30), [2, 2])
    assert len(squads._dealt) == 2


@pytest.mark.parametrize(
    "other", [policy(1, True), policy(1, acts="epsilon-greedy", epsilon=0.5), policy(1, epsilon=0.1)]
)
def test_policies_of_one_kind_of_network_act_each_in_its_own_way(other):
    seen = torch.rand(20, 30)
    squads = Squads([(0, policy()), (1, other), (2, policy(2))], 100)
    actions, _ = squads.act(seen, [5, 8, 7])
    assert [len(crew.sizes) for (squad,) in [squads._dealt] for crew in squad.crews] == [2, 1]
    for seed, one, own in ((0, policy(), slice(0, 5)), (1, other, slice(5, 13)), (2, policy(2), slice(13, 20))):
        assert torch.equal(actions[own], one(seen[own], torch.Generator().manual_seed(seed)))


def test_a_squad_that_stays_together_is_stacked_once():
    squads = Squads([(seed, policy(seed)) for seed in range(4)], 100)
    squads.act(torch.rand(14, 30), [5, 7, 1, 1])
    first, second = (squad.policy for squad in squads._dealt)
    squads.act(torch.rand(12, 30), [6, 5, 1, 0])
    assert squads._dealt[0].policy is first
    assert squads._dealt[1].policy is not second
    assert [*squads._stacked] == [(0, 1), (2,)]


def test_actions_of_32_bits_come_back_as_64():
    crew = [(0, lambda seen, generator: torch.arange(len(seen), dtype=torch.int32)), (1, reactive)]
    actions, _ = Squads(crew, 100).act(torch.rand(5, 30), [3, 2])
    assert (actions.dtype, actions[:3].tolist()) == (torch.int64, [0, 1, 2])
    alone, _ = Squads(crew[:1], 100).act(torch.rand(3, 30), [3])
    assert alone.dtype == torch.int64


def test_values_come_back_in_the_order_of_the_rows():
    crew = [(0, policy(0)), (1, policy(1, activation="relu")), (2, policy(2))]
    seen = torch.rand(6, 30)
    actions, values = Squads(crew, 100).act(seen, [2, 2, 2], values=True)
    for place, (_, one) in enumerate(crew):
        own = slice(2 * place, 2 * place + 2)
        torch.testing.assert_close(values[own], one.values(seen[own]))
    assert actions.shape == (6,)


def test_stacked_networks_give_what_each_gives():
    ones = [network(seed, layer_norm=True) for seed in range(3)]
    seen = torch.rand(3, 5, 30)
    whole = stacked(ones)
    assert made_of(whole) == made_of(ones[0])
    assert torch.equal(whole(seen), torch.cat([one(own[None]) for one, own in zip(ones, seen, strict=True)]))
    assert not any(weight.requires_grad for weight in whole.parameters())


def test_another_network_than_an_mlp_is_made_of_nothing_known():
    assert made_of(torch.nn.Sequential(torch.nn.Linear(30, 100))) is None
    assert made_of(torch.nn.Identity()) is None
