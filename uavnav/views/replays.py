"""Episodes of trained policies for the report's player, small enough for a page: nothing here trains.

Numbers are rounded to what a picture shows, put into bytes field by field (`FIELDS`), deflated, and written
as base64. Action values have 64 levels between the least and the greatest of their step: noise in the lowest
bits deflates worst (of DQN's 100 values a step about 85 bytes are left with 256 levels, 50 with 64, 40 with
32). A page then contains 40 kB of text for 1,000 steps of PPO, 110 of DQN.

Letters: R rows, one an episode, T steps of an episode, K obstacles of a layout.
"""

from __future__ import annotations

import base64
import itertools
import zlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from uavnav.algorithms import ALGORITHMS
from uavnav.evaluation import EPISODES, episodes
from uavnav.runs import Run
from uavnav.runs.policies import Policy, PolicyError, load_policy
from uavnav.stats import Array
from uavnav.tasks import layouts
from uavnav.tasks.baselines import AnyPolicy, reactive
from uavnav.tasks.faults import NO_FAULTS
from uavnav.tasks.goal import Goal
from uavnav.tasks.space import SpaceWorld
from uavnav.tasks.state import State
from uavnav.tasks.table import name_of, unusual
from uavnav.tasks.task import Task
from uavnav.tasks.world import World
from uavnav.tasks.wrapper import WrappedTask
from uavnav.training import machine
from uavnav.views import browser

TITLES = browser.TITLES | browser.IN_3D
LEVELS = 64  # so many different colours has an action's value


class Trained(NamedTuple):
    """Runs of one configuration, whatever their seeds; only some layouts of one seed, where that is said."""

    algorithm: str
    label: str
    runs: Sequence[Run]
    seed: int | None = None
    layouts: Sequence[int] = ()
    colour: str = ""  # of its drone; by default the page's accent


class Field(NamedTuple):
    """How one quantity is kept: as the nearest whole number of units, or a float as it is."""

    type: str  # NumPy's name; bytes are little-endian
    unit: float
    chosen: bool = False  # belongs to a choice, so T times an episode; else to a pose, T + 1 times


FIELDS = {
    "x": Field("uint16", 0.1),  # [px]
    "y": Field("uint16", 0.1),  # [px]
    "heading": Field("uint16", 1),  # [degrees]
    "clearance": Field("int16", 0.1),  # [px], negative within a circle
    "reward": Field("float32", 1),  # sum up to this pose
    "right": Field("int8", 1 / 127),  # the ten slots of eq. (13), each in three fields
    "forward": Field("uint8", 1 / 255),
    "proximity": Field("uint8", 1 / 255),
    "action": Field("uint16", 1, chosen=True),
    "low": Field("float32", 1, chosen=True),  # the least value of all actions
    "high": Field("float32", 1, chosen=True),  # and the greatest
    "value": Field("uint8", 1 / (LEVELS - 1), chosen=True),  # 0 is the least, 1 the greatest
}
IN_3D = FIELDS | {
    "z": Field("uint16", 0.1),  # [px]
    "pitch": Field("int8", 1),  # [degrees]
    "up": Field("int8", 1 / 127),  # of the ten slots
}
"""Of an episode in 3D."""
SLOT = ("right", "up", "forward", "proximity")
"""The fields of a slot, in the order of an observation; `up` in 3D."""
Columns = dict[str, Tensor]


def record(
    configurations: Sequence[Trained], n_seeds: int = 3, n_layouts: int = 3, max_steps: int = 1000
) -> dict[str, Any]:
    """Fly the first seeds of each configuration, as in training, on the first layouts of their test split.

    n_seeds: of a configuration, the lowest that can be loaded; max_steps: longer episodes are truncated.

    Returns:
        What the player reads, as JSON: `world` (its constants), `layouts` (of [x, y, radius] px;
        None for those that are not shown), `actions` ([degrees, px] of each), `fields` (of the bytes),
        `configurations` (with their `episodes`; elsewhere than in the paper's task also `_place`), `scripted`
        (episodes of the scripted policy; none where no policy can fly), and `left_out`: a line for each
        policy that cannot.
    """
    all_layouts, world = layouts.load("test"), World()
    ready: list[tuple[Trained, str, dict[int, Policy]]] = []
    left_out: list[str] = []
    for configuration in configurations:
        population, problems = _load(configuration, n_seeds)
        left_out += problems
        split = layouts.judged_on(configuration.runs[0].config["layouts"])
        ready += [(configuration, split, population)] if population else []
    usual = range(n_layouts)
    flyers = [
        Flyer(seed, policy, policy.task, configuration.layouts or usual, split)
        for configuration, split, population in ready
        for seed, policy in population.items()
    ]
    with machine.use_threads(1):
        episodes = iter(fly(flyers, max_steps))
        task = WrappedTask(Task(world, all_layouts[:n_layouts], max_steps=max_steps))
        scripted = next(_fly_together([Flyer(0, reactive, task, usual)], task)) if ready else []
    shown = []
    for configuration, split, population in ready:
        algorithm, label = configuration.algorithm, configuration.label
        where = _place(next(iter(population.values())).task, split, configuration.layouts or usual)
        titles = [f"{algorithm.upper()} {label}", "sampled", *(one["title"] for one in where.values())]
        shown.append(
            {
                "algorithm": algorithm,
                "label": label,
                **({"accent": configuration.colour} if configuration.colour else {}),
                "name": ", ".join(titles),
                **where,
                "values": ALGORITHMS[algorithm].shown,
                "episodes": [episode for _ in population for episode in next(episodes)],
            }
        )
    places = [*usual, *(place for one in configurations for place in one.layouts)]
    return {
        **_constants(world),
        "layouts": _sparse(all_layouts.double().numpy().round(2).tolist(), places),
        "configurations": shown,
        "scripted": scripted,
        "left_out": list(dict.fromkeys(left_out)),
    }


def _sparse(rows: Sequence[Any], shown: Sequence[int]) -> list[Any]:
    """Layouts at their places in a list, with nothing for those that nobody sees."""
    return [rows[place] if place in shown else None for place in range(max(shown) + 1)]


def _constants(world: World | SpaceWorld) -> dict[str, Any]:
    """The constants of a world, what each action does there, and the fields of an episode's bytes."""
    columns = {"value": world.n_actions} | dict.fromkeys(SLOT, world.n_slots)
    told = [
        {"name": name, "columns": columns.get(name, 1), **one._asdict()}
        for name, one in _fields(world).items()
    ]
    actions = browser.actions(world)
    shown = {"actions": actions, "values": browser.picture(actions)}
    return {"world": world.model_dump(), "fields": told} | shown


def _fields(world: World) -> dict[str, Field]:
    return IN_3D if isinstance(world, SpaceWorld) else FIELDS


def together(recorded: dict[str, Any], configurations: Mapping[str, str], scripted: str) -> dict[str, Any]:
    """What a page needs to show first seeds of configurations and the scripted policy on the same obstacles.

    recorded: as `record` gives it; configurations: names by the configuration's label, such as `PPO tanh`;
    scripted: the scripted policy's name. Episodes are without choices, and begin where the configurations'
    are shortest.
    """
    # configurations of the paper's task
    there = [one for one in recorded["configurations"] if "place" not in one]
    of = {f"{one['algorithm'].upper()} {one['label']}": one["episodes"] for one in there}
    by_name = {name: of[label] for label, name in configurations.items() if label in of}
    by_name[scripted] = recorded["scripted"]
    firsts = {
        name: {one["layout"]: one for one in episodes if one["seed"] == episodes[0]["seed"]}
        for name, episodes in by_name.items()
    }
    learned = [own for name, own in firsts.items() if name != scripted]
    fields = [field for field in recorded["fields"] if not field["chosen"]]
    order = sorted(range(len(recorded["layouts"])), key=lambda at: sum(own[at]["steps"] for own in learned))
    return {
        "world": recorded["world"],
        "layouts": [recorded["layouts"][at] for at in order],
        "fields": fields,
        "drones": [
            {"name": name, "episodes": [_poses(own[at], fields) for at in order]}
            for name, own in firsts.items()
        ],
    }


def paths(together: dict[str, Any], steps: int) -> dict[str, Array]:
    """Where the drones of `together` fly in their first steps on the first obstacles: name -> [T, 2] px."""
    found = {}
    for drone in together["drones"]:
        episode = drone["episodes"][0]
        content = zlib.decompress(base64.b64decode(episode["bytes"]))
        # an episode's bytes begin with all x and all y
        columns = np.frombuffer(content, "<u2", 2 * (episode["steps"] + 1)).reshape(2, -1)
        found[drone["name"]] = columns.T[: steps + 1] * FIELDS["x"].unit
    return found


def _poses(episode: dict[str, Any], fields: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """A packed episode with these fields, without its choices, whose bytes are the last."""
    size = sum(np.dtype(one["type"]).itemsize * one["columns"] for one in fields)
    content = zlib.decompress(base64.b64decode(episode["bytes"]))[: size * (episode["steps"] + 1)]
    return episode | {"bytes": base64.b64encode(zlib.compress(content, 9)).decode()}


def _load(configuration: Trained, n_seeds: int) -> tuple[dict[int, Policy], list[str]]:
    """The policies of a configuration's lowest seeds that can be loaded, and a line for each that cannot."""
    population: dict[int, Policy] = {}
    problems = []
    seeds = sorted((seed, run.path) for run in configuration.runs for seed in run.seeds)
    for seed, path in seeds:
        if configuration.seed not in (None, seed):
            continue
        if len(population) == n_seeds:
            break
        try:
            policy = load_policy(path, seed, greedy=False)
        except PolicyError as error:
            problems.append(str(error))
            continue
        task = name_of(policy.task)
        if task in TITLES:
            population[seed] = policy
        else:
            problems.append(f"{path}: a page has no replays of task={task}; uavnav render makes a film of it")
    return population, problems


def _layouts(task: WrappedTask, split: str) -> Tensor:
    """The layouts of the task's own test split, or of a rung's, that an evaluation flies."""
    return layouts.load(split, task.world)[:EPISODES]


def _place(task: WrappedTask, split: str, chosen: Sequence[int]) -> dict[str, Any]:
    """Where episodes were recorded, if not in the paper's task as it is: `place`, what the player draws.

    split: the split, which may be a rung's such as `slalom-80/test`.
    """
    name = name_of(task)
    found = {TITLES[name]: name != "drone", split.removesuffix("/test"): split != "test"}
    found |= dict.fromkeys(unusual(task), True)
    found |= {str(task.faults): task.faults != NO_FAULTS, f"stack={task.stack}": task.stack > 1}
    words = [word for word, is_so in found.items() if is_so]
    if not words:
        return {}
    shown = _sparse(
        browser.placed(_layouts(task, split).double().tolist(), isinstance(task.task, Goal)), chosen
    )
    place = {"task": name, "title": ", ".join(words), "layouts": shown, "max_steps": task.max_steps}
    return {"place": place | _constants(task.world)}


class Flyer(NamedTuple):
    """A policy with its seed and its task, and the layouts of a split on which it is shown."""

    seed: int
    policy: AnyPolicy
    task: WrappedTask
    layouts: Sequence[int]
    split: str = "test"


def fly(flyers: Sequence[Flyer], max_steps: int) -> list[list[dict[str, Any]]]:
    """The shown episodes of each policy in its own task, on the layouts there of its split.

    All layouts have an episode, as in an evaluation: sampled actions of one episode follow others. Policies
    share a batch where their tasks differ only in layouts and time limit.
    """
    batches: dict[tuple[Any, ...], list[int]] = {}
    for place, (_, _, task, _, split) in enumerate(flyers):
        key = split, type(task.task), task.world, task.reward, task.stack, task.faults
        batches.setdefault(key, []).append(place)
    found: list[list[dict[str, Any]]] = [[] for _ in flyers]
    for (split, *_), places in batches.items():
        together, own_task = [flyers[place] for place in places], flyers[places[0]].task
        task = own_task.on(_layouts(own_task, split), max_steps)
        for place, own in zip(places, _fly_together(together, task), strict=True):
            found[place] = own
    return found


def _fly_together(flyers: Sequence[Flyer], task: WrappedTask) -> Iterator[list[dict[str, Any]]]:
    """The shown episodes of each flyer as a page has them, all of them as one batch."""
    n = len(task.layouts)
    start = episodes.start(task, [flyer.seed for flyer in flyers])
    rows = [[place * n + layout for layout in flyer.layouts] for place, flyer in enumerate(flyers)]
    kept = torch.zeros(len(start.x), dtype=torch.bool)
    kept[list(itertools.chain(*rows))] = True
    going = kept.reshape(-1, n).sum(1)  # shown episodes of each flyer
    poses, choices = [_pose(task, torch.arange(len(kept)), start, *task.observe(start), kept)], []
    collided, arrived = torch.zeros(2, len(kept), dtype=torch.bool)
    for step in episodes.steps([flyer[:2] for flyer in flyers], task):
        mine, outcome = kept[step.episode], step.outcome
        values = step.values
        if values is None:  # behind the action of a scripted policy is nothing but itself
            values = functional.one_hot(step.action, task.world.n_actions).float()
        choices.append({"row": step.episode[mine], "action": step.action[mine], "values": values[mine]})
        poses.append(_pose(task, step.episode, step.state, outcome.observation, outcome.clearance, mine))
        collided[step.episode] = outcome.terminated
        if isinstance(task.task, Goal):
            arrived[step.episode] = task.succeeded(step.state)
        going -= torch.bincount(step.episode[step.ended & mine] // n, minlength=len(going))
        # nobody sees how the others of this flyer go on
        step.ended.logical_or_((going == 0)[step.episode // n])
    seen, done = (dict(_by_row(parts)) for parts in (poses, choices))
    for own, flyer in zip(rows, flyers, strict=True):
        packed = []
        for row in own:
            if isinstance(flyer.policy, Policy):
                done[row]["values"] = flyer.policy.shown(done[row]["values"])
            ended = "goal" if arrived[row] else "collision" if collided[row] else "truncated"
            packed.append(_pack(flyer.seed, row % n, ended, seen[row], done[row]))
        yield packed


def _pose(
    task: WrappedTask, row: Tensor, state: State, observation: Tensor, clearance: Tensor, kept: Tensor
) -> Columns:
    """The fields of a pose, of those of a step's episodes that are shown.

    Slots are of observations [F, n], without velocities, of a stack the newest. row [F]: which episodes they
    are, kept [F] bool.
    """
    world, fields = task.world, _fields(task.world)
    slots = observation[:, : world.n_slots * len(world.slot_low)].reshape(len(observation), world.n_slots, -1)
    columns = {"row": row, "clearance": clearance}
    columns |= zip((name for name in SLOT if name in fields), slots.unbind(-1), strict=False)
    columns |= {name: getattr(state, name) for name in fields if name in state._fields}
    return {name: column[kept] for name, column in columns.items()}


def _by_row(steps: Sequence[Columns]) -> Iterator[tuple[int, Columns]]:
    """Each episode's part of the steps of all of them, in order of time."""
    table = {name: torch.cat([step[name] for step in steps]) for name in steps[0]}
    for row in sorted(set(table["row"].tolist())):
        own = table["row"] == row
        yield row, {name: column[own] for name, column in table.items() if name != "row"}


def _pack(seed: int, layout: int, ended: str, poses: Columns, choices: Columns) -> dict[str, Any]:
    """One episode as a page has it.

    poses: T + 1 rows of the fields of a pose; choices: T rows of action, and values [T, 100], the numbers
    behind it.
    """
    values = choices["values"]
    low, high = values.aminmax(dim=-1, keepdim=True)
    relative = (values - low) / torch.where(high > low, high - low, 1)
    columns = poses | {"action": choices["action"], "low": low, "high": high, "value": relative}
    fields = IN_3D if "z" in poses else FIELDS
    content = b"".join(_bytes(columns[name], field) for name, field in fields.items())
    return {
        "seed": seed,
        "layout": layout,
        "steps": len(values),
        "reward": round(float(poses["reward"][-1]), 2),
        "ended": ended,
        "bytes": base64.b64encode(zlib.compress(content, 9)).decode(),
    }


def _bytes(column: Tensor, field: Field) -> bytes:
    """The bytes of a field [T] or [T, columns], column by column, in which alike numbers are neighbours."""
    kind = np.dtype(field.type).newbyteorder("<")
    numbers = column.reshape(len(column), -1).T.double().numpy() / field.unit
    return (numbers if kind.kind == "f" else np.rint(numbers)).astype(kind).tobytes()
