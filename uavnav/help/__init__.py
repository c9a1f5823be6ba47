"""What each key of a run means: said once, beside the key, and shown by `uavnav train ALGORITHM --help`.

`python -m uavnav.train.help` writes that text for each algorithm of the package into this folder, where it is found
without torch. Nothing here imports more than the standard library.
"""

from __future__ import annotations

import types
from collections.abc import Sequence
from dataclasses import MISSING, Field, field, fields
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

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


def key(default: Any, what: str = "", unit: str = "", **limits: Any) -> Any:
    """A field of a configuration: its default, meaning, unit and limits (`choices`, `least`, `most`)."""
    return field(default=default, metadata={"what": what, "unit": unit, **limits})


class Line(NamedTuple):
    """What is said of a key."""

    name: str
    default: str  # as on a command line
    unit: str
    meaning: str  # with the choices


def lines(kind: type, prefix: str = "") -> list[Line]:
    """Every field of a configuration or of a world; one that says nothing means what it meant in the class before."""
    hints, found = get_type_hints(kind), []
    for item in fields(kind):
        facts = _facts(kind, item)
        meaning = "; ".join(filter(None, (facts.get("what", ""), _allowed(kind, hints[item.name], item))))
        found.append(Line(prefix + item.name, shown(item.default), facts.get("unit", ""), meaning))
    return found


def _facts(kind: type, item: Field[Any]) -> Any:
    """The metadata of a field, from the class that last said what it means."""
    for owner in kind.__mro__:
        there = getattr(owner, "__dataclass_fields__", {}).get(item.name)
        if there is not None and there.metadata.get("what"):
            return there.metadata
    return item.metadata


def _allowed(kind: type, hint: Any, item: Field[Any]) -> str:
    """`relu, tanh`, `at least 1`, `0 to 1 or null`: what a value may be, where that is more than its type."""
    null = " or null" if isinstance(hint, types.UnionType) else ""
    limits = item.metadata
    choices: Sequence[str] = get_args(hint) if get_origin(hint) is Literal else limits.get("choices", ())
    choices = ("false", "true") if hint is bool else getattr(kind, "PRESETS", ()) if item.name == "preset" else choices
    if choices:
        return ", ".join(sorted(choices)) + null
    if "most" in limits:
        return f"{shown(limits['least'])} to {shown(limits['most'])}{null}"
    return f"at least {shown(limits['least'])}{null}" if "least" in limits else null and f"a number{null}"


def shown(value: Any) -> str:
    """A value as a command line gives it."""
    if value is None or value is MISSING:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return f"[{','.join(map(shown, value))}]"
    return str(value)


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
