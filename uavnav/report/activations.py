"""The study `activations`: nine activations with and without LayerNorm, by PPO and by DQN.

Written before a run of it was read: what is measured, and the margins within which activations count as
equal. Letters: S seeds of a configuration.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from uavnav import stats, style
from uavnav.report.apart import flights
from uavnav.report.configurations import one_line
from uavnav.report.frames import name
from uavnav.report.verdicts import ALPHA, SEEDS
from uavnav.runs import Run
from uavnav.runs.definitions import per_frame
from uavnav.runs.tables import RunError
from uavnav.stats import Array

Table = pd.DataFrame
STUDY = "activations"
EQUAL, CARRIED = "activations_equal", "activations_carried"
COMPARED = ("relu", "leaky_relu", "tanh", "sigmoid", "silu", "crelu", "rational", "hadamard", "fourier")
REWARD, FINAL = "reward per 1,000 frames", "reward of a final policy"
PROBES = {"dormant [share]": "dormant", "saturated [share]": "saturated", "effective rank": "effective_rank"}
"""Columns of progress by their labels; shown are means over the last tenth of training."""
MARGINS = {("ppo", REWARD): 5.3, ("dqn", REWARD): 4.4, ("ppo", FINAL): 24.0, ("dqn", FINAL): 5.7}
"""Half of what parts the best and the worst of the paper's activations in the study `paper`, which was read
before: 10.6 and 8.9 per 1,000 frames, 48 and 11 an episode.
"""
RELEVANT, IRRELEVANT, OPEN = "relevant", "irrelevant", "open"


class Where(NamedTuple):
    """Which configuration."""

    algorithm: str
    layer_norm: bool
    activation: str


Measured = Mapping[Where, Mapping[str, Array]]
"""By configuration and measure: a number a seed [S]."""


def gather(folders: Sequence[Path]) -> tuple[dict[str, Table], list[str]]:
    """The study's tables by name, none where there is no such study; a line for what cannot be read.

    activations: a row a configuration and measure; activations_equal: of `judged`; activations_carried: of
    `carried`.
    """
    flown, left_out = flights(folders, STUDY)
    measured: dict[Where, dict[str, Array]] = {}
    for one in flown:
        if one.run is None or not len(one.reward):
            continue
        try:
            run = Run(one.run.path)
            where = Where(run.algorithm, run.config["layer_norm"], run.config["activation"])
            if where.activation in COMPARED:
                measured[where] = {**_trained(run), FINAL: one.reward}
        except RunError as error:
            left_out.append(one_line(error))
    if not measured:
        return {}, left_out
    return {STUDY: table(measured), EQUAL: judged(measured), CARRIED: carried(measured)}, left_out


def _trained(run: Run) -> dict[str, Array]:
    late = run.progress[run.progress["frame"] > 0.9 * run.frames].groupby("seed")
    known = {label: column for label, column in PROBES.items() if column in run.progress}
    reward = 1_000 * per_frame(run.episodes, run.frames)["reward"].to_numpy()
    return {REWARD: reward, **{label: late[column].mean().to_numpy() for label, column in known.items()}}


def table(measured: Measured) -> Table:
    """Means over seeds and their 95 % intervals: a row a configuration and measure."""
    rows = [
        where._asdict()
        | {"configuration": name(where.algorithm, where.activation) + ", LayerNorm" * where.layer_norm}
        | {"measure": measure, **stats.difference([seeds], [])._asdict()}
        for where, own in sorted(measured.items(), key=lambda item: _place(item[0]))
        for measure, seeds in own.items()
    ]
    return pd.DataFrame(rows)


def _place(where: Where) -> tuple[bool, bool, int]:
    """PPO first, then without LayerNorm, then in the order of `COMPARED`."""
    return where.algorithm == "dqn", where.layer_norm, COMPARED.index(where.activation)


def _of(measured: Measured, algorithm: str, layer_norm: bool, measure: str) -> list[Array]:
    """The seeds of each of `COMPARED`; empty where one has too few."""
    none = np.empty(0)
    found = [measured.get(Where(algorithm, layer_norm, one), {}).get(measure, none) for one in COMPARED]
    return found if min(map(len, found)) >= SEEDS else []


def judged(measured: Measured) -> Table:
    """Whether the choice of an activation matters: a row an algorithm, measure, and LayerNorm or not.

    `irrelevant`: every two activations differ by less than the margin, by two one-sided tests at 5 %.
    `relevant`: two of them differ by more, by one-sided tests at 5 % over all pairs (Bonferroni). Else
    `open`, as where an activation is missing. `value` is the largest difference, of `best` and `worst`, with
    its interval over all pairs.
    """
    rows = []
    for (algorithm, measure), margin in MARGINS.items():
        for layer_norm in (False, True):
            samples = _of(measured, algorithm, layer_norm, measure)
            said = [OPEN, "", "", np.nan, np.nan, np.nan] if not samples else widest(samples, margin)
            rows.append([algorithm, layer_norm, measure, margin, *said, min(map(len, samples), default=0)])
    columns = ["algorithm", "layer_norm", "measure", "margin", "verdict", "best", "worst"]
    return pd.DataFrame(rows, columns=[*columns, "value", "low", "high", "n"])


def widest(samples: Sequence[Array], margin: float) -> list[object]:
    """The verdict on activations in the order of `COMPARED`, and their largest difference; [S] each."""
    pairs = [*itertools.permutations(range(len(samples)), 2)]
    units = np.eye(len(samples))
    found = stats.welch(samples, np.array([units[one] - units[other] for one, other in pairs]))
    low, high = found.lower(ALPHA / len(pairs)), found.upper(ALPHA / len(pairs))
    verdict = RELEVANT if (low > margin).any() else OPEN
    verdict = IRRELEVANT if (found.upper(ALPHA) < margin).all() else verdict
    place = int(found.value.argmax())
    best, worst = (COMPARED[one] for one in pairs[place])
    return [verdict, best, worst, *(float(one[place]) for one in (found.value, low, high))]


def carried(measured: Measured) -> Table:
    """Whether PPO's order of activations is DQN's: Spearman's correlation of means, a row a measure."""
    rows = [
        [layer_norm, measure, *stats.rank_correlation(both[0], both[1])]
        for layer_norm in (False, True)
        for measure in (REWARD, FINAL, *PROBES)
        if all(both := [_of(measured, algorithm, layer_norm, measure) for algorithm in ("ppo", "dqn")])
    ]
    return pd.DataFrame(rows, columns=["layer_norm", "measure", "value", "low", "high", "n"])


@matplotlib.rc_context(style.STYLE)
def figure(found: Table, width: float = style.WIDTH) -> style.Drawn:
    """Reward per 1,000 frames by activation, a panel an algorithm, with and without LayerNorm."""
    shown = found[found["measure"] == REWARD]
    panels = [*shown.groupby("algorithm", sort=False)]
    looks = {False: ("o", style.INK, "without LayerNorm"), True: ("D", style.CLEAR, "with LayerNorm")}
    side_by_side = (1, len(panels)) if width >= style.WIDTH else (len(panels), 1)
    drawn = Figure(figsize=(width, 4.2 * side_by_side[0] + 0.6), layout="constrained")
    grid = drawn.subplots(*side_by_side, sharey=True, squeeze=False).ravel()
    said = []
    for axes, (algorithm, panel) in zip(grid, panels, strict=True):
        for layer_norm, part in panel.groupby("layer_norm"):
            marker, colour, _ = looks[bool(layer_norm)]
            rows = part["activation"].map(COMPARED.index) + (0.15 if layer_norm else -0.15)
            ends = np.abs(part[["low", "high"]].to_numpy().T - part["value"].to_numpy())
            axes.errorbar(part["value"], rows, xerr=ends, fmt=marker, color=colour, capsize=3)
            top = part.loc[part["value"].idxmax()]
            best = f"{top['activation']} {style.number(top['value'])}"
            said.append(f"{algorithm.upper()} {looks[bool(layer_norm)][2]}, {best}")
        style.name_rows(axes, [one.replace("_", " ") for one in COMPARED])
        axes.set_title(algorithm.upper())
        axes.set_xlabel(REWARD)
    handles = [style.mark(marker, label, markerfacecolor=one) for marker, one, label in looks.values()]
    style.legend(drawn, handles)
    return style.Drawn(drawn, f"The most {REWARD}: {'; '.join(said)}.")
