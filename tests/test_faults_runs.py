"""Faults and stacks in runs: trained with, kept, resumed, flown, shown; and what older runs and policies
are.
"""

import functools
import json
import shutil

import pandas as pd
import pytest
import torch
import yaml
from policies_by_hand import always, untrained
from replaying import unpack
from runs_by_hand import write_policies
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from uavnav import evaluation, load_policy
from uavnav.algorithms import dqn, ppo
from uavnav.cli import commands
from uavnav.evaluation import episodes, evaluate_policy, evaluate_run, on
from uavnav.evaluation.verify import verify
from uavnav.report import behaviour, configurations
from uavnav.runs import Run
from uavnav.runs.export import export_policy
from uavnav.tasks import layouts
from uavnav.tasks.baselines import straight_ahead, uniform_random
from uavnav.tasks.faults import NO_FAULTS, Faults
from uavnav.tasks.table import EMPTY, make_task
from uavnav.tasks.wrapper import WrappedTask
from uavnav.training import machine, probes
from uavnav.training.config import plain
from uavnav.training.recorder import Interrupted
from uavnav.views import render, replays

fly_command = functools.partial(commands.run, "evaluate")

ALL = {"noise": 5.0, "lost": 0.2, "late": 2, "sticky": 0.25}
HOW = {
    "stack": 2,
    "faults": ALL,
    "hidden": (8,),
    "n_seeds": 2,
    "n_envs": 4,
    "compile": "off",
    "max_steps": 40,
}
CONFIGS = {
    "ppo": ppo.PPOConfig(total_frames=512, frames_per_batch=128, minibatch_size=64, epochs=1, **HOW),
    "dqn": dqn.DQNConfig(total_frames=512, learning_starts=64, frames_per_update=16, buffer_size=128, **HOW),
}


@pytest.fixture
def resumed(once):
    """`resumed(algorithm)`: a run stopped halfway and gone on with, not to be changed."""

    def run(algorithm):
        def make(folder):
            with pytest.raises(Interrupted):
                ppo.train(CONFIGS[algorithm], out=folder / "run", quiet=True, until=256)
            ppo.train(CONFIGS[algorithm], out=folder / "run", quiet=True)

        return Run(once(f"faults-{algorithm}", make) / "run")

    return run


@pytest.mark.parametrize("name", CONFIGS)
def test_a_run_with_faults_and_a_stack_resumes_bit_for_bit_and_its_policy_knows_its_task(name, resumed):
    run = resumed(name)
    verdict = verify(run, quiet=True)
    assert verdict.same, verdict.lines
    assert not any("not compared" in line for line in verdict.lines)
    assert yaml.safe_load((run.path / "config.yaml").read_text())["faults"] == ALL
    policy = load_policy(run.path, seed=1)
    assert (policy.task.stack, policy.task.faults) == (2, Faults(**ALL))
    assert policy.values(torch.zeros(3, 60)).shape == (3, 100)
    assert len(run.episodes) > 8


def test_one_training_is_evaluated_exported_and_replayed_and_its_evaluations_with_other_faults_lie_apart(
    resumed, tmp_path
):
    run = Run(shutil.copytree(resumed("ppo").path, tmp_path / "run"))
    rows = evaluate_run(run, 12, 30, quiet=True)
    plain_rows = evaluate_run(run, 12, 30, quiet=True, faults=NO_FAULTS)
    late = evaluate_run(run, 12, 30, quiet=True, faults=Faults(late=2))
    names = ["test-12-30", "test-12-30-none", "test-12-30-late=2"]
    for name in names:
        assert (run.path / f"evaluation-{name}.parquet").exists()
        assert (run.path / f"behaviour-{name}.parquet").exists()
    assert not (run.path / "evaluation.parquet").exists()
    assert late.attrs["faults"] == "late=2"
    assert "faults" not in rows.attrs
    assert not rows.equals(plain_rows)
    assert evaluate_run(run, 12, 30, quiet=True).equals(rows)
    policy = load_policy(run.path, seed=0)
    pd.testing.assert_frame_equal(
        evaluate_policy(policy, episodes=12, max_steps=30, seed=0),
        rows[(rows["mode"] == "greedy") & (rows["seed"] == 0)].drop(columns="mode").reset_index(drop=True),
    )
    assert export_policy(policy, tmp_path / "policy.pt2").exists()
    settings = configurations.read(run.path).settings
    assert (settings["stack"], settings["faults.noise"], settings["faults.late"]) == (2, 5.0, 2)


@pytest.mark.parametrize(
    ("words", "says"), [("nois=5", "did you mean noise?"), ("lost=2", "at least 0 and at most 1")]
)
def test_evaluate_refuses_wrong_faults_in_one_line(words, says, capsys):
    assert fly_command(["random", "--faults", words]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"uavnav evaluate: --faults {words}: ")
    assert says in said
    assert said.count("\n") == 1


def test_evaluate_flies_a_baseline_with_faults(capsys):
    for words in ("none", "noise=5,sticky=0.5"):
        how = ["--episodes", "5", "--max-steps", "40", "--json"]
        assert fly_command(["random", "--faults", words, *how]) == 0
    assert capsys.readouterr().out.count('"run": "random"') == 2


# -- episodes ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("greedy", [True, False])
def test_a_flyer_with_faults_flies_among_others_as_alone_and_its_film_is_its_row(greedy):
    own = make_task(EMPTY, stack=2, faults=ALL)
    policies = {seed: untrained(seed, greedy, own, sizes=(60, 16, 100)) for seed in (5, 6)}
    task = on(own, "test", 20, 60)
    together = evaluation.fly(policies, task).episodes
    alone = evaluation.fly({6: policies[6]}, task).episodes
    pd.testing.assert_frame_equal(together[together["seed"] == 6].reset_index(drop=True), alone)
    film = render.fly(render.Pilot("own", policies[6], own, 6), layouts.load("test")[:20], 7, 60)
    row = alone[alone["layout"] == 7].iloc[0]
    last = film.states[-1]
    assert (int(last.steps), int(last.distance), float(last.reward)) == (
        row["steps"],
        row["distance"],
        row["reward"],
    )
    assert (film.ended == "collided") == row["terminated"]


def test_draws_of_an_episode_depend_on_its_seed_its_set_and_the_step_and_not_on_who_has_ended(monkeypatch):
    task = on(make_task(EMPTY, faults={"noise": 5.0, "sticky": 0.5}), "test", 30, 50)
    original, given = WrappedTask.step, []

    def step(self, state, action, draws=None):
        given.append(draws)
        return original(self, state, action, draws)

    monkeypatch.setattr(WrappedTask, "step", step)

    def drawn(*policies):
        """By seed, set and number, what each step was given."""
        found, seeds = {}, [seed for seed, _ in policies]
        for moved in episodes.steps(policies, task):
            for episode, row in zip(moved.episode.tolist(), given.pop().tolist(), strict=True):
                found[seeds[episode // 30], episode % 30, moved.number] = tuple(row)
        return found

    flying = drawn((3, straight_ahead), (4, straight_ahead))
    standing = drawn((4, always(0)), (3, always(0)))
    assert len(flying) < len(standing) == 2 * 30 * 50  # many have ended
    assert flying.items() <= standing.items()
    assert len({*standing.values()}) == len(standing)


def test_a_compiled_step_takes_the_same_draws_as_a_step_that_is_not_compiled(monkeypatch):
    """Episodes that have ended keep their places in the batch of a graph; here the graph is left out."""
    own = make_task(EMPTY, stack=2, faults=ALL)
    policies = {seed: untrained(seed, task=own, sizes=(60, 16, 100)) for seed in (5, 6)}
    task = on(own, "test", 40, 60)
    eager = evaluation.fly(policies, task)
    monkeypatch.setattr(machine, "EAGER_STEPS", 9)
    monkeypatch.setattr(machine, "episodes", lambda max_steps: True)
    monkeypatch.setattr(episodes.graph, "Graph", lambda function: function)
    episodes._graph.cache_clear()
    padded = evaluation.fly(policies, task)
    episodes._graph.cache_clear()
    pd.testing.assert_frame_equal(eager.episodes, padded.episodes)
    pd.testing.assert_frame_equal(eager.behaviour, padded.behaviour)


def test_behaviour_keeps_executed_actions_which_lead_where_the_drone_was():
    own = make_task(EMPTY, faults={"sticky": 0.5})
    task = on(own, "test", 5, 40)
    flown = evaluation.fly({3: uniform_random}, task)
    table = flown.behaviour.assign(mode="sampled")
    traced = behaviour.retrace(table, task.layouts, episodes.headings(task, 5), task.world)
    ends = traced.groupby("layout").last()
    states = {}
    for step in episodes.steps([(3, uniform_random)], task):
        for nth, episode in enumerate(step.episode.tolist()):
            states[episode] = float(step.state.x[nth]), float(step.state.y[nth])
    assert {layout: (row.x, row.y) for layout, row in ends.iterrows()} == states


def test_greedy_episodes_with_a_memory_are_flown_and_not_counted():
    policy = untrained()
    assert evaluation._repeatable(policy, make_task(EMPTY))
    for how in ({"stack": 2}, {"faults": {"late": 1}}, {"faults": {"noise": 1.0}}):
        assert not evaluation._repeatable(policy, make_task(EMPTY, **how))


def test_only_policies_of_one_stack_and_the_same_faults_fly_as_one_batch(monkeypatch):
    tasks = [
        make_task(EMPTY),
        make_task(EMPTY, stack=2),
        make_task(EMPTY, faults={"noise": 1.0}),
        make_task(EMPTY),
    ]
    batches = []

    def note(flyers, task):
        batches.append([flyer.seed for flyer in flyers])
        return [[]] * len(flyers)

    monkeypatch.setattr(replays, "_fly_together", note)
    replays.fly([replays.Flyer(seed, untrained(task=task), task, [0]) for seed, task in enumerate(tasks)], 12)
    assert batches == [[0, 3], [1], [2]]


def test_a_replay_shows_the_newest_ten_slots_of_a_stack():
    own = make_task(EMPTY, stack=3, faults={"noise": 2.0})
    ((episode,),) = replays.fly([replays.Flyer(0, untrained(task=own, sizes=(90, 16, 100)), own, [0])], 12)
    shown = unpack(episode, replays._constants(own.world)["fields"])
    assert all(shown[name].shape == (episode["steps"] + 1, 10) for name in ("right", "forward", "proximity"))


def test_probes_show_a_pose_as_if_an_episode_began_there_and_without_faults():
    plain_poses = probes.poses(make_task("test"))
    assert torch.equal(probes.poses(make_task("test", faults=ALL)), plain_poses)
    assert torch.equal(probes.poses(make_task("test", stack=3)), plain_poses.repeat(1, 3))


# -- configurations, older files -----------------------------------------------------------------------------


def test_settings_from_plain_keys_are_kept_and_named_where_they_differ_from_the_preset():
    config = ppo.PPOConfig.from_mapping({"stack": 4, "faults": {"noise": 5, "late": 2.0}})
    assert config.faults == Faults(noise=5.0, late=2)
    assert config.observation_size == config.make_task().observation_size == 120
    assert config.beyond_preset() == {"stack": 4, "faults.noise": 5.0, "faults.late": 2}
    assert ppo.PPOConfig.from_mapping(plain(config)) == config


def test_a_run_of_an_earlier_version_is_one_without_faults_and_stack():
    config = ppo.PPOConfig()
    older = {key: value for key, value in plain(config).items() if key not in ("stack", "faults")}
    again = ppo.PPOConfig.from_mapping(ppo.PPOConfig.as_run(older | {"algorithm": "ppo"}))
    assert again == config
    assert (again.stack, again.faults) == (1, NO_FAULTS)


def test_a_policy_of_an_earlier_version_has_neither_faults_nor_stack(tmp_path):
    path = write_policies(tmp_path / "run") / "policy.safetensors"
    with safe_open(path, framework="pt") as file:
        facts = json.loads(file.metadata()["uavnav"])
    older = {key: value for key, value in facts.items() if key not in ("stack", "faults")}
    save_file(load_file(path), path, metadata={"uavnav": json.dumps(older)})
    policy = load_policy(path)
    assert (policy.task.stack, policy.task.faults) == (1, NO_FAULTS)
