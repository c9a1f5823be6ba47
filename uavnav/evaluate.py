"""Fly policies on sets of obstacles that they never trained on: one row an episode.

`uavnav evaluate RUN...` evaluates every seed of finished runs, greedy and sampled, into their folders; and
whatever else flies (scripted baselines, zips of Stable-Baselines3), whose rows `--out` keeps for a report.
"""

from __future__ import annotations

import functools
import json
import sys
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import pandas as pd
import torch
from torch import Tensor

from uavnav import commands, flights, plugins, policies
from uavnav.choices import did_you_mean_run
from uavnav.files import check_out
from uavnav.policies import Policy
from uavnav.repeats import Repeats
from uavnav.runs import BEHAVIOUR, EVALUATION, Run
from uavnav.runs.metrics import EPISODE_COLUMNS, MODES
from uavnav.runs.tables import RunError, lock, write_table
from uavnav.tasks import layouts as banks
from uavnav.tasks.baselines import BASELINES, AnyPolicy, suited
from uavnav.tasks.faults import Faults, from_words
from uavnav.tasks.ladders import Measure, measure_of
from uavnav.tasks.protocol import ACROSS_STEPS, GROUPS
from uavnav.tasks.protocol import EPISODES as EPISODES
from uavnav.tasks.protocol import MAX_STEPS as MAX_STEPS
from uavnav.tasks.protocol import header as header
from uavnav.tasks.rewards import BY_ACTION, REWARDS
from uavnav.tasks.simulator import EMPTY, Task, make_task
from uavnav.tasks.state import COUNTS, State, at
from uavnav.tasks.world import World
from uavnav.training import display, machine
from uavnav.training.display import evaluation_summary

WATCHED_LAYOUTS = 10
WATCHED_STEPS = 500
"""Behaviour is kept of so many sets of obstacles, and of so many steps of each."""

BEHAVIOUR_COLUMNS = {"seed": "int64", "layout": "int64", "action": "int16"}
"""The steps of a flight follow each other. Where they lead, `uavnav.report.behaviour.retrace` works out."""


class Flights(NamedTuple):
    """What an evaluation leaves."""

    episodes: pd.DataFrame  # one row an episode, `metrics.EPISODE_COLUMNS`
    behaviour: pd.DataFrame  # one row a watched step, `BEHAVIOUR_COLUMNS`


def evaluate_policy(
    policy: AnyPolicy,
    layouts: str | Path | Tensor = "test",
    episodes: int = EPISODES,
    max_steps: int = MAX_STEPS,
    world: World | None = None,
    reward: str | None = None,
    seed: int = 0,
    faults: Faults | None = None,
) -> pd.DataFrame:
    """One episode on each of the first sets of a bank, each starting at the centre.

    Args:
        policy: what `uavnav.load_policy` returns, or any callable of that form.
        layouts: `train`, `validation`, `test`, a bank's path, or a tensor [n, k, 3].
        episodes: how many sets, from the first.
        max_steps: an episode that lasts so long is cut off: `truncated`, a censored observation and no collision.
        world: constants and switches; by default those that the policy was trained in, if it has any.
        reward: a name of `uavnav.rewards.REWARDS`; by default the policy's, or eq14.
        seed: of the generator that the policy is given, and of what faults draw; also written into the column `seed`.
        faults: of its sensor and actuator; by default those that the policy was trained with, if it has any.

    Returns:
        A row an episode, the columns of `metrics.EPISODE_COLUMNS` (`frame` is the step of its end, `world` its row).

    Raises:
        LayoutError: the bank cannot be read.
        ValueError: an unknown reward, more episodes than the bank has sets, or a count below 1.
    """
    own = policy.task if isinstance(policy, Policy) else make_task(EMPTY, world)
    own = replace(own, world=world or own.world, reward=reward or own.reward)
    return fly({seed: policy}, on(own, layouts, episodes, max_steps, faults)).episodes


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
    if not isinstance(episodes, int) or not isinstance(max_steps, int):
        raise ValueError(f"episodes={episodes}, max_steps={max_steps}; give whole numbers")
    bank = banks.resolve(layouts, task.world)
    if not 1 <= episodes <= len(bank) or max_steps < 1:
        raise ValueError(
            f"episodes={episodes}, max_steps={max_steps}; give 1 to {len(bank)} episodes of at least 1 step"
        )
    flown = replace(task, bank=bank[:episodes], max_steps=max_steps)
    return flown if faults is None else replace(flown, faults=faults)


def fly(
    population: Mapping[int, AnyPolicy],
    task: Task,
    tell: Callable[[int, int], object] = lambda step, up: None,
    measure: Measure | None = None,
) -> Flights:
    """Evaluate one policy a seed on every set of the task's bank, the flights of all of them in one batch.

    `tell` is called after each step with its number and how many flights go on. What `measure`, or the task's own,
    gives of each step is added up over a flight: a column more for each. Flights that go round for ever are
    counted to the cap instead of flown (`uavnav.repeats`).
    """
    seeds = torch.tensor(list(population)).repeat_interleave(len(task.bank))
    sums = Sums(measure or task.measure, flights.start(task, list(population)))
    goes_round = not sums.columns and _repeatable(population, task)
    repeats = Repeats(len(seeds), task.max_steps or 0, WATCHED_STEPS) if goes_round else None
    ended: list[dict[str, Tensor]] = []
    watched: list[dict[str, Tensor]] = []
    for step in flights.fly(list(population.items()), task):
        up = ~step.ended
        if step.number <= WATCHED_STEPS:
            watched.append(_watch(step, seeds[step.flight]))
        if sums.columns:
            sums.add(step.flight, step.state)
        if not up.all():
            over = step.place[~up]
            own = sums.of(step.flight[~up])
            ended.append(_end(seeds[step.flight[~up]], at(step.states, over), step.outcomes.terminated[over]) | own)
        tell(step.number, int(up.sum()))
        if repeats is not None and (state_at_cap := repeats.see(step)) is not None:
            cut_off = torch.zeros(len(state_at_cap.x), dtype=torch.bool)
            ended.append(_end(seeds[step.flight[up]], state_at_cap, cut_off))
            break
    return Flights(
        _table(ended, EPISODE_COLUMNS | sums.columns).sort_values(["seed", "layout"], ignore_index=True),
        _table(watched, BEHAVIOUR_COLUMNS).sort_values(["seed", "layout"], kind="stable", ignore_index=True),
    )


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


def _repeatable(population: Mapping[int, AnyPolicy], task: Task) -> bool:
    """Whether the same pose is always followed by the same steps and rewards."""
    greedy = all(isinstance(policy, Policy) and policy.greedy for policy in population.values())
    return greedy and task.STATIC and not task.remembers and REWARDS[task.reward] in BY_ACTION


def _end(seed: Tensor, state: State, terminated: Tensor) -> dict[str, Tensor]:
    counts = {name: getattr(state, name) for name in ("layout", *COUNTS)}
    flags = {"terminated": terminated, "truncated": ~terminated}
    return {"seed": seed, "frame": state.steps, "world": state.layout, **counts, **flags}


def _watch(step: flights.Step, seed: Tensor) -> dict[str, Tensor]:
    layout = step.states.layout[step.place]
    kept = layout < WATCHED_LAYOUTS
    return {"seed": seed[kept], "layout": layout[kept], "action": step.action[kept]}


def _table(parts: list[dict[str, Tensor]], columns: dict[str, str]) -> pd.DataFrame:
    return pd.DataFrame({name: torch.cat([part[name] for part in parts]).numpy() for name in columns}).astype(columns)


def evaluate_run(
    run: Run,
    episodes: int = EPISODES,
    max_steps: int = MAX_STEPS,
    layouts: str | Path = "test",
    quiet: bool = False,
    faults: Faults | None = None,
) -> pd.DataFrame:
    """Evaluate every seed of a run, greedy and sampled, and keep the rows in its folder (`files_of` says where).

    Training's generators play no part, and nothing else in the folder changes. On a terminal a bar shows how far it is,
    unless it is `quiet`. Faults are those that the run was trained with, unless others are given.

    Returns:
        The columns of `metrics.EPISODE_COLUMNS` and `mode`; in `attrs`, and in the file's header, the protocol.

    Raises:
        LayoutError, PolicyError, RunError: the bank or the run's policy cannot be read, or its folder not be written.
    """
    flown, task = {}, None
    with machine.use_threads(1):
        for mode in MODES:
            population = {seed: policies.load_policy(run.path, seed, greedy=mode == "greedy") for seed in run.seeds}
            task = task or on(population[run.seeds[0]].task, layouts, episodes, max_steps, faults)
            what = f"{run.algorithm} {run.config['activation']}, {mode}"
            with display.flights(what, episodes * len(population), max_steps, quiet) as tell:
                flown[mode] = fly(population, task, tell, measure_of(layouts))
    rows = pd.concat([part.episodes.assign(mode=mode) for mode, part in flown.items()], ignore_index=True)
    behaviour = pd.concat([part.behaviour.assign(mode=mode) for mode, part in flown.items()], ignore_index=True)
    with lock(run.path):
        for name, table in zip(files_of(layouts, episodes, max_steps, faults), (rows, behaviour), strict=True):
            table.attrs = header(layouts, episodes, max_steps, faults)
            write_table(run.path / name, table)
    return rows


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


def _found(name: str, activation: str | None) -> Run | dict[str, AnyPolicy]:
    """A run, or what else flies, by its mode."""
    if name in BASELINES:
        return {"scripted": BASELINES[name]}
    if policies.is_zip(name):
        return {mode: policies.load_policy(name, greedy=mode == "greedy", activation=activation) for mode in MODES}
    try:
        return Run(name)
    except RunError as error:
        raise RunError(f"{error}{did_you_mean_run(name, BASELINES)}") from error


def _faults(words: str) -> Faults:
    try:
        return from_words(words)
    except ValueError as error:
        raise ValueError(f"--faults {words}: {error}") from error


def _rows_file(name: str, mode: str, protocol: str = "") -> str:
    """Where the rows of what is no run are kept; a report calls them so."""
    who = name if name in BASELINES else f"{Path(name).stem}-{mode}"
    return f"{who}{protocol}.parquet"


def _elsewhere(arguments: Namespace, found: Mapping[str, Run | dict[str, AnyPolicy]]) -> int:
    """The command with `--across` or `--transfer`; returns the exit status."""
    from uavnav.across import across  # which fly as this module does
    from uavnav.transfer import transfer

    if (given := arguments.faults) is not None:
        raise ValueError(f"--faults {given}: ladders and worlds of training have their own; leave it out")
    if arguments.layouts != "test":
        told = "--across and --transfer fly on test sets of their own"
        raise ValueError(f"--layouts {arguments.layouts}: {told}; leave it out")
    if arguments.transfer and arguments.task != "drone":
        raise ValueError(f"--task {arguments.task}: --transfer flies in the worlds of the runs; leave it out")
    cap = ACROSS_STEPS if arguments.max_steps is None else arguments.max_steps
    quiet = arguments.quiet or arguments.json
    tell = functools.partial(print, file=sys.stderr)
    if arguments.transfer:
        records = transfer(found, arguments.episodes, cap, arguments.out, quiet, tell)
    else:
        names = dict.fromkeys(one for word in arguments.across for one in GROUPS.get(word, (word,)))
        bounds = arguments.episodes, cap, arguments.out
        records = across(found, [*names], *bounds, quiet, tell, arguments.task)
    if arguments.json:
        print(json.dumps(records, indent=2))
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Evaluate finished runs, scripted baselines or zips of Stable-Baselines3 on the test split: one row an episode."""
    arguments = commands.parse("evaluate", argv)
    try:
        plugins.load(arguments.plugins)
        zips = policies.zips(arguments.runs, arguments.activation)
        if arguments.out is not None and len({Path(name).stem for name in zips}) < len(zips):
            raise ValueError(f"--out {arguments.out}: two zips of one name would share a file; rename one")
        found = {name: _found(name, arguments.activation) for name in arguments.runs}
        max_steps = MAX_STEPS if arguments.max_steps is None else arguments.max_steps
        bounds = arguments.layouts, arguments.episodes, max_steps
        faults = None if arguments.faults is None else _faults(arguments.faults)
        protocol = protocol_name(*bounds, faults, arguments.task)
        if arguments.out is not None:
            for name, run in found.items():
                for mode in () if isinstance(run, Run) else run:
                    check_out(arguments.out / _rows_file(name, mode, protocol))
        if arguments.across is not None or arguments.transfer:
            return _elsewhere(arguments, found)
        scripted = make_task(EMPTY, task=arguments.task)
        quiet, records = arguments.quiet or arguments.json, []
        for name, run in found.items():
            if isinstance(run, Run):
                rows = evaluate_run(run, arguments.episodes, max_steps, arguments.layouts, quiet, faults)
                kept = [run.path / files_of(*bounds, faults)[0]]
            else:
                flown = {}
                for mode, policy in run.items():
                    task = on(policy.task if isinstance(policy, Policy) else scripted, *bounds, faults)
                    with machine.use_threads(1), display.flights(f"{name}, {mode}", *bounds[1:], quiet) as tell:
                        flown[mode] = fly({0: suited(policy, task)}, task, tell, measure_of(arguments.layouts)).episodes
                rows = pd.concat([part.assign(mode=mode) for mode, part in flown.items()], ignore_index=True)
                kept = []
                for mode, part in flown.items() if arguments.out is not None else ():
                    path = arguments.out / _rows_file(name, mode, protocol)
                    path.parent.mkdir(parents=True, exist_ok=True)
                    part.attrs = header(*bounds, faults)
                    write_table(path, part)
                    kept.append(path)
            records.append({"run": name, **display.evaluation_record(rows)})
            if not quiet:
                who = run if isinstance(run, Run) else name if name in BASELINES else Path(name).stem
                display.show(evaluation_summary(rows, who))
                print("".join(f"the rows are in {path}\n" for path in kept), end="", flush=True)
        if arguments.json:
            print(json.dumps(records, indent=2))
    except BrokenPipeError:  # nobody reads on: `terminal` ends it
        raise
    except (RunError, ValueError, OSError) as error:
        print(f"uavnav evaluate: {policies.as_option(error)}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
