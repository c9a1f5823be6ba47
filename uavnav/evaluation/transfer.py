"""The transfer matrix, `uavnav evaluate RUN RUN... --transfer`: trained in one task, evaluated in each."""

from __future__ import annotations

import hashlib
import operator
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from rich.table import Table

from uavnav import style
from uavnav.evaluation import check_bounds, summary
from uavnav.evaluation.across import Flyer, judged, save, with_interval
from uavnav.files import check_out
from uavnav.runs import Run
from uavnav.runs.metrics import PER_EPISODE
from uavnav.runs.tables import RunError, lock, records, write_table
from uavnav.tasks import layouts as splits
from uavnav.tasks.ladders import Measure, measure_of, reached
from uavnav.tasks.protocol import ACROSS_STEPS
from uavnav.tasks.table import EMPTY, make_task, name_of, unusual
from uavnav.tasks.wrapper import WrappedTask

EVALUATED_IN = "evaluated_in"  # the column that names the task of an episode
SPEEDS = ("speed_min", "speed_max")  # fields of a world by which sensed velocities are scaled


class Place(NamedTuple):
    """A task that a policy was trained in, on its test layouts."""

    name: str
    task: WrappedTask
    measure: Measure | None


def place(run: Run, episodes: int, max_steps: int | None) -> Place:
    """Where a run was trained: its task and faults, on the first test layouts that belong to its split.

    The time limit is 2,000 steps by default, or the task's own where that is lower.
    """
    task, layouts = trained_in(run)
    there = task.on(layouts, max_steps or task.limit(ACROSS_STEPS))
    return Place(named(task, layouts), there.replace(layouts=there.layouts[:episodes]), measure_of(layouts))


def trained_in(run: Run) -> tuple[WrappedTask, str]:
    """The task of a run's training, without obstacles, and the test layouts that belong to its split.

    Raises a RunError where its settings name no task.
    """
    own = run.config
    try:
        where = own["world"], own["reward"], None, own["task"]
        task = make_task(EMPTY, *where, faults=own.get("faults"))
    except (TypeError, ValueError) as error:
        raise RunError(
            f"{run.path / 'config.yaml'}: names no task ({error}); give a run of this package"
        ) from error
    return task, splits.judged_on(own["layouts"])


def named(task: WrappedTask, layouts: str) -> str:
    """A task in words: its name or the rung of its split, and what else is not as usual."""
    name = name_of(task)
    all_layouts = splits.name_of(layouts).removesuffix("-test")
    faults = [str(task.faults)] * (str(task.faults) != "none")
    reward = [f"reward={task.reward}"] * (task.reward != task.REWARD)
    first = name if all_layouts in splits.SPLITS else f"{name} {all_layouts}".removeprefix("drone ")
    return ", ".join([first, *unusual(task), *reward, *faults])


def visit(who: Flyer, place: Place, quiet: bool = True) -> pd.DataFrame:
    """Fly a policy's seeds in a place, greedy and sampled: a row an episode, with `mode` and `evaluated_in`.

    A policy keeps its own memory; its proximities stay shares of the reach of its training, and sensed
    velocities of that world's greatest speed.
    """
    own, task = who.task, place.task
    if own is not None:
        both = [name for name in SPEEDS if hasattr(own.world, name) and hasattr(task.world, name)]
        world = task.world.replace(**{name: getattr(own.world, name) for name in both})
        task = reached(task.replace(stack=own.stack, world=world), own.world.sensor_radius)
    return who.fly(task, f"in {place.name}", quiet, place.measure).assign(**{EVALUATED_IN: place.name})


@matplotlib.rc_context(style.STYLE)
def draw(table: pd.DataFrame, trained: Mapping[str, str]) -> style.Drawn:
    """The reward of each policy, as in training, in each task: a heat map; trained: a name's own task."""
    mine = table[(table["mode"] != "greedy") & (table["measure"] == "reward")]
    names, tasks = ([*dict.fromkeys(mine[column])] for column in ("name", EVALUATED_IN))
    found = mine.set_index(["name", EVALUATED_IN])
    values = np.array(
        [[found.loc[(name, task), "value"] for task in tasks] for name in names], dtype=np.float64
    )
    figure = Figure(figsize=(style.WIDTH, 2.6 + 0.75 * len(names)), layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(values, cmap="cividis", aspect="auto")
    for (row, column), value in np.ndenumerate(values):
        one = found.loc[(names[row], tasks[column])]
        dark = np.array(image.to_rgba(np.array([value]))[0, :3]) @ np.array([0.3, 0.6, 0.1]) < 0.5
        look: dict[str, Any] = {"color": "white" if dark else style.INK, "size": 10}
        number = with_interval(one["value"], one["low"], one["high"], "\n", ", ")
        axes.text(column, row, number, ha="center", va="center", **look)
        if trained.get(names[row]) == tasks[column]:
            axes.add_patch(
                Rectangle((column - 0.47, row - 0.46), 0.94, 0.92, fill=False, color=style.OPEN, linewidth=2)
            )
    axes.set_xticks(range(len(tasks)), tasks, rotation=20, ha="right", rotation_mode="anchor")
    style.name_rows(axes, [f"{name} (of {trained[name]})" if trained.get(name) else name for name in names])
    axes.set(title="Reward per episode, framed: the task of training", xlabel="evaluated in")
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    figure.colorbar(image, ax=axes, label="reward per episode", fraction=0.05)
    told = "; ".join(
        f"{name} in {task} {style.number(values[row, column])}"
        for row, name in enumerate(names)
        for column, task in enumerate(tasks)
    )
    return style.Drawn(figure, f"Reward per episode: {told}.")


def shown(table: pd.DataFrame, trained: Mapping[str, str]) -> Table:
    """The matrix as a table: a row a policy, mode and measure, a column a task."""
    text = Table(
        title="Trained in, evaluated in: means and 95 % intervals over seeds", title_justify="left", box=None
    )
    tasks = [*dict.fromkeys(table[EVALUATED_IN])]
    for column in ("who", "trained in", "", "measure", *tasks):
        text.add_column(column, justify="right" if column in tasks else "left")
    kept = table[table["measure"].isin(PER_EPISODE)]
    for (who, mode, measure), own in kept.groupby(["name", "mode", "measure"], sort=False):
        ends = own[["value", "low", "high"]].to_numpy()
        numbers = [with_interval(value, low, high, comma=", ") for value, low, high in ends]
        text.add_row(str(who), trained.get(str(who), ""), str(mode), PER_EPISODE[str(measure)], *numbers)
    return text


def transfer(
    flyers: Sequence[Flyer],
    episodes: int,
    max_steps: int | None,
    out: Path | None,
    quiet: bool,
    say: Callable[[str], object] = print,
) -> list[dict[str, Any]]:
    """Evaluate all that is named in every task of training; rows and a figure go to `out` or a run's folder.

    max_steps: as of `place`; say: is told who is left out because it sees or does something else.

    Returns:
        What the table shows, for JSON.

    Raises:
        LayoutError, PolicyError, RunError: a file cannot be read or written.
        ValueError: a count below 1, or more layouts than a layout file has.
    """
    check_bounds(episodes, ACROSS_STEPS if max_steps is None else max_steps, splits.SPLITS["test"].n)
    first = next((who.task for who in flyers if who.run is not None), None)
    if first is None:
        given = " ".join(who.name for who in flyers)
        raise RunError(f"--transfer {given}: names no run; give the folders of runs of several tasks")
    sizes = operator.attrgetter("observation_size", "n_turns", "n_distances")
    fit = [who for who in flyers if who.task is None or sizes(who.task.world) == sizes(first.world)]
    if left_out := [who.name for who in flyers if who not in fit]:
        size, actions = first.world.observation_size, first.world.n_actions
        lack = f"for they have not {size} numbers to see and these {actions} actions"
        say(f"left out, {lack}: {', '.join(left_out)}")
    homes = {who.name: place(who.run, episodes, max_steps) for who in fit if who.run is not None}
    places = {home.name: home for home in homes.values()}
    folder = out or next(who.run.path for who in flyers if who.run is not None)
    names = "\n".join(who.name for who in flyers)
    limit = max(one.task.max_steps or 0 for one in places.values())
    unique = hashlib.sha256(names.encode()).hexdigest()[:6]  # others may have a matrix there
    path = folder / f"transfer-{episodes}-{limit}-{unique}.parquet"
    check_out(path)
    rows = {}
    for who in fit:
        visits = [visit(who, one, quiet) for one in places.values()]
        rows[who.name] = pd.concat(visits, ignore_index=True)
    trained = {who.name: homes[who.name].name if who.name in homes else "" for who in fit}
    table = judged(rows, by=EVALUATED_IN)
    kept = [one.assign(policy=name, trained_in=trained[name]) for name, one in rows.items()]
    kept_rows = pd.concat(kept, ignore_index=True)
    kept_rows.attrs = {"episodes": episodes, "max_steps": limit}
    folder.mkdir(parents=True, exist_ok=True)
    with lock(folder):
        write_table(path, kept_rows)
        figure = save(draw(table, trained), path)
    if not quiet:
        summary.show(shown(table, trained))
        print(f"the rows are in {path}\nthe figure is {figure}", flush=True)
    return [{"trained_in": trained[one["name"]], **one} for one in records(table)]
