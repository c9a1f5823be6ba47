"""The classics of obstacle avoidance as scripted policies: potential field, VFH+, dynamic window and ORCA.

Each is a pure function of what is sensed, observation [..., numbers] -> action [...]. It flies towards the
goal where one is sensed, else straight ahead at full speed. world: what is sensed. The other arguments
are its parameters. docs/classics.py chose their defaults: they have the least mean rank of rewards on
validation layouts of the tasks drone, goal and moving; those of orca on moving and space-moving.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from uavnav.errors import ConfigError
from uavnav.tasks.moving import MovingWorld
from uavnav.tasks.sensed import MARGIN, ahead, moves, seen, steer, target
from uavnav.tasks.world import World

WORLD = World()
SENSING = MovingWorld(sense_velocity=True)


def apf(
    observation: Tensor,
    generator: torch.Generator | None = None,
    world: World = WORLD,
    gain: float = 3e3,
    reach: float = 80.0,
    tolerance: float = 10.0,
) -> Tensor:
    """Artificial potential field (Khatib 1986): the target pulls with 1, each body within reach pushes.

    A body's push is gain (1 / rho - 1 / reach) / rho^2, its eq. (16), with rho [px] from the drone's edge.
    The drone flies along the sum of all forces, and turns if that is more than tolerance [degrees] aside.
    """
    slots, (pull, away) = seen(observation, world), target(observation, world)
    rho = (slots.distance - world.drone_radius).clamp(min=1)
    push = torch.where(slots.empty | (rho > reach), 0.0, gain * (1 / rho - 1 / reach) / rho**2)
    force = pull - (push[..., None] * slots.towards).sum(-2)
    pace = away.clamp(max=world.distances[-1])[..., None]
    return steer(pace * force / force.norm(dim=-1, keepdim=True).clamp(min=1e-6), world, tolerance)


SECTORS = torch.arange(-90, 91, 5)  # [degrees] to the right of the heading
ASIDE = 45.0  # [degrees] to turn, from which it stops for it


def vfh(
    observation: Tensor,
    generator: torch.Generator | None = None,
    world: World = WORLD,
    window: float = 60.0,
    spare: float = 5.0,
    wide: int = 2,
) -> Tensor:
    """Vector field histogram, VFH+ (Ulrich & Borenstein 1998), in sectors of 5 degrees.

    A body nearer than window [px] blocks the sectors within asin((drone radius + spare) / distance) of its
    bearing, eqs (6) to (8): every certainty is 1, so the binary histogram needs no threshold. The drone turns
    on the spot, so none is masked. Candidates are the middle of a narrow opening, and of a wide one what is
    `wide` sectors from its ends; the cheapest is chosen, eq. (14), with 5 and 2 for what is apart from the
    target and the heading. Without a memory the third term is left out. Speed falls with the turn and with
    what is ahead (Borenstein & Koren 1991, eqs 13 and 14). Where nothing is open the drone turns left.

    Raises:
        ConfigError: the world is a box.
    """
    if len(world.size) > 2:
        raise ConfigError("vfh: its histogram is of a plane, and this task is a box; fly apf or dwa there")
    slots, (goal, away) = seen(observation, world), target(observation, world)
    bearing = torch.rad2deg(torch.atan2(slots.towards[..., 0], slots.towards[..., 1]))
    half = torch.rad2deg(((world.drone_radius + spare) / slots.distance).clamp(max=1).asin())
    reach = away.clamp(max=window)[..., None]
    near = ~slots.empty & (slots.distance < reach + world.drone_radius)
    covered = (SECTORS - bearing[..., None]).abs() <= half[..., None]
    blocked = (near[..., None] & covered).any(-2)
    index = torch.arange(len(SECTORS))
    left = index - torch.where(blocked, index, -len(index)).cummax(-1).values
    right = torch.where(blocked, index, 2 * len(index)).flip(-1).cummin(-1).values.flip(-1) - index
    candidate = ~blocked & ((left.minimum(right) >= wide) | ((left - right).abs() <= 1))
    aim = torch.rad2deg(torch.atan2(goal[..., 0], goal[..., 1]))[..., None]
    cost = 5 * ((SECTORS - aim + 180) % 360 - 180).abs() + 2 * SECTORS.abs()
    wanted = SECTORS[torch.where(candidate, cost, torch.inf).argmin(-1)]
    wanted = torch.where(candidate.any(-1), wanted, -90)
    most = world.n_turns // 2
    angle = (-wanted).clamp(most + 1 - world.n_turns, most)
    along = (slots.towards * ahead(angle[..., None].float())[..., None, :]).sum(-1).clamp(min=0)
    dense = torch.where(near, along * (1 - (slots.distance - world.drone_radius) / window), 0.0).amax(-1)
    pace = world.distances[-1] * (1 - dense) * (1 - wanted.abs() / ASIDE).clamp(min=0)
    return angle % world.n_turns * world.n_distances + pace.round().long()


STRETCH = 9.0  # [px] between two points of an arc
POINTS = 10  # of an arc


@functools.cache
def _arcs(world: World) -> Tensor:
    """Where each action leads if it is repeated [A, POINTS, axes] px, for a stretch of the way each."""
    each = moves(world)
    rate = torch.where(each.distance > 0, 1 / each.distance, 0.0)[:, None] * each.turn  # [degrees a px]
    third = STRETCH / 3 * (torch.arange(3 * POINTS) + 0.5)
    points = (STRETCH / 3 * ahead(rate[:, None] * third[:, None])).cumsum(1)[:, 2::3]
    return points * (each.distance > 0)[:, None, None]


def dwa(
    observation: Tensor,
    generator: torch.Generator | None = None,
    world: World = WORLD,
    heading: float = 1.0,
    clear: float = 1.0,
    speed: float = 0.2,
    body: float = 60.0,
) -> Tensor:
    """Dynamic window approach (Fox, Burgard & Thrun 1997) over all actions, for the drone has no inertia.

    An action is an arc of turn / distance [degrees a px]. It is worth heading x (1 - angle to the target /
    180) + clear x (share of 90 px of the arc that are free) + speed x distance / the greatest, their eq.
    (13). Admissible is what cannot touch a body in this step, whatever the body's size, and is no full stop.
    A body is taken for a circle of `body` px. What moves is taken as if it stood still.
    """
    slots, (goal, _) = seen(observation, world), target(observation, world)
    each, arcs = moves(world), _arcs(world)
    centre = slots.towards * (slots.distance + body)[..., None]
    apart = (arcs**2).sum(-1).reshape(-1, 1) + (centre**2).sum(-1)[..., None, :]
    apart = apart - 2 * (arcs.flatten(0, 1) @ centre.mT)
    hit = (apart < (body + world.drone_radius) ** 2) & ~slots.empty[..., None, :]
    free = (~hit.any(-1)).reshape(*hit.shape[:-2], *arcs.shape[:2]).cumprod(-1).float().mean(-1)
    nearer = slots.distance[..., None, :] - each.to @ slots.towards.mT
    moving = (each.distance > 0) | (each.turn != 0).any(-1)
    safe = moving & ((nearer > world.drone_radius + MARGIN) | slots.empty[..., None, :]).all(-1)
    angle = torch.rad2deg((goal @ each.heading.T).clamp(-1, 1).acos())
    worth = heading * (1 - angle / 180) + clear * free + speed * each.distance / world.distances[-1]
    return torch.where(safe, worth, -torch.inf).argmax(-1)


def _velocities(axes: int) -> Tensor:
    """Velocities to choose among [V, axes] px a step: three speeds in all directions."""
    angles = [torch.arange(0, 360, 10.0 if axes == 2 else 20.0), torch.arange(-60, 61, 20.0)][: axes - 1]
    directions = ahead(torch.cartesian_prod(*angles).reshape(-1, axes - 1))
    return torch.cat([speed * directions for speed in (3, 6, 9)])


VELOCITIES = {axes: _velocities(axes) for axes in (2, 3)}


def orca(
    observation: Tensor,
    generator: torch.Generator | None = None,
    world: World = SENSING,
    horizon: float = 8.0,
    body: float = 100.0,
) -> Tensor:
    """Optimal reciprocal collision avoidance (van den Berg et al. 2011), among bodies that do not avoid.

    Each body, taken for a circle of `body` px with the velocity that is sensed, allows a half-plane of
    velocities with which the drone does not touch it within `horizon` steps, their sec. 4: the drone takes
    all of u upon itself, and its own velocity is the wished one (their sec. 5.2). It wants the allowed
    velocity nearest to the wish, or else the one that is least deep in what is forbidden (sec. 5.3).

    Raises:
        ConfigError: no velocities are sensed.
    """
    if not getattr(world, "sense_velocity", False):
        raise ConfigError(
            "orca: no velocities are in this task's observation; give --task moving, or compare it with "
            "a run of task=moving world.sense_velocity=true"
        )
    slots, (goal, away) = seen(observation, world), target(observation, world)
    wish = goal * away.clamp(max=world.distances[-1])[..., None]
    place = slots.towards * (slots.distance + body)[..., None]
    radius = body + world.drone_radius
    normal, least = half_space(place, slots.velocity, wish[..., None, :], radius, horizon)
    choices = VELOCITIES[len(world.size)]
    inside = _inside(choices, normal, least, slots.empty)
    off = (choices - wish[..., None, :]).norm(dim=-1)
    best = torch.where(inside >= 0, 1e3 - off, inside).argmax(-1)
    forbidden = (-_inside(moves(world).to, normal, least, slots.empty)).clamp(min=0)
    return steer(choices[best], world, forbidden=forbidden)


def half_space(
    place: Tensor, velocity: Tensor, wish: Tensor, radius: float, horizon: float
) -> tuple[Tensor, Tensor]:
    """The velocities v [..., axes] with normal . v >= least: none comes closer than radius within horizon.

    place [..., axes] px of a body's centre, its velocity, and the wished one [px a step]. Its boundary is
    where the velocity obstacle's is nearest to the wish; as RVO2-3D has it.
    """
    relative = wish - velocity
    square, along, speed = (place**2).sum(-1), (place * relative).sum(-1), (relative**2).sum(-1)
    cut = relative - place / horizon
    behind = (cut * place).sum(-1)
    on_disc = (behind < 0) & (behind**2 > radius**2 * (cut**2).sum(-1))
    beside = (square * speed - along**2) / (square - radius**2).clamp(min=1)
    root = (along**2 - square * (speed - beside)).clamp(min=0).sqrt()
    share = torch.where(on_disc, 1 / horizon, (along + root) / square)
    out = relative - share[..., None] * place
    normal = out / out.norm(dim=-1, keepdim=True).clamp(min=1e-6)
    return normal, ((wish - out) * normal).sum(-1) + radius * share


def _inside(velocities: Tensor, normal: Tensor, least: Tensor, empty: Tensor) -> Tensor:
    """How far velocities [V, axes] are within all half-planes, at the least [..., V] px a step."""
    return torch.where(empty[..., None], 1e3, normal @ velocities.T - least[..., None]).amin(-2)
