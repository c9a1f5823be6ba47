"""The study `ambiguities`: which environment the paper may have used, by draws of what it leaves open.

The draws are fitted to what DQN logs with tanh and sigmoid. The other configurations, the curve of DQN with
sigmoid and PPO's order are held out.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from uavnav import stats
from uavnav.report.claims import around_surge
from uavnav.report.configurations import apart, order, settings_of, show
from uavnav.report.frames import Rows, columns, lost, name
from uavnav.runs import Run, draws, paper
from uavnav.runs.definitions import last_hundred
from uavnav.settings import differing
from uavnav.stats import Array

STUDY, DRAWS = "ambiguities", "draws"
FOLLOW = {"frames", "layouts", "total_frames"}
"""Settings that follow from others."""
REJECTED = 0.05
PPO_ORDER, SURGES = "PPO's order of rewards", "DQN sigmoid: share of the rise that is lost"
SURGING = ("dqn", "sigmoid")
COLUMNS = ["part", "value", "low", "high", "n", "p_holm", "verdict"]
AS_PRINTED, NOT, OPEN = "as printed", "not as printed", "open"


def gather(folders: Sequence[Path]) -> tuple[dict[str, pd.DataFrame], list[str]]:
    """The study's tables by name, none where there is no such study; a line for what cannot be read.

    draws: all draws, the nearest first, with their settings; ambiguities: the nearest, a row a part.
    """
    left_out: list[str] = []
    for home in apart(folders, STUDY):
        screened, unread = draws.runs_of(home / draws.SCREEN)
        further, unread_too = draws.runs_of(home / draws.NEAREST)
        left_out += [*unread, *unread_too]
        if not screened:
            continue
        near, seeds = draws.distances(draws.by_draw(screened)), draws.by_draw(further)
        chosen = {}
        for number, (run, *_) in screened.items():
            own = settings_of(run.config, run.meta, run.frames)
            chosen[number] = {key: show(value) for key, value in own.items()}
        settings, varied = pd.DataFrame(chosen).T, differing(chosen.values()) - FOLLOW
        shown = settings.loc[near.index, settings.columns.isin(varied)]
        tables = {DRAWS: shown.join(near).rename_axis("draw").reset_index()}
        rows = [
            {"draw": number} | row
            for number in near.index
            if number in further
            for table in (judged(seeds[number]), surges(further[number]))
            for row in table.to_dict("records")
        ]
        tables |= {STUDY: pd.DataFrame(rows)} if rows else {}
        return tables, left_out
    return {}, left_out


@columns(*COLUMNS)
def judged(seeds: draws.Seeds) -> Rows:
    """How the paper's numbers fit one draw: a row a part, with a verdict.

    A configuration's six metrics, as Stable-Baselines3 logs them, as one more seed: Mahalanobis' distance
    from the seeds' mean and Hotelling's p, by Holm over the configurations. It is rejected where that is
    below 5 %.
    """
    keys = sorted((key for key in seeds if key in paper.TABLES), key=order)
    printed = {key: np.array([*paper.TABLES[key].values()]) for key in keys}
    p_values = [stats.joint(seeds[key], printed[key])[0] for key in keys]
    for key, p_holm in zip(keys, stats.holm(p_values), strict=True):
        distance = stats.mahalanobis([seeds[key]], printed[key])[0]
        verdict = OPEN if np.isnan(p_holm) else "rejected" if p_holm < REJECTED else "fits"
        yield [name(*key), distance, np.nan, np.nan, len(seeds[key]), p_holm, verdict]
    reward = paper.COLUMNS.index("reward")
    yield _order({key[1]: seeds[key][:, reward] for key in keys if key[0] == "ppo"})


def _order(rewards: dict[str, Array]) -> list[object]:
    """How often one seed of each activation would stand in the paper's order, and whether their means do."""
    n = min(len(rewards.get(one, ())) for one in paper.ACTIVATIONS)
    if not n:
        return [PPO_ORDER, np.nan, np.nan, np.nan, n, np.nan, OPEN]
    in_order = sorted(paper.ACTIVATIONS, key=lambda one: -paper.printed("ppo", one, "reward"))
    means = [rewards[one].mean() for one in in_order]
    chance = stats.chance_of_order([rewards[one] for one in in_order])
    verdict = AS_PRINTED if means == sorted(means, reverse=True) else NOT
    return [PPO_ORDER, chance, np.nan, np.nan, n, np.nan, verdict]


@columns(*COLUMNS)
def surges(runs: Sequence[Run]) -> Rows:
    """The share of the rise in the reward that DQN with sigmoid logs, from the first 300,000 frames to the
    next, that is lost in the last 100,000; as printed where it is more than half.
    """
    for run in (one for one in runs if (one.algorithm, one.config["activation"]) == SURGING):
        rewards = last_hundred(run.episodes, "reward", around_surge(run.frames))
        share = lost(*rewards.dropna().to_numpy().T)
        verdict = AS_PRINTED if share.low > 0.5 else NOT if share.high < 0.5 else OPEN
        yield [SURGES, *share, np.nan, verdict]


def standing(found: pd.DataFrame) -> pd.Series[str]:
    """Whether each draw `fits`: the paper's numbers reject none of its configurations, and all of them could
    tell; or is `rejected`, or `open`.
    """
    of_tables = found[~found["part"].isin([PPO_ORDER, SURGES])]
    verdicts = of_tables.groupby("draw", sort=False)["verdict"].agg(list)
    whole = len(paper.TABLES)
    return verdicts.map(
        lambda own: "rejected" if "rejected" in own else "fits" if own.count("fits") == whole else OPEN
    )
