"""Fly policies across ladders: reward, collisions and survival against difficulty, scripted baselines beside them.

`uavnav evaluate RUN... --across density slalom` flies each policy on every rung and draws one figure a ladder.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.table import Table

from uavnav import stats, style
from uavnav.evaluation import check_bounds, fly_crews, rows_across, summary
from uavnav.files import check_out, write
from uavnav.runs import Run, metrics, policies
from uavnav.runs.metrics import MODES
from uavnav.runs.policies import Policy
from uavnav.runs.tables import RunError, lock, records, write_table
from uavnav.tasks.baselines import BASELINES, AnyPolicy, chosen_among, suited
from uavnav.tasks.ladders import LADDERS, Ladder, Measure
from uavnav.tasks.protocol import ACROSS_STEPS, SPLITS
from uavnav.tasks.simulator import EMPTY, Task, make_task
from uavnav.training import display, machine


class Flyer(NamedTuple):
    """Who flies a ladder: its seeds by mode, and where its rows are kept."""

    name: str
    by_mode: Mapping[str, Mapping[int, AnyPolicy]]
    folder: Path | None = None

    @property
    def first(self) -> AnyPolicy:
        """One of its policies: all were trained in one task."""
        return next(iter(next(iter(self.by_mode.values())).values()))

    def fly(self, task: Task, where: str, quiet: bool, measure: Measure | None) -> dict[str, pd.DataFrame]:
        """Its rows in a task, by mode; where: the task's name for a bar."""
        crews = {
            mode: {seed: suited(policy, task) for seed, policy in population.items()}
            for mode, population in self.by_mode.items()
        }
        n = len(task.bank) * sum(map(len, crews.values()))
        with machine.use_threads(1), display.flights(f"{self.name}, {where}", n, task.max_steps or 0, quiet) as tell:
            return {mode: left.episodes for mode, left in fly_crews(crews, task, tell, measure).items()}


def flyer(name: str, found: Run | Mapping[str, AnyPolicy]) -> Flyer:
    """A run, or what else flies by its mode."""
    if not isinstance(found, Run):
        return Flyer(name, {mode: {0: policy} for mode, policy in found.items()})
    by_mode = {
        mode: {seed: policies.load_policy(found.path, seed, greedy=mode == "greedy") for seed in found.seeds}
        for mode in MODES
    }
    return Flyer(name, by_mode, found.path)


def climb(
    who: Flyer,
    ladder: Ladder,
    episodes: int,
    max_steps: int = ACROSS_STEPS,
    quiet: bool = True,
    scripted: Task | None = None,
) -> pd.DataFrame:
    """Fly every rung of a ladder on its first test sets.

    scripted: what a script flies there; by default the paper's task.

    Returns:
        A row an episode: the columns of `metrics.EPISODE_COLUMNS`, `mode` and `rung`.
    """
    first = who.first
    own = first.task if isinstance(first, Policy) else scripted or make_task(EMPTY)
    parts = []
    for rung in ladder.rungs:
        task = ladder.task(replace(own, max_steps=max_steps), rung, "test")
        task = replace(task, bank=task.bank[:episodes])
        for mode, rows in who.fly(task, f"{ladder.words} {rung:g}", quiet, ladder.measure).items():
            parts.append(rows.assign(mode=mode, rung=float(rung)))
    return pd.concat(parts, ignore_index=True)


def judged(rows: Mapping[str, pd.DataFrame], by: str = "rung") -> pd.DataFrame:
    """Means and 95 % intervals over seeds, a row a name, mode, rung and measure; rows: of `climb`, by name.

    by: the column that tells what was flown.
    """
    found = []
    for name, table in rows.items():
        for (mode, rung), flown in table.groupby(["mode", by], sort=False):
            for measure, values in metrics.of_flights(flown).items():
                one = stats.interval(values.dropna().to_numpy())
                found.append([name, mode, rung, measure, one.n, one.value, one.low, one.high])
    columns = ["name", "mode", by, "measure", "n", "value", "low", "high"]
    return pd.DataFrame(found, columns=columns)


@matplotlib.rc_context(style.STYLE)
def draw(table: pd.DataFrame, ladder: Ladder, width: float = style.WIDTH) -> style.Drawn:
    """Each measure against difficulty, one line a policy as it acts in training, bands for intervals."""
    mine = table[table["mode"] != "greedy"]
    measures = [*dict.fromkeys(mine["measure"])]
    figure = Figure(figsize=(width, 1 + 2.5 * len(measures)), layout="constrained")
    panels = figure.subplots(len(measures), 1, sharex=True)
    names = list(dict.fromkeys(mine["name"]))
    learned = [name for name in names if name not in BASELINES]
    colours = dict(zip(learned, itertools.cycle([*style.COLOURS.values(), *style.OTHER_COLOURS]), strict=False))
    lines = dict(zip(BASELINES, (":", "-.", "--"), strict=True))
    for axes, measure in zip(panels, measures, strict=True):
        for name, own in mine[mine["measure"] == measure].groupby("name", sort=False):
            colour, line = colours.get(str(name), style.INK), lines.get(str(name), "-")
            axes.plot(own["rung"], own["value"], line, color=colour, marker="o", label=str(name))
            axes.fill_between(own["rung"], own["low"], own["high"], color=colour, alpha=0.15, linewidth=0)
        axes.set_title(in_words(measure))
    panels[-1].set_xlabel(ladder.words)
    panels[-1].set_xticks(sorted(ladder.rungs))
    style.legend(figure, panels[0].get_legend_handles_labels()[0])
    first, last = ladder.rungs[0], ladder.rungs[-1]
    rewards = mine[(mine["measure"] == "reward") & mine["rung"].isin([first, last])]
    told = "; ".join(
        f"{name}: {' to '.join(style.number(value) for value in own['value'])}"
        for name, own in rewards.groupby("name", sort=False)
    )
    return style.Drawn(figure, f"Reward per flight from {first:g} to {last:g} of {ladder.words}: {told}.")


def shown(table: pd.DataFrame, name: str) -> Table:
    """A ladder as a table: a row a policy, mode and rung, a column a measure."""
    measures = list(dict.fromkeys(table["measure"]))
    text = Table(title=f"{name}: {LADDERS[name].words}", title_justify="left", box=None)
    text.add_column("who", overflow="fold", width=18)
    text.add_column("")
    for column in ("rung", *map(in_words, measures)):
        text.add_column(column, justify="right")
    for (who, mode), mine in table.groupby(["name", "mode"], sort=False):
        for at, (rung, own) in enumerate(mine.groupby("rung", sort=False)):
            values = own.set_index("measure")["value"].reindex(measures)
            text.add_row(*([str(who), str(mode)] if not at else ["", ""]), f"{rung:g}", *map(_number, values))
    return text


def in_words(measure: str) -> str:
    """A measure with its unit."""
    return metrics.FLIGHTS.get(measure) or metrics.OWN[measure].label


def _number(value: float) -> str:
    return style.number(round(value, 9)) if np.isfinite(value) else "–"


def _task_of(one: Flyer, scripted: Task) -> Task:
    """What it was trained in, or what scripts fly."""
    return one.first.task if isinstance(one.first, Policy) else scripted


def across(
    found: Mapping[str, Run | Mapping[str, AnyPolicy]],
    names: Sequence[str],
    episodes: int,
    max_steps: int | None,
    out: Path | None,
    quiet: bool,
    tell: Callable[[str], object] = print,
    task: str = "drone",
    alone: bool = False,
) -> list[dict[str, Any]]:
    """Fly all that is named, and the scripted baselines, across ladders; keep rows and a figure.

    The cap on steps is 2,000 if none is given, or that of somebody's own task where it is lower; `tell` is told of caps
    that differ, and a figure is named after the highest. Scripts fly what the first policy was trained in; without one,
    the world of `task`. A ladder that somebody's world does not have is left out, and `tell` is told so. The rows of a
    run lie in its folder, figures in `out` or else in the first run's folder. `alone`, policies fly only as in
    training, without scripts and a figure.

    Returns:
        What the tables show, for JSON.

    Raises:
        LayoutError, PolicyError: a bank or a policy cannot be read.
        RunError: a file cannot be written, or no ladder is left.
        ValueError: a count below 1, or more sets than a bank has.
    """
    flyers = [flyer(name, one) for name, one in found.items()]
    if alone:
        acted = [{mode: crew for mode, crew in one.by_mode.items() if mode != "greedy"} for one in flyers]
        flyers = [one._replace(by_mode=own) for one, own in zip(flyers, acted, strict=True)]
    trained = (replace(one.first.task, stack=1) for one in flyers if isinstance(one.first, Policy))
    theirs = next(trained, make_task(EMPTY, task=task))
    check_bounds(episodes, ACROSS_STEPS if max_steps is None else max_steps, SPLITS["test"].n)
    folder = out or next((one.folder for one in flyers if one.folder is not None), Path())
    check_out(folder / "across.svg")
    unfit = {
        name: [one.name for one in flyers if not ladder.fits(_task_of(one, theirs))] for name, ladder in LADDERS.items()
    }
    fit = ", ".join(name for name in LADDERS if not unfit[name])
    climbed = [name for name in names if not unfit[name]]
    if not climbed:
        raise RunError(f"--across {' '.join(names)}: no ladder of these worlds; give some of {fit}")
    for name in names:
        if name not in climbed:
            tell(f"left out: the ladder {name}, which the world of {', '.join(unfit[name])} does not have; {fit} fit")
    turns, distances = chosen_among(theirs.world)
    if not alone and (theirs.world.n_turns, theirs.world.n_distances) != (turns, distances):
        tell(f"left out: the scripts, which choose among {turns} turns and {distances} distances")
    elif not alone:
        flyers += [flyer(name, {"scripted": rule}) for name, rule in BASELINES.items() if name not in found]
    caps = {one.name: max_steps or _task_of(one, theirs).cap(ACROSS_STEPS) for one in flyers}
    if len(set(caps.values())) > 1:
        each = ", ".join(f"{name} {cap:,}" for name, cap in caps.items())
        tell(f"caps on steps differ ({each}); --max-steps gives all the same")
    folder.mkdir(parents=True, exist_ok=True)
    told: list[dict[str, Any]] = []
    for name in climbed:
        rows, stem = {}, Path(rows_across(name, episodes, max(caps.values()))).stem
        for one in flyers:
            cap = caps[one.name]
            rows[one.name] = climb(one, LADDERS[name], episodes, cap, quiet, theirs)
            if one.folder is not None:
                rows[one.name].attrs = {"ladder": name, "episodes": episodes, "max_steps": cap}
                with lock(one.folder):
                    write_table(one.folder / rows_across(name, episodes, cap), rows[one.name])
        table = judged(rows)
        if not quiet:
            summary.show(shown(table, name))
        if not alone:
            svg, png = style.save(draw(table, LADDERS[name]).figure)
            write(folder / f"{stem}.svg", svg)
            write(folder / f"{stem}.png", png)
        if not (quiet or alone):
            print(f"the figure is {folder / f'{stem}.png'}", flush=True)
        told += [{"ladder": name, **one} for one in records(table)]
    return told
