"""The study `longer`: who leads after 1, 3 and 10 million frames, by how much, and who passes the scripted
policy.

Who leads is chosen on validation layouts and judged on test layouts.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import matplotlib
import pandas as pd

from uavnav import stats, style
from uavnav.report import charts
from uavnav.report.apart import Evaluated, named
from uavnav.tasks.protocol import MAX_STEPS

STUDY = "longer"
NEAR = 0.1
"""A change within this share of the reward before it counts as none."""


class Where(NamedTuple):
    """Which configuration, and how it was evaluated."""

    settings: str  # default, fast or tuned
    algorithm: str
    activation: str
    layouts: str
    limit: int  # of an episode's steps
    frames: int  # of training


def table(found: Sequence[Evaluated]) -> pd.DataFrame:
    """A row a configuration, split, time limit and length of training.

    Columns: n and `value`, the reward; `gap` to the scripted policy, whose reward is `scripted`, and how many
    seeds are `above` it; `gain` over the length before, seed by seed, and its `trend`; `lead` over the best
    configuration of the other algorithm, and whether it `leads` all. The best are chosen on `validation`.
    """
    known = {}
    for one in found:
        if one.run:
            who = one.run.path.parent.parent.name, one.run.algorithm, one.run.config["activation"]
            frames = round(one.how["at"] * one.run.config["total_frames"])
            known[Where(*who, one.how["layouts"], one.how["max_steps"], frames)] = one
    algorithms = {where.algorithm for where in known}
    rows = []
    for where, own in known.items():
        other = best(known, where, algorithms - {where.algorithm})
        shorter = max((one.frames for one in known if one.frames < where.frames), default=0)
        before = known.get(where._replace(frames=shorter))
        gain = stats.NONE if before is None else stats.difference([own.reward - before.reward])
        lead = stats.NONE if other is None else stats.difference([own.reward], [known[other].reward])
        rows.append(
            where._asdict()
            | {"n": len(own.reward), "above": int((own.gap > 0).sum())}
            | stats.difference([own.reward])._asdict()
            | named("gap", stats.difference([own.gap]))
            | named("lead", lead)
            | named("gain", gain)
            | {"trend": "" if before is None else trend(gain, before.reward.mean())}
            | {"leads": best(known, where, algorithms) == where}
            | {"scripted": own.scripted}
        )
    by = ["layouts", "limit", "frames", "algorithm", "settings", "activation"]
    return pd.DataFrame(rows).sort_values(by, ignore_index=True)


def best(known: Mapping[Where, Evaluated], where: Where, algorithms: Collection[str]) -> Where | None:
    """Of some algorithms, the configuration that earns most on validation layouts with the same time limit
    and length, as it was evaluated on the layouts of `where`; None where there is none.
    """
    judged = {
        one: own.reward.mean()
        for one, own in known.items()
        if one[3:] == ("validation", *where[4:]) and one.algorithm in algorithms
    }
    found = max(judged, key=lambda one: judged[one])._replace(layouts=where.layouts) if judged else None
    return found if found in known else None


def trend(gain: stats.Interval, before: float) -> str:
    """Whether a reward changes with longer training, from the 95 % interval of its change: `rises`, `falls`,
    `saturated` where the interval is within `NEAR` of the reward before, else `open`.
    """
    near = NEAR * abs(before)
    if -near <= gain.low and gain.high <= near:
        return "saturated"
    return "rises" if gain.low > 0 else "falls" if gain.high < 0 else "open"


@matplotlib.rc_context(style.STYLE)
def figure(found: pd.DataFrame, width: float = style.WIDTH) -> style.Drawn:
    """Reward on test layouts by frames of training, a panel an algorithm with its settings."""
    shown = found[(found["layouts"] == "test") & (found["limit"] == MAX_STEPS)]
    if shown.empty:
        return style.nothing("Reward on test layouts")
    panels = [*shown.groupby(["algorithm", "settings"], sort=False)]
    columns, said = 3 if width >= style.WIDTH else 2, []
    drawn, grid = charts.panels(len(panels), columns, 2.3, width, sharex=True, sharey=True)
    for axes, ((algorithm, settings), panel) in zip(grid, panels, strict=True):
        for activation, line in panel.groupby("activation", sort=False):
            look = {"color": style.COLOURS[activation], "marker": "o", "capsize": 3, "label": activation}
            axes.errorbar(line["frames"] / 1e6, line["value"], charts.errors(line), **look)
            last = line.iloc[-1]
            said.append(f"{algorithm.upper()} {settings} {activation} {style.number(last['value'])}")
        axes.axhline(panel["scripted"].iloc[0], **style.SCRIPTED_LINE)
        axes.set_xscale("log")
        ticks = sorted(shown["frames"].unique() / 1e6)
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
        axes.set_title(f"{algorithm.upper()} {settings}")
    drawn.supxlabel("million frames", fontsize=12)
    drawn.supylabel("reward per episode", fontsize=12)
    handles = [
        style.mark("o", name, markerfacecolor=style.COLOURS[name]) for name in shown["activation"].unique()
    ]
    style.legend(drawn, [*handles, style.scripted_mark()], 3)
    return style.Drawn(drawn, f"Reward on test layouts after the longest training: {'; '.join(said)}.")
