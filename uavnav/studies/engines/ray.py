"""Jobs on a Ray cluster: each is one call of `subprocess.call` on one CPU, so that nothing of ours is pickled."""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from uavnav.help.choices import ConfigError
from uavnav.studies import engines

SECONDS = 60.0
"""Given to a machine to answer."""
KNOCK_SECONDS = 5.0


@dataclass
class Ray:
    """The CPUs of a Ray cluster, as many as it has at each moment.

    address: of the cluster's head; `auto` is the one that runs on this machine.
    """

    SEEDS_PER_SHARE: ClassVar[int | None] = 10

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
                f"engine=ray: there is no Ray cluster at address={self.address}; `ray start --head` begins one"
            ) from error
        self._call = ray.remote(subprocess.call).options(num_cpus=1, max_retries=0)

    def slots(self) -> int:
        return int(self._ray.cluster_resources().get("CPU", 0))

    def check(self, folder: Path) -> None:
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        exists = self._ray.remote(os.path.exists)
        for node in self._ray.nodes():
            if node["Alive"]:
                there = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
                ask = exists.options(num_cpus=0, scheduling_strategy=there)
                name = f"the machine {node['NodeManagerHostname']} of the Ray cluster"
                try:
                    sees, runs = self._ray.get([ask.remote(str(folder)), ask.remote(sys.executable)], timeout=SECONDS)
                except self._ray.exceptions.RayError as error:
                    raise ConfigError(f"engine=ray: {name} does not answer") from error
                if not sees:
                    raise engines.unseen(folder, name)
                if not runs:
                    raise ConfigError(f"engine=ray: {name} has no {sys.executable}; install uavnav there, at that path")

    def start(self, jobs: Sequence[list[str]]) -> list[Any]:
        return [self._call.remote(words) for words in jobs]

    def ended(self, job: Any) -> bool:
        done, _ = self._ray.wait([job], timeout=0)
        return bool(done)

    def close(self) -> None:
        self._ray.shutdown()


def _knock(address: str) -> None:
    """Raise an OSError where nobody listens at host:port; Ray itself would wait a minute and then end the process."""
    host, _, port = address.rpartition(":")
    if host and port.isdigit() and "://" not in address:
        socket.create_connection((host, int(port)), KNOCK_SECONDS).close()
