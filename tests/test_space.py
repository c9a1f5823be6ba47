"""The worlds in 3D: sensing, motion, collision and reward against slow loops and closed forms."""

import functools
import math

import numpy as np
import oracle
import pytest
import space_by_hand as by_hand
import torch
from scipy import stats

import uavnav
from uavnav.cli import commands
from uavnav.tasks import layouts, moving, space
from uavnav.tasks.space import SpaceMovingWorld, SpaceWorld
from uavnav.tasks.table import make_task

write_layouts = functools.partial(commands.run, "layouts")

SENSED = {"sense_velocity": True}


@pytest.fixture(scope="module")
def splits():
    return {
        "space": layouts.load("test", SpaceWorld()),
        "space-moving": layouts.load("test", SpaceMovingWorld()),
    }


def pose(state, row):
    place = state.x[row].item(), state.y[row].item(), state.z[row].item()
    return place, state.heading[row].item(), state.pitch[row].item()


def random_states(task, n, seed=5):
    """Poses over the box and a little beyond, all headings and pitches, at any moment."""
    generator = torch.Generator().manual_seed(seed)
    layout, yaw = (torch.randint(most, (n,), generator=generator) for most in (len(task.layouts), 360))
    x, y, z = (size * torch.rand(n, generator=generator) for size in task.world.size)
    pitch, steps = (
        torch.randint(-45, 46, (n,), generator=generator),
        torch.randint(300, (n,), generator=generator),
    )
    return task.task.start(layout, yaw)._replace(x=x, y=y, z=z, pitch=pitch, steps=steps)


# -- what is sensed ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["space", "space-moving"])
def test_what_is_sensed_at_5000_poses_and_moments_equals_a_slow_loop_by_every_switch(splits, name):
    n, every = 5000, [(more, drawn) for more in ({}, SENSED) for drawn in oracle.SWITCHES]
    every = every[:4] if name == "space" else every
    tasks = [make_task(splits[name], more | drawn, task=name) for more, drawn in every]
    state = random_states(tasks[0], n)
    poses = [pose(state, row) for row in range(n)]
    found = [
        by_hand.look(*one, set_) for one, set_ in zip(poses, tasks[0].obstacles(state).tolist(), strict=True)
    ]
    kept = [row for row in range(n) if not by_hand.doubtful(found[row])]
    assert len(kept) > 0.9 * n
    for (more, drawn), task in zip(every, tasks, strict=True):
        observation, clearance = task.observe(state)
        assert clearance.tolist() == pytest.approx([*map(by_hand.clearance_of, found)], abs=3e-4)
        velocities = task.velocities(state).tolist() if more else [None] * n
        expected = [by_hand.slots_of(found[row], velocities[row], *poses[row][1:], **drawn) for row in kept]
        torch.testing.assert_close(observation[kept], torch.tensor(expected).flatten(1), rtol=0, atol=3e-5)
        assert observation.shape == (n, 70 if more else 40)
        low = torch.tensor(task.world.observation_low)
        assert ((observation >= low) & (observation <= 1)).all()


def test_a_sphere_ahead_above_and_to_the_right_fills_the_numbers_that_say_so():
    spheres = [[400.0, 400.0, 300.0, 40.0], [400.0, 300.0, 400.0, 30.0], [500.0, 300.0, 300.0, 50.0]]
    task = make_task(torch.tensor([spheres]), task="space")
    slots = task.observe(by_hand.at(task, (400, 300, 300), 90, 0))[0].reshape(10, 4)
    expected = [[1, 0, 0, 20 / 90], [0, 0, 1, 30 / 90], [0, 1, 0, 40 / 90], [0, 0, 0, 1]]
    torch.testing.assert_close(slots[:4], torch.tensor(expected))
    climbing = task.observe(by_hand.at(task, (400, 300, 300), 90, 45))[0].reshape(10, 4)
    half = math.sqrt(0.5)
    torch.testing.assert_close(climbing[1:3, :3], torch.tensor([[0, -half, half], [0, half, half]]))


@pytest.mark.parametrize(
    ("place", "yaw", "pitch", "slot"),
    [
        ((100, 300, 300), 180, 0, (0, 0, 1, 50 / 90)),
        ((760, 300, 300), 0, 0, (0, 0, 1, 0)),
        ((400, 550, 300), 0, 0, (-1, 0, 0, 0)),
        ((400, 300, 570), 0, 0, (0, 1, 0, 0)),
        ((400, 300, 10), 0, 0, (0, -1, 0, 0)),
        ((400, 300, 95), 90, -45, (0, -math.sqrt(0.5), math.sqrt(0.5), 0.5)),
    ],
)
def test_a_wall_is_its_nearest_point_and_beyond_it_at_distance_0_outwards(place, yaw, pitch, slot):
    task = make_task(torch.empty(1, 0, 4), task="space")
    seen, clearance = task.observe(by_hand.at(task, place, yaw, pitch))
    torch.testing.assert_close(seen[:4], torch.tensor([float(one) for one in slot]))
    assert torch.equal(seen[4:].reshape(9, 4), torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(9, 4))
    gaps = [min(p - 20, size - 20 - p) for p, size in zip(place, by_hand.BOX, strict=True)]
    assert clearance.item() == max(min(gaps), 0)


def test_at_a_height_of_its_own_and_level_a_slot_is_that_of_the_papers_world_bit_for_bit():
    n, generator = 200, torch.Generator().manual_seed(3)
    circles = layouts.load("test")[:n]
    flat = torch.cat([circles[..., :2], torch.full((n, 8, 1), 300.0), circles[..., 2:]], -1)
    ours, paper = make_task(flat, task="space"), make_task(circles)
    yaw, layout = torch.randint(360, (n,), generator=generator), torch.arange(n)
    x, y = 200 + 400 * torch.rand(n, generator=generator), 200 + 200 * torch.rand(n, generator=generator)
    seen = ours.observe(ours.start(layout, yaw)._replace(x=x, y=y))[0].reshape(n, 10, 4)
    expected = paper.observe(paper.start(layout, yaw)._replace(x=x, y=y))[0].reshape(n, 10, 3)
    assert torch.equal(seen[..., [0, 2, 3]], expected)  # where no wall is in reach
    assert not seen[..., 1].any()


# -- how it flies --------------------------------------------------------------------------------------------


def test_the_100_actions_ask_for_five_yaws_five_pitches_and_four_distances():
    action = torch.arange(100)
    found = torch.stack(space.decode(action, SpaceWorld()), -1).tolist()
    assert found == [[*by_hand.decode(one)] for one in range(100)]
    assert len({*map(tuple, found)}) == SpaceWorld().n_actions == 100


@pytest.mark.parametrize(("asks", "up"), [(2 * 4, 1), (4 * 4, -1)])
def test_it_begins_level_at_the_centre_its_pitch_stops_at_45_and_asking_for_more_is_a_penalised_turn(
    asks, up
):
    task = make_task(torch.empty(1, 0, 4), task="space")
    state = task.start(torch.tensor(0), torch.tensor(90))
    assert (state.x, state.y, state.z, state.heading, state.pitch) == (400, 300, 300, 90, 0)
    for n in range(1, 15):
        state, outcome = task.step(state, torch.tensor(asks))
        assert (state.pitch.item(), state.turns.item()) == (up * min(4 * n, 45), n)
        assert outcome.reward.item() == -0.01
    state, outcome = task.step(state, torch.tensor(3))
    assert (state.pitch.item(), state.turns.item()) == (up * 45, 14)
    assert outcome.reward.item() == pytest.approx(0.09)
    half = 9 * math.sqrt(0.5)
    assert (state.y.item(), state.z.item()) == pytest.approx((300 + half, 300 + up * half))


# -- layouts -------------------------------------------------------------------------------------------------


def test_the_three_splits_have_40_spheres_a_set_uniform_in_the_box_and_velocities_uniform_over_directions():
    found = []
    for split, (n, seed) in layouts.SPLITS.items():
        all_layouts, header = layouts.read(split, SpaceWorld())
        moved, told = layouts.read(split, SpaceMovingWorld())
        assert (all_layouts.shape, moved.shape) == ((n, 40, 4), (n, 40, 7))
        assert torch.equal(moved[..., :4], all_layouts)
        assert (header["task"], header["k"], header["generator_seed"]) == ("space", "40", str(seed))
        assert (told["task"], told["speed_max"]) == ("space-moving", "2.0")
        found.append(moved[:1000].reshape(-1, 7))
    x, y, z, radius, *velocity = torch.cat(found).double().T.numpy()
    away = np.sqrt((x - 400) ** 2 + (y - 300) ** 2 + (z - 300) ** 2)
    assert (away - radius).min() >= 50
    far = (y < 100) | (y > 500)  # where the safe zone takes nothing away
    assert stats.kstest(x[far], stats.uniform(0, 800).cdf).pvalue > 0.01
    assert stats.kstest(z[(x < 200) | (x > 600)], stats.uniform(0, 600).cdf).pvalue > 0.01
    speed = np.linalg.norm(velocity, axis=0)
    assert stats.kstest(speed, stats.uniform(0, 2).cdf).pvalue > 0.01
    for part in velocity:  # Archimedes: each coordinate of a uniform direction is uniform
        assert stats.kstest(part / speed, stats.uniform(-1, 2).cdf).pvalue > 0.01


def test_spheres_fill_about_as_much_of_the_box_as_the_papers_circles_of_the_window():
    generator = torch.Generator().manual_seed(0)
    task, paper = make_task("validation", task="space"), make_task("validation")
    state = random_states(task, 20_000)
    x, y = (torch.rand(20_000, generator=generator) * size for size in (800, 600))
    flat = paper.start(torch.arange(20_000) % 1000, torch.zeros(20_000, dtype=torch.int64))._replace(x=x, y=y)

    def filled(obstacles, place):
        away = (obstacles[..., :-1] - torch.stack(place, -1)[:, None]).norm(dim=-1)
        return (away < obstacles[..., -1]).any(-1).double().mean().item()

    spheres = filled(task.obstacles(state), (state.x, state.y, state.z))
    assert spheres == pytest.approx(filled(paper.obstacles(flat), (x, y)), abs=0.05)


def test_after_a_thousand_steps_100_spheres_are_where_a_loop_that_bounces_them_has_them(splits):
    where, how = moving.motion(splits["space-moving"][:3], torch.full((3,), 1000), SpaceMovingWorld())
    expected = [by_hand.drift(rows, 1000) for rows in splits["space-moving"][:3].double().tolist()]
    places, velocities = (torch.tensor([[one[part] for one in row] for row in expected]) for part in (0, 1))
    torch.testing.assert_close(where, places, rtol=0, atol=1e-4)
    torch.testing.assert_close(how, velocities, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["space", "space-moving"])
def test_files_of_spheres_are_what_their_seed_generates_and_fly_in_their_world_alone(name, tmp_path, capsys):
    assert write_layouts(["--task", name, "--n", "5", "--split", "test", "--out", str(tmp_path)]) == 0
    path = tmp_path / f"{name}-test.safetensors"
    assert write_layouts(["--check", str(path)]) == 0
    assert "5 layouts of 40 obstacles" in capsys.readouterr().out
    assert make_task(path, task=name).layouts.shape[:2] == (5, 40)
    with pytest.raises(
        uavnav.LayoutError, match=f"a layout file of task={name}, not of task=drone; give one of those"
    ):
        make_task(path)
