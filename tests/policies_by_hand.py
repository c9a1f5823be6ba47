"""Policies of random weights or of one action, without a run."""

import zipfile

import torch
from torch import nn

from uavnav.networks import mlp
from uavnav.runs.policies import Policy
from uavnav.tasks.table import EMPTY, make_task


def network(seed=0, sizes=(30, 64, 64, 100), activation="tanh", **how):
    return mlp(sizes, activation, [torch.Generator().manual_seed(seed)], "default", **how)


def untrained(seed=5, greedy=True, task=None, acts="categorical", epsilon=0.0, algorithm="ppo", **how):
    """Its episodes end by collisions at many steps; of those of seed 5 on 20 test layouts one goes round
    for ever.
    """
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


def write_zip(path):
    """What Stable-Baselines3 saves of a DQN, as far as it is read."""
    generator, shapes = (
        torch.Generator().manual_seed(0),
        {"q_net.q_net.0": (8, 30), "q_net.q_net.2": (100, 8)},
    )
    weights = {f"{name}.weight": torch.randn(shape, generator=generator) for name, shape in shapes.items()}
    weights |= {f"{name}.bias": torch.zeros(shape[0]) for name, shape in shapes.items()}
    with zipfile.ZipFile(path, "w") as archive, archive.open("policy.pth", "w") as file:
        torch.save(weights, file)
    return path
