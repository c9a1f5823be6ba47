"""Jobs: functions of the modules `worlds`, `ours` and `peers` that measure, each call in a fresh process.

`python -m uavnav.bench.jobs MODULE.FUNCTION '{"argument": ...}' LAUNCHED` prints what the function returns as JSON, in
its last line. LAUNCHED is the time at which the process was started [s since the epoch], so that start-up counts.
A job ends when its standard input does.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path

from uavnav.bench.results import Result

THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")
SAMPLED_EVERY = 1.0
"""Seconds from one look at a job's memory to the next."""


class JobError(RuntimeError):
    """A job failed or took too long; the message is one line."""


class Job:
    """A job in a fresh process, started at once.

    Args:
        name: module and function.
        arguments: the function's keyword arguments, as JSON holds them.
        threads: how many its libraries may use.
        cache: the folder of compiled graphs.
    """

    def __init__(self, name: str, arguments: Result, threads: int, cache: Path) -> None:
        env = os.environ | dict.fromkeys(THREADS, str(threads)) | {"TORCHINDUCTOR_CACHE_DIR": str(cache.resolve())}
        command = [sys.executable, "-m", "uavnav.bench.jobs", name, json.dumps(arguments), str(time.time())]
        self._peak = 0.0
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the job
        listen, self._held = os.pipe()  # not Popen's own, which `communicate` closes
        self._process = subprocess.Popen(
            command, env=env, stdin=listen, stdout=subprocess.PIPE, stderr=self._errors, start_new_session=True
        )
        os.close(listen)

    def result(self, timeout: float) -> Result:
        """Wait for what the job found; `peak` is the peak memory of all its processes together [GB].

        Raises:
            JobError: the job failed, or took longer than `timeout` seconds, after which it is ended.
        """
        end = time.monotonic() + timeout
        while True:
            try:
                output, _ = self._process.communicate(timeout=min(max(end - time.monotonic(), 0.01), SAMPLED_EVERY))
                break
            except subprocess.TimeoutExpired:
                if time.monotonic() > end:
                    self.stop()
                    raise JobError(f"it took longer than {timeout:.0f} s") from None
                self._peak = max(self._peak, memory(self._process.pid))
        if self._process.returncode:
            self._errors.seek(0)
            lines = self._errors.read().decode(errors="replace").strip().splitlines()
            raise JobError(lines[-1] if lines else f"exit status {self._process.returncode}")
        found: Result = json.loads(output.splitlines()[-1])
        return found | {"peak": self._peak}

    def stop(self) -> None:
        """End the process and those that it started, if they still run."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        for process in _session(self._process.pid):  # processes that share a run's seeds are groups of their own
            with suppress(ProcessLookupError):
                os.kill(int(process.name), signal.SIGKILL)
        self._process.wait()
        if self._process.stdout and not self._process.stdout.closed:
            self._process.stdout.close()
        if not self._errors.closed:
            self._errors.close()
            os.close(self._held)


def memory(session: int) -> float:
    """The memory of all processes of a session, shared pages counted once [GB]; 0 where /proc is not there."""
    total = 0
    for process in _session(session):
        with suppress(OSError):  # it may have ended by now
            lines = (process / "smaps_rollup").read_text().splitlines()
            total += sum(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    return total * 1024 / 1e9


def _session(number: int) -> list[Path]:
    """The folders in /proc of the processes of a session; none where there is no /proc."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, ValueError, IndexError):  # it may have ended by now
            if int((process / "stat").read_text().rpartition(")")[2].split()[3]) == number:
                found.append(process)
    return found


# -- in the process of a job ------------------------------------------------------------------------------------------


def _end_with_parent() -> None:
    """End at once when the process that started this one is gone, and no longer holds the standard input."""
    while os.read(sys.stdin.fileno(), 1):
        pass
    os._exit(1)


def main(argv: list[str]) -> None:
    """Run one job and print what it found."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    name, arguments, launched = argv
    module, function = name.split(".")
    job = getattr(importlib.import_module(f"uavnav.bench.{module}"), function)
    print(json.dumps(job(float(launched), **json.loads(arguments))), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
