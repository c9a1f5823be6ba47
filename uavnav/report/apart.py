"""Rows of a study in a folder of its own name, apart from those that answer for the paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from uavnav.report.configurations import apart, of_a_study
from uavnav.report.frames import REACTIVE, baselines, gap_to, name
from uavnav.runs import Run, run_folders
from uavnav.runs.evaluations import Protocol
from uavnav.runs.metrics import EVALUATED, MODES
from uavnav.runs.tables import RunError, read_table
from uavnav.stats import Array, Interval
from uavnav.tasks.protocol import SCRIPTED, TASK_NAMES

GREEDY = {"pqn"}
"""Algorithms whose greedy episodes count: their random actions are only for learning."""


def named(name: str, found: Interval) -> dict[str, float]:
    """An interval as the columns of a table."""
    return {name: found.value, f"{name}_low": found.low, f"{name}_high": found.high}


class Evaluated(NamedTuple):
    """An evaluation of a run, or of a scripted policy."""

    who: str  # the configuration, or the scripted policy
    run: Run | None  # None: of a scripted policy
    how: dict[str, Any]  # `task`, `layouts`, `max_steps`, `faults`, `shield`, and `at`, the share of training
    rows: pd.DataFrame  # sampled episodes, or greedy ones of an algorithm of `GREEDY`
    reward: Array  # a seed's mean over them, [S]
    scripted: float  # the reward of the scripted policy `reactive`, evaluated alike; NaN where it was not
    gap: Array  # `reward` minus that of `reactive` on the same layouts, [S]


def evaluations(folders: Sequence[Path], study: str) -> tuple[list[Evaluated], list[str]]:
    """All evaluations of a study, none without a run; a line for what cannot be read; seeds are in order.

    Raises:
        RunError: a folder cannot be read.
    """
    found, left_out = [], []
    for home in apart(folders, study):
        kept, unread = baselines([home])
        scripted = [(name.split("-")[0], rows) for name, rows in kept.items()]
        reactive = {_key(_how(rows)): rows for who, rows in scripted if who == REACTIVE}
        found += [_evaluation(who, None, rows, reactive) for who, rows in scripted if who in SCRIPTED]
        left_out += unread
        for path in filter(of_a_study, run_folders(home)[0]):
            try:
                run = Run(path, rows=False)
                who = name(run.algorithm, run.config["activation"])
                mode = MODES[run.algorithm not in GREEDY]
                for file in run.evaluations():
                    rows = read_table(file, EVALUATED | {"mode": "object"}, "evaluate the run again")
                    found.append(_evaluation(who, run, rows[rows["mode"] == mode], reactive))
            except RunError as error:
                left_out.append(str(error))
    found = [one for one in found if len(one.reward)]
    return (found if any(one.run for one in found) else []), left_out


def _how(rows: pd.DataFrame, run: Run | None = None) -> dict[str, Any]:
    task = run.config["task"] if run else TASK_NAMES[0]
    usual = {**Protocol().header(), "task": task, "faults": "none", "at": 1.0, "shield": False}
    return usual | {str(key): value for key, value in rows.attrs.items()}


def _key(how: Mapping[str, Any]) -> tuple[Any, ...]:
    """What the episodes of a policy and of a scripted one must have in common."""
    return tuple(how.get(key) for key in ("task", "layouts", "episodes", "max_steps", "faults", "shield"))


def _evaluation(
    who: str, run: Run | None, rows: pd.DataFrame, reactive: Mapping[tuple[Any, ...], pd.DataFrame]
) -> Evaluated:
    how = _how(rows, run)
    beside = reactive.get(_key(how), rows[:0])
    own, scripted = (episodes.groupby("seed")["reward"].mean() for episodes in (rows, beside))
    gap = np.empty(0) if beside.empty or rows.empty else gap_to(rows, beside)
    return Evaluated(who, run, how, rows, own.to_numpy(), float(scripted.mean()), gap)
