"""Tables for people: rows of strings, the first of them a header; in Markdown, HTML and LaTeX alike."""

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from uavnav import paper, stats
from uavnav.decisions import DECISIONS, HEADER
from uavnav.metrics import METRICS, finished, per_seed
from uavnav.report.cells import Cell, one_line, readings, show
from uavnav.report.claims import UNDECIDED, Claim, Finding, verdict
from uavnav.report.frames import name
from uavnav.report.studies import Cells
from uavnav.runs import Run

Rows = list[list[str]]
NOTHING = "–"
MANY = 10_000
"""Seeds of which more is as good as never."""


def number(value: float, digits: int = 2) -> str:
    """A number for people; a dash where there is none, more digits where fewer would show nothing."""
    if math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if value and abs(value) < 10**-digits:
        return f"{value:.1g}".replace("-", "−")
    return f"{value:,.{digits}f}".replace("-", "−")


def with_interval(value: float, low: float, high: float, digits: int = 2) -> str:
    """A number and its interval in brackets, where it has one."""
    shown = number(value, digits)
    return shown if math.isnan(low) else f"{shown} [{number(low, digits)}, {number(high, digits)}]"


# -- the audit --------------------------------------------------------------------------------------------------------


def audit_rows(findings: Sequence[Finding]) -> Rows:
    """The parts of a claim."""
    header = ["question", "the paper", "ours, adjusted interval", "claimed", "Holm's p", "seeds", "verdict"]
    rows = [header]
    for one in findings:
        own = number(one.paper, one.digits) + (" (against the claim)" if one.against_itself else "")
        ours = with_interval(one.value, one.low, one.high, one.digits)
        p = NOTHING if math.isnan(one.p_holm) else "< 0.001" if one.p_holm < 0.001 else f"{one.p_holm:.3f}"
        rows.append([one.text, own, ours, one.region, p, str(one.n), said(one)])
    return rows


def said(finding: Finding) -> str:
    """A verdict, and how many seeds it would take where there is none."""
    if finding.verdict != UNDECIDED:
        return finding.verdict
    if not finding.n:
        return "undecided (no runs)"
    needed = NOTHING if math.isnan(finding.needed) else f"about {finding.needed:,.0f} seeds needed"
    needed = f"more than {MANY:,} seeds needed" if MANY < finding.needed < math.inf else needed
    needed = "no number of seeds would do" if math.isinf(finding.needed) else needed
    return f"undecided (n = {finding.n}" + ("" if needed == NOTHING else f", {needed}") + ")"


def overview(claims: Sequence[Claim], audits: Mapping[str, Sequence[Finding]], primary: str) -> Rows:
    """One row a claim: its verdict in the primary reading, and in the others."""
    others = [reading for reading in audits if reading != primary]
    rows = [["", "the paper says", "verdict", "parts supported, contradicted, undecided", *others]]
    for claim in claims:
        of = {reading: [one for one in found if one.claim == claim.number] for reading, found in audits.items()}
        parts = pd.Series([one.verdict for one in of[primary]]).value_counts()
        counts = ", ".join(str(parts.get(one, 0)) for one in ("supported", "contradicted", "undecided"))
        rest = [verdict(of[reading]) for reading in others]
        rows.append([str(claim.number), claim.sentence, verdict(of[primary]), counts, *rest])
    return rows


# -- the paper's tables -----------------------------------------------------------------------------------------------


def beside_paper(metrics: pd.DataFrame, algorithm: str) -> Rows:
    """One algorithm's six columns: the paper's row, then each reading of ours with its interval, by activation."""
    labels = [METRICS[metric].label for metric in paper.COLUMNS]
    rows = [["activation", "reading", "seeds", *labels]]
    mine = metrics[(metrics["algorithm"] == algorithm) & (metrics["ratio"] == "mean of ratios")]
    for activation in [one for which, one in paper.TABLES if which == algorithm]:
        printed = paper.TABLES[algorithm, activation]
        theirs = [f"{printed[metric]:,}".replace("-", "−") for metric in paper.COLUMNS]
        rows.append([activation, "the paper", "1", *theirs])
        cell = mine[mine["activation"] == activation]
        if cell.empty:
            rows.append([activation, "missing: no finished run", "0", *[NOTHING] * len(labels)])
        for reading, part in cell.groupby("reading", sort=False):
            by_metric = part.set_index("metric")
            shown = [_estimate(by_metric, metric) for metric in paper.COLUMNS]
            rows.append([activation, str(reading), str(by_metric["n"].max()), *shown])
    return rows


def _estimate(by_metric: pd.DataFrame, metric: str) -> str:
    if metric not in by_metric.index:
        return NOTHING
    one: Any = by_metric.loc[metric]
    return with_interval(one["mean"], one["low"], one["high"], min(METRICS[metric].digits, 2))


def latex(rows: Rows) -> str:
    """A tabular with booktabs' rules."""
    escape = str.maketrans({"%": r"\%", "_": r"\_", "&": r"\&", "#": r"\#", "−": "$-$", "–": "--"})
    lines = [" & ".join(cell.translate(escape) for cell in row) + r" \\" for row in rows]
    columns = "ll" + "r" * (len(rows[0]) - 2)
    body = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", lines[0], r"\midrule", *lines[1:], r"\bottomrule"]
    return "\n".join([*body, r"\end{tabular}", ""])


def table(cells: list[Cell], algorithm: str, ratio_of_means: bool) -> Rows:
    """A header and rows: for each activation the paper's, then every reading of each cell.

    ratio_of_means: the ratios alone, as ratios of means (decision 13).
    """
    metrics = [one for one, metric in METRICS.items() if metric.scale is not None or not ratio_of_means]
    rows = [["activation", "reading", "seeds", "episodes", "cut off", *(METRICS[one].label for one in metrics)]]
    of_paper = [activation for which, activation in paper.TABLES if which == algorithm]
    for activation in dict.fromkeys([*of_paper, *(cell.activation for cell in cells)]):
        ours = [cell for cell in cells if cell.activation == activation]
        if activation in of_paper:
            printed = paper.TABLES[algorithm, activation]
            beside = [f"{printed[one]:,}" if one in printed else "-" for one in metrics]
            rows.append([activation, "the paper", "1", "-", "-", *beside])
        if not ours:
            rows.append([activation, "missing: no finished run", "0", *["-"] * (len(metrics) + 2)])
        for cell in ours:
            for kind, part in readings(cell).items():
                reading = kind if len(part) else f"{kind}: missing"
                rows.append([cell.label, reading, *_values(part, metrics, ratio_of_means)])
    return rows


def _values(part: pd.DataFrame, metrics: list[str], ratio_of_means: bool) -> list[str]:
    """Seeds, episodes, share cut off, and each metric as mean ± standard deviation over seeds."""
    if part.empty:
        return ["0", "0", *["-"] * (len(metrics) + 1)]
    seeds, cut = per_seed(part, ratio_of_means), part[part["truncated"]]
    share = f"{len(cut) / len(part):.1%}" + (f" at {cut['steps'].max():,} steps" if len(cut) else "")
    return [str(len(seeds)), f"{len(part):,}", share, *(_spread(seeds[one], METRICS[one].digits) for one in metrics)]


def _spread(values: pd.Series[float], digits: int) -> str:
    mean = f"{values.mean():,.{digits}f}"
    return mean if len(values) == 1 else f"{mean} ± {values.std():,.{digits}f}"


# -- further tables of the page ---------------------------------------------------------------------------------------


def interactions(frame: pd.DataFrame) -> Rows:
    """The test of algorithm and activation."""
    rows = [["reading", "metric", "seeds", "p, ranks", "p, raw scale"]]
    for one in frame.to_dict("records"):
        p_values = [NOTHING if math.isnan(p) else f"{p:.4f}" for p in (one["p_ranks"], one["p_raw"])]
        rows.append([one["reading"], one["metric"], str(one["n"]), *p_values])
    return rows


def survivals(frame: pd.DataFrame) -> Rows:
    """Restricted means."""
    rows = [["cell", "seeds", "flights", "cut off", "mean steps"]]
    for one in frame.to_dict("records"):
        mean = with_interval(one["restricted_mean"], one["low"], one["high"], 0)
        rows.append([one["cell"], str(one["n"]), f"{one['episodes']:,}", f"{one['cut_off']:.0%}", mean])
    return rows


def powers(frame: pd.DataFrame) -> Rows:
    """Seeds that it would take."""
    rows = [["pair", "seeds a cell"]]
    return rows + [[one["pair"], number(one["seeds"], 0)] for one in frame.to_dict("records")]


def measured(frame: pd.DataFrame, measures: Sequence[str], mode: str = "sampled") -> Rows:
    """Measures of flights: mean over seeds and interval, a row a cell."""
    rows = [["cell", "seeds", *(measure.replace("_", " ") for measure in measures)]]
    if frame.empty:
        return rows
    for cell, part in frame[frame["mode"] == mode].groupby("cell", sort=False):
        found = [stats.interval(part[measure].to_numpy()) for measure in measures]
        shown = [with_interval(one.value, one.low, one.high, 3 if abs(one.value) < 1 else 1) for one in found]
        rows.append([str(cell), str(part["seed"].nunique()), *shown])
    return rows


def pivot(frame: pd.DataFrame, columns: str, digits: int = 3) -> Rows:
    """A row a cell, a column each value of a column, with intervals."""
    names = list(dict.fromkeys(frame[columns]))
    rows = [["cell", *(str(one).replace("_", " ") for one in names)]]
    for cell, part in frame.groupby("cell", sort=False):
        known: dict[str, Any] = {str(one[columns]): one for one in part.to_dict("records")}
        shown = [known.get(one) for one in names]
        rows.append(
            [str(cell)]
            + [with_interval(one["value"], one["low"], one["high"], digits) if one else NOTHING for one in shown]
        )
    return rows


def overestimated(frame: pd.DataFrame) -> Rows:
    """DQN's values beside what followed."""
    rows = [["cell", "seeds", "max Q", "realised", "overestimation"]]
    for cell, part in frame.groupby("cell", sort=False):
        found = [stats.interval(part[one].to_numpy()) for one in ("q", "realised", "overestimation")]
        rows.append([str(cell), str(found[0].n), *(with_interval(one.value, one.low, one.high) for one in found)])
    return rows


FLIPS = {"yes": " – flips", "sign": " – other sign", "no": "", "": ""}


def sensitivities(frame: pd.DataFrame) -> Rows:
    """A row a switch, a column a conclusion."""
    names = list(dict.fromkeys(frame["conclusion"]))
    rows = [["switch", *names, "seeds"]]
    for switch, part in frame.groupby("switch", sort=False):
        known = {one["conclusion"]: one for one in part.to_dict("records")}
        shown = [
            with_interval(known[one]["value"], known[one]["low"], known[one]["high"], 1) + FLIPS[known[one]["flips"]]
            if one in known
            else NOTHING
            for one in names
        ]
        rows.append([str(switch), *shown, str(part["n"].min())])
    return rows


def of_metrics(frame: pd.DataFrame, only: Sequence[str], readings_shown: Sequence[str]) -> Rows:
    """Cells against metrics, in some readings."""
    rows = [["cell", "reading", "seeds", *(METRICS[metric].label for metric in only)]]
    if frame.empty:
        return rows
    plain = frame[(frame["ratio"] == "mean of ratios") & frame["reading"].isin(list(readings_shown))]
    for key, part in plain.groupby(["algorithm", "activation", "reading"], sort=False):
        algorithm, activation, reading = (str(one) for one in key)
        by_metric = part.set_index("metric")
        shown = [_estimate(by_metric, metric) for metric in only]
        rows.append([name(algorithm, activation), reading, str(by_metric["n"].max()), *shown])
    return rows


def baselines(found: Mapping[str, pd.DataFrame], main: Cells, cap: int) -> Rows:
    """What needs no learning beside what was learned, on test sets: reward, steps, share of flights cut off."""
    rows = [["who", "seeds", "flights", "cut off", "reward per flight", "steps per flight", "speed [px a step]"]]
    learned = {name(*key): readings(cell)["sampled evaluation"] for key, cell in main.items()}
    for who, part in [*found.items(), *learned.items()]:
        ended = finished(part)
        if ended.empty:
            continue
        seeds = per_seed(ended, ratio_of_means=True)
        shown = []
        for metric in ("reward", "steps", "speed"):
            one = stats.interval(seeds[metric].to_numpy())
            shown.append(with_interval(one.value, one.low, one.high, min(METRICS[metric].digits, 2)))
        cut = f"{ended['truncated'].mean():.0%}"
        rows.append([who, str(len(seeds)), f"{len(ended):,}", cut, *shown])
    return rows if found else rows[:1]


def speeds(frame: pd.DataFrame) -> Rows:
    """Wall times."""
    rows = [["cell", "seeds side by side", "seconds a seed", "machine"]]
    found = frame.to_dict("records")
    return rows + [[one["cell"], str(one["seeds"]), number(one["seconds"], 0), one["machine"]] for one in found]


def decisions() -> Rows:
    """What the paper leaves open."""
    return [list(HEADER), *(list(one) for one in DECISIONS)]


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


def run_table(cells: list[Cell]) -> Rows:
    """How each run was made."""
    rows = [["run", "cell", "seeds", "frames per seed", "ended", "wall time", "threads", "compiled"]]
    for run, whose in [(run, f"{cell.algorithm} {cell.activation}") for cell in cells for run in cell.runs]:
        seconds, first, last = run.meta.get("wall_seconds"), run.seeds[0], run.seeds[-1]
        wall = str(datetime.timedelta(seconds=round(seconds))) if isinstance(seconds, (int, float)) else "not known"
        how = [show(run.meta.get(fact, "not known")) for fact in ("threads", "compiled")]
        seeds = str(first) if first == last else f"{first} ... {last}"
        ended = str(run.meta.get("ended", "not known")).partition("T")[0]
        rows.append([str(run.path), whose, seeds, f"{run.frames:,}", ended, wall, *how])
    return rows


def markdown(rows: Rows) -> str:
    """A table whose first row is its header and whose numbers, from the third column on, are right-aligned."""
    rule = ["---" if place < 2 else "---:" for place in range(len(rows[0]))]
    lines = (" | ".join(cell.replace("|", "\\|") for cell in row) for row in [rows[0], rule, *rows[1:]])
    return "\n".join(f"| {line} |" for line in lines)
