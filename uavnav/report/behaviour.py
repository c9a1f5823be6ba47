"""What flights look like, as numbers for each training seed (claims 9 and 10); nothing here trains.

A table of behaviour has a row a step and the columns of `uavnav.evaluate.BEHAVIOUR_COLUMNS` and `mode`; a flight is the
steps of one mode, seed and layout. Letters: P poses, K obstacles of a layout, M = K + 4 bodies (they and the four
walls), F flights of all seeds together, T steps.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from uavnav import policies
from uavnav.evaluate import BEHAVIOUR_COLUMNS, MAX_STEPS
from uavnav.runs import BEHAVIOUR, Run
from uavnav.runs.metrics import MODES
from uavnav.runs.tables import RunError, read_table
from uavnav.tasks import layouts, simulator
from uavnav.tasks.dynamics import decode
from uavnav.tasks.simulator import UP, Outcome, State
from uavnav.tasks.world import World
from uavnav.training import machine

Array = np.ndarray[Any, np.dtype[np.float64]]
Flags = np.ndarray[Any, np.dtype[np.bool_]]

FLIGHT = ["mode", "seed", "layout"]
PLACES = ("clearance", "corridor", "corridor_flown", "border")
MEASURES = (*PLACES, "reversals", "trembling", "straight_speed", "turning_speed")
OPPOSITE = -0.5
"""Cosine of 120 degrees: two directions at least so far apart are on opposite sides of the drone."""
CHUNK = 8192
"""Poses at a time: their pairs of bodies stay in a processor's cache."""
AGAIN = "evaluate the run again"
HEADINGS = (0, 90, 180, 270)
"""Of the flights in the empty arena [degrees]."""
EMPTY_ARENA = torch.empty(len(HEADINGS), 0, 3)
"""The bank [4, 0, 3] that belongs to `empty_arena`: as many sets without an obstacle as it has flights a seed."""


def read(run: Run) -> pd.DataFrame | None:
    """The watched steps of a run's evaluation; None where there is no such file.

    Raises:
        RunError: the file is damaged, or is not a run's.
    """
    path = run.path / BEHAVIOUR
    if not path.exists():
        return None
    table = read_table(path, BEHAVIOUR_COLUMNS | {"mode": "object"}, AGAIN)
    world = World()
    for column, right in {
        "seed": table["seed"].isin(run.seeds),
        "mode": table["mode"].isin(MODES),
        "layout": table["layout"].between(0, layouts.SPLITS["test"].n - 1),
        "x": table["x"].between(0, world.width),
        "y": table["y"].between(0, world.height),
        "clearance": table["clearance"].between(0, world.width),
        "action": table["action"].between(0, world.n_actions - 1),
    }.items():
        if not right.all():
            raise RunError(f"{path}: has {column}={table[column][~right].iloc[0]!s}; {AGAIN}")
    return table


def measures(table: pd.DataFrame, bank: Tensor, world: World) -> pd.DataFrame:
    """One row for each mode and seed: columns mode, seed and `MEASURES`, all of them means over steps.

    A seed's steps weigh alike, whichever flight they are of: what is described is where and how it spends its time, of
    which a flight of 20 steps says less than one of 500.

    - clearance: distance [px] from the drone's centre to the nearest body, as the simulator measured it.
    - corridor: share of steps between two close bodies. Of the circles of the layout and the four walls (each one body,
      the whole strip of its border squares), two have their nearest points within the sensor's radius (120 px) of the
      drone's centre, in directions at least 120 degrees apart. The heading plays no part: it is a property of a place.
      Two walls of a corner are 90 degrees apart, and make none.
    - corridor_flown: share of the distance flown in such places: a drone that stands between two bodies steers through
      nothing. NaN for a seed that never moves.
    - reversals: turn-sign reversals a step. A step with angle != 0 is one if the last such step before it in the same
      flight, however long ago, turned the other way: straight steps in between are skipped.
    - trembling: the same, of two consecutive steps alone: a straight step in between breaks it off.
    - straight_speed, turning_speed: distance [px] of the steps with angle = 0, and of those with angle != 0; NaN where
      there is none.
    - border: share of steps whose nearest body is a wall (or as near as the nearest circle).

    table: any number of rows; bank [L, K, 3] px with the sets that `layout` counts; K may be 0.
    """
    table = table.sort_values([*FLIGHT, "step"], ignore_index=True)
    angle, distance = (part.numpy() for part in decode(_tensor(table["action"], torch.int64), world))
    corridor, border = surroundings(table, bank, world)
    reversals = _reversals(table, np.sign(angle))
    steps = table[["mode", "seed"]].assign(
        clearance=table["clearance"].astype("float64"),
        corridor=corridor,
        corridor_flown=corridor * distance,
        distance=distance,
        reversals=reversals["any"],
        trembling=reversals["consecutive"],
        straight_speed=np.where(angle == 0, distance, np.nan),
        turning_speed=np.where(angle != 0, distance, np.nan),
        border=border,
    )
    means = steps.astype(dict.fromkeys(MEASURES, "float64")).groupby(["mode", "seed"], as_index=False).mean()
    means["corridor_flown"] /= means.pop("distance").replace(0, np.nan)
    return means


def surroundings(table: pd.DataFrame, bank: Tensor, world: World) -> tuple[Flags, Flags]:
    """For each step of a table, whether it is in a corridor and whether a wall is nearest (see `measures`): two [P].

    In float64, so that a world and its mirror image differ in nothing.
    """
    x, y = (_tensor(table[name], torch.float64) for name in ("x", "y"))
    layout = _tensor(table["layout"], torch.int64)
    corridor, border = torch.zeros(len(x), dtype=torch.bool), torch.zeros(len(x), dtype=torch.bool)
    for first in range(0, len(x), CHUNK):
        part = slice(first, first + CHUNK)
        distance, toward_x, toward_y = _bodies(x[part], y[part], bank[layout[part]].double(), world)
        border[part] = distance[-4:].amin(0) <= distance.amin(0)
        near = distance <= world.sensor_radius
        toward_x, toward_y = toward_x * near, toward_y * near  # a body that is far has no direction, and no opposite
        cosine = toward_x[:, None] * toward_x + toward_y[:, None] * toward_y
        corridor[part] = cosine.amin((0, 1)) <= OPPOSITE
    return corridor.numpy(), border.numpy()


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
    walls = torch.tensor([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]], dtype=x.dtype)[..., None].expand(
        4, 2, len(x)
    )
    return distance, torch.cat([dx * scale, walls[:, 0]]), torch.cat([dy * scale, walls[:, 1]])


def _reversals(table: pd.DataFrame, sign: Array) -> pd.DataFrame:
    """Which steps turn the other way than the last turn: columns any, consecutive (bool), a row each of the table.

    table: in the order of flights and steps; sign [P] of the turn: -1, 0 or 1.
    """
    turning = table[[*FLIGHT, "step"]].assign(sign=sign)[sign != 0]
    before = turning.groupby(FLIGHT)[["sign", "step"]].shift()  # NaN at a flight's first turn, which is no reversal
    any_ = before["sign"] == -turning["sign"]
    found = pd.DataFrame({"any": any_, "consecutive": any_ & (before["step"] == turning["step"] - 1)})
    return found.reindex(table.index, fill_value=False)


def heat(table: pd.DataFrame, world: World, cell: int = 20) -> Array:
    """Share of steps in each square: [rows from bottom to top, columns from left to right], summing to 1.

    Every seed weighs the same, however long it flew; a table of several modes is not told apart. No rows: all zeros.
    cell: side of a square [px]; where it does not divide the window, the last row and column are cut by its edge.
    """
    rows, columns = -(-world.height // cell), -(-world.width // cell)
    row = (table["y"].to_numpy() // cell).clip(0, rows - 1).astype(np.int64)
    column = (table["x"].to_numpy() // cell).clip(0, columns - 1).astype(np.int64)
    seeds = table["seed"].to_numpy()
    shares = np.zeros((rows, columns))
    for seed in np.unique(seeds):
        own = seeds == seed
        counts = np.bincount(row[own] * columns + column[own], minlength=rows * columns)
        shares += counts.reshape(rows, columns) / own.sum()
    return shares / max(len(np.unique(seeds)), 1)


class Crew(NamedTuple):
    """All seeds of a run in one mode."""

    seeds: list[int]
    mode: str
    policies: list[policies.Policy]


def crew(run: Run, mode: str) -> Crew:
    """Load every seed of a run.

    Raises:
        PolicyError: the run's policy cannot be read.
        ValueError: there is no such mode.
    """
    if mode not in MODES:
        raise ValueError(f"mode={mode!r}; choose from {', '.join(MODES)}")
    loaded = [policies.load_policy(run.path, seed, greedy=mode == "greedy") for seed in run.seeds]
    return Crew(run.seeds, mode, loaded)


def empty_arena(crews: Sequence[Crew], steps: int = 500) -> list[pd.DataFrame]:
    """Fly where there is no obstacle, from the centre: four flights a seed, by start heading.

    Flight 0 starts at a heading of 0 degrees, 1 at 90, 2 at 180 and 3 at 270; each ends at a collision or after `steps`
    steps. A seed's flights depend on its policy and a generator of its own alone.

    Returns:
        For each crew a table of behaviour, whose `layout` is the flight: for `measures` with the bank `EMPTY_ARENA`.

    Raises:
        ValueError: steps is below 1.
    """
    tables: dict[int, pd.DataFrame] = {}
    rules = [(one.policies[0].world, one.policies[0].reward) for one in crews]
    for own in dict.fromkeys(rules):  # those of one world and reward fly as one batch
        places = [place for place, one in enumerate(rules) if one == own]
        together = [crews[place] for place in places]
        number = torch.arange(len(together)).repeat_interleave(torch.tensor([len(one.seeds) for one in together]))
        number = number.repeat_interleave(len(HEADINGS))
        seed = torch.tensor([seed for one in together for seed in one.seeds]).repeat_interleave(len(HEADINGS))
        parts: list[dict[str, Tensor]] = []
        for one in _fly(together, EMPTY_ARENA, torch.tensor(HEADINGS), steps):
            fields = {name: getattr(one.state, name) for name in ("layout", "x", "y", "heading")}
            counted = {"step": one.state.steps, "clearance": one.outcome.clearance, "action": one.action}
            parts.append({"crew": number[one.flight], "seed": seed[one.flight], **fields, **counted})
        columns = {name: torch.cat([part[name] for part in parts]).numpy() for name in ("crew", *BEHAVIOUR_COLUMNS)}
        for which, table in pd.DataFrame(columns).groupby("crew"):
            rows = table.drop(columns="crew").astype(BEHAVIOUR_COLUMNS).assign(mode=together[int(str(which))].mode)
            tables[places[int(str(which))]] = rows.sort_values([*FLIGHT, "step"], ignore_index=True)
    return [tables[place] for place in range(len(crews))]


def overestimation(run: Run, steps: int = 300, n_layouts: int = 20, tail: float = 0.01) -> pd.DataFrame:
    """How much more a DQN's seeds expect than they get: columns seed, q, realised, overestimation = q - realised.

    q is the mean of max_a Q(s, a) over the states of greedy flights, one on each of the first test layouts, and
    realised the mean of the discounted return from the same states on, under the discount that the run was trained
    with. States are those of the first `steps` steps of a flight, collision or not; the flight goes on until the rest
    of its return is worth less than `tail` of what it would be now (gamma^n < tail, 459 steps at 0.99), so that no
    state is left out for lack of a future. Where that takes more than `evaluate.MAX_STEPS` steps in all (gamma near 1),
    only states with so much future, or with a collision ahead, count: NaN where there is none.

    All flights start upwards, whatever the start heading in training.

    Raises:
        LayoutError, PolicyError: the test bank or the run's policy cannot be read.
        RunError: the run's gamma is missing or no discount.
        ValueError: the run is not of DQN, or there are not so many layouts or steps.
    """
    if run.algorithm != "dqn":
        raise ValueError(f"{run.path}: its algorithm is {run.algorithm}; only dqn has values of actions")
    gamma = run.config.get("gamma")
    if not isinstance(gamma, (int, float)) or not 0 <= gamma <= 1:
        raise RunError(f"{run.path / 'config.yaml'}: its gamma={gamma} is no discount; give a run's folder")
    bank = layouts.load("test")
    if not 1 <= n_layouts <= len(bank) or steps < 1:
        raise ValueError(f"n_layouts={n_layouts}, steps={steps}; give 1 to {len(bank)} layouts and at least 1 step")
    horizon = next((n for n in range(1, MAX_STEPS + 1) if gamma**n < tail), MAX_STEPS + 1)
    heading = torch.full((n_layouts,), UP)
    n_flights = len(run.seeds) * n_layouts
    limit = min(steps + horizon, MAX_STEPS)
    q, returned = (torch.zeros(limit, n_flights, dtype=torch.float64) for _ in range(2))
    flown = torch.zeros(limit, n_flights, dtype=torch.bool)
    collided = torch.zeros(n_flights, dtype=torch.bool)
    for step, one in enumerate(_fly([crew(run, "greedy")], bank[:n_layouts], heading, limit)):
        q[step, one.flight] = one.values.amax(-1).double()
        returned[step, one.flight] = one.outcome.reward
        flown[step, one.flight] = True
        collided[one.flight] = one.outcome.terminated
    for step in reversed(range(limit - 1)):
        returned[step] += gamma * returned[step + 1]
    known = collided | (torch.arange(limit)[:, None] + horizon <= limit)
    counts = (flown & known)[:steps].reshape(-1, len(run.seeds), n_layouts)
    result = {"seed": run.seeds}
    for name, values in {"q": q, "realised": returned}.items():
        summed = (values[:steps].reshape(counts.shape) * counts).sum((0, 2))
        result[name] = (summed / counts.sum((0, 2))).tolist()  # 0 / 0 is NaN
    table = pd.DataFrame(result)
    return table.assign(overestimation=table["q"] - table["realised"])


class _Step(NamedTuple):
    """One step of the flights that are still up: every field has a row for each."""

    flight: Tensor  # its index: first all flights of the first seed
    values: Tensor  # [F, 100] what the network said of each action
    action: Tensor
    state: State  # after it
    outcome: Outcome


def _fly(crews: Sequence[Crew], bank: Tensor, heading: Tensor, steps: int) -> Iterator[_Step]:
    """Fly every seed of some crews on every set of a bank, in the world and by the reward that they were trained with.

    bank [L, K, 3] px, heading [L] whole degrees. A flight ends at a collision or after so many steps. A seed's flights
    depend on its policy and a generator of its own alone.

    Raises:
        ValueError: steps is below 1.
    """
    own = crews[0].policies[0]
    simulator.check_rules(own.reward, steps)
    stacked, sizes = [_stacked(one.policies) for one in crews], [len(one.seeds) for one in crews]
    flyers = [policy for one in crews for policy in one.policies]
    generators = [torch.Generator().manual_seed(seed) for one in crews for seed in one.seeds]
    layout = torch.arange(len(bank)).repeat(len(flyers))
    state = simulator.start(layout, heading[layout], own.world)
    up = torch.ones(len(layout), dtype=torch.bool)
    with machine.use_threads(1), torch.no_grad():
        observation, _ = simulator.observe(state, bank, own.world)
        while up.any():  # flights that have ended are flown on, and not told of
            seen = torch.split(observation.reshape(len(flyers), len(bank), -1), sizes)
            parts = [
                torch.func.functional_call(one.policies[0].network, weights, (part,))
                for one, weights, part in zip(crews, stacked, seen, strict=True)
            ]
            values = torch.cat(parts)
            chosen = zip(flyers, values, generators, strict=True)
            action = torch.cat([policy.act(own_values, generator) for policy, own_values, generator in chosen])
            state, outcome = simulator.step(state, action, bank, own.world, own.reward, steps)
            flight = up.nonzero()[:, 0]
            yield _Step(
                flight,
                values.flatten(0, 1)[flight],
                action[flight],
                State(*(field[flight] for field in state)),
                Outcome(*(field[flight] for field in outcome)),
            )
            up &= ~(outcome.terminated | outcome.truncated)
            observation = outcome.observation


def _stacked(population: Sequence[policies.Policy]) -> dict[str, Tensor]:
    """The weights of policies of one shape, along the agent axis."""
    weights = [policy.network.state_dict() for policy in population]
    return {name: torch.cat([one[name] for one in weights]) for name in weights[0]}


def _tensor(column: pd.Series[Any], dtype: torch.dtype) -> Tensor:
    return torch.from_numpy(column.to_numpy().copy()).to(dtype)
