"""Evaluate policies on layouts that they never trained on: one row an episode.

`uavnav evaluate RUN...` evaluates every seed of finished runs, greedy and sampled, into their folders.
Scripted policies and zips of Stable-Baselines3 are evaluated too; `--out` keeps their rows for a report.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from uavnav.algorithms import ALGORITHMS
from uavnav.errors import ConfigError, told
from uavnav.evaluation import episodes, values
from uavnav.evaluation.measures import Measures
from uavnav.evaluation.repeats import Repeats
from uavnav.runs import ARENA, BEHAVIOUR, EVALUATION, VALUES, Run, kept
from uavnav.runs.evaluations import Protocol as Protocol
from uavnav.runs.metrics import EPISODE_COLUMNS
from uavnav.runs.policies import Policy, by_mode, load_policies
from uavnav.runs.tables import RunError, lock, write_table
from uavnav.settings import Whole, checked
from uavnav.tasks import layouts as splits
from uavnav.tasks.baselines import AnyPolicy, suited
from uavnav.tasks.faults import Faults
from uavnav.tasks.ladders import Measure, measure_of
from uavnav.tasks.protocol import EPISODES as EPISODES
from uavnav.tasks.protocol import MAX_STEPS as MAX_STEPS
from uavnav.tasks.rewards import BY_ACTION, REWARDS
from uavnav.tasks.shield import shielded
from uavnav.tasks.state import COUNTS, State, at
from uavnav.tasks.table import EMPTY, TASKS, make_task
from uavnav.tasks.task import Task
from uavnav.tasks.world import World
from uavnav.tasks.wrapper import WrappedTask
from uavnav.training import display, machine

MOST_STEPS = 1_000_000
"""The largest time limit of an evaluation: some episodes never end."""
WATCHED_LAYOUTS = 10
WATCHED_STEPS = 500
"""Behaviour is kept of so many layouts, and of so many steps of each."""

BEHAVIOUR_COLUMNS = {"seed": "int64", "layout": "int64", "action": "int16"}
"""The steps of an episode follow each other. Where they lead, `uavnav.report.behaviour.retrace` works out."""

HEADINGS = (0, 90, 180, 270)  # start headings of a seed's episodes in the empty arena [degrees]
EMPTY_ARENA = torch.empty(len(HEADINGS), 0, 3)  # as many layouts without an obstacle [4, 0, 3]


class Evaluation(NamedTuple):
    """What an evaluation leaves."""

    episodes: pd.DataFrame  # one row an episode, `metrics.EPISODE_COLUMNS`
    behaviour: pd.DataFrame  # one row a watched step, `BEHAVIOUR_COLUMNS`


def evaluate_policy(
    policy: Callable[..., Any],
    layouts: str | Path | Tensor = "test",
    episodes: int = EPISODES,
    max_steps: int | None = None,
    world: World | None = None,
    reward: str | None = None,
    seed: int = 0,
    faults: Faults | None = None,
    task: str | None = None,
) -> pd.DataFrame:
    """One episode on each of the first layouts of a layout file, each starting at the centre.

    Args:
        policy: what `uavnav.load_policy` returns, or a function of observations [n, 30] that returns a whole
            number from 0 to 99 for each [n], as a tensor, an array or a list. If it takes two arguments, the
            second is a generator.
        layouts: `train`, `validation`, `test`, a layout file's path, or a tensor [n, k, 3].
        episodes: how many layouts, from the first.
        max_steps: an episode that lasts so long is `truncated`: a censored observation and no
            collision. By default 10,000, or the task's own limit where that is lower.
        world: constants and switches; by default those that the policy was trained in, if it has any.
        reward: a name of `uavnav.rewards.REWARDS`; by default the policy's, or eq14.
        seed: of the generator that the policy is given, and of what faults draw; also written into the column
            `seed`.
        faults: of its sensor and actuator; by default those that the policy was trained with, if it has any.
        task: a name of `uavnav.tasks.table.TASKS`; by default the policy's, or the one that has such a world.

    Returns:
        A row an episode, the columns of `metrics.EPISODE_COLUMNS` (`frame` is the step of its end, `env` its
        row).

    Raises:
        LayoutError: the split cannot be read.
        ValueError: an unknown reward or task, more episodes than the split has layouts, a count below 1, or a
            policy that sees another number of numbers than there are in this task.
    """
    if not callable(policy):
        raise ConfigError(
            f"policy={told(policy)}; give what load_policy returns, or a function of observations"
        )
    seed = checked("seed", seed, Whole)
    own = policy.task if isinstance(policy, Policy) else make_task(EMPTY)
    if task is not None or (world is not None and type(world) is not type(own.world)):
        of_world = next((name for name, kind in TASKS.items() if kind.WORLD is type(world)), "drone")
        name = of_world if task is None else task
        own = make_task(EMPTY, world, reward, task=name, stack=own.stack, faults=own.faults)
    own = own.replace(
        world=own.world if world is None else world, reward=own.reward if reward is None else reward
    )
    if isinstance(policy, Policy) and own.observation_size != policy.task.observation_size:
        both = f"sees {policy.task.observation_size} numbers, and this task has {own.observation_size}"
        raise ValueError(f"the policy {both}; give one that was trained there")
    limit = own.limit(MAX_STEPS) if max_steps is None else max_steps
    return fly({seed: suited(policy, own)}, on(own, layouts, episodes, limit, faults)).episodes


def fitted(policy: AnyPolicy, task: WrappedTask, shield: bool) -> AnyPolicy:
    """`suited`, and under the shield where that is asked for."""
    if not shield:
        return suited(policy, task)
    if isinstance(policy, Policy):
        return policy.shielded()
    return shielded(suited(policy, task), task.world)


def on(
    task: WrappedTask,
    layouts: str | Path | Tensor = "test",
    episodes: int = EPISODES,
    max_steps: int = MAX_STEPS,
    faults: Faults | None = None,
) -> WrappedTask:
    """The task of an evaluation: the first layouts of a file, a time limit, and these faults or its own.

    Raises:
        LayoutError: the split cannot be read.
        ValueError: more episodes than the split has layouts, or a count below 1.
    """
    if not isinstance(faults, Faults | None):
        raise ConfigError(f"faults={told(faults)}; give Faults, or None for the task's own")
    if not isinstance(episodes, int) or not isinstance(max_steps, int):
        raise ValueError(f"episodes={told(episodes)}, max_steps={told(max_steps)}; give whole numbers")
    all_layouts = splits.resolve(layouts, task.world)
    check_bounds(episodes, max_steps, len(all_layouts))
    own = task.faults if faults is None else faults
    return task.replace(layouts=all_layouts[:episodes], max_steps=max_steps, faults=own)


def check_bounds(episodes: int, max_steps: int, most: int) -> None:
    """Raise a ValueError for more episodes than `most`, a split's layouts, or for a count below 1."""
    if not 1 <= episodes <= most or not 1 <= max_steps <= MOST_STEPS:
        bounds = f"1 to {most} episodes of at least 1 step and at most {MOST_STEPS:,}"
        raise ValueError(f"episodes={told(episodes)}, max_steps={told(max_steps)}; give {bounds}")


def fly(population: Mapping[int, AnyPolicy], task: WrappedTask) -> Evaluation:
    """`fly_modes` of one policy a seed; no column `mode`."""
    found = fly_modes({"": population}, task)
    return Evaluation(*(table.drop(columns="mode") for table in found))


def fly_modes(
    modes: Mapping[str, Mapping[int, AnyPolicy]],
    task: WrappedTask,
    tell: Callable[[int, int], object] = lambda step, going: None,
    measure: Measure | None = None,
    heading: Tensor | None = None,
    measures: bool = False,
) -> Evaluation:
    """Evaluate policies by mode, such as `greedy` and `sampled`, and by seed on every layout of the task, all
    episodes in one batch; both tables have a column `mode`.

    `tell` is called after each step with its number and how many episodes go on. What `measure`, or the
    task's own, gives of each step is added up over an episode: a column more for each. Episodes that go round
    for ever are counted to the time limit (`uavnav.evaluation.repeats`). heading: [layouts] of the start,
    where it is not the task's. measures: rows have the columns of `uavnav.evaluation.measures` too. With
    columns more, every step is taken.
    """
    policies = [one for population in modes.values() for one in population.items()]
    seeds = [seed for seed, _ in policies]
    measure, start = measure or task.measure, episodes.start(task, seeds, heading)
    sums = {name: torch.zeros_like(one) for name, one in measure(start, start).items()}
    more = Measures(len(start.x), task) if measures else None
    columns = sums if more is None else sums | more.columns
    goes_round = torch.tensor([not columns and _repeatable(policy, task) for _, policy in policies])
    repeats = Repeats(goes_round.repeat_interleave(len(task.layouts)), task.max_steps or 0, WATCHED_STEPS)
    ended: list[dict[str, Tensor]] = []
    watched: list[dict[str, Tensor]] = []
    for step in episodes.steps(policies, task, heading):
        if step.number <= WATCHED_STEPS:
            watched.append(_watch(step))
        if sums:
            for name, found in measure(at(step.before, step.place), step.state).items():
                sums[name][step.episode] += found
        if more is not None:
            more.see(step)
        if step.ended.any():
            episode, place = step.episode[step.ended], step.place[step.ended]
            row = _end(episode, at(step.states, place), step.outcomes.terminated[place])
            ended.append(row | {name: one[episode] for name, one in columns.items()})
        if (counted := repeats.see(step)) is not None:
            ended.append(_end(*counted, torch.zeros(len(counted[0]), dtype=torch.bool)))
        tell(step.number, int((~step.ended).sum()))
    names = [mode for mode, population in modes.items() for _ in population]
    who = pd.DataFrame({"seed": seeds, "mode": names}).loc[np.arange(len(policies)).repeat(len(task.layouts))]
    return Evaluation(_table(ended, who, EPISODE_COLUMNS), _table(watched, who, BEHAVIOUR_COLUMNS))


def _repeatable(policy: AnyPolicy, task: WrappedTask) -> bool:
    """Whether the same pose is always followed by the same steps and rewards."""
    greedy = isinstance(policy, Policy) and policy.greedy
    return greedy and task.STATIC and not task.remembers and REWARDS[task.reward] in BY_ACTION


def _end(episode: Tensor, state: State, terminated: Tensor) -> dict[str, Tensor]:
    counts = {name: getattr(state, name) for name in ("layout", *COUNTS)}
    flags = {"terminated": terminated, "truncated": ~terminated}
    return {"episode": episode, "frame": state.steps, "env": state.layout, **counts, **flags}


def _watch(step: episodes.Transition) -> dict[str, Tensor]:
    layout = step.states.layout[step.place]
    kept = layout < WATCHED_LAYOUTS
    return {"episode": step.episode[kept], "layout": layout[kept], "action": step.action[kept]}


def _table(parts: list[dict[str, Tensor]], who: pd.DataFrame, columns: dict[str, str]) -> pd.DataFrame:
    """Rows by policy and layout, in the order of steps; who: seed and mode of each episode."""
    table = pd.DataFrame({name: torch.cat([part[name] for part in parts]).numpy() for name in parts[0]})
    table = table.sort_values("episode", kind="stable", ignore_index=True)
    own = who.iloc[table.pop("episode")].reset_index(drop=True)
    table.insert(0, "seed", own["seed"])
    return table.assign(mode=own["mode"]).astype(columns)


def in_empty_arena(modes: Mapping[str, Mapping[int, Policy]]) -> pd.DataFrame:
    """The first `WATCHED_STEPS` actions of an episode for each policy and start heading.

    Columns seed, layout (counts `HEADINGS`), action, mode.
    """
    first = next(iter(next(iter(modes.values())).values()))
    task = first.task.replace(layouts=EMPTY_ARENA, max_steps=WATCHED_STEPS)
    return fly_modes(modes, task, heading=torch.tensor(HEADINGS)).behaviour


def evaluate_run(
    run: Run,
    episodes: int = EPISODES,
    max_steps: int | None = None,
    layouts: str | Path = "test",
    quiet: bool = False,
    faults: Faults | None = None,
    at: float | None = None,
    shield: bool = False,
    measures: bool = False,
) -> pd.DataFrame:
    """Evaluate every seed of a run, greedy and sampled, and keep its rows (see `Protocol.file`).

    On a terminal a bar shows how far it is, unless it is `quiet`. By default faults are of training, and the
    time limit is 10,000 steps, or the task's own where that is lower. Policies are those
    of the end of training, or those kept after the share `at` of it (the setting `keep_at`). With a shield
    they are `Policy.shielded`. measures: as of `fly_modes`.

    Returns:
        The columns of `metrics.EPISODE_COLUMNS` and `mode`; in `attrs` the protocol, as in the file's header.

    Raises:
        LayoutError, PolicyError, RunError: a file cannot be read or written.
    """
    if not isinstance(run, Run):
        raise RunError(f"run={told(run)}; give a Run")
    for name, value in (("quiet", quiet), ("shield", shield), ("measures", measures)):
        checked(name, value, bool)
    if at is not None and at not in run.config.get("keep_at", []):
        right = f"train with keep_at=[{at:g}]" if 0 < at < 1 else "give a share between 0 and 1"
        raise RunError(f"{run.path}: kept no policies at={at:g}; {right}")
    policies = load_policies(run.path if at is None else run.path / kept(at), run.seeds)
    modes = by_mode({seed: one.shielded() if shield else one for seed, one in policies.items()})
    own = modes["greedy"][run.seeds[0]].task
    max_steps = own.limit(MAX_STEPS) if max_steps is None else max_steps
    task = on(own, layouts, episodes, max_steps, faults)
    protocol = Protocol(layouts, episodes, max_steps, faults, at=at, shield=shield)
    rows_file, behaviour_file = (protocol.file(Path(name).stem) for name in (EVALUATION, BEHAVIOUR))
    usual = type(task.task) is Task and rows_file == EVALUATION

    def fly_seeds(
        seeds: Sequence[int], tell: Callable[[int, int], object] = lambda step, going: None
    ) -> dict[str, pd.DataFrame]:
        own = {mode: {seed: population[seed] for seed in seeds} for mode, population in modes.items()}
        rows, behaviour = fly_modes(own, task, tell, measure_of(layouts), measures=measures)
        found = {ARENA: in_empty_arena(own)} if usual else {}
        if usual and ALGORITHMS[run.algorithm].shown == "Q value":
            found[VALUES] = values.overestimation(own["greedy"], run.config["gamma"])
        return found | {behaviour_file: behaviour, rows_file: rows}  # rows last: who finds them has all

    here, there = run.seeds, []
    n = episodes * len(modes)
    if machine.forks() and len(run.seeds) * n * max_steps >= machine.MANY:
        here, there = run.seeds[::2], run.seeds[1::2]
    what = f"{run.algorithm} {run.config['activation']}" + ", half of the seeds" * bool(there)
    fork = machine.forked(lambda: fly_seeds(there)) if there else contextlib.nullcontext(dict)
    with (
        machine.use_threads(1),
        fork as others,
        display.episodes(what, n * len(here), max_steps, quiet) as tell,
    ):
        halves = [half for half in (fly_seeds(here, tell), others()) if half]
    tables = {name: together([half[name] for half in halves]) for name in halves[0]}
    with lock(run.path):
        for name, table in tables.items():
            if name in (rows_file, behaviour_file):
                table.attrs = protocol.header()
            write_table(run.path / name, table)
    return tables[rows_file]


def together(parts: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Tables of some seeds each as one, by mode, seed and layout; the steps of an episode stay in order."""
    by = [name for name in ("mode", "seed", "layout") if name in parts[0]]
    return pd.concat(parts).sort_values(by, kind="stable", ignore_index=True)


def rows_across(ladder: str, episodes: int, max_steps: int) -> str:
    """The file of a run's rows across a ladder, in its folder."""
    return f"across-{ladder}-{episodes}-{max_steps}.parquet"
