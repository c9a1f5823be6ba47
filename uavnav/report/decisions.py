"""What the paper leaves open, and what was decided: the rows of the table in docs/decisions.md and of the report."""

from __future__ import annotations

from typing import NamedTuple


class Decision(NamedTuple):
    """One row; `switch` names the settings that choose otherwise, the first of them the default."""

    number: str
    question: str
    decision: str
    why: str
    switch: str


HEADER = Decision("#", "the paper leaves open", "decision (default)", "why", "switch")

DECISIONS = (
    Decision(
        "1",
        "obstacles per set",
        "8",
        "in a prototype with 8, DQN's means over all training episodes fell on the paper's Table 1",
        "a bank of `python -m uavnav.layouts --k K`, and `layouts=PATH`",
    ),
    Decision(
        "2",
        "may obstacles overlap",
        "yes, each other and the border",
        "the paper draws them freely",
        "-",
    ),
    Decision(
        "3",
        "which ten obstacles are sensed",
        "the nearest, ties by index",
        '"the most immediate obstacles" (3.6); in file order the nearest could be dropped',
        "`slots=nearest`, `listed`",
    ),
    Decision(
        "4",
        "how a border square is sensed",
        "as its nearest point",
        "exact for a square",
        "-",
    ),
    Decision(
        "5",
        "in view by",
        "the nearest point",
        "a circle of radius 100 would be hit before its centre is 120 px away",
        "-",
    ),
    Decision(
        "6",
        "empty slot",
        "(0, 0, 1)",
        "zeros would read as contact",
        "`padding=far`, `zeros`",
    ),
    Decision(
        "7",
        "safe zone to",
        "the obstacle's edge",
        "to the centre would start some episodes inside an obstacle",
        "-",
    ),
    Decision(
        "8",
        "start heading",
        "up (90°)",
        "the natural reading of a fixed reset",
        "`start_heading=up`, `random`",
    ),
    Decision(
        "9",
        "collision with something out of view",
        "counts",
        "physics does not depend on the sensor",
        "-",
    ),
    Decision(
        "10",
        "text and eq. (14) disagree: additive or exclusive penalties",
        "eq. (14), exclusive",
        "under the additive reading all 8 rows of the paper would have to be higher than reported",
        "`reward=eq14`, `additive`, `initial`",
    ),
    Decision(
        "11",
        '"full stops"',
        "two metrics: `stops` (distance = 0) and `full_stops` (distance = 0 and angle = 0)",
        "a uniform policy stops in 10 % of its steps and fully stops in 1 %; the paper reports 0.07-3.9 %",
        "both reported",
    ),
    Decision(
        "12",
        "what the tables average",
        "all training episodes; the last 100; evaluation on the test split",
        'the paper says "throughout the simulations"',
        "all reported",
    ),
    Decision(
        "13",
        "mean of ratios or ratio of means",
        "both, for speed, turns and stops",
        "the paper's speed is not distance / steps",
        "both reported",
    ),
    Decision(
        "14",
        "hyper-parameters",
        "Stable-Baselines3's defaults of the paper's time",
        "the paper names the library and no values",
        "`preset=paper`; also `paper-2.3` for DQN, and our own `fast`",
    ),
    Decision(
        "15",
        "initialisation",
        "SB3's: PPO orthogonal (gain √2 hidden, 0.01 policy, 1 value), DQN PyTorch's default",
        "the gain is part of the treatment",
        "`init=orthogonal`, `default`",
    ),
    Decision(
        "16",
        "parallel worlds per seed",
        "PPO 16 (128 steps each), DQN 64 (16 updates after each step)",
        "SB3's default is one; printed in every table; [measured](benchmarks.md)",
        "`n_worlds=`",
    ),
)
