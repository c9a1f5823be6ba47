"""The paper's tables 1 and 2, as printed: one run per configuration, of 1,000,000 steps."""

from __future__ import annotations

import math

TITLE = "Comparative Analysis of DQN and PPO Algorithms in UAV Obstacle Avoidance 2D Simulation"
COLUMNS = ("steps", "full_stops", "turns", "distance", "speed", "reward")
"""The six metrics in the tables' order; their units: episode, %, %, px an episode, px a step, episode."""

TABLES: dict[tuple[str, str], dict[str, float]] = {
    configuration: dict(zip(COLUMNS, row, strict=True))
    for configuration, row in {
        ("dqn", "tanh"): (159.434, 1.497, 62.558, 649.456, 4.318, -6.982),
        ("dqn", "sigmoid"): (211.367, 0.626, 59.983, 797.7136, 4.984, -5.666),
        ("dqn", "relu"): (205.576, 3.881, 67.722, 761.555, 3.993, -7.616),
        ("dqn", "leaky_relu"): (209.794, 2.216, 67.46, 772.307, 4.103, -7.406),
        ("ppo", "tanh"): (2727.577, 0.13, 50.839, 12781.262, 4.2, 88.527),
        ("ppo", "sigmoid"): (1538.434, 0.149, 60.723, 5535.878, 3.428, 31.117),
        ("ppo", "relu"): (1730.587, 0.074, 51.748, 8023.028, 4.12, 43.598),
        ("ppo", "leaky_relu"): (1444.961, 0.088, 51.174, 6546.359, 4.269, 33.8),
    }.items()
}
TABLE_OF, CURVES_OF = {"dqn": 1, "ppo": 2}, {"dqn": 4, "ppo": 5}
"""Numbers of an algorithm's table and of its figure with learning curves, in the paper's order."""
PATHS = (6, 7)
"""Numbers of the figures with paths of episodes."""
ACTIVATIONS = ("tanh", "sigmoid", "relu", "leaky_relu")
"""In the tables' order."""


def printed(algorithm: str, activation: str, metric: str, per_frame: bool = False) -> float:
    """A number of the tables; NaN where they have none.

    per_frame: reward / steps, and distance / steps for the speed. Steps and distance are per collision as
    they are, as each of the paper's episodes ended in one.
    """
    row = TABLES.get((algorithm, activation), {})
    if per_frame and row:
        row = row | {"reward": row["reward"] / row["steps"], "speed": row["distance"] / row["steps"]}
    return row.get(metric, math.nan)


HOURS = 10.0
"""Hours that one run took, sec. 4.1."""
