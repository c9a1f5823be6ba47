"""The sections of `uavnav bench`, and where it writes."""

from pathlib import Path

QUICK = ("world", "gymnasium", "training")
BY_DEFAULT = (*QUICK, "memory")
LONGER = ("worlds",)
"""The sections that a quick run measures, those of a plain run, and those that only `--only` chooses."""

OUT = Path("docs/benchmarks.md")
SCRATCH = Path("build/bench")
"""The folder of compiled graphs, and of what `--quick` writes."""
