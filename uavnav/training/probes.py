"""Statistics of a network's hidden units, on poses that are the same for every run.

The statistics are the shares of dormant and saturated units, and the effective rank. Letters: A agents, P
poses, H units of a layer.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from uavnav.networks import ACTIVATIONS, Activation
from uavnav.tasks import layouts
from uavnav.tasks.faults import NO_FAULTS
from uavnav.tasks.seeding import stream
from uavnav.tasks.wrapper import WrappedTask

POSES = 512
DORMANT = 0.025
"""A unit is dormant if its mean |activation| is at most this share of its layer's (Sokar et al. 2023)."""
SATURATED = 0.05
"""A unit is saturated at a pose if its slope there is at most this share of the steepest slope."""


def poses(task: WrappedTask) -> Tensor:
    """What a drone sees at poses drawn once over the window and the task's train split: observation [P, 30].

    As if an episode began there, and without faults, so that nothing of it is random.
    """
    generator = stream(0, "probe")
    axes = zip("xyz", task.world.size, strict=False)  # a window has two
    places = {axis: torch.rand(POSES, generator=generator) * size for axis, size in axes}
    task = task.replace(layouts=layouts.load("train", task.world), faults=NO_FAULTS)
    heading, layout = (
        torch.randint(most, (POSES,), generator=generator) for most in (360, len(task.layouts))
    )
    observation, _ = task.observe(task.remember(task.start(layout, heading)._replace(**places)))
    return observation


@torch.no_grad()
def units(network: nn.Module, observation: Tensor) -> dict[str, Tensor]:
    """Statistics [A] of the hidden units of each agent's `mlp`, on observation [P, 30].

    `dormant` and `saturated` are shares over all hidden layers: of what the layer behind sees, and of units.
    `effective_rank` belongs to the last hidden layer's activations [P, H]: the exponential of the entropy of
    their singular values, as shares of the sum (Roy and Vetterli 2007). What activations learn follows.
    """
    dormant, saturated, learned = [], [], dict[str, Tensor]()
    hidden = observation.expand(len(next(network.parameters())), -1, -1)
    for place, layer in enumerate([*network.children()][:-1]):
        if isinstance(layer, Activation):
            steep = _steepest_of_units(layer, hidden)
            hidden, slope = _with_slope(layer.function, layer.normalised(hidden), layer.units, layer.parallel)
            mean = hidden.abs().mean(1)
            dormant.append(mean <= DORMANT * mean.mean(1, keepdim=True))
            saturated.append(slope <= SATURATED * steep)
            for name, value in layer.named_parameters():
                name = f"layer_{place // 2 + 1}_{name.removeprefix('layer.')}"
                each = value.reshape(*value.shape[:2], -1).mean(-1).unbind(1)
                learned |= {f"{name}_{number}": one for number, one in enumerate(each)}
        else:
            hidden = layer(hidden)
    return {
        "dormant": torch.cat(dormant, -1).float().mean(-1),
        "saturated": torch.cat([part.flatten(1) for part in saturated], -1).float().mean(-1),
        "effective_rank": _effective_rank(hidden),
        **learned,
    }


@functools.cache
def steepest(function: Callable[[Tensor], Tensor]) -> float:
    """The largest |slope| of a function between -10 and 10."""
    return _with_slope(function, torch.linspace(-10, 10, 2001)[:, None])[1].max().item()


def _steepest_of_units(activation: Activation, hidden: Tensor) -> Tensor | float:
    """The same of an activation; of a layer for each unit [A, 1, U], from as many random places."""
    if activation.layer is None:
        return steepest(ACTIVATIONS[activation.name])
    x = 20 * torch.rand(2001, hidden.shape[-1], generator=stream(0, "slope")).to(hidden.device) - 10
    x = x.expand(len(hidden), -1, -1)
    _, slope = _with_slope(activation.function, x, activation.units, activation.parallel)
    return slope.amax(1, keepdim=True)


def _with_slope(
    function: Callable[[Tensor], Tensor], x: Tensor, units: int = 1, parallel: int = 1
) -> tuple[Tensor, Tensor]:
    """A function's values at x [..., parallel U], and each unit's largest |slope| there [..., U]."""
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        y = function(x)
        parts = [part.sum() for part in torch.split(y, units, -1)]
        slopes = torch.stack([torch.autograd.grad(part, x, retain_graph=True)[0] for part in parts])
    return y.detach(), slopes.reshape(*slopes.shape[:-1], parallel, units).abs().amax((0, -2))


def _effective_rank(x: Tensor) -> Tensor:
    """The effective ranks of matrices: [A, P, H] -> [A]; 0 of a matrix of zeros, NaN of one not finite.

    Products are in single precision, in which a singular value below some 3e-4 of the largest is lost in
    rounding: a rank near 1 comes out up to 3 % too high.
    """
    gram = (x.mT @ x).double()
    finite = gram.isfinite().flatten(1).all(1)
    values = torch.linalg.eigvalsh(torch.where(finite[:, None, None], gram, 0.0)).clamp(min=0).sqrt()
    shares = values / values.sum(-1, keepdim=True).clamp(min=torch.finfo(values.dtype).tiny)
    entropy = -torch.xlogy(shares, shares).sum(-1)
    rank = torch.where(values.sum(-1) > 0, entropy.exp(), 0.0)
    return torch.where(finite, rank, math.nan).float()
