"""What measurements found, and the arithmetic and the words for it."""

from __future__ import annotations

import datetime
import math
import statistics
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

Result = dict[str, Any]


class Results:
    """`found` holds the rounds of each measurement, and for each round what its processes found."""

    def __init__(self) -> None:
        self.found: dict[str, list[list[Result]]] = defaultdict(list)
        self.missing: dict[str, str] = {}  # why something was not measured

    def _rounds(self, name: str, key: str) -> list[list[float]]:
        rounds = self.found.get(name, [])
        return [[one[key] for one in group] for group in rounds if all(key in one for one in group)]

    def values(self, name: str, key: str) -> list[float]:
        """One number a round: the mean over its processes."""
        return [statistics.mean(group) for group in self._rounds(name, key)]

    def sums(self, name: str, key: str) -> list[float]:
        """One number a round: the sum over its processes."""
        return [sum(group) for group in self._rounds(name, key)]

    def median(self, name: str, key: str) -> float | None:
        return median(self.values(name, key))

    def batches(self, name: str) -> list[int]:
        """The batch sizes whose rates were found."""
        return sorted({int(key) for group in self.found.get(name, []) for key in group[0] if key.isdigit()})

    def measured(self, section: str) -> list[str]:
        """The measurements of a section that found something."""
        return [name for name, rounds in self.found.items() if name.startswith(f"{section}/") and rounds]


def median(values: Sequence[float]) -> float | None:
    return statistics.median(values) if values else None


def ratio(numerators: Sequence[float], denominators: Sequence[float]) -> float | None:
    """The median of the rounds' ratios, or the ratio of the medians where the two have different numbers of rounds."""
    if not numerators or not denominators:
        return None
    if len(numerators) == len(denominators):
        return statistics.median(a / b for a, b in zip(numerators, denominators, strict=True))
    return statistics.median(numerators) / statistics.median(denominators)


def number(value: float | None) -> str:
    """Three significant digits, with commas between thousands."""
    if value is None:
        return "-"
    if math.isinf(value):
        return "never"
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def clock(seconds: float | None) -> str:
    """Hours, minutes and seconds."""
    return "-" if seconds is None else str(datetime.timedelta(seconds=round(seconds)))


def table(head: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> list[str]:
    """A Markdown table; the first `left` columns are aligned left, the others right."""
    return [
        f"| {' | '.join(head)} |",
        f"|{'---|' * left}{'--:|' * (len(head) - left)}",
        *(f"| {' | '.join(row)} |" for row in rows),
    ]


def when() -> str:
    """The date and the commit of the code, with `+` where the code differs from the commit."""
    from uavnav.training.provenance import git_commit  # loads torch, which not every job needs

    return f"{datetime.datetime.now(datetime.UTC).date()}, commit {git_commit(10) or 'unknown'}"
