"""Poses whose sensor readings are held against the slow loop of `oracle`."""

import oracle
import torch

import uavnav
from uavnav.tasks import layouts
from uavnav.tasks.sensing import sense

WORLD = uavnav.World()


def random_poses(n, seed, k=8):
    """Positions anywhere in the window, whole-degree headings, a layout each: x, y, heading, obstacles."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(n, generator=generator) * 800
    y = torch.rand(n, generator=generator) * 600
    heading = torch.randint(360, (n,), generator=generator)
    return x, y, heading, layouts.generate(n, k, seed=seed)


def agree_with_the_oracle(poses, world=WORLD, arena=oracle.PAPER, there=lambda circle: True):
    """Compare every pose that is not doubtful; the share of the doubtful ones. there: which circles the loop has."""
    slots, clearance = sense(*poses, world)
    x, y, heading, circles = (part.tolist() for part in poses)
    expected, kept = [], []
    for row in range(len(x)):
        found = oracle.look(x[row], y[row], heading[row], filter(there, circles[row]), arena)
        if not oracle.doubtful(found, arena):
            kept.append(row)
            slots_there = oracle.slots_of(found, world.slots, world.padding, arena)
            expected.append([oracle.clearance_of(found), *sum(slots_there, ())])
    got = torch.cat([clearance[:, None], slots.flatten(1)], -1)[kept]
    torch.testing.assert_close(got, torch.tensor(expected), rtol=0, atol=1e-4)
    return 1 - len(kept) / len(x)
