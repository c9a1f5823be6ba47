"""Where which algorithm flies: the study `worlds`, apart from what answers for the paper's tables.

Letters: S seeds of a configuration.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from uavnav import stats, style
from uavnav.report.claims import ALL_TASKS, CRASHED, EXPLAINS, RANKED, SCATTER, SLOPE, VARIATION, at, slopes
from uavnav.report.configurations import MODE, apart, of_a_study, order, settings_of
from uavnav.report.frames import Rows, columns
from uavnav.runs import Run, run_folders
from uavnav.runs.evaluations import Protocol
from uavnav.runs.metrics import EVALUATED, OWN, PER_EPISODE, collided, of_episodes
from uavnav.runs.tables import RunError, read_table
from uavnav.stats import Array
from uavnav.tasks.protocol import ACROSS_STEPS, DRAWS, EPISODES, SCRIPTED, USUAL

DEFAULT, TUNED = "vectorised", "fast"
"""The presets of the study; a task's name says the second."""
MEASURES = {
    "reward": "reward per episode",
    "greedy": "reward per episode, greedy",
    "collisions": PER_EPISODE["collisions"],
    "survival": "restricted mean survival [steps]",
}
LABELS = MEASURES | {name: one.label for name, one in OWN.items()}
"""Columns of a task's table."""
CLIMBED = ("reward", "collisions", *OWN)
"""What is measured on the rungs of a ladder."""

Key = tuple[str, str, str]
"""Task (with the preset where it is not the default), algorithm and activation."""


class Worlds(NamedTuple):
    """What the study says."""

    seeds: dict[Key, pd.DataFrame]  # a row a seed: `MEASURES`, those of `metrics.OWN`, and what claims ask
    scripted: dict[tuple[str, str], pd.DataFrame]  # the same of a task's scripted policies
    # ladder and rung -> the same of the scripted policies there
    rungs: dict[tuple[str, float], dict[str, pd.DataFrame]]
    runs: pd.DataFrame  # how each run was made, a row a run


def gather(folders: Sequence[Path]) -> tuple[Worlds | None, list[str]]:
    """Read the study in a report's folders, and scripted policies' rows in its tasks; None without one.

    Also a line for each run and table that is of no use.
    """
    homes = apart(folders, "worlds")
    seeds: dict[Key, pd.DataFrame] = {}
    places: dict[str, Protocol | None] = {}
    settings: dict[Key, dict[str, object]] = {}
    left_out, made = [], []
    for path in filter(of_a_study, (path for folder in homes for path in run_folders(folder)[0])):
        try:
            run = Run(path, rows=False)
            place, protocol, table = read(run)
            if (preset := run.config["preset"]) not in (DEFAULT, TUNED):
                raise RunError(f"{path}: preset={preset}; the study has {DEFAULT} and {TUNED}")
            task = place + f", {TUNED}" * (preset == TUNED)
            key = (task, run.algorithm, run.config["activation"])
            if key in seeds and not seeds[key].index.intersection(table.index).empty:
                raise RunError(f"{path}: its seeds are there already, in {task}")
            own = settings_of(run.config, run.meta, run.frames)
            if settings.setdefault(key, own) != own:
                raise RunError(f"{path}: its settings differ from those of another run in {task}")
            seeds[key] = pd.concat([seeds[key], table]) if key in seeds else table
            places.setdefault(place, protocol)
            facts = {name: run.meta.get(name) for name in ("git_commit", "ended", "wall_seconds")}
            who = {"run": str(path), "task": task, "algorithm": run.algorithm, "activation": key[-1]}
            made.append({**who, "seeds": len(run.seeds), **facts, **(run.meta.get("machine") or {})})
        except RunError as error:
            left_out.append(str(error))
        except KeyError as error:
            left_out.append(f"{path}: its config.yaml or a table of it has no {error}")
    if not seeds:
        return None, left_out

    def by_number(name: str) -> tuple[object, ...]:  # density-4 comes before density-16
        words, _, number = name.partition("-")
        return name != "drone", *((words, float(number)) if number.isdecimal() else (name, 0.0))

    def rank(key: Key) -> tuple[object, ...]:  # the default presets first
        return in_order.index(_place(key[0])), key[0] != _place(key[0]), *order(key[1:])

    in_order = sorted(places, key=by_number)
    seeds = {key: seeds[key] for key in sorted(seeds, key=rank)}
    scripted, rungs, lines = _of_scripted([home / "baselines" for home in homes], in_order, places, seeds)
    return Worlds(seeds, scripted, rungs, pd.DataFrame(made)), [*left_out, *lines]


def _of_scripted(
    folders: Sequence[Path],
    names: Sequence[str],
    places: Mapping[str, Protocol | None],
    seeds: Mapping[Key, pd.DataFrame],
) -> tuple[dict[tuple[str, str], pd.DataFrame], dict[tuple[str, float], dict[str, pd.DataFrame]], list[str]]:
    """What scripted policies reach in tasks and on rungs of the paper's policies; lines for missing rows."""
    from uavnav.evaluation.scripted import rows_of_scripted
    from uavnav.tasks import ladders, layouts

    left_out: list[str] = []
    scripted: dict[tuple[str, str], pd.DataFrame] = {}
    rungs = {}
    for name in names:
        if (protocol := places[name]) is None:
            left_out.append(
                f"{name}: no rows of scripted policies, which fly only with the usual settings of a task"
            )
            continue
        rows, unread = rows_of_scripted(folders, protocol)
        left_out += unread
        scripted |= {(name, who): measured(own, protocol.max_steps) for who, own in rows.items()}
    if (protocol := places.get("drone")) is not None:
        there = {
            metric for (task, _, _), table in seeds.items() if _place(task) == "drone" for metric in table
        }
        for rung in ((name, rung) for name in layouts.RUNGS for rung in ladders.LADDERS[name].rungs):
            if at("reward", *rung) in there:
                rows, unread = rows_of_scripted(folders, protocol._replace(layouts=ladders.split_of(*rung)))
                left_out += unread
                rungs[rung] = {who: on_rung(own) for who, own in rows.items()}
    return scripted, rungs, left_out


def _place(task: str) -> str:
    return task.removesuffix(f", {TUNED}")


def read(run: Run) -> tuple[str, Protocol | None, pd.DataFrame]:
    """Where a run was trained, how scripted policies fly there, and its seeds: only of the study's episodes.

    Raises a RunError where its task is not known, or it was not evaluated as in the study.
    """
    from uavnav.evaluation import rows_across  # these know the tasks, and so load torch
    from uavnav.evaluation.scripted import protocol_in
    from uavnav.evaluation.transfer import named, trained_in
    from uavnav.tasks.ladders import LADDERS

    task, split = trained_in(run)
    limit = task.limit(ACROSS_STEPS)
    name = Protocol(split, EPISODES, limit).file("evaluation")
    if not (run.path / name).exists():
        raise RunError(f"{run.path}: has no {name}; give its study again")
    rows = read_table(
        run.path / name, EVALUATED | {"distance": "int64", "mode": "object"}, "evaluate the run again"
    )
    table = measured(rows[rows["mode"] == MODE], limit)
    if len(greedy := rows[rows["mode"] == "greedy"]):
        table["greedy"] = greedy.groupby("seed")["reward"].mean()
    for name, ladder in LADDERS.items():
        path = run.path / rows_across(name, EPISODES, limit)
        if path.exists():
            climbed = read_table(
                path, {"seed": "int64", "rung": "float64", "mode": "object"}, "evaluate it again"
            )
            climbed = climbed[climbed["mode"] == MODE]
            for rung in ladder.rungs:
                one = on_rung(climbed[climbed["rung"] == rung])
                table = table.join(one.set_axis([at(str(metric), name, rung) for metric in one], axis=1))
            if name == "density":
                rewards = table[[at("reward", name, rung) for rung in ladder.rungs]]
                table[SLOPE] = rewards.to_numpy() @ slopes(ladder.rungs)
    if "grad_norm" in run.progress:
        norms = run.progress.groupby("seed")["grad_norm"]
        table[VARIATION] = norms.std() / norms.mean()
    return named(task, split), protocol_in(task, split, EPISODES, limit), table


def measured(episodes: pd.DataFrame, limit: int) -> pd.DataFrame:
    """`on_rung`, and the restricted mean survival up to a limit; the goal counts as truncation."""
    ended, steps = collided(episodes).to_numpy(np.float64), episodes["steps"].to_numpy()
    survival = {
        seed: stats.restricted_mean(steps[own], ended[own], limit)
        for seed, own in episodes.groupby("seed").indices.items()
    }
    return on_rung(episodes).assign(survival=pd.Series(survival))


def on_rung(episodes: pd.DataFrame) -> pd.DataFrame:
    """The measures of some episodes, a row a seed."""
    crashed = {CRASHED: collided(episodes).groupby(episodes["seed"]).mean()}
    return of_episodes(episodes).drop(columns="survive").assign(**crashed)


class Evidence:
    """What the claims of the discussion ask (`claims.Evidence`); means over tasks need all of them."""

    def __init__(self, seeds: Mapping[Key, pd.DataFrame]) -> None:
        self._seeds = dict(seeds)
        self._ranks = functools.cache(self._explains)
        self._tasks = [*dict.fromkeys(task for task, _, _ in self._seeds if task == _place(task))]
        for task in dict.fromkeys(task for task, _, _ in self._seeds):
            mine = {key: table for key, table in self._seeds.items() if key[0] == task}
            apart = {key: (table["reward"] - table["reward"].median()).abs() for key, table in mine.items()}
            whole = [key for key in mine if task != _place(task) or self._everywhere(*key[1:])]
            usual = pd.concat([apart[key] for key in whole or mine]).mean()
            for key, table in mine.items():
                self._seeds[key] = table.assign(**{SCATTER: apart[key] / usual if usual > 0 else np.nan})

    def __call__(self, algorithm: str, activation: str, metric: str, study: str = ALL_TASKS) -> Array:
        if algorithm == RANKED:
            found = self._ranks(metric, () if study == ALL_TASKS else ("sac",))
            return found if activation == RANKED else np.zeros(len(found))
        if study != ALL_TASKS:
            table = self._seeds.get((study, algorithm, activation))
            return np.empty(0) if table is None or metric not in table else table[metric].dropna().to_numpy()
        parts = [one[metric] for one in self._everywhere(algorithm, activation) if metric in one]
        return (
            pd.concat(parts, axis=1, join="inner").mean(axis=1).dropna().to_numpy() if parts else np.empty(0)
        )

    def _everywhere(self, algorithm: str, activation: str) -> list[pd.DataFrame]:
        """A configuration's seeds in each task, with the default preset; nothing where it lacks a task."""
        none = pd.DataFrame()
        found = [self._seeds.get((task, algorithm, activation), none) for task in self._tasks]
        return found if all(map(len, found)) else []

    def _explains(self, metric: str, without: Sequence[str]) -> Array:
        """A measure's rank correlation with the reward across a task's configurations, mean over all: [S].

        Seeds of the same number are taken together, as a study of its own; without: some algorithms.
        """
        measure = next(name for name, explains in EXPLAINS.items() if explains == metric)
        parts = []
        for task in self._tasks:
            own = (key for key in self._seeds if key[0] == task and key[1] not in without)
            configurations = (key for key in own if self._everywhere(*key[1:]))
            mine = [table for one in configurations if measure in (table := self._seeds[one])]
            if len(mine) > 2:
                first, second = (
                    pd.concat(
                        [table[name] for table in mine], axis=1, join="inner", keys=range(len(mine))
                    ).rank(axis=1)
                    for name in (measure, "reward")
                )
                parts.append(first.T.corrwith(second.T))
        return pd.concat(parts, axis=1).mean(axis=1).dropna().to_numpy() if parts else np.empty(0)


# -- what a report shows -------------------------------------------------------------------------------------


@columns("task", "who", "metric", "value", "low", "high", "n")
def summary(found: Worlds) -> Rows:
    """A row for each task, configuration (or scripted policy) and measure, with intervals over seeds."""
    everything = {
        (task, f"{algorithm.upper()} {activation}{' fast' * (task != _place(task))}"): table
        for (task, algorithm, activation), table in found.seeds.items()
    }
    for (task, name), table in (everything | found.scripted).items():
        for metric in (*MEASURES, *OWN):
            # where most episodes end at the goal, few tell how long one lives
            if metric in table and not (metric == "survival" and "success" in table):
                yield [_place(task), name, metric, *stats.interval(table[metric].to_numpy())]


@columns("task", "best", "value", "low", "high", "best_scripted", "scripted", "ahead", "chance")
def leaders(found: pd.DataFrame) -> Rows:
    """Who is ahead in each task by reward per episode, a row a task; found: of `summary`.

    A scripted policy is ahead if it is above the interval of every configuration, a configuration if its
    interval is above every scripted policy.
    `chance` has the configurations whose interval is not above a random policy's.
    """
    rewards = found[found["metric"] == "reward"].sort_values("value", ascending=False, kind="stable")
    rewards = rewards.assign(top=rewards["high"].fillna(rewards["value"]))
    for task in found["task"].unique():
        mine = rewards[rewards["task"] == task]
        scripted = mine["who"].isin(SCRIPTED)
        rest, learned = mine[scripted], mine[~scripted]
        best, chance = learned.iloc[0], rest.loc[rest["who"] == DRAWS, "top"].max()
        none = pd.Series({"who": "", "value": np.nan, "top": np.nan})
        top, ahead = (rest.iloc[0], "neither") if len(rest) else (none, "")
        if (top["value"] > learned["top"]).all():
            ahead = "a scripted policy"
        elif best["low"] > top["top"]:
            ahead = "a configuration"
        under = "; ".join(learned.loc[learned["low"] <= chance, "who"])
        numbers = best[["who", "value", "low", "high"]]
        yield [task, *numbers, top["who"], top["value"], ahead, under]


@columns("name", "mode", "rung", "measure", "n", "value", "low", "high")
def ladder(found: Worlds, name: str) -> Rows:
    """The configurations that were trained in the paper's task across a ladder, means of their activations,
    and the usual scripted policies; no rows where no configuration was.
    """
    from uavnav.tasks.ladders import LADDERS

    rungs, learned = LADDERS[name].rungs, False
    for (task, algorithm), group in itertools.groupby(found.seeds.items(), key=lambda item: item[0][:2]):
        known = [table for _, table in group if at("reward", name, rungs[0]) in table]
        if not known or _place(task) != "drone":
            continue
        learned, who = True, algorithm.upper() + " fast" * (task != _place(task))
        for rung, metric in itertools.product(rungs, CLIMBED):
            if (there := at(metric, name, rung)) in known[0]:
                *mean, n = stats.difference([table[there].dropna().to_numpy() for table in known])
                yield [who, MODE, float(rung), metric, n, *mean]
    for who, rung, metric in itertools.product(USUAL, rungs, CLIMBED) if learned else ():
        own = found.rungs.get((name, rung), {}).get(who, pd.DataFrame())
        if metric in own:
            *mean, n = stats.interval(own[metric].to_numpy())
            yield [who, "scripted", float(rung), metric, n, *mean]


def figure(climbed: pd.DataFrame, name: str, width: float = style.WIDTH) -> style.Drawn:
    """What `ladder` gives, as a figure."""
    from uavnav.evaluation import across
    from uavnav.tasks.ladders import LADDERS

    kinds = {who: who.split()[0].lower() for who in climbed["name"]}
    return across.draw(climbed, LADDERS[name], kinds, width)
