"""The help of an algorithm, from the declarations of its settings."""

from __future__ import annotations

from collections.abc import Sequence

from uavnav.settings import Line, Settings, lines, shown
from uavnav.tasks.faults import Faults
from uavnav.tasks.world import World
from uavnav.training.config import PARTS, TrainConfig

TEXT = """usage: uavnav train {name} [KEY=VALUE ...] [-m] [--cfg job] [--quiet] [--json]

{title}

  uavnav train {name} activation=relu
  uavnav train {name} activation=tanh n_seeds=4 total_frames=1e6 out=runs/mine
  uavnav train {name} -m activation=relu,tanh    one run after the other, for each combination of values

Settings, with their defaults:

{settings}

Presets, and what they set instead:

{presets}

The world:

{world}

Faults:

{faults}

The command:

{command}

Flags:

  -m, --multirun    a key may have several values, as a,b or range(0,3): train with each combination
  -c, --cfg job     show every setting as these arguments set it, and train nothing
  --quiet           show nothing but errors
  --json            show the table at the end as JSON, and nothing else
"""


def render(kind: type[TrainConfig], world: type[World], command: type[Settings]) -> str:
    """The help of an algorithm, from its configuration's class, its `World`'s and the command's own keys."""
    width = max(len(one) for one in kind.PRESETS)
    presets = {
        name: " ".join(f"{key}={shown(value)}" for key, value in given.items())
        for name, given in kind.PRESETS.items()
    }
    return TEXT.format(
        name=kind.algorithm,
        title=(kind.__doc__ or "").partition("\n")[0],
        settings=_table([line for line in lines(kind) if line.name not in PARTS]),
        presets="\n".join(f"  {name:{width}}  {given or 'nothing'}" for name, given in presets.items()),
        world=_table(lines(world, "world.")),
        faults=_table(lines(Faults, "faults.")),
        command=_table(lines(command)),
    )


def _table(found: Sequence[Line]) -> str:
    heads = [f"{line.name}={line.default}" for line in found]
    width = max(map(len, heads))
    units = [f"[{line.unit}] " if line.unit else "" for line in found]
    parts = zip(heads, units, found, strict=True)
    return "\n".join(f"  {head:{width}}  {unit}{line.meaning}".rstrip() for head, unit, line in parts)
