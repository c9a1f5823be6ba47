"""Multilayer perceptrons over the agent axis: A independent networks of one shape, evaluated together.

Letters: A agents. To add an activation, add a line to `ACTIVATIONS`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from uavnav.errors import among, choose_from, quoted

ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
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
}

KNOWN = dict(ACTIVATIONS)
"""Those that every process of a run has: built in, or of a plugin."""

Init = Literal["orthogonal", "unit", "default"]


class AgentLinear(nn.Module):
    """One linear layer per agent, computed as one product: x [A, ..., in] -> [A, ..., out].

    `init="orthogonal"`, with a gain and zero biases, is SB3's choice for PPO; `"unit"` differs only in its
    gains. `"default"` is PyTorch's initialisation (weights and biases uniform within 1 / sqrt(in)) and SB3's
    choice for DQN. Only generators[a] initialises agent a.
    """

    def __init__(
        self, inputs: int, outputs: int, generators: Sequence[torch.Generator], init: Init, gain: float = 1.0
    ) -> None:
        super().__init__()
        weight = torch.empty(len(generators), outputs, inputs)
        bias = torch.zeros(len(generators), 1, outputs)
        bound = 1 / math.sqrt(inputs)
        for agent, generator in enumerate(generators):
            if init != "default":
                nn.init.orthogonal_(weight[agent], gain, generator=generator)
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
    """

    def __init__(self, name: str, layer_norm: bool = False) -> None:
        super().__init__()
        if not among(name, ACTIVATIONS):
            raise ValueError(f"activation={quoted(name)}; {choose_from(name, ACTIVATIONS)}")
        self.name, self.layer_norm = name, layer_norm

    def forward(self, x: Tensor) -> Tensor:
        return ACTIVATIONS[self.name](F.layer_norm(x, x.shape[-1:]) if self.layer_norm else x)

    def extra_repr(self) -> str:
        return self.name


def unit_gain(activation: str) -> float:
    """1 / std f(z) for z ~ N(0, 1): with it, the units of the next layer begin on one scale, whatever the
    activation.

    >>> round(unit_gain("relu"), 2), round(unit_gain("sigmoid"), 2)
    (1.71, 4.8)
    """
    z, weight = (torch.from_numpy(values) for values in np.polynomial.hermite_e.hermegauss(200))
    values, weight = ACTIVATIONS[activation](z), weight / weight.sum()
    return float((weight * (values - (weight * values).sum()).square()).sum().rsqrt())


def mlp(
    sizes: Sequence[int],
    activation: str,
    generators: Sequence[torch.Generator],
    init: Init,
    output_gain: float = 1.0,
    layer_norm: bool = False,
) -> nn.Sequential:
    """Linear layers of the given sizes with the activation between them: x [A, ..., sizes[0]] -> [A, ...,
    sizes[-1]].

    With `init="orthogonal"`, hidden layers have the gain sqrt(2) and the last layer has `output_gain`,
    whatever the activation (as in SB3, decision 15). With `"unit"`, what follows an activation has its
    `unit_gain` instead of sqrt(2), and the first layer 1.
    """
    layers: list[nn.Module] = []
    after = unit_gain(activation) if init == "unit" else 1.0
    for index, (inputs, outputs) in enumerate(pairwise(sizes)):
        last = index == len(sizes) - 2
        gain = (after if index else 1.0) if init == "unit" else math.sqrt(2)
        gain = output_gain * after if last else gain
        layers.append(AgentLinear(inputs, outputs, generators, init, gain))
        if not last:
            layers.append(Activation(activation, layer_norm))
    return nn.Sequential(*layers)


def made_of(network: nn.Module) -> tuple[object, ...] | None:
    """What an `mlp` is made of, layer by layer, whatever its weights and agents; None of any other
    network.
    """
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
    for layer, *alike in zip(whole.children(), *(network.children() for network in networks), strict=True):
        for name, _ in list(layer.named_parameters()):
            weights = torch.cat([one.get_parameter(name).detach() for one in alike])
            setattr(layer, name, nn.Parameter(weights, requires_grad=False))
    return whole
