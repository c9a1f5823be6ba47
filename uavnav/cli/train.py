"""From a command line to training runs: one for each combination of what `key=value` words set."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import re
import shlex
import signal
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import yaml
from pydantic import BeforeValidator

from uavnav import files, plugins
from uavnav.algorithms import ALGORITHMS
from uavnav.cli import commands
from uavnav.cli.help.render import render
from uavnav.errors import ConfigError, complain, told, unknown, unknown_key
from uavnav.evaluation import MAX_STEPS, Protocol, evaluate_run, summary
from uavnav.runs import Run
from uavnav.runs.policies import Diverged, load_policies
from uavnav.runs.tables import RunError
from uavnav.settings import Seconds, Settings, flat, key, shown
from uavnav.tasks.table import TASKS
from uavnav.tasks.world import World
from uavnav.training.config import PARTS, TASK, TrainConfig, plain
from uavnav.training.loggers import chosen, shown_by
from uavnav.training.loop import Fit, alone, train
from uavnav.training.recorder import CHECKPOINT_SECONDS, Interrupted, Recorder, free_folder
from uavnav.views.browser.playground import shows

MOST_CONFIGURATIONS = 1_000  # runs of a sweep
MOST_COMPARED = 4  # the newest runs of a sweep, in the command that compares them


def _folder(value: Any) -> Any:
    if not isinstance(value, str | None) or value == "":
        raise ConfigError(f"out={told(value)}; give a folder")
    return value


Folder = Annotated[str | None, BeforeValidator(_folder)]


class Command(Settings):
    """The keys of the command itself; all others are fields of the algorithm's configuration."""

    out: Folder = key(None, "the run's folder; null is runs/ALGORITHM-PRESET/ACTIVATION, and what differs")
    overwrite: bool = key(False, "start anew if the folder already contains a run")
    checkpoint_seconds: Seconds = key(CHECKPOINT_SECONDS, "the shortest time between two snapshots")
    evaluate: bool = key(True, "fly 200 test layouts after training, once greedily and once as in training")
    plugins: Any = key(None, "my_module or [one,other]: modules of your own, imported first")
    logger: Any = key(
        "none", "live logs in the run's folder; none, tensorboard, wandb, or [tensorboard,wandb]"
    )

    def check(self) -> None:
        chosen(self.logger)


class Order(NamedTuple):
    config: TrainConfig
    out: Path
    command: Command


def main(given: Namespace, fit: Fit = alone) -> int:
    """Train once, or once for each combination of a `-m` sweep, after every one of them was checked.

    fit: as of `uavnav.training.loop.train`.
    """
    try:
        if given.algorithm not in ALGORITHMS:
            raise unknown("algorithm", given.algorithm, ALGORITHMS)
        kind: type[TrainConfig] = ALGORITHMS[given.algorithm].config
        if given.help:
            print(render(kind, _world(given.settings), Command), end="")
            return 0
        orders = [_order(kind, settings) for settings in _sweep(given.settings, given.multirun)]
        if given.cfg:
            said = (plain(one.config) | one.command.model_dump() for one in orders)
            print("---\n".join(yaml.safe_dump(one, sort_keys=False) for one in said), end="")
            return 0
        _check(orders)
        finished = []
        for order in orders:
            try:
                finished.append(_train(order, given.quiet or given.json, fit))
            except Diverged as error:  # the others of a sweep are trained all the same
                complain("train", error)
    except ConfigError as error:
        raise ConfigError(f"{error}{commands.needs(given.algorithm, given.settings)}") from error
    if given.json:
        print(json.dumps([summary.record(run) for run in finished], indent=2))
    elif not given.quiet:
        if len(finished) == len(orders) and finished[-1].fresh:
            print(_next(finished, orders[-1], given.plugins))
        for run in finished:
            for shown in shown_by(run.path, chosen(orders[0].command.logger)):
                print(f"see its log: {shown}")
    return 0 if len(finished) == len(orders) else 2


def _world(settings: Sequence[str]) -> type[World]:
    """The world of the task that a command line names; the paper's where it names none or several."""
    tasks = commands.names_in(settings, "task")
    return TASKS[tasks[0] if len(tasks) == 1 and tasks[0] in TASKS else TASK].WORLD


# -- settings ------------------------------------------------------------------------------------------------


def _sweep(words: Sequence[str], multirun: bool) -> list[dict[str, Any]]:
    """The settings of each run: with `-m` every combination of the values of keys that have several."""
    values: dict[str, Sequence[Any]] = {}
    for word in words:
        name, _, text = word.lstrip("+").partition("=")
        values[name] = [text] if name == "plugins" else _values(word, text)  # all of them at once
    several = [name for name, found in values.items() if len(found) > 1]
    if several and not multirun:
        raise ConfigError(f"{several[0]}: give one value, or -m to train with each in turn")
    if (runs := math.prod(map(len, values.values()))) > MOST_CONFIGURATIONS:
        raise ConfigError(f"{several[0]}: the sweep has {runs:,} runs; give at most {MOST_CONFIGURATIONS:,}")
    return [dict(zip(values, chosen, strict=True)) for chosen in itertools.product(*values.values())]


def _values(word: str, text: str) -> Sequence[Any]:
    """The values in a setting's text: of `relu,tanh` two, of range(0,3) three."""
    if not text.startswith("range("):
        return [value_of(word, part) for part in _parts(text)]
    try:
        values = range(*map(int, text.removeprefix("range(").removesuffix(")").split(",")))
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{told(word)}: it is no range; give range(start,stop,step)") from error
    if not values or values[MOST_CONFIGURATIONS:]:
        raise ConfigError(
            f"{told(word)}: the sweep is empty or too long; give at most {MOST_CONFIGURATIONS:,} values"
        )
    return values


def _parts(text: str) -> list[str]:
    """A text split at its commas, but for those in brackets and quotes."""
    parts, depth, quote = [""], 0, ""
    for one in text:
        if quote or one in "'\"":
            quote = "" if one == quote else quote or one
        else:
            depth += (one in "[{") - (one in "]}")
        if one == "," and not quote and not depth:
            parts.append("")
        else:
            parts[-1] += one
    return parts


def value_of(word: str, text: str) -> Any:
    """A number, true, false, null, a list or a mapping as in YAML; anything else is text."""
    if text[:1] in ("'", '"') and text[1:].endswith(text[0]):
        return text[1:-1]
    if text[:1] in ("[", "{", "'", '"'):
        try:
            return files.parsed_yaml(text)
        except ValueError as error:
            raise ConfigError(
                f"{told(word)}: its value cannot be read; in a shell quote brackets and blanks: "
                "'hidden=[64,64]'"
            ) from error
    if word.lstrip("+").startswith("out="):  # 007 is a folder's name
        return None if text == "null" else text
    for number in (int, float):
        with contextlib.suppress(ValueError):
            return number(text)
    return {"null": None, "true": True, "false": False}.get(text.lower(), text)


def _order(kind: type[TrainConfig], settings: dict[str, Any]) -> Order:
    """The run that the settings describe; a ConfigError where they cannot be."""
    known = [*kind.names(), *Command.names()]
    for name in settings:
        if name not in known and name.partition(".")[0] not in PARTS:
            raise unknown_key(name, known)
    command = Command(**{name: settings.pop(name) for name in Command.names() if name in settings})
    config = kind.from_mapping(settings)
    if command.out is None:
        return Order(config, free_folder(config), command)
    return Order(config, Path(_filled(command.out, flat(plain(config) | command.model_dump()))), command)


def _filled(out: str, settings: dict[str, Any]) -> str:
    """A folder's name whose `${activation}` are filled in."""

    def value(found: re.Match[str]) -> str:
        if found[1] not in settings:
            raise unknown_key(found[1], settings)
        return shown(settings[found[1]])

    return re.sub(r"\$\{([\w.]+)\}", value, out)


def _check(orders: Sequence[Order]) -> None:
    """Raise a RunError where a folder cannot be used, before any run begins."""
    folders: set[Path] = set()
    for config, out, command in orders:
        Recorder(out, config, command.overwrite)
        if out.resolve() in folders:
            raise RunError(
                f"out={out}: two runs of the sweep would share it; name what differs, as"
                " out='runs/${activation}-${seed}'"
            )
        folders.add(out.resolve())


# -- a run ---------------------------------------------------------------------------------------------------


def _train(order: Order, quiet: bool, fit: Fit) -> Run:
    config, out, command = order
    how = {name: getattr(command, name) for name in ("overwrite", "checkpoint_seconds", "logger")}
    finished = train(config, out=out, quiet=quiet, fit=fit, **how)
    plugins.warn_of_changed(finished.path, finished.meta.get("plugins", {}))
    if not quiet and finished.fresh:
        summary.report(finished)
    elif not quiet:
        print(f"{out}: this run is already finished; overwrite=true starts it anew")
    if not command.evaluate:
        load_policies(finished.path)  # one that diverged ends in its line
    protocol = Protocol(max_steps=TASKS[config.task].limit(MAX_STEPS))
    if command.evaluate and not (finished.path / protocol.file("evaluation")).exists():
        if not quiet:
            print("evaluating on the test split; evaluate=false skips this", flush=True)
        try:
            rows = evaluate_run(finished, quiet=quiet)
        except KeyboardInterrupt:
            told = f"{out}: trained, not evaluated; the same command evaluates it"
            raise Interrupted(told, signal.SIGINT, finished.frames, wanted=False) from None
        if not quiet:
            summary.show(summary.of_evaluation(rows, finished))
            print(summary.verdict(rows, config))
    return finished


def _next(runs: Sequence[Run], order: Order, names: Sequence[str]) -> str:
    """What to do next with the newest run, in commands that run as they stand; names: of plugins."""
    paths = [str(run.path) for run in runs]
    with_plugins = ["--plugins", ",".join(names)] if names else []
    longer = order.config.replace(total_frames=2 * order.config.total_frames)
    given = {"preset": longer.preset, "activation": longer.activation, **longer.changes()}
    given["total_frames"] = longer.total_frames
    if order.command.out is not None:
        given["out"] = str(order.out.parent / f"{order.out.name or 'run'}-{longer.total_frames}")
    if names:
        given["plugins"] = names[0] if len(names) == 1 else [*names]
    commands = {
        "watch it": ["play" if shows(runs[-1].path) else "render", paths[-1], *with_plugins],
        "compare it": ["compare", *paths[-MOST_COMPARED:], "reactive", *with_plugins],
        "train anew": [
            "train",
            longer.algorithm,
            *(f"{name}={shown(value)}" for name, value in given.items()),
        ],
    }
    return "\n".join(f"{what + ':':14}{shlex.join(['uavnav', *words])}" for what, words in commands.items())
