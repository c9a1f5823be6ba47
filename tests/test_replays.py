"""Recorded episodes of policies written by hand: what a page holds is what a slow episode, one by one,
gives.
"""

import numpy as np
import pytest
import torch
from replaying import MAX_STEPS, STAY, STRAIGHT, as_stepped, few_layouts, of_folder, recorded, stepped, unpack
from runs_by_hand import write_policies

from uavnav.report import studies
from uavnav.report.configurations import collect
from uavnav.runs import POLICY
from uavnav.tasks import layouts, sensing, space
from uavnav.tasks.goal import Goal
from uavnav.tasks.sensing import sense
from uavnav.tasks.table import make_task
from uavnav.tasks.world import World
from uavnav.views import replays
from uavnav.views.replays import paths, record, together


@pytest.fixture(scope="module", autouse=True)
def _few_layouts():
    with few_layouts():
        yield


@pytest.fixture(scope="module", params=["ppo", "dqn"])
def run(request, tmp_path_factory):
    """Seed 4 flies by a random network, seed 5 straight on, seed 6 not at all."""
    folder = tmp_path_factory.mktemp("replays") / request.param
    return write_policies(folder / "run", request.param, seed=4, prefer=[(1, STRAIGHT), (2, STAY)])


@pytest.fixture(scope="module")
def data(run):
    return recorded(run.parent)


def test_poses_are_within_half_tenth_of_pixel_of_slow_episode_and_values_within_half_of_a_63rd_of_their_range(
    run, data
):
    (configuration,) = data["configurations"]
    assert [(episode["seed"], episode["layout"]) for episode in configuration["episodes"]] == [
        (seed, layout) for seed in (4, 5, 6) for layout in (0, 1, 2)
    ]
    reasons, chosen = set(), set()
    for seed in (4, 5, 6):
        expected = stepped(run, seed, 3)
        for episode in (one for one in configuration["episodes"] if one["seed"] == seed):
            poses, choices, ended = expected[episode["layout"]]
            as_stepped(episode, data["fields"], poses, choices, ended)
            reasons.add(ended)
            chosen |= {*choices[:, 0]}
    assert reasons == {"collision", "truncated"}
    assert len(chosen) > 5


def test_values_are_probabilities_of_ppo_and_q_of_dqn(run, data):
    (configuration,) = data["configurations"]
    found = unpack(configuration["episodes"][3], data["fields"])
    if configuration["algorithm"] == "ppo":
        assert configuration["values"] == "probability"
        assert found["high"] == pytest.approx(1.0)
    else:
        assert configuration["values"] == "Q value"
        assert found["high"] == pytest.approx(50.0)
    assert (found["value"][:, STRAIGHT] == 1.0).all()


def test_straight_on_is_nine_pixels_a_step_upwards_and_staying_is_cut_off(tmp_path):
    write_policies(tmp_path / "run", prefer=[(0, STRAIGHT), (1, STAY)], n_seeds=2)
    data = recorded(tmp_path, n_layouts=1)
    straight, stay = data["configurations"][0]["episodes"]
    found = unpack(straight, data["fields"])
    assert found["y"][:, 0] == pytest.approx(300 + 9 * np.arange(straight["steps"] + 1))
    assert set(found["heading"][:, 0]) == {90}
    assert straight["ended"] == "collision"
    assert found["clearance"][-1] <= 30 < found["clearance"][-2]
    assert straight["reward"] == pytest.approx(0.09 * (straight["steps"] - 1) - 10)
    assert (stay["ended"], stay["steps"], stay["reward"]) == ("truncated", MAX_STEPS, -0.6)


def test_the_player_gets_the_world_the_obstacles_and_what_each_action_does(data):
    assert (data["world"]["width"], data["world"]["sensor_radius"], data["world"]["n_slots"]) == (
        800,
        120.0,
        10,
    )
    assert torch.tensor(data["layouts"]).sub(layouts.load("test")[:3]).abs().max() <= 0.0051
    assert data["actions"][STAY] == [0, 0]
    assert data["actions"][STRAIGHT] == [0, 9]
    assert data["actions"][53] == [5, 3]
    assert data["actions"][99] == [-1, 9]
    assert data["left_out"] == []


def test_1000_steps_take_less_than_150_kb_of_text(run, data):
    # of the random network, in which most changes from step to step
    episodes = data["configurations"][0]["episodes"][:3]
    assert sum(len(episode["bytes"]) for episode in episodes) < 150 * sum(
        episode["steps"] for episode in episodes
    )


def test_policies_that_cannot_be_loaded_are_named_and_the_next_seeds_fly(tmp_path):
    for seed in (0, 1, 2, 3):
        write_policies(tmp_path / f"run-{seed}", seed=seed, n_seeds=1, prefer=[(0, STRAIGHT)])
    write_policies(tmp_path / "other", "dqn", n_seeds=2)
    (tmp_path / "run-0" / POLICY).write_bytes(b"no policy")
    (tmp_path / "run-2" / POLICY).unlink()
    (tmp_path / "other" / POLICY).unlink()
    data = recorded(tmp_path, n_seeds=2, n_layouts=1)
    (configuration,) = data["configurations"]
    assert [episode["seed"] for episode in configuration["episodes"]] == [1, 3]
    other, damaged, missing = sorted(data["left_out"])  # one line for both seeds of `other`
    assert "other: no policy.safetensors there" in other
    assert "run-0/policy.safetensors: not a readable policy file" in damaged
    assert "run-2: no policy.safetensors there" in missing


def test_a_seed_flies_the_same_whatever_the_others_are(tmp_path):
    write_policies(tmp_path / "two" / "run", seed=4, n_seeds=2)
    (two,) = recorded(tmp_path / "two", n_layouts=2)["configurations"]
    (one,) = recorded(tmp_path / "two", n_layouts=2, n_seeds=1)["configurations"]
    assert one["episodes"] == two["episodes"][:2]


def test_each_of_3_configurations_flies_in_a_batch_as_it_flies_alone(tmp_path):
    write_policies(tmp_path / "a", seed=4, n_seeds=2)
    write_policies(tmp_path / "b", seed=4, n_seeds=2, reward="initial")
    write_policies(tmp_path / "c", "dqn", seed=5, n_seeds=2)
    # the first and the last are of one world and reward
    configurations = [of_folder(tmp_path / name)[0] for name in "abc"]
    together = record(configurations, n_seeds=2, n_layouts=2, max_steps=MAX_STEPS)["configurations"]
    alone = [
        record([configuration], n_seeds=2, n_layouts=2, max_steps=MAX_STEPS)["configurations"][0]
        for configuration in configurations
    ]
    assert together == alone
    assert (
        len({episode["bytes"] for configuration in together for episode in configuration["episodes"]}) == 12
    )


def test_a_random_start_heading_is_that_of_the_set_of_obstacles(tmp_path):
    write_policies(tmp_path / "run", n_seeds=2, world={"start_heading": "random", "slots": "listed"})
    data = recorded(tmp_path, n_layouts=3)
    first = [
        unpack(episode, data["fields"])["heading"][0, 0] for episode in data["configurations"][0]["episodes"]
    ]
    assert first[:3] == first[3:]
    assert len(set(first)) == 3


def test_obstacles_that_move_are_where_they_were_at_each_step_whether_or_not_velocities_are_sensed(tmp_path):
    write_policies(tmp_path / "plain", task="moving", n_seeds=1, world={"speed_max": 4.0})
    write_policies(
        tmp_path / "sensed",
        task="moving",
        n_seeds=1,
        world={"speed_max": 4.0, "sense_velocity": True},
        n_inputs=50,
    )
    data = recorded(tmp_path, n_layouts=2)
    assert len(data["configurations"]) == 2
    for configuration in data["configurations"]:
        place = configuration["place"]
        task = make_task("test", place["world"], task=place["task"])
        sensed = ", sense_velocity=True" * place["world"]["sense_velocity"]
        assert place["title"] == f"moving obstacles, speed_max=4.0{sensed}"
        assert torch.equal(torch.tensor([one["circles"] for one in place["layouts"]]), task.layouts[:2])
        for episode in configuration["episodes"]:
            found = {name: torch.tensor(part) for name, part in unpack(episode, data["fields"]).items()}
            n = episode["steps"] + 1
            state = task.start(torch.full((n,), episode["layout"]), found["heading"][:, 0].long())
            state = state._replace(
                x=found["x"][:, 0].float(), y=found["y"][:, 0].float(), steps=torch.arange(n)
            )
            slots, clearance = sense(state.x, state.y, state.heading, task.obstacles(state), task.world)
            assert (clearance - found["clearance"][:, 0]).abs().max() < 0.2
            clear = (slots[..., 0, 2] - found["proximity"][:, 0]).abs() < 0.01  # of the nearest in view
            assert clear.float().mean() > 0.95


@pytest.mark.parametrize(("task", "n_inputs"), [("space", 40), ("space-moving", 40), ("space-moving", 70)])
def test_in_3d_a_drone_is_sensed_and_clear_as_where_its_poses_say(tmp_path, task, n_inputs):
    world = {"sense_velocity": True} if n_inputs == 70 else {}
    write_policies(tmp_path / "run", task=task, world=world, n_seeds=1, n_inputs=n_inputs)
    (configuration,) = recorded(tmp_path, n_layouts=2)["configurations"]
    place = configuration["place"]
    own = make_task("test", place["world"], task=task)
    assert torch.equal(torch.tensor([one["circles"] for one in place["layouts"]]), own.layouts[:2])
    assert place["actions"][:6] == [[0, 0, 0], [0, 0, 3], [0, 0, 6], [0, 0, 9], [0, 2, 0], [0, 2, 3]]
    for episode in configuration["episodes"]:
        found = {name: torch.tensor(part) for name, part in unpack(episode, place["fields"]).items()}
        n = episode["steps"] + 1
        state = own.start(torch.full((n,), episode["layout"]), found["heading"][:, 0].long())
        where = {axis: found[axis][:, 0].float() for axis in "xyz"}
        state = state._replace(**where, pitch=found["pitch"][:, 0].long(), steps=torch.arange(n))
        scan, clearance = space.scan(state, own.obstacles(state), own.world)
        slots = sensing.encode(scan, own.world)
        assert (clearance - found["clearance"][:, 0]).abs().max() < 0.3
        shown = torch.stack([found[name][:, 0] for name in ("right", "up", "forward", "proximity")], -1)
        assert ((slots[:, 0] - shown).abs().amax(-1) < 0.02).float().mean() > 0.95  # of the nearest in view


def test_an_episode_to_its_goal_ends_there_and_one_of_a_memory_with_faults_says_so(tmp_path, monkeypatch):
    write_policies(tmp_path / "goal", task="goal", n_seeds=1, n_inputs=33, prefer=[(0, STRAIGHT)])
    write_policies(tmp_path / "late", stack=2, faults={"late": 1}, n_seeds=1, n_inputs=60)
    above = torch.tensor([[[400.0, 520.0, 180.0]]])
    monkeypatch.setattr(
        replays,
        "_layouts",
        lambda task, split: above if isinstance(task.task, Goal) else layouts.load(split)[:30],
    )
    goal, late = recorded(tmp_path, n_layouts=1)["configurations"]
    (episode,) = goal["episodes"]
    assert (episode["ended"], episode["steps"]) == ("goal", 20)
    assert episode["reward"] == pytest.approx(10 + 0.01 * 180, abs=0.01)
    assert goal["place"]["layouts"] == [{"circles": [], "goal": [400, 520]}]
    assert late["place"]["title"] == "late=1, stack=2"


def test_a_run_trained_on_a_rung_is_shown_on_the_rungs_own_test_sets(tmp_path):
    write_policies(tmp_path / "paper", n_seeds=1)
    for rung in ("slalom-100", "density-20"):
        write_policies(tmp_path / rung, n_seeds=2, layouts=f"{rung}/train")
    data = recorded(tmp_path, n_layouts=2)
    found = {
        configuration["place"]["title"] if "place" in configuration else "": configuration
        for configuration in data["configurations"]
    }
    assert {*found} == {"", "slalom-100", "density-20"}
    for rung, configuration in found.items():
        all_layouts = layouts.load(f"{rung}/test" if rung else "test")[:2].double()
        shown = [one["circles"] for one in configuration["place"]["layouts"]] if rung else data["layouts"]
        for circles, rows in zip(shown, all_layouts, strict=True):
            assert np.allclose(circles, rows[rows[:, 0] >= 0], atol=0.01)
        for episode in configuration["episodes"]:
            poses = unpack(episode, data["fields"])
            x, y, heading = (torch.from_numpy(poses[name][:, 0]) for name in ("x", "y", "heading"))
            circles = all_layouts[episode["layout"]].expand(len(x), -1, -1)
            clearance = sense(x, y, heading.long(), circles, World())[1]
            assert np.allclose(poses["clearance"][:, 0], clearance, atol=0.3)


def test_on_a_rung_among_moving_obstacles_a_drone_flies_among_those_that_are_shown(tmp_path):
    write_policies(tmp_path / "run", task="moving", n_seeds=1, layouts="density-20/train")
    data = recorded(tmp_path, n_layouts=2)
    (configuration,) = data["configurations"]
    task = make_task("density-20/test", task="moving")
    shown = torch.tensor([one["circles"] for one in configuration["place"]["layouts"]])
    assert torch.equal(shown, task.layouts[:2])
    for episode in configuration["episodes"]:
        start = task.start(torch.tensor(episode["layout"]), torch.tensor(90))
        clearance = unpack(episode, data["fields"])["clearance"][0, 0]
        assert clearance == pytest.approx(float(task.observe(start)[1]), abs=0.06)


def test_a_world_that_the_player_does_not_draw_is_named_with_what_draws_it(tmp_path, monkeypatch):
    path = write_policies(tmp_path / "run", task="moving", n_seeds=1)
    monkeypatch.delitem(replays.TITLES, "moving")
    data = recorded(tmp_path, n_layouts=1)
    assert data["configurations"] == []
    assert data["left_out"] == [
        f"{path}: a page has no replays of task=moving; uavnav render makes a film of it"
    ]


@pytest.mark.parametrize(
    ("changes", "action"),
    [({"n_slots": 5}, 9), ({"sensor_arc": 90.0}, 9), ({"n_turns": 61, "n_distances": 5}, 304)],
)
def test_a_world_with_other_constants_is_drawn_and_packed_as_it_is(tmp_path, changes, action):
    world = World(**changes)
    sizes = {"n_inputs": 3 * world.n_slots, "n_actions": world.n_actions, "prefer": [(0, action)]}
    write_policies(tmp_path / "run", n_seeds=1, world=changes, **sizes)
    (configuration,) = recorded(tmp_path, n_layouts=1)["configurations"]
    place = configuration["place"]
    assert place["title"] == ", ".join(f"{name}={value}" for name, value in changes.items())
    assert place["world"] == world.model_dump()
    found = unpack(configuration["episodes"][0], place["fields"])  # and no byte is left
    assert found["value"].shape[1] == len(place["actions"]) == world.n_actions
    assert found["right"].shape[1] == world.n_slots
    assert {*found["action"][:, 0]} >= {action}


def test_a_report_records_configurations_of_other_worlds_beside_the_papers(tmp_path):
    write_policies(tmp_path / "here", n_seeds=1)
    write_policies(tmp_path / "moving", task="moving", n_seeds=1)
    write_policies(tmp_path / "noise", faults={"noise": 5.0}, n_seeds=1)
    (write_policies(tmp_path / "rows alone", task="goal", n_seeds=1) / POLICY).unlink()
    configurations, _ = collect([tmp_path])
    found = {configuration.runs[0].path.name for configuration in studies.elsewhere(configurations)}
    assert found == {"moving", "noise"}


def test_episodes_side_by_side_are_the_first_seeds_and_the_scripted_poses_on_the_same_obstacles(run, data):
    (configuration,) = data["configurations"]
    label = f"{configuration['algorithm'].upper()} {configuration['label']}"
    shown = together(data, {label: "mine", "PPO nobody": "nobody"}, "reactive")
    assert [drone["name"] for drone in shown["drones"]] == ["mine", "reactive"]
    assert [len(drone["episodes"]) for drone in shown["drones"]] == [3, 3]
    order = [episode["layout"] for episode in shown["drones"][0]["episodes"]]
    assert order == [episode["layout"] for episode in shown["drones"][1]["episodes"]]
    assert shown["layouts"] == [data["layouts"][at] for at in order]
    lengths = [episode["steps"] for episode in shown["drones"][0]["episodes"]]
    assert lengths == sorted(lengths)  # where a policy collides first, the scripted policy is seen to fly on
    for drone, episodes in zip(shown["drones"], (configuration["episodes"], data["scripted"]), strict=True):
        for episode in drone["episodes"]:
            (whole,) = [
                one
                for one in episodes
                if (one["seed"], one["layout"]) == (episode["seed"], episode["layout"])
            ]
            kept, before = unpack(episode, shown["fields"]), unpack(whole, data["fields"])
            assert "action" not in kept
            assert all((kept[name] == before[name]).all() for name in kept)
            assert len(episode["bytes"]) < len(whole["bytes"])
        path = paths(shown, 5)[drone["name"]]
        first = unpack(drone["episodes"][0], shown["fields"])
        assert path == pytest.approx(np.hstack([first["x"], first["y"]])[:6])


def test_reactive_flies_as_baselines_say_it_does(data):
    for episode in data["scripted"]:
        found = unpack(episode, data["fields"])
        assert set(found["action"][:, 0]) <= {STRAIGHT, 50}
        assert (episode["ended"], episode["steps"]) == ("truncated", MAX_STEPS)
