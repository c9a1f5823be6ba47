"""Policies that act side by side: those of a run as one network [A, ...], and every other one in turn.

From four rows on, a product rounds only by its columns. Each agent has at least 16, so that its actions do
not depend on who else acts. Letters: A agents, F rows of all policies, N of some, W of each agent in a
product.
"""

from __future__ import annotations

import contextlib
import inspect
import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from uavnav.errors import told
from uavnav.networks import made_of, stacked
from uavnav.runs.policies import Policy
from uavnav.tasks.baselines import AnyPolicy

Seeded = tuple[int, AnyPolicy]  # the seed of a policy's generator, and the policy

INTEGERS = (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)
LEAST_ROWS = 16
"""Of an agent in a product. Where it was tried, fewer than 4 round otherwise, and 16 take as long."""


class Policies:
    """Some policies, each with a generator of its own; n_actions: that they choose from."""

    def __init__(self, policies: Sequence[Seeded], n_actions: int) -> None:
        self._n_actions = n_actions
        self._groups: list[Agents | Alone] = []

        def network(seeded: Seeded) -> tuple[object, ...] | None:  # None of a scripted policy
            own = seeded[1]
            if not isinstance(own, Policy):
                return None
            shield = own.world if own.under_shield else None
            return made_of(own.network) or object(), own.head, shield

        for some in ([*alike] for _, alike in itertools.groupby(policies, network)):
            agents = [(seed, policy) for seed, policy in some if isinstance(policy, Policy)]
            self._groups += [Agents(agents)] if agents else [Alone(*one) for one in some]

    def act(self, observation: Tensor, sizes: Sequence[int]) -> tuple[Tensor, Tensor | None]:
        """An action for each row, and the numbers behind it unless it is scripted: [F, obs] -> [F], [F, n].

        sizes: how many rows each policy has, in turn. Raises a ValueError for what is no action.
        """
        each = iter(sizes)
        own_sizes = [[*itertools.islice(each, group.n)] for group in self._groups]
        rows = torch.split(observation, [sum(own) for own in own_sizes])
        actions, values = [], []
        for group, own, seen in zip(self._groups, own_sizes, rows, strict=True):
            if len(seen):
                action, behind = group.act(seen, own)
                self._check(action, len(seen))
                actions.append(action)
                values += [] if behind is None else [behind]
        if len(values) == len(actions) == 1:
            return actions[0], values[0]
        return torch.cat(actions).long(), torch.cat(values) if len(values) == len(actions) else None

    def _check(self, action: Tensor, n: int) -> None:
        fits = isinstance(action, Tensor) and action.shape == (n,) and action.dtype in INTEGERS
        if not fits or not 0 <= int(action.min()) <= int(action.max()) < self._n_actions:
            shown = (
                f"{action.dtype} {list(action.shape)}"
                if isinstance(action, Tensor) and not fits
                else told(repr(action))
            )
            raise ValueError(
                f"a policy chose {shown}; it must give whole numbers [{n}] from 0 to {self._n_actions - 1}"
            )


class Agents:
    """Policies whose networks differ only in their weights, as one network."""

    def __init__(self, policies: Sequence[tuple[int, Policy]]) -> None:
        self.n = len(policies)
        self._policies = [policy for _, policy in policies]
        self._generators = [torch.Generator().manual_seed(seed) for seed, _ in policies]

        def way(agent: int) -> tuple[object, ...]:
            own = self._policies[agent]
            return own.greedy, own.acts, own.epsilon

        ways = itertools.groupby(range(self.n), way)
        self._alike = [[*agents] for _, agents in ways]
        """Neighbours that act in the same way."""
        self._sizes: list[int] = []
        self._up: list[int] = []
        """Agents that have rows, and so are in the network."""

    def act(self, observation: Tensor, sizes: list[int]) -> tuple[Tensor, Tensor]:
        """[N, obs], rows of each agent -> actions [N], values [N, actions]."""
        if sizes != self._sizes:
            self._arrange(sizes)
        values = self._network.of_agents(observation[self._rows])[self._own]
        parts = torch.split(values, [sum(sizes[agent] for agent in agents) for agents in self._alike])
        actions = []
        for agents, part in zip(self._alike, parts, strict=True):
            policy = self._policies[agents[0]]
            uniforms = [policy.draw((sizes[agent],), self._generators[agent]) for agent in agents]
            actions.append(policy.choose(part, torch.cat(uniforms, -1)))
        return self._policies[0].kept_safe(torch.cat(actions), observation), values

    def _arrange(self, sizes: list[int]) -> None:
        """Lay out the rows of each agent that has some [A, W]; the last one again where there are fewer."""
        up = [agent for agent, size in enumerate(sizes) if size]
        if up != self._up:
            networks = [self._policies[agent].network for agent in up]
            self._network = replace(
                self._policies[0], network=stacked(networks) if len(up) > 1 else networks[0]
            )
            self._up = up
        n = torch.tensor(sizes)[up, None]
        column = torch.arange(max(LEAST_ROWS, *sizes))
        self._own = column < n
        self._rows = n.cumsum(0) - n + column.minimum(n - 1)
        self._sizes = sizes


class Alone:
    """Any other policy, such as a scripted one: it may take only an observation and give an array or list."""

    n = 1

    def __init__(self, seed: int, policy: Callable[..., Any]) -> None:
        self._policy = policy
        self._generators = [torch.Generator().manual_seed(seed)] if _takes_generator(policy) else []

    def act(self, observation: Tensor, sizes: list[int]) -> tuple[Any, None]:
        """[N, obs] -> actions [N], and nothing behind them."""
        action = self._policy(observation, *self._generators)
        with contextlib.suppress(TypeError, ValueError, RuntimeError):  # no array: it is refused as it is
            action = torch.as_tensor(action)
        return action, None


def _takes_generator(policy: Callable[..., Any]) -> bool:
    """Whether a policy takes two arguments."""
    try:
        inspect.signature(getattr(policy, "forward", policy)).bind(None, None)
    except TypeError:
        return False
    except ValueError:  # of a function in C nothing is known
        return True
    return True
