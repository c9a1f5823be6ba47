"""`uavnav playground`: the world and trained policies as one page, to be opened from disk: nothing here
trains.

The page holds the worlds (`uavnav.views.browser`), the weights of some seeds of each run as they are, in
float32, and scripts without a framework. It loads nothing. What a link to it says is checked by `link.js`.
"""

from __future__ import annotations

import base64
import importlib.metadata
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
from markupsafe import Markup

from uavnav import networks
from uavnav.algorithms import ALGORITHMS
from uavnav.errors import ConfigError
from uavnav.runs import POLICY, paper, policies, read_settings, run_folders
from uavnav.runs.metrics import METRICS
from uavnav.runs.policies import Policy, PolicyError
from uavnav.tasks.faults import NO_FAULTS
from uavnav.tasks.ladders import LADDERS
from uavnav.tasks.moving import MovingWorld
from uavnav.tasks.protocol import DEFAULT_K
from uavnav.tasks.table import name_of
from uavnav.tasks.world import World
from uavnav.views import browser

HERE = Path(__file__).parent
PARTS = ("policies", "rules", "link", "race", "stage", "panel", "worlds", "keys", "playground")
SCRIPTS = tuple(HERE / f"{name}.js" for name in PARTS)
"""After those of `uavnav.views.browser`, in the order in which a browser reads them."""
SEEDS = 3
"""Of each run, the lowest, if there is room."""
MOST = 36
"""Networks on a page: a network of 64-64 takes 67 kB, and a page shall stay below 3 MB."""
DEPTH = 2
"""Runs lie so many folders below the one that is given: ppo/tanh. Studies within studies are deeper, and
left out.
"""
FIRST_SET = 3
"""The layout that the page begins with."""


class Setting(NamedTuple):
    """A slider of the page: what of a world, or which fault, it sets."""

    label: str
    low: float
    high: float
    step: float
    first: float
    unit: str = ""
    worlds: tuple[str, ...] = ()  # that have it; none: a fault, which any world can have


def _rungs(name: str) -> tuple[float, float]:
    """The least and the most of a ladder."""
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
    "slalom": "Four columns, each with one gap. Networks of the paper's world fly here as they are.",
    "moving": "Networks of the paper's world fly here as they are: none senses how fast an obstacle moves.",
    "goal": "Fly to the rings, in at most 1,000 steps. It takes a network that senses its goal.",
}
"""What the page says of each world."""
WORLDS = {name: {"title": title, "told": TOLD[name]} for name, title in browser.TITLES.items()}


def runs_in(folder: Path) -> list[Path]:
    """The runs of a folder that have policies: itself, or those at most `DEPTH` below.

    Raises:
        RunError: it is missing, a file, or holds no run.
    """
    found, _ = run_folders(folder)
    near = [path for path in found if len(path.relative_to(folder).parts) <= DEPTH]
    return [path for path in near if (path / POLICY).exists()]


def collect(folders: Sequence[Path]) -> tuple[list[dict[str, Any]], list[str]]:
    """The policies of the runs in some folders, as the page reads them, and a line for each run that is left
    out.

    Raises:
        RunError: a folder is missing, or holds no run.
        ConfigError: no policy is left, or there are more runs than a page holds.
    """
    runs = list(dict.fromkeys(path for folder in folders for path in runs_in(folder)))
    if len(runs) > MOST:
        raise ConfigError(f"{len(runs)} runs; a page holds at most {MOST}: give folders with fewer")
    kept: list[tuple[Path, list[Policy]]] = []
    left_out = []
    for path in runs:
        try:
            kept.append((path, list(_load(path, max(1, min(SEEDS, MOST // len(runs)))))))
        except PolicyError as error:
            left_out.append(str(error))
    if not kept:
        where = ", ".join(map(str, folders))
        because = f" ({left_out[0]})" if left_out else ""
        raise ConfigError(
            f"{where}: no policy that the page can fly{because}; give a folder with a finished run"
        )
    kept.sort(key=lambda one: _order(one[1][0]))
    names = Counter((own[0].algorithm, _activation(own[0])) for _, own in kept)
    found = []
    for path, own in kept:
        alone = names[own[0].algorithm, _activation(own[0])] == 1
        frames = int(read_settings(path / "meta.json").get("frames", 0))
        found += [_packed(policy, "" if alone else "/".join(path.parts[-3:]), frames) for policy in own]
    return found, left_out


def _load(path: Path, n_seeds: int) -> Iterator[Policy]:
    """The policies of a run's lowest seeds; raises a PolicyError where the page cannot fly one."""
    for seed in policies.seeds(path / POLICY)[:n_seeds]:
        policy = policies.load_policy(path, seed)
        shown = ALGORITHMS[policy.algorithm].shown
        for what, value, choices in (
            ("task", name_of(policy.task), ("drone", "moving", "goal")),
            ("activation", _activation(policy), networks.KNOWN),
            ("way to act", policy.acts, ("categorical", "epsilon-greedy")),
            ("values", shown, ("probability", "Q value")),
            ("stack", str(policy.task.stack), ("1",)),
        ):
            if value not in choices:
                raise PolicyError(f"{path}: the page has no {what} {value!r}; it has {', '.join(choices)}")
        usual = type(policy.world)()
        same = {name: getattr(usual, name) for name in ("speed_min", "speed_max") if hasattr(usual, name)}
        if policy.world.replace(**same) != usual:  # the page has obstacles of any speed
            raise PolicyError(f"{path}: trained in another world than the page's, which has every default")
        yield policy


def _order(policy: Policy) -> tuple[int, int]:
    """Algorithms as in their table, and the paper's activations first."""
    activation = _activation(policy)
    usual = paper.ACTIVATIONS.index(activation) if activation in paper.ACTIVATIONS else len(paper.ACTIVATIONS)
    return list(ALGORITHMS).index(policy.algorithm), usual


def _activation(policy: Policy) -> str:
    """Of its hidden layers."""
    return next(
        (one.name for one in policy.network.children() if isinstance(one, networks.Activation)), "identity"
    )


def _packed(policy: Policy, where: str, frames: int) -> dict[str, Any]:
    """A policy as the page holds it; where: its run, if its algorithm and activation do not tell."""
    layers = [layer for layer in policy.network.children() if isinstance(layer, networks.AgentLinear)]
    numbers = b"".join(
        part.detach().numpy().astype("<f4").tobytes()
        for layer in layers
        for part in (layer.weight, layer.bias)
    )
    activation = _activation(policy)
    title = f"{policy.algorithm.upper()} {activation.replace('_', ' ')}, seed {policy.seed}"
    how = "samples its actions"
    if policy.acts == "epsilon-greedy":
        how = f"a random action in {100 * policy.epsilon:g} % of its steps, else the best"
    task = policy.task
    place = "" if name_of(task) == "drone" else f" with {WORLDS[name_of(task)]['title']}"
    place += "" if task.faults == NO_FAULTS else f" with {str(task.faults).replace(',', ', ')}"
    words = [*where.split("/"), policy.algorithm, activation, str(policy.seed)] if where else []
    return {
        "key": "-".join(words or [policy.algorithm, activation, str(policy.seed)]),
        "title": f"{title}{place}" + (f" ({where})" if where else ""),
        "told": f"{frames:,} frames of training{place}; {how}.",
        "task": name_of(task),
        "algorithm": policy.algorithm,
        "activation": activation,
        "acts": policy.acts,
        "epsilon": policy.epsilon,
        "shown": ALGORITHMS[policy.algorithm].shown,
        "head": policy.head,
        "layer_norm": any(getattr(layer, "layer_norm", False) for layer in policy.network.children()),
        "sizes": [layers[0].weight.shape[1], *(layer.weight.shape[2] for layer in layers)],
        "weights": base64.b64encode(numbers).decode(),
    }


def page(found: Sequence[dict[str, Any]]) -> str:
    """The one HTML file, with policies as `collect` gives them."""
    data: dict[str, Any]
    metrics = [{"name": name, **METRICS[name]._asdict()} for name in paper.COLUMNS]
    settings = {name: one._asdict() for name, one in SETTINGS.items()}
    data = {"tasks": browser.constants(), "settings": settings, "worlds": WORLDS, "metrics": metrics}
    data |= {"policies": found, "set": FIRST_SET, "k": DEFAULT_K}
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    configurations = len({(one["algorithm"], one["activation"]) for one in found})
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, autoescape=True, trim_blocks=True)
    return environment.from_string((HERE / "playground.html").read_text(encoding="utf-8")).render(
        css=Markup(browser.joined([HERE / "playground.css"])),
        js=Markup(browser.joined([*browser.WORLD, *SCRIPTS])),
        data=Markup(text),
        metrics=metrics,
        settings=SETTINGS,
        worlds=WORLDS,
        world=World(),
        algorithms=" and ".join(dict.fromkeys(one["algorithm"].upper() for one in found)),
        told=f"It holds {len(found)} trained networks: {configurations} pairs of an algorithm and an "
        "activation.",
        version=importlib.metadata.version("uavnav"),
    )
