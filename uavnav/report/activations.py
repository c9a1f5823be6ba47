"""The study `activations`: nine activations with and without LayerNorm, by PPO and by DQN.

Written before a run of it was read: what is measured, and the margins within which activations count as
equal. Kendall's tau came later, when PPO's rows and part of DQN's had been read.

Letters: S seeds of a configuration.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
import pandas as pd

from uavnav import stats, style
from uavnav.report import charts
from uavnav.report.apart import evaluations
from uavnav.report.frames import NUMBERS, Rows, columns, last_tenth, name
from uavnav.report.verdicts import ALPHA, OPEN, SEEDS
from uavnav.runs import Run
from uavnav.runs.definitions import per_frame
from uavnav.runs.tables import RunError
from uavnav.stats import Array

STUDY = "activations"
EQUAL, CARRIED = "activations_equal", "activations_carried"
ALGORITHMS = ("ppo", "dqn")
COMPARED = ("relu", "leaky_relu", "tanh", "sigmoid", "silu", "crelu", "rational", "hadamard", "fourier")
REWARD, FINAL = "reward per 1,000 frames", "reward of a final policy"
PROBES = {"dormant [share]": "dormant", "saturated [share]": "saturated", "effective rank": "effective_rank"}
"""Columns of progress by their labels; shown are means over the last tenth of training."""
MARGINS = {("ppo", REWARD): 5.3, ("dqn", REWARD): 4.4, ("ppo", FINAL): 24.0, ("dqn", FINAL): 5.7}
"""Half of what parts the best and the worst of the paper's activations in the study `paper`, which was read
before: 10.6 and 8.9 per 1,000 frames, 48 and 11 an episode.
"""
LAYER_NORM = {False: "without LayerNorm", True: "with LayerNorm"}


class Where(NamedTuple):
    """Which configuration."""

    algorithm: str
    layer_norm: bool
    activation: str


Measured = Mapping[Where, Mapping[str, Array]]
"""By configuration and measure: a number a seed [S]."""


def gather(folders: Sequence[Path]) -> tuple[dict[str, pd.DataFrame], list[str]]:
    """The study's tables by name, none where there is no such study; a line for what cannot be read.

    activations: a row a configuration and measure; activations_equal: of `judged`; activations_carried: of
    `carried`.
    """
    evaluated, left_out = evaluations(folders, STUDY)
    measured: dict[Where, dict[str, Array]] = {}
    for one in evaluated:
        if one.run is None:
            continue
        try:
            run = Run(one.run.path)
            where = Where(run.algorithm, run.config["layer_norm"], run.config["activation"])
            if where.activation in COMPARED:
                measured[where] = {**_trained(run), FINAL: one.reward}
        except RunError as error:
            left_out.append(str(error))
    if not measured:
        return {}, left_out
    return {STUDY: table(measured), EQUAL: judged(measured), CARRIED: carried(measured)}, left_out


def _trained(run: Run) -> dict[str, Array]:
    seeds = last_tenth(run.progress, run.frames)
    probed = {label: seeds[column].to_numpy() for label, column in PROBES.items() if column in seeds}
    return {REWARD: 1_000 * per_frame(run.episodes, run.frames)["reward"].to_numpy(), **probed}


@columns(*Where._fields, "configuration", "measure", *NUMBERS)
def table(measured: Measured) -> Rows:
    """Means over seeds and their 95 % intervals: a row a configuration and measure."""
    for where in itertools.starmap(Where, itertools.product(ALGORITHMS, (False, True), COMPARED)):
        who = name(where.algorithm, where.activation) + ", LayerNorm" * where.layer_norm
        for measure, seeds in measured.get(where, {}).items():
            yield [*where, who, measure, *stats.difference([seeds])]


def _of(measured: Measured, algorithm: str, layer_norm: bool, measure: str) -> list[Array]:
    """The seeds of each of `COMPARED`; empty where one has too few."""
    none = np.empty(0)
    found = [measured.get(Where(algorithm, layer_norm, one), {}).get(measure, none) for one in COMPARED]
    return found if min(map(len, found)) >= SEEDS else []


@columns("algorithm", "layer_norm", "measure", "margin", "verdict", "best", "worst", *NUMBERS)
def judged(measured: Measured) -> Rows:
    """Whether the choice of an activation matters: a row an algorithm, measure, and LayerNorm or not.

    `irrelevant`: every two activations differ by less than the margin, by two one-sided tests at 5 %.
    `relevant`: two of them differ by more, by one-sided tests at 5 % over all pairs (Bonferroni). Else
    `open`, as where an activation is missing. `value` is the largest difference, of `best` and `worst`, with
    its interval over all pairs.
    """
    for (algorithm, measure), margin in MARGINS.items():
        for layer_norm in (False, True):
            samples = _of(measured, algorithm, layer_norm, measure)
            said = [OPEN, "", "", np.nan, np.nan, np.nan] if not samples else widest(samples, margin)
            yield [algorithm, layer_norm, measure, margin, *said, min(map(len, samples), default=0)]


def widest(samples: Sequence[Array], margin: float) -> list[object]:
    """The verdict on activations in the order of `COMPARED`, and their largest difference; [S] each."""
    pairs = [*itertools.permutations(range(len(samples)), 2)]
    units = np.eye(len(samples))
    found = stats.welch(samples, np.array([units[one] - units[other] for one, other in pairs]))
    low, high = found.lower(ALPHA / len(pairs)), found.upper(ALPHA / len(pairs))
    equal = (found.upper(ALPHA) < margin).all()
    verdict = "irrelevant" if equal else "relevant" if (low > margin).any() else OPEN
    place = int(found.value.argmax())
    best, worst = (COMPARED[one] for one in pairs[place])
    return [verdict, best, worst, *(float(one[place]) for one in (found.value, low, high))]


@columns("layer_norm", "measure", *NUMBERS)
def carried(measured: Measured) -> Rows:
    """Whether PPO's order of activations is DQN's: Kendall's tau of means, a row a measure."""
    for layer_norm, measure in itertools.product((False, True), (REWARD, FINAL, *PROBES)):
        first, second = (_of(measured, algorithm, layer_norm, measure) for algorithm in ALGORITHMS)
        if first and second:
            yield [layer_norm, measure, *stats.concordance(first, second)]


@matplotlib.rc_context(style.STYLE)
def figure(found: pd.DataFrame, width: float = style.WIDTH) -> style.Drawn:
    """Reward per 1,000 frames by activation, a panel an algorithm, with and without LayerNorm."""
    shown = found[found["measure"] == REWARD]
    panels = {str(one).upper(): panel for one, panel in shown.groupby("algorithm", sort=False)}
    columns = len(panels) if width >= style.WIDTH else 1
    drawn, grid = charts.panels(len(panels), columns, 4.2, width, sharey=True)
    words = {one: LAYER_NORM[one] for one in sorted({*shown["layer_norm"]})}
    charts.switched(drawn, grid, panels, "activation", "layer_norm", words, REWARD, COMPARED)
    best = shown.loc[shown.groupby(["algorithm", "layer_norm"], sort=False)["value"].idxmax()]
    said = [
        f"{one['algorithm'].upper()} {LAYER_NORM[one['layer_norm']]}, {one['activation']}"
        f" {style.number(one['value'])}"
        for one in best.to_dict("records")
    ]
    return style.Drawn(drawn, f"The most {REWARD}: {'; '.join(said)}.")
