"""A goal to fly to among circles that stand still: where goals are, how far the shortest way is, what a
layout file contains.

A layout has its circles, and as its last row (x, y, shortest): the goal, and how long the shortest way there
is.
Letters: B the batch shape, K circles of a layout.
"""

from __future__ import annotations

import functools
import itertools
import math
from typing import Any

import numpy as np
import torch
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from uavnav.errors import told
from uavnav.settings import key
from uavnav.tasks import circles
from uavnav.tasks.circles import LayoutError
from uavnav.tasks.protocol import DEFAULT_K, LIMITS
from uavnav.tasks.rewards import REWARDS, Step, Terms
from uavnav.tasks.sensing import Scan, clearance, to_drone_frame
from uavnav.tasks.state import State
from uavnav.tasks.task import Task
from uavnav.tasks.world import Number, Size, World

ROOM = 60.0  # [px] from a goal to the edge of every circle and of the border, at least
FAR = 200.0  # [px] from the start to a goal, at least
GRID = 5  # [px] between the places of which shortest ways consist
TRIES = 100  # goals of a layout, before another one is drawn
GOALS = 2
"""The stream of a layout file's goals; its circles have another."""
SCALE = 1000.0
"""[px] A goal so far away, or farther, is seen at distance 1."""

Array = np.ndarray[Any, np.dtype[Any]]


class GoalWorld(World):
    """The paper's arena, drone and sensor, and a goal.

    Raises:
        ConfigError: as of `World`.
    """

    goal_radius: Size = key(40.0, "within which the drone's centre has reached the goal", "px")
    goal_reward: Number = key(10.0, "for reaching the goal", "reward")

    @property
    def observation_low(self) -> tuple[float, ...]:
        """The least of each number: of the slots, then of the direction to the goal and its distance."""
        return (*super().observation_low, -1.0, -1.0, 0.0)


MOST = 100
"""Layouts that are tried for a goal, at most."""


def generate(n: int, k: int = DEFAULT_K, seed: int = 0, world: World | None = None) -> Tensor:
    """The circles that the same arguments give `circles.generate`, each layout with a goal.

    A goal is uniform over the places at least 60 px from every edge and 200 px from the start that can be
    reached: else another is drawn, and after 100 goals other circles.

    Returns:
        Tensor [n, k + 1, 3] float32: (x, y, radius) of the circles, then (x, y, shortest) of the goal, in px.

    Raises:
        LayoutError: n, k or seed is negative, the goal is smaller than the grid of ways, or none can be
            reached.
    """
    world = circles.of_kind(GoalWorld, world)
    if world.goal_radius < GRID:
        raise LayoutError(
            f"goal_radius={world.goal_radius:g}: ways are measured from place to place; give {GRID} px"
        )
    all_circles = circles.generate(n, k, seed, world).numpy()
    found = np.empty((n, k + 1, 3), dtype=np.float32)
    for index, drawn in enumerate(all_circles):
        rng = np.random.Generator(np.random.PCG64([seed, GOALS, index]))
        standing = drawn
        for _ in range(MOST):
            if (goal := _draw_goal(standing, rng, world)) is not None:
                break
            standing = circles.generate(1, k, int(rng.integers(2**31)), world)[0].numpy()
        else:
            raise LayoutError(
                f"goal_radius={world.goal_radius:g}: no goal could be reached in {MOST} layouts; give more px"
            )
        found[index, :k], found[index, k] = standing, goal
    return torch.from_numpy(found)


def validate(layouts: Tensor, world: World | None = None) -> None:
    """As `circles.validate`; and every goal has room around it, and a way that is long enough.

    Raises:
        LayoutError: naming the first layout that is wrong.
    """
    world = circles.of_kind(GoalWorld, world)
    if not isinstance(layouts, Tensor):
        raise LayoutError(f"{told(layouts)}: is no tensor of layouts; give a tensor")
    if layouts.ndim != 3 or layouts.shape[1] == 0:
        raise LayoutError(f"layouts have the shape [n > 0, k + 1, 3], not {list(layouts.shape)}")
    circles.validate(layouts[:, :-1], world)
    goal = layouts[:, -1].double().cpu().numpy()
    standing = layouts[:, :-1].cpu().numpy()
    room = _room(goal[:, None, :2], standing, world)[:, 0]
    away = np.hypot(*(goal[:, :2] - np.array(world.start)).T)
    for wrong, problem in (
        (~np.isfinite(goal).all(-1), "is not finite"),
        (room < ROOM - 1e-3, f"is nearer than {ROOM:g} px to an edge"),
        (away < FAR - 1e-3, f"is nearer than {FAR:g} px to the start"),
        (goal[:, 2] < 0, "has a way of less than 0 px"),
    ):
        if wrong.any():
            raise LayoutError(f"the goal of layout {np.argwhere(wrong)[0][0]} {problem}")


def shortest_ways(standing: Array, world: World) -> Array:
    """Lengths of the shortest ways from the start to each place of the grid [columns, rows] px; infinite: no
    way.

    A way leads from place to place, each to 16 neighbours, over places where the drone keeps more than its
    radius of clearance; there is none from a start without it. standing: circles [K, 3] px.
    """
    places, (near, far), length = _grid(world.width, world.height)
    free = _room(places, standing, world) > world.drone_radius
    kept = free[near] & free[far]
    number = np.cumsum(free) - 1  # places that are not free have no row
    ways = csr_array((length[kept], (number[near[kept]], number[far[kept]])), shape=(int(free.sum()),) * 2)
    lengths = np.full(len(places), np.inf)
    columns, rows = world.width // GRID + 1, world.height // GRID + 1
    start = round(world.start[0] / GRID) * rows + round(world.start[1] / GRID)
    if free[start]:
        lengths[free] = dijkstra(ways, directed=False, indices=number[start])
    return lengths.reshape(columns, rows)


def _draw_goal(standing: Array, rng: np.random.Generator, world: GoalWorld) -> Array | None:
    """(x, y, shortest) of a goal among circles [K, 3], or None where none of 100 can be reached."""
    drawn = rng.random((20 * TRIES, 2)) * np.array(world.size)
    drawn = drawn.astype(np.float32).astype(np.float64)
    far = np.hypot(*(drawn - np.array(world.start)).T) >= FAR
    goals = drawn[far & (_room(drawn, standing, world) >= ROOM)][:TRIES]
    if not len(goals):
        return None
    places, lengths = _grid(world.width, world.height)[0], shortest_ways(standing, world).ravel()
    there = np.isfinite(lengths)
    for goal in goals:
        within = there & (np.hypot(*(places - goal).T) <= world.goal_radius)
        if within.any():
            return np.array([*goal, lengths[within].min()])
    return None


def _room(places: Array, standing: Array, world: World) -> Array:
    """Distance [..., P] px from places [..., P, 2] to the nearest edge of circles [..., K, 3] or a border."""
    x, y = np.moveaxis(places, -1, 0)
    inner = world.border
    border = np.minimum(
        np.minimum(x - inner, world.width - inner - x), np.minimum(y - inner, world.height - inner - y)
    )
    offset = places[..., None, :] - standing[..., None, :, :2].astype(np.float64)
    edges = np.hypot(offset[..., 0], offset[..., 1]) - standing[..., None, :, 2]
    return np.asarray(np.minimum(border, edges.min(-1, initial=np.inf)))


@functools.lru_cache(maxsize=2)
def _grid(width: int, height: int) -> tuple[Array, tuple[Array, Array], Array]:
    """Places [P, 2] px, pairs of neighbours (index, index) [E] each once, and the px between them [E]."""
    columns, rows = width // GRID + 1, height // GRID + 1
    index = np.arange(columns * rows).reshape(columns, rows)
    places = GRID * np.stack(np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij"), -1).reshape(
        -1, 2
    )
    near, far, length = [], [], []
    for dx, dy in itertools.product(range(3), range(-2, 3)):
        if math.gcd(dx, dy) != 1 or (dx == 0 and dy < 0):
            continue
        low, high = max(-dy, 0), rows - max(dy, 0)
        near.append(index[: columns - dx, low:high].ravel())
        far.append(index[dx:, low + dy : high + dy].ravel())
        length.append(np.full(near[-1].size, GRID * math.hypot(dx, dy)))
    return places.astype(np.float64), (np.concatenate(near), np.concatenate(far)), np.concatenate(length)


class Goal(Task):
    """The paper's task with a place to fly to: an episode ends there, at a collision, or after 1,000 steps.

    The last row of a layout is (x, y) of the goal and the length of the shortest way.
    """

    WORLD = GoalWorld
    REWARD = "goal"
    MAX_STEPS = LIMITS["goal"]
    STATIC = True
    world: GoalWorld

    def obstacles(self, state: State) -> Tensor:
        """Where the obstacles of each row are: [*B, K, 3] px."""
        return self.layouts[state.layout][..., :-1, :]

    def to_goal(self, state: State) -> tuple[Tensor, Tensor, Tensor]:
        """From the drone to its goal: dx, dy and distance, each [*B] px."""
        place = self.layouts[state.layout][..., -1, :]
        dx, dy = place[..., 0] - state.x, place[..., 1] - state.y
        return dx, dy, torch.sqrt(dx * dx + dy * dy)

    def encode(self, state: State, found: Scan) -> Tensor:
        """Eq. (13), then the goal's direction, right and forward, and its distance / 1,000 px, at most 1."""
        dx, dy, distance = self.to_goal(state)
        scale = torch.where(distance > 0, 1 / distance, 0.0)
        right, forward = to_drone_frame(dx * scale, dy * scale, state.heading)
        ahead = [right.clamp(-1, 1), forward.clamp(-1, 1), (distance / SCALE).clamp(max=1)]
        return torch.cat([super().encode(state, found), torch.stack(ahead, -1)], -1)

    def judge(self, step: Step) -> tuple[Tensor, Terms]:
        """Over at a collision or at the goal."""
        before, after = self.to_goal(step.before)[-1], self.to_goal(step.after)[-1]
        terms = REWARDS[self.reward](step._replace(to_goal=(before, after)))
        return step.collided | (after <= self.world.goal_radius), terms

    def succeeded(self, state: State) -> Tensor:
        """Whether each row's drone has reached its goal, without a collision: [*B] bool."""
        near = clearance(state.x, state.y, self.obstacles(state), self.world)
        return (self.to_goal(state)[-1] <= self.world.goal_radius) & (near > self.world.drone_radius)

    def info(self, state: State) -> dict[str, Tensor]:
        """As of the paper's task, and where the goal is and whether it is reached."""
        place = self.layouts[state.layout][..., -1, :]
        facts = {"goal_x": place[..., 0], "goal_y": place[..., 1], "succeeded": self.succeeded(state)}
        return super().info(state) | facts

    def marks(self, state: State) -> Tensor:
        """The goal: [*B, 1, 3] px."""
        place = self.layouts[state.layout][..., -1:, :2]
        return torch.cat([place, torch.full_like(place[..., :1], self.world.goal_radius)], -1)

    def measure(self, before: State, after: State) -> dict[str, Tensor]:
        """`succeeded` at the step that reaches the goal, and once an episode its shortest way [px]."""
        shortest = torch.where(before.steps == 0, self.layouts[before.layout][..., -1, 2], 0.0)
        return {"succeeded": self.succeeded(after).long(), "shortest": shortest * (after.steps > 0)}
