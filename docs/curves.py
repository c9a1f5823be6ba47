"""Draw docs/curves-ALGORITHM.png, the learning curves of committed runs (`python docs/curves.py ppo dqn`)."""

from __future__ import annotations

import math
import sys
from pathlib import Path

from uavnav import style
from uavnav.report.charts import curves
from uavnav.report.configurations import read
from uavnav.runs import paper

DOCS = Path(__file__).parent
RESULTS = DOCS.parent / "results"


def draw(algorithm: str) -> bytes:
    """The four activations of the paper: reward per frame, with the paper's means where it has some."""
    study = "paper" if algorithm in ("ppo", "dqn") else "algorithms"
    found = {name: read(RESULTS / study / algorithm / name) for name in paper.ACTIVATIONS}
    printed = {name: paper.printed(algorithm, name, "reward", per_frame=True) for name in found}
    known = {name: mean for name, mean in printed.items() if math.isfinite(mean)}
    return style.png(curves(found, known, f"{algorithm.upper()}: ").figure)


if __name__ == "__main__":
    for name in sys.argv[1:]:
        (DOCS / f"curves-{name}.png").write_bytes(draw(name))
