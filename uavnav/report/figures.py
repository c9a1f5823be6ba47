"""Which figures a report has: at most twelve, each with its section and a caption; none repeats a table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pandas as pd

from uavnav import style
from uavnav.evaluation import WATCHED_LAYOUTS, WATCHED_STEPS
from uavnav.report import arena, behaviour, charts, curves, frames, longer, worlds
from uavnav.report.claims import EVERY, LOG, PRIMARY, PRINTED, TRAINING
from uavnav.report.configurations import algorithms
from uavnav.report.frames import RULE, name
from uavnav.report.studies import Configurations
from uavnav.report.verdicts import COUNTS
from uavnav.report.worlds import Worlds
from uavnav.runs import paper
from uavnav.runs.definitions import PER_FRAME, SAMPLED, words
from uavnav.runs.metrics import MODES
from uavnav.stats import Array, Interval
from uavnav.style import Drawn
from uavnav.tasks import layouts
from uavnav.tasks.world import World

SHOWN_LAYOUTS = (0, 1, 2)
SHOWN_ACTIVATION = "tanh"
"""Trajectories show these; the replays show all."""


class Figure(NamedTuple):
    """A figure, where it belongs, and what the reader should see in it."""

    name: str  # of its files
    section: str
    drawn: Drawn
    caption: str


def draw(
    configurations: Configurations,
    numbers: Mapping[str, pd.DataFrame],
    episodes: Mapping[tuple[str, str, str], pd.DataFrame],
    survival: Mapping[str, pd.Series],
    of_worlds: Worlds | None = None,
    width: float = style.WIDTH,
) -> list[Figure]:
    """All figures, in the order of the page.

    configurations: of the paper's activations in the main study; numbers: the report's tables by name;
    episodes: steps by study, algorithm and activation; survival: curves by configuration; width: of the
    figures [inches].
    """
    flown = {key[1:]: table for key, table in episodes.items() if key[0] == "main"}
    found = [_first(numbers["seeds"], numbers["gaps"], width), _forest(numbers["verdicts"], width)]
    found += _curves(configurations, width)
    found += [
        _training(numbers["seeds"], numbers["gaps"], width),
        *_paths(flown, width),
        *_places(flown, width),
    ]
    found.append(_survival(configurations, numbers["survival"], survival, width))
    if len(numbers["behaviour"]):
        sampled = numbers["behaviour"].query("mode == 'sampled'")
        drawn = charts.behaviours(
            sampled[["configuration", "algorithm", "activation", "seed", *frames.MEASURES]], width
        )
        caption = (
            "Each small dot is a seed, the bar its configuration's 95 % interval; sampled episodes on "
            "test layouts."
        )
        found.append(Figure("behaviour", "behaviour", drawn, caption))
    if len(numbers["sensitivity"]):
        caption = (
            "The band is the interval as decided; an interval on the other side of zero flips a conclusion."
        )
        found.append(
            Figure("sensitivity", "sensitivity", charts.sensitivity(numbers["sensitivity"], width), caption)
        )
    if of_worlds and (density := worlds.ladder(of_worlds, "density", width)):
        caption = (
            "The density ladder: policies trained in the paper's task, means over activations with Welch's "
            "95 %"
            " intervals over seeds. Dotted and dashed: scripts."
        )
        found.append(Figure("worlds-density", "worlds", density, caption))
    if longer.STUDY in numbers:
        caption = (
            "Does longer training pay? Reward on test layouts, sampled, at most 10,000 steps: means and 95 % "
            "intervals over seeds. Dashed: the scripted policy."
        )
        found.append(Figure("longer", "longer", longer.figure(numbers[longer.STUDY], width), caption))
    return found


def _forest(verdicts: pd.DataFrame, width: float) -> Figure:
    """The effects on reward that the paper prints, by both ways of averaging training."""
    rows = []
    for label, (number, place) in PRINTED.items():
        for column in (TRAINING, LOG):
            text = EVERY[number - 1].asks(column)[place].text
            chosen = verdicts["claim"].eq(number) & verdicts["column"].eq(column) & verdicts["text"].eq(text)
            one = verdicts[chosen].iloc[0]
            ends = one[["ratio", "ratio_low", "ratio_high"]].astype(float)
            rows.append([label, column, *ends, one["standing"] == COUNTS])
    table = pd.DataFrame(rows, columns=["row", "column", "ratio", "low", "high", "counts"])
    caption = (
        "How much of the paper's difference of reward do our seeds find? At 1 as much as printed, at 0 none, "
        "below 0 the other way round. Bars: 95 % intervals over seeds, adjusted within a claim; arrows go on."
        " Grey: the paper's effect is too small for so many seeds."
    )
    return Figure("forest", "verdicts", charts.forest(table, width), caption)


def _of_rule(gaps: pd.DataFrame, column: str) -> float:
    """What the scripted policy reaches on the test layouts; NaN without its episodes."""
    found = gaps.loc[gaps["who"] == RULE, column]
    return float(found.iloc[0]) if len(found) else np.nan


def _curves(configurations: Configurations, width: float) -> list[Figure]:
    found = []
    for algorithm in dict.fromkeys([*paper.TABLE_OF, *algorithms(configurations)]):
        mine = {
            activation: configuration
            for (which, activation), configuration in configurations.items()
            if which == algorithm
        }
        printed = {one: paper.printed(algorithm, one, "reward", per_frame=True) for one in mine}
        number = paper.CURVES_OF.get(algorithm)
        beside = f", as the paper's Figure {number}" if number else ""
        dashed = "; dashed: the paper's mean" if number else ""
        caption = (
            f"{algorithm.upper()}{beside}: {words('reward', PER_FRAME)} in each stretch of training, of all "
            "seeds and"
            f" episodes, open ones too. Line: {curves.LINES['reward']}; band: its 95 % interval over "
            f"seeds{dashed}."
        )
        known = {name: mean for name, mean in printed.items() if np.isfinite(mean)}
        drawn = curves.curves(mine, "reward", known, f"{algorithm.upper()}: ", width)
        found.append(Figure(f"curves-{algorithm}-reward", "curves", drawn, caption))
    return found


def _training(values: pd.DataFrame, gaps: pd.DataFrame, width: float) -> Figure:
    """Configurations side by side by their reward in training."""
    rule, seeds = _of_rule(gaps, "per_frame"), _seeds(values, PRIMARY, "reward")
    printed = {name(*key): paper.printed(*key, "reward", PRIMARY == PER_FRAME) for key in paper.TABLES}
    caption = f"{PRIMARY.capitalize()}: seeds, their mean with its 95 % interval, and the paper's run."
    if np.isfinite(rule):
        caption += f" Dashed: the scripted policy `{RULE}` on the test layouts."
    drawn = charts.intervals(seeds, printed, words("reward", PRIMARY), rule, width)
    return Figure("configurations-reward", "tables", drawn, caption)


def _first(values: pd.DataFrame, gaps: pd.DataFrame, width: float) -> Figure:
    """The figure of the first screen, as wide as the page: the reward of test episodes, with the rule's."""
    seeds, sampled = _seeds(values, SAMPLED, "reward"), gaps[gaps["mode"] == MODES[1]]
    rows = {
        row["who"]: (seeds[row["who"]], Interval(row["reward"], row["low"], row["high"], row["n"]))
        for row in sampled.to_dict("records")
        if row["who"] in seeds
    }
    full = style.FULL if width >= style.WIDTH else width
    looks = {label: (style.of_pilot(label), "-") for label in rows}
    drawn = charts.episodes(rows, looks, _of_rule(gaps, "reward"), "reward an episode, new obstacles", full)
    limits = sampled["limit"].dropna()
    limit = f" Episodes end at a collision, or after {limits.max():,.0f} steps." if len(limits) else ""
    caption = "A small dot is a training run, a large one the mean of its row with its 95 % interval."
    return Figure("configurations-episodes", "first", drawn, f"{caption}{limit} The paper: {paper.TITLE}.")


def _seeds(values: pd.DataFrame, definition: str, metric: str) -> dict[str, Array]:
    """Each of the paper's configurations: one number a seed [S]."""
    shown = values[(values["definition"] == definition) & (values["metric"] == metric)]
    return {
        name(*(str(one) for one in key)): part["value"].dropna().to_numpy()
        for key, part in shown.groupby(["algorithm", "activation"], sort=False)
        if key[1] in paper.ACTIVATIONS
    }


def _paths(flown: Mapping[tuple[str, str], pd.DataFrame], width: float) -> list[Figure]:
    shown = {
        name(*key): table[table["layout"] >= 0] for key, table in flown.items() if key[1] == SHOWN_ACTIVATION
    }
    if not shown:
        return []
    drawn = arena.trajectories(
        shown, layouts.load("test").numpy(), SHOWN_LAYOUTS, World(), mode="sampled", width=width
    )
    caption = (
        f"As the paper's Figures {' and '.join(map(str, paper.PATHS))}: the first seed's episodes on"
        f" {len(SHOWN_LAYOUTS)} test layouts, at most {WATCHED_STEPS} steps, as in training (sampled), with"
        f" {SHOWN_ACTIVATION}. The replays below show the others."
    )
    return [Figure("trajectories", "episodes", drawn, caption)]


def _places(flown: Mapping[tuple[str, str], pd.DataFrame], width: float) -> list[Figure]:
    """Heat maps, a panel an algorithm."""
    chosen = "mode == 'sampled' and layout >= 0"
    sampled = {key: part for key, table in flown.items() if len(part := table.query(chosen))}
    maps = {}
    for algorithm in algorithms(sampled):
        mine = [behaviour.heat(table, World()) for (which, _), table in sampled.items() if which == algorithm]
        maps[algorithm.upper()] = np.mean(mine, axis=0)
    if not maps:
        return []
    activations = len({activation for _, activation in flown})
    n = frames.least_to_most((table["seed"].nunique() for table in sampled.values()), "seed")
    caption = (
        f"Where the drones are on {WATCHED_LAYOUTS} test layouts: share of steps in each square, of every "
        "seed and"
        f" activation alike ({activations} activations, {n} each)."
    )
    return [Figure("heat", "behaviour", arena.heat_maps(maps, World(), width), caption)]


def _survival(
    configurations: Configurations, means: pd.DataFrame, survival: Mapping[str, pd.Series], width: float
) -> Figure:
    """How long episodes last; means: as `frames.survival` gives them."""
    counted = means.set_index("configuration")["n"]
    shown = [label for label in (name(*key) for key in configurations) if label in survival]
    episodes = {f"{label} (n = {counted[label]})": survival[label] for label in shown}
    episodes |= {style.RULE: survival[RULE]} if RULE in survival else {}
    caption = (
        "Kaplan-Meier, all seeds of a configuration pooled, n of them: a time limit censors an episode, and "
        "is no collision."
        " Sampled."
    )
    return Figure("survival", "statistics", curves.survival(episodes, frames.LIMIT, width), caption)
