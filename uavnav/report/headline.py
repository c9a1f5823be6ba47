"""The tables behind the findings: gaps to the hand-written rule, what settings change, peaks, which reading fits.

Every function gives a frame, one row a number, as those of `frames`. Letters: S seeds of a cell.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from uavnav import stats
from uavnav.report.cells import Cell, curve, episodes_of, windowed
from uavnav.report.claims import PRIMARY, SURGE
from uavnav.report.frames import name, of_seeds
from uavnav.report.studies import AFTER, Cells, Studies, paper_cells, seeds
from uavnav.runs.metrics import finished
from uavnav.runs.readings import EVALUATIONS

RULE = "reactive"
"""The scripted policy that everything learned is held against: `uavnav.tasks.baselines.reactive`."""
VECTORISED = "many environments"
"""The setting in which the study in many environments differs from that in one."""
EVERY = "all cells"
NUMBERS = ["value", "low", "high", "n"]


def cells(studies: Studies) -> pd.DataFrame:
    """How large each study is: columns study, algorithm, activation, seeds, frames (of a seed), worlds (of a seed)."""
    named = {"main": studies.main, VECTORISED: studies.vectorised, "baseline": studies.baseline}
    named |= {"initial": studies.initial, **studies.switches, "tuned": studies.tuned}
    rows = [
        [study, *key, seeds(cell), cell.settings["frames"], cell.settings["n_envs"]]
        for study, found in named.items()
        for key, cell in (paper_cells(found) if study == "main" else found).items()
    ]
    return pd.DataFrame(rows, columns=["study", "algorithm", "activation", "seeds", "frames", "worlds"])


def gaps(cells: Cells, baselines: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Reward of test flights, and its gap to the rule's on the same sets: columns who, mode, cap, n and more.

    `up` is the share of flights that the cap [steps] ended, `above` the share of seeds above the rule. A gap is a mean
    over seeds of each seed's mean over sets of obstacles, with Student's 95 % interval over seeds; it is NaN without
    flights of the rule on the same sets and below the same cap. `per_frame` is reward over steps, mean over seeds.
    """
    known = [(who, "", "scripted", table) for who, table in baselines.items()]
    known += [
        (name(*key), key[0], reading.split()[0], episodes_of(cell, reading))
        for reading, (key, cell) in itertools.product(EVALUATIONS, cells.items())
    ]
    rule = finished(baselines[RULE]) if RULE in baselines else pd.DataFrame()
    rows = []
    for who, algorithm, mode, table in known:
        ended = finished(table)
        if ended.empty:
            continue
        of_seeds = ended.groupby("seed")
        reward, sums = _mean(of_seeds["reward"].mean().to_numpy()), of_seeds[["reward", "steps"]].sum()
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


def worlds(studies: Studies) -> pd.DataFrame:
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
