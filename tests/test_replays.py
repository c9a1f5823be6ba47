"""Recorded flights of policies written by hand: what a page holds is what a slow flight, one by one, gives."""

import numpy as np
import pytest
import torch
from replaying import MAX_STEPS, STAY, STRAIGHT, as_flown, few_sets, flown, recorded, unpack
from runs_by_hand import write_policies

from uavnav.report import replays, studies
from uavnav.report.cells import collect
from uavnav.report.replays import paths, record, together
from uavnav.runs import POLICY
from uavnav.tasks import layouts, space
from uavnav.tasks.sensing import sense
from uavnav.tasks.simulator import Goal, make_task
from uavnav.tasks.world import World


@pytest.fixture(scope="module", autouse=True)
def _few_sets():
    with few_sets():
        yield


@pytest.fixture(scope="module", params=["ppo", "dqn"])
def run(request, tmp_path_factory):
    """Seed 4 flies by a random network, seed 5 straight on, seed 6 not at all."""
    folder = tmp_path_factory.mktemp("replays") / request.param
    return write_policies(folder / "run", request.param, seed=4, prefer=[(1, STRAIGHT), (2, STAY)])


@pytest.fixture(scope="module")
def data(run):
    return recorded(run.parent)


def test_poses_are_within_half_a_tenth_of_a_pixel_of_a_slow_flight_and_values_within_half_of_a_63rd_of_their_range(
    run, data
):
    (cell,) = data["cells"]
    assert [(flight["seed"], flight["layout"]) for flight in cell["flights"]] == [
        (seed, layout) for seed in (4, 5, 6) for layout in (0, 1, 2)
    ]
    reasons, chosen = set(), set()
    for seed in (4, 5, 6):
        expected = flown(run, seed, 3)
        for flight in (one for one in cell["flights"] if one["seed"] == seed):
            poses, choices, ended = expected[flight["layout"]]
            as_flown(flight, data["fields"], poses, choices, ended)
            reasons.add(ended)
            chosen |= {*choices[:, 0]}
    assert reasons == {"collision", "cut off"}
    assert len(chosen) > 5


def test_values_are_probabilities_of_ppo_and_q_of_dqn(run, data):
    (cell,) = data["cells"]
    found = unpack(cell["flights"][3], data["fields"])
    if cell["algorithm"] == "ppo":
        assert cell["values"] == "probability"
        assert found["high"] == pytest.approx(1.0)
    else:
        assert cell["values"] == "Q value"
        assert found["high"] == pytest.approx(50.0)
    assert (found["value"][:, STRAIGHT] == 1.0).all()


def test_straight_on_is_nine_pixels_a_step_upwards_and_staying_is_cut_off(tmp_path):
    write_policies(tmp_path / "run", prefer=[(0, STRAIGHT), (1, STAY)], n_seeds=2)
    data = recorded(tmp_path, n_layouts=1)
    straight, stay = data["cells"][0]["flights"]
    found = unpack(straight, data["fields"])
    assert found["y"][:, 0] == pytest.approx(300 + 9 * np.arange(straight["steps"] + 1))
    assert set(found["heading"][:, 0]) == {90}
    assert straight["ended"] == "collision"
    assert found["clearance"][-1] <= 30 < found["clearance"][-2]
    assert straight["reward"] == pytest.approx(0.09 * (straight["steps"] - 1) - 10)
    assert (stay["ended"], stay["steps"], stay["reward"]) == ("cut off", MAX_STEPS, -0.6)


def test_the_player_gets_the_world_the_obstacles_and_what_each_action_does(data):
    assert (data["world"]["width"], data["world"]["sensor_radius"], data["world"]["n_slots"]) == (800, 120.0, 10)
    assert torch.tensor(data["layouts"]).sub(layouts.load("test")[:3]).abs().max() <= 0.0051
    assert data["actions"][STAY] == [0, 0]
    assert data["actions"][STRAIGHT] == [0, 9]
    assert data["actions"][53] == [5, 3]
    assert data["actions"][99] == [-1, 9]
    assert data["left_out"] == []


def test_1000_steps_take_less_than_150_kb_of_text(run, data):
    flights = data["cells"][0]["flights"][:3]  # of the random network, in which most changes from step to step
    assert sum(len(flight["bytes"]) for flight in flights) < 150 * sum(flight["steps"] for flight in flights)


def test_policies_that_cannot_be_loaded_are_named_and_the_next_seeds_fly(tmp_path):
    for seed in (0, 1, 2, 3):
        write_policies(tmp_path / f"run-{seed}", seed=seed, n_seeds=1, prefer=[(0, STRAIGHT)])
    write_policies(tmp_path / "other", "dqn", n_seeds=2)
    (tmp_path / "run-0" / POLICY).write_bytes(b"no policy")
    (tmp_path / "run-2" / POLICY).unlink()
    (tmp_path / "other" / POLICY).unlink()
    data = recorded(tmp_path, n_seeds=2, n_layouts=1)
    (cell,) = data["cells"]
    assert [flight["seed"] for flight in cell["flights"]] == [1, 3]
    other, damaged, missing = sorted(data["left_out"])  # one line for both seeds of `other`
    assert "other: no policy.safetensors there" in other
    assert "run-0/policy.safetensors: not a readable policy file" in damaged
    assert "run-2: no policy.safetensors there" in missing


def test_a_seed_flies_the_same_whatever_the_others_are(tmp_path):
    write_policies(tmp_path / "two" / "run", seed=4, n_seeds=2)
    (two,) = recorded(tmp_path / "two", n_layouts=2)["cells"]
    (one,) = recorded(tmp_path / "two", n_layouts=2, n_seeds=1)["cells"]
    assert one["flights"] == two["flights"][:2]


def test_each_of_3_cells_flies_in_a_batch_as_it_flies_alone(tmp_path):
    write_policies(tmp_path / "a", seed=4, n_seeds=2)
    write_policies(tmp_path / "b", seed=4, n_seeds=2, reward="initial")
    write_policies(tmp_path / "c", "dqn", seed=5, n_seeds=2)
    cells = [collect([tmp_path / name])[0][0] for name in "abc"]  # the first and the last are of one world and reward
    together = record(cells, n_seeds=2, n_layouts=2, max_steps=MAX_STEPS)["cells"]
    alone = [record([cell], n_seeds=2, n_layouts=2, max_steps=MAX_STEPS)["cells"][0] for cell in cells]
    assert together == alone
    assert len({flight["bytes"] for cell in together for flight in cell["flights"]}) == 12


def test_a_random_start_heading_is_that_of_the_set_of_obstacles(tmp_path):
    write_policies(tmp_path / "run", n_seeds=2, world={"start_heading": "random", "slots": "listed"})
    data = recorded(tmp_path, n_layouts=3)
    first = [unpack(flight, data["fields"])["heading"][0, 0] for flight in data["cells"][0]["flights"]]
    assert first[:3] == first[3:]
    assert len(set(first)) == 3


def test_obstacles_that_move_are_where_they_were_at_each_step_whether_or_not_velocities_are_sensed(tmp_path):
    write_policies(tmp_path / "plain", task="moving", n_seeds=1, world={"speed_max": 4.0})
    write_policies(
        tmp_path / "sensed", task="moving", n_seeds=1, world={"speed_max": 4.0, "sense_velocity": True}, n_inputs=50
    )
    data = recorded(tmp_path, n_layouts=2)
    assert len(data["cells"]) == 2
    for cell in data["cells"]:
        place = cell["place"]
        task = make_task("test", place["world"], task=place["task"])
        assert place["title"] == "moving obstacles"
        assert torch.equal(torch.tensor([one["circles"] for one in place["sets"]]), task.bank[:2])
        for flight in cell["flights"]:
            found = {name: torch.tensor(part) for name, part in unpack(flight, data["fields"]).items()}
            n = flight["steps"] + 1
            state = task.place(torch.full((n,), flight["layout"]), found["heading"][:, 0].long())
            state = state._replace(x=found["x"][:, 0].float(), y=found["y"][:, 0].float(), steps=torch.arange(n))
            slots, clearance = sense(state.x, state.y, state.heading, task.obstacles(state), task.world)
            assert (clearance - found["clearance"][:, 0]).abs().max() < 0.2
            clear = (slots[..., 0, 2] - found["proximity"][:, 0]).abs() < 0.01  # of the nearest in view
            assert clear.float().mean() > 0.95


@pytest.mark.parametrize(("task", "n_inputs"), [("space", 40), ("space-moving", 40), ("space-moving", 70)])
def test_in_3d_a_drone_is_sensed_and_clear_as_where_its_poses_say(tmp_path, task, n_inputs):
    world = {"sense_velocity": True} if n_inputs == 70 else {}
    write_policies(tmp_path / "run", task=task, world=world, n_seeds=1, n_inputs=n_inputs)
    (cell,) = recorded(tmp_path, n_layouts=2)["cells"]
    place = cell["place"]
    own = make_task("test", place["world"], task=task)
    assert torch.equal(torch.tensor([one["circles"] for one in place["sets"]]), own.bank[:2])
    assert place["actions"][:6] == [[0, 0, 0], [0, 0, 3], [0, 0, 6], [0, 0, 9], [0, 2, 0], [0, 2, 3]]
    for flight in cell["flights"]:
        found = {name: torch.tensor(part) for name, part in unpack(flight, place["fields"]).items()}
        n = flight["steps"] + 1
        state = own.place(torch.full((n,), flight["layout"]), found["heading"][:, 0].long())
        where = {axis: found[axis][:, 0].float() for axis in "xyz"}
        state = state._replace(**where, pitch=found["pitch"][:, 0].long(), steps=torch.arange(n))
        slots, clearance = space.sense(state, own.obstacles(state), own.world)
        assert (clearance - found["clearance"][:, 0]).abs().max() < 0.3
        shown = torch.stack([found[name][:, 0] for name in ("right", "up", "forward", "proximity")], -1)
        assert ((slots[:, 0] - shown).abs().amax(-1) < 0.02).float().mean() > 0.95  # of the nearest in view


def test_a_flight_to_its_goal_ends_there_and_one_of_a_memory_with_faults_says_so(tmp_path, monkeypatch):
    write_policies(tmp_path / "goal", task="goal", n_seeds=1, n_inputs=33, prefer=[(0, STRAIGHT)])
    write_policies(tmp_path / "late", stack=2, faults={"late": 1}, n_seeds=1, n_inputs=60)
    above = torch.tensor([[[400.0, 520.0, 180.0]]])
    monkeypatch.setattr(
        replays, "_bank", lambda task, sets="test": above if isinstance(task, Goal) else layouts.load("test")
    )
    goal, late = recorded(tmp_path, n_layouts=1)["cells"]
    (flight,) = goal["flights"]
    assert (flight["ended"], flight["steps"]) == ("goal", 20)
    assert flight["reward"] == pytest.approx(10 + 0.01 * 180, abs=0.01)
    assert goal["place"]["sets"] == [{"circles": [], "goal": [400, 520]}]
    assert late["place"]["title"] == "late=1, stack=2"


def test_a_run_trained_on_a_rung_is_shown_on_the_rungs_own_test_sets(tmp_path):
    write_policies(tmp_path / "paper", n_seeds=1)
    for rung in ("slalom-100", "density-20"):
        write_policies(tmp_path / rung, n_seeds=2, layouts=f"{rung}/train")
    data = recorded(tmp_path, n_layouts=2)
    found = {cell["place"]["title"] if "place" in cell else "": cell for cell in data["cells"]}
    assert {*found} == {"", "slalom-100", "density-20"}
    for rung, cell in found.items():
        bank = layouts.load(f"{rung}/test" if rung else "test")[:2].double()
        shown = [one["circles"] for one in cell["place"]["sets"]] if rung else data["layouts"]
        assert np.allclose(shown, bank, atol=0.01)
        for flight in cell["flights"]:
            poses = unpack(flight, data["fields"])
            x, y, heading = (torch.from_numpy(poses[name][:, 0]) for name in ("x", "y", "heading"))
            circles = bank[flight["layout"]].expand(len(x), -1, -1)
            clearance = sense(x, y, heading.long(), circles, World())[1]
            assert np.allclose(poses["clearance"][:, 0], clearance, atol=0.3)


def test_a_world_that_the_player_does_not_draw_is_named_with_what_draws_it(tmp_path, monkeypatch):
    path = write_policies(tmp_path / "run", task="moving", n_seeds=1)
    monkeypatch.delitem(replays.TITLES, "moving")
    data = recorded(tmp_path, n_layouts=1)
    assert data["cells"] == []
    assert data["left_out"] == [f"{path}: a page has no replays of task=moving; uavnav render makes a film of it"]


def test_a_report_records_cells_of_other_worlds_beside_the_papers(tmp_path):
    write_policies(tmp_path / "here", n_seeds=1)
    write_policies(tmp_path / "moving", task="moving", n_seeds=1)
    write_policies(tmp_path / "noise", faults={"noise": 5.0}, n_seeds=1)
    (write_policies(tmp_path / "rows alone", task="goal", n_seeds=1) / POLICY).unlink()
    cells, _ = collect([tmp_path])
    found = {cell.runs[0].path.name for cell in studies.elsewhere(cells)}
    assert found == {"moving", "noise"}


@pytest.mark.parametrize("counts", [{"n_seeds": 0}, {"n_layouts": 0}, {"n_layouts": 1001}, {"max_steps": 0}])
def test_counts_that_make_no_sense_are_refused(counts):
    with pytest.raises(ValueError, match="give whole numbers from 1, and at most 1000 layouts"):
        record([], **counts)


def test_flights_side_by_side_are_the_first_seeds_and_the_rules_poses_on_the_same_obstacles(run, data):
    (cell,) = data["cells"]
    label = f"{cell['algorithm'].upper()} {cell['label']}"
    shown = together(data, {label: "mine", "PPO nobody": "nobody"}, "rule")
    assert [drone["name"] for drone in shown["drones"]] == ["mine", "rule"]
    assert [len(drone["flights"]) for drone in shown["drones"]] == [3, 3]
    order = [flight["layout"] for flight in shown["drones"][0]["flights"]]
    assert order == [flight["layout"] for flight in shown["drones"][1]["flights"]]
    assert shown["layouts"] == [data["layouts"][at] for at in order]
    lengths = [flight["steps"] for flight in shown["drones"][0]["flights"]]
    assert lengths == sorted(lengths)  # where a policy collides first, the rule is seen to fly on
    for drone, flights in zip(shown["drones"], (cell["flights"], data["rule"]), strict=True):
        for flight in drone["flights"]:
            (whole,) = [one for one in flights if (one["seed"], one["layout"]) == (flight["seed"], flight["layout"])]
            kept, before = unpack(flight, shown["fields"]), unpack(whole, data["fields"])
            assert "action" not in kept
            assert all((kept[name] == before[name]).all() for name in kept)
            assert len(flight["bytes"]) < len(whole["bytes"])
        path = paths(shown, 5)[drone["name"]]
        first = unpack(drone["flights"][0], shown["fields"])
        assert path == pytest.approx(np.hstack([first["x"], first["y"]])[:6])


def test_the_rule_flies_as_baselines_say_it_does(data):
    for flight in data["rule"]:
        found = unpack(flight, data["fields"])
        assert set(found["action"][:, 0]) <= {STRAIGHT, 50}
        assert (flight["ended"], flight["steps"]) == ("cut off", MAX_STEPS)
