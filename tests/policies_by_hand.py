"""Policies of random weights or of one action, without a run."""

import torch
from torch import nn

from uavnav.networks import mlp
from uavnav.runs.policies import Policy
from uavnav.tasks.simulator import EMPTY, make_task


def network(seed=0, sizes=(30, 64, 64, 100), activation="tanh", **how):
    return mlp(sizes, activation, [torch.Generator().manual_seed(seed)], "default", **how)


def untrained(seed=5, greedy=True, task=None, acts="categorical", epsilon=0.0, algorithm="ppo", **how):
    """Its episodes end by collisions at many steps; of those of seed 5 on 20 test layouts one goes round for ever."""
    task = task or make_task(EMPTY)
    return Policy(network(seed, **how), algorithm, greedy, task, acts, "direct", epsilon, seed)


class Always(nn.Module):
    """The same action everywhere, which is worth so much more than the others."""

    def __init__(self, action, worth=1.0):
        super().__init__()
        self.action, self.worth = action, worth

    def forward(self, observation):
        values = torch.zeros(*observation.shape[:-1], 100)
        values[..., self.action] = self.worth
        return values


def always(action, greedy=True, worth=1.0):
    return Policy(Always(action, worth), "ppo", greedy, make_task(EMPTY), "categorical", "direct")
