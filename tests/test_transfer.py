"""The transfer matrix: who flies where, what is kept, and who is left out."""

import json
from pathlib import Path

import pandas as pd
import pytest
import torch
from policies_by_hand import untrained

import uavnav
from uavnav.__main__ import main
from uavnav.algorithms import ppo
from uavnav.evaluation import transfer
from uavnav.evaluation.across import of_run
from uavnav.tasks.baselines import reactive
from uavnav.tasks.moving import MovingWorld
from uavnav.tasks.table import EMPTY, make_task

SMALL = {"total_frames": 64, "n_envs": 2, "frames_per_batch": 64, "hidden": (8,), "epochs": 1}
RUNS = {
    "paper": {"n_seeds": 2},
    "moving": {"task": "moving", "world": {"speed_max": 3.0}},
    "dense": {"layouts": "density-12/train", "stack": 2},
    "far": {"world": {"sensor_radius": 160.0}, "faults": {"noise": 5.0}},
    "goal": {"task": "goal"},
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("transfer")
    return {
        name: ppo.train(ppo.PPOConfig(**SMALL, **own), folder / name, quiet=True)
        for name, own in RUNS.items()
    }


@pytest.mark.parametrize(
    ("own", "layouts", "name"),
    [
        ({}, "test", "drone"),
        ({"task": "moving"}, "test", "moving"),
        ({"task": "moving", "world": {"speed_max": 3.0}}, "test", "moving, speed_max=3.0"),
        ({}, "slalom-80/test", "slalom-80"),
        ({"faults": {"noise": 5.0}}, "density-12/test", "density-12, noise=5"),
        ({"reward": "initial"}, "test", "drone, reward=initial"),
    ],
)
def test_a_world_is_named_by_what_is_not_as_usual(own, layouts, name):
    assert transfer.named(make_task(EMPTY, **own), layouts) == name


def test_each_policy_flies_in_each_world_of_training_and_one_of_other_observations_is_left_out(
    runs, capsys, tmp_path
):
    words = ["evaluate", *(str(run.path) for run in runs.values()), "reactive", "--transfer", "--json"]
    assert main([*words, "--episodes", "2", "--max-steps", "20", "--out", str(tmp_path / "out")]) == 0
    printed, err = capsys.readouterr()
    assert (
        err == f"left out, for they have not 30 numbers to see and these 100 actions: {runs['goal'].path}\n"
    )
    worlds = ["drone", "moving, speed_max=3.0", "density-12", "drone, sensor_radius=160.0, noise=5"]
    [kept] = (tmp_path / "out").glob("transfer-2-20-*.parquet")
    rows = pd.read_parquet(kept)
    seeds = {str(run.path): len(run.seeds) for name, run in runs.items() if name != "goal"}
    assert len(rows) == 2 * len(worlds) * (2 * sum(seeds.values()) + 1)  # sets, worlds, modes and the rule
    assert [*rows["evaluated_in"].unique()] == worlds
    assert dict(zip(rows["policy"], rows["trained_in"], strict=True)) == {
        **dict(zip(seeds, worlds, strict=True)),
        "reactive": "",
    }
    said = json.loads(printed)
    assert {(one["trained_in"], one["evaluated_in"]) for one in said} == {
        (a, b) for a in (*worlds, "") for b in worlds
    }
    assert kept.with_suffix(".png").read_bytes()[:4] == b"\x89PNG"


def test_in_its_own_world_a_policy_flies_as_an_evaluation_of_its_run(runs, capsys):
    for name, layouts in (("dense", "density-12/test"), ("far", "test")):
        run = runs[name]
        own = transfer.visit(of_run(name, run), transfer.place(run, 3, 30)).query("mode == 'greedy'")
        assert (
            main(
                [
                    "evaluate",
                    str(runs[name].path),
                    "--layouts",
                    layouts,
                    "--episodes",
                    "3",
                    "--max-steps",
                    "30",
                ]
            )
            == 0
        )
        kept = pd.read_parquet(next(runs[name].path.glob("evaluation-*-3-30.parquet"))).query(
            "mode == 'greedy'"
        )
        assert own["reward"].tolist() == kept["reward"].tolist()


@pytest.mark.parametrize(("given", "limits"), [(None, (2000, 1000)), (1500, (1500, 1500)), (30, (30, 30))])
def test_a_limit_that_is_given_holds_in_every_world_and_else_that_of_each_task(given, limits, runs):
    assert tuple(transfer.place(runs[name], 1, given).task.max_steps for name in ("paper", "goal")) == limits


def test_the_figure_frames_the_world_of_training_and_says_every_number():
    rows = [
        ["a", "sampled", world, "reward", 2, value, value - 1, value + 1]
        for world, value in (("drone", 5.0), ("moving", -3.0))
    ]
    columns = ["name", "mode", "evaluated_in", "measure", "n", "value", "low", "high"]
    drawn = transfer.draw(pd.DataFrame(rows, columns=columns), {"a": "moving"})
    assert drawn.alt == "Reward per episode: a in drone 5.00; a in moving -3.00."
    axes = drawn.figure.axes[0]
    assert [text.get_text() for text in axes.texts] == ["5.00\n[4.00, 6.00]", "-3.00\n[-4.00, -2.00]"]
    (frame,) = axes.patches
    assert round(frame.get_x()) == 1


def test_sensed_velocities_stay_shares_of_the_greatest_speed_in_training(monkeypatch):
    """Trained among obstacles of up to 4 px a step, a policy senses those of 2 as halves."""
    flown = []
    monkeypatch.setattr(
        transfer.Flyer, "fly", lambda _, task, *rest: flown.append(task) or pd.DataFrame({"steps": [1]})
    )
    sensing = {"speed_max": 4.0, "sense_velocity": True}
    own = make_task(EMPTY, sensing, task="moving")
    who = transfer.Flyer("mine", {"sampled": {0: untrained(task=own, sizes=(50, 8, 100))}})
    slow = make_task("test", {"speed_min": 2.0, "speed_max": 2.0, "sense_velocity": True}, task="moving")
    transfer.visit(who, transfer.Place("slow", slow, None))
    [task] = flown
    assert torch.equal(task.layouts, slow.layouts)
    for mine, share in ((task, 0.5), (slow, 1.0)):
        seen, _ = mine.observe(mine.start(torch.arange(200), torch.full((200,), 90)))
        speeds = seen.reshape(200, 10, 5)[..., 3:].norm(dim=-1)
        assert speeds[speeds > 0].median() == pytest.approx(share, abs=1e-4)


def test_a_policy_flies_in_another_world_of_the_same_observations_and_a_scripted_policy_in_any():
    policy = uavnav.load_policy(
        Path(uavnav.__file__).parents[1] / "results" / "vectorised" / "ppo" / "tanh", seed=3
    )
    fast = MovingWorld(speed_min=6.0, speed_max=6.0)
    flown = {"episodes": 20, "max_steps": 300}
    still, moving = (uavnav.evaluate_policy(policy, world=world, **flown) for world in (None, fast))
    assert moving["steps"].mean() < 0.5 * still["steps"].mean()
    assert uavnav.evaluate_policy(reactive, task="space", **flown)["steps"].eq(300).all()
    with pytest.raises(ValueError, match="the policy sees 30 numbers, and this task has 40; give one"):
        uavnav.evaluate_policy(policy, task="space", **flown)
    with pytest.raises(ValueError, match=r"task='spcae'; did you mean space\? choose from"):
        uavnav.evaluate_policy(policy, task="spcae", **flown)
