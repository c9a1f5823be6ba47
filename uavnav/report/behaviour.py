"""What episodes look like, as numbers for each training seed (claims 9 and 10); nothing here trains.

A table of behaviour has a row a step and the columns mode and `COLUMNS`; an episode is the steps of one mode,
seed and layout. Files contain only its actions (`uavnav.evaluation.BEHAVIOUR_COLUMNS`). Letters: P poses, K
obstacles of a layout, M = K + 4 bodies (they and the four walls), L layouts, F episodes of all seeds
together, T steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from uavnav.evaluation import BEHAVIOUR_COLUMNS, EMPTY_ARENA, HEADINGS, episodes
from uavnav.report.frames import MEASURES
from uavnav.runs import ARENA, Run
from uavnav.runs.metrics import MODES
from uavnav.runs.tables import RunError, read_table
from uavnav.stats import Array, Flags
from uavnav.tasks.dynamics import decode, direction
from uavnav.tasks.sensing import clearance
from uavnav.tasks.table import make_task
from uavnav.tasks.world import World
from uavnav.tasks.wrapper import WrappedTask

COLUMNS = BEHAVIOUR_COLUMNS | {
    "step": "int64",  # counted from 1
    "x": "float32",  # [px], after the step
    "y": "float32",  # [px]
    "heading": "int16",  # [degrees]
    "clearance": "float32",  # [px] to the nearest obstacle or border square
}
EPISODE = ["mode", "seed", "layout"]
OPPOSITE = -0.5
"""Cosine of 120 degrees: two directions at least so far apart are on opposite sides of the drone."""
CHUNK = 8192
"""Poses at a time: their pairs of bodies stay in a processor's cache."""
BEFORE_CRASH = 40
"""So many steps before a crash say how an episode ended, and not where the policy flies."""
FIRST = 50
"""So many steps at the start of episodes are alike in length, whoever crashes sooner."""
PLACES = ("corridor", "clearance")
"""Measures of where a drone is, which are also taken without the steps before a crash, and by layout."""
AGAIN = "evaluate the run again"
ONLY = "only those of drones on test layouts are measured"


def read(run: Run, in_arena: bool = False, modes: Sequence[str] = MODES) -> pd.DataFrame | None:
    """The watched steps of a run, or those in the empty arena, with their poses; None without such a file.

    modes: those of `metrics.MODES` that are wanted.

    Raises:
        RunError: the file is damaged, or its episodes are not those of drones on test layouts.
    """
    path = run.path / ARENA if in_arena else run.behaviour_file()
    if not path.exists():
        return None
    if (kind := run.config["task"]) != "drone":  # whose `World` has other fields
        raise RunError(f"{path}: episodes of task={kind}; {ONLY}")
    try:
        task = make_task("test", run.config["world"])
    except (TypeError, ValueError) as error:
        raise RunError(f"{run.path / 'config.yaml'}: {error}; not a run of this package") from error
    task = task.replace(layouts=EMPTY_ARENA) if in_arena else task
    heading = torch.tensor(HEADINGS) if in_arena else episodes.headings(task, len(task.layouts))
    table = _actions(run, path, task)
    return retrace(table[table["mode"].isin(modes)], task.layouts, heading, task.world)


def _actions(run: Run, path: Path, task: WrappedTask) -> pd.DataFrame:
    """What a run's file says of its episodes, if they are a drone's on test layouts; else a RunError."""
    table = read_table(path, BEHAVIOUR_COLUMNS | {"mode": "object"}, AGAIN)
    if (split := table.attrs.get("layouts", "test")) != "test":
        raise RunError(f"{path}: episodes on layouts={split}; {ONLY}")
    for column, right in {
        "seed": table["seed"].isin(run.seeds),
        "mode": table["mode"].isin(MODES),
        "layout": table["layout"].between(0, len(task.layouts) - 1),
        "action": table["action"].between(0, task.world.n_actions - 1),
    }.items():
        if not right.all():
            raise RunError(f"{path}: has {column}={table[column][~right].iloc[0]!s}; {AGAIN}")
    return table


def retrace(table: pd.DataFrame, layouts: Tensor, heading: Tensor, world: World) -> pd.DataFrame:
    """Where the actions of episodes led: the columns `COLUMNS` and mode, rows as they were.

    x, y are the simulator's sums in float32, bit for bit; its clearance may round otherwise.

    table: mode, seed, layout, action, in the order of steps; layouts [L, K, 3] px, heading [L] whole degrees.
    """
    episodes_of = table.groupby(EPISODE, sort=False)
    episode, step = episodes_of.ngroup().to_numpy(), episodes_of.cumcount().to_numpy() + 1
    layout = _tensor(table["layout"], torch.int64)

    def path(start: Tensor, moved: Tensor) -> Tensor:
        """Running sums [P] within each episode, in the type of moved [P], from start [P] or one for all."""
        sums = np.zeros((episode.max(initial=-1) + 1, step.max(initial=0) + 1), moved.numpy().dtype)
        sums[episode, 0], sums[episode, step] = start.numpy(), moved.numpy()
        return torch.from_numpy(sums.cumsum(1, dtype=sums.dtype)[episode, step])

    angle, distance = decode(_tensor(table["action"], torch.int64), world)
    turned = path(heading[layout], angle) % 360
    ways = zip(world.start, direction(turned), strict=True)
    x, y = (path(torch.tensor(start), distance * way) for start, way in ways)
    parts = (slice(first, first + CHUNK) for first in range(0, len(x), CHUNK))
    near = [clearance(x[part], y[part], layouts[layout[part]], world).numpy() for part in parts]
    poses = {
        "x": x.numpy(),
        "y": y.numpy(),
        "heading": turned.numpy(),
        "clearance": np.concatenate([[], *near]),
    }
    return table[[*BEHAVIOUR_COLUMNS, "mode"]].assign(step=step, **poses).astype(COLUMNS)


def measures(table: pd.DataFrame, layouts: Tensor, world: World) -> pd.DataFrame:
    """One row for each mode and seed: columns mode, seed and `MEASURES`, all of them means over steps.

    A seed's steps weigh alike, whichever episode they are of.

    - clearance: distance [px] from the drone's centre to the nearest body, as the simulator measured it.
    - corridor: share of steps between two close bodies. Of the circles of the layout and the four walls (each
      one body, the whole strip of its border squares), two have their nearest points within the sensor's
      radius (120 px) of the drone's centre, in directions at least 120 degrees apart. The heading plays no
      part: it is a property of a place. Two walls of a corner are 90 degrees apart, and make none.
    - corridor_path: share of the path in such places: a drone that stands between two bodies
      steers through nothing. NaN for a seed that never moves.
    - reversals: turn-sign reversals a step. A step with angle != 0 is one if the last such step before it in
      the same episode, however long ago, turned the other way: straight steps in between are skipped.
    - straight_speed, turning_speed: distance [px] of the steps with angle = 0, and of those with angle != 0;
      NaN where there is none.

    table: any number of rows; layouts [L, K, 3] px with the layouts that `layout` counts; K may be 0.
    """
    return of_seeds(of_steps(table, layouts, world))


def of_steps(table: pd.DataFrame, layouts: Tensor, world: World) -> pd.DataFrame:
    """What `measures` are means of: columns mode, seed, layout, the sums of each measure, `late` and `first`.

    late: one of the last `BEFORE_CRASH` steps before a collision; first: one of the first `FIRST` steps.
    """
    table = table.sort_values([*EPISODE, "step"], ignore_index=True)
    angle, distance = (part.numpy() for part in decode(_tensor(table["action"], torch.int64), world))
    corridor = corridors(table, layouts, world)
    ends = table.groupby(EPISODE)[["step", "clearance"]].transform("last")
    crashed = ends["clearance"] <= world.drone_radius
    steps = table[EPISODE].assign(
        clearance=table["clearance"].astype("float64"),
        corridor=corridor,
        corridor_path=corridor * distance,
        distance=distance,
        reversals=_reversals(table, np.sign(angle)),
        straight_speed=np.where(angle == 0, distance, np.nan),
        turning_speed=np.where(angle != 0, distance, np.nan),
        late=crashed & (ends["step"] - table["step"] < BEFORE_CRASH),
        first=table["step"] <= FIRST,
    )
    return steps.astype(dict.fromkeys(MEASURES, "float64"))


def of_seeds(steps: pd.DataFrame) -> pd.DataFrame:
    """`measures` of what `of_steps` gives."""
    means = steps.groupby(["mode", "seed"])[[*MEASURES, "distance"]].mean()
    means["corridor_path"] /= means.pop("distance").replace(0, np.nan)
    return means.reset_index()


def early(steps: pd.DataFrame) -> pd.DataFrame:
    """Measures of `PLACES` by mode and seed, of first steps and without late ones (`corridor_early`).

    A seed whose episodes all crash within `BEFORE_CRASH` steps has no early ones.
    """
    found = {
        kind: steps[chosen].groupby(["mode", "seed"])[[*PLACES]].mean().add_suffix(f"_{kind}")
        for kind, chosen in {"first": steps["first"], "early": ~steps["late"]}.items()
    }
    return found["first"].join(found["early"])


def by_layout(steps: pd.DataFrame) -> pd.DataFrame:
    """Measures of `PLACES` on each layout, mean over seeds: mode, layout, `corridor_by_layout` and so on."""
    of_episodes = steps.groupby(EPISODE)[[*PLACES]].mean()
    return of_episodes.groupby(["mode", "layout"]).mean().add_suffix("_by_layout").reset_index()


def corridors(table: pd.DataFrame, layouts: Tensor, world: World) -> Flags:
    """Whether each step is in a corridor (see `measures`): [P]; in float64, so that mirror images agree."""
    x, y = (_tensor(table[name], torch.float64) for name in ("x", "y"))
    layout = _tensor(table["layout"], torch.int64)
    found = torch.zeros(len(x), dtype=torch.bool)
    for first in range(0, len(x), CHUNK):
        part = slice(first, first + CHUNK)
        distance, toward_x, toward_y = _bodies(x[part], y[part], layouts[layout[part]].double(), world)
        near = distance <= world.sensor_radius
        toward_x, toward_y = toward_x * near, toward_y * near  # what is far has no direction, no opposite
        for body in range(1, len(distance)):  # each pair once
            cosine = toward_x[body] * toward_x[:body] + toward_y[body] * toward_y[:body]
            found[part] |= cosine.amin(0) <= OPPOSITE
    return found.numpy()


def _bodies(x: Tensor, y: Tensor, circles: Tensor, world: World) -> tuple[Tensor, Tensor, Tensor]:
    """Distance [px] to the nearest point of every body, and the unit vector towards it; the walls come last.

    x, y [P] px, circles [P, K, 3] px -> distance, toward x, toward y, each [M, P].
    """
    dx, dy = circles[..., 0].T - x, circles[..., 1].T - y
    length = torch.sqrt(dx * dx + dy * dy)
    scale = 1 / length.clamp_min(1e-9)  # a centre that coincides has no direction
    left, right = x - world.border, world.width - world.border - x
    below, above = y - world.border, world.height - world.border - y
    distance = torch.cat([length - circles[..., 2].T, torch.stack([left, right, below, above])])
    # directions to the four walls
    toward_x, toward_y = x.new_tensor([[-1, 1, 0, 0], [0, 0, -1, 1]])[..., None].expand(2, 4, len(x))
    return distance, torch.cat([dx * scale, toward_x]), torch.cat([dy * scale, toward_y])


def _reversals(table: pd.DataFrame, sign: Array) -> pd.Series[bool]:
    """Which steps turn the other way than the last turn, a row each of the table.

    table: in the order of episodes and steps; sign [P] of the turn: -1, 0 or 1.
    """
    turning = table[EPISODE].assign(sign=sign)[sign != 0]
    before = turning.groupby(EPISODE)["sign"].shift()  # NaN at an episode's first turn, which is no reversal
    found: pd.Series[bool] = before == -turning["sign"]
    return found.reindex(table.index, fill_value=False)


def heat(table: pd.DataFrame, world: World, square: int = 20) -> Array:
    """Share of steps in each square: [rows from bottom to top, columns from left to right], summing to 1.

    Every seed weighs the same. square: its side [px]; the window's edge cuts the last row and column.
    """
    edges = [np.arange(0, side + square, square) for side in (world.height, world.width)]
    counts = [np.histogram2d(seed["y"], seed["x"], edges)[0] for _, seed in table.groupby("seed")]
    none = np.zeros([len(axis) - 1 for axis in edges])
    return np.asarray(sum((one / one.sum() for one in counts), none) / max(len(counts), 1))


def _tensor(column: pd.Series[Any], dtype: torch.dtype) -> Tensor:
    return torch.from_numpy(column.to_numpy().copy()).to(dtype)
