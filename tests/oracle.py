"""The world once more, slowly: shared/world.md in scalar float64 and plain Python. It imports nothing of uavnav.

Candidates are (d, x, y): distance in px of the nearest point, its direction's components to the right and forward.
"""

import itertools
import math

WIDTH, HEIGHT, SIDE = 800, 600, 20
SENSOR, DRONE, SLOTS = 120, 30, 10
START = (400, 300)
BEHIND = -1e-6

SQUARES = (
    [(20 * i, 0) for i in range(40)]
    + [(20 * i, 580) for i in range(40)]
    + [(0, 20 * j) for j in range(1, 29)]
    + [(780, 20 * j) for j in range(1, 29)]
)


def cosine(heading):
    return {0: 1.0, 90: 0.0, 180: -1.0, 270: 0.0}.get(heading, math.cos(math.radians(heading)))


def sine(heading):
    return {0: 0.0, 90: 1.0, 180: 0.0, 270: -1.0}.get(heading, math.sin(math.radians(heading)))


def look(x, y, heading, circles):
    """Every circle, then every border square, in index order, in view or not."""
    cos, sin = cosine(heading), sine(heading)
    found = []
    for cx, cy, radius in circles:
        dx, dy = cx - x, cy - y
        distance = math.sqrt(dx * dx + dy * dy)
        ux, uy = (dx / distance, dy / distance) if distance > 0 else (0.0, 0.0)
        found.append((distance - radius, ux * sin - uy * cos, ux * cos + uy * sin))
    for left, bottom in SQUARES:
        dx = min(max(x, left), left + SIDE) - x
        dy = min(max(y, bottom), bottom + SIDE) - y
        d = math.sqrt(dx * dx + dy * dy)
        ux, uy = (dx / d, dy / d) if d > 0 else (0.0, 0.0)
        found.append((d, ux * sin - uy * cos, ux * cos + uy * sin))
    return found


def distances(x, y, circles):
    """From a place to the edge of every circle, then of every border square [px]."""
    return [c[0] for c in look(x, y, 90, circles)]


def clearance(x, y, circles):
    return min(distances(x, y, circles))


def in_view(candidate):
    return candidate[0] <= SENSOR and candidate[2] >= BEHIND


def triple(candidate):
    d, x, y = candidate
    return min(max(x, -1.0), 1.0), min(max(y, 0.0), 1.0), min(max((d - DRONE) / (SENSOR - DRONE), 0.0), 1.0)


def slots_of(found, slots="nearest", padding="far"):
    seen = [c for c in found if in_view(c)]
    if slots == "nearest":
        seen.sort(key=lambda c: c[0])  # stable: ties keep their index order
    filled = [triple(c) for c in seen[:SLOTS]]
    empty = (0.0, 0.0, 1.0) if padding == "far" else (0.0, 0.0, 0.0)
    return filled + [empty] * (SLOTS - len(filled))


def clearance_of(found):
    return min(c[0] for c in found)


def sense(x, y, heading, circles, slots="nearest", padding="far"):
    found = look(x, y, heading, circles)
    return slots_of(found, slots, padding), clearance_of(found)


def doubtful(found):
    """Whether float32 may rightly decide otherwise: within 1e-3 px of a threshold or a tie but not exactly on it."""
    if 0 < abs(clearance_of(found) - DRONE) < 1e-3:
        return True
    for d, _, y in found:
        if d < SENSOR + 1e-3 and y > -1e-5 and (0 < abs(d - SENSOR) < 1e-3 or 0 < abs(y) < 1e-5):
            return True
    ranked = sorted((c for c in found if in_view(c)), key=lambda c: c[0])[: SLOTS + 1]
    for a, b in itertools.pairwise(ranked):
        if 0 < b[0] - a[0] < 1e-3 and any(abs(p - q) > 1e-5 for p, q in zip(triple(a), triple(b), strict=True)):
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


class Flight:
    """One drone through the sets of a bank: the whole of an episode, and what follows it."""

    def __init__(self, bank, layout=0, heading=90, variant="eq14", max_steps=None):
        self.bank, self.variant, self.max_steps = bank, variant, max_steps
        self.begin(layout, heading)

    def begin(self, layout, heading=90):
        self.layout = layout % len(self.bank)
        (self.x, self.y), self.heading = START, heading
        self.steps = self.stops = self.full_stops = self.turns = self.distance = 0
        self.total = 0.0
        self.terminated = self.truncated = False
        self.sense()

    def sense(self):
        self.found = look(self.x, self.y, self.heading, self.bank[self.layout])
        self.slots, self.clearance = slots_of(self.found), clearance_of(self.found)
        return self.slots

    def at(self, x, y):
        """Take over a place that float32 rounded, so that its error does not build up over an episode."""
        assert math.hypot(x - self.x, y - self.y) < 1e-4, (x, y, self.x, self.y)
        self.x, self.y = x, y
        return self.sense()

    def step(self, action):
        turn, distance = decode(action)
        self.x, self.y, self.heading = move(self.x, self.y, self.heading, turn, distance)
        self.sense()
        self.terminated = self.clearance <= DRONE
        self.reward = reward(turn, distance, self.terminated, self.variant)
        self.steps += 1
        self.stops += distance == 0
        self.full_stops += distance == 0 and turn == 0
        self.turns += turn != 0
        self.distance += distance
        self.total += self.reward
        self.truncated = self.steps == self.max_steps and not self.terminated
        return self.slots, self.reward, self.terminated, self.truncated

    def next_episode(self):
        self.begin(self.layout + 1)
