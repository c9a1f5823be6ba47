"""Gradient steps of a whole population: TorchRL's loss, the gradient of each agent, its norm clipped, an optimiser.

Agents share no parameter, so the gradient of the sum of their losses is, agent by agent, the gradient of each one's
own loss; optimisers are elementwise; only the norm must be taken per agent. Letters: A agents, the leading axis of
every parameter and target; M minibatches of N rows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule

from uavnav.graph import Loop
from uavnav.training.optimisers import Optimiser, Tensors

LARGE = 2**20
"""Bytes of an agent's weights, moments and targets, from which agents learn in turn on a CPU.

An agent's minibatches then find these in the caches, which a step of all agents would empty.
"""

After = Callable[[Mapping[str, Tensor], Mapping[str, Tensor]], Mapping[str, Tensor]]
"""What follows a step: (parameters, buffers) of the loss by name -> the buffers that it changes, such as targets."""


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
    """Steps on the parameters of a TorchRL loss module, in place, any number of minibatches a call.

    Args:
        loss: built with `reduction="none"` on networks whose parameters lead with the agent axis. Its buffers of a
            parameter's shape, such as targets, do so too; others are everyone's.
        losses: names of what it returns; an agent's loss is the sum of their means over the agent's rows.
        optimiser: of `uavnav.training.optimisers`.
        max_grad_norm: each agent's gradient is scaled down to this norm; None leaves it as it is.
        compile: run all minibatches of a call as one compiled graph.
        after: what follows each step, such as targets that move softly; a pure function.
    """

    def __init__(
        self,
        loss: LossModule,
        losses: Sequence[str],
        optimiser: Optimiser,
        *,
        max_grad_norm: float | None,
        compile: bool,
        after: After | None = None,
    ) -> None:
        self.optimiser, self.after = optimiser, after
        self.max_grad_norm = math.inf if max_grad_norm is None else max_grad_norm
        self.compile = compile
        self.names = (*losses, "grad_norm")
        self.objective = _Objective(loss, losses)
        self.parameters = dict(self.objective.named_parameters())
        self.buffers = dict(self.objective.named_buffers())
        self.moments = [torch.zeros_like(value) for _ in range(optimiser.moments) for value in self.parameters.values()]
        self.steps = torch.zeros((), dtype=torch.float64, device=next(iter(self.parameters.values())).device)
        n_agents = len(next(iter(self.parameters.values())))
        held = sum(value.nbytes for value in (*self.parameters.values(), *self.moments, *self.buffers.values()))
        self.in_turn = self.steps.device.type == "cpu" and held >= LARGE * n_agents
        self._updates: dict[Any, Loop] = {}  # by the keys of minibatches

    def learn(self, batches: TensorDictBase) -> dict[str, Tensor]:
        """Updates from minibatches [A, M, N], one after the other; each agent's mean losses and gradient norm, [A]."""
        if not self.compile:
            steps = [self.step(batch) for batch in batches.unbind(1)]
            return {name: torch.stack([losses[name] for losses in steps]).mean(0) for name in self.names}
        with torch.no_grad():
            keys, leaves = zip(*batches.items(include_nested=True, leaves_only=True), strict=True)
            if keys not in self._updates:
                self._updates[keys] = self._compile(keys)
            rates, update = self._rates(batches.shape[1]), self._updates[keys]
            found = torch.cat([update(rates, *given)[0] for given in self._given(leaves)], -1)
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
        """Weights, targets, the optimiser's moments and steps."""
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
    def _followers(self) -> dict[str, Tensor]:
        """The buffers that `after` changes with each step."""
        return self.buffers if self.after is not None else {}

    @property
    def _constants(self) -> dict[str, Tensor]:
        """The buffers that no step changes."""
        return self.buffers if self.after is None else {}

    @property
    def _state(self) -> list[Tensor]:
        """What an update changes: the parameters, then the optimiser's moments, then the buffers that follow."""
        return [*self.parameters.values(), *self.moments, *self._followers.values()]

    def _rates(self, n: int) -> Tensor:
        """What the optimiser needs of the next n steps: [n, rates]."""
        step = self.steps + torch.arange(1, n + 1, device=self.steps.device)
        return self.optimiser.rates(step).to(next(iter(self.parameters.values())).dtype)

    def _given(self, leaves: Sequence[Tensor]) -> list[list[Tensor]]:
        """State, constants and the leaves of minibatches: of all agents at once, or of each in turn."""
        held = [*self._state, *self._constants.values()]
        if not self.in_turn:
            return [[*held, *leaves]]
        shapes = {value.shape for value in self.parameters.values()}
        return [
            [
                *(value[agent : agent + 1] if value.shape in shapes else value for value in held),
                *(leaf[agent : agent + 1] for leaf in leaves),
            ]
            for agent in range(len(leaves[0]))
        ]

    def _gradient(self, parameters: Tensors, batch: TensorDictBase) -> tuple[Tensors, Tensor]:
        """The gradient of each parameter that the objective holds now, and the losses [losses, A]."""
        with torch.enable_grad():
            total, losses = self.objective(batch)
            return torch.autograd.grad(total, parameters), losses

    def _update(self, rate: Tensor, state: Tensors, batch: TensorDictBase) -> tuple[Tensor, list[Tensor]]:
        """One step: the losses and the gradient's norm [losses + 1, A], and the next state."""
        n = len(self.parameters)
        kept = n * (1 + self.optimiser.moments)
        values, *moments = (state[first : first + n] for first in range(0, kept, n))
        gradient, losses = self._gradient(values, batch)
        norm = torch.stack([part.flatten(1).square().sum(1) for part in gradient]).sum(0).sqrt()
        scale = (self.max_grad_norm / (norm + 1e-6)).clamp(max=1.0)  # as torch.nn.utils.clip_grad_norm_
        clipped = [part * scale.reshape(-1, *[1] * (part.ndim - 1)) for part in gradient]
        values, *moments = self.optimiser.update(rate, values, clipped, *moments)
        following = [*values, *(value for part in moments for value in part)]
        if self.after is not None:
            buffers = dict(zip(self.buffers, state[kept:], strict=True))
            changed = self.after(dict(zip(self.parameters, values, strict=True)), buffers)
            # a copy of the others: a graph must not give back what it was given
            following += [changed[name] if name in changed else value.clone() for name, value in buffers.items()]
        return torch.cat([losses, norm[None]]), following

    def _compile(self, keys: Sequence[Any]) -> Loop:
        """All updates of a call as one graph, however many there are; keys: of the leaves of minibatches [A, M, N]."""
        n, n_state, n_constants = len(self.parameters), len(self._state), len(self._constants)
        kept = n * (1 + self.optimiser.moments)
        names = [tuple(name.split(".")) for name in (*self.parameters, *self.buffers)]

        def update(rate: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
            values = [value.detach().requires_grad_() for value in tensors[:n]]
            buffers, leaves = tensors[kept : n_state + n_constants], tensors[n_state + n_constants :]
            batch = TensorDict(dict(zip(keys, leaves, strict=True)), leaves[0].shape[:2])
            with TensorDict(dict(zip(names, (*values, *buffers), strict=True))).to_module(self.objective):
                found, following = self._update(rate, [*values, *tensors[n:n_state]], batch)
            return found, *following

        on_cpu = self.steps.device.type == "cpu"  # elsewhere the wrapper needs that device's own headers
        return Loop(update, n_state, n_constants, cpp_wrapper=on_cpu)
