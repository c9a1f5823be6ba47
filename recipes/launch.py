"""From a command line to a training run: the one place where Hydra lives."""

from __future__ import annotations

import os
import re
import sys
import tempfile
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Literal, NoReturn, get_args, get_origin, get_type_hints

os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # let errors come here, to be said in one line

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from uavnav.choices import ConfigError, did_you_mean, unknown, unknown_key
from uavnav.evaluate import evaluate_run
from uavnav.policies import PolicyError
from uavnav.runs import LOG_FOLDERS, Run
from uavnav.runs.tables import RunError
from uavnav.tasks.layouts import LayoutError
from uavnav.training.config import TrainConfig
from uavnav.training.display import evaluation_summary, print_table, report
from uavnav.training.loggers import NONE, chosen
from uavnav.training.recorder import Interrupted, Recorder, default_folder

HERE = ("out", "overwrite", "checkpoint_seconds", "evaluate", "logger")
"""The keys of the recipes themselves; all others are fields of the algorithm's configuration."""

HELP = """{what}
These have names for values; {config} and {yaml} say more of each key.

{choices}

Everything, as these arguments set it:

$CONFIG
Flags besides -m: --cfg job shows the settings and runs nothing; --hydra-help lists Hydra's own.
"""

LAUNCHERS = "not installed; ray, submitit_local and submitit_slurm come with pip install 'uavnav[scale]'"

ERRORS = (ConfigError, LayoutError, PolicyError, RunError)


def launch(algorithm: str, presets: Mapping[str, TrainConfig], train: Callable[..., Run]) -> None:
    """Run `train` once, or once for each combination of a `-m` sweep, after every one of them was checked."""
    store = ConfigStore.instance()
    for name, preset in presets.items():
        store.store(group="preset", name=name, node=asdict(preset), package="_global_")
    kind = type(next(iter(presets.values())))
    help = {"app_name": algorithm, "header": "", "footer": "", "template": _help(algorithm, presets)}
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
        return config, default_folder(algorithm, config) if out is None else Path(str(out)), here

    def check(settings: DictConfig) -> None:
        config, out, here = parse(settings)
        if out.resolve() in folders:
            raise RunError(
                f"out={out}: two runs of the sweep would share it; leave it out, or use out='runs/${{activation}}'"
            )
        folders.add(out.resolve())
        Recorder(out, algorithm, config, here["overwrite"])

    def run(settings: DictConfig) -> None:
        config, out, here = parse(settings)
        how = {key: here[key] for key in ("overwrite", "checkpoint_seconds", "logger")}
        finished = train(config, out=out, **how)
        evaluating = here["evaluate"] and finished.evaluation() is None
        if finished.fresh:
            report(finished)
        else:
            print(f"{out}: this run is already finished; overwrite=true starts it anew")
        if evaluating:
            print("evaluating on the test split; evaluate=false skips this", flush=True)
            rows = evaluate_run(finished)
            print_table(evaluation_summary(rows, algorithm, config.activation))

    warnings.formatwarning = lambda message, *where, **more: f"{algorithm}: {message}\n"
    with tempfile.TemporaryDirectory() as scratch:  # where Hydra may keep its own notes of a sweep
        os.environ["UAVNAV_SCRATCH"] = scratch
        try:
            settings, flags = _words(sys.argv[1:], [*asdict(next(iter(presets.values()))), *HERE])
            if {"-m", "--multirun"} & {*flags}:
                _compose(algorithm, check, [*settings, "hydra/launcher=basic", *flags])
            _compose(algorithm, run, [*settings, *flags])
        except Interrupted as stop:
            print(stop, file=sys.stderr)
            sys.exit(128 + stop.signum)
        except ERRORS as error:
            sys.exit(f"{algorithm}: {error}")
        except (HydraException, OmegaConfBaseException) as error:
            sys.exit(f"{algorithm}: {_one_line(error, presets)}")
        except KeyboardInterrupt:
            sys.exit(130)


def _help(algorithm: str, presets: Mapping[str, TrainConfig]) -> str:
    """The recipe's help, as a template of Hydra's: its own docstring, and the choices of each key that has some."""
    kind = type(next(iter(presets.values())))
    choices: dict[str, Any] = {"preset": presets, "logger": (*LOG_FOLDERS, NONE)}
    for item in fields(kind):
        hint = get_type_hints(kind)[item.name]
        named = get_args(hint) if get_origin(hint) is Literal else item.metadata.get("choices")
        choices |= {item.name: named} if named else {}
    lines = [f"  {key:14} {', '.join(sorted(named))}" for key, named in choices.items()]
    return HELP.format(
        what=sys.modules["__main__"].__doc__ or "",
        config=f"uavnav/algorithms/{algorithm}.py",
        yaml=f"recipes/conf/{algorithm}.yaml",
        choices="\n".join(lines),
    )


def _words(words: list[str], keys: list[str]) -> tuple[list[str], list[str]]:
    """The settings and Hydra's flags of a command line, in any order; a ConfigError for a word that is neither."""

    def refuse(message: str) -> NoReturn:
        raise ConfigError(f"{message}; --help says more")

    parser = get_args_parser()
    parser.error = refuse
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
    settings += ["hydra/help=recipe"] if found.help else []
    return settings, [word for word in words if word not in settings]


class _Stop(BaseException):
    """Carries an error past Hydra, which would print more than it."""

    def __init__(self, error: Exception) -> None:
        self.error = error


def _compose(algorithm: str, task: Callable[[DictConfig], None], arguments: list[str]) -> None:
    def guarded(settings: DictConfig) -> None:
        try:
            task(settings)
        except Exception as error:
            raise _Stop(error) from error

    sys.argv[1:] = arguments
    try:
        hydra.main(version_base="1.3", config_path=str(Path(__file__).parent / "conf"), config_name=algorithm)(
            guarded
        )()
    except _Stop as stop:
        raise stop.error from stop.error.__cause__
    except ValueError as error:  # of Hydra's own: flags that do not go together
        raise HydraException(str(error)) from error


def _one_line(error: Exception, presets: Mapping[str, TrainConfig]) -> str:
    """Hydra's complaint as one line with the choices."""
    if isinstance(error, MissingConfigException) and (error.missing_cfg_file or "").startswith("preset/"):
        return str(unknown("preset", error.missing_cfg_file.removeprefix("preset/"), presets))
    if isinstance(error, MissingConfigException) and (error.missing_cfg_file or "").startswith("hydra/launcher/"):
        return f"hydra/launcher={error.missing_cfg_file.removeprefix('hydra/launcher/')}: {LAUNCHERS}"
    if isinstance(error, OverrideParseException):
        return f"{error.override}: its value cannot be read; in a shell quote brackets and blanks: 'hidden=[64,64]'"
    key = re.match(r"Could not override '([^']+)'", str(error))
    if key:
        return str(unknown_key(key[1], [*asdict(next(iter(presets.values()))), *HERE]))
    several = re.match(r"Ambiguous value for argument '([^']+)'", str(error))
    if several:
        return f"{several[1]}: give one value, or -m to train with each in turn"
    return str(error).strip().splitlines()[0]
