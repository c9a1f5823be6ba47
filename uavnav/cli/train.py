"""From a command line to training runs: the one place where Hydra lives."""

from __future__ import annotations

import itertools
import json
import math
import re
import shlex
import sys
import types
from collections.abc import Sequence
from dataclasses import asdict, fields
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, RangeSweep
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from uavnav import plugins
from uavnav.algorithms import ALGORITHMS
from uavnav.cli import commands, help
from uavnav.errors import ConfigError, complain, told, unknown, unknown_key
from uavnav.evaluation import evaluate_run, summary, usual_files
from uavnav.runs import Run
from uavnav.runs.policies import Diverged, PolicyError
from uavnav.runs.tables import RunError
from uavnav.tasks.faults import Faults
from uavnav.tasks.layouts import LayoutError
from uavnav.tasks.simulator import TASKS
from uavnav.tasks.world import World
from uavnav.training.config import TrainConfig, checked, part_keys
from uavnav.training.loggers import chosen
from uavnav.training.loop import Fit, alone, train
from uavnav.training.recorder import Interrupted, Recorder

MOST_CELLS = 1_000
"""Runs of a sweep."""
MOST_BRACKETS = 50
"""That are open at once in a setting."""
HERE = tuple(line.name for line in help.of_command())
"""The keys of the command itself; all others are fields of the algorithm's configuration."""


class Order(NamedTuple):
    """A run to train."""

    config: TrainConfig
    out: Path
    here: dict[str, Any]  # the keys of the command


def main(argv: Sequence[str] | None = None, fit: Fit = alone) -> int:
    """Train once, or once for each combination of a `-m` sweep, after every one of them was checked.

    fit: as of `uavnav.training.loop.train`.
    """
    given = commands.parse("train", argv)
    try:
        plugins.load(given.plugins)
        if given.algorithm not in ALGORITHMS:
            raise unknown("algorithm", given.algorithm, ALGORITHMS)
        kind: type[TrainConfig] = ALGORITHMS[given.algorithm].config
        if given.help:
            print(help.render(kind, _world(given.settings) or World, Faults), end="")
            return 0
        settings = [_composed(kind, words) for words in _cells(kind, given.settings, given.multirun)]
        orders = [_order(kind, one) for one in settings]
        if given.cfg:
            print("\n---\n".join(OmegaConf.to_yaml(one).strip() for one in settings))
            return 0
        _check(orders)
        finished = []
        for order in orders:
            try:
                finished.append(_train(order, given.quiet or given.json, fit))
            except Diverged as error:  # the others of a sweep are trained all the same
                complain("train", error)
        if given.json:
            print(json.dumps([summary.record(run) for run in finished], indent=2))
        elif not given.quiet and finished and finished[-1].fresh:
            print(_next(finished[-1], given.plugins))
    except Interrupted as stop:
        print(stop, file=sys.stderr)
        return 128 + stop.signum
    except (HydraException, OmegaConfBaseException) as error:
        complain("train", _one_line(error, kind))
        return 2
    except ConfigError as error:
        complain("train", f"{error}{commands.needs(given.algorithm, given.settings)}")
        return 2
    except (LayoutError, PolicyError, RunError) as error:
        complain("train", error)
        return 2
    return 0 if len(finished) == len(orders) else 2


def _world(settings: Sequence[str]) -> type[World] | None:
    """The world of the task that a command line names; None for several tasks, or one that there is not."""
    tasks = commands.names_in(settings, "task") or [TrainConfig.task]
    return TASKS[tasks[0]].WORLD if len(tasks) == 1 and tasks[0] in TASKS else None


# -- settings --------------------------------------------------------------------------------------------------------


def _cells(kind: type[TrainConfig], settings: Sequence[str], multirun: bool) -> list[list[str]]:
    """The words of each run: with `-m` every combination of the values of keys that have several."""
    # a task of its own may have other fields than the world that Hydra knows: the configuration checks them
    words = [f"++{word}" if word.startswith("world.") else word for word in settings]
    overrides = [_parsed(word) for word in words]
    for name in (one.key_or_group for one in overrides):
        if name.startswith("hydra"):  # that it has settings of its own is nobody's business
            raise unknown_key(name, _keys(kind))
    several = [one.key_or_group for one in overrides if one.is_sweep_override()]
    if several and not multirun:
        raise ConfigError(f"{several[0]}: give one value, or -m to train with each in turn")
    values = [_values(one) for one in overrides]
    if (cells := math.prod(map(len, values))) > MOST_CELLS:
        raise ConfigError(f"{several[0]}: the sweep has {cells:,} runs; give at most {MOST_CELLS:,}")
    return [list(cell) for cell in itertools.product(*values)]


def _parsed(word: str) -> Override:
    """A setting as Hydra reads it."""
    depths = itertools.accumulate((one in "[{(") - (one in ")}]") for one in word)
    if max(depths, default=0) > MOST_BRACKETS:  # a list in a list in a list: more than Python's stack may hold
        raise ConfigError(f"{told(word)}: its value cannot be read; give a shorter one")
    try:
        return OverridesParser.create().parse_overrides([word])[0]
    except (RecursionError, ValueError) as error:  # a number of thousands of digits
        raise ConfigError(f"{told(word)}: its value cannot be read; give a shorter one") from error


def _values(override: Override) -> list[str]:
    """The words of a setting, one a value."""
    if not override.is_sweep_override():
        return [override.input_line or ""]
    swept = override.value()
    try:
        if isinstance(swept, RangeSweep) and (swept.stop - swept.start) / swept.step > MOST_CELLS:
            raise ConfigError(f"{override.input_line}: the sweep is too long; give at most {MOST_CELLS:,} values")
        return [f"{override.get_key_element()}={value}" for value in override.sweep_string_iterator()]
    except ArithmeticError as error:
        raise ConfigError(f"{override.input_line}: it is no range; give range(start,stop,step)") from error


def _composed(kind: type[TrainConfig], words: list[str]) -> DictConfig:
    """Everything that a run is set to, preset and defaults included."""
    world = _world(words)
    task = next(iter(commands.names_in(words, "task") if world else ()), TrainConfig.task)
    for name in kind.PRESETS:
        node = kind.usual(name, task) | {"world": asdict(world()) if world else {}}
        ConfigStore.instance().store(group="preset", name=name, node=node, package="_global_")
    try:
        with initialize_config_dir(str(help.COMMAND.parent), version_base="1.3"):
            return compose(help.COMMAND.stem, words)
    except HydraException:
        raise
    except (OSError, TypeError, ValueError) as error:  # Hydra looks for files of names that are none
        named = next((word for word in words if word.lstrip("+").startswith("preset=")), None)
        if named is not None:
            raise unknown("preset", named.partition("=")[2], kind.PRESETS) from error
        raise ConfigError(
            f"{told(' '.join(words))}: cannot be read; settings are key=value: activation=tanh"
        ) from error


def _order(kind: type[TrainConfig], settings: DictConfig) -> Order:
    """The run that the settings describe; a ConfigError where they cannot be."""
    values: dict[str, Any] = OmegaConf.to_container(settings, resolve=True)
    for key in HERE:
        if key not in values:
            raise ConfigError(f"~{key}: it cannot be left out; give {key}=...")
    here = {key: values.pop(key) for key in HERE}
    for key in ("overwrite", "evaluate"):
        checked(key, here[key], bool, {})
    if here["checkpoint_seconds"] != math.inf:  # no snapshot but that of a stop
        checked("checkpoint_seconds", here["checkpoint_seconds"], float, {"least": 0})
    if not isinstance(here["out"], (str, int, float, types.NoneType)):
        raise ConfigError(f"out={told(here['out'])}; give a folder")
    chosen(here["logger"])
    config = kind.from_mapping(values)
    return Order(config, config.folder if here["out"] is None else Path(str(here["out"])), here)


def _check(orders: Sequence[Order]) -> None:
    """Raise a RunError where a folder cannot be used, before any run begins."""
    folders: set[Path] = set()
    for config, out, here in orders:
        Recorder(out, config, here["overwrite"])
        if out.resolve() in folders:
            raise RunError(
                f"out={out}: two runs of the sweep would share it; name what differs, as"
                " out='runs/${activation}-${seed}'"
            )
        folders.add(out.resolve())


def _one_line(error: Exception, kind: type[TrainConfig]) -> str:
    """Hydra's complaint as one line with the choices."""
    if isinstance(error, MissingConfigException) and (error.missing_cfg_file or "").startswith("preset/"):
        return str(unknown("preset", (error.missing_cfg_file or "").removeprefix("preset/"), kind.PRESETS))
    if isinstance(error, OverrideParseException):
        return f"{error.override}: its value cannot be read; in a shell quote brackets and blanks: 'hidden=[64,64]'"
    key = re.match(r"Could not override '([^']+)'", str(error))
    if key:
        return str(unknown_key(key[1], _keys(kind)))
    return str(error).strip().splitlines()[0]


def _keys(kind: type[TrainConfig]) -> list[str]:
    """Every key that a command line may set."""
    return [*(item.name for item in fields(kind)), *part_keys(), *HERE]


# -- a run -----------------------------------------------------------------------------------------------------------


def _train(order: Order, quiet: bool, fit: Fit) -> Run:
    """Train, show the table, and fly the test split."""
    config, out, here = order
    how = {key: here[key] for key in ("overwrite", "checkpoint_seconds", "logger")}
    finished = train(config, out=out, quiet=quiet, **how, fit=fit)
    plugins.warn_of_changed(finished.path, finished.meta.get("plugins", {}))
    if not quiet and finished.fresh:
        summary.report(finished)
    elif not quiet:
        print(f"{out}: this run is already finished; overwrite=true starts it anew")
    if here["evaluate"] and not (finished.path / usual_files(finished)[0]).exists():
        if not quiet:
            print("evaluating on the test split; evaluate=false skips this", flush=True)
        rows = evaluate_run(finished, quiet=quiet)
        if not quiet:
            summary.show(summary.of_evaluation(rows, finished))
    return finished


def _next(finished: Run, names: Sequence[str]) -> str:
    """What to do with a run next, with the very commands; names: of the plugins that it needs."""
    run = finished.path
    with_plugins = ["--plugins", ",".join(names)] if names else []
    watch = ["uavnav", "play" if find_spec("pygame") else "render", str(run), *with_plugins]
    root = str(run) if run.is_absolute() or run.parts[:1] in ((), ("..",)) else run.parts[0]
    compare = ["uavnav", "report", root, "--out", "report", *with_plugins]
    return f"watch it:    {shlex.join(watch)}\ncompare it:  {shlex.join(compare)}"
