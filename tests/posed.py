"""Poses whose sensor readings are held against the slow loop of `oracle`."""

import math

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
    """Compare every pose that is not doubtful; the share of the doubtful ones. there: which circles the
    loop has.
    """
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


def near_walls(n, generator):
    x, y, heading, circles = random_poses(n, 11)
    gap = 20 + 40 * torch.rand(n, generator=generator)
    x[0::4], x[1::4] = gap[0::4], 800 - gap[1::4]
    y[2::4], y[3::4] = gap[2::4], 600 - gap[3::4]
    return x, y, heading, circles


def near_corners(n, generator):
    _, _, heading, circles = random_poses(n, 12)
    x, y = 20 + 130 * torch.rand(2, n, generator=generator)
    x[0::2], y[1::4], y[2::4] = 800 - x[0::2], 600 - y[1::4], 600 - y[2::4]
    return x, y, heading, circles


def around_a_circle(n, generator, gap, seed):
    """The first circle's edge is gap [n] px away."""
    x, y, heading, circles = random_poses(n, seed)
    angle = 2 * math.pi * torch.rand(n, generator=generator)
    circles[:, 0, 0] = x + (circles[:, 0, 2] + gap) * torch.cos(angle)
    circles[:, 0, 1] = y + (circles[:, 0, 2] + gap) * torch.sin(angle)
    return x, y, heading, circles


def in_contact(n, generator):
    return around_a_circle(n, generator, 29.5 + torch.rand(n, generator=generator), 13)


def at_the_edge_of_view(n, generator):
    return around_a_circle(n, generator, 119.5 + torch.rand(n, generator=generator), 14)


def axis_headings(n, generator):
    """On whole pixels, so that directions at right angles and equal distances are exact in float32 too.

    Not inside the border, where no episode gets: there, exactly on the edge of two squares, `sense` leaves
    out the square whose nearest point is exactly 120 px along the wall (the eighth from the drone's).
    """
    x, y, heading, circles = random_poses(n, 15)
    x, y = 21 + x * 758 / 800, 21 + y * 558 / 600
    circles[:, 0] = torch.stack([x.round() + 90, y.round(), torch.full_like(x, 45)], -1)
    return x.round(), y.round(), heading // 90 * 90, circles


def inside_a_square(n, generator):
    _, _, heading, circles = random_poses(n, 16)
    left, bottom = torch.tensor(oracle.SQUARES)[torch.randint(136, (n,), generator=generator)].T
    return (
        left + 20 * torch.rand(n, generator=generator),
        bottom + 20 * torch.rand(n, generator=generator),
        heading,
        circles,
    )


def on_a_circles_centre(n, generator):
    _, _, heading, circles = random_poses(n, 17)
    return circles[:, 3, 0].clone(), circles[:, 3, 1].clone(), heading, circles


OTHERS = [
    ({"sensor_arc": 90}, {"arc": 90}),
    ({"sensor_arc": 270}, {"arc": 270}),
    ({"sensor_arc": 360}, {"arc": 360}),
    ({"sensor_radius": 200, "n_slots": 25}, {"sensor": 200, "slots": 25}),
    ({"sensor_radius": 75.5, "drone_radius": 10, "n_slots": 3}, {"sensor": 75.5, "drone": 10, "slots": 3}),
    ({"border": 10, "n_slots": 40}, {"side": 10, "slots": 40}),
    ({"width": 1000, "height": 500, "border": 50}, {"width": 1000, "height": 500, "side": 50}),
]
"""Fields of other worlds than the paper's, and the same for the oracle."""


def poses_in(world, n):
    x, y, heading, circles = near_walls(n, torch.Generator().manual_seed(3))
    across, up = world.width / 800, world.height / 600
    return x * across, y * up, heading, circles * torch.tensor([across, up, 1.0])
