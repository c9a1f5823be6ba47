"""The process of a share of a run's seeds: it trains them as a run of its own.

It gets its settings as JSON. A process that started it (`training.workers`) gives them on the standard input and hears
its progress as lines of JSON; the share saves and ends when that process is gone. A study (`uavnav.studies`) names a
file, from which a share on another machine may read them; nobody listens then, and the share writes beside the file how
it ended.
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
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from uavnav import files, plugins
from uavnav.algorithms import ALGORITHMS
from uavnav.errors import ConfigError, unknown
from uavnav.evaluation import evaluate_run
from uavnav.runs import STOP, Run
from uavnav.runs.policies import Diverged, PolicyError
from uavnav.runs.tables import Columns, RunError, with_reward
from uavnav.tasks.layouts import LayoutError
from uavnav.training import loop, machine
from uavnav.training.display import Tell
from uavnav.training.heartbeat import Heartbeat
from uavnav.training.recorder import STOPS, Interrupted, Log, Recorder

EXPECTED = (ConfigError, LayoutError, RunError)
POLL_SECONDS = 0.2
STOP_SECONDS = 1.0
"""Between two askings of a share to stop: before its run has begun it does not hear."""


class Job(files.Facts):
    """What a study tells a share in a file."""

    out: str
    folder: str
    algorithm: str
    config: dict[str, Any]
    how: dict[str, Any]
    threads: Annotated[int, Field(ge=1, le=2**12)]
    evaluation: dict[str, Any] | None


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


def _told(described: dict[str, Any]) -> Any:
    """The class of a configuration, from wherever the one that started this process had it."""
    plugins.load(described["plugins"])
    module, name = described["kind"]
    return getattr(importlib.import_module(module), name)


def _listed(described: dict[str, Any], names: Sequence[str]) -> Any:
    """The same for a file, which cannot have anything imported: of the table, with these plugins in it."""
    plugins.load(names)
    name = described["algorithm"]
    if name not in ALGORITHMS:
        raise unknown("algorithm", name, ALGORITHMS)
    return ALGORITHMS[name].config


def _train(
    described: dict[str, Any], kind: Callable[[], Any], tell: Tell | None = None, log: Log | None = None
) -> dict[str, Any]:
    """Train a share, and say how that ended; kind: gives the class of its configuration."""
    try:
        config = kind().from_mapping(described["config"])
        recorder = Recorder(Path(described["out"]), config, log=log, **described["how"])
        if recorder.finished:
            run = Run(recorder.path)
            if log is not None:
                log(with_reward(run.progress, run.episodes))
        else:
            with machine.use_threads(described["threads"]):
                run = loop.alone(recorder, quiet=True, tell=tell)
        return {"finished": run.frames}
    except Interrupted as stop:
        return {"stopped": stop.frames, "wanted": stop.wanted}
    except EXPECTED as error:
        return {"error": str(error)}
    except Exception as error:
        traceback.print_exc()
        return {"error": f"{described['out']}: {type(error).__name__}, see above"}


def listened_to() -> None:
    """Train the share that is described on the standard input."""
    channel = os.dup(sys.stdout.fileno())
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what a library prints is no message
    for number in STOPS:
        signal.signal(number, _hear_nothing)  # a run hears the first signal, and then this is there again
    if not (line := sys.stdin.readline()):
        sys.exit("uavnav.cli.worker: nothing on the standard input; a run of several processes starts it by itself")
    described = json.loads(line)
    over = threading.Event()
    watch = threading.Thread(target=_end_with_parent, args=[over], daemon=True)
    watch.start()

    def tell(frames: int, rewards: list[float]) -> None:
        say(channel, frames=frames, rewards=rewards)

    def log(rows: Columns) -> None:
        say(channel, rows={name: column.tolist() for name, column in rows.items()})

    last = _train(described, lambda: _told(described), tell, log if described["log"] else None)
    for number in STOPS:
        signal.signal(number, signal.SIG_IGN)  # there is nothing left to save
    say(channel, **last)
    over.set()
    watch.join()  # a thread that woke while the interpreter ends would end the process loudly


def unheard(job: Path, names: Sequence[str] = ()) -> None:
    """Train the share that a file describes, in the folder that was made for it, and write beside it how that ended.

    names: of the plugins that the study was given.
    """
    try:
        described = files.read_json(job)
        told = files.facts(Job, described)
    except (OSError, ValueError):
        raise SystemExit(f"{job}: missing or damaged; give the study's command again, which writes it anew") from None
    out, folder, evaluation = Path(told.out), told.folder, told.evaluation
    with job.with_suffix(".log").open("ab", buffering=0) as log:
        for stream in (sys.stdout, sys.stderr):
            os.dup2(log.fileno(), stream.fileno())
    if not out.is_dir():
        raise SystemExit(f"{out}: is gone; another process has taken this run over")
    os.chdir(folder)
    stopped = (out / STOP).exists()
    last = {"stopped": 0, "wanted": True} if stopped else _train(described, lambda: _listed(described, names))
    if "finished" in last and evaluation is not None:
        try:
            with Heartbeat(out, total=last["finished"], frames=last["finished"]):
                evaluate_run(Run(out), **evaluation, quiet=True)
        except (ConfigError, LayoutError, PolicyError, RunError, ValueError, OSError) as error:
            last = {"error": str(error), "diverged": isinstance(error, Diverged)}
    files.write(job.with_suffix(".ended"), json.dumps(last).encode())


def main(argv: Sequence[str]) -> None:
    """Train the share that is described in a file, the last word after those of plugins, or on the standard input."""
    warnings.formatwarning = lambda message, *where, **more: f"{message}\n"
    warnings.filterwarnings("ignore", machine.EAGER)  # the one that started this process has said it
    if argv:
        unheard(Path(argv[-1]), argv[:-1])
    else:
        listened_to()


if __name__ == "__main__":
    main(sys.argv[1:])
