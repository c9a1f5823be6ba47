"""The study `horizon`: what the discount gamma does, by how long PPO trains and how long an episode may last.

The paper prints no gamma; Stable-Baselines3's default, 0.99, is what it most likely had: steps beyond some
hundred hardly count.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle

import matplotlib
import numpy as np
import pandas as pd

from uavnav import stats, style
from uavnav.colours import colours
from uavnav.report import charts
from uavnav.report.apart import Evaluated, named

STUDY = "horizon"
USUAL = 0.99
"""The gamma that others are compared with."""


def table(found: Sequence[Evaluated]) -> pd.DataFrame:
    """A row a time limit, length of training and gamma.

    Columns: n; `value`, the reward; `survive`, the share of episodes that reach the time limit [%]; `gain`,
    the reward over that with `USUAL`; each with its 95 % interval; `scripted`, the scripted policy's reward;
    `verdict`, by the interval of the gain: more, less or open, or – where there is none.
    """
    known = {
        (one.how["max_steps"], round(one.how["at"] * one.run.frames), one.run.config["gamma"]): one
        for one in found
        if one.run
    }
    rows = []
    for limit, frames, gamma in sorted(known):
        own = known[limit, frames, gamma]
        usual = known.get((limit, frames, USUAL)) if gamma != USUAL else None
        survive = 100 * own.rows.groupby("seed")["truncated"].mean().to_numpy()
        rows.append(
            {"limit": limit, "frames": frames, "gamma": gamma, "scripted": own.scripted}
            | stats.difference([own.reward])._asdict()
            | named("survive", stats.difference([survive]))
            | named("gain", stats.difference([own.reward], [usual.reward]) if usual else stats.NONE)
        )
    table = pd.DataFrame(rows)
    verdicts = [table["gain"].isna(), table["gain_low"] > 0, table["gain_high"] < 0]
    return table.assign(verdict=np.select(verdicts, ["–", "more", "less"], "open"))


@matplotlib.rc_context(style.STYLE)
def figure(found: pd.DataFrame, width: float = style.WIDTH) -> style.Drawn:
    """Reward by frames of training: a panel a time limit, a line a gamma."""
    limits = [*found.groupby("limit")]
    drawn, grid = charts.panels(len(limits), len(limits) if width >= style.WIDTH else 1, 3.4, width)
    gammas = sorted(found["gamma"].unique())
    looks = dict(zip(gammas, zip(colours(["ppo"] * len(gammas)), cycle("os^Dv"), strict=False), strict=True))
    said = []
    for axes, (limit, panel) in zip(grid, limits, strict=True):
        for gamma, line in panel.groupby("gamma"):
            ends = charts.errors(line)
            colour, marker = looks[gamma]
            at = line["frames"] / 1e6 + 0.02 * gammas.index(gamma)  # so that no interval hides another
            axes.errorbar(at, line["value"], ends, color=colour, marker=marker, capsize=3)
            said.append(f"{limit:,} steps, gamma {gamma:g}: {style.number(line['value'].iloc[-1])}")
        axes.axhline(panel["scripted"].iloc[0], **style.SCRIPTED_LINE)
        axes.set_title(f"at most {limit:,} steps")
        axes.set_xlabel("million frames")
        axes.set_ylabel("reward per episode")
    handles = [
        style.mark(marker, f"γ = {gamma:g}", markerfacecolor=colour, markeredgecolor=colour)
        for gamma, (colour, marker) in looks.items()
    ]
    style.legend(drawn, [*handles, style.scripted_mark()], 4)
    return style.Drawn(drawn, f"Reward after the longest training: {'; '.join(said)}.")
