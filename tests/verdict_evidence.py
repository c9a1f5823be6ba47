"""Evidence made up for the audit: means of configurations whose verdicts are known."""

import functools

import numpy as np

from uavnav.report.claims import ACTIVATIONS
from uavnav.report.studies import of_paper
from uavnav.runs.definitions import PER_FRAME

of_paper_per_frame = functools.partial(of_paper, definition=PER_FRAME)

EIGHT = np.array([-1.5, -1.0, -0.5, -0.25, 0.25, 0.5, 1.0, 1.5])  # mean 0


def nothing(algorithm, activation, metric, study="main"):
    return np.empty(0)


def evidence(means, seeds=EIGHT, spread=0.1):
    """From (algorithm, activation, metric[, study]) to a mean; what is not named has no seeds."""

    def found(algorithm, activation, metric, study="main"):
        key = (algorithm, activation, metric, study)
        mean = means.get(key, means.get(key[:3]) if study == "main" else None)
        if mean is None:
            return np.empty(0)
        place = sum(map(ord, "".join(key)))  # another order in every configuration
        return mean + spread * np.roll(seeds, place)

    return found


def of_metric(metric, ppo, dqn=(), **more):
    """Means of a metric by algorithm, in the order tanh, sigmoid, relu, leaky_relu."""
    rows = {"ppo": ppo, "dqn": dqn}
    return {
        (algorithm, activation, metric): mean
        for algorithm, means in rows.items()
        for activation, mean in zip(ACTIVATIONS, means, strict=bool(means))
    } | more


def verdicts_of(findings):
    return [finding.verdict for finding in findings]
