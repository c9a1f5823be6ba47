"""How long 8 configurations of 1,000 seeds take on 1, 10 and 100 machines, from the measured times of the
committed study.

    python docs/makespan.py results

A machine has two cores and runs two workers of ten seeds side by side, as the committed study did. A worker's
time is the wall time of its configuration, in which its snapshots are, and what start-up and evaluation add.
"""

import heapq
import json
import sys
from pathlib import Path

CONFIGURATIONS = 8
SEEDS = 1_000
SEEDS_PER_WORKER = 10
CORES = 2
START_SECONDS = 50.0
"""From a job's command line to its first frame, with cold caches of the compiler."""
EVALUATION_SECONDS = 95.0
"""Of ten seeds, 200 layouts, greedy and sampled, on one core."""


def worker_seconds(results: Path) -> list[float]:
    """One number a configuration."""
    metas = sorted(
        path
        for algorithm in ("ppo", "dqn")
        for path in (results / "vectorised" / algorithm).glob("*/meta.json")
    )
    return [
        json.loads(path.read_text())["wall_seconds"] + START_SECONDS + EVALUATION_SECONDS for path in metas
    ]


def makespan(jobs: list[float], cores: int) -> float:
    """When the last job ends, if each core takes the next of the list as soon as it is free."""
    free = [0.0] * cores
    for seconds in jobs:
        heapq.heapreplace(free, free[0] + seconds)
    return max(free)


def table(results: Path) -> str:
    """Rows of machines, hours, efficiency: the work over what all cores could have done until the end."""
    jobs = [seconds for seconds in worker_seconds(results) for _ in range(SEEDS // SEEDS_PER_WORKER)]
    rows = ["| machines | hours | efficiency |", "|--:|--:|--:|"]
    for machines in (1, 10, 100):
        cores = machines * CORES
        end = makespan(jobs, cores)
        rows.append(f"| {machines} | {end / 3600:.1f} | {sum(jobs) / (cores * end):.0%} |")
    return "\n".join(rows)


if __name__ == "__main__":
    print(table(Path(sys.argv[1])))
