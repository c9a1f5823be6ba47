"""What each setting of a run means: said once, beside it. Nothing here imports more than Python's own."""

from __future__ import annotations

import types
from collections.abc import Sequence
from dataclasses import MISSING, Field, field, fields
from typing import Any, Literal, NamedTuple, get_args, get_origin, get_type_hints


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
