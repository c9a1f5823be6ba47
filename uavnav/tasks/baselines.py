"""Scripted policies, of the form that `uavnav.evaluate_policy` takes: what a learned one must be better than."""

from __future__ import annotations

import functools
from collections.abc import Callable

import torch
from torch import Tensor

from uavnav.tasks.goal import SCALE, GoalWorld
from uavnav.tasks.protocol import SCRIPTS
from uavnav.tasks.simulator import Space, Task
from uavnav.tasks.space import SpaceWorld, decode
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


STEPS = 16  # that a way is looked ahead
TURNING = (0, 1, 3, 8, 18, 36)  # steps of a way that turn, before it goes straight on at full speed
SPEEDS = (0, 3, 6, 9)  # [px a step] while it turns
BODY = 60.0  # [px] radius that a sensed body is taken to have
DRIFT = 0.5  # [px a step] that a body may come nearer by itself
ENOUGH = 40.0  # [px] of clearance, beyond which more is worth nothing


def _ways() -> tuple[Tensor, Tensor, Tensor]:
    """Ways to fly: places [W, STEPS, 2] px to the right and forward, first action [W], what each is worth [W] px."""
    sides = (WORLD.n_turns // 2, WORLD.n_turns // 2 + 1 - WORLD.n_turns)  # [degrees] the greatest turns
    turn, turning, speed = torch.cartesian_prod(torch.tensor(sides), torch.tensor(TURNING), torch.tensor(SPEEDS)).T
    step = torch.arange(1, STEPS + 1)
    heading = torch.deg2rad((turn[:, None] * step.minimum(turning[:, None])).float())
    pace = torch.where((step <= turning[:, None]) | (turning[:, None] == 0), speed[:, None], FULL_SPEED)
    places = (pace[..., None] * torch.stack([-heading.sin(), heading.cos()], -1)).cumsum(1)
    first = torch.where(turning > 0, turn % WORLD.n_turns, 0) * WORLD.n_distances + speed
    flies = (turning > 0) | (speed > 0)  # who stands still is hit from behind
    return places[flies], first[flies], 0.1 * places[flies, -1].norm(dim=-1)


PLACES, FIRST, WORTH = _ways()


def dodge(observation: Tensor, generator: torch.Generator | None = None, width: int | None = None) -> Tensor:
    """The first action of the way that keeps most clear of what is in view, also if that comes nearer by itself.

    It judges 46 ways of 16 steps, each a turn and then straight on, as the dynamic window approach does (Fox et al.
    1997). A way that leads farther counts a little more. It never stands still without a turn, and looks at no sensed
    velocities. width: numbers of a slot, by default as the size of one observation tells.
    """
    width = width or (3 if observation.shape[-1] % WORLD.observation_size == 0 else 5)
    slots = observation[..., : WORLD.n_slots * width].reshape(*observation.shape[:-1], WORLD.n_slots, width)
    distance = WORLD.drone_radius + slots[..., 2] * (WORLD.sensor_radius - WORLD.drone_radius)
    centre = slots[..., :2] * (distance + BODY)[..., None]
    centre = torch.where((slots[..., :2] == 0).all(-1, keepdim=True), torch.inf, centre)
    apart = (PLACES[:, :, None] - centre[..., None, None, :, :]).norm(dim=-1).amin(-1)  # [..., ways, steps]
    clear = (apart - BODY - WORLD.drone_radius - DRIFT * torch.arange(1, STEPS + 1)).amin(-1)
    return FIRST[(clear.clamp(max=ENOUGH) + WORTH).argmax(-1)]


# -- in a box --------------------------------------------------------------------------------------------------------

BOX = SpaceWorld()
AHEAD = BOX.n_distances - 1  # straight ahead, 9 px
LEFT_IN_THE_BOX = BOX.n_turns // 2 * BOX.n_turns * BOX.n_distances  # 4 degrees, 0 px
LOOKED_AHEAD = 10  # steps of a way
TURNED = (1, 11)  # steps of a way that turn, before it goes straight on at full speed
SPHERE = 80.0  # [px] radius that a sensed body is taken to have


def straight_in_the_box(observation: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """As `straight_ahead`, by the actions of a box."""
    return torch.full(observation.shape[:-1], AHEAD)


def reactive_in_the_box(
    observation: Tensor, generator: torch.Generator | None = None, width: int = len(BOX.slot_low)
) -> Tensor:
    """As `reactive`, and for the same reason never into what it senses: straight at full speed, else a yaw to the left.

    width: numbers of a slot, more where velocities are sensed.
    """
    towards, distance = _in_the_box(observation, width)
    closest = (distance - FULL_SPEED * towards[..., 2]).amin(-1)
    return torch.where(closest > BOX.drone_radius + MARGIN, AHEAD, LEFT_IN_THE_BOX)


def _ways_in_the_box() -> tuple[Tensor, Tensor, Tensor]:
    """As `_ways`, by yaw and pitch: places [W, LOOKED_AHEAD, 3] px to the right, up and forward, and the rest."""
    action = torch.arange(BOX.n_actions)
    yaw, pitch, speed = decode(action, BOX)
    greatest = (yaw.abs() % 4 == 0) & (pitch.abs() % 4 == 0)
    turns = (yaw != 0) | (pitch != 0)
    first = torch.cat([action[greatest & turns].repeat(len(TURNED)), action[~turns & (speed > 0)]])
    turning = torch.tensor(TURNED).repeat_interleave(int((greatest & turns).sum()))
    turning = torch.cat([turning, torch.zeros(len(first) - len(turning), dtype=torch.int64)])
    step = torch.arange(1, LOOKED_AHEAD + 1)
    turned = step.minimum(turning[:, None])
    side, climb = (torch.deg2rad((angle[first, None] * turned).float()) for angle in (yaw, pitch))
    pace = torch.where((step <= turning[:, None]) | (turning[:, None] == 0), speed[first, None], FULL_SPEED)
    ahead = torch.stack([-side.sin() * climb.cos(), climb.sin(), side.cos() * climb.cos()], -1)
    places = (pace[..., None] * ahead).cumsum(1)
    return places, first, 0.1 * places[:, -1].norm(dim=-1)


BOX_PLACES, BOX_FIRST, BOX_WORTH = _ways_in_the_box()
BOX_STRAIGHT = int((BOX_FIRST == AHEAD).nonzero())
EASY = 15.0  # [px] of clearance straight ahead with which it does not turn, for a turn costs


def dodge_in_the_box(
    observation: Tensor, generator: torch.Generator | None = None, width: int = len(BOX.slot_low)
) -> Tensor:
    """As `dodge`, of 67 ways of 10 steps that turn to eight sides, where straight on is not clear; it knows nothing of
    its pitch, which may be at its end. width: as of `reactive_in_the_box`.
    """
    towards, distance = _in_the_box(observation, width)
    centre = towards * (distance + SPHERE)[..., None]
    centre = torch.where((towards == 0).all(-1, keepdim=True), torch.inf, centre)
    apart = (BOX_PLACES[:, :, None] - centre[..., None, None, :, :]).norm(dim=-1).amin(-1)
    clear = (apart - SPHERE - BOX.drone_radius - DRIFT * torch.arange(1, LOOKED_AHEAD + 1)).amin(-1)
    best = BOX_FIRST[(clear.clamp(max=ENOUGH) + BOX_WORTH).argmax(-1)]
    return torch.where(clear[..., BOX_STRAIGHT] > EASY, AHEAD, best)


def _in_the_box(observation: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """Directions [..., S, 3] (right, up, forward) and distances [..., S] px of the slots of the newest observation."""
    slots = observation[..., : BOX.n_slots * width].reshape(*observation.shape[:-1], BOX.n_slots, width)
    return slots[..., :3], BOX.drone_radius + slots[..., 3] * (BOX.sensor_radius - BOX.drone_radius)


def suited(policy: AnyPolicy, task: Task) -> AnyPolicy:
    """The policy that a name stands for in a task: among obstacles that move, `reactive` is `dodge`; a box has its own
    straight flight and its own rules.
    """
    if isinstance(task, Space):
        rule = reactive_in_the_box if task.STATIC else dodge_in_the_box
        own: dict[AnyPolicy, AnyPolicy] = {
            straight_ahead: straight_in_the_box,
            reactive: functools.partial(rule, width=len(task.world.slot_low)),
        }
        return own.get(policy, policy)
    if policy is not reactive or task.STATIC:
        return policy
    width = len(task.world.slot_low)
    return dodge if width == len(WORLD.slot_low) else functools.partial(dodge, width=width)


BASELINES: dict[str, AnyPolicy] = dict(zip(SCRIPTS, (uniform_random, straight_ahead, reactive), strict=True))
