"""The paper's claims as data: each is a list of parts, which `verdicts` judges by one rule.

A part asks whether linear contrasts of configurations' means over training seeds are above zero. To add a
claim, see CONTRIBUTING.md. The paper's own effect is the same function of its printed tables. Claims 12 to
16, of the paper's discussion, are asked of the study `worlds`; the paper prints no number for them. They were
fixed before that study was run. What other settings are asked (`Claim.elsewhere`), which of the parts of
claims 9, 10 and 13 count, and claim 4 by SB3's log came later, when the runs had been read.
Letters: S seeds of a configuration, C terms of a part, J its contrasts.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from uavnav.colours import NAMES
from uavnav.runs import paper
from uavnav.runs.definitions import LOG_CURVE, PER_FRAME, SAMPLED
from uavnav.runs.metrics import METRICS
from uavnav.stats import Array

PRIMARY = PER_FRAME
"""The metric definition wherever none is named."""
TRAINING, LOG = "training, per frame", "training, SB3's log"
FINAL, OTHER = "final policies", "other settings"
COLUMNS = {TRAINING: PER_FRAME, LOG: LOG_CURVE, FINAL: SAMPLED, OTHER: SAMPLED}
"""What a claim is graded on, none of which is the whole answer, and the metric definition of each."""
COMPARED = ("ppo", "dqn")
"""Those that the claims compare: the first is said to be better."""
BOUNDED, UNBOUNDED = ("tanh", "sigmoid"), ("relu", "leaky_relu")
ACTIVATIONS = (*BOUNDED, *UNBOUNDED)
CONFIGURATIONS = tuple(itertools.product(COMPARED, ACTIVATIONS))
SIX = {name: METRICS[name] for name in paper.COLUMNS}
"""The metrics of the paper's tables."""
SURGE = (300_000, 600_000)
"""Frames between which the paper sees DQN with sigmoid surge."""
AFTER = 100_000
"""Frames at the end of training, which tell what is left of a surge."""
WHEN = ("before", "surge", "after")
"""The windows of `around_surge`."""
TIMES = 1.5
"""What counts as "about twice" and "nearly double": at least so many times each other configuration."""

PAIR = ("tanh", "relu")
"""Activations of most side studies, the bounded one first."""
ALL_TASKS = "all tasks"
"""The mean over tasks."""
RUNGS = {0: "density-0", 4: "density-4", 8: "drone", 16: "density-16", 20: "density-20"}
"""Tasks by their number of obstacles."""
PASSAGES = {
    "passages_per_1000_steps": "passages per 1,000 steps",
    "passages_per_episode": "passages per episode",
}
CRASHED = "crashed"
"""The share of episodes that end in a collision."""
SLOPE = "reward_by_density"
"""The slope of a policy's reward over the density ladder, a number a seed [reward an obstacle]."""
VARIATION, SCATTER = "gradient_variation", "scatter"
"""Over training, a seed's standard deviation of the gradient's norm to its mean; how far a seed's reward is
from its configuration's median, to the mean of that in its task.
"""
EXPLAINS = {VARIATION: "gradient_variation_explains", SCATTER: "scatter_explains"}
"""A rank correlation with the reward across the configurations of a task, a number a seed."""
NO_SAC = "all tasks, without SAC"
"""The mean over tasks of such correlations among the configurations of other algorithms."""
FAST, TUNED = "fast", "tuned"
"""Studies of other settings: the preset, and what 40 trials found."""
RANKED, NONE = "ranked", "none"
"""Stand for algorithms in claim 16: the correlation itself, and zero, which it is compared with."""

OF_FINAL = ("corridor", "clearance", "empty_", "reversals")
"""How the names of metrics begin that are known only of final policies."""


class Evidence(Protocol):
    """A metric of a configuration: one number a seed [S]; none where it is not known.

    Besides the six metrics there are

    - `stops`, and `hours` (one number a run);
    - `reward_before`, `reward_surge`, `reward_after`: reward in 0-300,000, 300,000-600,000 and the last
      100,000 frames, in the same order of seeds;
    - what `behaviour.measures` gives; the same in the empty arena as `empty_clearance` and so on;
    - `corridor_early` and `clearance_early`: the same without the last 40 steps before a crash, and
      `corridor_first`: the same in the first 50 steps (`behaviour.early`);
    - `corridor_by_layout` and `clearance_by_layout`: one number a layout, the mean over seeds, in the same
      order of layouts in every configuration (`behaviour.by_layout`).

    study: `main`, `initial` (the first reward), `baseline` (the same frames without it), `FAST` or `TUNED`;
    of claims 12 to 16 a task by its name, with the preset where it is not the default (`drone, fast`), or
    `ALL_TASKS`.
    """

    def __call__(self, algorithm: str, activation: str, metric: str, study: str = "main") -> Array: ...


class Term(NamedTuple):
    """The arguments of an `Evidence`."""

    algorithm: str
    activation: str
    metric: str
    study: str = "main"

    def __str__(self) -> str:
        return f"{self.algorithm.upper()} {NAMES[self.activation]}"


@dataclass(frozen=True)
class Part:
    """One question: are these contrasts of the terms' means above zero, every one or at least one?

    weights: [J][C]. A metric of which less is better enters with a minus, so that the claimed direction is
        up.
    """

    text: str
    terms: tuple[Term, ...]
    weights: tuple[tuple[float, ...], ...]
    every: bool = True
    paired: bool = False  # the terms are the same seeds (or layouts), in the same order
    beside: bool = False  # it is shown with the claim and is no part of its grade

    def sides(self, contrast: int) -> str:
        """Which configurations a contrast compares, in words."""
        weighed = list(zip(self.weights[contrast], self.terms, strict=True))
        return " against ".join(
            ", ".join(dict.fromkeys(str(term) for weight, term in weighed if sign * weight > 0)) or "0"
            for sign in (1, -1)
        )


class Claim(NamedTuple):
    """A sentence of the paper and what it comes to."""

    number: int
    sentence: str
    parts: Sequence[Part]
    shown: int | None = 0  # the part that its sentence (templates/study.md) is about, where one counts
    equal: tuple[str, ...] = ("algorithm", "metric")
    """If nothing differed, terms that agree in these fields would have the same mean."""
    note: str = ""  # what else its own tables say
    column: str = TRAINING  # of `COLUMNS`: the one that its sentence is about
    elsewhere: Sequence[Part] = ()  # what it asks of other settings

    def asks(self, column: str) -> Sequence[Part]:
        """Its parts in a column: training does not say how final policies fly."""
        if column == OTHER:
            return self.elsewhere
        trains = column in (TRAINING, LOG)
        return [one for one in self.parts if not (trains and one.terms[0].metric.startswith(OF_FINAL))]


def asked(claims: Sequence[Claim], column: str) -> list[Claim]:
    """The claims that a column is asked, with their parts there."""
    return [claim._replace(parts=parts) for claim in claims if (parts := claim.asks(column))]


Keys = Sequence[tuple[str, ...]]
"""Algorithm, activation and, if it is not the main one, study."""


def _of(algorithm: str, *activations: str) -> list[tuple[str, str]]:
    """The configurations of an algorithm, all four or with some activations."""
    return [(algorithm, one) for one in activations or ACTIVATIONS]


PPO, DQN = map(_of, COMPARED)


def _terms(configurations: Keys, metric: str) -> tuple[Term, ...]:
    return tuple(Term(which, activation, metric, *study) for which, activation, *study in configurations)


def _means(text: str, metric: str, up: Keys, down: Keys, sign: int = 1, **more: bool) -> Part:
    """The mean of some configurations is above that of others (sign -1: below)."""
    weights = (*[sign / len(up)] * len(up), *[-sign / len(down)] * len(down))
    return Part(text, _terms([*up, *down], metric), (weights,), **more)


def _pairs(text: str, metric: str, up: Keys, down: Keys, sign: int = 1, every: bool = True) -> Part:
    """Each configuration is above each of the others (sign -1: below), or at least one such pair is."""
    every_one = range(len(up) + len(down))
    pairs = itertools.product(every_one[: len(up)], every_one[len(up) :])
    rows = (tuple(float(sign * ((one == a) - (one == b))) for one in every_one) for a, b in pairs)
    return Part(text, _terms([*up, *down], metric), tuple(rows), every)


def _times(metric: str, algorithm: str, activation: str) -> Part:
    """A configuration is above zero and above `TIMES` each of the others: nothing is twice a loss."""
    up, down = _one(algorithm, activation)
    rows = [(1.0, *(-TIMES * (other == one) for one in down)) for other in (None, *down)]
    text = f"{algorithm.upper()} with {NAMES[activation]} at least {TIMES} times each other activation"
    return Part(f"{METRICS[metric].label}: {text}", _terms([*up, *down], metric), tuple(rows))


def _one(algorithm: str, activation: str) -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    """A configuration, and those of its algorithm with another activation."""
    return _of(algorithm, activation), _of(algorithm, *(one for one in ACTIVATIONS if one != activation))


def _six(text: str, up: Keys, down: Keys, sign: int = 1, make: Any = _pairs) -> list[Part]:
    """A question to each of the six metrics: some configurations are better than others (sign -1: worse)."""
    return [make(f"{one.label}: {text}", name, up, down, sign * one.better) for name, one in SIX.items()]


def _bounded(algorithm: str, metric: str, beside: bool = False) -> Part:
    text = f"{METRICS[metric].label}: {algorithm.upper()}'s tanh and sigmoid above its ReLU and leaky ReLU"
    return _means(text, metric, _of(algorithm, *BOUNDED), _of(algorithm, *UNBOUNDED), beside=beside)


def around_surge(frames: int) -> list[tuple[int, int]]:
    """The windows of frames before, in and after the surge, of a training of so many frames."""
    return [(0, SURGE[0]), SURGE, (frames - AFTER, frames)]


def _dqn_sigmoid_surges() -> list[Part]:
    terms = tuple(Term("dqn", "sigmoid", f"reward_{when}") for when in WHEN)
    above = "reward of DQN with sigmoid: 300,000 to 600,000 frames above"
    half = "more than half of the rise by 600,000 frames is lost in the last 100,000"
    return [
        Part(f"{above} those before", terms[:2], ((-1.0, 1.0),), paired=True),
        Part(f"{above} the last 100,000", terms[1:], ((1.0, -1.0),), paired=True),
        Part(f"reward of DQN with sigmoid: {half}", terms, ((0.5, 0.5, -1.0),), paired=True),
    ]


def _dqn_takes_corridors() -> list[Part]:
    steps, space = "share of steps between two close obstacles", "distance to the nearest obstacle or wall"
    more, wider = "DQN above PPO", "PPO above DQN"
    early, layouts = ", without the last 40 steps before a crash", ", layouts resampled"
    asked = ("corridor", "clearance", "empty_clearance")
    questions = {
        "corridor": (f"{steps}: {more}", -1),
        "clearance": (f"{space}: {wider}", 1),
        "empty_clearance": (f"distance to the nearest wall in the empty arena: {wider}", 1),
        "corridor_path": (f"share of the path between two close obstacles: {more}", -1),
        "corridor_first": (f"{steps}, the first 50 of an episode: {more}", -1),
        "corridor_early": (f"{steps}{early}: {more}", -1),
        "clearance_early": (f"{space}{early}: {wider}", 1),
        "corridor_by_layout": (f"{steps}{layouts}: {more}", -1),
        "clearance_by_layout": (f"{space}{layouts}: {wider}", 1),
    }
    return [
        _means(text, metric, PPO, DQN, sign, paired="_by_layout" in metric, beside=metric not in asked)
        for metric, (text, sign) in questions.items()
    ]


def _penalties_cure() -> list[Part]:
    questions = {
        "stops": "stops",
        "full_stops": "full stops",
        "turns": "turning",
        "reversals": "reversals of turning per step",
    }
    return [
        _means(
            f"{words}: {algorithm.upper()} more under the first reward",
            metric,
            [(algorithm, one, "initial") for one in PAIR],
            [(algorithm, one, "baseline") for one in PAIR],
        )
        for algorithm, (metric, words) in itertools.product(COMPARED, questions.items())
    ]


def at(metric: str, ladder: str, rung: float) -> str:
    """A metric on a rung of a ladder, of a policy trained in another task."""
    return f"{metric} at {ladder} {rung:g}"


def _above(text: str, metric: str, first: str, second: str, task: str, beside: bool = False) -> Part:
    """The first algorithm is above the second in a task, means of the activations."""
    up, down = ([(one, activation, task) for activation in PAIR] for one in (first, second))
    return _means(text, metric, up, down, beside=beside)


def _fast(parts: Sequence[Part]) -> list[Part]:
    """The same questions to policies of the preset `fast`."""
    return [
        replace(one, terms=tuple(term._replace(study=f"{term.study}, {FAST}") for term in one.terms))
        for one in parts
    ]


def _other_settings() -> list[Part]:
    """PPO against DQN with the preset `fast` and after tuning, of the activations that have runs."""
    parts = []
    for study, activations in {FAST: BOUNDED, TUNED: ("tanh",)}.items():
        up, down = ([(algorithm, one, study) for one in activations] for algorithm in COMPARED)
        parts += _six(f"PPO better than DQN, {study}", up, down, make=_means)
    return parts


def _density() -> list[Part]:
    falls = "reward: PPO minus DQN falls along the density ladder, policies trained at eight obstacles"
    eight = {
        at("reward", "density", rung): f"reward: DQN above PPO at {rung} obstacles, policies trained at eight"
        for rung in (16, 18, 20)
    }
    own = {
        RUNGS[rung]: f"reward: DQN above PPO where both were trained at {rung} obstacles" for rung in (16, 20)
    }
    return [
        _above(falls, SLOPE, "dqn", "ppo", "drone"),
        *(_above(text, metric, "dqn", "ppo", "drone") for metric, text in eight.items()),
        _own_rungs(),
        *(_above(text, "reward", "dqn", "ppo", task, beside=True) for task, text in own.items()),
    ]


def _own_rungs() -> Part:
    """PPO minus DQN falls from rung to rung, each trained there: the least-squares slope is below 0."""
    tasks = itertools.product(RUNGS.values(), ("dqn", "ppo"), PAIR)
    terms = tuple(Term(which, activation, "reward", task) for task, which, activation in tasks)
    signs = (1, 1, -1, -1)
    weights = tuple(float(one) * sign / len(PAIR) for one in slopes(tuple(RUNGS)) for sign in signs)
    text = "reward: PPO minus DQN falls with the obstacles that both were trained among"
    return Part(text, terms, (weights,), beside=True)


def slopes(rungs: Sequence[float]) -> Array:
    """Weights [R] whose sum over values at some rungs is their least-squares slope."""
    apart = np.asarray(rungs, dtype=np.float64) - np.mean(rungs)
    return np.asarray(apart / (apart**2).sum())


def _slalom() -> list[Part]:
    """Two independent tests, at the widest narrow gap; what else the same policies do is only shown."""
    tasks = {"drone": "the paper's layouts", "slalom-100": "the slalom"}
    asked = itertools.product(PASSAGES.items(), (100, 90, 80, 70), tasks.items())
    parts = [
        _above(
            f"{label}: DQN above PPO at gaps of {gap} px, trained on {words}",
            at(metric, "slalom", gap),
            "dqn",
            "ppo",
            task,
            beside=place > 1,
        )
        for place, ((metric, label), gap, (task, words)) in enumerate(asked)
    ]
    crashes = "share of episodes that end in a crash: DQN below PPO at gaps of 100 px, trained on"
    crashed = at(CRASHED, "slalom", 100)
    return parts + [
        _above(f"{crashes} {words}", crashed, "ppo", "dqn", task, beside=True)
        for task, words in tasks.items()
    ]


def _order(task: str, *names: str) -> tuple[Part, ...]:
    """Each algorithm's reward is above the next one's in a task."""
    return tuple(
        _above(f"reward: {one.upper()} above {two.upper()} in {task}", "reward", one, two, task)
        for one, two in itertools.pairwise(names)
    )


def _gradients() -> list[Part]:
    questions = {
        VARIATION: "gradient norms of tanh vary less over training than those of ReLU",
        SCATTER: "seeds of tanh scatter less in reward than those of ReLU",
    }
    words = {VARIATION: "the less gradient norms vary", SCATTER: "the less seeds scatter"}
    bounded, unbounded = PAIR
    rank = "the more reward: rank correlation across the configurations of a task, mean over tasks"
    less = [
        _means(
            f"{one.upper()}: {text}, mean over tasks",
            metric,
            [(one, unbounded, ALL_TASKS)],
            [(one, bounded, ALL_TASKS)],
        )
        for (metric, text), one in itertools.product(questions.items(), ("ppo", "dqn", "sac", "a2c", "c51"))
    ]
    explains = [
        _means(
            f"{words[metric]}, {rank}" + ", without SAC" * (tasks == NO_SAC),
            name,
            [(RANKED, NONE, tasks)],
            [(RANKED, RANKED, tasks)],
            paired=True,
            beside=tasks == NO_SAC,
        )
        for (metric, name), tasks in itertools.product(EXPLAINS.items(), (ALL_TASKS, NO_SAC))
    ]
    return less + explains


CLAIMS = (
    Claim(
        1,
        "PPO outperforms DQN in all six metrics, and PPO's weakest result surpasses DQN's best.",
        [
            *_six("PPO better than DQN, means of four activations", PPO, DQN, make=_means),
            *_six("each PPO configuration better than each DQN configuration", PPO, DQN),
        ],
        shown=5,
        equal=("metric",),
        elsewhere=_other_settings(),
    ),
    Claim(
        2,
        "PPO with tanh is best: its reward is nearly double the next, its steps and distance about twice "
        "the others'.",
        [
            *_six("PPO with tanh better than each other activation", *_one("ppo", "tanh")),
            *(_times(metric, "ppo", "tanh") for metric in ("reward", "steps", "distance")),
        ],
        shown=5,
        note="In its own table the steps are 1.58 and the distance 1.59 times the runner-up's.",
    ),
    Claim(
        3,
        "DQN with sigmoid is best in all six columns of its table.",
        _six("DQN with sigmoid better than each other activation", *_one("dqn", "sigmoid")),
        shown=5,
        note="The six columns are the bold type of the table; the text says best overall.",
    ),
    Claim(
        4,
        "DQN with sigmoid surges between 300,000 and 600,000 steps and then falls steeply.",
        _dqn_sigmoid_surges(),
        shown=2,
        equal=("algorithm", "activation"),
        column=LOG,
        note="The surge is one of reward per episode (the paper's Figure 4), which SB3's log has.",
    ),
    Claim(
        5,
        "With PPO, ReLU and leaky ReLU stop least.",
        [
            _pairs(
                "full stops: PPO's ReLU and leaky ReLU each below its tanh and its sigmoid",
                "full_stops",
                _of("ppo", *UNBOUNDED),
                _of("ppo", *BOUNDED),
                -1,
            )
        ],
        shown=None,
    ),
    Claim(
        6,
        "With PPO, sigmoid is weakest except in steps.",
        [
            *_six("PPO with sigmoid worse than each other activation", *_one("ppo", "sigmoid"), -1)[1:],
            _pairs(
                "steps: PPO with sigmoid above at least one other activation",
                "steps",
                *_one("ppo", "sigmoid"),
                every=False,
            ),
        ],
        shown=1,
    ),
    Claim(
        7,
        "Bounded activations (sigmoid, tanh) generally beat unbounded ones (ReLU, leaky ReLU), though "
        "sigmoid is behind in PPO.",
        [
            *(
                _bounded(algorithm, metric)
                for algorithm in COMPARED
                for metric in ("reward", "steps", "distance")
            ),
            _means(
                "reward: PPO's sigmoid below its ReLU and leaky ReLU",
                "reward",
                _of("ppo", "sigmoid"),
                _of("ppo", *UNBOUNDED),
                -1,
            ),
        ],
        shown=1,
    ),
    Claim(
        8,
        "No single family of activations is universally superior: algorithm and activation interact.",
        [
            _means(
                "reward: DQN's sigmoid above the mean of its three others", "reward", *_one("dqn", "sigmoid")
            ),
            _means(
                "reward: PPO's sigmoid below the mean of its three others",
                "reward",
                *_one("ppo", "sigmoid"),
                -1,
            ),
            *(_bounded(algorithm, "reward", beside=True) for algorithm in ("dqn", "ppo")),
        ],
        shown=1,
        note="In its own tables bounded activations are ahead in both algorithms; what changes sides is "
        "sigmoid.",
    ),
    Claim(
        9,
        "DQN steers through corridors between obstacles; PPO keeps to open space.",
        _dqn_takes_corridors(),
        equal=("metric",),
        column=FINAL,
        note="It is three questions: corridors, clearance and the empty arena. Besides them, two parts leave"
        " out the last 40 steps before a crash, and one takes only the first 50. In two, the unit is the"
        " layout and not the seed, so that the answer is for other layouts too; their n counts layouts.",
    ),
    Claim(
        10,
        "The first reward led to standing still and to trembling; the penalties of eq. (14) cure both.",
        _penalties_cure(),
        shown=2,
        equal=("algorithm", "activation", "metric"),
        note="Its design is its own: 10 seeds of 300,000 frames in parallel environments, tanh and ReLU. A"
        " full stop has no turn either.",
    ),
    Claim(
        11,
        "A million steps take about ten hours.",
        [
            Part(
                "hours for 1,000,000 steps: a seed's share of a run of several side by side, mean of the "
                "eight configurations",
                _terms(CONFIGURATIONS, "hours"),
                ((1 / len(CONFIGURATIONS),) * len(CONFIGURATIONS),),
                beside=True,
            )
        ],
        note="It is another machine, and no claim about learning.",
    ),
)

DISCUSSION = (
    Claim(
        12,
        "DQN suits dense places and PPO open ones.",
        _density(),
        3,
        ("metric", "study"),
        column=FINAL,
        elsewhere=_fast(_density()[:4]),
    ),
    Claim(
        13,
        "DQN is the more agile in narrow places.",
        _slalom(),
        0,
        ("metric", "study"),
        "Its tests are two, one for each set of policies. The other gaps are of the same policies.",
        FINAL,
        _fast(_slalom()),
    ),
    Claim(
        14,
        "The order of algorithms depends on dimensionality: in 3D DQN is above PPO.",
        _order("space", "dqn", "ppo"),
        0,
        ("metric", "study"),
        "",
        OTHER,
        _fast(_order("space", "dqn", "ppo")),
    ),
    Claim(
        15,
        "With moving obstacles in 3D SAC is above DQN, and DQN above PPO.",
        _order("space-moving", "sac", "dqn", "ppo"),
        1,
        ("metric", "study"),
        "",
        OTHER,
        _fast(_order("space-moving", "sac", "dqn", "ppo")),
    ),
    Claim(
        16,
        "Bounded activations win because of their gradient flow: they learn more stably, and that explains "
        "the reward.",
        _gradients(),
        10,
        ("algorithm", "metric"),
        column=FINAL,
    ),
)
EVERY = (*CLAIMS, *DISCUSSION)
"""All claims of the paper, 1 to 16."""
PRINTED = {
    "PPO − DQN": (1, 5),
    "worst PPO − best DQN": (1, 11),
    "DQN: sigmoid − best other": (3, 5),
    "DQN: sigmoid − mean of others": (8, 0),
    "PPO: tanh − best other": (2, 5),
    "PPO: sigmoid − mean of others": (8, 1),
    "PPO: bounded − unbounded": (7, 0),
    "DQN: bounded − unbounded": (7, 3),
}
"""The differences of reward that the paper prints: the number of a claim and the place of its part."""
