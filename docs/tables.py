"""Write the tables of docs/commands.md and docs/algorithms.md, from the code (`python docs/tables.py`)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from uavnav.algorithms import ALGORITHMS
from uavnav.cli import commands
from uavnav.report.docs import between_marks
from uavnav.settings import lines, shown
from uavnav.training.config import TrainConfig

Configs = Mapping[str, type[TrainConfig]]
"""By the algorithm's name."""


def command_table() -> str:
    """A row for each command: its name, what it does, its example."""
    rows = ["| command | what it does | example |", "|---|---|---|"]
    for name, one in commands.COMMANDS.items():
        example = one.example or "train ppo preset=fast activation=relu"
        rows.append(f"| `{name}` | {one.what} | `uavnav {example}` |")
    return "\n".join(rows)


def settings_table(kinds: Configs) -> str:
    """The settings in which algorithms or their preset `fast` differ, a column an algorithm; then those that
    only some have, and those that are the same in all.
    """
    defaults = {name: {line.name: line.default for line in lines(kind)} for name, kind in kinds.items()}
    every = dict.fromkeys(key for own in defaults.values() for key in own)
    rows, same = [f"| key | {' | '.join(map(str.upper, kinds))} |", f"|---|{'---|' * len(kinds)}"], []
    only: dict[str, list[str]] = {}
    for key in every:
        cells = {name: _cell(defaults[name].get(key), kind, key) for name, kind in kinds.items()}
        owners = [name.upper() for name in kinds if cells[name]]
        one, *others = {cell for cell in cells.values() if cell}
        if others:
            rows.append(f"| `{key}` | {' | '.join(cells.values())} |")
        elif len(owners) < len(kinds):
            only.setdefault(" and ".join(filter(None, [", ".join(owners[:-1]), owners[-1]])), []).append(
                f"`{key}={one}`"
            )
        else:
            same.append(f"`{key}={one}`")
    part = [f"- Only {owners}: {', '.join(keys)}." for owners, keys in only.items()]
    return "\n".join([*rows, "", *part, "", f"The same in all: {', '.join(same)}."])


def preset_table(kinds: Configs) -> str:
    """The presets other than the default and `fast`, and what each sets."""
    sets: dict[tuple[str, str], list[str]] = {}
    for name, kind in kinds.items():
        for preset in kind.PRESETS:
            given = kind.PRESETS[preset]
            if given and preset != "fast":
                words = ", ".join(f"`{key}={shown(value)}`" for key, value in given.items())
                sets.setdefault((preset, words), []).append(name.upper())
    return "\n".join(
        f"- `{preset}` of {', '.join(names)}: {words}." for (preset, words), names in sets.items()
    )


def _cell(default: str | None, kind: type[TrainConfig], key: str) -> str:
    """A default, and what the preset `fast` sets instead."""
    if default is None:
        return ""
    fast = kind.PRESETS["fast"].get(key)
    return default if fast is None or shown(fast) == default else f"{default}→{shown(fast)}"


def main() -> None:
    """Replace each table between its marks."""
    kinds = {name: algorithm.config for name, algorithm in ALGORITHMS.items()}
    for name, block, table in (
        ("commands", "commands", command_table()),
        ("algorithms", "settings", settings_table(kinds)),
        ("algorithms", "presets", preset_table(kinds)),
    ):
        page = Path(__file__).parent / f"{name}.md"
        page.write_text(
            between_marks(page.read_text(encoding="utf-8"), table, page.name, block), encoding="utf-8"
        )


if __name__ == "__main__":
    main()
