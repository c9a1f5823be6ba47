"""How a policy acts: what its network says of each action, and the random choice of one.

`ACTS`, `HEADS` and `SHOWN` are tables. A record of `uavnav.algorithms`, or the header of a policy's file,
names an entry in each. Nothing but `Actor` has a generator; uniform numbers are arguments.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.func import functional_call

from uavnav import graph
from uavnav.tasks.seeding import Streams


def sample_categorical(logits: Tensor, uniform: Tensor) -> Tensor:
    """An action from softmax(logits) by inverting its cumulative distribution.

    logits [..., actions], uniform [...] in [0, 1) -> int64 [...].
    """
    cumulative = torch.softmax(logits, -1).cumsum(-1)
    return (cumulative <= uniform[..., None]).sum(-1).clamp(max=logits.shape[-1] - 1)


def epsilon_greedy(values: Tensor, epsilon: Tensor | float, coin: Tensor, choice: Tensor) -> Tensor:
    """The best action, or with probability epsilon a uniformly random one.

    values [..., actions], coin and choice [...] uniform in [0, 1) -> int64 [...].
    """
    n_actions = values.shape[-1]
    explored = (choice * n_actions).long().clamp(max=n_actions - 1)
    return torch.where(coin < epsilon, explored, values.argmax(-1))


def by_atom(outputs: Tensor, n_atoms: float) -> Tensor:
    """[..., rows x atoms] -> [..., rows, atoms]."""
    return outputs.reshape(*outputs.shape[:-1], -1, int(n_atoms))


def dueling(outputs: Tensor, n_atoms: float = 1) -> Tensor:
    """A state's value v and each action's advantage a as action values, v + a - mean a. Wang et al. (2016),
    eq. (9).

    outputs [..., (1 + actions) x atoms], v first -> [..., actions x atoms]; each atom by itself.
    """
    value, advantage = by_atom(outputs, n_atoms).tensor_split([1], -2)
    return (value + (advantage - advantage.mean(-2, keepdim=True))).flatten(-2)


def expected(logits: Tensor, least: float, most: float, n_atoms: float) -> Tensor:
    """Expected returns, from the logits of a distribution for each action. Bellemare et al. (2017), sec. 4.

    logits [..., actions x atoms], of atoms evenly spaced from least to most -> [..., actions].
    """
    atoms = torch.linspace(least, most, int(n_atoms), dtype=logits.dtype, device=logits.device)
    return (by_atom(logits, n_atoms).softmax(-1) * atoms).sum(-1)


class Act(NamedTuple):
    """A way to act in training."""

    uniforms: int  # random numbers an action
    # (values, epsilon, uniforms) -> actions
    choose: Callable[[Tensor, Tensor | float, Sequence[Tensor]], Tensor]


ACTS: dict[str, Act] = {
    "categorical": Act(1, lambda values, epsilon, uniforms: sample_categorical(values, *uniforms)),
    "epsilon-greedy": Act(2, lambda values, epsilon, uniforms: epsilon_greedy(values, epsilon, *uniforms)),
}

HEADS: dict[str, Callable[..., Tensor]] = {
    "direct": lambda outputs: outputs,
    "dueling": dueling,
    "distribution": expected,
    "dueling-distribution": lambda outputs, least, most, n: expected(dueling(outputs, n), least, most, n),
}
"""How a network's outputs [..., outputs] become one number an action [..., actions]; the largest is the
greedy one.

A policy names an entry with its numbers, if it has some: `direct`, or `distribution -10.0 9.0 51`.
"""

SHOWN: dict[str, Callable[[Tensor], Tensor]] = {
    "probability": lambda values: values.softmax(-1),
    "Q value": lambda values: values,
}
"""What a picture shows of those numbers, by its name there."""


def values_of(head: str, outputs: Tensor) -> Tensor:
    """One number an action by an entry in `HEADS`: outputs [..., outputs] -> [..., actions]."""
    name, *numbers = head.split()
    return HEADS[name](outputs, *map(float, numbers))


class Values(nn.Module):
    """A network and its head as one: observation [..., obs] -> [..., actions]."""

    def __init__(self, network: nn.Module, head: str) -> None:
        super().__init__()
        self.network, self.head = network, head

    def forward(self, observation: Tensor) -> Tensor:
        return values_of(self.head, self.network(observation))


class Actor(TensorDictModuleBase):  # type: ignore[misc]
    """Acts in training: observation [A, W, obs] -> action [A, W], each agent's from a stream of its own.

    Args:
        network: observation -> outputs, with the agent axis in front.
        seeds: one for each agent.
        acts, head: names of `ACTS` and `HEADS`; a head with its numbers.
        compile: run network and choice as one graph.
        epsilon: the share of random actions after so many frames per seed, where the way to act has one.
    """

    in_keys: ClassVar[list[str]] = ["observation"]
    out_keys: ClassVar[list[str]] = ["action"]

    def __init__(
        self,
        network: nn.Module,
        seeds: Sequence[int],
        acts: str,
        head: str,
        compile: bool,
        epsilon: Callable[[int], float] = lambda frames: 0.0,
    ) -> None:
        super().__init__()
        self.network, self.acts, self.head = network, acts, head
        self.streams = Streams(seeds, "actions")
        self._weights = dict(network.named_parameters())
        self.frames, self.schedule = 0, epsilon
        self.device = next(network.parameters()).device
        self._choose = graph.Graph(self.choose) if compile else self.choose

    def choose(
        self, observation: Tensor, uniform: Tensor, epsilon: Tensor, *weights: Tensor
    ) -> tuple[Tensor]:
        """Actions from uniform numbers [A, uniforms, W], by the network with these weights."""
        named = dict(zip(self._weights, weights, strict=True))
        values = values_of(self.head, functional_call(self.network, named, (observation,)))
        return (ACTS[self.acts].choose(values, epsilon, uniform.unbind(1)),)

    def draw(self, n_steps: int, n_envs: int) -> tuple[Tensor, Tensor]:
        """What so many next steps need: uniform numbers [T, A, uniforms, W] and epsilons [T]."""
        device, uniforms = self.device, ACTS[self.acts].uniforms
        numbers = self.streams.draw(torch.rand, n_steps, uniforms, n_envs, device=device)
        shares = [self.schedule(self.frames + step * n_envs) for step in range(n_steps)]
        self.frames += n_steps * n_envs
        return numbers.movedim(1, 0).contiguous(), torch.tensor(shares, dtype=torch.float32, device=device)

    @property
    def weights(self) -> list[Tensor]:
        """The network's, which learning writes in place."""
        return [*self._weights.values()]

    def act(self, observation: Tensor) -> Tensor:
        """Actions from the streams' next numbers."""
        (uniform,), (epsilon,) = self.draw(1, observation.shape[1])
        return self._choose(observation, uniform, epsilon, *self.weights)[0]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """As a collector calls it, without the Python of a TensorDictModule around `act`."""
        return tensordict.set("action", self.act(tensordict.get("observation")))

    def state_dict(self, *args: Any, **how: Any) -> dict[str, Any]:
        """Where the streams and the schedule are; the network's weights are the learner's to save."""
        return {**self.streams.state_dict(), "frames": torch.tensor(self.frames)}

    def load_state_dict(self, state_dict: Any, *args: Any, **how: Any) -> None:
        """Go on from there."""
        self.streams.load_state_dict(state_dict)
        self.frames = int(state_dict["frames"])
