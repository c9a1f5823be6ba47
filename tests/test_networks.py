"""Networks over the agent axis: each agent is an ordinary MLP, initialised from its own generator."""

import itertools
import math

import numpy as np
import pytest
import torch
from torch import nn

from uavnav import studies
from uavnav.errors import ConfigError
from uavnav.networks import ACTIVATIONS, KNOWN, Activation, AgentLinear, Layer, mlp, unit_gain
from uavnav.runs.paper import TABLES
from uavnav.tasks.seeding import stream


def generators(*seeds):
    return [stream(seed, "test") for seed in seeds]


def as_torch(network, agent):
    """The agent's network as PyTorch's own layers."""
    layers = []
    for layer in network:
        if isinstance(layer, AgentLinear):
            linear = nn.Linear(layer.weight.shape[1], layer.weight.shape[2])
            linear.weight.data = layer.weight[agent].detach().T.clone()
            linear.bias.data = layer.bias[agent, 0].detach().clone()
            layers.append(linear)
        else:
            layers.append(layer)
    return nn.Sequential(*layers)


@pytest.mark.parametrize("init", ["orthogonal", "default"])
def test_each_of_three_agents_is_an_ordinary_mlp(init):
    network = mlp([30, 64, 64, 100], "tanh", generators(0, 1, 2), init)
    observation = torch.rand(3, 5, 7, 30)
    result = network(observation)
    assert result.shape == (3, 5, 7, 100)
    for agent in range(3):
        torch.testing.assert_close(
            result[agent], as_torch(network, agent)(observation[agent]), rtol=1e-5, atol=1e-5
        )


@pytest.mark.parametrize("init", ["orthogonal", "default"])
@pytest.mark.parametrize("activation", ["relu", "hadamard"])
def test_an_agent_is_the_same_in_any_population(init, activation):
    alone = mlp([30, 64, 100], activation, generators(4), init)
    among = mlp([30, 64, 100], activation, generators(9, 4, 7), init)
    for a, b in zip(alone.parameters(), among.parameters(), strict=True):
        assert torch.equal(a[0], b[1])
        assert not torch.equal(b[0], b[1]) or not a.any()


def test_orthogonal_weights_have_singular_values_of_their_gain_and_zero_biases():
    network = mlp([30, 64, 64, 100], "tanh", generators(0, 1), "orthogonal", output_gain=0.01)
    for layer, gain in zip(network[::2], [math.sqrt(2), math.sqrt(2), 0.01], strict=True):
        singular = torch.linalg.svdvals(layer.weight.detach())
        torch.testing.assert_close(singular, torch.full_like(singular, gain), rtol=1e-4, atol=1e-6)
        assert not layer.bias.any()


def test_default_weights_and_biases_are_uniform_within_one_over_the_root_of_the_inputs():
    layer = AgentLinear(64, 4000, generators(0), "default")
    bound = 1 / 8
    for values in (layer.weight, layer.bias):
        assert values.abs().max() <= bound
        assert values.abs().max() > 0.99 * bound
        assert abs(values.var().item() / (bound**2 / 3) - 1) < 0.1


PLAIN = {
    "relu": lambda x: max(0.0, x),
    "leaky_relu": lambda x: x if x >= 0 else 0.01 * x,
    "sigmoid": lambda x: 1 / (1 + math.exp(-x)),
    "tanh": lambda x: (math.exp(x) - math.exp(-x)) / (math.exp(x) + math.exp(-x)),
    "elu": lambda x: x if x > 0 else math.exp(x) - 1,
    "gelu": lambda x: x * 0.5 * (1 + math.erf(x / math.sqrt(2))),
    "silu": lambda x: x / (1 + math.exp(-x)),
    "mish": lambda x: x * math.tanh(math.log1p(math.exp(x))),
    "selu": lambda x: 1.0507009873554805 * (x if x > 0 else 1.6732632423543772 * (math.exp(x) - 1)),
    "softplus": lambda x: math.log1p(math.exp(x)),
    "softsign": lambda x: x / (1 + abs(x)),
    "identity": lambda x: x,
    "hardtanh": lambda x: max(-1.0, min(1.0, x)),
    "relu6": lambda x: max(0.0, min(6.0, x)),
    "sigmoid_centred": lambda x: math.tanh(x / 2),
}


def rational(x, numerator, denominator):
    above = sum(a * x**power for power, a in enumerate(numerator))
    return above / (1 + sum(abs(b * x**power) for power, b in enumerate(denominator, start=1)))


OTHERS = {  # of a row of numbers, and of what the agent has learned
    "crelu": lambda x, *_: [max(0.0, one) for one in x] + [max(0.0, -one) for one in x],
    "fourier": lambda x, *_: [*map(math.sin, x), *map(math.cos, x)],
    "hadamard": lambda x, *_: [math.tanh(x[i]) * math.tanh(x[i + len(x) // 2]) for i in range(len(x) // 2)],
    "rational": lambda x, *learned: [rational(one, *learned) for one in x],
}


def test_the_table_holds_the_papers_four_and_fifteen_more():
    assert set(ACTIVATIONS) >= set(KNOWN) == {*PLAIN, *OTHERS}
    assert (len(PLAIN), len(OTHERS)) == (15, 4)
    assert (
        {activation for _, activation in TABLES}
        == {"tanh", "sigmoid", "relu", "leaky_relu"}
        <= set(ACTIVATIONS)
    )


@pytest.mark.parametrize("name", sorted(PLAIN))
def test_each_activation_is_its_formula(name):
    x = torch.linspace(-7, 7, 101)
    expected = torch.tensor([PLAIN[name](float(value)) for value in x])
    torch.testing.assert_close(Activation(name)(x), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", OTHERS)
def test_each_layer_is_a_slow_loop_over_agents_rows_and_units(name):
    layer = Activation(name, units=3, generators=generators(0, 1))
    with torch.no_grad():
        for learned in layer.parameters():
            learned.add_(0.3 * torch.randn(learned.shape, generator=torch.Generator().manual_seed(1)))
    x = 3 * torch.randn(2, 4, 5, 3 * layer.parallel, generator=torch.Generator().manual_seed(0))
    found = layer(x)
    assert found.shape == (2, 4, 5, layer.width)
    for agent, row, column in itertools.product(range(2), range(4), range(5)):
        learned = [one[agent].flatten().tolist() for one in layer.parameters()]
        expected = torch.tensor(OTHERS[name](x[agent, row, column].tolist(), *learned))
        torch.testing.assert_close(found[agent, row, column], expected, rtol=1e-4, atol=1e-5)


def test_a_rational_function_begins_within_0_03_of_a_leaky_relu_between_minus_3_and_3():
    x = torch.linspace(-3, 3, 601)[None, :, None]
    off = (Activation("rational")(x) - torch.nn.functional.leaky_relu(x)).abs()
    assert 0.029 < off.max() < 0.030


def test_parallel_layers_begin_each_as_a_layer_of_its_own():
    """An orthogonal 64 x 64 matrix has 64 singular values of 1; of a 128 x 64 one, halves would not."""
    both = AgentLinear(64, 64, generators(0), "orthogonal", parallel=2).weight[0].mT.chunk(2)
    for one in both:
        torch.testing.assert_close(one @ one.mT, torch.eye(64), rtol=0, atol=1e-5)
    assert not torch.equal(*both)


def test_the_networks_of_the_study_have_nearly_the_same_number_of_parameters():
    counts = {}
    for one in studies.configurations(studies.read("activations"), studies.HERE):
        sizes = [30, *one.config.hidden, 100]
        network = mlp(sizes, one.config.activation, generators(0), "default")
        counts[one.config.activation] = sum(part.numel() for part in network.parameters())
    assert {name: counts.pop(name) for name in OTHERS} == {
        "crelu": 12_580,
        "fourier": 12_580,
        "hadamard": 12_580,
        "rational": 12_664,
    }
    assert counts == dict.fromkeys(("relu", "leaky_relu", "tanh", "sigmoid", "silu"), 12_644)


@pytest.mark.parametrize("mode", [torch.inference_mode, torch.no_grad])
def test_networks_are_made_where_no_gradient_is_wanted_too(mode):
    with mode():
        assert mlp([30, 8, 100], "rational", generators(0), "default")[-1].weight.shape == (1, 8, 100)


class Flat(Layer):
    def forward(self, x):
        return x.flatten()


class Shared(Layer):
    """Its one parameter is of no agent."""

    def __init__(self, units, generators):
        super().__init__(units, generators)
        self.slope = nn.Parameter(torch.ones(1))

    def forward(self, x):
        return x * self.slope


@pytest.mark.parametrize(
    ("entry", "says"),
    [
        (Flat, r"\[0, 1, 8\] became \[0, 1, 0\]"),
        (nn.ReLU, "takes from 1 to 2"),
        (lambda x: x.sum(-1), "became"),
        (lambda x: x.detach().numpy(), "it gave a ndarray"),
        (lambda x: torch.from_numpy(np.tanh(x.detach().numpy())), "requires_grad=False"),
        (lambda x: x.double(), "torch.float32 became torch.float64"),
        (Shared, r"layer.slope \[1\] is not led by 0 agents"),
    ],
)
def test_what_cannot_be_an_activation_is_one_line_that_says_what_can(entry, says, monkeypatch):
    monkeypatch.setitem(ACTIVATIONS, "mine", entry)
    with pytest.raises(ConfigError, match=f"activation=mine: .*{says}.*; give a function of a tensor"):
        mlp([30, 8, 100], "mine", [], "default")


@pytest.mark.parametrize("name", OTHERS)
def test_layers_have_the_unit_gain_of_the_mean_variance_of_what_they_give(name):
    layer = Activation(name)
    z = torch.randn(1, 100_000, layer.parallel, generator=torch.Generator().manual_seed(0))
    assert abs(unit_gain(name) * layer(z)[0].var(0).mean().sqrt().item() - 1) < 0.02


@pytest.mark.parametrize("name", sorted(PLAIN))
def test_units_of_the_next_layer_begin_with_variance_1_whatever_the_activation(name):
    """100,000 draws of z ~ N(0, 1); LayerNorm makes such z of any values."""
    z = torch.randn(100_000, generator=torch.Generator().manual_seed(0))
    assert abs(unit_gain(name) * Activation(name)(z).std().item() - 1) < 0.02
    normed, plain = Activation(name, layer_norm=True), Activation(name)
    torch.testing.assert_close(
        normed(5 * z - 3), plain((z - z.mean()) / z.std(correction=0)), atol=1e-4, rtol=1e-4
    )


def test_unit_gains_stand_before_all_layers_but_the_first():
    """64 x 64 orthogonal layers: the gain is the root of their mean square times 8."""
    sizes, gain = [64, 64, 64, 64], unit_gain("sigmoid")
    layers = [
        layer
        for layer in mlp(sizes, "sigmoid", generators(0), "unit", 0.01)
        if isinstance(layer, AgentLinear)
    ]
    found = [layer.weight.square().mean().sqrt().item() * 8 for layer in layers]
    assert found == pytest.approx([1, gain, 0.01 * gain], rel=1e-5)
