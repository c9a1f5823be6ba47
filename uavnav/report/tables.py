"""Tables: the paper's beside ours in every reading, and how the runs were made. Rows of strings, the first a header."""

from __future__ import annotations

import datetime

import pandas as pd

from uavnav import paper
from uavnav.metrics import METRICS, per_seed
from uavnav.report.cells import Cell, one_line, readings, show
from uavnav.runs import Run


def table(cells: list[Cell], algorithm: str, ratio_of_means: bool) -> list[list[str]]:
    """A header and rows: for each activation the paper's, then every reading of each cell.

    ratio_of_means: the ratios alone, as ratios of means (decision 13).
    """
    metrics = [name for name, metric in METRICS.items() if metric.scale is not None or not ratio_of_means]
    rows = [["activation", "reading", "seeds", "episodes", "cut off", *(METRICS[name].label for name in metrics)]]
    of_paper = [activation for name, activation in paper.TABLES if name == algorithm]
    for activation in dict.fromkeys([*of_paper, *(cell.activation for cell in cells)]):
        ours = [cell for cell in cells if cell.activation == activation]
        if activation in of_paper:
            printed = paper.TABLES[algorithm, activation]
            beside = [f"{printed[name]:,}" if name in printed else "-" for name in metrics]
            rows.append([activation, "the paper", "1", "-", "-", *beside])
        if not ours:
            rows.append([activation, "missing: no finished run", "0", *["-"] * (len(metrics) + 2)])
        for cell in ours:
            for name, part in readings(cell).items():
                reading = name if len(part) else f"{name}: missing"
                rows.append([cell.label, reading, *_values(part, metrics, ratio_of_means)])
    return rows


def _values(part: pd.DataFrame, metrics: list[str], ratio_of_means: bool) -> list[str]:
    """Seeds, episodes, share cut off, and each metric as mean ± standard deviation over seeds."""
    if part.empty:
        return ["0", "0", *["-"] * (len(metrics) + 1)]
    seeds, cut = per_seed(part, ratio_of_means), part[part["truncated"]]
    share = f"{len(cut) / len(part):.1%}" + (f" at {cut['steps'].max():,} steps" if len(cut) else "")
    return [str(len(seeds)), f"{len(part):,}", share, *(_spread(seeds[name], METRICS[name].digits) for name in metrics)]


def _spread(values: pd.Series[float], digits: int) -> str:
    mean = f"{values.mean():,.{digits}f}"
    return mean if len(values) == 1 else f"{mean} ± {values.std():,.{digits}f}"


def facts(runs: list[Run]) -> list[str]:
    """Versions, commits, machines and banks, and which runs have which where they are not the same."""
    lines = []
    for kind in ("versions", "git_commit", "machine", "bank"):
        groups: dict[str, list[str]] = {}
        for run in runs:
            fact = run.meta.get(kind)
            if isinstance(fact, dict):
                fact = ", ".join(f"{key} {show(value)}" for key, value in fact.items())
            groups.setdefault(one_line(fact or "not known"), []).append(str(run.path))
        for value, paths in groups.items():
            lines.append(f"{kind.replace('_', ' ')}: {value}" + (f" ({', '.join(paths)})" if len(groups) > 1 else ""))
    return lines


def run_table(cells: list[Cell]) -> list[list[str]]:
    rows = [["run", "cell", "seeds", "frames per seed", "ended", "wall time", "threads", "compiled"]]
    for run, name in [(run, f"{cell.algorithm} {cell.activation}") for cell in cells for run in cell.runs]:
        seconds, first, last = run.meta.get("wall_seconds"), run.seeds[0], run.seeds[-1]
        wall = str(datetime.timedelta(seconds=round(seconds))) if isinstance(seconds, (int, float)) else "not known"
        how = [show(run.meta.get(fact, "not known")) for fact in ("threads", "compiled")]
        seeds = str(first) if first == last else f"{first} ... {last}"
        ended = str(run.meta.get("ended", "not known")).partition("T")[0]
        rows.append([str(run.path), name, seeds, f"{run.frames:,}", ended, wall, *how])
    return rows


def markdown(rows: list[list[str]]) -> str:
    """A table whose first row is its header and whose numbers, from the third column on, are right-aligned."""
    rule = ["---" if place < 2 else "---:" for place in range(len(rows[0]))]
    lines = (" | ".join(cell.replace("|", "\\|") for cell in row) for row in [rows[0], rule, *rows[1:]])
    return "\n".join(f"| {line} |" for line in lines)
