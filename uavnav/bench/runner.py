"""Runs measurements one after the other, each in fresh processes."""

from __future__ import annotations

import importlib.util
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from uavnav.bench.jobs import Job, JobError
from uavnav.bench.plan import PEERS, Measurement
from uavnav.bench.results import Result, Results, clock, number

INSTALL = "pip install -e '.[bench]'"
LONGEST = 4 * 3600.0
"""Seconds after which any measurement is given up."""


class Runner:
    """Runs measurements, and stops at Ctrl-C; `stopped` is true from then on.

    Args:
        folder: for compiled graphs.
        say: shows a line.
    """

    def __init__(self, folder: Path, say: Callable[[str], None]) -> None:
        self.folder = folder
        self.stopped = False
        self.began = time.monotonic()
        self._say = say

    def run(self, measurements: Sequence[Measurement]) -> Results:
        """All measurements, round by round, so that the machine's drift falls on all alike."""
        results = Results()
        try:
            rounds = [(turn, one) for turn in range(9) for one in measurements if turn < one.rounds]
            for count, (turn, one) in enumerate(rounds, 1):
                self._run(one, f"{count}/{len(rounds)}", turn, results)
        except KeyboardInterrupt:
            self.stopped = True
            for one in measurements:
                if not results.found.get(one.name):
                    results.missing.setdefault(one.name, "the run was stopped before")
        return results

    def _run(self, one: Measurement, count: str, turn: int, results: Results) -> None:
        if one.needs and importlib.util.find_spec(one.needs) is None:
            said = f"{PEERS[one.needs]} is not installed: {INSTALL}"
        else:
            try:
                if one.warm and turn == 0:
                    changed = [process | one.warm for process in one.processes]
                    self.measure(replace(one, processes=changed))
                found = self.measure(one)
                results.found[one.name].append(found)
                self._tell(f"{count} {one.name}: {_short(found)}")
                return
            except JobError as error:
                said = f"failed: {error}"
        if turn == 0 or said.startswith("failed"):
            results.missing[one.name] = said
            self._tell(f"{count} {one.name}: {said}")

    def _tell(self, line: str) -> None:
        self._say(f"{clock(time.monotonic() - self.began)} {line}")

    def measure(self, one: Measurement) -> list[Result]:
        """One round: what each process found.

        Raises:
            JobError: one of the processes failed; the others have ended too.
        """
        graphs = self.folder / one.cache
        if one.cold:
            shutil.rmtree(graphs, ignore_errors=True)
        graphs.mkdir(parents=True, exist_ok=True)
        running: list[Job] = []
        found, errors = [], []
        with tempfile.TemporaryDirectory() as folder:
            meeting = {"meeting": folder, "copies": len(one.processes)} if one.together else {}
            try:
                running.extend(Job(one.job, process | meeting, one.threads, graphs) for process in one.processes)
                for job in running:
                    try:
                        found.append(job.result(LONGEST))
                    except JobError as error:
                        errors.append(error)
            finally:
                for job in running:
                    job.stop()
        if errors:
            raise errors[0]
        return found


def _short(found: list[Result]) -> str:
    """The numbers of the first process."""
    pairs = [(key, value) for key, value in found[0].items() if type(value) in (int, float)]
    return ", ".join(f"{key} {number(value)}" for key, value in pairs)
