"""One gradient step of a whole population: TorchRL's loss, the gradient of each agent, its norm clipped, Adam.

Agents share no parameter, so the gradient of the sum of their losses is, agent by agent, the gradient of each one's
own loss; Adam is elementwise; only the norm must be taken per agent. Letter: A agents, the leading axis of every
parameter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.optim.adam import adam
from torchrl.objectives import LossModule

AgentLosses = Callable[[TensorDictBase], dict[str, Tensor]]
"""From what a loss module returned with `reduction="none"`: name -> [A], each agent's mean. The loss is their sum."""


class _Objective(nn.Module):
    """A loss module as a plain module from a batch to the population's scalar and each agent's parts.

    The tracer needs a plain `nn.Module` outermost: a `LossModule` has a `named_parameters` of its own.
    """

    def __init__(self, loss: LossModule, agent_losses: AgentLosses) -> None:
        super().__init__()
        self.loss = loss
        self.agent_losses = agent_losses

    def forward(self, batch: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        losses = self.agent_losses(self.loss(batch))
        return sum(losses.values(), torch.zeros(())).sum(), {name: part.detach() for name, part in losses.items()}


class Learner:
    """Adam on the parameters of a TorchRL loss module, in place, one minibatch a call.

    Args:
        loss: built with `reduction="none"` on networks whose parameters lead with the agent axis.
        agent_losses: how each agent's losses follow from what the module returns.
        lr, eps: Adam's.
        max_grad_norm: each agent's gradient is scaled down to this norm.
        compile: run loss, gradient, clipping and Adam as one compiled graph.
    """

    def __init__(
        self,
        loss: LossModule,
        agent_losses: AgentLosses,
        *,
        lr: float,
        eps: float,
        max_grad_norm: float,
        compile: bool,
    ) -> None:
        self.lr, self.eps, self.max_grad_norm = lr, eps, max_grad_norm
        self.objective = _Objective(loss, agent_losses)
        self.parameters = dict(self.objective.named_parameters())
        self.first_moments = [torch.zeros_like(value) for value in self.parameters.values()]
        self.second_moments = [torch.zeros_like(value) for value in self.parameters.values()]
        self.steps = [torch.zeros((), device=value.device) for value in self.parameters.values()]
        self._step = self._update
        if compile:
            torch._dynamo.config.trace_autograd_ops = True  # let the gradient be a part of the graph
            self._step = torch.compile(self._update, dynamic=False, fullgraph=True)

    def step(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """One update of every agent from a minibatch [A, N]; returns each agent's losses and gradient norm, [A]."""
        with torch.no_grad():
            return self._step(batch)

    def state_dict(self) -> dict[str, dict[str, Tensor]]:
        """Weights, targets, Adam's moments and steps."""
        return {
            "network": {name: value.detach().clone() for name, value in self._tensors()},
            "first_moments": {str(index): value.clone() for index, value in enumerate(self.first_moments)},
            "second_moments": {str(index): value.clone() for index, value in enumerate(self.second_moments)},
            "steps": {str(index): value.clone() for index, value in enumerate(self.steps)},
        }

    def load_state_dict(self, state_dict: dict[str, dict[str, Tensor]]) -> None:
        """Write in place what `state_dict` returned, so that the networks elsewhere follow."""
        with torch.no_grad():
            for name, value in self._tensors():
                value.copy_(state_dict["network"][name])
            for kind in ("first_moments", "second_moments", "steps"):
                for index, value in enumerate(getattr(self, kind)):
                    value.copy_(state_dict[kind][str(index)])

    def _tensors(self) -> Iterator[tuple[str, Tensor]]:
        yield from self.objective.named_parameters()
        yield from self.objective.named_buffers()

    def gradient(self, batch: TensorDictBase) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """The gradient by parameter, unclipped, and each agent's losses [A]."""
        with torch.enable_grad():
            total, losses = self.objective(batch.clone(False))  # DQNLoss writes its errors into what it is given
            gradient = torch.autograd.grad(total, list(self.parameters.values()))
        return dict(zip(self.parameters, gradient, strict=True)), losses

    def _update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        gradient, losses = self.gradient(batch)
        norm = torch.stack([part.flatten(1).square().sum(1) for part in gradient.values()]).sum(0).sqrt()
        scale = (self.max_grad_norm / (norm + 1e-6)).clamp(max=1.0)  # as torch.nn.utils.clip_grad_norm_
        adam(
            list(self.parameters.values()),
            [part * scale.reshape(-1, *[1] * (part.ndim - 1)) for part in gradient.values()],
            self.first_moments,
            self.second_moments,
            [],
            self.steps,
            foreach=False,
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=self.lr,
            weight_decay=0.0,
            eps=self.eps,
            maximize=False,
        )
        return losses | {"grad_norm": norm}
