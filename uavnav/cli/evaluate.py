"""`uavnav evaluate`: the command."""

from __future__ import annotations

import functools
import json
import sys
from argparse import Namespace
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from uavnav.errors import ConfigError
from uavnav.evaluation import Protocol, evaluate_run, on, summary
from uavnav.evaluation.across import Flyer, across, of_policy, of_run
from uavnav.evaluation.scripted import options, task_of
from uavnav.evaluation.transfer import transfer
from uavnav.files import check_out
from uavnav.runs import Run, policies, shipped
from uavnav.runs.tables import RunError, write_table
from uavnav.tasks.baselines import BASELINES
from uavnav.tasks.faults import from_option
from uavnav.tasks.ladders import measure_of
from uavnav.tasks.protocol import DRAWS, GROUPS, MAX_STEPS
from uavnav.tasks.table import TASKS, name_of
from uavnav.tasks.task import Task

MOST_SEEDS = 1_000  # of a scripted policy
USUAL = {"seeds": 1, "layouts": "test", "alone": False, "shield": False, "measures": False}
"""Options that are always there, and their values where they are not given."""
OF_ONE_SPLIT = {
    "faults": "ladders and tasks of training have their own",
    "shield": "only on the layouts of one split",
    "measures": "only on the layouts of one split",
    "layouts": "--across and --transfer fly on test layouts of their own",
}
"""Options that go neither with --across nor with --transfer, and why."""


def _found(name: str, arguments: Namespace) -> Run | Flyer:
    """A run, a zip, a policy that ships or a scripted policy."""
    if name in BASELINES or policies.is_zip(name) or shipped.is_shipped(name):
        who = of_policy(name, arguments.activation, arguments.seeds if name == DRAWS else 1)
        return who._replace(shield=arguments.shield)
    try:
        return Run(name)
    except RunError as error:
        raise RunError(f"{error}{shipped.instead(name)}") from error


def _check(arguments: Namespace, found: Mapping[str, Run | Flyer]) -> None:
    """Raise a ConfigError for options that do not go with what is named or with each other."""
    of_one_split = arguments.across is None and not arguments.transfer
    only_runs = all(isinstance(one, Run) for one in found.values())
    several = f"only {DRAWS} has several, on the layouts of one split"
    for name, goes, why in (
        ("task", BASELINES.keys() & found.keys(), "what was trained flies in its own task"),
        ("seeds", of_one_split and DRAWS in arguments.runs, several),
        ("alone", arguments.across is not None, "only --across adds scripted policies"),
        ("at", only_runs and of_one_split, "only runs keep policies, for one split"),
        ("out", not (only_runs and of_one_split), "the rows of a run are kept in its folder"),
        *((name, of_one_split, why) for name, why in OF_ONE_SPLIT.items()),
        ("task", not arguments.transfer, "--transfer flies in the tasks of the runs"),
    ):
        given = getattr(arguments, name)
        if given != USUAL.get(name) and not goes:
            words = options({name: f"{given:g}" if isinstance(given, float) else given})
            raise ConfigError(f"{' '.join(words)}: {why}; leave it out")


def _trained_in(found: Iterable[Run | Flyer]) -> Iterator[str]:
    """The tasks of runs and of other learned policies, if they are known here."""
    for one in found:
        if isinstance(one, Run) and (name := one.config["task"]) in TASKS:
            yield name
        elif isinstance(one, Flyer) and one.task is not None:
            yield name_of(one.task)


def _protocol(found: Run | Flyer, arguments: Namespace) -> Protocol:
    """How what is named is evaluated; what was trained flies in its own task."""
    if isinstance(found, Run):
        limit, name = TASKS.get(found.config["task"], Task).limit(MAX_STEPS), "drone"
    else:
        task = found.task or task_of(arguments.task)
        limit, name = task.limit(MAX_STEPS), name_of(task)
    limit = limit if arguments.max_steps is None else arguments.max_steps
    faults = from_option(arguments.faults)
    return Protocol(
        arguments.layouts, arguments.episodes, limit, faults, name, arguments.at, arguments.shield
    )


def _files(who: Flyer, arguments: Namespace) -> dict[str, Path]:
    """Where the rows of a zip or a scripted policy are kept, by mode; a report calls them so."""
    if arguments.out is None:
        return {}
    protocol = _protocol(who, arguments)
    names = {mode: who.name if who.task is None else f"{Path(who.name).stem}-{mode}" for mode in who.modes}
    return {mode: arguments.out / protocol.file(name) for mode, name in names.items()}


def _evaluated(name: str, found: Run | Flyer, arguments: Namespace, quiet: bool) -> dict[str, object]:
    """Evaluate on the layouts of one split, keep the rows and show them; returns them for JSON."""
    protocol = _protocol(found, arguments)
    if isinstance(found, Run):
        layouts, episodes, limit, faults, _, at, shield = protocol
        rows = evaluate_run(found, episodes, limit, layouts, quiet, faults, at, shield, arguments.measures)
        kept = [found.path / protocol.file("evaluation")]
        shown: str | Run = found
    else:
        files = _files(found, arguments)
        task = on(found.task or task_of(protocol.task), *protocol[:4])
        measure = measure_of(protocol.layouts)
        rows = found.fly(task, f"on {protocol.layouts}", quiet, measure, arguments.measures)
        rows.attrs = protocol.header()
        for mode, path in files.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_table(path, rows[rows["mode"] == mode].drop(columns="mode").reset_index(drop=True))
        kept, shown = [*files.values()], name if found.task is None else Path(name).stem
    if not quiet:
        summary.show(summary.of_evaluation(rows, shown))
        print("".join(f"the rows are in {path}\n" for path in kept), end="", flush=True)
    return {"run": name, **summary.evaluation_record(rows)}


def main(arguments: Namespace) -> int:
    """Evaluate all that is named on one split, or across ladders, or in each other's tasks."""
    if not 1 <= arguments.seeds <= MOST_SEEDS:
        raise ConfigError(f"--seeds {arguments.seeds}; give at least 1 and at most {MOST_SEEDS:,}")
    learned = [
        *policies.zips(arguments.runs, arguments.activation),
        *filter(shipped.is_shipped, arguments.runs),
    ]
    if arguments.out is not None and len({Path(name).stem for name in learned}) < len({*learned}):
        raise ConfigError(f"--out {arguments.out}: two policies of one name would share a file; rename one")
    found = {name: _found(name, arguments) for name in arguments.runs}
    _check(arguments, found)
    arguments.task = arguments.task or next(_trained_in(found.values()), "drone")
    for one in found.values():
        for path in _files(one, arguments).values() if isinstance(one, Flyer) else ():
            check_out(path)
    quiet = arguments.quiet or arguments.json
    if arguments.across is not None or arguments.transfer:
        flyers = [of_run(name, one) if isinstance(one, Run) else one for name, one in found.items()]
        bounds = arguments.episodes, arguments.max_steps, arguments.out
        tell = functools.partial(print, file=sys.stderr)
        if arguments.transfer:
            records = transfer(flyers, *bounds, quiet, tell)
        else:
            names = dict.fromkeys(one for word in arguments.across for one in GROUPS.get(word, (word,)))
            records = across(flyers, [*names], *bounds, quiet, tell, arguments.task, arguments.alone)
    else:
        records = [_evaluated(name, one, arguments, quiet) for name, one in found.items()]
    if arguments.json:
        print(json.dumps(records, indent=2))
    return 0
