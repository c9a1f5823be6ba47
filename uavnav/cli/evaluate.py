"""`uavnav evaluate`: the command."""

from __future__ import annotations

import functools
import json
import sys
from argparse import Namespace
from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from uavnav import plugins
from uavnav.cli import commands
from uavnav.errors import complain, did_you_mean_run
from uavnav.evaluation import evaluate_run, files_of, header, on, protocol_name, summary
from uavnav.evaluation.across import Flyer, across
from uavnav.evaluation.transfer import transfer
from uavnav.files import check_out
from uavnav.runs import Run, policies
from uavnav.runs.metrics import MODES
from uavnav.runs.policies import Policy
from uavnav.runs.tables import RunError, write_table
from uavnav.tasks.baselines import BASELINES, AnyPolicy
from uavnav.tasks.faults import from_option
from uavnav.tasks.ladders import measure_of
from uavnav.tasks.protocol import DRAWS, GROUPS, MAX_STEPS
from uavnav.tasks.simulator import EMPTY, TASKS, Task, make_task, name_of

MOST_SEEDS = 1_000
"""Of a script."""


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


def _cap(arguments: Namespace, task: Task | type[Task]) -> int:
    given: int | None = arguments.max_steps
    return task.cap(MAX_STEPS) if given is None else given


def _world(flyers: Mapping[str, AnyPolicy], task: str) -> Task:
    """The world of what is no run: a policy's own, a script's is that of the task."""
    first = next(iter(flyers.values()))
    return first.task if isinstance(first, Policy) else make_task(EMPTY, task=task)


def _rows_file(name: str, mode: str, protocol: str = "") -> str:
    """Where the rows of what is no run are kept; a report calls them so."""
    who = name if name in BASELINES else f"{Path(name).stem}-{mode}"
    return f"{who}{protocol}.parquet"


def _check_seeds(arguments: Namespace) -> None:
    given, elsewhere = f"--seeds {arguments.seeds}", arguments.across is not None or arguments.transfer
    if not 1 <= arguments.seeds <= MOST_SEEDS:
        raise ValueError(f"{given}; give at least 1 and at most {MOST_SEEDS:,}")
    if DRAWS not in arguments.runs or elsewhere:
        raise ValueError(f"{given}: only {DRAWS} has several, on the sets of one bank; leave it out")


def _elsewhere(arguments: Namespace, found: Mapping[str, Run | dict[str, AnyPolicy]]) -> int:
    """The command with `--across` or `--transfer`; returns the exit status."""
    if arguments.alone and arguments.across is None:
        raise ValueError("--alone: only --across flies others beside; leave it out")
    if (given := arguments.faults) is not None:
        raise ValueError(f"--faults {given}: ladders and worlds of training have their own; leave it out")
    if arguments.layouts != "test":
        told = "--across and --transfer fly on test sets of their own"
        raise ValueError(f"--layouts {arguments.layouts}: {told}; leave it out")
    if arguments.transfer and arguments.task != "drone":
        raise ValueError(f"--task {arguments.task}: --transfer flies in the worlds of the runs; leave it out")
    quiet = arguments.quiet or arguments.json
    tell = functools.partial(print, file=sys.stderr)
    if arguments.transfer:
        records = transfer(found, arguments.episodes, arguments.max_steps, arguments.out, quiet, tell)
    else:
        names = dict.fromkeys(one for word in arguments.across for one in GROUPS.get(word, (word,)))
        bounds = arguments.episodes, arguments.max_steps, arguments.out
        records = across(found, [*names], *bounds, quiet, tell, arguments.task, arguments.alone)
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
        if arguments.task != "drone" and not BASELINES.keys() & found.keys():
            raise ValueError(f"--task {arguments.task}: what was trained flies in its own world; leave it out")
        if arguments.seeds != 1:
            _check_seeds(arguments)
        faults = from_option(arguments.faults)
        others = {name: one for name, one in found.items() if not isinstance(one, Run)}
        worlds = {name: _world(one, arguments.task) for name, one in others.items()}
        protocols = {
            name: (arguments.layouts, arguments.episodes, _cap(arguments, task), faults, name_of(task))
            for name, task in worlds.items()
        }
        if arguments.out is not None:
            for name, protocol in protocols.items():
                for mode in others[name]:
                    check_out(arguments.out / _rows_file(name, mode, protocol_name(*protocol)))
        if arguments.across is not None or arguments.transfer or arguments.alone:
            return _elsewhere(arguments, found)
        quiet, records = arguments.quiet or arguments.json, []
        for name, run in found.items():
            if isinstance(run, Run):
                cap = _cap(arguments, TASKS.get(run.config.get("task", "drone"), Task))
                rows = evaluate_run(run, arguments.episodes, cap, arguments.layouts, quiet, faults)
                kept = [run.path / files_of(arguments.layouts, arguments.episodes, cap, faults)[0]]
            else:
                seeds = range(arguments.seeds if name == DRAWS else 1)
                who = Flyer(name, {mode: dict.fromkeys(seeds, policy) for mode, policy in run.items()})
                protocol, kept = protocols[name], []
                task = on(worlds[name], *protocol[:-1])
                flown = who.fly(task, f"on {arguments.layouts}", quiet, measure_of(arguments.layouts))
                rows = pd.concat([part.assign(mode=mode) for mode, part in flown.items()], ignore_index=True)
                rows.attrs = header(*protocol)
                for mode, part in flown.items() if arguments.out is not None else ():
                    path = arguments.out / _rows_file(name, mode, protocol_name(*protocol))
                    path.parent.mkdir(parents=True, exist_ok=True)
                    part.attrs = rows.attrs
                    write_table(path, part)
                    kept.append(path)
            records.append({"run": name, **summary.evaluation_record(rows)})
            if not quiet:
                shown = run if isinstance(run, Run) else name if name in BASELINES else Path(name).stem
                summary.show(summary.of_evaluation(rows, shown))
                print("".join(f"the rows are in {path}\n" for path in kept), end="", flush=True)
        if arguments.json:
            print(json.dumps(records, indent=2))
    except BrokenPipeError:  # nobody reads on: `terminal` ends it
        raise
    except (RunError, ValueError, OSError) as error:
        complain("evaluate", policies.as_option(error))
        return 2
    return 0
