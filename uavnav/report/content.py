"""What a report says, before it is a page: studies, verdicts, numbers, figures, replays."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from uavnav.evaluation import EMPTY_ARENA
from uavnav.report import (
    activations,
    ambiguities,
    behaviour,
    figures,
    frames,
    horizon,
    learned,
    longer,
    noise,
    studies,
    tables,
    tuning,
    whys,
    worlds,
)
from uavnav.report.apart import evaluations
from uavnav.report.claims import (
    CLAIMS,
    COLUMNS,
    DISCUSSION,
    FINAL,
    OTHER,
    PRIMARY,
    Claim,
    Evidence,
    asked,
)
from uavnav.report.configurations import MODE, Configuration, algorithms, collect, read_as
from uavnav.report.operating import characteristics
from uavnav.report.quotes import STUDY, prose
from uavnav.report.studies import Studies
from uavnav.report.templating import Figure
from uavnav.report.verdicts import Finding, audit
from uavnav.report.worlds import Worlds
from uavnav.runs import VALUES, Run, paper
from uavnav.runs.definitions import DEFINITIONS, SAMPLED
from uavnav.runs.metrics import MODES
from uavnav.runs.tables import RunError, joined, read_table
from uavnav.tasks import layouts
from uavnav.tasks.world import World
from uavnav.training import machine
from uavnav.views import replays

Episodes = dict[whys.Place, pd.DataFrame]
Ask = tuple[str, Evidence, Evidence, Sequence[Claim]]
"""A column of grades, our numbers and the paper's, and the claims that are asked of them."""
WATCHED = ("main", "baseline", "initial")
"""Studies whose episodes are measured."""


@dataclass
class Content:
    """All that a report says."""

    configurations: list[Configuration]
    studies: Studies
    tables: dict[str, pd.DataFrame]  # by the name of their CSV
    figures: list[Figure]
    replays: dict[str, Any] | None
    baselines: dict[str, pd.DataFrame]
    left_out: list[str]

    @property
    def missing(self) -> list[str]:
        """The paper's configurations that have no finished run in the main study."""
        return [" ".join(key) for key in paper.TABLES if key not in self.studies.main]

    @property
    def of_the_study(self) -> bool:
        """Whether the main study is the one that answers for the paper, and all of it."""
        named = [
            studies.PLACES.get(one.study) == "main"
            for one in studies.paper_configurations(self.studies.main).values()
        ]
        return not self.missing and all(named)

    @property
    def unasked(self) -> list[int]:
        """The claims of which no run says anything."""
        known = {*self.tables["verdicts"].query("n > 0")["claim"]}
        return [claim.number for claim in CLAIMS if claim.number not in known]

    @property
    def evaluated(self) -> dict[str, pd.DataFrame]:
        """Each configuration's test episodes as a row a seed, sampled, by the folder of its first run."""
        read = {str(one.runs[0].path): read_as(one, SAMPLED) for one in self.configurations}
        return {name: seeds for name, seeds in read.items() if len(seeds)}

    @functools.cached_property
    def said(self) -> dict[str, str]:
        """The study's prose by block (`quotes`), empty in the report of other runs."""
        return prose(self.tables) if self.of_the_study else dict.fromkeys(STUDY.blocks, "")

    @functools.cached_property
    def baseline_rows(self) -> list[list[str]]:
        """Scripted policies, people and policies from elsewhere, as a table."""
        return tables.baselines(self.baselines)

    @functools.cached_property
    def paper_tables(self) -> dict[str, list[list[str]]]:
        """The main study as in the paper's tables, by algorithm: the paper's, and whatever else has runs."""
        main = self.studies.main
        return {
            algorithm: tables.table(
                {activation: one for (own, activation), one in main.items() if own == algorithm}, algorithm
            )
            for algorithm in dict.fromkeys([*paper.TABLE_OF, *algorithms(main)])
        }


def gather(
    folders: Sequence[Path],
    fly: Callable[[Sequence[replays.Trained]], dict[str, Any]] = replays.record,
    found: tuple[list[Configuration], list[str]] | None = None,
    tell: Callable[[str], None] = lambda step: None,
) -> Content:
    """Read all runs in some folders, let their policies fly a little, and work out what the report says.

    fly: gives the replays of some configurations; found: what `collect` gave; tell: is told each step.

    Raises a RunError where no run can be used.
    """
    configurations, left_out = found or collect(folders)
    dealt = studies.sort(configurations)
    left_out += studies.in_none(dealt)
    main, of_paper = dealt.main, studies.paper_configurations(dealt.main)
    shown = dict.fromkeys([*of_paper.values(), *studies.elsewhere(configurations)])
    flying = [replays.Trained(one.algorithm, one.activation, one.runs) for one in shown]
    with contextlib.ExitStack() as beside:
        beside.enter_context(machine.use_threads(1))
        replayed = beside.enter_context(machine.forked(lambda: fly(flying)))
        elsewhere = beside.enter_context(machine.forked(lambda: _apart(folders)))
        tell("measuring episodes")
        episodes, by_layout, watched, problems = watch(dealt)
        kept, unread = frames.baselines(folders)
        baselines = {who: rows for who, rows in kept.items() if frames.as_usual(rows)}
        tuned, winners, untuned = tuning.read(folders, baselines)
        evidence = {one: studies.evidence_of(dealt, one, episodes, by_layout, winners) for one in DEFINITIONS}
        tell("working out tables")
        survival, survived = frames.survival(main, baselines)
        overestimated, unvalued = _overestimation(of_paper)
        predictions = frames.predictions(evidence)
        carried = frames.carried(dealt, evidence[PRIMARY])
        values, vectorised = frames.per_seed_values(main), studies.paper_configurations(dealt.vectorised)
        numbers = {
            "seeds": values,
            "metrics": frames.estimates(values),
            "one_run": frames.one_run(values),
            "tuned": frames.estimates(frames.per_seed_values(dealt.tuned)),
            "improvement": frames.improvement(of_paper),
            "interaction": frames.interactions(values),
            "power": frames.power(main),
            "behaviour": frames.watched(episodes),
            "diagnostics": frames.diagnostics(of_paper),
            "sensitivity": frames.sensitivity(dealt),
            "configurations": frames.sizes(dealt),
            "effects": frames.effects(dealt),
            "environments": frames.one_against_many(dealt),
            "vectorised": frames.estimates(frames.per_seed_values(vectorised)),
            "wide": frames.estimates(frames.per_seed_values(studies.wide(dealt))),
            "speed": frames.speed(of_paper),
            "whys": whys.table(evidence[PRIMARY]),
            "overestimation": overestimated,
            "survival": survived,
            "predictions": predictions,
            "gaps": (gaps := frames.gaps(of_paper, baselines)),
            "passing": frames.passing(gaps),
            "by_default": frames.by_default(dealt, winners),
            "fits": frames.fits(predictions, evidence),
            "peaks": frames.peaks(of_paper, evidence),
            **tuned,
        }
        if dealt.tuned:
            numbers["fast"] = frames.gaps(dealt.tuned, baselines)
        if len(carried):
            numbers |= {"carried": carried, "further": frames.gaps(studies.further(dealt), baselines)}
        tell("judging the claims")
        asks: list[Ask] = [
            (column, evidence[one], functools.partial(studies.of_paper, definition=one), CLAIMS)
            for column, one in COLUMNS.items()
        ]
        of_worlds, of_studies, unread_apart = elsewhere()
        left_out += unread_apart
        if of_worlds:
            of_tasks = worlds.Evidence(of_worlds.seeds)
            asks += [(column, of_tasks, studies.of_paper, DISCUSSION) for column in (FINAL, OTHER)]
        audits: dict[str, list[Finding]] = {column: [] for column in COLUMNS}
        for column, ours, printed, claims in asks:
            audits[column] += audit(ours, printed, asked(claims, column))
        operating = beside.enter_context(
            machine.forked(
                lambda: joined(
                    [
                        characteristics(ours, printed, asked(claims, column)).assign(column=column)
                        for column, ours, printed, claims in asks
                    ]
                )
            )
        )
        numbers |= {"verdicts": frames.verdicts(audits), "grades": frames.grades(audits), **of_studies}
        tell("drawing figures")
        drawn = figures.draw(of_paper, numbers, watched, survival, of_worlds)
        numbers["operating"] = operating()
        tell("flying episodes for the replays")
        recorded = replayed()
    return Content(
        configurations,
        dealt,
        numbers,
        drawn,
        recorded if recorded["configurations"] else None,
        baselines,
        list(dict.fromkeys([*left_out, *problems, *unvalued, *unread, *untuned, *recorded["left_out"]])),
    )


def _apart(folders: Sequence[Path]) -> tuple[Worlds | None, dict[str, pd.DataFrame], list[str]]:
    """The study of further tasks, tables of other studies beside the paper's, and lines for unread ones."""
    numbers: dict[str, pd.DataFrame] = {}
    left_out: list[str] = []
    for study in (longer, noise, horizon):
        found, unread = evaluations(folders, study.STUDY)
        numbers |= {study.STUDY: study.table(found)} if found else {}
        left_out += unread
    for tables_of, unread in (one.gather(folders) for one in (ambiguities, activations, learned)):
        numbers |= tables_of
        left_out += unread
    of_worlds, unread = worlds.gather(folders)
    if of_worlds:
        places = worlds.summary(of_worlds)
        numbers |= {"places": places, "leaders": worlds.leaders(places), "places_runs": of_worlds.runs}
    return of_worlds, numbers, [*unread, *left_out]


def watch(all_configurations: Studies) -> tuple[Episodes, Episodes, Episodes, list[str]]:
    """Measures of episodes by mode and seed, by mode and layout, the episodes, and lines for what was unread.

    Those of the main study are also taken early and by layout (`behaviour.early`, `by_layout`), and in the
    empty arena: the measures there are `empty_...`, the `layout` is -1. Of other studies no claim or question
    asks for greedy episodes.
    """
    measured: Episodes = {}
    by_layout: Episodes = {}
    tables: Episodes = {}
    problems: list[str] = []
    world, all_layouts, by = World(), layouts.load("test"), ["mode", "seed"]
    in_arena = functools.partial(behaviour.read, in_arena=True)
    for study in (*WATCHED, *all_configurations.why):
        read = functools.partial(behaviour.read, modes=MODES if study == "main" else [MODE])
        for key, configuration in studies.paper_configurations(all_configurations.of(study)).items():
            if (table := _of_runs(configuration, read, problems)) is None:
                continue
            place, steps = (study, *key), behaviour.of_steps(table, all_layouts, world)
            tables[place], measured[place] = table, behaviour.of_seeds(steps)
            if study != "main":
                continue
            measured[place] = measured[place].join(behaviour.early(steps), on=by)
            by_layout[place] = behaviour.by_layout(steps)
            if (empty := _of_runs(configuration, in_arena, problems)) is not None:
                own = behaviour.measures(empty, EMPTY_ARENA, world).set_index(by).add_prefix("empty_")
                measured[place] = measured[place].join(own, on=by)
                tables[place] = pd.concat([table, empty.assign(layout=-1)], ignore_index=True)
    return measured, by_layout, tables, problems


def _of_runs(
    configuration: Configuration, read: Callable[[Run], pd.DataFrame | None], problems: list[str]
) -> pd.DataFrame | None:
    """What the runs of a configuration have of a table; a line for each that could not be read."""
    found = []
    for run in configuration.runs:
        try:
            found.append(read(run))
        except RunError as error:
            problems.append(str(error))
    there = [table for table in found if table is not None]
    return pd.concat(there, ignore_index=True) if there else None


def _overestimation(configurations: studies.Configurations) -> tuple[pd.DataFrame, list[str]]:
    """What seeds expect and get (`evaluation.values`), and a line for each table that could not be read."""
    columns = {"seed": "int64"} | dict.fromkeys(frames.OVERESTIMATION, "float64")

    def read(run: Run) -> pd.DataFrame | None:
        path = run.path / VALUES
        return read_table(path, columns, behaviour.AGAIN) if path.exists() else None

    problems: list[str] = []
    found = [pd.DataFrame(columns=["configuration", *columns])]
    for key, configuration in configurations.items():
        if (table := _of_runs(configuration, read, problems)) is not None:
            found.append(table.assign(configuration=frames.name(*key))[[*found[0].columns]])
    return joined(found), problems
