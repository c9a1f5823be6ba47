"""The study `horizon`: what the discount gamma does, by how long PPO trains and how long an episode may last.

The paper prints no gamma; Stable-Baselines3's default, 0.99, is what it most likely had: steps beyond some
hundred hardly count. Letters: S seeds of a configuration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
import pandas as pd

from uavnav import stats, style
from uavnav.colours import colours
from uavnav.report import charts
from uavnav.report.apart import flights, named
from uavnav.report.frames import RULE
from uavnav.stats import Array

STUDY = "horizon"
USUAL = 0.99
"""The gamma that others are compared with."""


class Where(NamedTuple):
    """Which policies, and how they were flown."""

    limit: int  # of an episode's steps
    frames: int  # of training
    gamma: float


class Seeds(NamedTuple):
    """A number a seed, [S] each."""

    reward: Array  # mean over test episodes, sampled
    survive: Array  # share of them that reach the time limit [%]


def gather(folders: Sequence[Path]) -> tuple[dict[str, pd.DataFrame], list[str]]:
    """The study's table by its name, none where there is no such study; a line for what cannot be read."""
    found, left_out = flights(folders, STUDY)
    flown = {
        Where(one.how["max_steps"], round(one.how["at"] * one.run.frames), one.run.config["gamma"]): Seeds(
            one.reward, 100 * one.rows.groupby("seed")["truncated"].mean().to_numpy()
        )
        for one in found
        if one.run and len(one.reward)
    }
    rules = {one.how["max_steps"]: float(one.reward.mean()) for one in found if one.who == RULE}
    return ({STUDY: table(flown, rules)} if flown else {}), left_out


def table(flown: Mapping[Where, Seeds], rules: Mapping[int, float]) -> pd.DataFrame:
    """A row a time limit, length of training and gamma.

    rules: the scripted policy's reward by time limit. Columns: n; `value`, the reward; `survive`; `gain`, the
    reward over that with `USUAL`; each with its 95 % interval; `scripted`; `verdict`, by the interval of the
    gain: more, less or open, or – where there is none.
    """
    rows = []
    for where, own in sorted(flown.items()):
        usual = flown.get(where._replace(gamma=USUAL)) if where.gamma != USUAL else None
        gain = stats.difference([own.reward], [usual.reward]) if usual else stats.NONE
        rows.append(
            where._asdict()
            | {"n": len(own.reward), "scripted": rules.get(where.limit, np.nan)}
            | named("value", stats.difference([own.reward]))
            | named("survive", stats.difference([own.survive]))
            | named("gain", gain)
        )
    found = pd.DataFrame(rows)
    verdicts = [found["gain"].isna(), found["gain_low"] > 0, found["gain_high"] < 0]
    return found.assign(verdict=np.select(verdicts, ["–", "more", "less"], "open"))


@matplotlib.rc_context(style.STYLE)
def figure(found: pd.DataFrame, width: float = style.WIDTH) -> style.Drawn:
    """Reward by frames of training: a panel a time limit, a line a gamma."""
    limits = [*found.groupby("limit")]
    drawn, grid = charts.panels(len(limits), len(limits) if width >= style.WIDTH else 1, 3.4, width)
    gammas = sorted(found["gamma"].unique())
    looks = dict(zip(gammas, zip(colours(["ppo"] * len(gammas)), "os^Dv", strict=False), strict=False))
    said = []
    for axes, (limit, panel) in zip(grid, limits, strict=True):
        for gamma, line in panel.groupby("gamma"):
            ends = charts.errors(line, ["value_low", "value_high"])
            colour, marker = looks[gamma]
            at = line["frames"] / 1e6 + 0.02 * gammas.index(gamma)  # so that no interval hides another
            axes.errorbar(at, line["value"], ends, color=colour, marker=marker, capsize=3)
            said.append(f"{limit:,} steps, gamma {gamma:g}: {style.number(line['value'].iloc[-1])}")
        axes.axhline(panel["scripted"].iloc[0], **style.RULED)
        axes.set_title(f"at most {limit:,} steps")
        axes.set_xlabel("million frames")
        axes.set_ylabel("reward per episode")
    handles = [
        style.mark(marker, f"γ = {gamma:g}", markerfacecolor=colour, markeredgecolor=colour)
        for gamma, (colour, marker) in looks.items()
    ]
    style.legend(drawn, [*handles, matplotlib.lines.Line2D([], [], label=style.RULE, **style.RULED)], 4)
    return style.Drawn(drawn, f"Reward after the longest training: {'; '.join(said)}.")
