"""Flyers that act side by side: policies that differ in their weights alone are evaluated as one product.

A product rounds by how many rows each network has, and not by how many networks. So each network's rows are filled up
to a number that its own rows decide: whoever acts among others does, bit for bit, what it does here alone. Letters: F
flights that are up, P policies of a squad, N rows of each, filled up.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from uavnav.networks import made_of, stacked
from uavnav.runs.policies import Policy
from uavnav.tasks.baselines import AnyPolicy

Flyers = Sequence[tuple[int, AnyPolicy]]
"""Seeds and their policies."""
Chosen = tuple[Tensor, Tensor | None]
"""Actions, and the numbers behind them where they were asked for."""

ROWS_AGREE_FROM = 4
"""From so many rows, a product rounds by its columns alone on the machines that were tried; fewer round otherwise."""
LEAST_ROWS = 16
"""A network has at least so many rows in a product; fewer take as long."""


class Alone(NamedTuple):
    """One policy of whatever kind."""

    policy: AnyPolicy
    generator: torch.Generator
    rows: Tensor  # [N] of all flights, its own

    def act(self, observation: Tensor, values: bool) -> Chosen:
        """[F, obs] -> [N], [N, actions]."""
        seen = observation[self.rows]
        if not values:
            return self.policy(seen, self.generator), None
        assert isinstance(self.policy, Policy)
        behind = self.policy.values(seen)
        return self.policy.act(behind, self.generator), behind


class Crew(NamedTuple):
    """Policies of a squad that act in the same way."""

    policy: Policy  # one of them
    generators: Sequence[torch.Generator]
    sizes: Sequence[int]  # how many rows each has

    def act(self, behind: Tensor) -> Tensor:
        """[P, N, actions] -> [P, N]."""
        if self.policy.greedy:
            return behind.argmax(-1)
        drawn = [
            F.pad(self.policy.draw((size,), generator), (0, behind.shape[1] - size))
            for size, generator in zip(self.sizes, self.generators, strict=True)
        ]
        return self.policy.choose(behind, torch.stack(drawn, 1))


class Squad(NamedTuple):
    """Several policies as one, whose network has the agents of all."""

    policy: Policy
    crews: Sequence[Crew]  # whose policies those are, in turn
    rows: Tensor  # [P, N] of all flights, each policy's own; the last one again where it has fewer

    def act(self, observation: Tensor, values: bool) -> Chosen:
        """[F, obs] -> [P N], [P N, actions]."""
        behind = self.policy.of_agents(observation[self.rows])
        own = torch.split(behind, [len(crew.sizes) for crew in self.crews])
        actions = torch.cat([crew.act(part) for crew, part in zip(self.crews, own, strict=True)])
        return actions.flatten(), behind.flatten(0, 1)


class Squads:
    """Some flyers, each with a generator of its own; n_actions: that they choose from."""

    def __init__(self, flyers: Flyers, n_actions: int) -> None:
        self._policies = [policy for _, policy in flyers]
        self._generators = [torch.Generator().manual_seed(seed) for seed, _ in flyers]
        self._kinds = [_kind(policy) for policy in self._policies]
        self._n_actions = n_actions
        self._sizes: list[int] = []
        self._stacked: dict[tuple[int, ...], Policy] = {}  # by its flyers
        self._dealt: list[Alone | Squad] = []
        self._back = torch.empty(0, dtype=torch.int64)  # [F] where a row lies among those of all squads

    def act(self, observation: Tensor, sizes: list[int], values: bool = False) -> Chosen:
        """An action for each row [F], each flyer's in turn; sizes: how many it has.

        Raises:
            ValueError: a policy chose something that is no action.
        """
        if sizes != self._sizes:
            self._deal(sizes)
        actions, behind = [], []
        for squad in self._dealt:
            action, numbers = squad.act(observation, values)
            actions.append(_checked(action, squad.rows.numel(), self._n_actions))
            behind += [numbers] if values and numbers is not None else []
        return torch.cat(actions)[self._back].long(), torch.cat(behind)[self._back] if behind else None

    def _deal(self, sizes: list[int]) -> None:
        """Who acts with whom: flyers whose networks are of one kind and have as many rows, filled up."""
        groups: dict[tuple[object, int], dict[object, list[int]]] = {}  # of each, flyers by how they act
        for flyer, (kind, size) in enumerate(zip(self._kinds, sizes, strict=True)):
            if size:
                group = groups.setdefault((flyer, size) if kind is None else (kind.network, kind.width(size)), {})
                group.setdefault(kind and kind.acts, []).append(flyer)
        starts = [0, *itertools.accumulate(sizes)]
        kept, self._stacked = self._stacked, {}
        self._dealt, self._back, first = [], torch.empty(starts[-1], dtype=torch.int64), 0
        for (_, width), crews in groups.items():
            flyers = tuple(flyer for crew in crews.values() for flyer in crew)
            own = {flyer: torch.arange(starts[flyer], starts[flyer + 1]) for flyer in flyers}
            if self._kinds[flyers[0]] is None:
                self._dealt.append(Alone(self._policies[flyers[0]], self._generators[flyers[0]], own[flyers[0]]))
            else:
                self._stacked[flyers] = kept.get(flyers) or self._as_one(flyers)
                self._dealt.append(
                    Squad(
                        self._stacked[flyers],
                        [self._crew(crew, own) for crew in crews.values()],
                        torch.stack([_filled_up(rows, width) for rows in own.values()]),
                    )
                )
            for place, rows in enumerate(own.values()):
                self._back[rows] = first + place * width + torch.arange(len(rows))
            first += len(flyers) * width
        self._sizes = sizes

    def _as_one(self, flyers: Sequence[int]) -> Policy:
        """One policy whose network has the agents of theirs."""
        theirs = [policy for flyer in flyers if isinstance(policy := self._policies[flyer], Policy)]
        return replace(theirs[0], network=stacked([policy.network for policy in theirs]))

    def _crew(self, flyers: Sequence[int], own: Mapping[int, Tensor]) -> Crew:
        """Flyers that act alike; own: everybody's rows."""
        policy = self._policies[flyers[0]]
        assert isinstance(policy, Policy)
        return Crew(policy, [self._generators[flyer] for flyer in flyers], [len(own[flyer]) for flyer in flyers])


class Kind(NamedTuple):
    """What decides with whom a policy acts."""

    network: tuple[object, ...]  # layers and head: of those alike, many are one product
    acts: tuple[object, ...]  # how it acts, whether greedily first

    def width(self, n: int) -> int:
        """How many rows its network has in a product if it has n of its own: 16, 32, 64, ...

        Rows of greedy flights must not depend on how many are counted instead of flown. Sampled ones keep the 1 to 3
        rows that they had in all versions.
        """
        return n if n < ROWS_AGREE_FROM and not self.acts[0] else max(LEAST_ROWS, 1 << (n - 1).bit_length())


def _kind(policy: AnyPolicy) -> Kind | None:
    """That of a policy; None of one that acts alone."""
    if not isinstance(policy, Policy) or (layers := made_of(policy.network)) is None:
        return None
    return Kind((layers, policy.head), (policy.greedy, policy.acts, policy.epsilon))


def _filled_up(rows: Tensor, width: int) -> Tensor:
    """Rows [n], the last one again until there are as many as `width`."""
    return torch.cat([rows, rows[-1:].expand(width - len(rows))])


def _checked(action: Tensor, n: int, n_actions: int) -> Tensor:
    """Actions of n rows, if they are some."""
    fits = isinstance(action, Tensor) and action.shape == (n,) and action.dtype in (torch.int64, torch.int32)
    if not fits or not 0 <= int(action.min()) <= int(action.max()) < n_actions:
        shown = f"{action.dtype} {list(action.shape)}" if isinstance(action, Tensor) and not fits else repr(action)
        raise ValueError(f"a policy chose {shown}; it must give int64 [{n}] from 0 to {n_actions - 1}")
    return action
