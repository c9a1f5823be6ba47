"""The claims of the paper's discussion, 12 to 16, as data: what the study `worlds` is asked, by the rule of `verdicts`.

A term's study is a world by its name, with the preset where it is not the default (`drone, fast`); `ALL` is the mean
over worlds. The paper prints no number for any of them. They were fixed before the study was run; the parts
of `fast` of claims 13 and 15 came later, when its runs had been read.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from uavnav.report.claims import CLAIMS, Claim, Part, Term
from uavnav.stats import Array

ACTIVATIONS = ("tanh", "relu")
"""Those of the study, the bounded one first."""
ALGORITHMS = ("ppo", "dqn", "sac", "a2c", "c51")
ALL = "all worlds"
RUNGS = {0: "density-0", 4: "density-4", 8: "drone", 16: "density-16", 20: "density-20"}
"""Worlds by their number of obstacles."""
DENSE = (16, 18, 20)
NARROW = (100, 90, 80, 70)  # [px]
PASSAGES = {"passages_per_1000_steps": "passages per 1,000 steps", "passages_per_flight": "passages per flight"}
SLOPE = "reward_by_density"
"""The slope of a policy's reward over the rungs of the density ladder, a number a seed [reward an obstacle]."""
VARIATION, SCATTER = "gradient_variation", "scatter"
"""Over training, a seed's standard deviation of the gradient's norm to its mean; how far a seed's reward is from its
cell's median, to the mean of that in its world."""
EXPLAINS = {VARIATION: "gradient_variation_explains", SCATTER: "scatter_explains"}
"""A rank correlation with the reward across the cells of a world, a number a seed."""
CELLS, NONE = "cells", "none"
"""The term of a correlation across cells, and that of no correlation."""


def at(metric: str, ladder: str, rung: float) -> str:
    """A metric on a rung of a ladder, as a policy of another world flies it."""
    return f"{metric} at {ladder} {rung:g}"


def _above(text: str, metric: str, first: str, second: str, world: str, beside: bool = False) -> Part:
    """The first algorithm is above the second, means of the activations."""
    terms = [Term(one, activation, metric, world) for one in (first, second) for activation in ACTIVATIONS]
    half = 1 / len(ACTIVATIONS)
    return Part(text, tuple(terms), ((half, half, -half, -half),), beside=beside)


def _tuned(part: Part) -> Part:
    """The same question to the tuned presets, beside the claim."""
    terms = tuple(term._replace(study=f"{term.study}, fast") for term in part.terms)
    return replace(part, text=f"{part.text}, preset fast", terms=terms, beside=True)


def _density() -> tuple[Part, ...]:
    falls = "reward: PPO minus DQN falls along the density ladder, policies trained at eight obstacles"
    parts = [_above(falls, SLOPE, "dqn", "ppo", "drone")]
    parts += [
        _above(
            f"reward: DQN above PPO at {rung} obstacles, policies trained at eight",
            at("reward", "density", rung),
            "dqn",
            "ppo",
            "drone",
        )
        for rung in DENSE
    ]
    own = [
        _above(
            f"reward: DQN above PPO where both were trained at {rung} obstacles", "reward", "dqn", "ppo", world, True
        )
        for rung, world in RUNGS.items()
        if rung >= DENSE[0]
    ]
    return (*parts, _own_rungs(), *own, *map(_tuned, parts))


def _own_rungs() -> Part:
    """PPO minus DQN falls from rung to rung, each trained there: the least-squares slope over rungs is below 0."""
    terms = [
        Term(algorithm, activation, "reward", world)
        for world in RUNGS.values()
        for algorithm in ("dqn", "ppo")
        for activation in ACTIVATIONS
    ]
    slope = slopes(tuple(RUNGS))
    weights = tuple(float(one) * sign / len(ACTIVATIONS) for one in slope for sign in (1, -1) for _ in ACTIVATIONS)
    text = "reward: PPO minus DQN falls with the obstacles that both were trained among"
    return Part(text, tuple(terms), (weights,), beside=True)


def slopes(rungs: Sequence[float]) -> Array:
    """Weights [R] whose sum over values at some rungs is their least-squares slope."""
    apart = np.asarray(rungs, dtype=np.float64) - np.mean(rungs)
    return np.asarray(apart / (apart**2).sum())


def _slalom() -> tuple[Part, ...]:
    worlds = {"drone": "the paper's banks", "slalom-100": "the slalom"}
    parts = tuple(
        _above(
            f"{label}: DQN above PPO at gaps of {gap} px, trained on {words}",
            at(metric, "slalom", gap),
            "dqn",
            "ppo",
            world,
        )
        for world, words in worlds.items()
        for metric, label in PASSAGES.items()
        for gap in NARROW
    )
    return (*parts, *map(_tuned, parts))


def _order(world: str, *names: str) -> tuple[Part, ...]:
    """Each algorithm's reward is above the next one's in a world."""
    return tuple(
        _above(f"reward: {one.upper()} above {two.upper()} in {world}", "reward", one, two, world)
        for one, two in itertools.pairwise(names)
    )


def _gradients() -> tuple[Part, ...]:
    questions = {
        VARIATION: "gradient norms of tanh vary less over training than those of ReLU",
        SCATTER: "seeds of tanh scatter less in reward than those of ReLU",
    }
    bounded, unbounded = ACTIVATIONS
    parts = [
        Part(
            f"{one.upper()}: {text}, mean over worlds",
            (Term(one, unbounded, metric, ALL), Term(one, bounded, metric, ALL)),
            ((1.0, -1.0),),
        )
        for metric, text in questions.items()
        for one in ALGORITHMS
    ]
    words = {VARIATION: "the less gradient norms vary", SCATTER: "the less seeds scatter"}
    across = [
        Part(
            f"{words[metric]}, the more reward: rank correlation across the cells of a world, mean over worlds",
            (Term(CELLS, NONE, name, ALL), Term(CELLS, CELLS, name, ALL)),
            ((1.0, -1.0),),
            paired=True,
        )
        for metric, name in EXPLAINS.items()
    ]
    return (*parts, *across)


DISCUSSION = (
    Claim(12, "DQN suits dense places and PPO open ones.", _density(), 3, ("metric", "study")),
    Claim(13, "DQN is the more agile in narrow places.", _slalom(), 0, ("metric", "study")),
    Claim(
        14,
        "The order of algorithms depends on dimensionality: in 3D DQN is above PPO.",
        (*_order("space", "dqn", "ppo"), *map(_tuned, _order("space", "dqn", "ppo"))),
        equal=("metric", "study"),
    ),
    Claim(
        15,
        "With moving obstacles in 3D SAC is above DQN, and DQN above PPO.",
        (*_order("space-moving", "sac", "dqn", "ppo"), *map(_tuned, _order("space-moving", "dqn", "ppo"))),
        1,
        ("metric", "study"),
    ),
    Claim(
        16,
        "Bounded activations win because of their gradient flow: they learn more stably, and that explains the reward.",
        _gradients(),
        10,
        ("algorithm", "metric"),
    ),
)

EVERY = (*CLAIMS, *DISCUSSION)
"""All claims of the paper, 1 to 16."""


def nothing_printed(algorithm: str, activation: str, metric: str, study: str = "main") -> Array:
    """The paper's numbers: there are none (an `Evidence`)."""
    return np.empty(0)
