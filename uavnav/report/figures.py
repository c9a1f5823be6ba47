"""Which figures a report has: at most twelve, each with its section and a caption; none repeats a table."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from uavnav import style
from uavnav.evaluation import WATCHED_LAYOUTS, WATCHED_STEPS
from uavnav.report import activations, arena, behaviour, charts, frames, horizon, learned, longer, worlds
from uavnav.report.claims import EVERY, LOG, PRIMARY, PRINTED, TRAINING
from uavnav.report.configurations import MODE, Key, algorithms
from uavnav.report.frames import REACTIVE, least_to_most, name
from uavnav.report.studies import Configurations
from uavnav.report.templating import Figure, sized
from uavnav.report.verdicts import COUNTS
from uavnav.report.worlds import Worlds
from uavnav.runs import paper
from uavnav.runs.definitions import LOG_CURVE, PER_FRAME, SAMPLED, words
from uavnav.stats import Array, Interval
from uavnav.tasks import layouts
from uavnav.tasks.protocol import MAX_STEPS
from uavnav.tasks.world import World

SHOWN_LAYOUTS = (0, 1, 2)
SHOWN_ACTIVATION = "tanh"
"""Trajectories show these; the replays show all."""

FURTHER = {
    longer: "Does longer training pay? Reward on test layouts, sampled, at most 10,000 steps: means and"
    " 95 % intervals over seeds. Dashed: the scripted policy.",
    activations: "Which activation earns most in training? Reward per 1,000 frames: means and 95 % intervals"
    " over seeds.",
    horizon: "Does a longer horizon pay? Reward on test layouts, sampled, by frames of training: means"
    " and 95 % intervals over seeds. Dashed: the scripted policy.",
    learned: "Does learning beat classical policies? Reward on test layouts: of the presets `best`, PPO's"
    " sampled and PQN's greedy, the mean and 95 % interval over seeds; of scripted policies one number, of"
    " `random` ten seeds.",
}
"""Questions and captions of further studies."""


def _asked(name: str, section: str, words: str, *args: Any) -> Figure:
    """A figure whose words begin with its question; args: as `sized` takes them."""
    question, _, caption = words.partition("? ")
    return sized(name, section, caption, *args, question=f"{question}?")


def draw(
    configurations: Configurations,
    numbers: Mapping[str, pd.DataFrame],
    episodes: Mapping[tuple[str, str, str], pd.DataFrame],
    survival: Mapping[str, pd.Series],
    of_worlds: Worlds | None,
) -> list[Figure]:
    """All figures, in the order of the page.

    configurations: of the paper's activations in the main study; numbers: the report's tables by name;
    episodes: steps by study, algorithm and activation; survival: curves by configuration.
    """
    flown = {key[1:]: table for key, table in episodes.items() if key[0] == "main"}
    found = [
        _tested(frames.rewards(configurations, SAMPLED), numbers["gaps"]),
        _forest(numbers["verdicts"]),
        *_curves(configurations),
        _training(frames.rewards(configurations, PRIMARY), numbers["gaps"]),
        *_paths(flown),
        *_places(flown),
        _survival(configurations, numbers["survival"], survival),
    ]
    if of_worlds and len(climbed := worlds.ladder(of_worlds, "density")):
        caption = (
            "Does DQN catch up among more obstacles? Policies trained in the paper's task, means over"
            " activations with Welch's 95 % intervals over seeds. Dotted and dashed: scripted policies."
        )
        found.append(_asked("worlds-density", "worlds", caption, worlds.figure, climbed, "density"))
    for one, caption in FURTHER.items():
        if one.STUDY in numbers:
            found.append(_asked(one.STUDY, one.STUDY, caption, one.figure, numbers[one.STUDY]))
    return found


def _forest(verdicts: pd.DataFrame) -> Figure:
    """The effects on reward that the paper prints, by both ways of averaging training."""
    rows = []
    known = verdicts.set_index(["claim", "column", "text"]).to_dict("index")
    for label, (number, place) in PRINTED.items():
        for column in (TRAINING, LOG):
            one = known[number, column, EVERY[number - 1].asks(column)[place].text]
            ends = (one[end] for end in ("ratio", "ratio_low", "ratio_high"))
            rows.append([label, column, *ends, one["standing"] == COUNTS])
    table = pd.DataFrame(rows, columns=["row", "column", "ratio", "low", "high", "counts"])
    caption = (
        "How much of the paper's difference of reward do our seeds find? At 1 as much as printed, at 0 none, "
        "below 0 the other way round. Bars: 95 % intervals over seeds, adjusted within a claim; arrows go on."
        " Grey: the paper's effect is too small for so many seeds."
    )
    return _asked("forest", "verdicts", caption, charts.forest, table)


def _of_reactive(gaps: pd.DataFrame, column: str) -> float:
    """What the scripted policy reaches on the test layouts; NaN without its episodes."""
    return float(next(iter(gaps.loc[gaps["who"] == REACTIVE, column]), np.nan))


def _curves(configurations: Configurations) -> list[Figure]:
    found = []
    for algorithm in dict.fromkeys([*paper.TABLE_OF, *algorithms(configurations)]):
        mine = {key[1]: one for key, one in configurations.items() if key[0] == algorithm}
        printed = {one: paper.printed(algorithm, one, "reward") for one in mine}
        number = paper.CURVES_OF.get(algorithm)
        beside = f", as the paper's Figure {number}" if number else ""
        dashed = "; dashed: the paper's mean" if number else ""
        caption = (
            f"Does {algorithm.upper()} keep what it earns? {algorithm.upper()}{beside}: reward per episode by"
            " Stable-Baselines3's log, a running mean of 100 episodes. Line: mean over seeds; band: its 95 %"
            f" interval over seeds{dashed}."
        )
        known = {name: mean for name, mean in printed.items() if np.isfinite(mean)}
        args = mine, known, f"{algorithm.upper()}: "
        draw_log = functools.partial(charts.curves, definition=LOG_CURVE)
        found.append(_asked(f"curves-{algorithm}-reward", "curves", caption, draw_log, *args))
    return found


def _training(rewards: Mapping[str, Array], gaps: pd.DataFrame) -> Figure:
    """Configurations side by side by their reward in training, a number a seed [S] each."""
    earned = _of_reactive(gaps, "per_frame")
    printed = {name(*key): paper.printed(*key, "reward", PRIMARY == PER_FRAME) for key in paper.TABLES}
    caption = "Which configuration earns most in training? "
    caption += f"{PRIMARY.capitalize()}: seeds, their mean with its 95 % interval, and the paper's run."
    if np.isfinite(earned):
        caption += f" Dashed: the scripted policy `{REACTIVE}` on the test layouts."
    args = rewards, printed, words("reward", PRIMARY), earned
    return _asked("configurations-reward", "tables", caption, charts.intervals, *args)


def _tested(rewards: Mapping[str, Array], gaps: pd.DataFrame) -> Figure:
    """Reward of test episodes, a number a seed [S] of each configuration, and the scripted policy's."""
    sampled = gaps[gaps["mode"] == MODE]
    known = sampled[sampled["who"].isin(rewards)].set_index("who")[["reward", "low", "high", "n"]]
    rows = {str(who): (rewards[str(who)], Interval(*one)) for who, *one in known.itertuples()}
    looks = {label: (style.of_pilot(label), "-") for label in rows}
    limits = sampled["limit"].dropna()
    limit = f" Episodes end at a collision, or after {limits.max():,.0f} steps." if len(limits) else ""
    caption = (
        "Does any configuration's mean reach the scripted policy? A small dot is the final policy of a"
        " training run, a large dot the mean of its row, a bar the mean's 95 % interval."
    )
    caption = f"{caption}{limit} The paper: {paper.TITLE}."
    args = rows, looks, _of_reactive(gaps, "reward"), "reward per test episode"
    return _asked("configurations-episodes", "baselines", caption, charts.episodes, *args)


def _paths(flown: Mapping[Key, pd.DataFrame]) -> list[Figure]:
    chosen = {key: table for key, table in flown.items() if key[1] == SHOWN_ACTIVATION}
    shown = {name(*key): table[table["layout"] >= 0] for key, table in chosen.items()}
    if not shown:
        return []
    caption = (
        "Does PPO fly longer than DQN?"
        f" As the paper's Figures {' and '.join(map(str, paper.PATHS))}: the first seed's episodes on"
        f" {len(SHOWN_LAYOUTS)} test layouts, at most {WATCHED_STEPS} steps, as in training (sampled), with"
        f" {SHOWN_ACTIVATION}. The replays below show the others."
    )
    args = shown, layouts.load("test").numpy(), SHOWN_LAYOUTS, World()
    return [_asked("trajectories", "episodes", caption, arena.trajectories, *args)]


def _places(flown: Mapping[Key, pd.DataFrame]) -> list[Figure]:
    """Heat maps, a panel an algorithm."""
    chosen = {key: table[(table["mode"] == MODE) & (table["layout"] >= 0)] for key, table in flown.items()}
    sampled = {key: table for key, table in chosen.items() if len(table)}
    if not sampled:
        return []
    heat = {key: behaviour.heat(table, World()) for key, table in sampled.items()}
    maps = {
        one.upper(): np.mean([own for key, own in heat.items() if key[0] == one], axis=0)
        for one in algorithms(sampled)
    }
    activations = len({activation for _, activation in flown})
    n = least_to_most((table["seed"].nunique() for table in sampled.values()), "seed")
    caption = (
        "Does PPO keep farther from obstacles and walls than DQN?"
        f" Where the drones are on {WATCHED_LAYOUTS} test layouts: share of steps in each square, of every"
        f" seed and activation alike ({activations} activations, {n} each)."
    )
    return [_asked("heat", "behaviour", caption, arena.heat_maps, maps, World())]


def _survival(
    configurations: Configurations, means: pd.DataFrame, survival: Mapping[str, pd.Series]
) -> Figure:
    """How long episodes last; means: as `frames.survival` gives them."""
    counted = means.set_index("configuration")["n"]
    shown = [label for label in (name(*key) for key in configurations) if label in survival]
    episodes = {f"{label} (n = {counted[label]})": survival[label] for label in shown}
    episodes |= {style.SCRIPTED_NAME: survival[REACTIVE]} if REACTIVE in survival else {}
    caption = (
        "How many test episodes last until the time limit? Kaplan-Meier, all seeds of a configuration pooled,"
        " n of them: a time limit censors an episode, and is no collision. Sampled."
    )
    return _asked("survival", "statistics", caption, charts.survival, episodes, MAX_STEPS)
