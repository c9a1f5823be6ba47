"""The transfer matrix: trained in one world, flown in another, among worlds whose observations have the same size.

`uavnav evaluate RUN RUN... --transfer` flies each policy on the test sets of each world that one of them was trained
in.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, replace
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
from uavnav.evaluation.across import Flyer, flyer, judged
from uavnav.files import check_out, write
from uavnav.runs import Run
from uavnav.runs.metrics import FLIGHTS
from uavnav.runs.policies import Policy
from uavnav.runs.tables import RunError, lock, records, write_table
from uavnav.tasks import layouts as banks
from uavnav.tasks.baselines import AnyPolicy
from uavnav.tasks.ladders import Measure, measure_of, reached
from uavnav.tasks.protocol import ACROSS_STEPS
from uavnav.tasks.simulator import EMPTY, Task, make_task, name_of

FLOWN = "flown_in"
"""The column that names the world of a flight."""
SPEEDS = ("speed_min", "speed_max")
"""Fields of a world by which sensed velocities are scaled."""


class Place(NamedTuple):
    """A world that somebody was trained in, on its test sets."""

    name: str
    task: Task
    measure: Measure | None


def place(run: Run, episodes: int, max_steps: int | None) -> Place:
    """Where a run was trained: its world and faults, on the first test sets that belong to its bank.

    The cap on steps is 2,000 if none is given, or the task's own where that is lower.

    Raises:
        LayoutError: there are no such sets.
        RunError: its settings name no world.
    """
    task, layouts = trained_in(run)
    flown = task.on(layouts, max_steps or task.cap(ACROSS_STEPS))
    return Place(named(task, layouts), flown.with_bank(flown.bank[:episodes]), measure_of(layouts))


def trained_in(run: Run) -> tuple[Task, str]:
    """The world and faults of a run's training, without obstacles, and the test sets that belong to its bank.

    Raises:
        RunError: its settings name no world.
    """
    own = run.config
    try:
        task = make_task(
            EMPTY, own.get("world"), own.get("reward"), None, own.get("task", "drone"), faults=own.get("faults")
        )
    except (TypeError, ValueError) as error:
        raise RunError(f"{run.path / 'config.yaml'}: names no world ({error}); give a run of this package") from error
    return task, banks.judged_on(own.get("layouts", "train"))


def named(task: Task, layouts: str) -> str:
    """A world in words: its task or the rung of its bank, and what else is not as usual."""
    name = name_of(task)
    bank = banks.name_of(layouts).removesuffix("-test")
    usual = asdict(type(task).WORLD())
    own = [f"{key}={value}" for key, value in asdict(task.world).items() if value != usual[key]]
    faults = [str(task.faults)] * (str(task.faults) != "none")
    reward = [f"reward={task.reward}"] * (task.reward != task.REWARD)
    first = name if bank in banks.SPLITS else bank if name == "drone" else f"{name} {bank}"
    return ", ".join([first, *own, *reward, *faults])


def sort(
    found: Mapping[str, Run | Mapping[str, AnyPolicy]], episodes: int, max_steps: int | None
) -> tuple[list[tuple[Flyer, str]], list[Place], list[str]]:
    """Who flies, each with the world that it was trained in; the worlds; and who is left out.

    A policy is left out if it does not see as many numbers of a moment as the first run's, or has other actions.

    Raises:
        RunError: no run is given.
    """
    flyers = {name: flyer(name, one) for name, one in found.items()}
    first = {name: one.first for name, one in flyers.items()}
    sizes = {name: _sizes(one) for name, one in first.items() if isinstance(one, Policy)}
    places: dict[str, Place] = {}
    trained: list[tuple[Flyer, str]] = []
    size = next((sizes[name] for name, one in found.items() if isinstance(one, Run)), None)
    if size is None:
        raise RunError(f"--transfer {' '.join(found)}: names no run; give the folders of runs of several worlds")
    for name, one in found.items():
        where = ""
        if sizes.get(name, size) != size:
            continue
        if isinstance(one, Run):
            own = place(one, episodes, max_steps)
            places.setdefault(own.name, own)
            where = own.name
        trained.append((flyers[name], where))
    return trained, [*places.values()], [name for name in found if sizes.get(name, size) != size]


def _sizes(policy: Policy) -> tuple[int, int, int]:
    """What worlds must have in common: numbers of an observation, turns and distances to choose from."""
    world = policy.world
    return world.observation_size, world.n_turns, world.n_distances


def visit(who: Flyer, place: Place, quiet: bool = True) -> pd.DataFrame:
    """Fly a policy's seeds in a world, greedy and sampled: a row an episode, with `mode` and `flown_in`.

    A policy keeps its own memory; its proximities stay shares of the reach of its training, and sensed velocities of
    that world's greatest speed.
    """
    first, task = who.first, place.task
    if isinstance(first, Policy):
        both = [name for name in SPEEDS if hasattr(first.world, name) and hasattr(task.world, name)]
        world = replace(task.world, **{name: getattr(first.world, name) for name in both})
        task = reached(replace(task, stack=first.task.stack, world=world), first.world.sensor_radius)
    rows = who.fly(task, f"in {place.name}", quiet, place.measure)
    parts = [part.assign(mode=mode, **{FLOWN: place.name}) for mode, part in rows.items()]
    return pd.concat(parts, ignore_index=True)


@matplotlib.rc_context(style.STYLE)
def draw(table: pd.DataFrame, trained: Mapping[str, str]) -> style.Drawn:
    """The reward of each policy, as it acts in training, in each world: a heat map with its numbers.

    table: of `judged`; trained: by name, the world of its training, which is framed.
    """
    mine = table[(table["mode"] != "greedy") & (table["measure"] == "reward")]
    names, worlds = ([*dict.fromkeys(mine[column])] for column in ("name", FLOWN))
    found = mine.set_index(["name", FLOWN])
    values = np.array([[found.loc[(name, world), "value"] for world in worlds] for name in names], dtype=np.float64)
    figure = Figure(figsize=(style.WIDTH, 2.6 + 0.75 * len(names)), layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(values, cmap="cividis", aspect="auto")
    for (row, column), value in np.ndenumerate(values):
        one = found.loc[(names[row], worlds[column])]
        dark = np.array(image.to_rgba(np.array([value]))[0, :3]) @ np.array([0.3, 0.6, 0.1]) < 0.5
        look: dict[str, Any] = {"color": "white" if dark else style.INK, "size": 10}
        axes.text(column, row, _in_brackets("\n", *one[["value", "low", "high"]]), ha="center", va="center", **look)
        if trained.get(names[row]) == worlds[column]:
            axes.add_patch(
                Rectangle((column - 0.47, row - 0.46), 0.94, 0.92, fill=False, color=style.OPEN, linewidth=2)
            )
    axes.set_xticks(range(len(worlds)), worlds, rotation=20, ha="right", rotation_mode="anchor")
    style.name_rows(axes, [f"{name} (of {trained[name]})" if trained.get(name) else name for name in names])
    axes.set(title="Reward per flight, framed: the world of training", xlabel="flown in")
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    figure.colorbar(image, ax=axes, label="reward per flight", fraction=0.05)
    told = "; ".join(
        f"{name} in {world} {style.number(values[row, column])}"
        for row, name in enumerate(names)
        for column, world in enumerate(worlds)
    )
    return style.Drawn(figure, f"Reward per flight: {told}.")


def _in_brackets(between: str, value: float, low: float, high: float) -> str:
    """A number, and its interval in brackets if it has one."""
    return style.number(value) + (f"{between}[{style.number(low)}, {style.number(high)}]" if np.isfinite(low) else "")


def shown(table: pd.DataFrame, trained: Mapping[str, str]) -> Table:
    """The matrix as a table: a row a policy, mode and measure, a column a world."""
    text = Table(title="Trained in, flown in: means and 95 % intervals over seeds", title_justify="left", box=None)
    worlds = [*dict.fromkeys(table[FLOWN])]
    for column in ("who", "trained in", "", "measure", *worlds):
        text.add_column(column, justify="right" if column in worlds else "left")
    kept = table[table["measure"].isin(FLIGHTS)]
    for (who, mode, measure), own in kept.groupby(["name", "mode", "measure"], sort=False):
        numbers = [_in_brackets(" ", *triple) for triple in own[["value", "low", "high"]].to_numpy().tolist()]
        text.add_row(str(who), trained.get(str(who), ""), str(mode), FLIGHTS[str(measure)], *numbers)
    return text


def transfer(
    found: Mapping[str, Run | Mapping[str, AnyPolicy]],
    episodes: int,
    max_steps: int | None,
    out: Path | None,
    quiet: bool,
    say: Any = print,
) -> list[dict[str, Any]]:
    """Fly all that is named in every world of their training; rows and a figure lie in `out` or the first run's folder.

    max_steps: as of `place`; files are named after the highest cap.
    say: is told, in one line, who is left out because it sees or does something else.

    Returns:
        What the table shows, for JSON.

    Raises:
        LayoutError, PolicyError, RunError: a bank or a policy cannot be read, or a file not be written.
        ValueError: a count below 1, or more sets than a bank has.
    """
    check_bounds(episodes, ACROSS_STEPS if max_steps is None else max_steps, banks.SPLITS["test"].n)
    flyers, places, left_out = sort(found, episodes, max_steps)
    if left_out:
        size, actions = places[0].task.world.observation_size, places[0].task.world.n_actions
        say(f"left out, for they have not {size} numbers to see and these {actions} actions: {', '.join(left_out)}")
    folder = out or next(who.folder for who, _ in flyers if who.folder is not None)
    names = hashlib.sha256("\n".join(map(str, found)).encode()).hexdigest()[:6]  # others may have a matrix there
    cap = max(one.task.max_steps or 0 for one in places)
    stem = f"transfer-{episodes}-{cap}-{names}"
    check_out(folder / f"{stem}.parquet")
    rows = {who.name: pd.concat([visit(who, one, quiet) for one in places], ignore_index=True) for who, _ in flyers}
    trained = {who.name: where for who, where in flyers}
    table = judged(rows, by=FLOWN)
    kept = pd.concat(
        [one.assign(policy=name, trained_in=trained[name]) for name, one in rows.items()], ignore_index=True
    )
    kept.attrs = {"episodes": episodes, "max_steps": cap}
    svg, png = style.save(draw(table, trained).figure)
    folder.mkdir(parents=True, exist_ok=True)
    with lock(folder):
        write_table(folder / f"{stem}.parquet", kept)
        write(folder / f"{stem}.svg", svg)
        write(folder / f"{stem}.png", png)
    if not quiet:
        summary.show(shown(table, trained))
        print(f"the rows are in {folder / f'{stem}.parquet'}\nthe figure is {folder / f'{stem}.png'}", flush=True)
    return [{"trained_in": trained[one["name"]], **one} for one in records(table)]
