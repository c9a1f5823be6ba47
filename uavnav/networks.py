"""Multilayer perceptrons over the agent axis: A independent networks of one shape, evaluated together.

Letters: A agents. To add an activation, add a line to `ACTIVATIONS`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from uavnav.choices import choose_from

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
}

KNOWN = dict(ACTIVATIONS)
"""Those that every process of a run has: built in, or of a plugin."""

Init = Literal["orthogonal", "default"]


class AgentLinear(nn.Module):
    """One linear layer per agent, computed as one product: x [A, ..., in] -> [A, ..., out].

    `init="orthogonal"`, with a gain and zero biases, is SB3's choice for PPO. `"default"` is PyTorch's initialisation
    (weights and biases uniform within 1 / sqrt(in)) and SB3's choice for DQN. generators[a] alone initialises agent a.
    """

    def __init__(
        self, inputs: int, outputs: int, generators: Sequence[torch.Generator], init: Init, gain: float = 1.0
    ) -> None:
        super().__init__()
        weight = torch.empty(len(generators), outputs, inputs)
        bias = torch.zeros(len(generators), 1, outputs)
        bound = 1 / math.sqrt(inputs)
        for agent, generator in enumerate(generators):
            if init == "orthogonal":
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
    """An activation of `ACTIVATIONS`, by name.

    Raises:
        ValueError: `ACTIVATIONS` has no such name.
    """

    def __init__(self, name: str) -> None:
        super().__init__()
        if name not in ACTIVATIONS:
            raise ValueError(f"activation={name!r}; {choose_from(name, ACTIVATIONS)}")
        self.name = name

    def forward(self, x: Tensor) -> Tensor:
        return ACTIVATIONS[self.name](x)

    def extra_repr(self) -> str:
        return self.name


def mlp(
    sizes: Sequence[int],
    activation: str,
    generators: Sequence[torch.Generator],
    init: Init,
    output_gain: float = 1.0,
) -> nn.Sequential:
    """Linear layers of the given sizes with the activation between them: x [A, ..., sizes[0]] -> [A, ..., sizes[-1]].

    With `init="orthogonal"`, hidden layers have the gain sqrt(2) and the last layer has `output_gain`, whatever the
    activation (as in SB3, decision 15).
    """
    layers: list[nn.Module] = []
    for index, (inputs, outputs) in enumerate(pairwise(sizes)):
        last = index == len(sizes) - 2
        layers.append(AgentLinear(inputs, outputs, generators, init, output_gain if last else math.sqrt(2)))
        if not last:
            layers.append(Activation(activation))
    return nn.Sequential(*layers)
