"""Gradient steps of a whole population: TorchRL's loss, the gradient of each agent, its norm clipped, Adam.

Agents share no parameter, so the gradient of the sum of their losses is, agent by agent, the gradient of each one's
own loss; Adam is elementwise; only the norm must be taken per agent. Letters: A agents, the leading axis of every
parameter; M minibatches of N rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule

from uavnav.graph import Loop

BETA1, BETA2 = 0.9, 0.999
"""Adam's, as everywhere."""

Tensors = Sequence[Tensor]


class _Objective(nn.Module):
    """A loss module as a plain module from a batch to the population's scalar and each agent's parts [losses, A]."""

    def __init__(self, loss: LossModule, losses: Sequence[str]) -> None:
        super().__init__()
        self.loss = loss
        self.losses = tuple(losses)

    def forward(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        found = self.loss(batch.clone(False))  # DQNLoss writes its errors into what it is given
        parts = torch.stack([found[name].flatten(1).mean(1) for name in self.losses])
        return parts.sum(), parts.detach()


class Learner:
    """Adam on the parameters of a TorchRL loss module, in place, any number of minibatches a call.

    Args:
        loss: built with `reduction="none"` on networks whose parameters lead with the agent axis.
        losses: names of what it returns; an agent's loss is the sum of their means over the agent's rows.
        lr, eps: Adam's.
        max_grad_norm: each agent's gradient is scaled down to this norm.
        compile: run all minibatches of a call as one compiled graph.
    """

    def __init__(
        self, loss: LossModule, losses: Sequence[str], *, lr: float, eps: float, max_grad_norm: float, compile: bool
    ) -> None:
        self.lr, self.eps, self.max_grad_norm = lr, eps, max_grad_norm
        self.compile = compile
        self.names = (*losses, "grad_norm")
        self.objective = _Objective(loss, losses)
        self.parameters = dict(self.objective.named_parameters())
        self.buffers = dict(self.objective.named_buffers())
        self.moments = [torch.zeros_like(value) for value in (*self.parameters.values(), *self.parameters.values())]
        self.steps = torch.zeros((), dtype=torch.float64, device=self.moments[0].device)
        self._updates: dict[Any, Loop] = {}  # by the keys and rows of minibatches

    def learn(self, batches: TensorDictBase) -> dict[str, Tensor]:
        """Updates from minibatches [A, M, N], one after the other; each agent's mean losses and gradient norm, [A]."""
        if not self.compile:
            steps = [self.step(batch) for batch in batches.unbind(1)]
            return {name: torch.stack([losses[name] for losses in steps]).mean(0) for name in self.names}
        with torch.no_grad():
            keys, leaves = zip(*batches.items(include_nested=True, leaves_only=True), strict=True)
            kind = (keys, batches.shape[2])
            if kind not in self._updates:
                self._updates[kind] = self._compile(keys, leaves[0].device.type == "cpu")
            given = (self._rates(batches.shape[1]), *self._state, *self.buffers.values(), *leaves)
            (found,) = self._updates[kind](*given)
            self.steps += batches.shape[1]
        return dict(zip(self.names, found, strict=True))

    def step(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """One update of every agent from a minibatch [A, N]; returns each agent's losses and gradient norm, [A]."""
        with torch.no_grad():
            found, state = self._update(self._rates(1)[0], self._state, batch)
            for value, new in zip(self._state, state, strict=True):
                value.copy_(new)
            self.steps += 1
        return dict(zip(self.names, found, strict=True))

    def gradient(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """The gradient by parameter, unclipped."""
        gradient, _ = self._gradient(list(self.parameters.values()), batch)
        return dict(zip(self.parameters, gradient, strict=True))

    def state_dict(self) -> dict[str, dict[str, Tensor]]:
        """Weights, targets, Adam's moments and steps."""
        network = {name: value.detach().clone() for name, value in (self.parameters | self.buffers).items()}
        moments = {str(index): value.clone() for index, value in enumerate(self.moments)}
        return {"network": network, "moments": moments, "steps": {"all": self.steps.clone()}}

    def load_state_dict(self, state_dict: dict[str, dict[str, Tensor]]) -> None:
        """Write in place what `state_dict` returned, so that the networks elsewhere follow."""
        with torch.no_grad():
            for name, value in (self.parameters | self.buffers).items():
                value.copy_(state_dict["network"][name])
            for index, value in enumerate(self.moments):
                value.copy_(state_dict["moments"][str(index)])
            self.steps.copy_(state_dict["steps"]["all"])

    @property
    def _state(self) -> list[Tensor]:
        """What an update changes: the parameters, then Adam's first moments, then the second."""
        return [*self.parameters.values(), *self.moments]

    def _rates(self, n: int) -> Tensor:
        """Adam's step size and epsilon of the next n steps, with the corrections of the moments' bias: [n, 2]."""
        step = self.steps + torch.arange(1, n + 1, device=self.steps.device)
        correction = (1 - BETA2**step).sqrt()
        rates = torch.stack([self.lr * correction / (1 - BETA1**step), self.eps * correction], -1)
        return rates.to(self.moments[0].dtype)

    def _gradient(self, parameters: Tensors, batch: TensorDictBase) -> tuple[Tensors, Tensor]:
        """By parameter, of those that the objective holds now; and the losses [losses, A]."""
        with torch.enable_grad():
            total, losses = self.objective(batch)
            return torch.autograd.grad(total, parameters), losses

    def _update(self, rate: Tensor, state: Tensors, batch: TensorDictBase) -> tuple[Tensor, list[Tensor]]:
        """One step: the losses and the gradient's norm [losses + 1, A], and the next state.

        Adam as at the end of section 2 of Kingma and Ba (2015), the moments' bias corrected in the rate [2]: fewer
        divisions for every parameter.
        """
        n = len(self.parameters)
        values, first, second = state[:n], state[n : 2 * n], state[2 * n :]
        gradient, losses = self._gradient(values, batch)
        norm = torch.stack([part.flatten(1).square().sum(1) for part in gradient]).sum(0).sqrt()
        scale = (self.max_grad_norm / (norm + 1e-6)).clamp(max=1.0)  # as torch.nn.utils.clip_grad_norm_
        clipped = [part * scale.reshape(-1, *[1] * (part.ndim - 1)) for part in gradient]
        first = [torch.lerp(m, g, 1 - BETA1) for m, g in zip(first, clipped, strict=True)]
        second = [v * BETA2 + (1 - BETA2) * g * g for v, g in zip(second, clipped, strict=True)]
        lr, eps = rate.unbind()
        values = [value - lr * m / (v.sqrt() + eps) for value, m, v in zip(values, first, second, strict=True)]
        return torch.cat([losses, norm[None]]), [*values, *first, *second]

    def _compile(self, keys: Sequence[Any], on_cpu: bool) -> Loop:
        """All updates of a call as one graph, however many there are; keys: of the leaves of minibatches [A, M, N]."""
        n, n_state, n_buffers = len(self.parameters), len(self._state), len(self.buffers)
        names = [tuple(name.split(".")) for name in (*self.parameters, *self.buffers)]

        def update(rate: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
            values = [value.detach().requires_grad_() for value in tensors[:n]]
            buffers, leaves = tensors[n_state : n_state + n_buffers], tensors[n_state + n_buffers :]
            batch = TensorDict(dict(zip(keys, leaves, strict=True)), leaves[0].shape[:2])
            with TensorDict(dict(zip(names, (*values, *buffers), strict=True))).to_module(self.objective):
                found, following = self._update(rate, [*values, *tensors[n:n_state]], batch)
            return found, *following

        return Loop(update, n_state, n_buffers, cpp_wrapper=on_cpu)  # elsewhere it needs that device's own headers
