"""Recorded episodes as a player of a page reads them, beside slow episodes in plain numbers."""

import base64
import json
import zlib
from unittest import mock

import numpy as np
import pytest
import torch

from uavnav.envs import scalar
from uavnav.report.configurations import collect
from uavnav.runs.policies import load_policy
from uavnav.tasks import layouts
from uavnav.views.replays import Trained, record

STRAIGHT, STAY = 9, 0  # actions
MAX_STEPS = 60
EPISODES = 30


def few_layouts():
    """Within, episodes are recorded beside those of 30 layouts: 200 take most of the time."""
    return mock.patch("uavnav.views.replays.EPISODES", EPISODES)


def of_folder(folder):
    """What flies of a folder's runs."""
    return [Trained(one.algorithm, one.activation, one.runs) for one in collect([folder])[0]]


def recorded(folder, **counts):
    """The dict of a folder's runs, as a page reads it: out of text."""
    return json.loads(json.dumps(record(of_folder(folder), max_steps=MAX_STEPS, **counts)))


def unpack(episode, fields):
    """What the player does: each field as [steps (+ 1), columns]."""
    content, found = zlib.decompress(base64.b64decode(episode["bytes"])), {}
    for field in fields:
        rows = episode["steps"] + (not field["chosen"])
        kind = np.dtype(field["type"]).newbyteorder("<")
        part, content = np.split(np.frombuffer(content, np.uint8), [rows * field["columns"] * kind.itemsize])
        found[field["name"]] = part.view(kind).reshape(field["columns"], rows).T * field["unit"]
    assert not len(content)
    return found


def stepped(path, seed, n_layouts):
    """The same episodes, each drone in plain numbers and beside those of all layouts, as an evaluation flies
    them.

    Lists of poses and of choices, a layout.
    """
    policy = load_policy(path, seed, greedy=False)
    generator = torch.Generator().manual_seed(seed)
    task = policy.task.on(layouts.load("test")[:EPISODES], MAX_STEPS)
    drones = [scalar.fly(task) for _ in range(EPISODES)]
    seen = {layout: drone.start(layout, 90) for layout, drone in enumerate(drones)}
    poses, choices = ({place: [] for place in range(EPISODES)} for _ in range(2))
    ended, total = {}, [0.0] * EPISODES

    def note(layout, observation):
        drone = drones[layout]
        numbers = (drone.x, drone.y, drone.heading, drone.clearance, total[layout])
        poses[layout].append((*numbers, *observation.reshape(10, 3).T.flatten()))

    for layout, observation in seen.items():
        note(layout, observation)
    while seen:
        observations = torch.tensor(np.stack(list(seen.values())))
        values = policy.values(observations)
        values = values.softmax(-1) if policy.acts == "categorical" else values
        actions = policy(observations, generator)
        for layout, action, row in zip(list(seen), actions.tolist(), values.numpy(), strict=True):
            choices[layout].append((action, *row))
            seen[layout], reward, collided, at_limit = drones[layout].step(action)
            total[layout] += reward
            note(layout, seen[layout])
            if collided or at_limit:
                ended[layout] = "collision" if collided else "truncated"
                del seen[layout]
    return {
        place: (np.array(poses[place]), np.array(choices[place]), ended[place]) for place in range(n_layouts)
    }


def as_stepped(episode, fields, poses, choices, ended):
    """Compare an episode of a page with one in plain numbers: the poses, the actions, and the values
    behind them.
    """
    found = unpack(episode, fields)
    assert episode["steps"] == len(choices) == len(poses) - 1
    assert episode["ended"] == ended
    kept = np.hstack([found[name] for name in ("x", "y", "heading", "clearance", "reward")])
    tolerance = np.array([0.05, 0.05, 0, 0.05, 1e-4]) + 1e-4
    assert (np.abs(kept - poses[:, :5]) <= tolerance).all()
    assert np.abs(found["right"] - poses[:, 5:15]).max() <= 0.5 / 127 + 1e-4
    assert np.abs(found["forward"] - poses[:, 15:25]).max() <= 0.5 / 255 + 1e-4
    assert np.abs(found["proximity"] - poses[:, 25:]).max() <= 0.5 / 255 + 1e-4
    assert episode["reward"] == pytest.approx(poses[-1, 4], abs=0.006)
    assert (found["action"][:, 0] == choices[:, 0]).all()
    span = found["high"] - found["low"]
    assert (span > 0).all()
    assert (np.abs(found["low"] + found["value"] * span - choices[:, 1:]) <= (0.5 / 63) * span + 1e-5).all()
