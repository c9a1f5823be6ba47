"""What runs in a browser: the tasks and their drawing, one home each, without a build step or a framework.

`world.js` is the tasks, compared with Python's by tests/test_playground.py, `layouts.js` their obstacles;
`drawing.js` draws them, in 3D the views of `box.js`. `replay.js` plays recorded episodes on a report, and the
folder `playground` flies live. A page contains the scripts that it needs, one after the other.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import torch
from markupsafe import Markup

from uavnav.tasks import baselines, classics, goal, slalom
from uavnav.tasks.dynamics import decode
from uavnav.tasks.space import SpaceWorld
from uavnav.tasks.space import decode as decode_in_3d
from uavnav.tasks.table import TASKS
from uavnav.tasks.world import World

HERE = Path(__file__).parent
WORLD = (HERE / "world.js", HERE / "layouts.js", HERE / "drawing.js")
"""What every page with a drone needs, in the order in which a browser reads it."""

PLAYER = (*WORLD, HERE / "box.js", HERE / "replay.js")  # what a page with recorded episodes needs
STYLES = (HERE / "replay.css", HERE / "values.css")
"""Its looks."""
VALUES = jinja2.Template((HERE / "values.html").read_text(encoding="utf-8"), autoescape=True)

SLALOM = {name: getattr(slalom, name.upper()) for name in ("columns", "radius", "spacing", "height")}
GOAL = {name: getattr(goal, name.upper()) for name in ("room", "far", "grid", "tries", "scale")}
GOAL |= {"bearings": classics.SECTORS.tolist(), "look": baselines.LOOK, "spare": baselines.ROOM}
MOVING: dict[str, Any] = {"body": baselines.BODY, "drift": baselines.DRIFT, "enough": baselines.ENOUGH}
MOVING["ways"] = [
    ([[round(part, 4) for part in place] for place in places.tolist()], int(first), round(float(worth), 4))
    for places, first, worth in zip(baselines.PLACES, baselines.FIRST, baselines.WORTH, strict=True)
]
CLASSICS: dict[str, dict[str, Any]] = {
    one.__name__: {name: of.default for name, of in [*inspect.signature(one).parameters.items()][3:]}
    for one in (classics.apf, classics.vfh)
}
CLASSICS["vfh"] |= {"sectors": classics.SECTORS.tolist(), "aside": classics.ASIDE}
NEEDS: dict[str, dict[str, Any]] = {"slalom": SLALOM, "moving": MOVING, "goal": GOAL}
"""What a task's layouts and its scripted policy need, besides its constants."""
TITLES = {"drone": "the paper's task", "slalom": "slalom", "moving": "moving obstacles", "goal": "a goal"}
"""How pages call the tasks of `world.js`."""
IN_3D = {"space": "a box in 3D", "space-moving": "a box in 3D, moving spheres"}
"""The same of those that pages show in replays and do not fly."""


def constants(worlds: Mapping[str, World]) -> dict[str, dict[str, Any]]:
    """What `world.js` needs of each task, by its name there: constants, the time limit, and `NEEDS`."""
    return {
        name: {
            "world": world.model_dump(),
            "max_steps": TASKS.get(name, TASKS["drone"]).MAX_STEPS,
            "needs": NEEDS.get(name, {}) | {"classics": CLASSICS},
        }
        for name, world in worlds.items()
    }


def placed(layouts: Sequence[Sequence[list[float]]], has_goal: bool) -> list[dict[str, Any]]:
    """Layouts, given by rows, as `world.js` has them: circles or spheres, and the goal (the last row)."""
    if has_goal:
        return [{"circles": rows[:-1], "goal": rows[-1][:2]} for rows in layouts]
    return [{"circles": [row for row in rows if row != [*slalom.NOWHERE]]} for rows in layouts]


def actions(world: World | SpaceWorld) -> list[list[int]]:
    """What each action of a world does: turn [degrees] and distance [px], in 3D yaw, pitch and distance."""
    every = torch.arange(world.n_actions)
    parts = decode_in_3d(every, world) if isinstance(world, SpaceWorld) else decode(every, world)
    return torch.stack([*parts], -1).tolist()


def picture(actions: Sequence[Sequence[int]]) -> Markup:
    """The inside of a picture of one value for each action, whose squares `showValues` of drawing.js colours.

    Left turns are to the left, and the longer way is the higher; in 3D so in each pitch.
    """
    turns, ways = (sorted({one[part] for one in actions}, reverse=True) for part in (0, -1))
    pitches = sorted({one[1] for one in actions if len(one) > 2}, reverse=True)
    places = []
    for turn, *pitch, way in actions:
        row = ways.index(way) + sum(len(ways) * pitches.index(one) for one in pitch)
        places.append((row + 1, turns.index(turn) + 1))
    return Markup(VALUES.render(turns=turns, pitches=pitches, ways=ways, places=places))


def as_json(data: Any) -> Markup:
    """Data as a page's script contains it: no text of theirs can end the script."""
    return Markup(json.dumps(data, separators=(",", ":")).replace("<", "\\u003c"))


def joined(paths: Sequence[Path]) -> str:
    """Scripts or styles as one text."""
    return "".join(path.read_text(encoding="utf-8") for path in paths)
