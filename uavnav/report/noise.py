"""The study `noise`: what policies earn with a noisy sensor, trained with and without that noise."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from uavnav import stats
from uavnav.report.apart import Flight, flights
from uavnav.tasks.faults import from_words

STUDY = "noise"


def gather(folders: Sequence[Path]) -> tuple[dict[str, pd.DataFrame], list[str]]:
    """The study's table by its name, none where there is no such study; a line for what cannot be read."""
    found, left_out = flights(folders, STUDY)
    learned = any(one.run for one in found)
    return ({STUDY: table(found)} if learned else {}), left_out


def table(found: Sequence[Flight]) -> pd.DataFrame:
    """A row a configuration or scripted policy, noise of training and noise of evaluation [px].

    Columns: `value`, the reward; `gap` to the scripted policy `reactive` under the same noise, and how many
    seeds are `above` it; `gain`, the reward minus that of the policies trained without noise, under the same
    noise.
    """
    rows = []
    without = {(one.who, one.how["faults"]): one.reward for one in found if one.run and _trained(one) == 0}
    for one in found:
        value, gap = stats.difference([one.reward], []), stats.difference([one.gap], [])
        clean = without.get((one.who, one.how["faults"]))
        gain = (np.nan,) * 3
        if one.run and _trained(one) and clean is not None:
            gain = stats.difference([one.reward], [clean])[:3]
        flown, trained = from_words(one.how["faults"]).noise, _trained(one) if one.run else np.nan
        facts = [one.who, trained, flown, *value[:3], value.n, *gap[:3], int((one.gap > 0).sum()), *gain]
        rows.append(facts)
    columns = ["who", "trained", "flown", "value", "low", "high", "n", "gap", "gap_low", "gap_high", "above"]
    named = pd.DataFrame(rows, columns=[*columns, "gain", "gain_low", "gain_high"])
    return named.sort_values(["flown", "trained"], kind="stable", ignore_index=True)


def _trained(one: Flight) -> float:
    """The noise that a run was trained with [px]."""
    return float(one.run.config["faults"]["noise"]) if one.run else np.nan
