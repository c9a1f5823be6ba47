"""The numbers of the report as data frames, one row a number or a seed: what `tables/*.csv` holds.

Every function takes the cells of a study and gives a frame; the page, the figures and the Markdown show parts of them.
To add a metric, add a line to `metrics.METRICS`; to add a measure of flights, a column to `behaviour.measures`.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from uavnav import stats
from uavnav.report import claims
from uavnav.report.cells import Cell, Key, algorithms, curve, episodes_of, order, read_as, windowed
from uavnav.report.claims import BOUNDED, PAIR, PRIMARY, SURGE, UNBOUNDED, Evidence, long
from uavnav.report.studies import AFTER, TUNED, Cells, Studies, hours, paper_cells, seeds, timed
from uavnav.report.verdicts import Finding, grade, of_claim
from uavnav.runs import paper
from uavnav.runs.metrics import EVALUATED, finished
from uavnav.runs.readings import EVALUATIONS, PER_FRAME, READINGS, SAMPLED
from uavnav.runs.tables import RunError, read_csv, read_table
from uavnav.tasks.protocol import MAX_STEPS

CAP = MAX_STEPS
"""Steps at which the restricted mean of a survival curve ends: the evaluation's own cap."""
DIAGNOSTICS = {
    "dormant": "dormant hidden units [share]",
    "saturated": "saturated activations [share]",
    "effective_rank": "effective rank of the last hidden layer [dimensions]",
    "grad_norm": "gradient norm before clipping",
    "entropy": "entropy of the policy [nat]",
    "q_value": "mean of max Q in training [reward]",
}
"""What a run's progress tells of its networks: columns that may say why activations differ."""
MEASURES = {
    "clearance": "clearance [px]",
    "corridor": "steps in corridors [share]",
    "corridor_flown": "distance flown in corridors [share]",
    "reversals": "reversals of turn [share of steps]",
    "straight_speed": "speed going straight [px a step]",
    "turning_speed": "speed in turns [px a step]",
}
"""How a policy flies: the columns of `behaviour.measures`."""
OVERESTIMATION = {"q": "max Q [reward]", "realised": "realised [reward]", "overestimation": "overestimation [reward]"}
"""What a seed expects and gets: columns of `evaluate.values.overestimation`."""
RULE = "reactive"
"""The scripted policy that everything learned is held against: `uavnav.tasks.baselines.reactive`."""
VECTORISED = "many environments"
"""The setting in which the study in many environments differs from that in one."""
EVERY = "all cells"
CONCLUSIONS = {
    "tanh − relu": (("tanh",), ("relu",)),
    "bounded − unbounded": (BOUNDED, UNBOUNDED),
    "tanh − sigmoid": (("tanh",), ("sigmoid",)),
    "relu − leaky_relu": (("relu",), ("leaky_relu",)),
}
"""What is said of activations, as differences of the mean reward per frame of some and of others."""
NUMBERS = ["value", "low", "high", "n"]
AS_DECIDED = "default"
"""The switch that changes nothing."""


def name(algorithm: str, activation: str) -> str:
    """A cell, in words."""
    return f"{algorithm.upper()} {activation}"


def of_seeds(cell: Cell, reading: str, metric: str = "reward") -> stats.Array:
    """A metric of a cell in one reading: a number a seed [S]."""
    return read_as(cell, reading)[metric].dropna().to_numpy()


def per_seed_values(cells: Cells) -> pd.DataFrame:
    """Every metric of every seed in every reading: algorithm, activation, reading, metric, seed, value."""
    parts = []
    for (algorithm, activation), cell in cells.items():
        for reading in READINGS:
            table = read_as(cell, reading)
            seeds = np.tile(table.index.to_numpy(), table.shape[1])
            metrics = np.repeat(table.columns.to_numpy(), len(table))
            where = (np.full(table.size, one, dtype=object) for one in (algorithm, activation, reading))
            parts.append([*where, metrics, seeds, table.to_numpy().T.ravel()])
    columns = ["algorithm", "activation", "reading", "metric", "seed", "value"]
    joined = map(np.concatenate, zip(*parts, strict=True))
    return pd.DataFrame(dict(zip(columns, joined, strict=True)) if parts else None, columns=columns)


def estimates(values: pd.DataFrame) -> pd.DataFrame:
    """Mean and interquartile mean over seeds, with 95 % intervals, beside the paper's number in the same reading."""
    rows = []
    keys = ["algorithm", "activation", "reading"]
    numbers = ["n", "mean", "low", "high", "interquartile_mean", "iqm_low", "iqm_high", "paper"]
    for key, part in values.groupby(keys, sort=False):
        algorithm, activation, reading = map(str, key)
        of_metrics = {
            str(metric): own.to_numpy(np.float64) for metric, own in part.groupby("metric", sort=False)["value"]
        }
        found = _intervals(tuple(own.tobytes() for own in of_metrics.values()))
        for metric, (mean, middle) in zip(of_metrics, found, strict=True):
            printed = paper.printed(algorithm, activation, metric, reading == PER_FRAME)
            rows.append([*key, metric, mean.n, *mean[:3], *middle[:3], printed])
    return pd.DataFrame(rows, columns=[*keys, "metric", *numbers])


@functools.lru_cache(maxsize=8192)
def _intervals(rows: tuple[bytes, ...]) -> list[list[stats.Interval]]:
    """Mean and interquartile mean of rows of float64 [S] as bytes: page and report.md ask for many of them twice."""
    return stats.intervals([np.frombuffer(row) for row in rows], [np.mean, stats.interquartile_mean])


def verdicts(audits: Mapping[str, Sequence[Finding]]) -> pd.DataFrame:
    """Every part of every claim in every reading; of a claim as a whole, its grade."""
    parts = []
    for reading, findings in audits.items():
        table = pd.DataFrame([finding._asdict() for finding in findings])
        grades = {number: str(grade(of_claim(findings, number))) for number in table["claim"].unique()}
        parts.append(table.assign(reading=reading, grade_of_claim=table["claim"].map(grades)))
    return pd.concat(parts, ignore_index=True)


def predictions(evidence: Mapping[str, Evidence]) -> pd.DataFrame:
    """Each of the paper's numbers, which is one run's, among our seeds (`stats.prediction`); evidence: by reading."""
    rows = []
    for reading, (cell, metric) in itertools.product(evidence, itertools.product(paper.TABLES, paper.COLUMNS)):
        number = paper.printed(*cell, metric, reading == PER_FRAME)
        found = stats.prediction(evidence[reading](*cell, metric), number)
        rows.append([*cell, metric, reading, number, *found])
    columns = ["algorithm", "activation", "metric", "reading", "paper", *stats.Prediction._fields]
    return pd.DataFrame(rows, columns=columns)


FIRST_RULE = (
    {"claim": "int64", "text": "object"}
    | dict.fromkeys(("paper", "value", "low", "high", "p_holm"), "float64")
    | {"n": "int64", "verdict": "object", "verdict_of_claim": "object"}
)
"""Columns of its verdicts."""


def first_rule(folder: Path) -> pd.DataFrame:
    """The verdicts of the first rule, which the report keeps as history; no rows where the folder has none."""
    path = folder / "tables" / "first_rule.csv"
    return read_csv(path, FIRST_RULE, "delete it") if path.exists() else pd.DataFrame(columns=["claim", "text"])


def improvement(cells: Cells) -> pd.DataFrame:
    """For each pair of cells, how probably a seed of the one beats a seed of the other (`stats.improvement`)."""
    return stats.improvement({name(*key): of_seeds(cell, PRIMARY) for key, cell in cells.items()})


def interactions(cells: Cells) -> pd.DataFrame:
    """Whether activations change places between the paper's algorithms: by metric and reading, `stats.interaction`."""
    rows = []
    for reading, metric in itertools.product((PRIMARY, SAMPLED), ("reward", "steps", "distance")):
        samples = {key: of_seeds(cell, reading, metric) for key, cell in cells.items() if key in paper.TABLES}
        found = stats.interaction(long(samples))
        rows.append({"reading": reading, "metric": metric, **found._asdict()})
    return pd.DataFrame(rows)


def survival(cells: Cells, baselines: Mapping[str, pd.DataFrame]) -> tuple[dict[str, pd.Series], pd.DataFrame]:
    """Kaplan-Meier curves of sampled flights, all seeds together, and restricted means over seeds with intervals."""
    curves, rows = {}, []
    flown = {name(*key): episodes_of(cell, SAMPLED) for key, cell in cells.items()}
    for label, part in {**flown, **baselines}.items():
        if part.empty:
            continue
        curves[label] = stats.survival(part["steps"].to_numpy(), part["terminated"].to_numpy())
        means = [
            stats.restricted_mean(one["steps"].to_numpy(), one["terminated"].to_numpy(), CAP)
            for _, one in part.groupby("seed")
        ]
        mean = stats.interval(means)
        rows.append([label, mean.n, len(part), part["truncated"].mean(), *mean[:3]])
    columns = ["cell", "n", "episodes", "cut_off", "restricted_mean", "low", "high"]
    return curves, pd.DataFrame(rows, columns=columns)


def power(cells: Cells) -> pd.DataFrame:
    """Seeds a cell that find the paper's difference in reward of two activations of an algorithm: 80 % power at 5 %."""
    rows = []
    for algorithm in algorithms(cells):
        mine = {activation: cell for (which, activation), cell in paper_cells(cells).items() if which == algorithm}
        values = {activation: of_seeds(cell, PRIMARY) for activation, cell in mine.items()}
        for a, b in itertools.combinations(values, 2):
            n = min(len(values[a]), len(values[b]))
            first, second = (paper.printed(algorithm, one, "reward", PRIMARY == PER_FRAME) for one in (a, b))
            needed = stats.seeds_needed(values[a], values[b], first - second)
            rows.append({"pair": f"{algorithm.upper()}: {a} and {b}", "n": n, "seeds": needed})
    return pd.DataFrame(rows, columns=["pair", "n", "seeds"])


def flown(flights: Mapping[tuple[str, str, str], pd.DataFrame]) -> pd.DataFrame:
    """What flights of the main study look like, one row a cell, mode and seed."""
    parts = [
        table.assign(cell=name(algorithm, activation), algorithm=algorithm, activation=activation)
        for (study, algorithm, activation), table in flights.items()
        if study == "main"
    ]
    columns = ["mode", "seed", "cell", "algorithm", "activation"]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=columns)


def diagnostics(cells: Cells) -> pd.DataFrame:
    """The last tenth of training: mean over seeds and its interval of each diagnostic."""
    rows = []
    for key, cell in cells.items():
        progress = pd.concat([run.progress for run in cell.runs], ignore_index=True)
        late = progress[progress["frame"] > 0.9 * cell.settings["frames"]]
        for column in DIAGNOSTICS:
            if column in late:
                mean = stats.interval(late.groupby("seed")[column].mean())
                rows.append({"cell": name(*key), "diagnostic": column, "n": mean.n, **mean._asdict()})
    return pd.DataFrame(rows, columns=["cell", "diagnostic", "n", "value", "low", "high"])


def compared(cells: Iterable[Key]) -> dict[str, list[Key]]:
    """What a choice may flip: the mean reward of the first half of these cells minus that of the second."""
    within = dict.fromkeys([*claims.ALGORITHMS, *algorithms(cells)])
    between = {" above ".join(map(str.upper, claims.ALGORITHMS)): list(itertools.product(claims.ALGORITHMS, PAIR))}
    return between | {f"{one.upper()}: tanh above ReLU": list(itertools.product([one], PAIR)) for one in within}


def sensitivity(studies: Studies) -> pd.DataFrame:
    """Each conclusion under each switch, beside it as decided: columns switch, conclusion, value, low, high, n, flips.

    An algorithm that a switch does not touch is taken as decided. `flips`: the interval lies wholly on the other side
    of zero than it does as decided; `sign` if only the estimate does.
    """
    rows = []
    for switch, cells in {AS_DECIDED: studies.baseline, **studies.switches}.items():
        for conclusion, keys in compared(studies.baseline).items():
            there = [cells.get(key) or studies.baseline.get(key) for key in keys]
            if None in there or not any(key in cells for key in keys):
                continue
            samples = [of_seeds(cell, PRIMARY) for cell in there if cell is not None]
            found = _first_minus_second(samples)
            rows.append({"switch": switch, "conclusion": conclusion, **found._asdict()})
    decided = {row["conclusion"]: row for row in rows if row["switch"] == AS_DECIDED}
    flips = [_flips(row, decided.get(row["conclusion"])) for row in rows]
    table = pd.DataFrame(rows, columns=["switch", "conclusion", "value", "low", "high", "n"])
    return table.assign(flips=flips)


def _first_minus_second(samples: Sequence[stats.Array]) -> stats.Interval:
    half = len(samples) // 2
    return stats.difference(samples[:half], samples[half:])


def _flips(row: Mapping[str, Any], decided: Mapping[str, Any] | None) -> str:
    if decided is None or decided is row:
        return ""
    if not decided["value"] * row["value"] < 0:
        return "no"
    clear = all(one["low"] * one["high"] > 0 for one in (decided, row))
    return "yes" if clear else "sign"


def by_default(studies: Studies) -> pd.DataFrame:
    """PPO's reward minus DQN's, tuned and in the main study: columns settings, activations, value, low, high, n.

    Both rows are of the activations that both algorithms have in the study `tuned`.
    """
    first, second = ([activation for which, activation in studies.tuned if which == one] for one in claims.ALGORITHMS)
    shared = [activation for activation in first if activation in second]
    keys, rows = list(itertools.product(claims.ALGORITHMS, shared)), []
    for settings, cells in {f"preset {TUNED}": studies.tuned, "main study": studies.main}.items():
        samples = [of_seeds(cells[key], SAMPLED) if key in cells else np.empty(0) for key in keys]
        found = _first_minus_second(samples)
        rows.append({"settings": settings, "activations": ", ".join(shared), **found._asdict()})
    return pd.DataFrame(rows)


def speed(cells: Cells) -> pd.DataFrame:
    """Wall time of a million frames of one seed, by run: columns cell, seconds, seeds, machine."""
    rows = []
    for key, cell in cells.items():
        for run, took in zip(timed(cell), hours(cell), strict=True):
            machine = run.meta.get("machine", {})
            processor = machine.get("processor", "not known") if isinstance(machine, dict) else str(machine)
            rows.append([name(*key), 3600 * took, len(run.seeds), processor])
    return pd.DataFrame(rows, columns=["cell", "seconds", "seeds", "machine"])


def sizes(studies: Studies) -> pd.DataFrame:
    """How large each study is: columns study, algorithm, activation, seeds, frames (of a seed), worlds (of a seed)."""
    named = {"main": studies.main, VECTORISED: studies.vectorised, "baseline": studies.baseline}
    named |= {"initial": studies.initial, **studies.switches, "tuned": studies.tuned}
    rows = [
        [study, *key, seeds(cell), cell.settings["frames"], cell.settings["n_envs"]]
        for study, found in named.items()
        for key, cell in (paper_cells(found) if study == "main" else found).items()
    ]
    return pd.DataFrame(rows, columns=["study", "algorithm", "activation", "seeds", "frames", "worlds"])


def gaps(cells: Cells, scripted: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Reward of test flights, and its gap to the rule's on the same sets: columns who, mode, cap, n and more.

    `up` is the share of flights that the cap [steps] ended, `above` the share of seeds above the rule. A gap is a mean
    over seeds of each seed's mean over sets of obstacles, with Student's 95 % interval over seeds; it is NaN without
    flights of the rule on the same sets and below the same cap. `per_frame` is reward over steps, mean over seeds.
    """
    known = [(who, "", "scripted", table) for who, table in scripted.items()]
    known += [
        (name(*key), key[0], reading.split()[0], episodes_of(cell, reading))
        for reading, (key, cell) in itertools.product(EVALUATIONS, cells.items())
    ]
    rule = finished(scripted[RULE]) if RULE in scripted else pd.DataFrame()
    rows = []
    for who, algorithm, mode, table in known:
        ended = finished(table)
        if ended.empty:
            continue
        by_seed = ended.groupby("seed")
        reward, sums = _mean(by_seed["reward"].mean().to_numpy()), by_seed[["reward", "steps"]].sum()
        own = _to_rule(ended, rule) if who != RULE else np.empty(0)
        above = float((own > 0).mean()) if len(own) else np.nan
        facts = (_cap(ended), reward.n, len(ended), ended["truncated"].mean())
        per_frame = (sums["reward"] / sums["steps"]).mean()
        rows.append([who, algorithm, mode, *facts, *reward[:3], per_frame, *_mean(own)[:3], above])
    columns = ["who", "algorithm", "mode", "cap", "n", "flights", "up", "reward", "low", "high", "per_frame"]
    return pd.DataFrame(rows, columns=[*columns, "gap", "gap_low", "gap_high", "above"])


def best(gaps: pd.DataFrame, mode: str, algorithm: str) -> Any:
    """Where the cell of an algorithm with the highest reward stands in a table of `gaps`; None where there is none."""
    mine = gaps[(gaps["mode"] == mode) & (gaps["algorithm"] == algorithm)]
    return mine["reward"].idxmax() if len(mine) else None


def _mean(seeds: stats.Array) -> stats.Interval:
    """The mean of one number a seed [S] with Student's interval."""
    return stats.difference([seeds], []) if len(seeds) else stats.Interval(np.nan, np.nan, np.nan, 0)


def _cap(flights: pd.DataFrame) -> float:
    """At how many steps flights were cut off; NaN where none was."""
    return float(flights.loc[flights["truncated"], "steps"].max())


def _to_rule(flights: pd.DataFrame, rule: pd.DataFrame) -> stats.Array:
    """Each seed's mean gap to the rule over the sets of obstacles that both flew [S]; none if their caps differ."""
    if rule.empty or not set(flights["layout"]) <= set(rule["layout"]) or abs(_cap(flights) - _cap(rule)) > 0:
        return np.empty(0)  # a cap that ended no flight is NaN
    of_rule = flights["layout"].map(rule.groupby("layout")["reward"].mean())
    return (flights["reward"] - of_rule).groupby(flights["seed"]).mean().to_numpy()


def effects(studies: Studies) -> pd.DataFrame:
    """What a setting changes in an algorithm's reward per frame: columns switch, algorithm, frames, and `NUMBERS`.

    The mean over the activations that both have, minus that as decided; many environments minus one. frames: a seed.
    """
    pairs = [(switch, cells, studies.baseline) for switch, cells in studies.switches.items()]
    pairs.append((VECTORISED, paper_cells(studies.vectorised), paper_cells(studies.main)))
    rows = []
    for switch, changed, usual in pairs:
        shared = [key for key in changed if key in usual]
        for algorithm in dict.fromkeys(which for which, _ in shared):
            keys = [key for key in shared if key[0] == algorithm]
            first, second = ([of_seeds(cells[key], PRIMARY) for key in keys] for cells in (changed, usual))
            frames = max(changed[key].settings["frames"] for key in keys)
            rows.append([switch, algorithm, frames, *stats.difference(first, second)])
    return pd.DataFrame(rows, columns=["switch", "algorithm", "frames", *NUMBERS])


def one_against_many(studies: Studies) -> pd.DataFrame:
    """What one environment a seed changes beside the mean, against many: columns measure, algorithm, and `NUMBERS`.

    One minus many, mean over the activations that both studies have, with Welch's interval over seeds:

    - scatter: the standard deviation over seeds of reward per frame in the last 100,000 frames (`stats.deviations`);
    - longest: the longest flight of a seed that is open at the end [steps], 0 where none is;
    - open: the share of a seed's frames in flights that are open at the end.

    order: Spearman's correlation, one against many, of the activations' mean rewards per frame.
    """
    one, many = paper_cells(studies.main), paper_cells(studies.vectorised)
    shared, rows = [key for key in one if key in many], []
    for algorithm in dict.fromkeys(which for which, _ in shared):
        pairs = [[cells[key] for key in shared if key[0] == algorithm] for cells in (one, many)]
        for measure, of in {"scatter": _scatter, "longest": _longest, "open": _open}.items():
            first, second = ([of(cell) for cell in cells] for cells in pairs)
            rows.append([measure, algorithm, *stats.difference(first, second)])
        first, second = ([of_seeds(cell, PRIMARY) for cell in cells] for cells in pairs)
        rows.append(["order", algorithm, *stats.rank_correlation(first, second)])
    return pd.DataFrame(rows, columns=["measure", "algorithm", *NUMBERS])


def _scatter(cell: Cell) -> stats.Array:
    frames = cell.settings["frames"]
    return stats.deviations(windowed(cell, "reward", [(frames - AFTER, frames)])[0].to_numpy())


def _longest(cell: Cell) -> stats.Array:
    return np.asarray(_open_flights(cell).max(), dtype=np.float64)


def _open(cell: Cell) -> stats.Array:
    return np.asarray(_open_flights(cell).sum() / cell.settings["frames"])


def _open_flights(cell: Cell) -> Any:
    """Steps of flights that are open at the end, 0 for all others, by seed."""
    ended = cell.episodes["terminated"] | cell.episodes["truncated"]
    return cell.episodes["steps"].where(~ended, 0).groupby(cell.episodes["seed"])


def carried(studies: Studies, evidence: Evidence) -> pd.DataFrame:
    """What is said of activations, by algorithm, in many environments: columns conclusion, algorithm, value, ...

    None unless an algorithm beyond the paper's has runs with the activations that some conclusion asks for.
    """
    study = "vectorised"
    there = sorted(studies.of(study), key=order)
    algorithms = list(dict.fromkeys(algorithm for algorithm, _ in there))
    rows = []
    for (label, sides), algorithm in itertools.product(CONCLUSIONS.items(), algorithms):
        first, second = (
            [evidence(algorithm, activation, "reward", study=study) for activation in side] for side in sides
        )
        if all(len(one) for one in (*first, *second)):
            rows.append([label, algorithm, *stats.difference(first, second)])
    found = pd.DataFrame(rows, columns=["conclusion", "algorithm", "value", "low", "high", "n"])
    return found if {*found["algorithm"]} - {*paper.TABLE_OF} else found[:0]


def peaks(cells: Cells) -> pd.DataFrame:
    """When a cell earns most per frame, and what it loses after 600,000 frames: columns cell, measure, and `NUMBERS`.

    `peak` is the middle of each seed's best stretch of training [frames]; `lost` the share of the rise in reward per
    frame, from the first 300,000 frames to the next, that is gone in the last 100,000 (Fieller's interval).
    """
    rows = []
    for key, cell in cells.items():
        frames = cell.settings["frames"]
        if frames < SURGE[1] + AFTER:
            continue
        best = np.asarray(curve(cell, "reward").round(9).idxmax(), dtype=np.float64)  # of equal ones the first
        before, surge, after = windowed(cell, "reward", [(0, SURGE[0]), SURGE, (frames - AFTER, frames)]).to_numpy().T
        rows += [[name(*key), "peak", *_mean(best)], [name(*key), "lost", *stats.ratio(surge - after, surge - before)]]
    return pd.DataFrame(rows, columns=["cell", "measure", *NUMBERS])


def fits(predictions: pd.DataFrame) -> pd.DataFrame:
    """How well the paper's numbers fit our prediction intervals: columns reading, cell, within, numbers, score.

    Of so many numbers, so many lie within. A wide interval holds any number, so the score of a 95 % interval (Gneiting
    and Raftery 2007, eq. 43) is its width plus 2 / 0.05 times how far it misses the number; the mean over numbers, each
    score in units of the paper's number. Less is better.

    predictions: as `frames.predictions` gives it; numbers without seeds are left out.
    """
    known = predictions[predictions["n"] > 1]
    low, high, number = (known[name] for name in ("low", "high", "paper"))
    missed = (low - number).clip(lower=0) + (number - high).clip(lower=0)
    score = (high - low + 2 / 0.05 * missed) / number.abs()
    named = known.assign(cell=known["algorithm"].str.upper() + " " + known["activation"], score=score)
    counted = [
        (reading, cell, int(part["within"].sum()), len(part), part["score"].mean())
        for reading, own in named.groupby("reading", sort=False)
        for cell, part in [(EVERY, own), *own.groupby("cell", sort=False)]
    ]
    return pd.DataFrame(counted, columns=["reading", "cell", "within", "numbers", "score"])


def baselines(folders: Sequence[Path]) -> tuple[dict[str, pd.DataFrame], list[str]]:
    """Rows of scripted policies and of people: `baselines/*.parquet` in the report's folders; what cannot be read."""
    found, left_out = {}, []
    for path in (path for folder in folders for path in sorted((folder / "baselines").glob("*.parquet"))):
        try:
            found[path.stem] = read_table(path, EVALUATED, "evaluate it again")
        except RunError as error:
            left_out.append(str(error))
    return found, left_out


def total_frames(cells: Cells) -> str:
    """How many frames a seed has: one number, or from ... to ..."""
    return least_to_most(cell.settings["frames"] for cell in cells.values())


def worlds(cells: Cells) -> str:
    """How many parallel environments a seed has: one number, or from ... to ..."""
    return least_to_most(cell.settings["n_envs"] for cell in cells.values())


def least_to_most(counts: Iterable[int], noun: str = "") -> str:
    """The range of some counts, one number where they are the same; and of what, in the plural unless there is one."""
    ordered = sorted({*counts})
    shown = " to ".join(f"{count:,}" for count in dict.fromkeys([*ordered[:1], *ordered[-1:]])) or "0"
    return f"{shown} {noun}{'s' * (ordered != [1])}" if noun else shown
