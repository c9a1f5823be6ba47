"""Benchmarks, `uavnav bench`: a table of jobs (`plan`), one runner (`jobs`) and the page that it writes."""

from pathlib import Path
from typing import Any

Result = dict[str, Any]  # what a job finds: JSON by name
QUICK = ("world", "gymnasium", "training")
BY_DEFAULT = (*QUICK, "memory")
LONGER = ("tasks",)
"""The sections that a quick run measures, those of a plain run, and those that only `--only` chooses."""
OUT = Path("docs/benchmarks.md")
SCRATCH = Path("build/bench")  # the folder of compiled graphs, and of what `--quick` writes
