"""The tasks and trained policies as one page, to be opened from disk: nothing here trains.

The page contains the tasks (`uavnav.views.browser`), the first layouts of their splits, the weights of some
seeds of each run as they are, in float32, and scripts without a framework. It loads nothing. What a link to
it says is checked by `link.js`.
"""

from __future__ import annotations

import base64
import importlib.metadata
import itertools
import math
import os
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np
from markupsafe import Markup
from torch import Tensor

from uavnav import colours, networks
from uavnav.algorithms import ALGORITHMS
from uavnav.errors import ConfigError
from uavnav.runs import POLICY, paper, policies, read_settings, run_folders, shipped
from uavnav.runs.metrics import EPISODE_COLUMNS, METRICS
from uavnav.runs.policies import Policy, PolicyError, is_zip
from uavnav.tasks import layouts as splits
from uavnav.tasks.baselines import BASELINES
from uavnav.tasks.faults import NO_FAULTS
from uavnav.tasks.ladders import LADDERS
from uavnav.tasks.moving import MovingWorld
from uavnav.tasks.protocol import DEFAULT_K, EPISODES, MAX_STEPS, SPLITS, USUAL
from uavnav.tasks.space import SpaceWorld
from uavnav.tasks.table import name_of
from uavnav.tasks.world import World
from uavnav.views import browser

HERE = Path(__file__).parent
PARTS = ("policies", "scripted", "link", "race", "stage", "panel", "keep", "keys", "playground")
SCRIPTS = tuple(HERE / f"{name}.js" for name in PARTS)
"""After those of `uavnav.views.browser`, in the order in which a browser reads them."""
OWN = Path("runs")  # where runs are looked for if none is named
SEEDS = 3  # of each run, the lowest, if there is room
MOST = 36  # networks on a page: a network of 64-64 takes 67 kB, and a page shall stay below 3 MB
DRONES = 4  # in a race
ALL_SPLITS = ("test", "validation", "train")  # of each of them a page contains the first `EPISODES` layouts
SCRIPTED = (*USUAL, *browser.CLASSICS)  # scripted policies that the page has
FIRST_LAYOUT = 3  # that the page begins with


class Setting(NamedTuple):
    """A slider of the page: what of a task, or which fault, it sets."""

    label: str
    low: float
    high: float
    step: float
    first: float
    unit: str = ""
    tasks: tuple[str, ...] = ()  # that have it; none: a fault, which any task can have


def _rungs(name: str) -> tuple[float, float]:
    return min(LADDERS[name].rungs), max(LADDERS[name].rungs)


SETTINGS = {
    "gap": Setting("gap", *_rungs("slalom"), 10, 120, "px", ("slalom",)),
    "pace": Setting("their speed", *_rungs("speed"), 0.5, MovingWorld().speed_max, "px/step", ("moving",)),
    "noise": Setting("noise", *_rungs("noise"), 1, 0, "px"),
    "lost": Setting("lost echoes", *_rungs("lost"), 0.05, 0),
    "late": Setting("delay", *_rungs("late"), 1, 0, "steps"),
    "sticky": Setting("sticky actions", *_rungs("sticky"), 0.05, 0),
}
"""By name in a link; the bounds are those of the ladders."""
TOLD = {
    "drone": "",
    "slalom": "Four columns, each with one gap. Networks of the paper's task fly here as they are.",
    "moving": "Networks of the paper's task fly here as they are: none senses how fast an obstacle moves.",
    "goal": "Fly to the rings, in at most 1,000 steps. It takes a network that senses its goal.",
}
"""What the page says of each task."""
ABOUT = {name: {"title": title, "told": TOLD[name]} for name, title in browser.TITLES.items()}


class Flyers(NamedTuple):
    """The policies of a page, as it reads them, and what could not be on it."""

    policies: list[dict[str, Any]]
    named: list[str]  # keys of the runs and scripted policies that were named, in order
    tasks: dict[str, World]  # by the task of a policy: the world of the first one, whose layouts are shown
    left_out: list[str]  # a line for each run that is not on the page


def usual() -> list[str]:
    """The folder whose policies fly if none is named: of one's own runs, or of the policies that ship."""
    return [str(OWN if any(OWN.glob(f"**/{POLICY}")) else shipped.FOLDER)]


def runs_in(*folders: Path) -> list[Path]:
    """The newest `MOST` runs with policies in and below folders; a RunError where a folder has no run."""
    every = dict.fromkeys(path for folder in folders for path in run_folders(folder)[0])
    found = [path for path in every if (path / POLICY).exists()]
    newest = sorted(found, key=lambda path: (path / POLICY).stat().st_mtime, reverse=True)[:MOST]
    return [path for path in found if path in newest]


def collect(words: Sequence[str | Path], seed: int | None = None, activation: str | None = None) -> Flyers:
    """The policies of runs, of all runs in folders, and of zips of Stable-Baselines3.

    seed: of every run, by default the lowest; activation: of the zips' hidden layers, where they need one.

    Raises:
        RunError: a folder contains no run.
        PolicyError: a run that is named has no policy, or one that the page cannot fly; or none is left.
    """
    zips = policies.zips([str(word) for word in words], activation)
    named: list[str] = []  # runs and scripted policies that were named themselves
    runs: list[str] = []
    folders = []
    for word in map(str, words):
        if word in SCRIPTED:
            named.append(word)
        elif word in BASELINES:
            _refuse(word, f"the playground has no such scripted policy; it has {', '.join(SCRIPTED)}")
        elif Path(word) == shipped.FOLDER:
            runs += shipped.shipped()
        elif os.path.isdir(word) and not os.path.isfile(Path(word) / POLICY) and not is_zip(word):
            folders.append(Path(word))
        else:
            runs.append(word)
            named.append(word)
    every = dict.fromkeys([*runs, *map(str, runs_in(*folders))])
    kept: dict[str, list[Policy]] = {}
    left_out = []
    for path in every:
        try:
            own = _policies(path, seed, activation if path in zips else None, MOST // len(every))
            kept[path] = [_checked(path, policy) for policy in own]
        except PolicyError as error:
            if path in named:
                raise
            left_out.append(str(error))
    if not kept and (every or folders):
        where = ", ".join(map(str, words))
        raise PolicyError(
            left_out[0] if left_out else f"{where}: no policy there; give a finished run's folder"
        )
    names = Counter((own[0].algorithm, _activation(own[0])) for own in kept.values())
    packed = {}
    for path, own in sorted(kept.items(), key=lambda item: _order(item[1][0])):
        unique = names[own[0].algorithm, _activation(own[0])] == 1 and not is_zip(path)
        packed[path] = [_packed(policy, "" if unique else path, _frames(path)) for policy in own]
    found, taken = [one for own in packed.values() for one in own], set[str]()
    for one in found:
        while one["key"] in taken:  # `a/b` and `a-b` are one name in a link
            one["key"] += "_"
        taken.add(one["key"])
    keys = [word if word in SCRIPTED else packed[word][0]["key"] for word in dict.fromkeys(named)]
    tasks = {name_of(own[0].task): own[0].world for own in reversed(kept.values())}
    return Flyers(found, keys, tasks, left_out)


def _policies(path: str, seed: int | None, activation: str | None, most: int) -> list[Policy]:
    """Those of a run's lowest seeds, at most so many; of one seed, or of a zip, the one that there is."""
    if is_zip(path):
        return [policies.load_policy(path, seed, False, activation)]
    own = policies.each_policy(path, None if seed is None else [seed], False)
    return [*itertools.islice(own, max(1, min(SEEDS, most)))]


def _checked(path: str, policy: Policy) -> Policy:
    """A policy that the page can fly; raises a PolicyError where it cannot."""
    if isinstance(policy.world, SpaceWorld):
        _refuse(path, "the playground has no 3D")
    for what, value, choices in (
        ("task", name_of(policy.task), ("drone", "moving", "goal")),
        ("activation", _activation(policy), networks.BUILT_IN),
        ("way to act", policy.acts, ("categorical", "epsilon-greedy")),
        ("values", ALGORITHMS[policy.algorithm].shown, ("probability", "Q value")),
        ("stack", str(policy.task.stack), ("1",)),
    ):
        if value not in choices:
            _refuse(path, f"the playground has no {what} {value!r}; it has {', '.join(choices)}")
    usual = type(policy.world)()
    same = {name: getattr(usual, name) for name in ("speed_min", "speed_max") if hasattr(usual, name)}
    if policy.world.replace(**same) != usual:  # the page has obstacles of any speed
        _refuse(path, "trained in another task than the playground's")
    return policy


def shows(run: Path) -> bool:
    """Whether the page can fly the policies of a finished run."""
    try:
        return bool(_checked(str(run), policies.load_policy(run)))
    except PolicyError:
        return False


def _refuse(path: str, reason: str) -> None:
    raise PolicyError(f"{path}: {reason}; watch it: uavnav render {path} --out episode.gif")


def _order(policy: Policy) -> tuple[int, int]:
    """Algorithms as in their table, and the paper's activations first."""
    activation = _activation(policy)
    usual = paper.ACTIVATIONS.index(activation) if activation in paper.ACTIVATIONS else len(paper.ACTIVATIONS)
    return list(ALGORITHMS).index(policy.algorithm), usual


def _activation(policy: Policy) -> str:
    return next(
        (one.name for one in policy.network.children() if isinstance(one, networks.Activation)), "identity"
    )


def _frames(run: str) -> int:
    """Of a run's training; 0 where nothing says it."""
    if shipped.is_shipped(run):
        return int(shipped.chosen()[run]["frames"])
    facts = (Path(run) if os.path.isdir(run) else Path(run).parent) / "meta.json"
    return int(read_settings(facts).get("frames") or 0) if facts.is_file() else 0


def _key(*words: str) -> str:
    """A name that a link can contain as it is."""
    return re.sub("[^A-Za-z0-9._=-]+", "-", "-".join(words)).strip("-")


def _packed(policy: Policy, where: str, frames: int) -> dict[str, Any]:
    """A policy as the page contains it; where: its run, if its algorithm and activation do not tell."""
    layers, numbers = [*policy.network.children()], [one.detach() for one in policy.network.parameters()]
    learned = [sum(one.numel() for one in layer.parameters()) for layer in layers[1::2]]
    activation = _activation(policy)
    words = activation.replace("_", " ")
    how = "samples its actions"
    if policy.acts == "epsilon-greedy":
        how = f"a random action in {100 * policy.epsilon:g} % of its steps, else the best"
    task = policy.task
    place = "" if name_of(task) == "drone" else f" with {ABOUT[name_of(task)]['title']}"
    place += "" if task.faults == NO_FAULTS else f" with {str(task.faults).replace(',', ', ')}"
    trained = f"{frames:,} frames of training" if frames else "trained elsewhere"
    return {
        "key": _key(*([where] if where else []), policy.algorithm, activation, str(policy.seed)),
        "title": f"{policy.algorithm.upper()} {words}, seed {policy.seed}{place}"
        + (f" ({where})" if where else ""),
        "name": Path(where).name if where else words,
        "told": f"{trained}{place}; {how}.",
        "task": name_of(task),
        "algorithm": policy.algorithm,
        "activation": activation,
        "acts": policy.acts,
        "epsilon": policy.epsilon,
        "shown": ALGORITHMS[policy.algorithm].shown,
        "head": policy.head,
        "layer_norm": any(getattr(layer, "layer_norm", False) for layer in layers),
        "faults": {name: value for name, value in task.faults if value},
        # of each linear layer: inputs, outputs, and the numbers that the activation behind it has learned
        "sizes": [
            [*layer.get_parameter("weight").shape[1:], own]
            for layer, own in zip(layers[::2], [*learned, 0], strict=True)
        ],
        "weights": _base64(*numbers),
    }


def _base64(*numbers: Any) -> str:
    """Arrays as the page reads them: float32, the lowest byte first."""
    return base64.b64encode(b"".join(np.asarray(one, "<f4").tobytes() for one in numbers)).decode()


# -- the page ------------------------------------------------------------------------------------------------


class Opening(NamedTuple):
    """What a page shows first."""

    layouts: str = "test"  # a split, a rung or a layout file
    layout: int = FIRST_LAYOUT
    task: str = "drone"  # where no run is named
    greedy: bool = False
    max_steps: int | None = None  # the time limit; None: each task's own


def page(flyers: Flyers, opening: Opening | None = None) -> str:
    found, opening = flyers.policies, opening or Opening()
    metrics = [{"name": name, **METRICS[name]._asdict()} for name in paper.COLUMNS]
    scene = _scene(flyers, opening)
    usual = splits.KINDS | {"slalom": splits.KINDS["drone"]}  # which is only a layout file
    worlds = {name: flyers.tasks.get(name) or usual[name].world() for name in browser.TITLES}
    values = scene | {"pace": worlds["moving"].model_dump()["speed_max"]}
    sliders = {name: _reaching(one, values[name]) for name, one in SETTINGS.items()}
    settings = {name: {**one._asdict(), "here": scene[name]} for name, one in sliders.items()}
    data: dict[str, Any] = {
        "tasks": browser.constants(worlds),
        "settings": settings,
        "about": ABOUT,
        "metrics": metrics,
        "columns": list(EPISODE_COLUMNS),
        "limit": MAX_STEPS,  # of an episode that can be kept
        "colours": {"known": colours.PILOTS, "others": colours.OTHERS},
        "policies": found,
        "scene": scene,
        "layouts": {},
        "headers": {},
    }
    for name, world in worlds.items():
        own = data["tasks"][name]
        own["max_steps"] = opening.max_steps or own["max_steps"] or MAX_STEPS
        data["headers"][name] = splits.read("test", world)[1]
        if name != "slalom":
            data["layouts"][name] = {
                split: _placed(name, splits.load(split, world)[:EPISODES]) for split in ALL_SPLITS
            }
            if name == scene["task"]:
                given = splits.load(opening.layouts, world)
                if not 0 <= opening.layout < len(given):
                    raise ConfigError(f"--layout {opening.layout}: choose from 0 to {len(given) - 1}")
                given = given[: max(EPISODES, opening.layout + 1)]
                data["layouts"][name][scene["layouts"]] = _placed(name, given)
    algorithms = " and ".join(dict.fromkeys(one["algorithm"].upper() for one in found))
    configurations = len({(one["algorithm"], one["activation"]) for one in found})
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, autoescape=True, trim_blocks=True)
    return environment.from_string((HERE / "playground.html").read_text(encoding="utf-8")).render(
        css=Markup(browser.joined([browser.HERE / "values.css", HERE / "playground.css"])),
        js=Markup(browser.joined([*browser.WORLD, *SCRIPTS])),
        data=browser.as_json(data),
        metrics=metrics,
        settings=sliders,
        about=ABOUT,
        splits=[*dict.fromkeys(itertools.chain(*data["layouts"].values())), "random"],
        scripted=SCRIPTED,
        policies=found,
        values=browser.picture(browser.actions(World())),
        world=World(),
        others=f"networks trained by {algorithms} and a scripted policy" if found else "a scripted policy",
        told=f"It contains {len(found)} trained networks: {configurations} pairs of an algorithm and an "
        "activation.",
        version=importlib.metadata.version("uavnav"),
    )


def _reaching(slider: Setting, value: float) -> Setting:
    """A slider that a value fits on, to six decimals."""
    steps = value / slider.step
    decimals = len(f"{value:.6f}".rstrip("0").partition(".")[2])
    step = slider.step if math.isclose(steps, round(steps)) else 10.0**-decimals
    return slider._replace(high=max(slider.high, math.ceil(value)), step=step)


def _placed(task: str, layouts: Tensor) -> list[dict[str, Any]]:
    """Layouts of a task, the rows of each in base64."""
    packed = {"columns": layouts.shape[-1]}
    every = browser.placed(layouts.double().tolist(), task == "goal")
    return [one | packed | {"circles": _base64(one["circles"])} for one in every]


def _scene(flyers: Flyers, opening: Opening) -> dict[str, Any]:
    """The scene of a page opened without a link: you and who was named, or two runs and `reactive`."""
    by_key = {one["key"]: one for one in flyers.policies}
    first = next((by_key[key] for key in flyers.named if key in by_key), None)
    tasks = [one["task"] for one in ([first] if first else flyers.policies)]
    task = opening.task if opening.task in tasks or opening.task != "drone" else next(iter(tasks), "drone")
    pilots = flyers.named or [*_two(flyers.policies, task), "reactive"]
    you = ["you"] if len(pilots) < DRONES else []
    settings = {name: one.first for name, one in SETTINGS.items()} | (first["faults"] if first else {})
    own = opening.layouts in SPLITS or splits.is_rung(opening.layouts)
    stem = Path(opening.layouts).stem
    return {
        "task": task,
        **settings,
        "layouts": opening.layouts if own else _key(*["own"] * (stem in (*SPLITS, "random")), stem),
        "layout": opening.layout,
        "k": DEFAULT_K,
        "circles": None,
        "pilots": [*you, *pilots, *["nobody"] * DRONES][:DRONES],
        "focus": 2,
        "speed": 1,
        "greedy": opening.greedy,
        "seed": 0,
    }


def _two(found: Sequence[dict[str, Any]], task: str) -> list[str]:
    """Keys of the policies of two runs in a task, of two algorithms if there are."""
    runs: dict[Any, str] = {}
    algorithms: dict[str, str] = {}
    for one in found:
        if one["task"] == task:
            runs.setdefault((one["algorithm"], one["name"]), one["key"])
            algorithms.setdefault(one["algorithm"], one["key"])
    return list(dict.fromkeys([*algorithms.values(), *runs.values()]))[:2]
