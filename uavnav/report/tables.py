"""Tables for people: rows of strings, the first of them a header; in Markdown, HTML and LaTeX alike."""

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from uavnav import stats
from uavnav.report.cells import Cell, one_line, readings, show
from uavnav.report.claims import SEEDS, UNDECIDED, Claim, Finding, p_shown, verdict
from uavnav.report.decisions import DECISIONS, HEADER
from uavnav.report.figures import DIAGNOSTICS, MEASURES
from uavnav.report.frames import estimates, name, per_seed_values
from uavnav.report.studies import Cells
from uavnav.runs import Run, paper
from uavnav.runs.metrics import METRICS, finished, per_seed

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
        p = p_shown(one)
        if one.region.startswith("p") and p != NOTHING:  # a test, which has no interval
            ours += f" (p {p})" if p[0] in "<≤" else f" (p = {p})"
        rows.append([one.text, own, ours, one.region, p, str(one.n), said(one)])
    return rows


def said(finding: Finding) -> str:
    """A verdict, and how many seeds it would take where there is none."""
    if finding.verdict != UNDECIDED:
        return finding.verdict
    if not finding.n:
        return "undecided (no runs)"
    if finding.region.startswith("p"):
        return f"undecided (n = {finding.n}; for a test the seeds needed are not worked out)"
    needed = (
        NOTHING
        if math.isnan(finding.needed)
        else f"{'at least' if finding.needed == SEEDS else 'about'} {finding.needed:,.0f} seeds needed"
    )
    needed = f"more than {MANY:,} seeds needed" if MANY < finding.needed < math.inf else needed
    needed = "no number of seeds would do" if math.isinf(finding.needed) else needed
    return f"undecided (n = {finding.n}" + ("" if needed == NOTHING else f", {needed}") + ")"


def in_reading(findings: Sequence[Finding]) -> str:
    """A claim's verdict; a dash where a reading has no runs for any part of it."""
    return verdict(findings) if any(one.n for one in findings) else NOTHING


def overview(claims: Sequence[Claim], audits: Mapping[str, Sequence[Finding]], primary: str) -> Rows:
    """One row a claim: its verdict in the primary reading, and in the others."""
    others = [reading for reading in audits if reading != primary]
    rows = [["", "the paper says", "verdict", "parts supported, contradicted, undecided", *others]]
    for claim in claims:
        of = {reading: [one for one in found if one.claim == claim.number] for reading, found in audits.items()}
        parts = pd.Series([one.verdict for one in of[primary]]).value_counts()
        counts = ", ".join(str(parts.get(one, 0)) for one in ("supported", "contradicted", "undecided"))
        rest = [in_reading(of[reading]) for reading in others]
        rows.append([str(claim.number), claim.sentence, verdict(of[primary]), counts, *rest])
    return rows


# -- the paper's tables -----------------------------------------------------------------------------------------------


def beside_paper(metrics: pd.DataFrame, algorithm: str, statistic: str = "mean") -> Rows:
    """One algorithm's metrics: the paper's row, then each reading of ours with its interval, by activation.

    Metrics per step have a second row in each reading, as ratios of means (decision 13). statistic: `mean` or
    `interquartile_mean`, over seeds.
    """
    rows = [["activation", "reading", "seeds", *map(str, METRICS.values())]]
    mine = metrics[metrics["algorithm"] == algorithm]
    for activation in [one for which, one in paper.TABLES if which == algorithm]:
        rows.append([activation, "the paper", "1", *_printed(algorithm, activation, list(METRICS))])
        cell = mine[mine["activation"] == activation]
        if cell.empty:
            rows.append([activation, "missing: no finished run", "0", *[NOTHING] * len(METRICS)])
        for (reading, ratio), part in cell.groupby(["reading", "ratio"], sort=False):
            by_metric = part.set_index("metric")
            shown = [_estimate(by_metric, metric, statistic) for metric in METRICS]
            rows.append([activation, _named(str(reading), str(ratio)), str(by_metric["n"].max()), *shown])
    return rows


def _printed(algorithm: str, activation: str, metrics: Sequence[str]) -> list[str]:
    printed = paper.TABLES[algorithm, activation]
    return [f"{printed[one]:,}".replace("-", "−") if one in printed else NOTHING for one in metrics]


def _named(reading: str, ratio: str) -> str:
    return f"{reading}, ratios of means" if ratio == "ratio of means" else reading


LIMITS = {"mean": ("low", "high"), "interquartile_mean": ("iqm_low", "iqm_high")}
"""Columns of `frames.estimates` with the interval of each statistic."""


def _estimate(by_metric: pd.DataFrame, metric: str, statistic: str = "mean") -> str:
    if metric not in by_metric.index:
        return NOTHING
    one: Any = by_metric.loc[metric]
    low, high = (one[limit] for limit in LIMITS[statistic])
    return with_interval(one[statistic], low, high, min(METRICS[metric].digits, 2))


def latex(rows: Rows) -> str:
    """A tabular with booktabs' rules."""
    escape = str.maketrans({"%": r"\%", "_": r"\_", "&": r"\&", "#": r"\#", "−": "$-$", "–": "--"})
    lines = [" & ".join(cell.translate(escape) for cell in row) + r" \\" for row in rows]
    columns = "ll" + "r" * (len(rows[0]) - 2)
    body = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", lines[0], r"\midrule", *lines[1:], r"\bottomrule"]
    return "\n".join([*body, r"\end{tabular}", ""])


def estimated(cells: list[Cell]) -> list[tuple[Cell, pd.DataFrame]]:
    """Every cell with its means and interquartile means."""
    return [(cell, estimates(per_seed_values({(cell.algorithm, cell.activation): cell}))) for cell in cells]


def table(cells: list[tuple[Cell, pd.DataFrame]], algorithm: str, ratio_of_means: bool) -> Rows:
    """A header and rows: for each activation the paper's, then every reading of each cell: means, interquartile means.

    cells: `estimated`; ratio_of_means: the ratios alone, as ratios of means (decision 13).
    """
    metrics = [one for one, metric in METRICS.items() if metric.scale is not None or not ratio_of_means]
    rows = [["activation", "reading", "seeds", "episodes", "cut off", *(str(METRICS[one]) for one in metrics)]]
    of_paper = [activation for which, activation in paper.TABLES if which == algorithm]
    nothing = [NOTHING] * len(metrics)
    for activation in dict.fromkeys([*of_paper, *(cell.activation for cell, _ in cells)]):
        ours = [(cell, found) for cell, found in cells if cell.activation == activation]
        if activation in of_paper:
            beside = _printed(algorithm, activation, metrics)
            rows.append([activation, "the paper", "1", NOTHING, NOTHING, *beside])
        if not ours:
            rows.append([activation, "missing: no finished run", "0", NOTHING, NOTHING, *nothing])
        for cell, found in ours:
            found = found[(found["ratio"] == "ratio of means") == ratio_of_means]
            for reading, part in readings(cell).items():
                if part.empty:
                    rows.append([cell.label, f"{reading}: missing", "0", "0", NOTHING, *nothing])
                    continue
                by_metric, counts = found[found["reading"] == reading].set_index("metric"), _counts(part)
                for statistic in LIMITS:
                    words = reading if statistic == "mean" else f"{reading}, interquartile mean"
                    shown = [_estimate(by_metric, one, statistic) for one in metrics]
                    rows.append([cell.label, words, *counts, *shown])
    return rows


def _counts(part: pd.DataFrame) -> list[str]:
    """Seeds, episodes and the share cut off, and at how many steps."""
    cut = part[part["truncated"]]
    share = f"{len(cut) / len(part):.1%}" + (f" at {cut['steps'].max():,} steps" if len(cut) else "")
    return [str(part["seed"].nunique()), f"{len(part):,}", share]


# -- further tables of the page ---------------------------------------------------------------------------------------


def interactions(frame: pd.DataFrame) -> Rows:
    """The test of algorithm and activation."""
    rows = [["reading", "metric", "seeds", "p, change of places", "p, raw scale"]]
    for one in frame.to_dict("records"):
        p_values = [NOTHING if math.isnan(p) else f"{p:.4f}" for p in (one["p_ranks"], one["p_raw"])]
        rows.append([one["reading"], one["metric"], str(one["n"]), *p_values])
    return rows


def survivals(frame: pd.DataFrame) -> Rows:
    """Restricted means."""
    rows = [["cell", "seeds", "flights", "cut off [share]", "mean [steps]"]]
    for one in frame.to_dict("records"):
        mean = with_interval(one["restricted_mean"], one["low"], one["high"], 0)
        rows.append([one["cell"], str(one["n"]), f"{one['episodes']:,}", f"{one['cut_off']:.0%}", mean])
    return rows


def powers(frame: pd.DataFrame) -> Rows:
    """Seeds that it would take."""
    rows = [["pair", "seeds there are", "seeds a cell"]]
    return rows + [[one["pair"], str(one["n"]), _needed(one["seeds"])] for one in frame.to_dict("records")]


def _needed(seeds: float) -> str:
    return f"> {MANY:,}" if MANY < seeds < math.inf else number(seeds, 0)


def measured(frame: pd.DataFrame, measures: Sequence[str], mode: str = "sampled") -> Rows:
    """Measures of flights: mean over seeds and interval, a row a cell."""
    rows = [["cell", "seeds", *(MEASURES.get(measure, measure) for measure in measures)]]
    if frame.empty:
        return rows
    for cell, part in frame[frame["mode"] == mode].groupby("cell", sort=False):
        found = [stats.interval(part[measure].to_numpy()) for measure in measures]
        shown = [with_interval(one.value, one.low, one.high, 3 if abs(one.value) < 1 else 1) for one in found]
        rows.append([str(cell), str(part["seed"].nunique()), *shown])
    return rows


def pivot(frame: pd.DataFrame, columns: str, digits: int = 3) -> Rows:
    """A row a cell, its seeds, and a column each value of a column, with intervals."""
    names = list(dict.fromkeys(frame[columns]))
    rows = [["cell", "seeds", *(DIAGNOSTICS.get(one, one) for one in names)]]
    for cell, part in frame.groupby("cell", sort=False):
        known: dict[str, Any] = {str(one[columns]): one for one in part.to_dict("records")}
        shown = [known.get(one) for one in names]
        rows.append(
            [str(cell), str(part["n"].max())]
            + [with_interval(one["value"], one["low"], one["high"], digits) if one else NOTHING for one in shown]
        )
    return rows


def overestimated(frame: pd.DataFrame) -> Rows:
    """DQN's values beside what followed."""
    rows = [["cell", "seeds", "max Q [reward]", "realised [reward]", "overestimation [reward]"]]
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
    rows = [["cell", "reading", "seeds", *(str(METRICS[metric]) for metric in only)]]
    if frame.empty:
        return rows
    plain = frame[(frame["ratio"] == "mean of ratios") & frame["reading"].isin(list(readings_shown))]
    for key, part in plain.groupby(["algorithm", "activation", "reading"], sort=False):
        algorithm, activation, reading = (str(one) for one in key)
        by_metric = part.set_index("metric")
        shown = [_estimate(by_metric, metric) for metric in only]
        rows.append([name(algorithm, activation), reading, str(by_metric["n"].max()), *shown])
    return rows


def by_default(frame: pd.DataFrame) -> Rows:
    """PPO minus DQN, tuned and in the main study, and what its interval says."""
    rows = [["settings", "activations of both", "seeds a cell", "PPO − DQN", "so"]]
    for one in frame.to_dict("records"):
        if math.isnan(one["value"]):
            so = "not known: no evaluated runs of both with the same activation"
        elif math.isnan(one["low"]):
            so = "not known: one seed has no interval"
        else:
            so = "PPO above DQN" if one["low"] > 0 else "DQN above PPO" if one["high"] < 0 else "not told apart"
        difference = with_interval(one["value"], one["low"], one["high"], 1)
        rows.append([one["settings"], one["activations"] or NOTHING, str(one["n"]), difference, so])
    return rows


def baselines(found: Mapping[str, pd.DataFrame], main: Cells) -> Rows:
    """Scripts, people and policies from elsewhere beside the study's, on test sets: all metrics, share cut off."""
    rows = [["who", "seeds", "flights", "cut off", *map(str, METRICS.values())]]
    learned = {name(*key): readings(cell)["sampled evaluation"] for key, cell in main.items()}
    for who, part in [*found.items(), *learned.items()]:
        ended = finished(part)
        if ended.empty:
            continue
        seeds = per_seed(ended, ratio_of_means=True)
        of_seeds = [flown for _, flown in ended.groupby("seed")]
        shown = []
        for key, metric in METRICS.items():
            if metric.scale is None and metric.column in ended:
                own = {seed: flown[metric.column].to_numpy() for seed, flown in enumerate(of_seeds)}
                one = stats.nested_interval(own)
            else:
                one = stats.interval(seeds[key].to_numpy())
            shown.append(with_interval(one.value, one.low, one.high, min(metric.digits, 2)))
        rows.append([who, *_counts(ended), *shown])
    return rows if found else rows[:1]


def speeds(frame: pd.DataFrame) -> Rows:
    """Wall times."""
    rows = [["cell", "seeds side by side", "wall time [s] of a seed's share", "machine"]]
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


def of_words(rows: Rows) -> list[bool]:
    """Which columns of a table hold words, and which numbers."""
    return [any(row[place][:1].isalpha() for row in rows[1:]) for place in range(len(rows[0]))]


def markdown(rows: Rows) -> str:
    """A table whose first row is its header and whose numbers, from the third column on, are right-aligned."""
    rule = ["---" if words or place < 2 else "---:" for place, words in enumerate(of_words(rows))]
    lines = (" | ".join(cell.replace("|", "\\|") for cell in row) for row in [rows[0], rule, *rows[1:]])
    return "\n".join(f"| {line} |" for line in lines)
