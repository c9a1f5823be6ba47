"""Scripted policies, of the form that `uavnav.evaluate_policy` takes: what a learned one must be better than."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from uavnav.tasks.goal import SCALE, GoalWorld
from uavnav.tasks.protocol import SCRIPTS
from uavnav.tasks.world import World

AnyPolicy = Callable[[Tensor, torch.Generator | None], Tensor]
"""observation [N, 30] (or what else the task senses), generator -> action [N] int64 in 0..99."""

WORLD = World()
FULL_SPEED = WORLD.n_distances - 1  # straight ahead, 9 px
LEFT_IN_PLACE = WORLD.n_turns // 2 * WORLD.n_distances  # 5 degrees, 0 px
MARGIN = 0.01  # [px] against rounding
WITH_GOAL = GoalWorld().observation_size


def uniform_random(observation: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Every action equally likely: the free check of the world (90 % turns, 10 % stops, 4.5 px a step)."""
    return torch.randint(WORLD.n_actions, observation.shape[:-1], generator=generator)


def straight_ahead(observation: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Nine pixels a step and never a turn, whatever is in the way."""
    return torch.full(observation.shape[:-1], FULL_SPEED)


def reactive(observation: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Fly straight at full speed where that is certainly safe, else turn left on the spot; where a goal is sensed too,
    `towards_goal`.

    The distance to a convex body at d px in a direction with forward component y falls by at most s y over s px
    straight ahead, and what is behind recedes: d - 9 y > 30 for all that is in view excludes a collision. It looks at
    the newest observation of a stack.
    """
    size = observation.shape[-1]
    if size % WITH_GOAL == 0:
        return towards_goal(observation, generator)
    width = 3 if size % WORLD.observation_size == 0 else 5  # with velocities
    slots = observation[..., : WORLD.n_slots * width].reshape(*observation.shape[:-1], WORLD.n_slots, width)
    distance = WORLD.drone_radius + slots[..., 2] * (WORLD.sensor_radius - WORLD.drone_radius)
    closest = (distance - FULL_SPEED * slots[..., 1]).amin(-1)
    return torch.where(closest > WORLD.drone_radius + MARGIN, FULL_SPEED, LEFT_IN_PLACE)


BEARINGS = torch.arange(-90, 91, 5)  # [degrees] to the right of the heading
LOOK = 60.0  # [px] that must be free in a direction
ROOM = 2.0  # [px] beyond the drone's own radius


def towards_goal(observation: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Turn to the free direction that is nearest to the goal's, and fly as far as is certainly safe.

    A direction is free if the nearest point of nothing in view comes too close to the next 60 px there, or to the way
    to a goal that is nearer. The drone turns on the spot while it has 45 degrees or more to turn, or nothing is free.
    """
    slots = observation[..., : 3 * WORLD.n_slots].reshape(*observation.shape[:-1], WORLD.n_slots, 3)
    right, forward, away = observation[..., WORLD.observation_size : WITH_GOAL].unbind(-1)
    towards, empty = slots[..., :2], (slots[..., :2] == 0).all(-1)
    distance = WORLD.drone_radius + slots[..., 2] * (WORLD.sensor_radius - WORLD.drone_radius)
    ahead = torch.deg2rad(BEARINGS)
    along = towards @ torch.stack([ahead.sin(), ahead.cos()])  # [..., slots, bearings]
    reach = (away * SCALE).clamp(max=LOOK)[..., None, None]
    flown = (distance[..., None] * along).clamp(min=0).minimum(reach)  # where it is nearest
    nearest = (distance[..., None] ** 2 - 2 * flown * distance[..., None] * along + flown**2).sqrt()
    free = ((nearest > WORLD.drone_radius + ROOM) | (along <= 0) | empty[..., None]).all(-2)
    bearing = torch.rad2deg(torch.atan2(right, forward))
    apart = torch.where(free, (BEARINGS - bearing[..., None]).abs(), torch.inf)
    wanted = torch.where(free.any(-1), BEARINGS[apart.argmin(-1)], -90)
    angle = (-wanted).clamp(WORLD.n_turns // 2 + 1 - WORLD.n_turns, WORLD.n_turns // 2)
    after = torch.deg2rad(angle)
    closing = (towards * torch.stack([-after.sin(), after.cos()], -1)[..., None, :]).sum(-1)
    room = torch.where(empty | (closing <= 0), torch.inf, (distance - WORLD.drone_radius - MARGIN) / closing)
    safe = room.amin(-1).clamp(0, FULL_SPEED).long()
    return angle % WORLD.n_turns * WORLD.n_distances + torch.where(wanted.abs() >= 45, 0, safe)


BASELINES: dict[str, AnyPolicy] = dict(zip(SCRIPTS, (uniform_random, straight_ahead, reactive), strict=True))
