"""The world once more, slowly: docs/environment.md in scalar float64 and plain Python. It imports nothing of
uavnav.

Candidates are (d, x, y): distance in px of the nearest point, its direction's components to the right and
forward.
"""

import itertools
import math
from typing import NamedTuple

START = (400, 300)
BEHIND = 1e-6
# of what is sensed
SWITCHES = [
    {},
    {"slots": "listed"},
    {"padding": "zeros"},
    {"slots": "listed", "padding": "zeros"},
]


class Arena(NamedTuple):
    """What is around the drone, and what of it its sensor covers; the defaults are the paper's."""

    width: int = 800
    height: int = 600
    side: int = 20
    sensor: float = 120
    drone: float = 30
    slots: int = 10
    arc: float = 180
    trained: float | None = None  # where a proximity is 1, if that is not the sensor's reach

    def squares(self):
        """Lower left corners of the border's squares in index order."""
        columns, rows, side = self.width // self.side, self.height // self.side, self.side
        return (
            [(side * i, 0) for i in range(columns)]
            + [(side * i, self.height - side) for i in range(columns)]
            + [(0, side * j) for j in range(1, rows - 1)]
            + [(self.width - side, side * j) for j in range(1, rows - 1)]
        )

    @property
    def edge(self):
        """The forward component of a direction at the edge of view, exactly 0 for half a turn."""
        return round(math.cos(math.radians(self.arc / 2)), 12)


PAPER = Arena()
SQUARES = PAPER.squares()


def cosine(heading):
    return {0: 1.0, 90: 0.0, 180: -1.0, 270: 0.0}.get(heading, math.cos(math.radians(heading)))


def sine(heading):
    return {0: 0.0, 90: 1.0, 180: 0.0, 270: -1.0}.get(heading, math.sin(math.radians(heading)))


def look(x, y, heading, circles, arena=PAPER):
    """Every circle, then every border square, in index order, in view or not."""
    cos, sin = cosine(heading), sine(heading)
    found = []
    for cx, cy, radius in circles:
        dx, dy = cx - x, cy - y
        distance = math.sqrt(dx * dx + dy * dy)
        ux, uy = (dx / distance, dy / distance) if distance > 0 else (0.0, 0.0)
        found.append((distance - radius, ux * sin - uy * cos, ux * cos + uy * sin))
    for left, bottom in SQUARES if arena is PAPER else arena.squares():
        dx = left - x if x < left else min(left + arena.side - x, 0.0)
        dy = bottom - y if y < bottom else min(bottom + arena.side - y, 0.0)
        d = math.sqrt(dx * dx + dy * dy)
        ux, uy = (dx / d, dy / d) if d > 0 else (0.0, 0.0)
        found.append((d, ux * sin - uy * cos, ux * cos + uy * sin))
    return found


def in_view(found, arena=PAPER):
    """Which candidates are."""
    edge = arena.edge - BEHIND
    return [index for index, (d, _, y) in enumerate(found) if d <= arena.sensor and y >= edge]


def triple(candidate, arena=PAPER):
    d, x, y = candidate
    proximity = (d - arena.drone) / ((arena.trained or arena.sensor) - arena.drone)
    return min(max(x, -1.0), 1.0), min(max(y, 0.0), 1.0), min(max(proximity, 0.0), 1.0)


def slots_of(
    found, slots="nearest", padding="far", arena=PAPER, velocities=None, heading=90, fastest=2.0, hear=None
):
    """The slots of what `look` found; with velocities (vx, vy) of the circles, each with two numbers more.

    hear: of a slot's place and its true distance, the distance that comes back, or None of a lost echo.
    """
    cos, sin = cosine(heading), sine(heading)
    moves, filled = velocities is not None, []
    empty = (0.0, 0.0, float(padding == "far")) + (0.0, 0.0) * moves
    for nth, index in enumerate(_sensed(found, slots, arena)):
        distance = hear(nth, found[index][0]) if hear else found[index][0]
        vx, vy = velocities[index] if moves and index < len(velocities) and fastest else (0.0, 0.0)
        own = (vx * sin - vy * cos, vx * cos + vy * sin) if moves else ()
        shares = (min(max(part / (fastest or 1), -1.0), 1.0) for part in own)
        filled.append(empty if distance is None else (*triple((distance, *found[index][1:]), arena), *shares))
    return filled + [empty] * (arena.slots - len(filled))


def _sensed(found, slots, arena):
    """Which candidates fill the slots, in order."""
    seen = in_view(found, arena)
    if slots == "nearest":
        seen.sort(key=lambda index: found[index][0])  # stable: ties keep their index order
    return seen[: arena.slots]


def clearance_of(found):
    return min(c[0] for c in found)


def doubtful(found, arena=PAPER):
    """Whether float32 may rightly decide otherwise: within 1e-3 px of a threshold or a tie but not
    exactly on it.
    """
    if 0 < abs(clearance_of(found) - arena.drone) < 1e-3:
        return True
    edge = arena.edge
    for d, _, y in found:
        near = d < arena.sensor + 1e-3 and y > edge - 1e-5
        if near and (0 < abs(d - arena.sensor) < 1e-3 or 0 < abs(y - edge) < 1e-5):
            return True
    ranked = sorted((found[index] for index in in_view(found, arena)), key=lambda c: c[0])[: arena.slots + 1]
    for a, b in itertools.pairwise(ranked):
        if 0 < b[0] - a[0] < 1e-3 and any(
            abs(p - q) > 1e-5 for p, q in zip(triple(a, arena), triple(b, arena), strict=True)
        ):
            return True
    return False


def decode(action):
    """Action 0..99 -> turn in degrees (left is positive), distance in px. Eqs (11), (12)."""
    q, distance = divmod(action, 10)
    return (q if q <= 5 else q - 10), distance


def move(x, y, heading, turn, distance):
    heading = (heading + turn) % 360
    return x + distance * cosine(heading), y + distance * sine(heading), heading


def reward(turn, distance, collided, variant="eq14"):
    if collided:
        return -10.0
    if variant == "eq14":
        return -0.01 if distance == 0 or turn != 0 else 0.01 * distance
    if variant == "additive":
        return 0.01 * distance - 0.01 * (distance == 0) - 0.01 * (turn != 0)
    if variant == "initial":
        return 0.01 * distance
    raise ValueError(variant)


def bounce(place, velocity, size, steps):
    """A coordinate that moves step by step in [0, size], and its velocity in the next moment."""
    for _ in range(steps):
        place += velocity
        while not 0 <= place <= size:
            place, velocity = (-place if place < 0 else 2 * size - place), -velocity
    inwards = (place == 0 and velocity < 0) or (place == size and velocity > 0)
    return place, -velocity if inwards else velocity


def drift(rows, steps, arena=PAPER):
    """Circles (x, y, radius, vx, vy) after so many steps: (x, y, radius) and (vx, vy) of each."""
    found = []
    for x, y, radius, vx, vy in rows:
        (x, vx), (y, vy) = bounce(x, vx, arena.width, steps), bounce(y, vy, arena.height, steps)
        found.append(((x, y, radius), (vx, vy)))
    return found


class Episode:
    """One drone through the layouts of a layout file: the whole of an episode, and what follows it.

    fastest: the speed [px a step] of which sensed velocities are shares; None where they are not sensed.
    """

    velocities = None

    def __init__(
        self, layouts, layout=0, heading=90, variant="eq14", max_steps=None, fastest=None, **switches
    ):
        self.layouts, self.variant, self.max_steps = layouts, variant, max_steps
        self.fastest, self.switches = fastest, switches
        self.begin(layout, heading)

    def begin(self, layout, heading=90):
        self.layout = layout % len(self.layouts)
        (self.x, self.y), self.heading = START, heading
        self.steps = self.stops = self.full_stops = self.turns = self.distance = 0
        self.total = 0.0
        self.terminated = self.truncated = False
        self.sense()

    def obstacles(self):
        return self.layouts[self.layout]

    def look(self):
        return look(self.x, self.y, self.heading, self.obstacles())

    def sensed(self, hear=None):
        """The slots; hear: as of `slots_of`."""
        own = {"velocities": self.velocities, "heading": self.heading, "fastest": self.fastest}
        return slots_of(self.found, **self.switches, **own, hear=hear)

    @property
    def slots(self):
        return self.sensed()

    def sense(self):
        self.found = self.look()
        self.clearance = clearance_of(self.found)

    def doubtful(self):
        return doubtful(self.found)

    def at(self, x, y):
        """Take over a place that float32 rounded, so that its error does not build up over an episode."""
        assert math.hypot(x - self.x, y - self.y) < 1e-4, (x, y, self.x, self.y)
        self.x, self.y = x, y
        self.sense()

    def fly(self, action):
        """Turn, then move: degrees and px."""
        turn, distance = decode(action)
        self.x, self.y, self.heading = move(self.x, self.y, self.heading, turn, distance)
        return turn, distance

    def judge(self, turn, distance):
        """Whether the episode is over, and what the step earned."""
        hit = self.clearance <= PAPER.drone
        return hit, reward(turn, distance, hit, self.variant)

    def step(self, action):
        turn, distance = self.fly(action)
        self.steps += 1
        self.stops += distance == 0
        self.full_stops += distance == 0 and turn == 0
        self.turns += turn != 0
        self.distance += distance
        self.sense()
        self.terminated, self.reward = self.judge(turn, distance)
        self.total += self.reward
        self.truncated = self.steps == self.max_steps and not self.terminated

    def next_episode(self):
        self.begin(self.layout + 1)


class AmongMoving(Episode):
    """The same where obstacles move."""

    drift = staticmethod(drift)

    def obstacles(self):
        now = self.drift(self.layouts[self.layout], self.steps)
        if self.fastest is not None:
            self.velocities = [velocity for _, velocity in now]
        return [obstacle for obstacle, _ in now]


class ToGoal(Episode):
    """The same with a goal, which is the last row of a set."""

    radius = 40

    def obstacles(self):
        return self.layouts[self.layout][:-1]

    def to_goal(self):
        gx, gy, _ = self.layouts[self.layout][-1]
        return gx - self.x, gy - self.y, math.hypot(gx - self.x, gy - self.y)

    def sensed(self, hear=None):
        (dx, dy, away), cos, sin = self.to_goal(), cosine(self.heading), sine(self.heading)
        return [
            *super().sensed(hear),
            ((dx * sin - dy * cos) / away, (dx * cos + dy * sin) / away, min(away / 1000, 1)),
        ]

    def doubtful(self):
        return super().doubtful() or abs(self.to_goal()[-1] - self.radius) < 1e-3

    def fly(self, action):
        self.before = self.to_goal()[-1]
        return super().fly(action)

    def judge(self, turn, distance):
        hit, away = self.clearance <= PAPER.drone, self.to_goal()[-1]
        there = away <= self.radius
        if self.variant != "goal" or hit:
            return hit or there, reward(turn, distance, hit, "eq14" if hit else self.variant)
        return there, 10.0 * there + 0.01 * (self.before - away) - 0.01 * (turn != 0 or distance == 0)
