"""Jobs on a SLURM cluster, through submitit: each is a command line, and those given together are one job array."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

from uavnav.help.choices import ConfigError
from uavnav.studies import engines

SACCT_SECONDS = 30
"""The time between two questions to SLURM."""
SEEN_SECONDS = 60.0
"""The time in which what one machine writes is seen by another."""


@dataclass
class Slurm:
    """A SLURM cluster, from a machine that has its `sbatch`.

    partition: where jobs go; by default the cluster's own.
    time: limit of a job [minutes]; a share that reaches it is given again and goes on.
    memory: of a job [GB].
    jobs: at once, in one array.
    cluster: `local` runs submitit's jobs as processes of this machine, to try.
    """

    SEEDS_PER_SHARE: ClassVar[int | None] = 10

    partition: str | None = None
    time: int = field(default=240, metadata={"least": 1})
    memory: int = field(default=4, metadata={"least": 1})
    jobs: int = field(default=100, metadata={"least": 1})
    cluster: Literal["slurm", "local"] = "slurm"

    def __post_init__(self) -> None:
        try:
            import submitit
        except ModuleNotFoundError as error:
            raise engines.missing("slurm") from error
        if self.cluster == "slurm" and shutil.which("sbatch") is None:
            raise ConfigError("engine=slurm: there is no sbatch on this machine; give the command where it is")
        self._submitit: Any = submitit
        self._running: list[Any] = []
        submitit.SlurmJob.watcher._delay_s = SACCT_SECONDS

    def slots(self) -> int:
        return self.jobs

    def check(self, folder: Path) -> None:
        self._executor = self._submitit.AutoExecutor(folder=folder / "slurm", cluster=self.cluster)
        self._executor.update_parameters(
            name="uavnav",
            timeout_min=self.time,
            mem_gb=self.memory,
            cpus_per_task=1,
            slurm_array_parallelism=self.jobs,
            **({"slurm_partition": self.partition} if self.partition else {}),
        )
        seen = folder / "slurm" / "seen"
        seen.unlink(missing_ok=True)
        (probe,) = self.start([["touch", str(seen)]])
        while not self.ended(probe):
            time.sleep(1)
        limit = time.monotonic() + SEEN_SECONDS
        while seen.name not in os.listdir(seen.parent):
            if time.monotonic() > limit:
                raise engines.unseen(folder, "a machine of the SLURM cluster")
            time.sleep(1)

    def start(self, jobs: Sequence[list[str]]) -> list[Any]:
        function, utils = self._submitit.helpers.CommandFunction, self._submitit.core.utils
        try:
            with self._executor.batch():
                started = [self._executor.submit(function(words, verbose=False)) for words in jobs]
        except (utils.UncompletedJobError, utils.FailedSubmissionError) as error:
            said = str(error).strip().splitlines()[-1]
            raise ConfigError(f"engine=slurm: sbatch refused the job ({said})") from error
        self._running += started
        return started

    def ended(self, job: Any) -> bool:
        return bool(job.done())

    def close(self) -> None:
        for job in self._running:
            if not job.done():
                job.cancel()
