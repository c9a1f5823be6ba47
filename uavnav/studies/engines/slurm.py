"""Jobs on a SLURM cluster, through submitit: those given together are one job array."""

from __future__ import annotations

import contextlib
import shutil
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

from uavnav.errors import ConfigError
from uavnav.settings import Count
from uavnav.studies import engines

SACCT_SECONDS = 30  # the time between two questions to SLURM
FREE = ["sinfo", "--noheader", "--Node", "--states=idle,mixed", "--format=%N %P"]
"""Lists the machines that take a job at once, with their partitions; a star marks the cluster's own."""
QUEUED = ("PENDING", "REQUEUE", "CONFIGURING", "RESV_DEL_HOLD", "SPECIAL_EXIT", "SUSPENDED", "STOPPED")
"""States of a job that waits, for however long."""
ANY = "a machine"


@dataclass
class Slurm:
    """A SLURM cluster, from a machine that has its `sbatch`.

    partition: where jobs go; by default the cluster's own.
    time: limit of a job [minutes]; a worker that reaches it is given again and goes on.
    memory: of a job [GB].
    jobs: at once, in one array.
    cluster: `local` runs submitit's jobs as processes of this machine, to try.
    """

    SEEDS_PER_WORKER: ClassVar[int | None] = 10

    partition: str | None = None
    time: Count = 240
    memory: Count = 4
    jobs: Count = 100
    cluster: Literal["slurm", "local"] = "slurm"

    def __post_init__(self) -> None:
        try:
            import submitit
        except ModuleNotFoundError as error:
            raise engines.missing("slurm") from error
        if self.cluster == "slurm" and shutil.which("sbatch") is None:
            raise ConfigError(
                "engine=slurm: there is no sbatch on this machine; give the command where it is"
            )
        self._submitit: Any = submitit
        self._running: list[Any] = []
        self._executor: Any = None
        submitit.SlurmJob.watcher._delay_s = SACCT_SECONDS

    def slots(self) -> int:
        return self.jobs

    def check(self, folder: Path) -> None:
        if self._executor is not None:
            return
        try:
            self._executor = self._submitit.AutoExecutor(folder=folder / "slurm", cluster=self.cluster)
        except RuntimeError as error:  # there is no `srun`
            raise ConfigError(f"engine=slurm: {error}; give the command where SLURM is installed") from error
        self._executor.update_parameters(
            name="uavnav",
            timeout_min=self.time,
            mem_gb=self.memory,
            cpus_per_task=1,
            slurm_array_parallelism=self.jobs,
            **({"slurm_partition": self.partition} if self.partition else {}),
        )
        with engines.Probe(folder) as probe:
            asked = {ANY: self.start([probe.words(ANY)])[0]}
            for machine in self._free():
                self._executor.update_parameters(slurm_nodelist=machine)
                with contextlib.suppress(ConfigError):  # it is too small for such jobs
                    (asked[machine],) = self.start([probe.words(machine)])
            self._executor.update_parameters(slurm_nodelist=None)
            self._wait(folder, probe, asked)

    def _free(self) -> list[str]:
        """Machines that take a job at once; none where it cannot be told."""
        if self.cluster != "slurm":
            return []
        try:
            said = subprocess.run(FREE, capture_output=True, text=True, check=True, timeout=60).stdout
        except (OSError, subprocess.SubprocessError):
            return []
        rows = [line.split() for line in said.splitlines()]
        return sorted({machine for machine, where in rows if self._goes_to(where)})

    def _goes_to(self, partition: str) -> bool:
        return partition.rstrip("*") == self.partition if self.partition else partition.endswith("*")

    def _wait(self, folder: Path, probe: engines.Probe, asked: dict[str, Any]) -> None:
        """Wait for the answers of machines; one that is busy by now need not answer, if another has."""
        ended: dict[str, float] = {}
        limit, patience = float("inf"), time.monotonic() + engines.Probe.PATIENCE
        while left := [machine for machine in asked if not probe.answered(machine)]:
            now = time.monotonic()
            limit = min(limit, now + probe.SECONDS) if len(left) < len(asked) else limit
            silent = [machine for machine in left if self.ended(asked[machine])]
            for machine in silent:
                if now >= ended.setdefault(machine, now) + probe.SECONDS:
                    name = f"{machine if machine == ANY else f'the machine {machine}'} of the SLURM cluster"
                    heard = asked[machine].paths.stderr.exists()
                    raise engines.lacking("slurm", name) if heard else engines.unseen(folder, name)
            if now >= limit and not silent:
                break
            if now >= patience and not any(self.queued(asked[machine]) for machine in left):
                raise engines.unseen(folder, f"{left[0]} of the SLURM cluster")
            time.sleep(1)
        for machine in left:
            asked[machine].cancel()

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
        return bool(job.done())  # failed with its machine, too

    def queued(self, job: Any) -> bool:
        return str(job.state).startswith(QUEUED)

    def cancel(self, job: Any) -> None:
        with contextlib.suppress(OSError, subprocess.SubprocessError):
            job.cancel()

    def close(self) -> None:
        for job in self._running:
            if not job.done():
                job.cancel()
