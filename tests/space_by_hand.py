"""The worlds in 3D once more, slowly, in scalar float64: shared facts with `oracle`, and nothing of uavnav.

Candidates are (d, right, up, forward): distance [px], and the direction's components in the drone's frame.
"""

import itertools
import math

import oracle
import torch
from oracle import BEHIND, bounce, cosine, sine

BOX = 800, 600, 600
START = 400, 300, 300


def at(task, place, yaw, pitch, layout=0, steps=0):
    """A state without a batch."""
    state = task.task.start(torch.tensor(layout), torch.tensor(yaw))
    x, y, z = (torch.tensor(float(one)) for one in place)
    return state._replace(x=x, y=y, z=z, pitch=torch.tensor(pitch), steps=torch.tensor(steps))


def frame(yaw, pitch):
    """Right, up and forward."""
    cy, sy, cp, sp = cosine(yaw), sine(yaw), cosine(pitch % 360), sine(pitch % 360)
    return (sy, -cy, 0.0), (-sp * cy, -sp * sy, cp), (cp * cy, cp * sy, sp)


def inside(vector, axes):
    """A vector's components along some axes."""
    x, y, z = vector
    return tuple(x * along + y * across + z * up for along, across, up in axes)


def look(place, yaw, pitch, spheres):
    """Every sphere (x, y, z, radius), then the six walls."""
    axes, found = frame(yaw, pitch), []
    for *centre, radius in spheres:
        offset = [c - p for c, p in zip(centre, place, strict=True)]
        length = math.sqrt(sum(part * part for part in offset))
        towards = [part / length for part in offset] if length else [0.0, 0.0, 0.0]
        found.append((length - radius, *inside(towards, axes)))
    for axis, size in enumerate(BOX):
        for sign, gap in ((-1, place[axis] - 20), (1, size - 20 - place[axis])):
            outwards = [sign * (axis == one) for one in range(3)]
            found.append((max(gap, 0.0), *inside(outwards, axes)))
    return found


def in_view(candidate):
    return candidate[0] <= 120 and candidate[3] >= -BEHIND


def numbers(candidate):
    d, right, up, forward = candidate
    return right, up, min(max(forward, 0.0), 1.0), min(max((d - 30) / 90, 0.0), 1.0)


def slots_of(found, velocities=None, yaw=90, pitch=0, fastest=2.0, slots="nearest", padding="far", hear=None):
    """Ten in view; with velocities (vx, vy, vz) of the spheres, three numbers more each; hear: as of the
    oracle.
    """
    seen = [index for index, one in enumerate(found) if in_view(one)]
    if slots == "nearest":
        seen.sort(key=lambda index: found[index][0])
    axes = frame(yaw, pitch)
    filled, empty = [], (0.0, 0.0, 0.0, float(padding == "far")) + (0.0,) * (3 * (velocities is not None))
    for nth, index in enumerate(seen[:10]):
        distance, own = hear(nth, found[index][0]) if hear else found[index][0], ()
        if velocities is not None:
            velocity = velocities[index] if index < len(velocities) else (0.0, 0.0, 0.0)
            own = tuple(max(-1.0, min(1.0, part / fastest)) for part in inside(velocity, axes))
        filled.append(empty if distance is None else (*numbers((distance, *found[index][1:])), *own))
    return filled + [empty] * (10 - len(filled))


def clearance_of(found):
    return min(one[0] for one in found)


def doubtful(found):
    """Whether float32 may rightly decide otherwise: within 1e-3 px of a threshold or a tie but not
    exactly on it.
    """
    if 0 < abs(clearance_of(found) - 30) < 1e-3:
        return True
    for d, *_, forward in found:
        near = d < 120 + 1e-3 and forward > -1e-5
        if near and (0 < abs(d - 120) < 1e-3 or 0 < abs(forward) < 1e-5):
            return True
    ranked = sorted((one for one in found if in_view(one)), key=lambda one: one[0])[:11]
    return any(0 < b[0] - a[0] < 1e-3 for a, b in itertools.pairwise(ranked))


def decode(action):
    """Yaw and pitch that are asked for [degrees], distance [px]."""
    turns = 0, 2, 4, -2, -4
    return turns[action // 20], turns[action // 4 % 5], (0, 3, 6, 9)[action % 4]


def move(place, yaw, pitch, action):
    """Turn, keep the pitch within 45 degrees, then fly along f."""
    more_yaw, more_pitch, distance = decode(action)
    yaw, pitch = (yaw + more_yaw) % 360, max(-45, min(45, pitch + more_pitch))
    forward = frame(yaw, pitch)[2]
    return tuple(p + distance * part for p, part in zip(place, forward, strict=True)), yaw, pitch


def drift(rows, steps):
    """Spheres (x, y, z, radius, vx, vy, vz) after so many steps: (x, y, z, radius) and (vx, vy, vz) of
    each.
    """
    found = []
    for row in rows:
        ways = [bounce(p, v, size, steps) for p, v, size in zip(row[:3], row[4:], BOX, strict=True)]
        found.append(((*(p for p, _ in ways), row[3]), tuple(v for _, v in ways)))
    return found


class InTheBox(oracle.Episode):
    """One drone through the layouts of a layout file of spheres."""

    def begin(self, layout, heading=90):
        self.z, self.pitch = START[2], 0
        super().begin(layout, heading)

    def look(self):
        return look((self.x, self.y, self.z), self.heading, self.pitch, self.obstacles())

    def sensed(self, hear=None):
        own = self.velocities, self.heading, self.pitch, self.fastest
        return slots_of(self.found, *own, **self.switches, hear=hear)

    def doubtful(self):
        return doubtful(self.found)

    def fly(self, action):
        place = self.x, self.y, self.z
        (self.x, self.y, self.z), self.heading, self.pitch = move(place, self.heading, self.pitch, action)
        yaw, pitch, distance = decode(action)
        return abs(yaw) + abs(pitch), distance


class AmongSpheres(oracle.AmongMoving, InTheBox):
    """The same where spheres move."""

    drift = staticmethod(drift)
