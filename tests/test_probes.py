"""The probes of hidden units on networks whose answer is known."""

import pytest
import torch

from uavnav.networks import ACTIVATIONS, mlp
from uavnav.tasks.seeding import stream
from uavnav.tasks.table import EMPTY, make_task
from uavnav.training import probes


def network(activation, agents=2, hidden=4, **how):
    generators = [stream(seed, "probe test") for seed in range(agents)]
    return mlp([3, hidden, hidden, 5], activation, generators, "default", **how)


def test_poses_are_512_observations_that_never_change_and_differ_from_each_other():
    first, again, other_layouts = (probes.poses(make_task(layouts)) for layouts in ("train", "train", EMPTY))
    assert torch.equal(first, again)
    assert torch.equal(first, other_layouts)  # whatever a run trains on
    assert first.shape == (512, 30)
    assert len(first.unique(dim=0)) > 400


def test_a_unit_that_is_always_zero_is_dormant_and_its_agent_alone_has_it():
    net = network("relu")
    with torch.no_grad():
        net[0].bias[:] = 1.0
        net[2].bias[:] = 1.0
        net[0].weight[:] = 0.1
        net[2].weight[:] = 0.1
        net[0].bias[1, 0, 2] = -100.0
    found = probes.units(net, torch.rand(50, 3))
    assert found["dormant"].tolist() == pytest.approx([0, 1 / 8])
    assert found["saturated"].tolist() == pytest.approx([0, 1 / 8])  # a ReLU below zero has no slope


@pytest.mark.parametrize(
    ("activation", "bias", "expected"),
    [
        ("tanh", 5.0, 1.0),
        ("sigmoid", 0.0, 0.0),
        ("identity", 9.0, 0.0),
        ("crelu", -9.0, 0.0),  # one of its two sides is never flat
        ("fourier", 0.785, 0.0),  # where sine and cosine have opposite slopes
        ("hadamard", 5.0, 1.0),
        ("rational", 1.0, 0.0),
    ],
)
def test_saturated_is_the_share_of_flat_activations(activation, bias, expected):
    net = network(activation)
    with torch.no_grad():
        for layer in (net[0], net[2]):
            layer.weight[:] = 0.0
            layer.bias[:] = bias
    assert probes.units(net, torch.rand(50, 3))["saturated"].tolist() == [expected] * 2


def test_a_product_is_saturated_only_where_both_of_its_layers_are():
    net = network("hadamard", hidden=1)
    with torch.no_grad():
        for layer in (net[0], net[2]):
            layer.weight[:] = 0.0
            layer.bias[:] = torch.tensor([[[0.0, 5.0]], [[5.0, 5.0]]])
    assert probes.units(net, torch.rand(50, 3))["saturated"].tolist() == [0, 1]


def test_behind_layer_norm_saturated_is_of_normalised_values():
    assert probes.units(network("identity", layer_norm=True), torch.rand(50, 3))["saturated"].tolist() == [
        0,
        0,
    ]


def test_each_coefficient_that_a_layer_learns_is_a_column():
    net = network("rational")
    with torch.no_grad():
        net[3].layer.denominator[1, 2] = 7.0
    found = probes.units(net, torch.rand(50, 3))
    parts = [f"numerator_{k}" for k in range(6)] + [f"denominator_{k}" for k in range(4)]
    assert [*found][3:] == [f"layer_{n}_{part}" for n in (1, 2) for part in parts]
    assert found["layer_2_denominator_2"].tolist() == pytest.approx([0.8714712, 7.0])
    assert [*probes.units(network("crelu"), torch.rand(50, 3))] == ["dormant", "saturated", "effective_rank"]


@pytest.mark.parametrize(
    ("activation", "slope"), [("relu", 1.0), ("tanh", 1.0), ("sigmoid", 0.25), ("leaky_relu", 1.0)]
)
def test_the_steepest_slope(activation, slope):
    assert probes.steepest(ACTIVATIONS[activation]) == pytest.approx(slope)


def test_the_effective_rank_of_orthogonal_features_is_their_number_and_of_one_direction_1():
    eye = torch.eye(6)[:, :4].expand(2, 6, 4).clone()
    eye[1] = torch.ones(6, 4)
    assert probes._effective_rank(eye).tolist() == pytest.approx([4.0, 1.0], abs=1e-4)
    assert probes._effective_rank(torch.zeros(1, 6, 4)).tolist() == [0.0]
    uneven = torch.diag(torch.tensor([2.0, 1.0]))[None]
    entropy = -(2 / 3 * torch.tensor(2 / 3).log() + 1 / 3 * torch.tensor(1 / 3).log())
    assert probes._effective_rank(uneven).item() == pytest.approx(entropy.exp().item(), rel=1e-5)


def test_a_network_that_diverged_has_no_rank_and_does_not_end_the_run():
    net = network("tanh")
    with torch.no_grad():
        net[0].weight[1] = float("nan")
    rank = probes.units(net, torch.rand(50, 3))["effective_rank"]
    assert rank.isnan().tolist() == [False, True]
