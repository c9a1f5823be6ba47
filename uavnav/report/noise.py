"""The study `noise`: what policies earn with a noisy sensor, trained with and without that noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from uavnav import stats
from uavnav.report.apart import Evaluated, named
from uavnav.tasks.faults import from_words

STUDY = "noise"


def table(found: Sequence[Evaluated]) -> pd.DataFrame:
    """A row a configuration or scripted policy, noise of training and noise of evaluation [px].

    Columns: `value`, the reward; `gap` to the scripted policy `reactive` under the same noise, and how many
    seeds are `above` it; `gain`, the reward minus that of the policies trained without noise, under the same
    noise.
    """
    trained = [one.run.faults.noise if one.run else np.nan for one in found]
    keys = [(one.who, one.how["faults"]) for one in found]
    without = {key: one.reward for key, one, noise in zip(keys, found, trained, strict=True) if noise == 0}
    rows = []
    for key, one, noise in zip(keys, found, trained, strict=True):
        gains = noise > 0 and key in without
        rows.append(
            {"who": one.who, "trained": noise, "evaluated": from_words(one.how["faults"]).noise}
            | stats.difference([one.reward])._asdict()
            | named("gap", stats.difference([one.gap]))
            | {"above": int((one.gap > 0).sum())}
            | named("gain", stats.difference([one.reward], [without[key]]) if gains else stats.NONE)
        )
    return pd.DataFrame(rows).sort_values(["evaluated", "trained"], kind="stable", ignore_index=True)
