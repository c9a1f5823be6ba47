"""The help of each algorithm: what its settings mean, as `uavnav train ALGORITHM --help` shows it.

`python -m uavnav.cli.help` writes that text for each algorithm of the package into this folder, where it is found
without torch. Nothing here imports more than the standard library.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from uavnav.settings import Line, lines, shown

HERE = Path(__file__).parent
COMMAND = HERE / "train.yaml"
"""The keys of the command itself, each with its meaning behind it."""

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


def of_command() -> list[Line]:
    """The keys of the command itself."""
    found = []
    for line in COMMAND.read_text(encoding="utf-8").splitlines():
        name, _, rest = line.partition(": ")
        if name.isidentifier() and " # " in rest:
            default, _, meaning = rest.partition(" # ")
            found.append(Line(name, default, "", meaning))
    return found


def render(kind: type, world: type, faults: type) -> str:
    """The help of an algorithm, from the class of its configuration, that of its world and that of faults."""
    name, presets = kind.algorithm, kind.PRESETS  # type: ignore[attr-defined]
    parts = {"world": world, "faults": faults}  # whose fields have lines of their own
    settings = [line for line in lines(kind) if line.name not in parts]
    width = max(len(one) for one in presets)
    sets = {one: " ".join(f"{key}={shown(value)}" for key, value in given.items()) for one, given in presets.items()}
    return TEXT.format(
        name=name,
        title=(kind.__doc__ or "").partition("\n")[0],
        settings=_table(settings),
        presets="\n".join(f"  {one:{width}}  {given or 'nothing'}" for one, given in sets.items()),
        **{name: _table(lines(part, f"{name}.")) for name, part in parts.items()},
        command=_table(of_command()),
    )


def _table(found: Sequence[Line]) -> str:
    """A line a key."""
    heads = [f"{line.name}={line.default}" for line in found]
    width = max(map(len, heads))
    units = [f"[{line.unit}] " if line.unit else "" for line in found]
    parts = zip(heads, units, found, strict=True)
    return "\n".join(f"  {head:{width}}  {unit}{line.meaning}".rstrip() for head, unit, line in parts)


def text_of(algorithm: str) -> Path:
    """Where the help of an algorithm of the package is; a plugin's has none."""
    return HERE / f"{algorithm}.txt"
