"""Logs besides a run's folder, through TorchRL's loggers: TensorBoard's, and Weights & Biases'.

A log lies in the run's folder, in `tensorboard/` or `wandb/`. It is told every row of progress.parquet as the row is
noted: each of its columns as `column/seed 3` against frames per seed, and `reward`, the mean over the seed's last 100
episodes. Where seeds are spread over processes, their rows come to the one that started them, which alone logs. Logging
draws no random number, and what identifies a run knows nothing of it.

Every log is whole: a run that goes on first tells what its snapshot holds, and into a new log; a finished run that has
none yet is logged from its tables.

Weights & Biases stays offline (`wandb sync` uploads a log later) unless the environment says WANDB_MODE=online, and is
told neither packages nor code, paths, host or user.
"""

from __future__ import annotations

import contextlib
import math
import os
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from uavnav.choices import ConfigError, unknown
from uavnav.runs import LOG_FOLDERS, Run
from uavnav.runs.tables import Columns, RunError, lock, with_reward

NONE = "none"
PROJECT = "uavnav"
INSTALL = {"tensorboard": "uavnav[tensorboard]", "wandb": "wandb"}


def chosen(logger: str | Sequence[str]) -> list[str]:
    """The loggers of one name, or of several; `none` is no logger.

    Raises:
        ConfigError: there is no such logger, or what it needs is not installed.
    """
    choices = (*LOG_FOLDERS, NONE)
    names = list(logger) if isinstance(logger, (list, tuple)) else [logger]
    for name in names:
        if name not in choices:
            raise unknown("logger", name, choices)
        if name != NONE and find_spec(name) is None:
            raise ConfigError(f"logger={name}: its package is not installed; pip install '{INSTALL[name]}'")
    return [name for name in LOG_FOLDERS if name in names]


class Logs:
    """The open logs of a run: call it with rows, columns of equal length by name, `seed` and `frame` among them.

    They are opened by the first call, which may hold no row.

    Args:
        names: as `chosen` gives them.
        folder: of the run.
        algorithm: for their title.
        settings: of the run; of a bank's path its name alone is logged.
    """

    def __init__(self, names: Sequence[str], folder: Path, algorithm: str, settings: Mapping[str, Any]) -> None:
        self._names, self._folder = names, folder
        self._title = f"{algorithm} {settings['activation']}"
        self._settings = {**settings, "algorithm": algorithm, "layouts": Path(settings["layouts"]).name}
        self._open: dict[str, Any] = {}

    def __call__(self, rows: Columns) -> None:
        by_frame: dict[int, dict[str, float]] = defaultdict(dict)
        for name, column in rows.items():
            for seed, frame, value in zip(rows["seed"], rows["frame"], column, strict=True):
                if name not in ("seed", "frame") and math.isfinite(value):  # in a table, nan is what was not there yet
                    by_frame[int(frame)][f"{name}/seed {int(seed)}"] = float(value)
        for name in self._names:
            if name not in self._open:
                self._open[name] = _opened(name, self._folder, self._title, self._settings)
        for name in self._names:
            with self._dropping(name):
                for frame, values in by_frame.items():
                    self._open[name].log_metrics(values, step=frame)
                self._open[name].flush()

    def close(self) -> None:
        """End the logs; they can then be read as a whole."""
        for name in [name for name in self._names if name in self._open]:
            with self._dropping(name):
                self._open[name].close()

    @contextlib.contextmanager
    def _dropping(self, name: str) -> Iterator[None]:
        """Go on without a log that fails: training is worth more than it."""
        try:
            yield
        except Exception as error:
            self._names = [other for other in self._names if other != name]
            warnings.warn(
                f"logger={name} fails and is left out ({_first_line(error)}); once the run is finished, delete"
                f" {self._folder / name} and give the same command to log it from its tables",
                stacklevel=3,
            )


def log_finished(run: Run, names: Sequence[str]) -> None:
    """Log a finished run from its tables where it has no such log.

    Raises:
        RunError: its folder is in use, or cannot be written.
    """
    missing = [name for name in names if not (run.path / name).exists()]
    if missing:
        with lock(run.path), contextlib.closing(Logs(missing, run.path, run.algorithm, run.config)) as log:
            log(with_reward(run.progress, run.episodes))


def _opened(name: str, folder: Path, title: str, settings: Mapping[str, Any]) -> Any:
    try:
        return OPEN[name](folder, title, settings)
    except Exception as error:  # of its own kinds
        raise RunError(f"logger={name}: cannot be opened ({_first_line(error)}); give another, or none") from error


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def _open_tensorboard(folder: Path, title: str, settings: Mapping[str, Any]) -> Any:
    from torchrl.record.loggers import TensorboardLogger

    log = TensorboardLogger("tensorboard", log_dir=str(folder))
    lines = (f"    {name}: {value}" for name, value in settings.items())
    log.experiment.add_text("settings", "\n".join([title, "", *lines]))  # its table of hyperparameters takes no lists
    return log


def _open_wandb(folder: Path, title: str, settings: Mapping[str, Any]) -> Any:
    os.environ.setdefault("WANDB_ERROR_REPORTING", "false")  # read when it is imported
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
        save_dir=str(folder.absolute()),  # its service, shared by child processes, may stand elsewhere
        project=PROJECT,
        log_env_packages=False,
        mode="online" if os.environ.get("WANDB_MODE") == "online" else "offline",  # its own `offline` is for good
        reinit="create_new",  # the caller's own run, if there is one, stays as it is
        settings=nothing_of_the_machine,
    )
    log.log_hparams(dict(settings))
    return log


OPEN: dict[str, Callable[[Path, str, Mapping[str, Any]], Any]] = {
    "tensorboard": _open_tensorboard,
    "wandb": _open_wandb,
}
