"""A user's own modules, which add activations, rewards, tasks and algorithms to the tables.

A plugin is imported because the user names it: `plugins=my_module` to `uavnav train`, `--plugins my_module`
to another command, `uavnav.plugins.load(["my_module"])` in Python. No file of a run can have one imported.
"""

from __future__ import annotations

import hashlib
import importlib
import os
import sys
import warnings
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from uavnav import networks
from uavnav.errors import ConfigError
from uavnav.tasks import rewards
from uavnav.tasks import table as tasks

LOADED: dict[str, str] = {}
"""The plugins of this process: name -> SHA-256 of its file, or of all files of a package."""

TABLES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "activation": (networks.ACTIVATIONS, networks.KNOWN),
    "reward": (rewards.REWARDS, rewards.KNOWN),
    "task": (tasks.TASKS, tasks.KNOWN),
}
"""By the setting that names a line: the table, and the lines that every process of a run has."""


def load(names: str | Sequence[str] | None) -> None:
    """Import modules by name, one or several, each once, from the present folder or from where Python finds
    modules.

    Raises:
        ConfigError: there is no such module, it cannot be imported, or it gives a name that is there another
            meaning.
    """
    wanted = [names] if isinstance(names, str) else list(names or ())
    if wanted and os.getcwd() not in sys.path and "" not in sys.path:
        sys.path.insert(0, os.getcwd())
    for name in wanted:
        if name in LOADED:
            continue
        if "/" in name or not all(name.split(".")):
            raise ConfigError(f"plugins={name}: is no module's name; give one, such as my_module")
        before, modules = [dict(table) for table, _ in TABLES.values()], {*sys.modules}
        try:
            module = _imported(name)
            added = [_added(name, setting, old) for setting, old in zip(TABLES, before, strict=True)]
        except ConfigError:  # nothing of it stays, so that it can be mended and loaded again
            for (table, _), old in zip(TABLES.values(), before, strict=True):
                table.clear()
                table |= old
            for one in {*sys.modules} - modules:
                if one == name or one.startswith(f"{name}."):
                    del sys.modules[one]
            raise
        for (_, known), new in zip(TABLES.values(), added, strict=True):
            known |= new
        LOADED[name] = _sha256(module)


def _imported(name: str) -> ModuleType:
    """A module by name; raises a ConfigError where it cannot be imported."""
    try:
        return importlib.import_module(name)
    except (Exception, SystemExit) as error:  # whatever a user's module raises
        if isinstance(error, ModuleNotFoundError) and error.name == name:
            where = f"is no module in {os.getcwd()} or on PYTHONPATH"
            raise ConfigError(f"plugins={name}: {where}; give a module's name, without .py") from error
        problem = f"{type(error).__name__}: {error}".splitlines()[0]
        raise ConfigError(f"plugins={name}: cannot be imported ({problem})") from error


def _added(name: str, setting: str, before: Mapping[str, Any]) -> dict[str, Any]:
    """What a plugin has put into a table; raises a ConfigError where it takes a name that is there."""
    table, known = TABLES[setting]
    added = {key: value for key, value in table.items() if before.get(key) is not value}
    if taken := sorted(added.keys() & known.keys()):
        raise ConfigError(f"plugins={name}: {setting}={taken[0]} is there already; give yours another name")
    return added


def _sha256(module: ModuleType) -> str:
    """The hash of a module's file, or of all Python files of a package; empty without any."""
    folders = [Path(folder) for folder in getattr(module, "__path__", ())]
    files = [file for folder in folders for file in sorted(folder.rglob("*.py"))] or [
        Path(module.__file__ or "")
    ]
    code = b"".join(file.read_bytes() for file in files if file.is_file())
    return hashlib.sha256(code).hexdigest() if code else ""


def warn_of_changed(path: Path, noted: Mapping[str, str]) -> None:
    """Say which of a run's plugins are loaded, and are not what they were when it was trained."""
    for name, sha in noted.items():
        if LOADED.get(name, sha) != sha:
            warnings.warn(f"{path}: {name} is not what it was when this was trained", stacklevel=3)


def missing(noted: Mapping[str, str] | Collection[str]) -> str:
    """The end of a message: which plugins a run needs that were not given; empty where all are there."""
    absent = [name for name in noted if name not in LOADED]
    return (
        f"; it was made with plugins, give --plugins {','.join(absent)} (plugins= to uavnav train)"
        if absent
        else ""
    )
