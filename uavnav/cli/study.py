"""The command `uavnav study`: train, evaluate and report many configurations."""

from __future__ import annotations

import contextlib
import json
import shlex
import sys
import time
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

from uavnav import files, plugins, studies
from uavnav.cli import commands
from uavnav.cli.train import value_of
from uavnav.errors import ConfigError
from uavnav.evaluation import Protocol, scripted
from uavnav.report import report
from uavnav.runs import heard, progress
from uavnav.runs.tables import RunError
from uavnav.settings import Count, Seconds, Settings, key
from uavnav.studies import Configuration, draws, engines, search, tuning
from uavnav.studies.run import Runner, Work, check_folder, evaluated, let_go, make_layouts, trained
from uavnav.tasks import ladders, layouts
from uavnav.tasks.layouts import LayoutError
from uavnav.tasks.protocol import USUAL
from uavnav.tasks.table import EMPTY, make_task
from uavnav.training.recorder import CHECKPOINT_SECONDS

LINE_SECONDS = 30.0  # between two lines of progress where there is no terminal


class Keys(Settings):
    """The settings of a study, without those of its engine; `commands.STUDY_KEYS` says what they mean."""

    engine: str = key("local")
    out: str | None = key(None)
    seeds: Count | None = key(None)
    frames: Count | None = key(None)
    trials: Count | None = key(None, le=1_000)
    algorithms: str | None = key(None)
    seeds_per_worker: Count | None = key(None)
    checkpoint_seconds: Seconds = key(CHECKPOINT_SECONDS)
    policies: bool = key(False)
    report: bool = key(True)
    plugins: Any = key(None)


def parse(words: Sequence[str]) -> tuple[Keys, dict[str, Any]]:
    """The settings in `key=value` words, and those that are the engine's; raises a ConfigError."""
    given = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals:
            raise ConfigError(f"{word!r} is no setting; settings are key=value: engine=local")
        if not value:
            raise ConfigError(f"{word}: give a value, or leave it out")
        given[name] = value_of(word, value)
    own = Keys(**{name: given.pop(name) for name in Keys.names() if name in given})
    plugins.load(commands.names_in(words, "plugins"))
    return own, given


def status(configuration: Configuration) -> dict[str, Any]:
    """What there is of a configuration: `state`, and the frames per seed of one that is under way."""
    out, config = configuration.out, configuration.config
    facts = {"configuration": str(out), "seeds": config.n_seeds, "frames": 0, "of": config.frames}
    if (out / "config.yaml").exists():
        try:
            check_folder(configuration)
        except LayoutError:
            pass  # a study makes its layouts when it begins
        except RunError as error:
            return facts | {"state": f"in the way ({error})"}
    if trained(configuration):
        state = "finished" if evaluated(configuration) else "not evaluated"
        return facts | {"frames": config.frames, "state": state}
    told = progress(out)
    state = "under way" if heard(told, time.time()) else "stopped" if out.exists() else "missing"
    return facts | {"frames": told.get("frames", 0), "state": state}


class Show:
    """The configurations under way: on a terminal a table until `stack` ends, elsewhere lines."""

    def __init__(self, quiet: bool, stack: contextlib.ExitStack) -> None:
        self._console = Console(highlight=False, soft_wrap=True, markup=False, quiet=quiet)
        self._live = Live(console=self._console, transient=True, auto_refresh=False)
        self._said = time.monotonic()
        if self._console.is_terminal:
            stack.enter_context(self._live)

    def say(self, line: str) -> None:
        self._console.print(line)

    def tell(self, works: Sequence[Work]) -> None:
        """works: all configurations that were not finished when the study began."""
        now, frames = time.monotonic(), sum(work.frames for work in works)
        rate = sum(work.rate for work in works)
        total = sum(work.total for work in works if work.workers)
        left = f", {(total - frames) / rate / 60:,.0f} min left" if rate else ""
        head = (
            f"{frames / 1e6:,.2f} of {total / 1e6:,.2f} million frames of all seeds, {rate:,.0f} a "
            f"second{left}"
        )
        if self._console.is_terminal:
            table = Table(title=head, box=None, title_justify="left")
            for name in ("configuration", "workers", "frames per seed"):
                table.add_column(name, justify="left" if name == "configuration" else "right")
            for work in works:
                if work.frames and not all(worker.done for worker in work.workers):
                    config, done = work.configuration.config, sum(worker.done for worker in work.workers)
                    each = f"{work.frames // config.n_seeds:,} of {config.frames:,}"
                    table.add_row(str(work.configuration.out), f"{done} of {len(work.workers)}", each)
            self._live.update(table, refresh=True)
        elif now - self._said >= LINE_SECONDS:
            self._said = now
            self.say(head)


def main(arguments: Namespace) -> int:
    own, of_engine = parse(arguments.settings)
    study = studies.only(studies.read(arguments.name, own.seeds, own.frames), own.algorithms)
    out = Path(own.out or Path("runs") / study.name)
    if not files.nearest(out).is_dir():
        raise RunError(f"out={out}: is a file; give a folder")
    if own.trials is not None and study.tune is None and study.draw is None:
        raise ConfigError(f"trials={own.trials}: study {study.name} neither tunes nor draws; leave it out")
    if arguments.json and not arguments.status:
        raise ConfigError("--json: only a --status is JSON; give both, or leave it out")
    make_engine = engines.chosen(own.engine, of_engine, Keys.names())
    folder = out if arguments.status else out.resolve()
    plan = search.plan(study, folder, own.trials)
    drawing = draws.plan(study, folder, own.trials)
    found = drawing.screened() if drawing else studies.configurations(study, folder)
    if arguments.status:
        rows = [status(one) for one in (*found, *(drawing.nearest() if drawing else ()))]
        if plan is not None:
            rows += [status(one) | ({"state": state} if state else {}) for one, state in search.planned(plan)]
        _print_status(rows, arguments.json)
        return 0
    engine = make_engine()
    with contextlib.ExitStack() as stack:
        stack.callback(let_go, engine)
        show = Show(arguments.quiet, stack)
        make_layouts(folder, study.obstacles)

        def train(configurations: Sequence[Configuration]) -> list[Work]:
            how: dict[str, Any] = {"policies": own.policies, "checkpoint_seconds": own.checkpoint_seconds}
            how |= {"tell": show.tell, "say": show.say}
            run = Runner(folder, configurations, engine, own.seeds_per_worker, **how)
            show.say(
                f"{study.name}: {study.what}; {len(run.works)} of {len(configurations)} configurations are "
                f"left, into {out}"
            )
            return run.run()

        untold = tuning.tune(plan, train, show.say) if plan is not None else []
        if plan is not None and not untold:
            found += search.winners(plan)
        failed = [] if untold else train(found)
        if drawing is not None and not failed:
            found = drawing.nearest()
            failed = train(found)
        flying = bool(study.scripted_folder) and not (untold or failed)
        home = out / str(study.scripted_folder)
        evaluations = scripted_evaluations(found, home, study.scripted) if flying else []
        unevaluated = 0
        for words in evaluations:
            show.say(f"{study.name}: uavnav evaluate {shlex.join(words)}")
            unevaluated += commands.run("evaluate", [*words, "--quiet"]) != 0
    failures = {
        f"{len(untold)} trials": untold,
        f"{len(failed)} of {len(found)} configurations": failed,
        f"{unevaluated} evaluations of scripted policies": unevaluated,
    }
    if what := next((words for words, some in failures.items() if some), ""):
        print(f"uavnav study: {what} failed; the same command repeats them", file=sys.stderr)
        return 1
    if own.report:
        print(f"the report is in {report([out]).path}")
    return 0


def scripted_evaluations(
    configurations: Sequence[Configuration], folder: Path, names: Sequence[str] = USUAL
) -> list[list[str]]:
    """The episodes of scripted policies that a folder lacks: of some in the tasks of configurations, of the
    usual ones on the rungs that are layouts of their own. Each is the words of `uavnav evaluate`.
    """
    wanted: dict[Protocol | None, tuple[Sequence[str], list[str]]] = {}
    for configuration in (one for one in configurations if one.evaluations):
        own, evaluations = configuration.config, configuration.evaluations
        climbed = [name for name in layouts.RUNGS if name in configuration.across]
        rungs = [ladders.split_of(name, rung) for name in climbed for rung in ladders.LADDERS[name].rungs]
        for evaluation in (*evaluations, *(evaluations[0]._replace(layouts=rung) for rung in rungs)):
            faults = evaluation.faults or own.faults
            task = make_task(EMPTY, own.world, own.reward, None, own.task, faults=faults)
            where = str(evaluation.layouts), evaluation.episodes, evaluation.max_steps, evaluation.shield
            protocol = scripted.protocol_in(task, *where)
            usual, (asked, more) = [one for one in names if one in USUAL], wanted.get(protocol, ((), []))
            wanted[protocol] = (
                names if evaluation in evaluations else asked or usual,
                ["--measures"] if configuration.measures else more,
            )
    return [
        [*scripted.words(lacking, folder, one), *more]
        for one, (asked, more) in wanted.items()
        if one is not None and (lacking := scripted.missing(folder, one, asked))
    ]


def _print_status(rows: Sequence[dict[str, Any]], as_json: bool) -> None:
    if as_json:
        print(json.dumps(rows, indent=2))
        return
    width = max(len(row["configuration"]) for row in rows)
    for row in rows:
        begun = row["state"] in ("under way", "stopped")
        far = f"  {row['frames']:,} of {row['of']:,} frames per seed" if begun else ""
        print(f"{row['configuration']:{width}}  {row['state']}{far}")
    states = [row["state"].partition(" (")[0] for row in rows]
    print(", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states)))
