"""Jobs on a Ray cluster: each is one call of `subprocess.call` on one CPU, so that nothing of ours is pickled."""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
import time
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

        call, exists = self._ray.remote(subprocess.call), self._ray.remote(os.path.exists)
        names, asked = {}, {}
        with engines.Probe(folder) as probe:
            for node in self._ray.nodes():
                if node["Alive"]:
                    key = node["NodeID"]
                    how = {"num_cpus": 0, "scheduling_strategy": NodeAffinitySchedulingStrategy(key, soft=False)}
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
