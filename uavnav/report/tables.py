"""Tables for people: rows of strings, the first of them a header; in Markdown, HTML and LaTeX alike."""

from __future__ import annotations

import datetime
import json
import math
import string
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from uavnav import stats, style
from uavnav.algorithms import ALGORITHMS
from uavnav.colours import NAMES
from uavnav.report.claims import COMPARED
from uavnav.report.configurations import MODE, Configuration, episodes_of, read_as, show
from uavnav.report.frames import NUMBERS, REACTIVE, means, name
from uavnav.report.verdicts import (
    BESIDE,
    COUNTS,
    DEGENERATE,
    GRADES,
    NO_RUNS,
    OPEN,
    SEEDS,
    TOO_FEW,
    TOO_SMALL,
)
from uavnav.runs import paper, trials
from uavnav.runs.definitions import DEFINITIONS, LOG_CURVE, PER_FRAME, decimals, words
from uavnav.runs.metrics import METRICS, OWN, finished, per_seed
from uavnav.runs.trials import DEFAULT, DIFFERENCE, TUNED

Rows = list[list[str]]
Record = Mapping[Any, Any]
Columns = Mapping[str, str | Callable[[Record], str]]
"""Columns of a table with a row a row of a frame: formats, or functions of a row, by header."""
NOTHING = "–"
FLIPS = {"yes": " – flips", "sign": " – other sign", "no": "", "": ""}
"""How a table says what `frames.sensitivity` found."""
MANY = 10_000
"""More seeds than these are as good as never."""


def interval_of(column: str) -> list[str]:
    """A column of a frame, and those that have its interval."""
    alone = column in ("value", "reward", "mean")
    return [column, *(end if alone else f"{column}_{end}" for end in ("low", "high"))]


VALUE, REWARD, GAP, MEAN = map(interval_of, ("value", "reward", "gap", "mean"))


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


def in_brackets(found: Record, unit: str, places: int | None) -> str:
    """A number and its interval, where it has one, in plain words. Shares and hundreds are whole."""
    if places is None:
        places = 0 if unit or abs(found["value"]) > 100 else digits(found)
    value, low, high = (number(round(found[one], places) + 0.0, max(places, 0)) for one in VALUE)  # no −0
    return value + unit if low == NOTHING else f"{value}{unit} ({low} to {high}{unit})"


def in_words(configuration: str) -> str:
    """A configuration's label in words: PPO with leaky ReLU."""
    algorithm, _, activation = configuration.partition(" ")
    return f"{algorithm} with {NAMES.get(activation, activation)}"


class _Cells(string.Formatter):
    """Formats of the cells of `LISTED`: their numbers look as `number` has them."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if isinstance(value, float) and format_spec.endswith("f"):
            return number(value, int(format_spec.strip(",.f")))
        shown = str(super().format_field(value, format_spec))
        return NOTHING if shown == "nan%" else shown


def linked(words: str, table: str, row: Any = None) -> str:
    """Words that lead to a table, or to a row of it: its line in the CSV, after that of the header."""
    return f"[{words}](tables/{table}.csv{f'#L{row + 2}' if row is not None else ''})"


def listed(frame: pd.DataFrame, name: str) -> Rows:
    """A row a row, with the columns of `LISTED`; an interval that is not known is left out."""
    columns, fill = LISTED[name], _Cells().vformat
    rows = [list(columns)]
    for one in frame.to_dict("records"):
        told = {str(key): value for key, value in one.items()}
        shown = (form(one) if callable(form) else fill(form, (), told) for form in columns.values())
        rows.append([cell.replace(f" [{NOTHING}, {NOTHING}]", "") for cell in shown])
    return rows


def cited(frame: pd.DataFrame, table: str, column: str) -> Rows:
    """The same, with a link to its row on the numbers of a column."""
    head, *rows = listed(frame, table)
    place = head.index(column)
    for line, row in zip(frame.index, rows, strict=True):
        row[place] = _to_row(row[place], table, line)
    return [head, *rows]


def _to_row(number: str, table: str, line: Any) -> str:
    """A number, perhaps with its interval, whose first part leads to a row of a table."""
    shown, *interval = number.partition(" [")
    return linked(shown, table, line) + "".join(interval)


def _across(
    part: pd.DataFrame, column: str, names: Iterable[str], shown: Callable[[Record], str]
) -> list[str]:
    """Some rows side by side, in the order of their names in a column; a dash where a name has none."""
    known = {one[column]: shown(one) for one in part.to_dict("records")}
    return [known.get(name, NOTHING) for name in names]


def _layer_norm(one: Record) -> str:
    return "with" if one["layer_norm"] else "without"


LISTED: Mapping[str, Columns] = {
    "verdicts": {
        "question": "{text}",
        "the paper": lambda one: number(one["paper"], digits(one)),
        "ours, adjusted interval": lambda one: (
            _interval(one, VALUE, digits(one)) + (f" ({one['nearest']})" if one["nearest"] else "")
        ),
        "ours : the paper": "{ratio:.2f} [{ratio_low:.2f}, {ratio_high:.2f}]",
        "Holm's p": lambda one: "< 0.001" if one["p_holm"] < 0.001 else number(one["p_holm"], 3),
        "seeds": "{n}",
        "verdict": lambda one: said(one),
    },
    "interaction": {
        "definition": "{definition}",
        "metric": "{metric}",
        "seeds": "{n}",
        "p, change of places": "{p_ranks:.4f}",
        "p, raw scale": "{p_raw:.4f}",
    },
    "survival": {
        "configuration": "{configuration}",
        "seeds": "{n}",
        "episodes": "{episodes:,}",
        "truncated [share]": "{truncated:.0%}",
        "mean [steps]": "{restricted_mean:.0f} [{low:.0f}, {high:.0f}]",
    },
    "gaps": {
        "who": "{who}",
        "acting": "{mode}",
        "seeds": "{n}",
        "episodes": "{episodes:,}",
        "that reach the time limit": "{truncated:.0%}",
        "reward": "{reward:.1f} [{low:.1f}, {high:.1f}]",
        "gap to the scripted policy": "{gap:.1f} [{gap_low:.1f}, {gap_high:.1f}]",
        "seeds above": "{above:.0%}",
    },
    "by_default": {
        "settings": "{settings}",
        "activations of both": "{activations}",
        "seeds a configuration": "{n}",
        "PPO − DQN": "{value:.1f} [{low:.1f}, {high:.1f}]",
    },
    "speed": {
        "configuration": "{configuration}",
        "seeds side by side": "{seeds}",
        "wall time [s] of a seed's share": "{seconds:.0f}",
        "machine": "{machine}",
    },
    "improvement": {
        "configuration": "{a}",
        "against": "{b}",
        "seeds": "{n_a}, {n_b}",
        "probability of more": "{probability:.2f}",
        "Holm's p": "{p_holm:.3f}",
    },
    "power": {
        "pair": "{pair}",
        "seeds there are": "{n}",
        "seeds a configuration": lambda one: (
            f"> {MANY:,}" if MANY < one["seeds"] < math.inf else number(one["seeds"], 0)
        ),
    },
    "whys": {
        "question": "{question}",
        "configuration or difference": "{row}",
        "measure": "{metric}",
        "mean": lambda one: _interval(one, VALUE, digits(one)),
        "seeds": "{n}",
    },
    "leaders": {
        "task": "{task}",
        "best configuration": "{best}",
        "reward per episode": "{value:.2f} [{low:.2f}, {high:.2f}]",
        "best scripted policy": lambda one: one["best_scripted"] or NOTHING,
        "its reward": "{scripted:.2f}",
        "ahead": lambda one: one["ahead"] or NOTHING,
        "not above a random policy": "{chance}",
    },
    "longer": {
        "configuration": lambda one: f"{name(one['algorithm'], one['activation'])} {one['settings']}",
        "time limit": "{limit:,}",
        "frames": "{frames:,}",
        "seeds": "{n}",
        "reward": "{value:.1f} [{low:.1f}, {high:.1f}]",
        "lead over the other algorithm": "{lead:.1f} [{lead_low:.1f}, {lead_high:.1f}]",
        "gap to the scripted policy": "{gap:.1f} [{gap_low:.1f}, {gap_high:.1f}]",
        "seeds above it": "{above}",
        "change": "{gain:.1f} [{gain_low:.1f}, {gain_high:.1f}]",
        "trend": lambda one: one["trend"] or NOTHING,
    },
    "ambiguities": {
        "draw": "{draw}",
        "part": "{part}",
        "value": "{value:.2f} [{low:.2f}, {high:.2f}]",
        "Holm's p": "{p_holm:.3f}",
        "seeds": "{n}",
        "verdict": "{verdict}",
    },
    "noise": {
        "who": "{who}",
        "trained with [px]": "{trained:.0f}",
        "evaluated with [px]": "{evaluated:.0f}",
        "seeds": "{n}",
        "reward": "{value:.1f} [{low:.1f}, {high:.1f}]",
        "gap to the scripted policy": "{gap:.1f} [{gap_low:.1f}, {gap_high:.1f}]",
        "seeds above it": "{above}",
        "more than trained without": "{gain:.1f} [{gain_low:.1f}, {gain_high:.1f}]",
    },
    "horizon": {
        "time limit": "{limit:,}",
        "frames": "{frames:,}",
        "γ": "{gamma:g}",
        "seeds": "{n}",
        "reward": "{value:.1f} [{low:.1f}, {high:.1f}]",
        "reach the time limit [%]": "{survive:.1f} [{survive_low:.1f}, {survive_high:.1f}]",
        "more than with 0.99": "{gain:.1f} [{gain_low:.1f}, {gain_high:.1f}]",
        "earns": "{verdict}",
        "scripted policy": "{scripted:.1f}",
    },
    "learned_ahead": {
        "task": lambda one: one["place"] + ", shield" * one["shield"],
        "best scripted policy": "{best_scripted}",
        "its reward": "{scripted:.1f}",
        "learned": "{who}",
        "earns more by": "{gap:.1f} [{gap_low:.1f}, {gap_high:.1f}]",
        "seeds": "{n}",
    },
    "learned_shielded": {
        "task": "{place}",
        "who": "{who}",
        "reward": "{value:.1f}",
        "more under the shield": "{gain:.1f} [{gain_low:.1f}, {gain_high:.1f}]",
        "collisions per 1,000 px": "{collisions:.3f}",
        "under the shield": "{left:.3f}",
        "seeds": "{n}",
    },
    "activations_equal": {
        "measure": "{measure}",
        "algorithm": lambda one: one["algorithm"].upper(),
        "LayerNorm": _layer_norm,
        "the choice is": "{verdict}",
        "margin": "{margin}",
        "largest difference": "{value:.1f} [{low:.1f}, {high:.1f}]",
        "of": lambda one: f"{one['best']} and {one['worst']}" if one["best"] else NOTHING,
        "seeds": "{n}",
    },
    "activations_carried": {
        "measure": "{measure}",
        "LayerNorm": _layer_norm,
        "Kendall's tau of PPO and DQN": "{value:.2f} [{low:.2f}, {high:.2f}]",
        "seeds": "{n}",
    },
}
"""The columns of the tables with a row a row of a frame, by the name of its CSV."""


def drawn(frame: pd.DataFrame) -> Rows:
    """Draws of settings, the nearest first: as `ambiguities.gather` gives them."""
    shown = frame.map(lambda one: number(one, 1) if isinstance(one, float) else str(one))
    return [list(shown.columns.astype(str)), *shown.to_numpy().tolist()]


def crossed(
    frame: pd.DataFrame,
    row: str,
    column: str,
    digits: int | None = 3,
    labels: Mapping[str, str] | None = None,
) -> Rows:
    """A row a value of one column and a column a value of another: numbers, intervals, and the fewest seeds.

    digits: None shows three of numbers below 1 and one of others; labels: words for the columns, in order.
    """

    def shown(one: Record) -> str:
        places = (3 if abs(one["value"]) < 1 else 1) if digits is None else digits
        return _interval(one, VALUE, places) + FLIPS[one.get("flips", "")]

    words = labels or {name: name.upper() if name in ALGORITHMS else name for name in frame[column].unique()}
    names = [name for name in words if name in set(frame[column])]
    rows = [[row, *(words[name] for name in names), "seeds"]]
    for key, part in frame.groupby(row, sort=False):
        rows.append([str(key), *_across(part, column, names, shown), str(part["n"].min())])
    return rows


def _interval(one: Record, columns: Sequence[str], digits: int) -> str:
    value, low, high = (one[column] for column in columns)
    return with_interval(value, low, high, digits)


def over_seeds(frame: pd.DataFrame, columns: Mapping[str, str]) -> Rows:
    """A row a configuration: means over seeds, with intervals, of some columns. frame: a row a seed."""
    found = [
        [one, name, *stats.interval(part[name].to_numpy())]
        for one, part in frame.groupby("configuration", sort=False)
        for name in columns
    ]
    means = pd.DataFrame(found, columns=["configuration", "of", *NUMBERS])
    return crossed(means, "configuration", "of", None, columns)


def digits(one: Record) -> int:
    """Decimals that show an interval with two significant digits; without one, the value."""
    width = one["high"] - one["low"]
    known = width if width > 0 else abs(one["value"])
    return min(max(1 - math.floor(math.log10(known)), 0), 6) if known > 0 else 2


def said(part: Record) -> str:
    """A part's verdict, how many seeds another would take, and why it does not count if it does not."""
    standing = str(part["standing"])
    if standing == NO_RUNS:
        return NO_RUNS
    if standing == TOO_FEW:
        return f"{OPEN} (n = {part['n']}, at least {SEEDS} seeds needed)"
    if standing == BESIDE and math.isnan(part["low"]):
        return BESIDE
    answer = str(part["verdict"]) + (", less than half" if part["less_than_half"] else "")
    if part["verdict"] == OPEN and not math.isnan(part["to_equal"]):
        answer += f" ({_about(part['to_equal'])} would show absence)"
    if standing in (COUNTS, DEGENERATE):
        return answer
    needed = f" for n = {part['n']} ({_about(part['to_detect'])} needed)"
    return f"{standing}{needed * (standing == TOO_SMALL)}; ours: {answer}"


def _about(seeds: float) -> str:
    return f"more than {MANY:,} seeds" if seeds > MANY else f"about {seeds:,.0f} seeds"


def side_by_side(seeds: Mapping[str, pd.DataFrame]) -> Rows:
    """A row a metric, a column for each that was evaluated; seeds: by name, as of `metrics.per_seed`.

    Rows of `metrics.OWN` follow where some have them.
    """
    rows = [["", *seeds], ["seeds", *(str(len(one)) for one in seeds.values())]]
    labels = {name: str(metric) for name, metric in METRICS.items()}
    own = {name: one.label for name, one in OWN.items() if any(name in known for known in seeds.values())}
    for column, label in (labels | own).items():
        shown = []
        for one in seeds.values():
            if column not in one or one[column].isna().all():
                shown.append(NOTHING)
                continue
            value, *ends, _ = stats.interval(one[column].to_numpy())
            inside = f" ({' to '.join(map(style.number, ends))})" if np.isfinite(ends[0]) else ""
            shown.append(f"{style.number(value)}{inside}")
        rows.append([label, *shown])
    return rows


def operating(shares: pd.DataFrame) -> Rows:
    """How often each claim would be graded what, if we knew the truth. shares: as
    `operating.characteristics` gives.
    """
    rows = [["", "column", "if the truth were", *GRADES[:-1]]]
    in_order = shares.sort_values("claim", kind="stable")
    for (claim, column, truth), part in in_order.groupby(["claim", "column", "truth"], sort=False):
        shown = _across(part, "grade", GRADES[:-1], lambda one: f"{one['share']:.1%}")
        rows.append([str(claim), str(column), str(truth), *shown])
    return rows


def predictions(frame: pd.DataFrame, definition: str) -> Rows:
    """The paper's numbers as one more seed, with its interval: a row a configuration, a column a metric."""

    def shown(one: Record) -> str:
        own = _interval(one, ["paper", "low", "high"], decimals(one["metric"], definition))
        return f"{own} {'within' if one['within'] else 'outside'}" if one["n"] > 1 else NOTHING

    rows = [["configuration", "seeds", *(words(metric, definition) for metric in paper.COLUMNS)]]
    own = frame[frame["definition"] == definition]
    for key, part in own.groupby(["algorithm", "activation"], sort=False):
        numbers = _across(part, "metric", paper.COLUMNS, shown)
        rows.append([name(*map(str, key)), str(part["n"].max()), *numbers])
    return rows


def table(own: Mapping[str, Configuration], algorithm: str) -> Rows:
    """For each activation the paper's row, then each metric definition's means and interquartile means.

    own: configurations of one algorithm, by activation.
    """
    metrics = [one.words() for one in METRICS.values()]
    rows = [["activation", "definition", "seeds", "episodes", "truncated", *metrics]]
    of_paper = paper.ACTIVATIONS if algorithm in paper.TABLE_OF else ()
    nothing = [NOTHING] * len(METRICS)
    for activation in dict.fromkeys([*of_paper, *own]):
        if activation in of_paper:
            for which, per_frame in (("the paper", False), (f"the paper, {PER_FRAME}", True)):
                printed = _printed(algorithm, activation, per_frame)
                rows.append([activation, which, "1", NOTHING, NOTHING, *printed])
        if activation not in own:
            rows.append([activation, "missing: no finished run", "0", NOTHING, NOTHING, *nothing])
            continue
        for definition in DEFINITIONS:
            found = means(read_as(own[activation], definition).items())
            if not any(mean.n for mean, _ in found.values()):
                rows.append([activation, f"{definition}: missing", "0", "0", NOTHING, *nothing])
                continue
            part = _counts(episodes_of(own[activation], definition))
            for place, which in enumerate((definition, f"{definition}, interquartile mean")):
                shown = [
                    with_interval(*found[metric][place][:3], decimals(metric, definition))
                    for metric in METRICS
                ]
                rows.append([activation, which, *part, *shown])
    return rows


def _printed(algorithm: str, activation: str, per_frame: bool) -> list[str]:
    """The paper's own digits; per frame, as many as ours."""
    shown = []
    for one in METRICS:
        value = paper.printed(algorithm, activation, one, per_frame)
        as_it_is = value == paper.printed(algorithm, activation, one)
        shown.append(f"{value:,}".replace("-", "−") if as_it_is else number(value, decimals(one, PER_FRAME)))
    return shown


def _counts(episodes: pd.DataFrame) -> list[str]:
    """Seeds, episodes and the share truncated, and at how many steps."""
    cut = episodes.loc[episodes["truncated"], "steps"]
    share = f"{len(cut) / len(episodes):.1%}" + (f" at {cut.max():,} steps" if len(cut) else "")
    return [str(episodes["seed"].nunique()), f"{len(episodes):,}", share]


def of_metrics(frame: pd.DataFrame, only: Sequence[str], definitions_shown: Sequence[str]) -> Rows:
    """Configurations against metrics, in some metric definitions."""
    rows = [["configuration", "definition", "seeds", *(METRICS[metric].words() for metric in only)]]
    shown_alone = frame[frame["definition"].isin(list(definitions_shown))]
    for key, part in shown_alone.groupby(["algorithm", "activation", "definition"], sort=False):
        algorithm, activation, definition = map(str, key)
        shown = _across(
            part, "metric", only, lambda one: _interval(one, MEAN, decimals(one["metric"], one["definition"]))
        )
        rows.append([name(algorithm, activation), definition, str(part["n"].max()), *shown])
    return rows


def baselines(found: Mapping[str, pd.DataFrame]) -> Rows:
    """Scripted policies, people and policies from elsewhere on test layouts: all metrics, share truncated."""
    rows = [["who", "seeds", "episodes", "truncated", *map(str, METRICS.values())]]
    for who, part in found.items():
        ended = finished(part)
        if ended.empty:
            continue
        seeds = per_seed(ended, ratio_of_means=True)
        shown = [
            with_interval(*stats.interval(seeds[key].to_numpy())[:3], min(metric.digits, 2))
            for key, metric in METRICS.items()
        ]
        rows.append([who, *_counts(ended), *shown])
    return rows


def rewards(numbers: Mapping[str, pd.DataFrame]) -> Rows:
    """Reward per episode of the paper's configurations: as printed, in training by SB3's log, and of final
    policies on unseen layouts; then the scripted policy's.
    """
    metrics, gaps = numbers["metrics"], numbers["gaps"]
    logged = metrics[(metrics["metric"] == "reward") & (metrics["definition"] == LOG_CURVE)]
    flown = gaps[gaps["mode"].isin((MODE, "scripted"))]
    rows = [["episode reward", "the paper, 1 run", "training, SB3's log", "unseen layouts, sampled"]]
    for algorithm, activation in sorted(paper.TABLES, key=lambda key: COMPARED.index(key[0])):
        of = logged[(logged["algorithm"] == algorithm) & (logged["activation"] == activation)]
        own = flown[flown["who"] == name(algorithm, activation)]
        printed = number(paper.printed(algorithm, activation, "reward"), 1)
        ours = _one(of, MEAN, 1, "metrics"), _one(own, REWARD, 0, "gaps")
        rows.append([f"{algorithm.upper()} {NAMES[activation]}", printed, *ours])
    earned = _one(flown[flown["who"] == REACTIVE], REWARD, 0, "gaps")
    return [*rows, ["scripted policy", NOTHING, NOTHING, earned]]


def _one(rows: pd.DataFrame, columns: Sequence[str], digits: int, table: str) -> str:
    """The number of a table's one row with its interval, and a link to it; a dash where there is none."""
    for place, one in zip(rows.index, rows.to_dict("records"), strict=True):
        return _to_row(_interval(one, columns, digits), table, place)
    return NOTHING


def tuned(found: pd.DataFrame) -> Rows:
    """Default against tuned, a row an algorithm. found: as `tuning.read` gives it."""
    settings = (DEFAULT, TUNED, DIFFERENCE)
    rows = [["algorithm", "seeds", *settings, "tuned, gap to the scripted policy"]]
    for algorithm, part in found.groupby("algorithm", sort=False):
        shown = _across(part, "settings", settings, lambda one: _interval(one, VALUE, 1))
        gap = _across(part, "settings", [TUNED], lambda one: _interval(one, GAP, 1))
        rows.append([str(algorithm).upper(), str(part["n"].max()), *shown, *gap])
    return rows


def reward(numbers: Mapping[str, pd.DataFrame], algorithm: str, which: str) -> str:
    """Of an algorithm's test episodes with some settings; by default those of tanh, if it was not tuned."""
    tuned = numbers["tuning"].query("algorithm == @algorithm") if "tuning" in numbers else pd.DataFrame()
    if len(tuned):
        return _one(tuned[tuned["settings"] == which], VALUE, 1, "tuning")
    if which != DEFAULT or "further" not in numbers:
        return NOTHING
    sampled = numbers["further"].query("mode == 'sampled'")
    return _one(sampled[sampled["who"] == name(algorithm, "tanh")], REWARD, 1, "further")


def tried(table: pd.DataFrame) -> Rows:
    """The first and the best of each algorithm's trials, and the settings of the best."""
    rows = [["algorithm", "trials", "diverged", "first (default)", "best", "its trial", "settings"]]
    for algorithm, part in table.groupby("algorithm", sort=False):
        first = next(iter(part.loc[part["trial"] == 0, "value"]), math.nan)
        counts = str(len(part)), str(part["value"].isna().sum())
        best, top = [NOTHING] * 3, trials.best(table, str(algorithm))
        if top is not None:
            settings = json.loads(top["settings"]).items()
            told = (
                f"{key}={f'{value:.3g}' if isinstance(value, float) else value}" for key, value in settings
            )
            best = [number(top["value"], 1), str(top["trial"]), ", ".join(told)]
        rows.append([str(algorithm).upper(), *counts, number(first, 1), *best])
    return rows


def facts(configurations: list[Configuration]) -> list[str]:
    """Versions, commits, machines, layouts and evaluations, and which runs have which where they differ."""
    lines = []
    for kind in ("versions", "git_commit", "machine", "layouts", "evaluation"):
        groups: dict[str, list[str]] = {}
        for run in (run for one in configurations for run in one.runs):
            fact = run.meta.get(kind)
            if isinstance(fact, dict):
                fact = ", ".join(f"{key} {show(value)}" for key, value in fact.items())
            groups.setdefault(show(fact or "not known"), []).append(str(run.path))
        for value, paths in groups.items():
            which = f" ({', '.join(paths)})" if len(groups) > 1 else ""
            lines.append(f"{kind.replace('_', ' ')}: {value}{which}")
    return lines


def run_table(configurations: list[Configuration]) -> Rows:
    rows = [["run", "configuration", "seeds", "frames per seed", "ended", "wall time", "threads", "compiled"]]
    unknown = dict.fromkeys(("threads", "compiled", "ended"), "not known")
    for configuration in configurations:
        whose = f"{configuration.algorithm} {configuration.activation}"
        for run in configuration.runs:
            told, wall, first, last = unknown | run.meta, "not known", run.seeds[0], run.seeds[-1]
            if isinstance(seconds := run.meta.get("wall_seconds"), (int, float)):
                wall = str(datetime.timedelta(seconds=round(seconds)))
            seeds = str(first) if first == last else f"{first} ... {last}"
            ended, how = str(told["ended"]).partition("T")[0], map(show, (told["threads"], told["compiled"]))
            rows.append([str(run.path), whose, seeds, f"{run.frames:,}", ended, wall, *how])
    return rows


def of_words(rows: Rows) -> list[bool]:
    """Which columns of a table contain words, and which numbers."""
    return [any(row[place].lstrip("[")[:1].isalpha() for row in rows[1:]) for place in range(len(rows[0]))]


def markdown(rows: Rows) -> str:
    """A table whose first row is its header; numbers, from the third column on, are right-aligned."""
    ruler = ["---" if words or place < 2 else "---:" for place, words in enumerate(of_words(rows))]
    lines = (" | ".join(cell.replace("|", "\\|") for cell in row) for row in [rows[0], ruler, *rows[1:]])
    return "\n".join(f"| {line} |" for line in lines)
