"""Gradient steps as pure functions of tensors, so that many of them fit into one graph.

All of it is elementwise, so agents do not see each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

BETA1, BETA2 = 0.9, 0.999
"""Adam's, as everywhere."""
ALPHA = 0.99
"""RMSprop's, PyTorch's and Stable-Baselines3's default."""

Tensors = Sequence[Tensor]


class Optimiser(Protocol):
    """What the learner needs."""

    @property
    def moments(self) -> int:
        """How many tensors are kept for each parameter; they begin at zero."""

    def rates(self, step: Tensor) -> Tensor:
        """step [M] float64, counted from 1 -> what `update` is given of each, [M, rates]."""

    def update(self, rate: Tensor, values: Tensors, gradient: Tensors, *moments: Tensors) -> tuple[Tensors, ...]:
        """One step of all parameters: rate [rates] -> new values and new moments."""


class Adam(NamedTuple):
    """As at the end of section 2 of Kingma and Ba (2015): the bias of the moments is corrected in the rate."""

    lr: float
    eps: float
    moments: int = 2

    def rates(self, step: Tensor) -> Tensor:
        correction = (1 - BETA2**step).sqrt()
        return torch.stack([self.lr * correction / (1 - BETA1**step), self.eps * correction], -1)

    def update(self, rate: Tensor, values: Tensors, gradient: Tensors, *moments: Tensors) -> tuple[Tensors, ...]:
        first = [torch.lerp(m, g, 1 - BETA1) for m, g in zip(moments[0], gradient, strict=True)]
        second = [v * BETA2 + (1 - BETA2) * g * g for v, g in zip(moments[1], gradient, strict=True)]
        lr, eps = rate.unbind()
        values = [value - lr * m / (v.sqrt() + eps) for value, m, v in zip(values, first, second, strict=True)]
        return values, first, second


class RMSprop(NamedTuple):
    """Hinton's, as `torch.optim.RMSprop` and Stable-Baselines3's A2C have it."""

    lr: float
    eps: float
    moments: int = 1

    def rates(self, step: Tensor) -> Tensor:
        return torch.full((len(step), 1), self.lr, dtype=step.dtype, device=step.device)

    def update(self, rate: Tensor, values: Tensors, gradient: Tensors, *moments: Tensors) -> tuple[Tensors, ...]:
        square = [v * ALPHA + (1 - ALPHA) * g * g for v, g in zip(moments[0], gradient, strict=True)]
        changes = [rate[0] * g / (v.sqrt() + self.eps) for g, v in zip(gradient, square, strict=True)]
        return [value - change for value, change in zip(values, changes, strict=True)], square
