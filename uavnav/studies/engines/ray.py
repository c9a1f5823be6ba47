"""Jobs on a Ray cluster: each is one call of `subprocess.call` on one CPU; nothing of ours is pickled.

Each job is given to one machine, so that it is known to have died where Ray says that the machine has. Ray
itself may never tell the end of a job whose machine is gone.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from uavnav.errors import ConfigError
from uavnav.studies import engines

SECONDS = 60.0  # given to a machine to answer
KNOCK_SECONDS = 5.0
LOOK_SECONDS = 0.5  # between two looks which machines live
KNOCKS = 3  # how often the head of the cluster may fail to answer


@dataclass
class Ray:
    """The CPUs of a Ray cluster, as many as it has at each moment.

    address: of the cluster's head; `auto` is the one that runs on this machine.
    """

    SEEDS_PER_WORKER: ClassVar[int | None] = 10

    address: str = "auto"

    def __post_init__(self) -> None:
        try:
            import ray
        except ModuleNotFoundError as error:
            raise engines.missing("ray") from error
        self._ray: Any = ray
        try:
            _knock(os.environ.get("RAY_ADDRESS", self.address) if self.address == "auto" else self.address)
            ray.init(address=self.address, log_to_driver=False, logging_level=logging.ERROR)
        except (OSError, RuntimeError, ValueError) as error:
            raise ConfigError(
                f"engine=ray: there is no Ray cluster at address={self.address}; `ray start --head` begins "
                "one"
            ) from error
        self._head: str = ray.get_runtime_context().gcs_address
        self._running: dict[Any, str] = {}  # the machine of each job
        self._doubted: set[str] = set()  # machines where a job was silent, or did not begin
        self._seen, self._living, self._answering = -math.inf, dict[str, int](), dict[str, int]()

    def _machines(self) -> dict[str, int]:
        """The CPUs of each machine that lives; some of these may not answer any more, and get no further job.

        Raises a ConfigError where the head of the cluster is gone, for which Ray itself would wait.
        """
        if time.monotonic() - self._seen < LOOK_SECONDS:
            return dict(self._living)
        for again in range(KNOCKS):
            try:
                time.sleep(again * KNOCK_SECONDS)
                _knock(self._head)
                break
            except OSError as error:
                problem = error
        else:
            where = f"engine=ray: the cluster at address={self.address}"
            raise ConfigError(f"{where} does not answer any more ({problem}); the same command goes on")
        nodes = [node for node in self._ray.nodes() if node["Alive"]]
        self._living = {node["NodeID"]: int(node["Resources"].get("CPU", 0)) for node in nodes}
        with ThreadPoolExecutor() as pool:
            answers = pool.map(
                _answers, [f"{node['NodeManagerAddress']}:{node['NodeManagerPort']}" for node in nodes]
            )
        answering = {node["NodeID"] for node, there in zip(nodes, answers, strict=True) if there}
        self._answering = {key: n for key, n in self._living.items() if key in answering or not answering}
        self._seen = time.monotonic()
        return dict(self._living)

    def slots(self) -> int:
        self._machines()
        return sum(self._answering.values())

    def check(self, folder: Path) -> None:
        call, exists = self._ray.remote(subprocess.call), self._ray.remote(os.path.exists)
        names, asked = {}, {}
        with engines.Probe(folder) as probe:
            for node in self._ray.nodes():
                if node["Alive"]:
                    key = node["NodeID"]
                    how = {"num_cpus": 0, "scheduling_strategy": self._only(key)}
                    names[key] = f"the machine {node['NodeManagerHostname']} of the Ray cluster"
                    asked[key] = [
                        call.options(**how).remote(probe.words(key)),
                        exists.options(**how).remote(sys.executable),
                    ]
            for key, name in names.items():
                try:
                    failed, runs = self._ray.get(asked[key], timeout=SECONDS)
                except self._ray.exceptions.RayError as error:
                    raise ConfigError(f"engine=ray: {name} does not answer") from error
                limit = time.monotonic() + probe.SECONDS
                while not failed and not probe.answered(key):
                    failed = time.monotonic() > limit
                    time.sleep(0.1)
                if failed:
                    raise engines.unseen(folder, name)
                if not runs:
                    raise engines.lacking("ray", name)

    def _only(self, machine: str) -> Any:
        """How Ray is told to run something on one machine, or nowhere."""
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        return NodeAffinitySchedulingStrategy(machine, soft=False)

    def start(self, jobs: Sequence[list[str]]) -> list[Any]:
        self._machines()
        free = dict(self._answering)
        given = list(self._running)
        done, _ = self._ray.wait(given, num_returns=len(given), timeout=0) if given else ([], [])
        for job in done:
            del self._running[job]
        for machine in self._running.values():
            if machine in free:
                free[machine] -= 1
        if not free:
            raise ConfigError("engine=ray: the cluster has no machine left; the same command goes on")
        started = []
        for words in jobs:
            machine = max(free, key=lambda one: (free[one] > 0, one not in self._doubted, free[one]))
            free[machine] -= 1
            call = self._ray.remote(subprocess.call)
            job = call.options(num_cpus=1, max_retries=0, scheduling_strategy=self._only(machine)).remote(
                words
            )
            self._running[job] = machine
            started.append(job)
        return started

    def ended(self, job: Any) -> bool:
        done, _ = self._ray.wait([job], timeout=0)
        if not done and self._running.get(job) in self._machines():
            return False
        self._running.pop(job, None)
        return True

    def queued(self, job: Any) -> bool:
        machine = self._running.get(job)
        # its jobs, in the order in which they were given
        there = [one for one, where in self._running.items() if where == machine]
        return machine in self._machines() and job in there[self._living[machine] :]

    def cancel(self, job: Any) -> None:
        if machine := self._running.pop(job, None):
            self._doubted.add(machine)
        with contextlib.suppress(self._ray.exceptions.RayError, ValueError):
            self._ray.cancel(job, force=True)

    def close(self) -> None:
        self._ray.shutdown()


def _answers(address: str) -> bool:
    try:
        _knock(address)
    except OSError:
        return False
    return True


def _knock(address: str) -> None:
    """Raise an OSError where nobody listens at host:port; Ray itself would wait a minute."""
    host, _, port = address.rpartition("://")[2].rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host, int(port)), KNOCK_SECONDS).close()
