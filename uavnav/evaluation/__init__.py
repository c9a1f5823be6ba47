"""Fly policies on sets of obstacles that they never trained on: one row an episode.

`uavnav evaluate RUN...` evaluates every seed of finished runs, greedy and sampled, into their folders; and
whatever else flies (scripted baselines, zips of Stable-Baselines3), whose rows `--out` keeps for a report.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import pandas as pd
import torch
from torch import Tensor

from uavnav.algorithms import ALGORITHMS
from uavnav.errors import ConfigError, told
from uavnav.evaluation import empty_arena, flights, values
from uavnav.evaluation.repeats import Repeats
from uavnav.runs import ARENA, BEHAVIOUR, EVALUATION, VALUES, Run, policies
from uavnav.runs.metrics import EPISODE_COLUMNS, MODES
from uavnav.runs.policies import Policy
from uavnav.runs.tables import RunError, lock, write_table
from uavnav.tasks import layouts as banks
from uavnav.tasks.baselines import AnyPolicy, suited
from uavnav.tasks.faults import Faults
from uavnav.tasks.ladders import Measure, measure_of
from uavnav.tasks.protocol import EPISODES as EPISODES
from uavnav.tasks.protocol import MAX_STEPS as MAX_STEPS
from uavnav.tasks.protocol import header as header
from uavnav.tasks.rewards import BY_ACTION, REWARDS
from uavnav.tasks.simulator import EMPTY, TASKS, Task, make_task
from uavnav.tasks.state import COUNTS, State, at
from uavnav.tasks.world import World
from uavnav.training import display, machine
from uavnav.training.config import checked

MOST_STEPS = 1_000_000
"""The largest cap on the steps of an evaluation: some flights never end."""
WATCHED_LAYOUTS = 10
WATCHED_STEPS = 500
"""Behaviour is kept of so many sets of obstacles, and of so many steps of each."""

BEHAVIOUR_COLUMNS = {"seed": "int64", "layout": "int64", "action": "int16"}
"""The steps of a flight follow each other. Where they lead, `uavnav.report.behaviour.retrace` works out."""


CREW = "_crew"
"""While tables are made, the column of whose population a row is."""


class Flights(NamedTuple):
    """What an evaluation leaves."""

    episodes: pd.DataFrame  # one row an episode, `metrics.EPISODE_COLUMNS`
    behaviour: pd.DataFrame  # one row a watched step, `BEHAVIOUR_COLUMNS`


def evaluate_policy(
    policy: AnyPolicy,
    layouts: str | Path | Tensor = "test",
    episodes: int = EPISODES,
    max_steps: int | None = None,
    world: World | None = None,
    reward: str | None = None,
    seed: int = 0,
    faults: Faults | None = None,
    task: str | None = None,
) -> pd.DataFrame:
    """One episode on each of the first sets of a bank, each starting at the centre.

    Args:
        policy: what `uavnav.load_policy` returns, or any callable of that form.
        layouts: `train`, `validation`, `test`, a bank's path, or a tensor [n, k, 3].
        episodes: how many sets, from the first.
        max_steps: an episode that lasts so long is cut off: `truncated`, a censored observation and no collision. By
            default 10,000, or the task's own cap where that is lower.
        world: constants and switches; by default those that the policy was trained in, if it has any.
        reward: a name of `uavnav.rewards.REWARDS`; by default the policy's, or eq14.
        seed: of the generator that the policy is given, and of what faults draw; also written into the column `seed`.
        faults: of its sensor and actuator; by default those that the policy was trained with, if it has any.
        task: a name of `uavnav.simulator.TASKS`; by default the policy's, or the one that has such a world.

    Returns:
        A row an episode, the columns of `metrics.EPISODE_COLUMNS` (`frame` is the step of its end, `env` its row).

    Raises:
        LayoutError: the bank cannot be read.
        ValueError: an unknown reward or task, more episodes than the bank has sets, a count below 1, or a policy that
            sees another number of numbers than there are in this world.
    """
    if not callable(policy):
        raise ConfigError(f"policy={told(policy)}; give what load_policy returns, or a function of that form")
    checked("seed", seed, int, {})
    own = policy.task if isinstance(policy, Policy) else make_task(EMPTY)
    if task is not None or (world is not None and type(world) is not type(own.world)):
        of_world = next((name for name, kind in TASKS.items() if kind.WORLD is type(world)), "drone")
        name = of_world if task is None else task
        own = make_task(EMPTY, world, reward, task=name, stack=own.stack, faults=own.faults)
    own = replace(own, world=own.world if world is None else world, reward=own.reward if reward is None else reward)
    if isinstance(policy, Policy) and own.observation_size != policy.task.observation_size:
        sees = f"the policy sees {policy.task.observation_size} numbers"
        raise ValueError(f"{sees}, and this world has {own.observation_size}; give one that was trained there")
    cap = own.cap(MAX_STEPS) if max_steps is None else max_steps
    return fly({seed: suited(policy, own)}, on(own, layouts, episodes, cap, faults)).episodes


def on(
    task: Task,
    layouts: str | Path | Tensor = "test",
    episodes: int = EPISODES,
    max_steps: int = MAX_STEPS,
    faults: Faults | None = None,
) -> Task:
    """The task of an evaluation: the first sets of a bank, with a cap, and with these faults instead of its own.

    Raises:
        LayoutError: the bank cannot be read.
        ValueError: more episodes than the bank has sets, or a count below 1.
    """
    if not isinstance(faults, Faults | None):
        raise ConfigError(f"faults={told(faults)}; give Faults, or None for the task's own")
    if not isinstance(episodes, int) or not isinstance(max_steps, int):
        raise ValueError(f"episodes={told(episodes)}, max_steps={told(max_steps)}; give whole numbers")
    bank = banks.resolve(layouts, task.world)
    check_bounds(episodes, max_steps, len(bank))
    flown = replace(task, bank=bank[:episodes], max_steps=max_steps)
    return flown if faults is None else replace(flown, faults=faults)


def check_bounds(episodes: int, max_steps: int, most: int) -> None:
    """Raise a ValueError for more episodes than a bank's sets, which are `most`, or for a count below 1."""
    if not 1 <= episodes <= most or not 1 <= max_steps <= MOST_STEPS:
        bounds = f"1 to {most} episodes of at least 1 step and at most {MOST_STEPS:,}"
        raise ValueError(f"episodes={told(episodes)}, max_steps={told(max_steps)}; give {bounds}")


def fly(
    population: Mapping[int, AnyPolicy],
    task: Task,
    tell: Callable[[int, int], object] = lambda step, up: None,
    measure: Measure | None = None,
) -> Flights:
    """Evaluate one policy a seed on every set of the task's bank, the flights of all of them in one batch.

    `tell` is called after each step with its number and how many flights go on. What `measure`, or the task's own,
    gives of each step is added up over a flight: a column more for each. Flights that go round for ever are
    counted to the cap instead of flown (`uavnav.evaluation.repeats`).
    """
    return fly_crews({"": population}, task, tell, measure)[""]


def fly_crews(
    crews: Mapping[str, Mapping[int, AnyPolicy]],
    task: Task,
    tell: Callable[[int, int], object] = lambda step, up: None,
    measure: Measure | None = None,
) -> dict[str, Flights]:
    """Evaluate several populations in one batch, such as `greedy` and `sampled`: what each leaves, by its name.

    Arguments are as of `fly`; `tell` counts the flights of all.
    """
    flyers = [flyer for crew in crews.values() for flyer in crew.items()]
    sets = len(task.bank)
    seeds = torch.tensor([seed for seed, _ in flyers]).repeat_interleave(sets)
    crew = torch.arange(len(crews)).repeat_interleave(torch.tensor([sets * len(one) for one in crews.values()]))
    sums = Sums(measure or task.measure, flights.start(task, [seed for seed, _ in flyers]))
    goes_round = torch.tensor([not sums.columns and _repeatable(policy, task) for _, policy in flyers])
    repeats = Repeats(goes_round.repeat_interleave(sets), task.max_steps or 0, WATCHED_STEPS)
    ended: list[dict[str, Tensor]] = []
    watched: list[dict[str, Tensor]] = []
    for step in flights.fly(flyers, task):
        up = ~step.ended
        if step.number <= WATCHED_STEPS:
            watched.append(_watch(step, seeds[step.flight], crew[step.flight]))
        if sums.columns:
            sums.add(step.flight, step.state)
        if not up.all():
            over, flight = step.place[~up], step.flight[~up]
            row = _end(seeds[flight], at(step.states, over), step.outcomes.terminated[over])
            ended.append(row | sums.of(flight) | {CREW: crew[flight]})
        if (counted := repeats.see(step)) is not None:
            flight, at_cap = counted
            row = _end(seeds[flight], at_cap, torch.zeros(len(flight), dtype=torch.bool))
            ended.append(row | {CREW: crew[flight]})
        tell(step.number, int((~step.ended).sum()))
    rows = _tables(ended, EPISODE_COLUMNS | sums.columns, len(crews))
    steps = _tables(watched, BEHAVIOUR_COLUMNS, len(crews))
    return {name: Flights(*own) for name, *own in zip(crews, rows, steps, strict=True)}


class Sums:
    """What a measure gives, added up over each flight; start: of all flights [F]."""

    def __init__(self, measure: Measure, start: State) -> None:
        self._measure, self._before = measure, type(start)(*(field.clone() for field in start))
        self._sums = {name: torch.zeros_like(one) for name, one in measure(start, start).items()}
        self.columns = {name: str(one.dtype).removeprefix("torch.") for name, one in self._sums.items()}

    def add(self, flight: Tensor, after: State) -> None:
        """A step of some flights, which led to a state."""
        found = self._measure(at(self._before, flight), after)
        for name, value in found.items():
            self._sums[name][flight] += value
        for field, new in zip(self._before, after, strict=True):
            field[flight] = new

    def of(self, flight: Tensor) -> dict[str, Tensor]:
        """The sums of some flights."""
        return {name: one[flight] for name, one in self._sums.items()}


def _repeatable(policy: AnyPolicy, task: Task) -> bool:
    """Whether the same pose is always followed by the same steps and rewards."""
    greedy = isinstance(policy, Policy) and policy.greedy
    return greedy and task.STATIC and not task.remembers and REWARDS[task.reward] in BY_ACTION


def _end(seed: Tensor, state: State, terminated: Tensor) -> dict[str, Tensor]:
    counts = {name: getattr(state, name) for name in ("layout", *COUNTS)}
    flags = {"terminated": terminated, "truncated": ~terminated}
    return {"seed": seed, "frame": state.steps, "env": state.layout, **counts, **flags}


def _watch(step: flights.Transition, seed: Tensor, crew: Tensor) -> dict[str, Tensor]:
    layout = step.states.layout[step.place]
    kept = layout < WATCHED_LAYOUTS
    return {"seed": seed[kept], "layout": layout[kept], "action": step.action[kept], CREW: crew[kept]}


def _tables(parts: list[dict[str, Tensor]], columns: dict[str, str], n_crews: int) -> list[pd.DataFrame]:
    """The rows of each crew by seed and set, each flight's in the order of its steps."""
    whole = pd.DataFrame({name: torch.cat([part[name] for part in parts]).numpy() for name in (*columns, CREW)})
    whole = whole.astype(columns).sort_values(["seed", "layout"], kind="stable")
    return [whole[whole[CREW] == crew].drop(columns=CREW).reset_index(drop=True) for crew in range(n_crews)]


def evaluate_run(
    run: Run,
    episodes: int = EPISODES,
    max_steps: int | None = None,
    layouts: str | Path = "test",
    quiet: bool = False,
    faults: Faults | None = None,
) -> pd.DataFrame:
    """Evaluate every seed of a run, greedy and sampled, and keep the rows in its folder (`files_of` says where).

    Training's generators play no part, and nothing else in the folder changes. On a terminal a bar shows how far it is,
    unless it is `quiet`. Faults are those that the run was trained with, unless others are given. The cap on steps is
    10,000 if none is given, or the task's own where that is lower.

    Returns:
        The columns of `metrics.EPISODE_COLUMNS` and `mode`; in `attrs`, and in the file's header, the protocol.

    Raises:
        LayoutError, PolicyError, RunError: the bank or the run's policy cannot be read, or its folder not be written.
    """
    if not isinstance(run, Run):
        raise RunError(f"run={told(run)}; give a Run")
    crews = {
        mode: {seed: policies.load_policy(run.path, seed, greedy=mode == "greedy") for seed in run.seeds}
        for mode in MODES
    }
    own = crews["greedy"][run.seeds[0]].task
    max_steps = own.cap(MAX_STEPS) if max_steps is None else max_steps
    task = on(own, layouts, episodes, max_steps, faults)
    rows_file, behaviour_file = files_of(layouts, episodes, max_steps, faults)
    usual = type(task) is Task and rows_file == EVALUATION
    n = episodes * len(MODES)

    def fly_seeds(
        seeds: Sequence[int], tell: Callable[[int, int], object] = lambda step, up: None
    ) -> dict[str, pd.DataFrame]:
        own = {mode: {seed: crew[seed] for seed in seeds} for mode, crew in crews.items()}
        flown = fly_crews(own, task, tell, measure_of(layouts))
        rows = pd.concat([part.episodes.assign(mode=mode) for mode, part in flown.items()])
        behaviour = pd.concat([part.behaviour.assign(mode=mode) for mode, part in flown.items()])
        beside = _beside(run, own) if usual else {}
        return {**beside, behaviour_file: behaviour, rows_file: rows}  # rows last: who finds them has the others too

    here, there = _halves(run.seeds, n * max_steps)
    what = f"{run.algorithm} {run.config['activation']}" + ", half of the seeds" * bool(there)
    fork = machine.forked(lambda: fly_seeds(there)) if there else contextlib.nullcontext(dict)
    with machine.use_threads(1), fork as others, display.flights(what, n * len(here), max_steps, quiet) as tell:
        parts = [fly_seeds(here, tell)]
        if there:
            parts.append(others())
    tables = {name: _in_order([part[name] for part in parts]) for name in parts[0]}
    with lock(run.path):
        for name, table in tables.items():
            if name in (rows_file, behaviour_file):
                table.attrs = header(layouts, episodes, max_steps, faults)
            write_table(run.path / name, table)
    return tables[rows_file]


def _in_order(parts: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Rows by mode, seed and set, the steps of a flight as they are."""
    by = [name for name in ("mode", "seed", "layout") if name in parts[0]]
    return pd.concat(parts).sort_values(by, kind="stable", ignore_index=True)


def _halves(seeds: list[int], steps: int) -> tuple[list[int], list[int]]:
    """The seeds that fly here, and those that a fork of this process flies meanwhile: none where that would not pay.

    Whoever flies among others has the same rows. steps: of a seed's flights, if none ended.
    """
    pays = machine.forks() and len(seeds) * steps >= machine.MANY
    return (seeds[::2], seeds[1::2]) if pays else (seeds, [])


def _beside(run: Run, crews: Mapping[str, Mapping[int, Policy]]) -> dict[str, pd.DataFrame]:
    """What else is kept of policies in the paper's world, by the name of its file; crews: by mode and seed."""
    empty = [empty_arena.fly(population).assign(mode=mode) for mode, population in crews.items()]
    found = {ARENA: pd.concat(empty, ignore_index=True).astype(BEHAVIOUR_COLUMNS)}
    if ALGORITHMS[run.algorithm].shown == "Q value":
        found[VALUES] = values.overestimation(crews["greedy"], run.config["gamma"])
    return found


def usual_files(run: Run) -> tuple[str, str]:
    """The same of the protocol that a run is evaluated by if nothing else is said."""
    return files_of("test", EPISODES, TASKS.get(run.config.get("task", "drone"), Task).cap(MAX_STEPS))


def files_of(layouts: str | Path, episodes: int, max_steps: int, faults: Faults | None = None) -> tuple[str, str]:
    """The files of rows and of behaviour of a protocol, in a run's folder.

    `evaluation.parquet` is for 200 test sets and 10,000 steps alone, with the faults of training; another protocol has
    a file of its own, such as `evaluation-test-10-500.parquet`, or `evaluation-test-200-10000-noise=5.parquet`.
    """
    own = f"{protocol_name(layouts, episodes, max_steps, faults)}.parquet"
    return EVALUATION.replace(".parquet", own), BEHAVIOUR.replace(".parquet", own)


def protocol_name(
    layouts: str | Path, episodes: int, max_steps: int, faults: Faults | None = None, task: str = "drone"
) -> str:
    """What a file's name says of a protocol, so that none replaces another's: nothing for 200 test sets of the paper's
    task and 10,000 steps, or such as `-test-10-500` and `-moving-test-200-10000-noise=5`."""
    if (str(layouts), episodes, max_steps, faults, task) == ("test", EPISODES, MAX_STEPS, None, "drone"):
        return ""
    parts = (*[task] * (task != "drone"), banks.name_of(layouts), episodes, max_steps, *[faults] * (faults is not None))
    return "".join(f"-{part}" for part in parts)


def rows_across(ladder: str, episodes: int, max_steps: int) -> str:
    """The file of a run's rows across a ladder, in its folder."""
    return f"across-{ladder}-{episodes}-{max_steps}.parquet"
