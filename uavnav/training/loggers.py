"""Live logs of a run, through TorchRL's loggers for TensorBoard and Weights & Biases.

A log is in the run's folder, in `tensorboard/` or `wandb/`. It receives each row of progress.parquet when
the row is written: every column as `column/seed 3` against frames per seed, and `reward`, the mean over the
seed's last 100 episodes. If seeds are spread over processes, their rows go to the parent process, and only
that logs. Logging draws no random number and is not part of a run's configuration.

Every log is complete: a resumed run opens a new log and first writes the rows of its snapshot.

Weights & Biases stays offline (`wandb sync` uploads a log later) unless WANDB_MODE=online, and receives no
packages, code, paths, host or user.
"""

from __future__ import annotations

import contextlib
import math
import os
import shlex
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from uavnav.errors import ConfigError, telling_line, unknown
from uavnav.runs import LOG_FOLDERS, Run
from uavnav.runs.tables import Columns, RunError, lock, with_reward

NONE = "none"
PROJECT = "uavnav"
INSTALL = {"tensorboard": "uavnav[tensorboard]", "wandb": "wandb"}


def chosen(logger: str | Sequence[str]) -> list[str]:
    """The names of the chosen loggers, given one name or several; `none` adds no logger.

    Raises:
        ConfigError: a name is unknown, or its package is not installed.
    """
    choices = (*LOG_FOLDERS, NONE)
    names = list(logger) if isinstance(logger, (list, tuple)) else [logger]
    for name in names:
        if not isinstance(name, str) or name not in choices:
            raise unknown("logger", name, choices)
        if name != NONE and find_spec(name) is None:
            raise ConfigError(f"logger={name}: its package is not installed; pip install '{INSTALL[name]}'")
    return [name for name in LOG_FOLDERS if name in names]


class Logs:
    """The logs of a run: call it with rows, as columns of equal length by name, `seed` and `frame` among
    them.

    The first call opens the logs, even if it has no rows.

    Args:
        names: the result of `chosen`.
        folder: the run's folder.
        algorithm: a part of the logs' title.
        settings: the run's settings; a layout file's path is logged as its file name.
    """

    def __init__(
        self, names: Sequence[str], folder: Path, algorithm: str, settings: Mapping[str, Any]
    ) -> None:
        self._names, self._folder = names, folder
        self._title = f"{algorithm} {settings['activation']}"
        self._settings = {**settings, "algorithm": algorithm, "layouts": Path(settings["layouts"]).name}
        self._open: dict[str, Any] = {}

    def __call__(self, rows: Columns) -> None:
        by_frame: dict[int, dict[str, float]] = defaultdict(dict)
        for name, column in rows.items():
            for seed, frame, value in zip(rows["seed"], rows["frame"], column, strict=True):
                if name not in ("seed", "frame") and math.isfinite(value):  # nan: not measured yet
                    by_frame[int(frame)][f"{name}/seed {int(seed)}"] = float(value)
        for name in self._names:
            if name not in self._open:
                try:
                    self._open[name] = OPEN[name](self._folder, self._title, self._settings)
                except Exception as error:  # each library has its own kinds
                    why = telling_line(error)
                    raise RunError(
                        f"logger={name}: cannot be opened ({why}); give another, or none"
                    ) from error
            with self._dropping(name):
                for frame, values in by_frame.items():
                    self._open[name].log_metrics(values, step=frame)
                self._open[name].flush()

    def close(self) -> None:
        """Close the logs; after that, every row can be read."""
        for name in [name for name in self._names if name in self._open]:
            with self._dropping(name):
                self._open[name].close()

    @contextlib.contextmanager
    def _dropping(self, name: str) -> Iterator[None]:
        """Drop a log that fails, so that training continues."""
        try:
            yield
        except Exception as error:
            self._names = [other for other in self._names if other != name]
            warnings.warn(
                f"logger={name} fails and is left out ({telling_line(error)}); once the run is finished, "
                f"delete {self._folder / name} and give the same command to log it from its tables",
                stacklevel=3,
            )


def log_finished(run: Run, names: Sequence[str]) -> None:
    """Log a finished run from its tables, with those loggers that it has no log of.

    Raises:
        RunError: the run's folder is in use, or cannot be written.
    """
    missing = [name for name in names if not (run.path / name).exists()]
    if missing:
        with lock(run.path), contextlib.closing(Logs(missing, run.path, run.algorithm, run.config)) as log:
            log(with_reward(run.progress, run.episodes))


def shown_by(run: Path, names: Sequence[str]) -> list[str]:
    """The commands that show the logs of a run; names: the result of `chosen`."""
    commands = [f"tensorboard --logdir {shlex.quote(str(run))}"] if "tensorboard" in names else []
    if "wandb" in names:
        offline = sorted((run / "wandb").glob("offline-run-*"))  # each is complete, the last the newest
        commands += (
            [f"wandb sync {shlex.quote(str(offline[-1]))}"]
            if offline
            else [f"https://wandb.ai, project {PROJECT}"]
        )
    return commands


def _open_tensorboard(folder: Path, title: str, settings: Mapping[str, Any]) -> Any:
    from torchrl.record.loggers import TensorboardLogger

    log = TensorboardLogger("tensorboard", log_dir=str(folder))
    lines = (f"    {name}: {value}" for name, value in settings.items())
    # its hyperparameter table takes no lists
    log.experiment.add_text("settings", "\n".join([title, "", *lines]))
    return log


def _open_wandb(folder: Path, title: str, settings: Mapping[str, Any]) -> Any:
    os.environ.setdefault("WANDB_ERROR_REPORTING", "false")  # wandb reads it when imported
    import wandb
    from torchrl.record.loggers import WandbLogger

    nothing_of_the_machine = wandb.Settings(
        console="off",
        disable_code=True,
        disable_git=True,
        disable_job_creation=True,
        email="",
        host="",
        label_disable=True,
        program="",
        save_code=False,
        silent=True,
        use_dot_wandb=False,
        username="",
        x_disable_machine_info=True,
        x_disable_meta=True,
        x_disable_stats=True,
        x_save_requirements=False,
    )
    log = WandbLogger(
        title,
        save_dir=str(folder.absolute()),  # wandb's service may run in another working folder
        project=PROJECT,
        log_env_packages=False,
        mode="online"
        if os.environ.get("WANDB_MODE") == "online"
        else "offline",  # wandb's own `offline` is permanent
        reinit="create_new",  # leaves a wandb run of the caller untouched
        settings=nothing_of_the_machine,
    )
    log.log_hparams(dict(settings))
    return log


OPEN: dict[str, Callable[[Path, str, Mapping[str, Any]], Any]] = {
    "tensorboard": _open_tensorboard,
    "wandb": _open_wandb,
}
