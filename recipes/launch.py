"""From a command line to a training run: the one place where Hydra lives."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

heard = signal.getsignal(signal.SIGINT)
if heard is signal.default_int_handler:
    signal.signal(signal.SIGINT, lambda *_: os._exit(128 + signal.SIGINT))  # without a word, until the next lines
from uavnav.terminal import end_quietly

signal.signal(signal.SIGINT, heard)
end_quietly(Path(sys.argv[0]).stem)  # the imports that follow may be stopped too

import argparse
import importlib
import re
import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any, Literal, NoReturn, get_args, get_origin, get_type_hints

os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # let errors come here, to be said in one line

import hydra
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console

from uavnav import plugins
from uavnav.algorithms import ALGORITHMS
from uavnav.choices import ConfigError, did_you_mean, unknown, unknown_key
from uavnav.evaluate import evaluate_run
from uavnav.policies import PolicyError
from uavnav.runs import EVALUATION, LOG_FOLDERS
from uavnav.runs.tables import RunError
from uavnav.tasks.layouts import LayoutError
from uavnav.tasks.simulator import TASKS
from uavnav.tasks.world import World
from uavnav.training.config import TrainConfig, plain
from uavnav.training.display import evaluation_summary, report
from uavnav.training.loggers import NONE, chosen
from uavnav.training.loop import train
from uavnav.training.recorder import Interrupted, Recorder, default_folder

HERE = ("out", "overwrite", "checkpoint_seconds", "evaluate", "logger", "plugins")
"""The keys of the recipes themselves; all others are fields of the algorithm's configuration."""

Presets = Mapping[str, TrainConfig]

HELP = """{what}
These have names for values; {config} and {yaml} say more of each key.

{choices}

Everything, as these arguments set it:

$CONFIG
Flags besides -m: --cfg job shows the settings and runs nothing; --hydra-help lists Hydra's own.
"""

LAUNCHERS = "not installed; ray, submitit_local and submitit_slurm come with pip install 'uavnav[scale]'"

ERRORS = (ConfigError, LayoutError, PolicyError, RunError)


def launch(recipe: str) -> None:
    """Train once, or once for each combination of a `-m` sweep, after every one of them was checked.

    recipe: the name of an algorithm; or `train`, whose command line names one of them, or of a plugin.
    """
    words = sys.argv[1:]
    try:
        plugins.load(_given(words, "plugins"))
        algorithm = recipe
        if recipe == "train":
            words = [word for word in words if not word.startswith("algorithm=")]
            algorithm = next(iter(_given(sys.argv[1:], "algorithm")), "")
            if algorithm not in ALGORITHMS:
                raise unknown("algorithm", algorithm, ALGORITHMS)
        _launch(recipe, algorithm, words)
    except ERRORS as error:
        sys.exit(f"{recipe}: {error}")


def _given(words: Sequence[str], key: str) -> list[str]:
    """The names in `key=name` or `key=[one,other]` among the words of a command line."""
    values = [word.partition("=")[2] for word in words if word.startswith(f"{key}=")]
    names = [name.strip() for value in values for name in value.strip("[]").split(",")]
    return [name for name in names if name and name != "null"]


def _launch(recipe: str, algorithm: str, words: list[str]) -> None:
    presets: Presets = importlib.import_module(ALGORITHMS[algorithm].module).PRESETS
    store = ConfigStore.instance()
    tasks = _given(words, "task") or [TrainConfig.task]
    world = asdict(TASKS[tasks[0]].WORLD()) if len(tasks) == 1 and tasks[0] in TASKS else {}  # of a sweep: each its own
    for name, preset in presets.items():
        store.store(group="preset", name=name, node=plain(preset) | {"world": world}, package="_global_")
    kind = type(next(iter(presets.values())))
    help = {"app_name": algorithm, "header": "", "footer": "", "template": _help(recipe, algorithm, presets)}
    store.store(group="hydra/help", name="recipe", node=help)
    folders: set[Path] = set()

    def parse(settings: DictConfig) -> tuple[TrainConfig, Path, dict[str, Any]]:
        values: dict[str, Any] = OmegaConf.to_container(settings, resolve=True)
        here = {key: values.pop(key) for key in HERE}
        out, seconds = here["out"], here["checkpoint_seconds"]
        for key in ("overwrite", "evaluate"):
            if not isinstance(here[key], bool):
                raise ConfigError(f"{key}={here[key]}; choose from false, true")
        if isinstance(seconds, bool) or not isinstance(seconds, (int, float)) or not seconds >= 0:
            raise ConfigError(f"checkpoint_seconds={seconds}; give a number of at least 0")
        chosen(here["logger"])
        config = kind.from_mapping(values)
        return config, default_folder(config) if out is None else Path(str(out)), here

    def check(settings: DictConfig) -> None:
        config, out, here = parse(settings)
        if out.resolve() in folders:
            raise RunError(
                f"out={out}: two runs of the sweep would share it; leave it out, or use out='runs/${{activation}}'"
            )
        folders.add(out.resolve())
        Recorder(out, config, here["overwrite"])

    def run(settings: DictConfig) -> None:
        plugins.load(settings.plugins)  # a launcher may have brought this to another process
        config, out, here = parse(settings)
        how = {key: here[key] for key in ("overwrite", "checkpoint_seconds", "logger")}
        finished = train(config, out=out, **how)
        evaluating = here["evaluate"] and not (finished.path / EVALUATION).exists()
        if finished.fresh:
            report(finished)
        else:
            print(f"{out}: this run is already finished; overwrite=true starts it anew")
        if evaluating:
            print("evaluating on the test split; evaluate=false skips this", flush=True)
            rows = evaluate_run(finished)
            Console().print(evaluation_summary(rows, algorithm, config.activation))

    warnings.formatwarning = lambda message, *where, **more: f"{algorithm}: {message}\n"
    with tempfile.TemporaryDirectory() as scratch:  # where Hydra may keep its own notes of a sweep
        os.environ["UAVNAV_SCRATCH"] = scratch
        try:
            settings, flags = _words(words, _keys(kind))
            if {"-m", "--multirun"} & {*flags}:
                _compose(recipe, check, [*settings, "hydra/launcher=basic", *flags])
            _compose(recipe, run, [*settings, *flags])
        except Interrupted as stop:
            print(stop, file=sys.stderr)
            sys.exit(128 + stop.signum)
        except (HydraException, OmegaConfBaseException) as error:
            sys.exit(f"{recipe}: {_one_line(error, presets)}")


def _keys(kind: type[TrainConfig]) -> list[str]:
    """Every key that a command line may set."""
    return [*(item.name for item in fields(kind)), *(f"world.{item.name}" for item in fields(World)), *HERE]


def _help(recipe: str, algorithm: str, presets: Presets) -> str:
    """The recipe's help, as a template of Hydra's: its own docstring, and the choices of each key that has some."""
    kind = type(next(iter(presets.values())))
    choices: dict[str, Any] = {"preset": presets, "logger": (*LOG_FOLDERS, NONE)}
    for prefix, owner in (("", kind), ("world.", World)):
        for item in fields(owner):
            hint = get_type_hints(owner)[item.name]
            named = get_args(hint) if get_origin(hint) is Literal else item.metadata.get("choices")
            choices |= {f"{prefix}{item.name}": named} if named else {}
    lines = [f"  {key:20} {', '.join(sorted(named))}" for key, named in choices.items()]
    return HELP.format(
        what=sys.modules["__main__"].__doc__ or "",
        config=ALGORITHMS[algorithm].module,
        yaml=f"recipes/conf/{recipe}.yaml",
        choices="\n".join(lines),
    )


def _words(words: list[str], keys: list[str]) -> tuple[list[str], list[str]]:
    """The settings and Hydra's flags of a command line, in any order; a ConfigError for a word that is neither."""

    def refuse(message: str) -> NoReturn:
        raise ConfigError(f"{message}; --help says more")

    parser = argparse.ArgumentParser(add_help=False)
    parser.error = refuse  # type: ignore[method-assign]
    parser.add_argument("overrides", nargs="*")
    for flag in (("--help", "-h"), ("--multirun", "-m"), ("--hydra-help",), ("--version",), ("--resolve",)):
        parser.add_argument(*flag, action="store_true")
    parser.add_argument("--cfg", "-c", choices=["job", "hydra", "all"])
    parser.add_argument("--package", "-p")
    parser.add_argument("--info", "-i", nargs="?", const="all")
    found, strange = parser.parse_known_args(words)
    settings = [*found.overrides, *(word for word in strange if not word.startswith("-"))]
    for word in strange:
        if word.startswith("-"):
            flag, _, value = word.partition("=")
            key = flag.lstrip("-").replace("-", "_")
            example = f"{key}={value or next(iter(settings), '...')}" if key in keys else "activation=tanh"
            near = did_you_mean(flag, parser._option_string_actions)
            raise ConfigError(f"there is no flag {flag}{near}; settings are key=value: {example}")
    for word in settings:
        if not re.match(r"~|\+*[^=+]+=", word):
            raise ConfigError(f"{word!r} is no setting; settings are key=value: activation=tanh")
    flags = [word for word in words if word not in settings]
    # a task of its own may have other fields than the world that Hydra knows: the configuration checks them
    settings = [f"++{word}" if word.startswith("world.") else word for word in settings]
    return settings + (["hydra/help=recipe"] if found.help else []), flags


class _Stop(BaseException):
    """Carries an error past Hydra, which would print more than it."""

    def __init__(self, error: Exception) -> None:
        self.error = error


def _compose(recipe: str, task: Callable[[DictConfig], None], arguments: list[str]) -> None:
    def guarded(settings: DictConfig) -> None:
        try:
            task(settings)
        except Exception as error:
            raise _Stop(error) from error

    sys.argv[1:] = arguments
    try:
        hydra.main(version_base="1.3", config_path=str(Path(__file__).parent / "conf"), config_name=recipe)(guarded)()
    except _Stop as stop:
        raise stop.error from stop.error.__cause__
    except ValueError as error:  # of Hydra's own: flags that do not go together
        raise HydraException(str(error)) from error


def _one_line(error: Exception, presets: Presets) -> str:
    """Hydra's complaint as one line with the choices."""
    if isinstance(error, MissingConfigException) and (error.missing_cfg_file or "").startswith("preset/"):
        return str(unknown("preset", error.missing_cfg_file.removeprefix("preset/"), presets))
    if isinstance(error, MissingConfigException) and (error.missing_cfg_file or "").startswith("hydra/launcher/"):
        return f"hydra/launcher={error.missing_cfg_file.removeprefix('hydra/launcher/')}: {LAUNCHERS}"
    if isinstance(error, OverrideParseException):
        return f"{error.override}: its value cannot be read; in a shell quote brackets and blanks: 'hidden=[64,64]'"
    key = re.match(r"Could not override '([^']+)'", str(error))
    if key:
        return str(unknown_key(key[1], _keys(type(next(iter(presets.values()))))))
    several = re.match(r"Ambiguous value for argument '([^']+)'", str(error))
    if several:
        return f"{several[1]}: give one value, or -m to train with each in turn"
    return str(error).strip().splitlines()[0]
