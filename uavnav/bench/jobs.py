"""The runner: each job is a function of `environments` or `training`, called in a fresh process.

`python -m uavnav.bench.jobs MODULE.FUNCTION '{"argument": ...}' LAUNCHED` prints its result as JSON.
LAUNCHED is when the process was started [s since the epoch], so that start-up counts.
A job ends when its standard input does.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import Any

from uavnav.bench import Result

THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")
LONGEST = 4 * 3600.0  # seconds after which any job is given up
LIBRARIES = {"stable_baselines3": "Stable-Baselines3", "sbx": "SBX"}  # peers that may not be installed

Process = subprocess.Popen[bytes]


class JobError(RuntimeError):
    """A job failed or took too long; the message is one line."""


@dataclass(frozen=True)
class Measurement:
    """A row of the table of jobs (`uavnav.bench.plan`)."""

    name: str  # section/row
    job: str  # module.function
    arguments: Result
    threads: int = 1  # of each process
    copies: int = 1  # processes side by side
    rounds: int = 3
    needs: str = ""  # a library that may not be installed
    base: str = ""  # the measurement that it is compared with
    warm: Result = field(default_factory=dict)  # changed arguments of a first run, only to warm the caches
    quick: Result | None = None  # changed arguments of a quick run; None: a quick run leaves this out


@dataclass
class Results:
    """What each round of a measurement found, and why something was not measured, by name."""

    rows: list[tuple[Measurement, int, Result]] = field(default_factory=list)
    missing: dict[str, str] = field(default_factory=dict)
    stopped: bool = False


def run(measurements: Sequence[Measurement], cache: Path, say: Callable[[str], None]) -> Results:
    """All measurements, round by round, so that the machine's drift falls on all alike; Ctrl-C stops them."""
    results, began = Results(), time.monotonic()
    most = max((one.rounds for one in measurements), default=0)
    rounds = [(one, turn) for turn in range(most) for one in measurements if turn < one.rounds]
    try:
        for count, (one, turn) in enumerate(rounds, 1):
            try:
                if one.warm and turn == 0:
                    measure(one, one.arguments | one.warm, cache)
                found = measure(one, one.arguments, cache)
                results.rows.append((one, turn, found))
                results.missing.pop(one.name, None)  # of an earlier round
                said = ", ".join(f"{key} {found[key]:,.4g}" for key in numbers(found))
            except JobError as error:
                results.missing[one.name] = said = str(error)
            took = timedelta(seconds=round(time.monotonic() - began))
            say(f"{took} {count}/{len(rounds)} {one.name}: {said}")
    except (KeyboardInterrupt, BrokenPipeError):  # nobody reads what is said
        results.stopped = True
    return results


def measure(one: Measurement, arguments: Result, cache: Path, timeout: float = LONGEST) -> Result:
    """What the processes of a round found together: their rates are added, other numbers are averaged.

    `peak` is the peak memory [GB] of each with those that it started. Raises a JobError.
    """
    if one.needs and importlib.util.find_spec(one.needs) is None:
        raise JobError(f"{LIBRARIES[one.needs]} is not installed: pip install -e '.[bench]'")
    cache.mkdir(parents=True, exist_ok=True)
    env = os.environ | dict.fromkeys(THREADS, str(one.threads))
    env["TORCHINDUCTOR_CACHE_DIR"] = str(cache.resolve())
    peak, end = 0.0, time.monotonic() + timeout
    with ExitStack() as ending:
        folder = Path(ending.enter_context(tempfile.TemporaryDirectory()))
        if "meeting" in arguments:
            arguments = arguments | {"meeting": str(folder)}
        said = [folder / str(copy) for copy in range(one.copies)]
        jobs = [ending.enter_context(_started(one.job, arguments, env, path)) for path in said]
        while any(job.poll() is None for job in jobs) and not any(job.poll() for job in jobs):
            if time.monotonic() > end:
                raise JobError(f"failed: it took longer than {timeout:.0f} s")
            peak = max(peak, sum(memory(job.pid) for job in jobs) / one.copies)
            time.sleep(min(timeout, 0.5))
        found = [_found(job, path) for job, path in zip(jobs, said, strict=True)]
    sums = {key: sum(each[key] for each in found) for key in numbers(found[0])}
    means = {key: sums[key] / one.copies for key in sums if key != "rate" and not key.isdigit()}
    return found[0] | sums | means | {"peak": peak}


def numbers(found: Result) -> list[str]:
    return [key for key, value in found.items() if type(value) in (int, float)]


@contextmanager
def _started(job: str, arguments: Result, env: dict[str, str], said: Path) -> Iterator[Process]:
    """A process that runs a job and writes into a file; it ends with the block, and its workers with it."""
    command = [sys.executable, "-m", "uavnav.bench.jobs", job, json.dumps(arguments), str(time.time())]
    how: Any = {"env": env, "stdin": subprocess.PIPE, "start_new_session": True}
    with said.open("wb") as out, subprocess.Popen(command, stdout=out, stderr=out, **how) as process:
        try:
            yield process
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def _found(job: Process, said: Path) -> Result:
    """What a job that has ended has found; nothing where it still runs. Raises JobError where it failed."""
    lines = said.read_text(errors="replace").strip().splitlines()
    if job.poll():
        raise JobError(f"failed: {lines[-1] if lines else job.returncode}")
    return dict(json.loads(next((line for line in reversed(lines) if line.startswith("{")), "{}")))


def memory(session: int) -> float:
    """The memory of all processes of a session, shared pages counted once [GB]; 0 where there is no /proc."""
    total = 0
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, IndexError):  # it may have ended by now
            if int((process / "stat").read_text().rpartition(")")[2].split()[3]) == session:
                lines = (process / "smaps_rollup").read_text().splitlines()
                total += sum(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    return total * 1024 / 1e9


def _end_with_parent() -> None:
    """End at once when the process that started this one has closed the standard input."""
    while os.read(sys.stdin.fileno(), 1):
        pass
    os._exit(1)


def main(argv: list[str]) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    name, arguments, launched = argv
    module, function = name.split(".")
    job = getattr(importlib.import_module(f"uavnav.bench.{module}"), function)
    print(f"\n{json.dumps(job(float(launched), **json.loads(arguments)))}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
