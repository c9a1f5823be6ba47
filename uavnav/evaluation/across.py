"""Evaluate policies across ladders: reward, collisions and survival against difficulty.

`uavnav evaluate RUN... --across density slalom` draws one figure a ladder.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.markup import escape
from rich.table import Table

from uavnav import stats, style
from uavnav.colours import PILOTS, colours
from uavnav.evaluation import check_bounds, fitted, fly_modes, rows_across, summary
from uavnav.evaluation.scripted import task_of
from uavnav.files import check_out, write
from uavnav.runs import Run, metrics
from uavnav.runs.lately import span
from uavnav.runs.policies import Policy, by_mode, is_zip, load_policies, load_policy
from uavnav.runs.tables import RunError, lock, records, write_table
from uavnav.tasks.baselines import BASELINES, AnyPolicy, chosen_among
from uavnav.tasks.ladders import LADDERS, Ladder, Measure
from uavnav.tasks.protocol import ACROSS_STEPS, SPLITS, USUAL
from uavnav.tasks.table import EMPTY, make_task
from uavnav.tasks.wrapper import WrappedTask
from uavnav.training import display, machine

SKETCH = 20  # episodes a rung below which an interval over episodes says little
RESAMPLES = 500


class Flyer(NamedTuple):
    """A run, a zip or a scripted policy: its policies by mode and seed."""

    name: str
    modes: Mapping[str, Mapping[int, AnyPolicy]]
    run: Run | None = None
    shield: bool = False  # whether all fly under the shield

    @property
    def _first(self) -> AnyPolicy:
        return next(iter(next(iter(self.modes.values())).values()))

    @property
    def task(self) -> WrappedTask | None:
        """What it was trained in, the same for all of its policies; None of a scripted policy."""
        return self._first.task if isinstance(self._first, Policy) else None

    @property
    def kind(self) -> str:
        """Its algorithm, or the name of a scripted policy: by this it has its colour."""
        return self._first.algorithm if isinstance(self._first, Policy) else self.name

    def as_trained(self) -> Flyer:
        """The same without its greedy policies."""
        return self._replace(modes={mode: own for mode, own in self.modes.items() if mode != "greedy"})

    def fly(
        self, task: WrappedTask, where: str, quiet: bool, measure: Measure | None, measures: bool = False
    ) -> pd.DataFrame:
        """A row an episode in a task, with its mode.

        where: the task's name for a bar; measures: as of `fly_modes`.
        """
        modes = {
            mode: {seed: fitted(policy, task, self.shield) for seed, policy in population.items()}
            for mode, population in self.modes.items()
        }
        n = len(task.layouts) * sum(map(len, modes.values()))
        bar = display.episodes(f"{self.name}, {where}", n, task.max_steps or 0, quiet)
        with machine.use_threads(1), bar as tell:
            return fly_modes(modes, task, tell, measure, measures=measures).episodes


def of_policy(name: str, activation: str | None = None, seeds: int = 1) -> Flyer:
    """A scripted policy with some seeds, a zip, a policy file, or a policy that ships."""
    if name in BASELINES:
        return Flyer(name, {"scripted": dict.fromkeys(range(seeds), BASELINES[name])})
    if is_zip(name):
        return Flyer(name, by_mode({0: load_policy(name, activation=activation)}))
    return Flyer(name, by_mode(load_policies(name)))


def of_run(name: str, run: Run) -> Flyer:
    return Flyer(name, by_mode(load_policies(run.path, run.seeds)), run)


def climb(
    who: Flyer,
    ladder: Ladder,
    episodes: int,
    max_steps: int = ACROSS_STEPS,
    quiet: bool = True,
    scripted: WrappedTask | None = None,
    tell: Callable[[float], object] = lambda seconds: None,
) -> pd.DataFrame:
    """Fly every rung of a ladder on its first test layouts: `metrics.EPISODE_COLUMNS`, `mode` and `rung`.

    scripted: the task of a scripted policy; by default the paper's; tell: is told the first rung's seconds.
    """
    own = who.task or scripted or make_task(EMPTY)
    parts: list[pd.DataFrame] = []
    start = time.monotonic()
    for rung in ladder.rungs:
        task = ladder.task(own.replace(max_steps=max_steps), rung, "test")
        task = task.replace(layouts=task.layouts[:episodes])
        rows = who.fly(task, f"{ladder.words} {rung:g}", quiet, ladder.measure)
        parts.append(rows.assign(rung=float(rung)))
        if len(parts) == 1:
            tell(time.monotonic() - start)
    return pd.concat(parts, ignore_index=True)


def judged(rows: Mapping[str, pd.DataFrame], by: str = "rung", of_one_seed: bool = False) -> pd.DataFrame:
    """Means and 95 % intervals, a row a name, mode, rung and measure; rows: of `climb`, by name.

    An interval is over n seeds. One seed has none; with `of_one_seed`, its interval is over its n episodes.
    The column `over` says which. by: the column that tells where an episode was.
    """
    found = []
    for name, table in rows.items():
        for (mode, rung), own in table.groupby(["mode", by], sort=False):
            seeds = metrics.of_episodes(own)
            ends = over_episodes(own) if of_one_seed and len(seeds) == 1 else None
            for measure, values in seeds.items():
                one = stats.interval(values.dropna().to_numpy())
                if ends is not None:
                    one = one._replace(low=ends[measure].iloc[0], high=ends[measure].iloc[1], n=len(own))
                over = "seeds" if ends is None else "episodes"
                found.append([name, mode, rung, measure, one.n, one.value, one.low, one.high, over])
    columns = ["name", "mode", by, "measure", "n", "value", "low", "high", "over"]
    return pd.DataFrame(found, columns=columns)


def over_episodes(rows: pd.DataFrame) -> pd.DataFrame:
    """Both ends of each measure's interval over episodes of one seed: two rows, a column a measure."""
    drawn = np.random.default_rng(0).integers(len(rows), size=(RESAMPLES, len(rows)))
    resampled = rows.iloc[drawn.ravel()].assign(seed=np.arange(RESAMPLES).repeat(len(rows)))
    return metrics.of_episodes(resampled).quantile(stats.TAILS)


def in_brief(table: pd.DataFrame) -> str:
    """What the intervals of `judged` are over, in words; few episodes are a sketch."""
    said = []
    for over, of_kind in table.groupby("over", sort=False):
        numbers = sorted(of_kind["n"].unique())
        few = ", a sketch" if over == "episodes" and numbers[0] < SKETCH else ""
        said.append(f"{' to '.join(f'{n:,}' for n in dict.fromkeys([numbers[0], numbers[-1]]))} {over}{few}")
    return f"95 % intervals over {', or of one seed over '.join(said)}"


@matplotlib.rc_context(style.STYLE)
def draw(
    table: pd.DataFrame, ladder: Ladder, kinds: Mapping[str, str], width: float = style.WIDTH
) -> style.Drawn:
    """Each measure against difficulty, a line and a band a policy; kinds: by name, for colours."""
    mine = table[table["mode"] != "greedy"]
    measures = [*dict.fromkeys(mine["measure"])]
    figure = Figure(figsize=(width, 1 + 2.5 * len(measures)), layout="constrained")
    panels = figure.subplots(len(measures), 1, sharex=True)
    names = list(dict.fromkeys(mine["name"]))
    learned = [name for name in names if name not in USUAL]
    colour_of = PILOTS | dict(zip(learned, colours(kinds[name] for name in learned), strict=True))
    lines = dict(zip(USUAL, (":", "-.", "--"), strict=True))
    for axes, measure in zip(panels, measures, strict=True):
        for name, own in mine[mine["measure"] == measure].groupby("name", sort=False):
            colour, line = colour_of[str(name)], lines.get(str(name), "-")
            axes.plot(own["rung"], own["value"], line, color=colour, marker="o", label=str(name))
            axes.fill_between(own["rung"], own["low"], own["high"], color=colour, alpha=0.15, linewidth=0)
        style.keep_lines_legible(axes)
        axes.set_title(in_words(measure))
    below = [in_brief(mine)] if "over" in mine else []
    panels[-1].set_xlabel("\n".join([ladder.words, *below]))
    panels[-1].set_xticks(sorted(ladder.rungs))
    style.legend(figure, panels[0].get_legend_handles_labels()[0])
    first, last = ladder.rungs[0], ladder.rungs[-1]
    rewards = mine[(mine["measure"] == "reward") & mine["rung"].isin([first, last])]
    told = "; ".join(
        f"{name}: {' to '.join(style.number(value) for value in own['value'])}"
        for name, own in rewards.groupby("name", sort=False)
    )
    return style.Drawn(figure, f"Reward per episode from {first:g} to {last:g} of {ladder.words}: {told}.")


def shown(table: pd.DataFrame, name: str) -> Table:
    """A ladder as a table: a row a policy, mode and rung, a column a measure."""
    measures = list(dict.fromkeys(table["measure"]))
    title = f"{name}: {LADDERS[name].words}; {in_brief(table)}"
    text = Table(title=title, title_justify="left", box=None)
    text.add_column("who", overflow="fold", width=18)
    text.add_column("")
    text.add_column("rung", justify="right")
    for measure in measures:  # an interval is never cut
        ends = table.loc[table["measure"] == measure, ["value", "low", "high"]].to_numpy()
        least = max(len(word) for triple in ends for word in with_interval(*triple).split())
        text.add_column(in_words(measure), justify="right", min_width=least)
    for (who, mode), mine in table.groupby(["name", "mode"], sort=False):
        for at, (rung, own) in enumerate(mine.groupby("rung", sort=False)):
            values = own.set_index("measure")[["value", "low", "high"]].reindex(measures).to_numpy()
            cells = [escape(with_interval(*triple)) for triple in values]
            text.add_row(*([str(who), str(mode)] if not at else ["", ""]), f"{rung:g}", *cells)
    return text


def in_words(measure: str) -> str:
    """A measure with its unit."""
    return metrics.PER_EPISODE.get(measure) or metrics.OWN[measure].label


def with_interval(value: float, low: float, high: float, between: str = " ", comma: str = ",") -> str:
    """A number, and its interval in brackets if it has one."""
    number, *ends = (style.number(round(one, 9)) if np.isfinite(one) else "–" for one in (value, low, high))
    return f"{number}{between}[{comma.join(ends)}]" if np.isfinite(low) else number


def across(
    flyers: Sequence[Flyer],
    names: Sequence[str],
    episodes: int,
    max_steps: int | None,
    out: Path | None,
    quiet: bool,
    tell: Callable[[str], object] = print,
    task: str = "drone",
    alone: bool = False,
) -> list[dict[str, Any]]:
    """Fly all that is named, and the scripted policies, across ladders; keep rows and a figure.

    The time limit is 2,000 steps by default, or that of a policy's own task where it is lower. `tell` is told
    of limits that differ and of ladders that a task lacks. Scripted policies fly the task of the first
    policy's training, or `task`. Rows of a run are in its folder, figures in `out` or the first run's folder.
    `alone`: policies fly only as in training, without scripted ones and a figure.

    Returns:
        What the tables show, for JSON.

    Raises:
        LayoutError, PolicyError: a layout file or a policy cannot be read.
        RunError: a file cannot be written, or no ladder is left.
        ValueError: a count below 1, or more layouts than a layout file has.
    """
    if alone:
        flyers = [one.as_trained() for one in flyers]
    trained_in = next((one.task for one in flyers if one.task is not None), None)
    scripted = task_of(task) if trained_in is None else trained_in.replace(stack=1)
    check_bounds(episodes, ACROSS_STEPS if max_steps is None else max_steps, SPLITS["test"].n)
    folder = out or next((one.run.path for one in flyers if one.run is not None), Path())
    check_out(folder / "across.svg")
    tasks = {one.name: one.task or scripted for one in flyers}
    unfit = {name: [who for who, own in tasks.items() if not one.fits(own)] for name, one in LADDERS.items()}
    fit = ", ".join(name for name in LADDERS if not unfit[name])
    climbed = [name for name in names if not unfit[name]]
    if not climbed:
        raise RunError(f"--across {' '.join(names)}: no ladder of these tasks; give some of {fit}")
    for name in names:
        if name not in climbed:
            which = f"the ladder {name}, which the task of {', '.join(unfit[name])} does not have"
            tell(f"left out: {which}; {fit} fit")
    turns, distances = chosen_among(scripted.world)
    if not alone and (scripted.world.n_turns, scripted.world.n_distances) != (turns, distances):
        tell(f"left out: the scripted policies, which choose among {turns} turns and {distances} distances")
    elif not alone:
        beside = [name for name in USUAL if name not in tasks]
        flyers = [*flyers, *map(of_policy, beside)]
    limits = {one.name: max_steps or (one.task or scripted).limit(ACROSS_STEPS) for one in flyers}
    if len(set(limits.values())) > 1:
        each = ", ".join(f"{name} {limit:,}" for name, limit in limits.items())
        tell(f"time limits differ ({each}); --max-steps gives all the same")
    folder.mkdir(parents=True, exist_ok=True)
    if not quiet and episodes < SKETCH:
        tell(f"--episodes {episodes} is a sketch; give {SKETCH} or more for intervals to trust")
    counts = {one.name: episodes * sum(map(len, one.modes.values())) for one in flyers}
    rungs = sum(len(LADDERS[name].rungs) for name in climbed)

    def how_long(seconds: float) -> None:
        n = rungs * sum(counts.values())
        left = seconds * (n / counts[flyers[0].name] - 1)
        tell(f"about {span(left)} more, as the first rung took: {n:,} episodes on {rungs} rungs")

    told: list[dict[str, Any]] = []
    for name in climbed:
        rows: dict[str, pd.DataFrame] = {}
        for one in flyers:
            limit, first = limits[one.name], not (told or rows or quiet)
            ask = [how_long] if first else []
            rows[one.name] = climb(one, LADDERS[name], episodes, limit, quiet, scripted, *ask)
            if one.run is not None:
                rows[one.name].attrs = {"ladder": name, "episodes": episodes, "max_steps": limit}
                with lock(one.run.path):
                    write_table(one.run.path / rows_across(name, episodes, limit), rows[one.name])
        table = judged(rows, of_one_seed=True)
        if not quiet:
            summary.show(shown(table, name))
        if not alone:
            drawn = draw(table, LADDERS[name], {one.name: one.kind for one in flyers})
            path = save(drawn, folder / rows_across(name, episodes, max(limits.values())))
            if not quiet:
                print(f"the figure is {path}", flush=True)
        told += [{"ladder": name, **one} for one in records(table)]
    return told


def save(drawn: style.Drawn, rows: Path) -> Path:
    """Write a figure as SVG and PNG under the name of a file of rows; returns the PNG's path."""
    write(rows.with_suffix(".svg"), drawn.svg)
    write(rows.with_suffix(".png"), style.png(drawn.figure))
    return rows.with_suffix(".png")
