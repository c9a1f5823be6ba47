"""Which configurations belong to which part of a report, and each metric of theirs as one number a seed.

A run's meta.json names its study, and `PLACES` says what each study answers. The *main* study answers for
the paper: in one environment per seed, once all the paper's configurations have runs there, or else in many
(`vectorised`). Runs of no study that the report knows are compared with each other: those of an algorithm's
most frequent settings.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from uavnav.report.claims import AFTER, FAST, PRIMARY, SURGE, TUNED, WHEN, Evidence, around_surge
from uavnav.report.configurations import Configuration, Key, episodes_of, order, read_as, show, windowed
from uavnav.runs import POLICY, Run, paper
from uavnav.runs.definitions import ALL, LOG_CURVE, PER_FRAME, last_hundred
from uavnav.settings import differing, flat
from uavnav.stats import Array
from uavnav.tasks.faults import NO_FAULTS

Configurations = dict[Key, Configuration]

PLACES = {
    "paper": "main",
    "vectorised": "vectorised",
    "algorithms": "vectorised",
    "wide": "baseline",
    "initial": "initial",
    "sensitivity": "switches",
    "why": "why",
    "tuned": "tuned",
}
"""What a study of the package answers: a field of `Studies`."""
FOLLOWING = {"preset", "frames", "total_frames", "exploration_fraction", "layouts", "compile"}
"""Settings that a shorter study or another layout file changes along with what it is about."""


class Studies(NamedTuple):
    """All configurations of a report."""

    main: Configurations  # the paper's comparison, and further activations at the same settings
    vectorised: Configurations  # the same in more environments, where the main study is in one; else none
    baseline: Configurations  # in many environments for fewer frames, what the next two are compared with
    initial: Configurations  # under the first reward
    switches: dict[str, Configurations]  # one setting that the paper leaves open otherwise, by `name=value`
    # one setting otherwise that may tell why configurations differ (`whys`), by `name=value`
    why: dict[str, Configurations]
    tuned: Configurations  # with the preset `fast`
    others: list[Configuration]

    def of(self, name: str) -> Configurations:
        """One of those that claims and questions ask, by its name; none where there is no such."""
        named = {
            "main": self.main,
            "vectorised": self.vectorised or self.main,
            "baseline": self.baseline,
            "initial": self.initial,
            FAST: self.tuned,
        }
        return named.get(name) or self.why.get(name, {})


def sort(configurations: Sequence[Configuration]) -> Studies:
    """Deal configurations out to the studies; of two in one place, the later is among the others."""
    studies = Studies({}, {}, {}, {}, {}, {}, {}, [])
    for algorithm in dict.fromkeys(one.algorithm for one in configurations):
        mine = [one for one in configurations if one.algorithm == algorithm]
        usual = _usual(mine)
        for configuration in mine:
            place = _place(studies, configuration, usual)
            if place is None or (algorithm, configuration.activation) in place:
                studies.others.append(configuration)
            else:
                place[algorithm, configuration.activation] = configuration
    missing = studies.vectorised.keys() - studies.main.keys()
    if missing & paper.TABLES.keys():
        studies.others.extend(studies.main.values())
        studies = studies._replace(main=studies.vectorised, vectorised={})
    for configurations_of in (*studies[:4], studies.tuned, *studies.switches.values(), *studies.why.values()):
        in_order = sorted(configurations_of.items(), key=lambda item: order(item[0]))
        configurations_of.clear()
        configurations_of.update(in_order)
    return studies


def _usual(configurations: Sequence[Configuration]) -> Mapping[str, Any]:
    """An algorithm's settings in the study `vectorised`, or else its most frequent ones."""
    named = [one for one in configurations if PLACES.get(one.study) == "vectorised"] or configurations

    def how_often(configuration: Configuration) -> tuple[int, int, int, str]:
        alike = [one for one in named if one.settings == configuration.settings]
        beyond = len(configuration.runs[0].meta.get("beyond_preset", {}))
        return len(alike), sum(one.n_seeds for one in alike), -beyond, str(configuration.settings)

    return max(named, key=how_often).settings


def _place(studies: Studies, configuration: Configuration, usual: Mapping[str, Any]) -> Configurations | None:
    place, changed = PLACES.get(configuration.study), differing([configuration.settings, usual])
    if place in ("main", "vectorised", "tuned"):
        configurations: Configurations = getattr(studies, place)
        return configurations
    if place is None:
        return studies.vectorised if not changed else None
    named = changed - FOLLOWING
    if not named:
        return studies.baseline
    if place == "initial":
        return studies.initial
    (name, *more) = sorted(named)
    apart: dict[str, Configurations] = studies.why if place == "why" else studies.switches
    return None if more else apart.setdefault(f"{name}={show(configuration.settings.get(name))}", {})


def in_none(studies: Studies) -> list[str]:
    """One line for each run that is in no study, with how its settings differ from the main study's."""
    lines, placed = [], [*studies.main.items(), *studies.vectorised.items()]
    for configuration in studies.others:
        usual = [one.settings for key, one in placed if key[0] == configuration.algorithm]
        changes = sorted(differing([configuration.settings, *usual[:1]]))
        how = ", ".join(f"{key}={show(configuration.settings.get(key)):.20}" for key in changes)
        differs = f"; it differs from the main one in {how}" if usual else ""
        lines += [f"{run.path}: in no study{differs}" for run in configuration.runs]
    return lines


def paper_configurations(configurations: Configurations) -> Configurations:
    """Those of the paper's activations, of whatever algorithm."""
    return {key: one for key, one in configurations.items() if key[1] in paper.ACTIVATIONS}


def elsewhere(configurations: Sequence[Configuration]) -> list[Configuration]:
    """Those with policies that have another task, faults, or a stack of observations."""
    usual = flat({"task": "drone", "stack": 1, "faults": NO_FAULTS.model_dump()})
    other = [
        one
        for one in configurations
        if any(one.settings.get(key, value) != value for key, value in usual.items())
    ]
    return [one for one in other if any((run.path / POLICY).exists() for run in one.runs)]


def wide(studies: Studies) -> Configurations:
    """All configurations of the first study with activations beyond the paper's."""
    return next(
        (
            configurations
            for configurations in studies[:3]
            if len(paper_configurations(configurations)) < len(configurations)
        ),
        {},
    )


def further(studies: Studies) -> Configurations:
    """The configurations in many environments of algorithms beyond the paper's."""
    return {key: one for key, one in studies.of("vectorised").items() if key[0] not in paper.TABLE_OF}


def evidence_of(
    studies: Studies,
    definition: str,
    episodes: Mapping[tuple[str, str, str], pd.DataFrame],
    by_layout: Mapping[tuple[str, str, str], pd.DataFrame] = MappingProxyType({}),
    searched: Mapping[Key, Configuration] = MappingProxyType({}),
) -> Evidence:
    """Each metric of the studies' configurations in one of `definitions.DEFINITIONS`.

    episodes: rows of `seed`, `mode` and measures by study, algorithm and activation; by_layout: of `layout`;
    searched: what the trials of `tuning` found.
    """
    mode = "greedy" if definition.startswith("greedy") else "sampled"

    @functools.cache
    def per_seed(configuration: Configuration) -> pd.DataFrame:
        table, frames = read_as(configuration, definition), configuration.settings["frames"]
        if definition not in (PRIMARY, LOG_CURVE) or frames < SURGE[1] + AFTER:
            return table
        windows = around_surge(frames)
        if definition == LOG_CURVE:
            rewards = last_hundred(episodes_of(configuration, LOG_CURVE), "reward", windows)
        else:
            rewards = windowed(configuration, windows)
        return table.join(rewards.set_axis([f"reward_{when}" for when in WHEN], axis=1))

    def known(algorithm: str, activation: str, metric: str, study: str = "main") -> Array:
        there = searched if study == TUNED else studies.of(study)
        configuration = there.get((algorithm, activation))
        if configuration is None:
            return np.empty(0)
        if metric == "hours":
            return hours(configuration) if definition == PRIMARY else np.empty(0)
        of_episodes = by_layout if metric.endswith("_by_layout") else episodes
        found = of_episodes.get((study, algorithm, activation))
        if found is not None and metric in found:
            table = found[found["mode"] == mode]
        else:
            table = per_seed(configuration)
        return np.asarray(table[metric].dropna(), dtype=np.float64) if metric in table else np.empty(0)

    return known


def timed(configuration: Configuration) -> list[Run]:
    """The runs of a configuration whose wall time is known."""
    return [run for run in configuration.runs if isinstance(run.meta.get("wall_seconds"), (int, float))]


def hours(configuration: Configuration) -> Array:
    """Wall time of a million frames of one seed [h], a run: its wall time over its seeds and frames."""
    return np.array(
        [
            run.meta["wall_seconds"] / 3600 / len(run.seeds) / (run.frames / 1e6)
            for run in timed(configuration)
        ]
    )


def of_paper(
    algorithm: str, activation: str, metric: str, study: str = "main", definition: str = ALL
) -> Array:
    """The paper's printed tables as a metric definition takes them, and its ten hours: an `Evidence` of
    one number a configuration.
    """
    if metric == "hours":
        return np.array([paper.HOURS])
    value = (
        paper.printed(algorithm, activation, metric, definition == PER_FRAME) if study == "main" else np.nan
    )
    return np.array([value])[np.isfinite([value])]
