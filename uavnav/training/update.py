"""Gradient steps of a whole population: the gradient of each agent's loss, its norm clipped, and an
optimiser's step.

Agents share no parameter, so the gradient of the sum of their losses is, agent by agent, the gradient of each
one's own loss; optimisers are elementwise; only the norm must be taken per agent. A step is a pure function,
so that many of them fit into one graph. All weights of an agent lie in one row, its moments and targets too,
because a graph pays for each tensor that it carries. Letters: A agents, the leading axis of every parameter
and target; P numbers in a row; M minibatches of N rows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.nn import functional as F

from uavnav.graph import Loop, parts

BETA1, BETA2 = 0.9, 0.999  # Adam's, as everywhere
ALPHA = 0.99  # RMSprop's, PyTorch's and Stable-Baselines3's default
AHEAD = 1_024  # steps whose rates are worked out at once
ALIGNED = 16  # numbers: 64 bytes, as PyTorch aligns memory, so that products have the same bits
FEW = 2**16
"""Weights in a call up to which one step for all of them is worth a copy of their gradient."""
LARGE = 2**20
"""Bytes of an agent's weights, moments and targets, from which agents learn in turn on a CPU.

An agent's minibatches then find these in the caches, which a step of all agents would empty.
"""


Read = Callable[..., TensorDictBase]
"""Turns a minibatch, and the tensors of `memory`, into what a loss takes; compiled with the step."""


def falling(lr: float, step: Tensor, until: float) -> Tensor:
    """The learning rate of a step, counted from 1, if it falls linearly to 0 over `until` steps."""
    return lr * (1 - (step - 1) / until)


class Adam(NamedTuple):
    """As at the end of section 2 of Kingma and Ba (2015): the bias of the moments is corrected in the
    rate, which may fall linearly to 0 over `until` steps.
    """

    lr: float
    eps: float
    moments: tuple[str, ...] = ("first", "second")
    until: float = math.inf

    def rates(self, step: Tensor) -> Tensor:
        """step [M] float64, counted from 1 -> what `step` is given of each, [M, 2]."""
        correction = (1 - BETA2**step).sqrt()
        lr = falling(self.lr, step, self.until)
        return torch.stack([lr * correction / (1 - BETA1**step), self.eps * correction], -1)

    def step(self, rate: Tensor, params: Tensor, gradient: Tensor, *moments: Tensor) -> tuple[Tensor, ...]:
        """Parameters, their gradient and its moments -> the next parameters and moments."""
        lr, eps = rate.unbind()
        first, second = moments
        first = torch.lerp(first, gradient, 1 - BETA1)
        second = second * BETA2 + (1 - BETA2) * gradient * gradient
        return params - lr * first / (second.sqrt() + eps), first, second


class RMSprop(NamedTuple):
    """Hinton's, as `torch.optim.RMSprop` and Stable-Baselines3's A2C have it."""

    lr: float
    eps: float
    moments: tuple[str, ...] = ("square",)
    until: float = math.inf

    def rates(self, step: Tensor) -> Tensor:
        """step [M] float64 -> what `step` is given of each, [M, 1]."""
        return falling(self.lr, step, self.until)[:, None]

    def step(self, rate: Tensor, params: Tensor, gradient: Tensor, square: Tensor) -> tuple[Tensor, ...]:
        """Parameters, their gradient and its mean square -> the next parameters and mean square."""
        square = square * ALPHA + (1 - ALPHA) * gradient * gradient
        return params - rate[0] * gradient / (square.sqrt() + self.eps), square


def flattened(values: Sequence[Tensor]) -> Tensor:
    """[A, ...] each -> [A, P]: a row of numbers an agent, each tensor from a multiple of `ALIGNED` on."""
    rows = [value.reshape(len(value), -1) for value in values]
    return torch.cat([F.pad(row, (0, -row.shape[1] % ALIGNED)) for row in rows], 1)


def unflattened(flat: Tensor, like: TensorDictBase) -> TensorDict:
    """The tensors of such rows, as views, with the names of `like` and its shapes of an agent."""
    shapes = {name: value.shape[1:] for name, value in like.items()}
    rooms = [shape.numel() + -shape.numel() % ALIGNED for shape in shapes.values()]
    pieces = zip(shapes.items(), flat.split_with_sizes(rooms, 1), strict=True)
    views = {name: piece[:, : shape.numel()].view(len(flat), *shape) for (name, shape), piece in pieces}
    return TensorDict(views, flat.shape[:1])


@torch.no_grad()
def in_one(values: TensorDictBase) -> Tensor:
    """Move these tensors into one, [A, P], of which they become views."""
    flat = flattened([*values.values()])
    for value, view in zip(values.values(), unflattened(flat, values).values(), strict=True):
        value.data = view
    return flat


class Learner:
    """Steps on the parameters of a loss module, in place, any number of minibatches a call.

    Args:
        loss: a batch [A, N] -> losses [A, N] by name, of networks whose parameters lead with the agent axis.
            These become views of one tensor: move networks to a device or type before. As in TorchRL, the
            target of a parameter has its name with `target_` in front, and needs no gradient.
        losses: names of what it returns; an agent's loss is the sum of their means over the agent's rows.
        optimiser: `Adam` or `RMSprop`.
        max_grad_norm: each agent's gradient is scaled down to this norm; None leaves it as it is.
        compile: run all minibatches of a call as one compiled graph.
        tau: the share of the way to its parameter that a target goes after each step.
        read: makes of a minibatch what the loss is given, as a part of the step.
        memory: what `read` is given too; whoever owns it writes it between two calls.
    """

    def __init__(
        self,
        loss: nn.Module,
        losses: Sequence[str],
        optimiser: Adam | RMSprop,
        *,
        max_grad_norm: float | None,
        compile: bool,
        tau: float = 0.0,
        read: Read = lambda batch: batch.clone(False),
        memory: Sequence[Tensor] = (),
    ) -> None:
        self.loss, self.optimiser, self.read, self.memory = loss, optimiser, read, memory
        self.names = (*losses, "grad_norm")
        self.max_grad_norm = math.inf if max_grad_norm is None else max_grad_norm
        self.compile, self.tau = compile, tau
        params = {name: value for name, value in loss.named_parameters() if value.requires_grad}
        others = {
            name: value
            for name, value in (*loss.named_parameters(), *loss.named_buffers())
            if name not in params
        }
        targets = {name: value for name, value in others.items() if name.removeprefix("target_") in params}
        self.constants = TensorDict({name: value for name, value in others.items() if name not in targets})
        agents = [len(next(iter(params.values())))]
        self.params, self.targets = TensorDict(params, agents), TensorDict(targets, agents)
        self.flat = {"params": in_one(self.params)}  # then moments, then targets
        for name in optimiser.moments:
            self.flat[name] = torch.zeros_like(self.flat["params"])
        if targets:
            self.flat["targets"] = in_one(self.targets)
        self.steps = 0
        self._ahead = 0, torch.empty(0)  # steps that were done, and the rates of those that follow
        self._run: Callable[[TensorDictBase], Tensor] | None = None  # compiled at the first call

    def learn(self, batches: TensorDictBase) -> dict[str, Tensor]:
        """Updates from minibatches [A, M, N] in turn; each agent's mean losses and gradient norm, [A]."""
        if not self.compile:
            steps = [self.step(batch) for batch in batches.unbind(1)]
            return {name: torch.stack([found[name] for found in steps]).mean(0) for name in steps[0]}
        with torch.no_grad():
            self._run = self._run or self._compiled(batches)
            found = self._run(batches)
            self.steps += batches.shape[1]
        return dict(zip(self.names, found, strict=True))

    def step(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """One update of every agent from a minibatch [A, N]; each agent's losses and gradient norm, [A]."""
        with torch.no_grad():
            found, following = self._update(
                self.rates(1)[0], self.params, [*self.flat.values()], self.memory, batch
            )
            for value, new in zip(self.flat.values(), following, strict=False):  # targets may stay
                value.copy_(new)
            self.steps += 1
        return dict(zip(self.names, found, strict=True))

    def _update(
        self,
        rate: Tensor,
        params: TensorDictBase,
        flat: Sequence[Tensor],
        memory: Sequence[Tensor],
        batch: TensorDictBase,
    ) -> tuple[Tensor, Sequence[Tensor]]:
        """One step: the losses and the gradient's norm [losses + 1, A], and what follows on `flat`."""
        with torch.enable_grad():
            found = self.loss(self.read(batch, *memory))  # DQNLoss writes its errors into what it is given
            losses = torch.stack([found[name].flatten(1).mean(1) for name in self.names[:-1]])
            gradients = torch.autograd.grad(losses.sum(), list(params.values()))
        norm = torch.stack([one.flatten(1).square().sum(1) for one in gradients]).sum(0).sqrt()
        scale = (self.max_grad_norm / (norm + 1e-6)).clamp(max=1.0)  # as torch.nn.utils.clip_grad_norm_
        clipped = [one * scale.reshape(-1, *[1] * (one.ndim - 1)) for one in gradients]
        n = 1 + len(self.optimiser.moments)
        if flat[0].numel() <= FEW:
            following = [*self.optimiser.step(rate, flat[0], flattened(clipped), *flat[1:n])]
        else:
            values = (unflattened(each, params).values() for each in flat[:n])
            after = [
                self.optimiser.step(rate, value, gradient, *moments)
                for gradient, value, *moments in zip(clipped, *values, strict=True)
            ]
            following = [flattened(each) for each in zip(*after, strict=True)]
        if self.tau:
            weights, targets = unflattened(following[0], params), unflattened(flat[-1], self.targets)
            towards = [
                target.lerp(weights[name.removeprefix("target_")], self.tau)
                for name, target in targets.items()
            ]
            following.append(flattened(towards))
        return torch.cat([losses.detach(), norm[None]]), following

    def rates(self, n: int) -> Tensor:
        """What the optimiser needs of the next n steps [n, rates], worked out for many steps at once."""
        first, rates = self._ahead
        if not first <= self.steps <= first + len(rates) - n:
            first, weight = self.steps, next(iter(self.params.values()))
            step = first + torch.arange(1, max(n, AHEAD) + 1, dtype=torch.float64, device=weight.device)
            rates = self.optimiser.rates(step).to(weight.dtype)
            self._ahead = first, rates
        return rates[self.steps - first :][:n]

    @property
    def tensors(self) -> list[Tensor]:
        """What an update is given besides its rate, memory and minibatch; first what it changes."""
        return [*self.flat.values(), *self.constants.values()]

    @property
    def n_changed(self) -> int:
        """How many of `tensors` an update changes: weights and moments, and targets that follow softly."""
        return 1 + len(self.optimiser.moments) + bool(self.tau)

    @property
    def on_cpu(self) -> bool:
        return bool(next(iter(self.params.values())).device.type == "cpu")

    @property
    def in_turn(self) -> bool:
        """Whether agents are so large that they are updated one after the other."""
        return self.on_cpu and sum(value.nbytes for value in self.tensors) >= LARGE * len(self.params)

    def loop(self, keys: Sequence[str], n_memory: int) -> Loop:
        """Updates from minibatches with these keys, as one graph however many they are."""
        n_constants = len(self.constants.keys())

        def update(rate: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
            flat, constants, memory, leaves = parts(tensors, len(self.flat), n_constants, n_memory)
            batch = TensorDict(dict(zip(keys, leaves, strict=True)), leaves[-1].shape[:2])
            params = unflattened(flat[0], self.params).apply(lambda value: value.detach().requires_grad_())
            others = dict(zip(self.constants.keys(), constants, strict=True))
            if "targets" in self.flat:
                others |= unflattened(flat[-1], self.targets)
            others = TensorDict(others).unflatten_keys(".")
            with (
                TensorDict({**params}).unflatten_keys(".").to_module(self.loss),
                # else tensordict makes new Parameters of what needs no gradient, and these are not traced
                others.to_module(self.loss, preserve_module_state=False),
            ):
                found, following = self._update(rate, params, flat, memory, batch)
            return found, *following

        # elsewhere the wrapper needs that device's own headers
        n_kept = len(self.tensors) - self.n_changed + n_memory
        return Loop(update, self.n_changed, n_kept, cpp_wrapper=self.on_cpu)

    def _compiled(self, batches: TensorDictBase) -> Callable[[TensorDictBase], Tensor]:
        """All updates of a call as one graph, however many, of all agents at once or of each in turn."""
        keys = list(batches.keys(True, True, sort=True))  # also those of a refilled buffer: one graph
        loop, n_agents = self.loop(keys, len(self.memory)), len(self.params)
        turns = [slice(agent, agent + 1) for agent in range(n_agents)] if self.in_turn else [slice(None)]
        constants = [*self.constants.values(), *self.memory]
        states = [[*(one[agents] for one in self.flat.values()), *constants] for agents in turns]

        def run(batches: TensorDictBase) -> Tensor:
            rates, leaves = self.rates(batches.shape[1]), [batches[key] for key in keys]
            found = [
                loop(rates, *state, *(leaf[agents] for leaf in leaves))[0]
                for agents, state in zip(turns, states, strict=True)
            ]
            return torch.cat(found, -1)

        return run

    @property
    def state(self) -> TensorDict:
        """Weights, moments and targets by name; views."""
        moments = {name: unflattened(self.flat[name], self.params) for name in self.optimiser.moments}
        followers = {"targets": self.targets} if "targets" in self.flat else {}
        return TensorDict({"params": self.params, "moments": moments, **followers}, self.params.shape)

    def state_dict(self) -> dict[str, Any]:
        """Weights, moments, targets, and how many steps there were."""
        return {"state": self.state.detach().clone().to_dict(), "steps": torch.tensor(self.steps)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Write in place what `state_dict` returned, so that the networks elsewhere follow."""
        with torch.no_grad():
            self.state.update_(TensorDict(state_dict["state"], self.params.shape))
        self.steps = int(state_dict["steps"])
