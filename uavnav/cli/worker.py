"""The process of a worker: it trains some seeds of a run, and flies them where a study asks for it.

    python -m uavnav.cli.worker [PLUGIN ...] MODULE:CLASS FILE.job

The class is that of the run's configuration; the file says the rest (see `uavnav.training.workers`). How
the process ended is written into FILE.ended.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import sys
import traceback
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from uavnav import files, plugins
from uavnav.errors import OneLineError
from uavnav.evaluation import evaluate_run
from uavnav.runs import Run, Threads
from uavnav.runs.policies import Diverged
from uavnav.runs.tables import RunError
from uavnav.tasks.faults import from_option
from uavnav.training import loop, machine
from uavnav.training.heartbeat import Heartbeat
from uavnav.training.recorder import STOPS, Interrupted, Recorder


class Job(files.Facts):
    """What a worker is told."""

    out: str
    folder: str
    config: dict[str, Any]
    how: dict[str, Any]
    threads: Threads
    evaluation: dict[str, Any] | None


def _hear_nothing(number: int, frame: object) -> None:
    """Let a signal pass, as `signal.SIG_IGN` does, which a compiler that is started would inherit."""


def _carry_out(told: Job, kind: str) -> dict[str, Any]:
    """Train and fly, and say how that ended; kind: the module and the class of the configuration."""
    out = Path(told.out)
    if not out.is_dir():
        raise RunError(f"{out}: is gone; another process has taken this run over")
    module, _, name = kind.partition(":")
    config = getattr(importlib.import_module(module), name).from_mapping(told.config)
    recorder = Recorder(out, config, **told.how)
    if recorder.finished:
        run = Run(out)
    else:
        with machine.use_threads(told.threads):
            run = loop.alone(recorder, quiet=True)
    if told.evaluation is None:
        return {"finished": run.frames}
    try:
        faults = from_option(told.evaluation.get("faults"))
        with Heartbeat(out, total=run.frames, frames=run.frames):
            evaluate_run(run, **told.evaluation | {"faults": faults}, quiet=True)
    except ValueError as error:
        return {"error": str(error), "diverged": isinstance(error, Diverged)}
    return {"finished": run.frames}


def main(argv: Sequence[str]) -> None:
    """Do what a file describes; argv: the names of plugins, the configuration's class, and the file."""
    *names, kind, file = argv
    for number in STOPS:
        signal.signal(number, _hear_nothing)  # a run hears the first signal, and then this is there again
    warnings.formatwarning = lambda message, *where, **more: f"{message}\n"
    warnings.filterwarnings("ignore", machine.EAGER)  # the one that started this process has said it
    try:
        told = files.facts(Job, files.read_json(file))
    except (OSError, ValueError):
        raise SystemExit(
            f"{file}: missing or damaged; give the same command again, which writes it anew"
        ) from None
    try:
        os.chdir(told.folder)
        plugins.load(names)
        last = _carry_out(told, kind)
    except Interrupted as stop:
        last = {"stopped": stop.frames}
    except (OneLineError, OSError) as error:
        last = {"error": str(error)}
    except Exception as error:
        traceback.print_exc()
        last = {"error": f"{told.out}: {type(error).__name__}: {error}"}
    try:
        files.write(Path(file).with_suffix(".ended"), json.dumps(last).encode())
    except OSError:  # a full disk, or a folder that is gone
        sys.exit(os.EX_IOERR)


if __name__ == "__main__":
    main(sys.argv[1:])
