"""Flyers that act side by side: policies that differ in their weights alone are evaluated as one product.

No row joins a policy's own, because a product rounds by how many rows each network has, and not by how many networks:
whoever acts in a squad does, bit for bit, what it does alone. Letters: F flights that are up, P policies of a squad, N
flights of each.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from uavnav.networks import made_of, stacked
from uavnav.policies import Policy
from uavnav.tasks.baselines import AnyPolicy

Flyers = Sequence[tuple[int, AnyPolicy]]
"""Seeds and their policies."""
Chosen = tuple[Tensor, Tensor | None]
"""Actions, and the numbers behind them where they were asked for."""


class Alone(NamedTuple):
    """One policy of whatever kind."""

    policy: AnyPolicy
    generator: torch.Generator

    def act(self, observation: Tensor, values: bool) -> Chosen:
        """[N, obs] -> [N], [N, actions]."""
        if not values:
            return self.policy(observation, self.generator), None
        assert isinstance(self.policy, Policy)
        behind = self.policy.values(observation)
        return self.policy.act(behind, self.generator), behind


class Squad(NamedTuple):
    """Several policies as one, whose network has the agents of all."""

    policy: Policy
    generators: list[torch.Generator]

    def act(self, observation: Tensor, values: bool) -> Chosen:
        """[P N, obs] -> [P N], [P N, actions]."""
        behind = self.policy.of_agents(observation.reshape(len(self.generators), -1, observation.shape[-1]))
        if self.policy.greedy:
            return behind.argmax(-1).flatten(), behind.flatten(0, 1)
        uniforms = [self.policy.draw(behind.shape[1:-1], generator) for generator in self.generators]
        return self.policy.choose(behind, torch.stack(uniforms, 1)).flatten(), behind.flatten(0, 1)


class Squads:
    """Some flyers, each with a generator of its own; n_actions: that they choose from."""

    def __init__(self, flyers: Flyers, n_actions: int) -> None:
        self._policies = [policy for _, policy in flyers]
        self._generators = [torch.Generator().manual_seed(seed) for seed, _ in flyers]
        self._kinds = [_kind(policy) or place for place, policy in enumerate(self._policies)]
        self._n_actions = n_actions
        self._sizes: list[int] = []
        self._dealt: dict[tuple[int, ...], Alone | Squad] = {}  # by its flyers
        self._rows: list[slice | Tensor] = []  # of each, flyer by flyer
        self._back: Tensor | None = None  # where a row lies among those of all squads, if these change their order

    def act(self, observation: Tensor, sizes: list[int], values: bool = False) -> Chosen:
        """An action for each row [F], each flyer's in turn; sizes: how many it has.

        Raises:
            ValueError: a policy chose something that is no action.
        """
        if sizes != self._sizes:
            self._deal(sizes)
        actions, behind = [], []
        for squad, rows in zip(self._dealt.values(), self._rows, strict=True):
            own = observation[rows]
            action, numbers = squad.act(own, values)
            actions.append(_checked(action, len(own), self._n_actions))
            behind += [numbers] if values and numbers is not None else []
        found = torch.cat(actions), torch.cat(behind) if behind else None
        if self._back is None:
            return found
        return found[0][self._back], None if found[1] is None else found[1][self._back]

    def _deal(self, sizes: list[int]) -> None:
        """Who acts with whom: flyers of one kind with as many flights."""
        groups: dict[object, list[int]] = {}
        for flyer, (kind, size) in enumerate(zip(self._kinds, sizes, strict=True)):
            if size:
                groups.setdefault((kind, size), []).append(flyer)
        ends = [*itertools.accumulate(sizes)]
        members = [tuple(group) for group in groups.values()]
        spans = [[range(ends[one] - sizes[one], ends[one]) for one in group] for group in members]
        self._rows = [_rows(own) for own in spans]
        alone = all(len(group) == 1 for group in members)
        self._back = None if alone else torch.tensor([*itertools.chain(*itertools.chain(*spans))]).argsort()
        self._dealt = {group: self._dealt.get(group) or self._squad(group) for group in members}
        self._sizes = sizes

    def _squad(self, group: Sequence[int]) -> Alone | Squad:
        generators = [self._generators[flyer] for flyer in group]
        policies = [self._policies[flyer] for flyer in group]
        if len(group) == 1:
            return Alone(policies[0], generators[0])
        alike = [policy for policy in policies if isinstance(policy, Policy)]
        return Squad(replace(alike[0], network=stacked([policy.network for policy in alike])), generators)


def _rows(spans: Sequence[range]) -> slice | Tensor:
    """What indexes the rows of some spans, one after the other."""
    return slice(spans[0].start, spans[0].stop) if len(spans) == 1 else torch.tensor([*itertools.chain(*spans)])


def _kind(policy: AnyPolicy) -> tuple[object, ...] | None:
    """What policies that can act as one have in common; None of one that acts alone."""
    if not isinstance(policy, Policy) or (layers := made_of(policy.network)) is None:
        return None
    return layers, policy.greedy, policy.acts, policy.head, policy.epsilon


def _checked(action: Tensor, n: int, n_actions: int) -> Tensor:
    """Actions of n rows, if they are some."""
    fits = isinstance(action, Tensor) and action.shape == (n,) and action.dtype in (torch.int64, torch.int32)
    if not fits or not 0 <= int(action.min()) <= int(action.max()) < n_actions:
        shown = f"{action.dtype} {list(action.shape)}" if isinstance(action, Tensor) and not fits else repr(action)
        raise ValueError(f"a policy chose {shown}; it must give int64 [{n}] from 0 to {n_actions - 1}")
    return action
