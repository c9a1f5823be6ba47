"""Flights of trained policies for the report's player, small enough for a page: nothing here trains.

A policy flies as in training, so PPO samples and DQN explores; what it sees and thinks is kept at every step.

Numbers are rounded to what a picture shows, put into bytes field by field, deflated, and written as base64. Positions
are kept to 0.1 px. Action values are rounded to 64 levels between the least and the greatest of their step: a colour
scale shows no more, and noise in the lowest bits is what deflates worst (of DQN's 100 values a step about 85 bytes are
left with 256 levels, 50 with 64, 40 with 32). A page then holds 40 kB of text for 1,000 steps of PPO, 110 of DQN.
`FIELDS` says how each number is kept, and the player reads it from there.

Letters: R rows, one a flight, T steps of a flight, K obstacles of a set.
"""

from __future__ import annotations

import base64
import itertools
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from uavnav.policies import Policy, PolicyError, load_policy
from uavnav.report.cells import Cell, one_line
from uavnav.tasks import layouts, simulator
from uavnav.tasks.dynamics import decode
from uavnav.tasks.seeding import stream
from uavnav.tasks.simulator import UP, State
from uavnav.tasks.world import World
from uavnav.training import machine

LEVELS = 64
"""So many different colours has an action's value."""
VALUES = {"ppo": "probability", "dqn": "Q value"}
"""What the numbers behind an action are."""


class Field(NamedTuple):
    """How one quantity is kept: as the nearest whole number of units (or as it is, if the type is a float's)."""

    type: str  # NumPy's name; bytes are little-endian
    unit: float
    chosen: bool = False  # belongs to a choice, so T times a flight; else to a pose, T + 1 times


FIELDS = {
    "x": Field("uint16", 0.1),  # [px]
    "y": Field("uint16", 0.1),  # [px]
    "heading": Field("uint16", 1),  # [degrees]
    "clearance": Field("int16", 0.1),  # [px], negative within a circle
    "reward": Field("float32", 1),  # sum up to this pose
    "right": Field("int8", 1 / 127),  # the ten slots of eq. (13), each in three fields
    "forward": Field("uint8", 1 / 255),
    "proximity": Field("uint8", 1 / 255),
    "action": Field("uint8", 1, chosen=True),
    "low": Field("float32", 1, chosen=True),  # the least value of all actions
    "high": Field("float32", 1, chosen=True),  # and the greatest
    "value": Field("uint8", 1 / (LEVELS - 1), chosen=True),  # 0 is the least, 1 the greatest
}
Columns = dict[str, Tensor]


def record(cells: Sequence[Cell], n_seeds: int = 3, n_layouts: int = 3, max_steps: int = 1000) -> dict[str, Any]:
    """Fly the first seeds of each cell, as in training, on the first sets of obstacles of the test bank.

    Args:
        cells: whose policies fly; those of one world and reward as one batch.
        n_seeds: seeds a cell, the lowest that can be loaded.
        n_layouts: sets of obstacles.
        max_steps: a flight that lasts so long is cut off.

    Returns:
        What the player reads, as JSON can hold it: `world` (its constants), `layouts` (sets of [x, y, radius] px),
        `actions` ([degrees, px] of each), `fields` (as `FIELDS`, in the order of the bytes, and how many columns each
        has; a field lies column by column), `cells` (algorithm, label, what its values are, and `flights` with seed,
        layout, steps, reward, how it ended, and the bytes), and `left_out`: a line for each policy that cannot fly.

    Raises:
        ValueError: a count is below 1, or the bank has fewer sets.
    """
    bank, world = layouts.load("test"), World()
    if min(n_seeds, n_layouts, max_steps) < 1 or n_layouts > len(bank):
        counts = f"n_seeds={n_seeds}, n_layouts={n_layouts}, max_steps={max_steps}"
        raise ValueError(f"{counts}; give whole numbers from 1, and at most {len(bank)} layouts")
    bank = bank[:n_layouts]
    ready: list[tuple[Cell, dict[int, Policy]]] = []
    left_out: list[str] = []
    for cell in cells:
        population, problems = _load(cell, n_seeds)
        left_out += problems
        ready += [(cell, population)] if population else []
    with machine.use_threads(1):
        flown = fly([population for _, population in ready], bank, max_steps)
    shown = []
    for (cell, population), flights in zip(ready, flown, strict=True):
        values = VALUES[next(iter(population.values())).algorithm]
        name = {"algorithm": cell.algorithm, "label": cell.label or cell.activation}
        shown.append(name | {"values": values, "flights": [_pack(flight) for flight in flights]})
    angle, distance = decode(torch.arange(world.n_actions), world)
    columns = {"value": world.n_actions} | dict.fromkeys(("right", "forward", "proximity"), world.n_slots)
    return {
        "world": asdict(world),
        "layouts": [[[round(number, 2) for number in circle] for circle in circles] for circles in bank.tolist()],
        "actions": torch.stack([angle, distance], -1).tolist(),
        "fields": [{"name": name, "columns": columns.get(name, 1)} | field._asdict() for name, field in FIELDS.items()],
        "cells": shown,
        "left_out": list(dict.fromkeys(left_out)),
    }


def _load(cell: Cell, n_seeds: int) -> tuple[dict[int, Policy], list[str]]:
    """The policies of a cell's lowest seeds that can be loaded, and a line for each that cannot."""
    population: dict[int, Policy] = {}
    problems = []
    for seed, path in sorted((seed, run.path) for run in cell.runs for seed in run.seeds):
        if len(population) == n_seeds:
            break
        try:
            population[seed] = load_policy(path, seed, greedy=False)
        except PolicyError as error:
            problems.append(one_line(error))
    return population, problems


class Flight(NamedTuple):
    """One flight, as it was flown."""

    seed: int
    layout: int
    collided: bool  # else it was cut off
    poses: Columns  # T + 1 rows: x, y [px], heading [degrees], clearance [px], reward so far, slots [T + 1, 10, 3]
    choices: Columns  # T rows: action, and values [T, 100], the numbers behind it


def fly(populations: Sequence[dict[int, Policy]], bank: Tensor, max_steps: int) -> list[list[Flight]]:
    """For each population, seed -> policy, a flight of each seed on each set of obstacles: bank [L, K, 3] px.

    As in `uavnav.evaluate`, a seed's flights depend on its policy and on a generator of its own, and on no other seed.
    """
    rules = [(one.world, one.reward) for one in (next(iter(population.values())) for population in populations)]
    found: dict[int, list[Flight]] = {}
    for rule in dict.fromkeys(rules):
        places = [place for place, own in enumerate(rules) if own == rule]
        flights = iter(_fly_together([one for place in places for one in populations[place].items()], bank, max_steps))
        for place in places:
            found[place] = list(itertools.islice(flights, len(populations[place]) * len(bank)))
    return [found[place] for place in range(len(populations))]


def _fly_together(flyers: Sequence[tuple[int, Policy]], bank: Tensor, max_steps: int) -> list[Flight]:
    """All flights of some seeds and their policies, of one world and reward, as one batch."""
    first = flyers[0][1]
    world, reward = first.world, first.reward
    generators = [torch.Generator().manual_seed(seed) for seed, _ in flyers]
    layout = torch.arange(len(bank)).repeat(len(flyers))
    flyer = torch.arange(len(flyers)).repeat_interleave(len(bank))
    row = torch.arange(len(flyer))
    heading = torch.full((len(bank),), UP)
    if world.start_heading == "random":  # that of the set of obstacles, the same for every policy
        heading = torch.randint(360, (len(bank),), generator=stream(0, "headings in evaluation"))
    state = simulator.start(layout, heading.repeat(len(flyers)), world)
    observation, clearance = simulator.observe(state, bank, world)
    collided = torch.zeros(len(row), dtype=torch.bool)
    poses, choices = [_pose(row, state, observation, clearance)], []
    flying = row
    while len(flying):
        chosen = []
        for place, (_, policy) in enumerate(flyers):
            seen = observation[flyer[flying] == place]
            if len(seen):
                values = policy.values(seen)
                action = policy.act(values, generators[place])
                chosen.append({"action": action, "values": values.softmax(-1) if policy.algorithm == "ppo" else values})
        choices.append({"row": flying} | _joined(chosen))
        state, outcome = simulator.step(state, choices[-1]["action"], bank, world, reward, max_steps)
        poses.append(_pose(flying, state, outcome.observation, outcome.clearance))
        collided[flying] = outcome.terminated
        on = ~(outcome.terminated | outcome.truncated)
        flying, state, observation = flying[on], State(*(field[on] for field in state)), outcome.observation[on]
    seeds = [seed for seed, _ in flyers for _ in range(len(bank))]
    seen_by, done_by = _split(_joined(poses), len(row)), _split(_joined(choices), len(row))
    rows = zip(seeds, layout.tolist(), collided.tolist(), seen_by, done_by, strict=True)
    return [Flight(*parts) for parts in rows]


def _pose(row: Tensor, state: State, observation: Tensor, clearance: Tensor) -> Columns:
    fields = {name: getattr(state, name) for name in ("x", "y", "heading", "reward")}
    return {"row": row, "clearance": clearance, "slots": observation.reshape(len(row), -1, 3)} | fields


def _joined(parts: Sequence[Columns]) -> Columns:
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def _split(table: Columns, n: int) -> Iterable[Columns]:
    """Each flight's part of a table of all of them, in order of time."""
    for row in range(n):
        own = table["row"] == row
        yield {name: column[own] for name, column in table.items() if name != "row"}


def _pack(flight: Flight) -> dict[str, Any]:
    """A flight as the page holds it."""
    values = flight.choices["values"]
    low, high = values.aminmax(dim=-1, keepdim=True)
    relative = (values - low) / torch.where(high > low, high - low, 1)
    right, forward, proximity = flight.poses["slots"].unbind(-1)
    columns = flight.poses | {"right": right, "forward": forward, "proximity": proximity}
    columns |= {"action": flight.choices["action"], "low": low, "high": high, "value": relative}
    content = b"".join(_bytes(columns[name], field) for name, field in FIELDS.items())
    return {
        "seed": flight.seed,
        "layout": flight.layout,
        "steps": len(values),
        "reward": round(float(flight.poses["reward"][-1]), 2),
        "ended": "collision" if flight.collided else "cut off",
        "bytes": base64.b64encode(zlib.compress(content, 9)).decode(),
    }


def _bytes(column: Tensor, field: Field) -> bytes:
    """The bytes of a field [T] or [T, columns], column by column, in which alike numbers are neighbours."""
    kind = np.dtype(field.type).newbyteorder("<")
    numbers = column.reshape(len(column), -1).T.double().numpy() / field.unit
    return (numbers if kind.kind == "f" else np.rint(numbers)).astype(kind).tobytes()
