"""Multilayer perceptrons over the agent axis: A independent networks of one shape, evaluated together.

Letters: A agents, N rows, U units of a layer. To add an activation, a function or a `Layer`, add a line to
`ACTIVATIONS`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Literal, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from uavnav.errors import ConfigError, among, choose_from, quoted, telling_line


class Layer(nn.Module):
    """An activation that is more than a function: x [A, N, parallel U] -> [A, N, any width].

    A subclass is made of U, the units, and a generator for each agent. Its parameters [A, n, ...] are learned
    with the network's; `progress` shows each of the n, as its mean over the rest.
    """

    parallel: ClassVar[int] = 1
    """Linear layers of U units before it, whose outputs it takes side by side."""

    def __init__(self, units: int, generators: Sequence[torch.Generator]) -> None:
        super().__init__()


def crelu(x: Tensor) -> Tensor:
    """Concatenated ReLU, Shang et al. (2016), arXiv 1603.05201: [..., U] -> [..., 2 U]."""
    return torch.cat([F.relu(x), F.relu(-x)], -1)


def fourier(x: Tensor) -> Tensor:
    """Deep Fourier features, Lewandowski et al. (2025), arXiv 2410.20634: [..., U] -> [..., 2 U]."""
    return torch.cat([x.sin(), x.cos()], -1)


class Hadamard(Layer):
    """The product of two parallel layers of tanh, Kooi et al. (2024), arXiv 2406.09079."""

    parallel = 2

    def forward(self, x: Tensor) -> Tensor:
        """[A, N, 2 U] -> [A, N, U]."""
        first, second = x.tanh().chunk(2, -1)
        return first * second


class Rational(Layer):
    """A rational function whose coefficients a layer's units share, Delfosse et al. (2024), arXiv 2102.09407.

        f(x) = (a_0 + a_1 x + ... + a_5 x^5) / (1 + |b_1 x| + ... + |b_4 x^4|)

    It begins as the authors' approximation of a leaky ReLU between -3 and 3: version A5/4 of
    `rationals_config.json` in their repository ml-research/rational_activations.
    """

    NUMERATOR = (0.0297927787, 0.6183735265, 2.3233090625, 3.0519362373, 1.4854203264, 0.2510244961)
    DENOMINATOR = (-1.1419548357, 4.393159975, 0.871471231, 0.3471966234)

    def __init__(self, units: int, generators: Sequence[torch.Generator]) -> None:
        super().__init__(units, generators)
        above, below = (
            torch.tensor(values).repeat(len(generators), 1)[..., None, None]
            for values in (self.NUMERATOR, self.DENOMINATOR)
        )
        self.numerator, self.denominator = nn.Parameter(above), nn.Parameter(below)

    def forward(self, x: Tensor) -> Tensor:
        """[A, N, U] -> [A, N, U], by Horner."""
        *a, above = self.numerator.unbind(1)
        *b, below = self.denominator.abs().unbind(1)
        for coefficient in reversed(a):
            above = above * x + coefficient
        for coefficient in reversed(b):
            below = below * x.abs() + coefficient
        return above / (below * x.abs() + 1)


ACTIVATIONS: dict[str, Callable[..., Any]] = {
    "relu": F.relu,  # eq. (5)
    "leaky_relu": F.leaky_relu,  # eq. (6), slope 0.01
    "sigmoid": torch.sigmoid,  # eq. (7)
    "tanh": torch.tanh,  # eq. (8)
    "elu": F.elu,
    "gelu": F.gelu,
    "silu": F.silu,
    "mish": F.mish,
    "selu": F.selu,
    "softplus": F.softplus,
    "softsign": F.softsign,
    "identity": lambda x: x,
    "hardtanh": F.hardtanh,  # as bounded and centred as tanh, in three straight lines
    "relu6": F.relu6,  # a ReLU with a bound
    "sigmoid_centred": lambda x: 2 * torch.sigmoid(x) - 1,  # which is tanh(x / 2)
    "crelu": crelu,
    "fourier": fourier,
    "hadamard": Hadamard,
    "rational": Rational,
}
"""Functions [..., U] -> [..., any width], and classes of layers, by name."""

BUILT_IN = tuple(ACTIVATIONS)

KNOWN = dict(ACTIVATIONS)
"""Those that every process of a run has: built in, or of a plugin."""

Init = Literal["orthogonal", "unit", "default"]


class AgentLinear(nn.Module):
    """One linear layer per agent, computed as one product: x [A, ..., in] -> [A, ..., out].

    `init="orthogonal"`, with a gain and zero biases, is SB3's choice for PPO; `"unit"` differs only in its
    gains. `"default"` is PyTorch's initialisation (weights and biases uniform within 1 / sqrt(in)) and SB3's
    choice for DQN. Only generators[a] initialises agent a. It may be several `parallel` layers side by side.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        generators: Sequence[torch.Generator],
        init: Init,
        gain: float = 1.0,
        parallel: int = 1,
    ) -> None:
        super().__init__()
        weight = torch.empty(len(generators), parallel * outputs, inputs)
        bias = torch.zeros(len(generators), 1, parallel * outputs)
        bound = 1 / math.sqrt(inputs)
        for agent, generator in enumerate(generators):
            if init != "default":
                for one in weight[agent].chunk(parallel):
                    nn.init.orthogonal_(one, gain, generator=generator)
            else:
                nn.init.uniform_(weight[agent], -bound, bound, generator=generator)
                nn.init.uniform_(bias[agent], -bound, bound, generator=generator)
        self.weight = nn.Parameter(weight.transpose(1, 2).clone(memory_format=torch.contiguous_format))
        self.bias = nn.Parameter(bias)

    def forward(self, x: Tensor) -> Tensor:
        rows = x[:, None] if x.ndim == 2 else x.flatten(1, -2)
        return torch.baddbmm(self.bias, rows, self.weight).reshape(*x.shape[:-1], self.weight.shape[-1])


class Activation(nn.Module):
    """An activation of `ACTIVATIONS`, by name; with `layer_norm`, of values that LayerNorm centres and scales
    first.

    Raises:
        ValueError: `ACTIVATIONS` has no such name.
        ConfigError: it cannot be made, or fails on zeros.
    """

    def __init__(
        self,
        name: str,
        layer_norm: bool = False,
        units: int = 1,
        generators: Sequence[torch.Generator] | None = None,
    ) -> None:
        super().__init__()
        if not among(name, ACTIVATIONS):
            raise ValueError(f"activation={quoted(name)}; {choose_from(name, ACTIVATIONS)}")
        self.name, self.layer_norm, self.units = name, layer_norm, units
        self.layer: Layer | None = None
        self.parallel = 1
        entry: Any = ACTIVATIONS[name]
        generators = [torch.Generator()] if generators is None else generators
        try:
            with torch.inference_mode(False), torch.enable_grad():  # wherever a policy is loaded
                if isinstance(entry, type):
                    self.layer = layer = entry(units, generators)
                    self.parallel = layer.parallel
                given = torch.zeros(len(generators), 1, self.parallel * units, requires_grad=True)
                found = self(given)
            if not isinstance(found, Tensor):
                raise TypeError(f"it gave a {type(found).__name__}")
            *rows, self.width = found.shape  # the width that the next layer sees
            if rows != [*given.shape[:-1]] or not self.width:
                raise ValueError(f"{[*given.shape]} became {[*rows, self.width]}")
            if found.dtype != given.dtype or not found.requires_grad:
                raise ValueError(f"{given.dtype} became {found.dtype}, requires_grad={found.requires_grad}")
            for parameter, one in self.named_parameters():
                if one.shape[:1] != given.shape[:1]:
                    raise ValueError(f"{parameter} {[*one.shape]} is not led by {len(generators)} agents")
        except Exception as error:  # a caller's activation may raise any kind
            raise ConfigError(
                f"activation={name}: {telling_line(error)}; give a function of a tensor that changes at most "
                "its last dimension, or a Layer"
            ) from error

    def normalised(self, x: Tensor) -> Tensor:
        """What `function` is given."""
        return F.layer_norm(x, x.shape[-1:]) if self.layer_norm else x

    def function(self, x: Tensor) -> Tensor:
        """[A, ..., parallel U] -> [A, ..., width], without LayerNorm."""
        if self.layer is None:
            return cast(Tensor, ACTIVATIONS[self.name](x))
        found: Tensor = self.layer(x[:, None] if x.ndim == 2 else x.flatten(1, -2))
        return found.reshape(*x.shape[:-1], found.shape[-1])

    def forward(self, x: Tensor) -> Tensor:
        """The same of what LayerNorm centres and scales, where there is one."""
        return self.function(self.normalised(x))

    def extra_repr(self) -> str:
        return self.name


@torch.no_grad()
def unit_gain(activation: str) -> float:
    """1 / std f(z) for z ~ N(0, 1): with it, the units of the next layer begin on one scale, whatever the
    activation.

    >>> round(unit_gain("relu"), 2), round(unit_gain("sigmoid"), 2)
    (1.71, 4.8)
    """
    one = Activation(activation).double()
    z, weight = (
        torch.cartesian_prod(*[torch.from_numpy(values)] * one.parallel).reshape(-1, one.parallel)
        for values in np.polynomial.hermite_e.hermegauss(200)
    )
    values, weight = one(z[None])[0].mT, weight.prod(-1) / weight.prod(-1).sum()
    mean = (weight * values).sum(-1, keepdim=True)
    return float((weight * (values - mean).square()).sum(-1).mean().rsqrt())


def mlp(
    sizes: Sequence[int],
    activation: str,
    generators: Sequence[torch.Generator],
    init: Init,
    output_gain: float = 1.0,
    layer_norm: bool = False,
) -> nn.Sequential:
    """Linear layers with an activation after each but the last: x [A, ..., sizes[0]] -> [A, ..., sizes[-1]].

    The sizes between are numbers of units. The activation says how many `parallel` layers of so many units
    stand before it, and how wide its outputs are for the layer behind it.

    With `init="orthogonal"`, hidden layers have the gain sqrt(2) and the last layer has `output_gain`,
    whatever the activation (as in SB3, decision 15). With `"unit"`, what follows an activation has its
    `unit_gain` instead of sqrt(2), and the first layer 1.
    """
    inputs, *hidden, outputs = sizes
    layers: list[nn.Module] = []
    after = unit_gain(activation) if init == "unit" else 1.0
    for units in hidden:
        gain = (after if layers else 1.0) if init == "unit" else math.sqrt(2)
        own = Activation(activation, layer_norm, units, generators)
        layers += [AgentLinear(inputs, units, generators, init, gain, own.parallel), own]
        inputs = own.width
    layers.append(AgentLinear(inputs, outputs, generators, init, output_gain * after))
    return nn.Sequential(*layers)


def shapes(weights: Mapping[str, Tensor]) -> dict[str, torch.Size]:
    """Of an agent's weights, by the names of those of all agents."""
    return {name: tensor.shape[1:] for name, tensor in weights.items()}


def made_of(network: nn.Module) -> tuple[object, ...] | None:
    """What an `mlp` is made of, layer by layer, whatever its weights and agents; None of another network."""
    layers = [*network.children()]
    if type(network) is not nn.Sequential or not all(
        type(layer) in (AgentLinear, Activation) for layer in layers
    ):
        return None
    return tuple(
        (layer.name, layer.layer_norm)
        if isinstance(layer, Activation)
        else tuple(layer.get_parameter("weight").shape)[1:]
        for layer in layers
    )


def stacked(networks: Sequence[nn.Module]) -> nn.Module:
    """The agents of several networks as those of one, frozen; the networks are `made_of` the same."""
    whole = copy.deepcopy(networks[0])
    for name, _ in networks[0].named_parameters():
        weights = torch.cat([one.get_parameter(name).detach() for one in networks])
        layer, _, own = name.rpartition(".")
        setattr(whole.get_submodule(layer), own, nn.Parameter(weights, requires_grad=False))
    return whole
