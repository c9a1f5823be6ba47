"""How long 8 cells of 1,000 seeds take on 1, 10 and 100 machines, from the measured times of the committed study.

    python docs/makespan.py results

A machine has two cores and runs two shares of ten seeds side by side, as the committed study did. A share's time is the
wall time of its cell, in which its snapshots are, and what start-up and evaluation add.
"""

import heapq
import json
import sys
from pathlib import Path

CELLS = 8
SEEDS = 1_000
SEEDS_PER_SHARE = 10
CORES = 2
START_SECONDS = 50.0
"""From a job's command line to its first frame, with cold caches of the compiler."""
EVALUATION_SECONDS = 95.0
"""Of ten seeds, 200 sets, greedy and sampled, on one core."""


def share_seconds(results: Path) -> list[float]:
    """One number a cell."""
    metas = sorted(
        path for algorithm in ("ppo", "dqn") for path in (results / "vectorised" / algorithm).glob("*/meta.json")
    )
    return [json.loads(path.read_text())["wall_seconds"] + START_SECONDS + EVALUATION_SECONDS for path in metas]


def makespan(jobs: list[float], workers: int) -> float:
    """When the last job ends, if each worker takes the next of the list as soon as it is free."""
    free = [0.0] * workers
    for seconds in jobs:
        heapq.heapreplace(free, free[0] + seconds)
    return max(free)


def table(results: Path) -> str:
    """Rows of machines, hours, efficiency: the work over what all cores could have done until the end."""
    jobs = [seconds for seconds in share_seconds(results) for _ in range(SEEDS // SEEDS_PER_SHARE)]
    rows = ["| machines | hours | efficiency |", "|--:|--:|--:|"]
    for machines in (1, 10, 100):
        workers = machines * CORES
        end = makespan(jobs, workers)
        rows.append(f"| {machines} | {end / 3600:.1f} | {sum(jobs) / (workers * end):.0%} |")
    return "\n".join(rows)


if __name__ == "__main__":
    print(table(Path(sys.argv[1])))
