"""Scripted policies, of the form that `uavnav.evaluate_policy` takes: what a learned one must beat."""

from __future__ import annotations

import functools
from collections.abc import Callable

import torch
from torch import Tensor

from uavnav.tasks.classics import SECTORS, apf, dwa, orca, vfh
from uavnav.tasks.goal import GoalWorld
from uavnav.tasks.moving import MovingWorld
from uavnav.tasks.protocol import SCRIPTED
from uavnav.tasks.sensed import MARGIN, ahead, seen, target
from uavnav.tasks.space import SpaceWorld, decode
from uavnav.tasks.world import World
from uavnav.tasks.wrapper import WrappedTask

AnyPolicy = Callable[[Tensor, torch.Generator | None], Tensor]
"""observation [N, 30] (or what else the task senses), generator -> action [N] int64 in 0..99."""

WORLD = World()
FULL_SPEED = WORLD.n_distances - 1  # [px], and the action that flies them straight ahead
GOAL = GoalWorld()


def uniform_random(observation: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """Every action equally likely: a check of the environment (90 % turns, 10 % stops, 4.5 px a step)."""
    return torch.randint(WORLD.n_actions, observation.shape[:-1], generator=generator)


def straight_ahead(
    observation: Tensor, generator: torch.Generator | None = None, world: World | None = None
) -> Tensor:
    """Nine pixels a step and never a turn, whatever is in the way; world: a box has other actions."""
    return torch.full(observation.shape[:-1], straight_on(world or WORLD))


def reactive(
    observation: Tensor, generator: torch.Generator | None = None, world: World | None = None
) -> Tensor:
    """Fly straight at full speed where that is certainly safe, else turn left on the spot; where a goal is
    sensed too, `towards_goal`.

    The distance to a convex body at d px in a direction with forward component y falls by at most s y over s
    px straight ahead, and what is behind recedes: d - 9 y > 30 for all that is in view excludes a collision.
    It looks at the newest observation of a stack. world: what is sensed; by default as the size of one
    observation tells.
    """
    if world is None and observation.shape[-1] % GOAL.observation_size == 0:
        return towards_goal(observation, generator)
    world = world or _of_size(observation)
    towards, distance, empty, _ = seen(observation, world)
    closest = distance - FULL_SPEED * towards[..., -1]
    if world.padding == "zeros":  # else an empty slot is as far as the sensor reaches
        closest = torch.where(empty, torch.inf, closest)
    left_on_the_spot = world.n_turns // 2 * (world.n_actions // world.n_turns)  # as far as one action turns
    safe = closest.amin(-1) > world.drone_radius + MARGIN
    return torch.where(safe, straight_on(world), left_on_the_spot)


def straight_on(world: World) -> int:
    """The action straight ahead at full speed."""
    return world.n_distances - 1


def _of_size(observation: Tensor) -> World:
    """The world without a goal whose observations have so many numbers, by default."""
    return WORLD if observation.shape[-1] % WORLD.observation_size == 0 else MovingWorld(sense_velocity=True)


LOOK = 60.0  # [px] that must be free in a direction
ROOM = 2.0  # [px] beyond the drone's own radius


def towards_goal(
    observation: Tensor, generator: torch.Generator | None = None, world: World | None = None
) -> Tensor:
    """Turn to the free direction that is nearest to the goal's, and fly as far as is certainly safe.

    A direction is free if the nearest point of nothing in view comes too close to the next 60 px there, or to
    the way to a goal that is nearer. The drone turns on the spot while it has 45 degrees or more to turn, or
    nothing is free.
    world: as of `reactive`.
    """
    world = world or GOAL
    (towards, distance, empty, _), (goal, away) = seen(observation, world), target(observation, world)
    angles = torch.deg2rad(SECTORS)
    along = towards @ torch.stack([angles.sin(), angles.cos()])  # [..., slots, bearings]
    reach = away.clamp(max=LOOK)[..., None, None]
    passed = (distance[..., None] * along).clamp(min=0).minimum(reach)  # where it is nearest
    nearest = (distance[..., None] ** 2 - 2 * passed * distance[..., None] * along + passed**2).sqrt()
    free = ((nearest > world.drone_radius + ROOM) | (along <= 0) | empty[..., None]).all(-2)
    bearing = torch.rad2deg(torch.atan2(goal[..., 0], goal[..., 1]))
    apart = torch.where(free, (SECTORS - bearing[..., None]).abs(), torch.inf)
    wanted = torch.where(free.any(-1), SECTORS[apart.argmin(-1)], -90)
    angle = (-wanted).clamp(WORLD.n_turns // 2 + 1 - WORLD.n_turns, WORLD.n_turns // 2)
    closing = (towards * ahead(angle[..., None].float())[..., None, :]).sum(-1)
    room = torch.where(empty | (closing <= 0), torch.inf, (distance - world.drone_radius - MARGIN) / closing)
    safe = room.amin(-1).clamp(0, FULL_SPEED).long()
    return angle % WORLD.n_turns * WORLD.n_distances + torch.where(wanted.abs() >= 45, 0, safe)


STEPS = 16  # that a way is looked ahead
TURNING = (0, 1, 3, 8, 18, 36)  # steps of a way that turn, before it goes straight on at full speed
SPEEDS = (0, 3, 6, 9)  # [px a step] while it turns
BODY = 60.0  # [px] radius that a sensed body is taken to have
DRIFT = 0.5  # [px a step] that a body may come nearer by itself
ENOUGH = 40.0  # [px] of clearance, beyond which more is worth nothing


def _places(turn: Tensor, turning: Tensor, speed: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Where ways lead that turn for so many steps and then go straight on: places [W, T, axes] px in the
    drone's frame, and what each way is worth [W] px.

    turn [W, angles] degrees a step, turning [W] steps, speed [W] px a step while it turns.
    """
    step = torch.arange(1, steps + 1)
    turned = turn[:, None] * step.minimum(turning[:, None])[..., None]
    pace = torch.where((step <= turning[:, None]) | (turning[:, None] == 0), speed[:, None], FULL_SPEED)
    places = (pace[..., None] * ahead(turned.float())).cumsum(1)
    return places, 0.1 * places[:, -1].norm(dim=-1)


def _ways() -> tuple[Tensor, Tensor, Tensor]:
    """Ways to fly: the first action [W], and what `_places` says of each."""
    sides = (WORLD.n_turns // 2, WORLD.n_turns // 2 + 1 - WORLD.n_turns)  # [degrees] the greatest turns
    turn, turning, speed = torch.cartesian_prod(
        torch.tensor(sides), torch.tensor(TURNING), torch.tensor(SPEEDS)
    ).T
    first = torch.where(turning > 0, turn % WORLD.n_turns, 0) * WORLD.n_distances + speed
    flies = (turning > 0) | (speed > 0)  # who stands still is hit from behind
    return first[flies], *_places(turn[flies, None], turning[flies], speed[flies], STEPS)


FIRST, PLACES, WORTH = _ways()


def dodge(
    observation: Tensor, generator: torch.Generator | None = None, world: World | None = None
) -> Tensor:
    """The first action of the way that keeps most clear of what is in view, also if that comes nearer by
    itself.

    It judges 46 ways of 16 steps, each a turn and then straight on, as the dynamic window approach does (Fox
    et al. 1997). A way that leads farther counts a little more. It never stands still without a turn, and
    looks at no sensed velocities. world: as of `reactive`.
    """
    clear = _clearances(observation, world or _of_size(observation), PLACES, BODY)
    return FIRST[(clear.clamp(max=ENOUGH) + WORTH).argmax(-1)]


def _clearances(observation: Tensor, world: World, places: Tensor, body: float) -> Tensor:
    """How clear each way [W, T, axes] keeps of bodies of a radius that drift nearer: [..., W] px."""
    towards, distance, empty, _ = seen(observation, world)
    centre = torch.where(empty[..., None], torch.inf, towards * (distance + body)[..., None])
    apart = (places[:, :, None] - centre[..., None, None, :, :]).norm(dim=-1).amin(-1)  # [..., ways, steps]
    drift = DRIFT * torch.arange(1, places.shape[1] + 1)
    clear: Tensor = apart - body - world.drone_radius - drift
    return clear.amin(-1)


# -- in a box ------------------------------------------------------------------------------------------------

BOX = SpaceWorld()
LOOKED_AHEAD = 10  # steps of a way
TURNED = (1, 11)  # steps of a way that turn, before it goes straight on at full speed
SPHERE = 80.0  # [px] radius that a sensed body is taken to have


def _ways_in_the_box() -> tuple[Tensor, Tensor, Tensor]:
    """As `_ways`, by yaw and pitch."""
    action = torch.arange(BOX.n_actions)
    yaw, pitch, speed = decode(action, BOX)
    greatest = (yaw.abs() % 4 == 0) & (pitch.abs() % 4 == 0)
    turns = (yaw != 0) | (pitch != 0)
    first = torch.cat([action[greatest & turns].repeat(len(TURNED)), action[~turns & (speed > 0)]])
    turning = torch.tensor(TURNED).repeat_interleave(int((greatest & turns).sum()))
    turning = torch.cat([turning, torch.zeros(len(first) - len(turning), dtype=torch.int64)])
    return first, *_places(torch.stack([yaw, pitch], -1)[first], turning, speed[first], LOOKED_AHEAD)


BOX_FIRST, BOX_PLACES, BOX_WORTH = _ways_in_the_box()
AHEAD = straight_on(BOX)
BOX_STRAIGHT = int((BOX_FIRST == AHEAD).nonzero())
EASY = 15.0  # [px] of clearance straight ahead with which it does not turn, for a turn costs


def dodge_in_the_box(
    observation: Tensor, generator: torch.Generator | None = None, world: World = BOX
) -> Tensor:
    """As `dodge`, of 67 ways of 10 steps that turn to eight sides, where straight on is not clear; it knows
    nothing of its pitch, which may be at its end. world: what is sensed.
    """
    clear = _clearances(observation, world, BOX_PLACES, SPHERE)
    best = BOX_FIRST[(clear.clamp(max=ENOUGH) + BOX_WORTH).argmax(-1)]
    return torch.where(clear[..., BOX_STRAIGHT] > EASY, AHEAD, best)


def chosen_among(world: World) -> tuple[int, int]:
    """How many turns and distances scripted policies choose among in a world of two or three dimensions."""
    usual = BOX if isinstance(world, SpaceWorld) else WORLD
    return usual.n_turns, usual.n_distances


def suited(policy: AnyPolicy, task: WrappedTask) -> AnyPolicy:
    """The policy that a name stands for in a task: `reactive` is another for what stands still, what moves,
    or a goal. It and the classics know the task's world. Other policies are as they are.

    Raises:
        ValueError: a scripted policy is to fly where there are other turns or distances than its own.
    """
    if policy not in BASELINES.values():
        return policy
    own, (turns, distances) = task.world, chosen_among(task.world)
    if (own.n_turns, own.n_distances) != (turns, distances):
        given = f"n_turns={own.n_turns}, n_distances={own.n_distances}"
        raise ValueError(
            f"{given}: scripted policies choose among {turns} turns and {distances} distances; leave them out"
        )
    in_a_box = isinstance(own, SpaceWorld)
    if policy is uniform_random or (policy is straight_ahead and not in_a_box):
        return policy
    suitable: Callable[..., Tensor] = policy
    if policy is reactive and not task.STATIC:
        suitable = dodge_in_the_box if in_a_box else dodge
    elif policy is reactive and isinstance(own, GoalWorld):
        suitable = towards_goal
    return functools.partial(
        suitable, world=own.replace(sensor_radius=task.trained_reach or own.sensor_radius)
    )


BASELINES: dict[str, AnyPolicy] = dict(
    zip(SCRIPTED, (uniform_random, straight_ahead, reactive, apf, vfh, dwa, orca), strict=True)
)
