"""The process of a share of a run's seeds: it trains them as a run of its own, and tells its progress as lines of JSON.

It gets its settings as JSON on the standard input, and saves and ends when the one that started it is gone.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import select
import signal
import sys
import threading
import traceback
import warnings
from pathlib import Path
from typing import Any

from uavnav import plugins
from uavnav.choices import ConfigError
from uavnav.runs import Run
from uavnav.runs.tables import Columns, RunError, with_reward
from uavnav.tasks.layouts import LayoutError
from uavnav.training import loop, machine
from uavnav.training.recorder import STOPS, Interrupted, Recorder

EXPECTED = (ConfigError, LayoutError, RunError)
POLL_SECONDS = 0.2
STOP_SECONDS = 1.0
"""Between two askings of a share to stop: before its run has begun it does not hear."""


def say(channel: int, **message: Any) -> None:
    """Write a line of JSON, whole."""
    line = (json.dumps(message) + "\n").encode()
    with contextlib.suppress(BrokenPipeError):  # the one that listened is gone: a stop is on its way
        while line:
            line = line[os.write(channel, line) :]  # a signal may cut a long one


def _end_with_parent(over: threading.Event) -> None:
    """Once the one that holds the other end of the standard input is gone, ask for a stop until the run is over."""
    channel = sys.stdin.fileno()
    while not over.is_set():
        said, _, _ = select.select([channel], [], [], POLL_SECONDS)
        if said and not os.read(channel, 1):
            os.kill(os.getpid(), signal.SIGTERM)
            over.wait(STOP_SECONDS)


def _hear_nothing(number: int, frame: object) -> None:
    """Let a signal pass, as `signal.SIG_IGN` does, which a compiler that is started would inherit."""


def _recorder(described: dict[str, Any], channel: int) -> Recorder:
    plugins.load(described["plugins"])
    module, name = described["kind"]
    config = getattr(importlib.import_module(module), name).from_mapping(described["config"])

    def log(rows: Columns) -> None:
        say(channel, rows={name: column.tolist() for name, column in rows.items()})

    return Recorder(Path(described["out"]), config, log=log if described["log"] else None, **described["how"])


def main() -> None:
    """Train the share that is described on the standard input."""
    channel = os.dup(sys.stdout.fileno())
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what a library prints is no message
    warnings.formatwarning = lambda message, *where, **more: f"{message}\n"
    warnings.filterwarnings("ignore", machine.EAGER)  # the one that started this process has said it
    for number in STOPS:
        signal.signal(number, _hear_nothing)  # a run hears the first signal, and then this is there again
    described = json.loads(sys.stdin.readline())
    over = threading.Event()
    watch = threading.Thread(target=_end_with_parent, args=[over], daemon=True)
    watch.start()
    try:
        recorder = _recorder(described, channel)
        if recorder.finished:
            run = Run(recorder.path)
            if recorder.log is not None:
                recorder.log(with_reward(run.progress, run.episodes))
        else:
            with machine.use_threads(1):
                run = loop.alone(
                    recorder, quiet=True, tell=lambda frames, rewards: say(channel, frames=frames, rewards=rewards)
                )
        last: dict[str, Any] = {"finished": run.frames}
    except Interrupted as stop:
        last = {"stopped": stop.frames, "wanted": stop.wanted}
    except EXPECTED as error:
        last = {"error": str(error)}
    except Exception as error:
        traceback.print_exc()
        last = {"error": f"{described['out']}: {type(error).__name__}, see above"}
    for number in STOPS:
        signal.signal(number, signal.SIG_IGN)  # there is nothing left to save
    say(channel, **last)
    over.set()
    watch.join()  # a thread that woke while the interpreter ends would end the process loudly
