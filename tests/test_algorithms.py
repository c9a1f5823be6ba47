"""What every algorithm of the table keeps, whatever it does inside: add one, and all of this asks it too."""

import functools
import itertools
import shutil

import numpy as np
import onnxruntime
import pandas as pd
import pytest
import torch
from pages import ALL, PAGES, code, table
from PIL import Image
from replaying import as_stepped, few_layouts, recorded, stepped
from runs_by_hand import same
from safetensors.torch import load_file

from uavnav.acting import ACTS, values_of
from uavnav.algorithms import ALGORITHMS
from uavnav.cli import commands
from uavnav.evaluation import evaluate_run
from uavnav.report import report
from uavnav.runs import POLICY, Run, export
from uavnav.runs.metrics import MODES
from uavnav.runs.policies import load_policy
from uavnav.tasks.rewards import BOUNDS, REWARDS, Bounds
from uavnav.training.loop import make_collector, make_env, train
from uavnav.training.recorder import Interrupted, Recorder
from uavnav.training.update import Learner
from uavnav.views import replays

render_command = functools.partial(commands.run, "render")

SMALL = {"n_seeds": 2, "n_envs": 8, "total_frames": 640, "hidden": (16,), "lr": 1e-2, "compile": "off"}
"""Of every run here."""
TINY = {
    "ppo": {"frames_per_batch": 128, "epochs": 2, "activation": "rational"},
    "dqn": {
        "learning_starts": 64,
        "target_update_frames": 64,
        "frames_per_update": 4,
        "activation": "hadamard",
    },
    "pqn": {"frames_per_batch": 128, "epsilon_end": 0.1, "epochs": 4},
    "sac": {"learning_starts": 64, "target_entropy": 0.3, "frames_per_update": 4, "activation": "crelu"},
    "c51": {
        "learning_starts": 64,
        "target_update_frames": 64,
        "frames_per_update": 4,
        "n_atoms": 11,
        "epsilon_end": 0.05,
        "activation": "fourier",
        "n_steps": 3,
        "max_steps": 40,
        "double": True,
        "dueling": True,
    },
}
"""And what an algorithm needs beside that, so that it learns within 640 frames; a new one often needs
nothing.

DQN learns here as it is, C51 with all that both have: two streams, targets of several steps, and a time
limit. Activations that change widths or learn are each one algorithm's; the others have tanh.
"""


def pytest_generate_tests(metafunc):
    if "algorithm" in metafunc.fixturenames:
        metafunc.parametrize("algorithm", list(ALGORITHMS), scope="module")


def configured(algorithm, **more):
    return ALGORITHMS[algorithm].config(**SMALL | TINY.get(algorithm, {}) | more)


@pytest.fixture(scope="module")
def shared(once):
    """`shared(algorithm)`: a run of two seeds that the tests share, not to be changed."""

    def found(algorithm):
        def make(folder):
            train(configured(algorithm), folder / "run", quiet=True)

        return Run(once(f"every-{algorithm}", make) / "run")

    return found


@pytest.fixture(scope="module")
def run(algorithm, shared):
    return shared(algorithm)


def left_at(frames, folder, monkeypatch):
    """Of a run that goes on, what a kill after so many frames would leave, in another folder."""
    checkpoint = Recorder.checkpoint

    def copied(self, now, *parts):
        if now >= frames and not folder.exists():
            self.checkpoint_seconds = 0
            checkpoint(self, now, *parts)
            shutil.copytree(self.path, folder)

    monkeypatch.setattr(Recorder, "checkpoint", copied)


def weights(trainee):
    return torch.cat(
        [value.detach().flatten() for one in trainee.networks().values() for value in one.parameters()]
    )


def steps_of(config):
    """What its iterations learn from, all flown with the weights of its beginning."""
    collected = make_collector(make_env(config, False), config.make(compile=False).actor, config)
    return [batch.clone() for batch, _ in zip(collected, range(config.iterations), strict=False)]


def observations(n=50):
    return torch.rand(n, 30, generator=torch.Generator().manual_seed(0))


# -- seeds, bits and stops -----------------------------------------------------------------------------------


def test_seed_1_among_3_is_seed_1_alone_and_none_is_another(algorithm, tmp_path):
    among = train(configured(algorithm, n_seeds=3), tmp_path / "three", quiet=True)
    alone = train(configured(algorithm, n_seeds=1, seed=1), tmp_path / "one", quiet=True)
    values = [load_policy(one.path, seed=1).values(observations()) for one in (among, alone)]
    torch.testing.assert_close(values[0], values[1], rtol=1e-4, atol=1e-4)
    fresh = configured(algorithm, n_seeds=1, seed=1).make(compile=False)
    before = values_of(fresh.actor.head, fresh.networks()["policy"](observations()[None]))[0]
    assert (values[0] - before).abs().max() > 1e-2  # it did learn
    own = among.episodes[among.episodes.seed == 1].reset_index(drop=True)
    assert len(own) > 0
    assert own.equals(alone.episodes)
    rewards = [rows.reward.tolist() for _, rows in among.episodes.groupby("seed")]
    for one, other in itertools.combinations(range(3), 2):
        assert rewards[one] != rewards[other]
        for name, tensor in load_file(among.path / POLICY).items():
            assert not torch.equal(tensor[one], tensor[other]), name


def test_a_run_stopped_at_160_and_at_400_frames_and_resumed_ends_the_same_whatever_the_global_generator(
    algorithm, run, tmp_path
):
    torch.manual_seed(12345)
    before = torch.get_rng_state()
    for until in (160, 400):
        with pytest.raises(Interrupted) as stop:
            train(configured(algorithm), tmp_path / "run", quiet=True, until=until)
        assert stop.value.wanted
        assert until <= stop.value.frames < 640
    same(run.path, train(configured(algorithm), tmp_path / "run", quiet=True).path)
    assert torch.equal(before, torch.get_rng_state())  # it is left alone, too


@pytest.mark.slow
@pytest.mark.compiled
def test_compiled_a_kill_changes_no_bit_and_the_eager_run_differs_by_rounding(
    algorithm, run, tmp_path, monkeypatch
):
    """Of up to 80 calls of a graph each begins with other weights, targets and moments than it was traced
    with.
    """
    left_at(320, tmp_path / "run", monkeypatch)
    whole = train(configured(algorithm, compile="on"), tmp_path / "whole", quiet=True, processes=1)
    assert whole.meta["compiled"]
    told = []
    tell = lambda frames, _: told.append(frames)  # noqa: E731
    again = train(configured(algorithm, compile="on"), tmp_path / "run", quiet=True, processes=1, tell=tell)
    assert told[0] > 320  # it does not begin anew
    same(whole.path, again.path)
    for seed in (0, 1):
        values = [load_policy(one.path, seed=seed).values(observations()) for one in (whole, run)]
        torch.testing.assert_close(values[0], values[1], rtol=1e-3, atol=1e-3)
    columns = ["frame", "layout", "steps", "turns", "distance"]
    assert whole.episodes[columns].equals(run.episodes[columns])
    tensors = [load_file(one.path / POLICY) for one in (whole, run)]
    torch.testing.assert_close(*tensors, rtol=1e-3, atol=1e-3)
    rows = [one.progress.drop(columns="frames_per_second") for one in (whole, run)]
    pd.testing.assert_frame_equal(*rows, rtol=1e-3, atol=1e-5)


def test_the_gradient_of_3_agents_is_each_ones_own(algorithm, monkeypatch):
    """In double precision, for the first minibatch that they learn from."""
    config, seen = configured(algorithm, n_seeds=3), []
    with monkeypatch.context() as patch:
        patch.setattr(
            Learner,
            "learn",
            lambda self, some: seen.append(self.read(some[:, 0], *self.memory).clone()) or {},
        )
        trainee = config.make(compile=False)
        collected = make_collector(make_env(config, False), trainee.actor, config)
        for frames, batch in zip(
            range(config.frames_per_iteration, 641, config.frames_per_iteration), collected, strict=False
        ):
            trainee.learn(batch, frames)
    minibatch = seen[0].apply(lambda value: value.double() if value.is_floating_point() else value)

    def gradient(config, rows):
        trainee = config.make(compile=False)
        learned = {
            name: value for name, value in trainee.loss.double().named_parameters() if value.requires_grad
        }
        found = trainee.loss(rows.clone())
        losses = sum(found[name].flatten(1).mean(1) for name in trainee.learner.names[:-1])
        return dict(zip(learned, torch.autograd.grad(losses.sum(), list(learned.values())), strict=True))

    population = gradient(config, minibatch)
    for agent in range(3):
        own = gradient(configured(algorithm, n_seeds=1, seed=agent), minibatch[agent : agent + 1])
        for name, part in own.items():
            assert part.abs().max() > 0
            torch.testing.assert_close(population[name][agent], part[0], rtol=1e-12, atol=1e-12)


# -- what it learns from -------------------------------------------------------------------------------------


def test_an_annealed_rate_comes_to_0_one_update_after_the_last(algorithm, tmp_path, monkeypatch):
    config, learners, step = configured(algorithm, anneal_lr=True), set(), Learner.step
    monkeypatch.setattr(Learner, "step", lambda self, batch: learners.add(self) or step(self, batch))
    train(config, tmp_path / "run", quiet=True)
    (learner,) = learners
    assert learner.steps == learner.optimiser.until == config.updates
    last, after = torch.tensor([config.updates, config.updates + 1.0], dtype=torch.float64)[:, None]
    assert learner.optimiser.rates(after)[0, 0] == 0 < learner.optimiser.rates(last)[0, 0]
    assert configured(algorithm).make(compile=False).learner.optimiser.until == float("inf")


def test_a_limit_bootstraps_from_its_own_last_observation_and_a_collision_does_not(algorithm):
    """The same steps four times: ended by the time limit or by a collision, in one place or in another."""
    config = configured(algorithm, max_steps=3, total_frames=256, n_seeds=1)
    batches = steps_of(config)
    truncated = sum(int(batch["next", "truncated"].sum()) for batch in batches)
    assert truncated > 60  # nearly a third of 256 steps
    elsewhere = torch.Generator().manual_seed(0)

    def learned(collided, moved):
        """The weights after those steps, where the ended episodes ended so."""
        trainee = config.make(compile=False)
        before = weights(trainee)
        for index, original in enumerate(batches, start=1):
            batch = original.clone()
            following, done = batch["next"], batch["next", "done"]
            if collided:
                following["terminated"], following["truncated"] = done.clone(), torch.zeros_like(done)
            if moved:
                place = torch.rand(following["observation"].shape, generator=elsewhere)
                following["observation"] = torch.where(done, place, following["observation"])
            trainee.learn(batch, index * config.frames_per_iteration)
        assert (weights(trainee) - before).abs().max() > 1e-3
        return weights(trainee)

    at_limit = learned(collided=False, moved=False)
    assert torch.equal(at_limit, learned(collided=False, moved=False))
    assert (
        at_limit - learned(collided=False, moved=True)
    ).abs().max() > 1e-4  # V(s') counts, of this very s'
    collision = learned(collided=True, moved=False)
    assert (at_limit - collision).abs().max() > 1e-4
    assert (collision - learned(collided=True, moved=True)).abs().max() < 1e-5  # and here it does not


@pytest.fixture
def paid_turn(monkeypatch):
    """A reward of 1 for the ten actions that turn by one of the ten angles, in the table for one test."""
    monkeypatch.setitem(REWARDS, "one turn", lambda step: {"turn": (step.action // 10 == 3).double()})
    monkeypatch.setitem(BOUNDS, "one turn", lambda world: Bounds(flying=(0.0, 1.0), collided=(0.0, 1.0)))
    return "one turn"


def paid(algorithm, reward, folder):
    """Each seed's reward a step over a run's first 512 frames and its last 1,024: a tenth, where actions
    are random.
    """
    how = {"n_seeds": 3, "total_frames": 4096, "gamma": 0.0, "max_steps": 10, "reward": reward}
    every = {"dqn": 8, "sac": 8, "c51": 16}
    how |= {"frames_per_update": every[algorithm]} if algorithm in every else {}
    found = train(configured(algorithm, **how), folder, quiet=True)
    episodes = found.episodes
    parts = [episodes[episodes.frame <= 512], episodes[episodes.frame > found.frames - 1024]]
    sums = [part.groupby("seed")[["reward", "steps"]].sum() for part in parts]
    return [(part.reward / part.steps).to_numpy() for part in sums]


def test_every_one_of_3_seeds_learns_which_of_10_turns_is_paid(algorithm, paid_turn, tmp_path):
    first, last = paid(algorithm, paid_turn, tmp_path / "run")
    assert last.min() > 0.5
    assert (last > first + 0.2).all()


def test_without_a_learning_rate_no_bit_of_a_weight_changes(algorithm):
    config = configured(algorithm, total_frames=256, lr=0.0)
    trainee = config.make(compile=False)
    before = weights(trainee)
    for index, batch in enumerate(steps_of(config), start=1):
        trainee.learn(batch, index * config.frames_per_iteration)
    assert trainee.learner.steps == config.updates > 0
    assert torch.equal(weights(trainee), before)


# -- what it leaves ------------------------------------------------------------------------------------------


def test_sampled_episodes_act_as_training_acted_with_the_same_uniform_numbers(algorithm, run):
    """The actor of a run that has ended, beside the policies of its file: 2 seeds, 500 places each."""
    config = configured(algorithm)
    trainee, saved = config.make(compile=False), load_file(run.path / POLICY)
    network, actor = trainee.networks()["policy"], trainee.actor
    network.load_state_dict({name: saved[f"policy.{name}"] for name in network.state_dict()})
    epsilon = torch.tensor(config.final_epsilon)
    observation = observations(1000).reshape(2, 500, 30)
    generators = [torch.Generator().manual_seed(7 + seed) for seed in config.seeds]
    uniform = torch.stack([torch.rand(ACTS[actor.acts].uniforms, 500, generator=one) for one in generators])
    with torch.no_grad():
        (trained,) = actor.choose(observation, uniform, epsilon, *network.parameters())
    for agent, seed in enumerate(config.seeds):
        policy = load_policy(run.path, seed, greedy=False)
        assert (policy.acts, policy.head, policy.epsilon) == (actor.acts, actor.head, config.final_epsilon)
        sampled = policy(observation[agent], torch.Generator().manual_seed(7 + seed))
        assert torch.equal(sampled, trained[agent])
        greedy = load_policy(run.path, seed)(observation[agent])
        assert torch.equal(greedy, policy.values(observation[agent]).argmax(-1))
        assert not torch.equal(greedy, sampled)


def test_an_evaluation_has_a_row_for_each_seed_way_and_set(algorithm, run, tmp_path):
    copy = Run(shutil.copytree(run.path, tmp_path / "run"))
    rows = evaluate_run(copy, episodes=4, max_steps=50, quiet=True)
    assert rows.groupby(["seed", "mode"]).size().to_dict() == {
        (seed, mode): 4 for seed in (0, 1) for mode in MODES
    }
    assert rows.steps.between(1, 50).all()
    assert (rows.terminated ^ rows.truncated).all()


def test_an_exported_policy_gives_the_same_values(algorithm, run, tmp_path):
    """C51's as ONNX, as no other has its head: of the rest `test_export` asks that."""
    policy = load_policy(run.path, seed=1)
    path = export.export_policy(policy, tmp_path / f"policy.{'onnx' if algorithm == 'c51' else 'pt2'}")
    if path.suffix == ".onnx":
        given = {"observation": observations().numpy()}
        (values,) = onnxruntime.InferenceSession(path).run(["values"], given)
    else:
        with torch.no_grad():
            values = torch.export.load(path).module()(observations()).numpy()
    np.testing.assert_allclose(values, policy.values(observations()), rtol=1e-4, atol=1e-4)
    assert np.ptp(values) > 0


def test_a_page_replays_its_episodes_as_they_are_flown_one_by_one(algorithm, run):
    with few_layouts():
        data = recorded(run.path.parent, n_seeds=1, n_layouts=2)
    (configuration,) = data["configurations"]
    assert configuration["values"] == ALGORITHMS[algorithm].shown
    expected = stepped(run.path, 0, 2)
    for episode in configuration["episodes"]:
        as_stepped(episode, data["fields"], *expected[episode["layout"]])


def test_an_episode_of_it_is_a_gif_of_more_than_one_picture(algorithm, run, tmp_path):
    path = tmp_path / "episode.gif"
    assert render_command([str(run.path), "--out", str(path), "--steps", "12", "--width", "160"]) == 0
    with Image.open(path) as film:
        assert (film.format, film.n_frames > 1) == ("GIF", True)


@pytest.mark.usefixtures("warm", "brief")
def test_a_report_has_the_configuration_of_a_run_of_each(shared, tmp_path, monkeypatch):
    monkeypatch.setattr(replays.record, "__defaults__", (3, 3, 50))
    runs = {name: Run(shutil.copytree(shared(name).path, tmp_path / name)) for name in ALGORITHMS}
    for run in runs.values():
        evaluate_run(run, episodes=2, max_steps=20, quiet=True)
    report([tmp_path], tmp_path / "report")
    page = (tmp_path / "report" / "report.md").read_text()
    for name, run in runs.items():
        assert f"| {name} | {name} | {run.config['activation']} | paper | drone | " in page


def test_its_page_has_a_line_for_every_column_that_it_logs(algorithm, run):
    _, logged = ALL["docs/algorithms.md"].split("\n## What every algorithm logs\n")
    rows = [line.split(": ", 1) for line in logged.splitlines() if line.startswith("- ")]
    rows += table(PAGES[algorithm], "| column | meaning |")
    assert all(row[1] for row in rows)
    names = [name for row in rows for name in code(row[0])]
    if "entropy_coeff" in run.config:
        names.remove("loss_entropy")  # of a bonus alone: see test_a2c and test_ppo_run
    learned = tuple(name[:-1] for name in names if name.endswith("…"))  # by an activation
    columns = [name for name in run.progress.columns if not name.startswith(learned)]
    assert sorted(columns) == sorted(name for name in names if not name.endswith("…"))
