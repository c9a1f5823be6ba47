"""The study `learned`: the preset `best` and scripted policies, task by task, also under the shield."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd

from uavnav import stats, style
from uavnav.report import charts
from uavnav.report.apart import Evaluated, evaluations
from uavnav.report.frames import NUMBERS, Rows, columns
from uavnav.runs.metrics import OWN, PER_EPISODE, of_episodes
from uavnav.tasks.faults import from_words

STUDY, AHEAD, SHIELDED = "learned", "learned_ahead", "learned_shielded"
USUAL = 2_000
"""Steps, the time limit of the study's evaluations; a goal has less."""
MEASURES = {
    "reward": "reward",
    "collisions": PER_EPISODE["collisions"],
    "survive": "reach the time limit [%]",
} | {
    name: OWN[name].label for name in ("success", "spl", "barn", "danger", "separation", "curvature", "jerk")
}
"""Columns of `metrics.of_episodes` in words, in the order of the tables."""


def gather(folders: Sequence[Path]) -> tuple[dict[str, pd.DataFrame], list[str]]:
    """The study's tables by name, none where there is no such study; a line for what cannot be read.

    learned: a row a task, policy, shield and measure; learned_ahead: of `ahead`; learned_shielded: of
    `shielded`, also for the configurations of the study `paper`.
    """
    found, left_out = evaluations(folders, STUDY)
    if not found:
        return {}, left_out
    found = [one._replace(who=f"{one.run.algorithm.upper()} best") if one.run else one for one in found]
    of_paper, unread = evaluations(folders, "paper")
    own = table(found)
    return {STUDY: own, AHEAD: ahead(own), SHIELDED: shielded([*found, *of_paper])}, [*left_out, *unread]


def place(one: Evaluated) -> str:
    """The task of an evaluation, its noise, and the time limit where it is more than `USUAL` steps."""
    noise = (one.run.faults if one.run else from_words(one.how["faults"])).noise
    limit = one.how["max_steps"]
    own = [str(one.how["task"]), f"{noise:g} px of noise" * bool(noise), f"{limit:,} steps" * (limit > USUAL)]
    return ", ".join(filter(None, own))


@columns("place", "who", "learned", "shield", "measure", *NUMBERS)
def table(found: Sequence[Evaluated]) -> Rows:
    """A row a task, policy, shield and measure: the mean over seeds and its 95 % interval."""
    for one in sorted(found, key=lambda one: (place(one), one.how["shield"], not one.run)):
        seeds = of_episodes(one.rows)
        facts = [place(one), one.who, bool(one.run), bool(one.how["shield"])]
        for name in (name for name in MEASURES if name in seeds):
            yield [*facts, name, *stats.difference([seeds[name].to_numpy()])]


def ahead(found: pd.DataFrame) -> pd.DataFrame:
    """What a learned policy earns over the scripted one with the most reward in a task.

    A row a task, shield and learned policy, `who`. Of the scripted ones `best_scripted` has most reward,
    `scripted`; `gap` is to it, with its 95 % interval over seeds; `verdict`: learned, scripted or
    open.
    """
    rewards = found[found["measure"] == "reward"]
    own, others = rewards[rewards["learned"]], rewards[~rewards["learned"]]
    best = others.sort_values("value").drop_duplicates(["place", "shield"], keep="last")
    best = best[["place", "shield", "who", "value"]].rename(
        columns={"who": "best_scripted", "value": "scripted"}
    )
    both = own.drop(columns=["learned", "measure"]).merge(best, on=["place", "shield"])
    for name, of in (("gap", "value"), ("gap_low", "low"), ("gap_high", "high")):
        both[name] = both.pop(of) - both["scripted"]
    verdict = np.select([both["gap_low"] > 0, both["gap_high"] < 0], ["learned", "scripted"], "open")
    return both.assign(verdict=verdict)


@columns("place", "who", "value", "gain", "gain_low", "gain_high", "n", "collisions", "left")
def shielded(found: Sequence[Evaluated]) -> Rows:
    """What the shield changes: a row a task and learned policy that was evaluated with and without it.

    Columns place, who, n; `value`, the reward without it; `gain` in reward, seed by seed, with its 95 %
    interval; `collisions` per 1,000 px without it, and `left` of them under it.
    """
    known: dict[tuple[str, str], dict[bool, pd.DataFrame]] = {}
    for one in found:
        if one.run:
            known.setdefault((place(one), one.who), {})[bool(one.how["shield"])] = of_episodes(one.rows)
    for key, own in known.items():
        if len(own) == 2:
            gain = stats.difference([(own[True]["reward"] - own[False]["reward"]).to_numpy()])
            collisions = [own[shield]["collisions"].mean() for shield in (False, True)]
            yield [*key, own[False]["reward"].mean(), *gain, *collisions]


def listed(found: pd.DataFrame, where: str) -> pd.DataFrame:
    """A task's rows as a table crosses them: `who` says the shield too, and `measure` is in words."""
    mine = found[found["place"] == where]
    shield = mine["shield"].map({True: " + shield", False: ""})
    return mine.assign(who=mine["who"] + shield, measure=mine["measure"].map(MEASURES))


@matplotlib.rc_context(style.STYLE)
def figure(found: pd.DataFrame, width: float = style.WIDTH) -> style.Drawn:
    """Reward per episode by policy: a panel a task, without and with the shield."""
    rewards = found[found["measure"] == "reward"]
    panels = {str(where): panel for where, panel in rewards.groupby("place", sort=False)}
    drawn, grid = charts.panels(len(panels), 2 if width >= style.WIDTH else 1, 2.9, width)
    words = {False: "as it is", True: "under the shield"}
    charts.switched(drawn, grid, panels, "who", "shield", words, "reward per episode")
    best = rewards.loc[rewards.groupby("place", sort=False)["value"].idxmax()]
    said = [
        f"{one['place']}: {one['who']}{' + shield' * one['shield']} {style.number(one['value'])}"
        for one in best.to_dict("records")
    ]
    return style.Drawn(drawn, f"The most reward per episode: {'; '.join(said)}.")
