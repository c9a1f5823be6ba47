"""DQN: the target by hand, each agent alone, Stable-Baselines3's own update, and a whole run against plain PyTorch."""

import copy
import itertools
from collections import defaultdict
from dataclasses import replace
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from stable_baselines3 import DQN
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from tensordict import TensorDict

import uavnav
from uavnav.algorithms.dqn import (
    PRESETS,
    DQNConfig,
    ExploringPolicy,
    learn,
    make_buffer,
    make_learner,
    make_loss,
    make_network,
    rows,
    train,
)
from uavnav.choices import ConfigError
from uavnav.envs.gym import DroneVectorEnv
from uavnav.tasks.seeding import Streams
from uavnav.tasks.world import World
from uavnav.training.learner import Learner
from uavnav.training.recorder import Interrupted, Recorder
from uavnav.training.sampler import AgentSampler


def transitions(*shape, dtype=torch.float32, seed=0):
    """Made-up transitions of any shape; a quarter of them end in a collision, and a quarter of the rest at the cap."""
    g = torch.Generator().manual_seed(seed)
    terminated = torch.rand(*shape, 1, generator=g) < 0.25
    truncated = ~terminated & (torch.rand(*shape, 1, generator=g) < 0.25)
    return TensorDict(
        {
            "observation": torch.rand(*shape, 30, generator=g, dtype=dtype),
            "action": torch.randint(100, shape, generator=g),
            "next": TensorDict(
                {
                    "observation": torch.rand(*shape, 30, generator=g, dtype=dtype),
                    "reward": torch.randn(*shape, 1, generator=g, dtype=dtype),
                    "done": terminated | truncated,
                    "terminated": terminated,
                },
                list(shape),
            ),
        },
        list(shape),
    )


def losses_by_row(batch, config):
    network = make_network(config)
    loss = make_loss(network, config)
    with torch.no_grad():
        for target in loss.target_value_network_params.values(True, True):
            target.mul_(0.5)  # so that online and target network differ
        return loss(batch.clone())["loss"].flatten(), network, loss


@pytest.mark.parametrize(
    ("kind", "gamma", "double", "n_steps"),
    [
        ("huber", 0.99, False, 1),
        ("squared", 0.99, False, 1),
        ("huber", 0.5, False, 1),
        ("squared", 0.99, True, 1),
        ("squared", 0.9, True, 4),
    ],
)
def test_the_loss_of_each_row_is_that_of_the_target_by_hand(kind, gamma, double, n_steps):
    config = DQNConfig(loss=kind, gamma=gamma, double=double, n_steps=n_steps)
    batch = transitions(1, 8)
    got, network, _ = losses_by_row(batch, config)
    halved = make_network(config)
    for parameter in halved.parameters():
        parameter.data.mul_(0.5)
    other = (network(batch["next", "observation"]).argmax(-1) != halved(batch["next", "observation"]).argmax(-1)).sum()
    assert other > 2  # or the double estimate would be the same
    for row in range(8):
        observation, following = batch["observation"][:, row], batch["next", "observation"][:, row]
        prediction = network(observation)[0, batch["action"][0, row]].item()
        best = (network if double else halved)(following).argmax()
        bootstrap = 0.0 if batch["next", "terminated"][0, row] else gamma**n_steps * halved(following)[0, best].item()
        error = abs(prediction - (batch["next", "reward"][0, row].item() + bootstrap))
        expected = error**2 if kind == "squared" else (0.5 * error**2 if error < 1 else error - 0.5)
        assert got[row].item() == pytest.approx(expected, abs=1e-5)


def test_a_truncated_step_bootstraps_and_a_terminated_one_does_not():
    config = DQNConfig(loss="squared")
    batch = transitions(1, 1)
    losses = {}
    for terminated in (False, True):
        batch["next", "done"] = torch.tensor([[[True]]])
        batch["next", "terminated"] = torch.tensor([[[terminated]]])
        losses[terminated] = losses_by_row(batch, config)[0].item()
    batch["next", "done"] = torch.tensor([[[False]]])
    batch["next", "terminated"] = torch.tensor([[[False]]])
    assert losses[False] == losses_by_row(batch, config)[0].item()
    assert abs(losses[False] - losses[True]) > 1e-3  # the negative control


def test_the_gradient_of_3_agents_is_each_ones_own():
    batch = transitions(3, 32, dtype=torch.float64)
    population_config = DQNConfig(n_seeds=3)
    loss = make_loss(make_network(population_config).double(), population_config)
    population = make_learner(loss, population_config, compile=False).gradient(batch)
    for agent in range(3):
        config = DQNConfig(seed=agent)
        learner = make_learner(make_loss(make_network(config).double(), config), config, compile=False)
        own = learner.gradient(batch[agent : agent + 1])
        for name, part in own.items():
            assert part.abs().max() > 0
            torch.testing.assert_close(population[name][agent], part[0], rtol=1e-12, atol=1e-12)


def test_rows_keep_agent_and_world_together():
    """Entry (agent 1, world 2) is 12 in every key."""
    code = 10.0 * torch.arange(2)[:, None, None] + torch.arange(3)[None, :, None]
    names = ("reward", "done", "terminated")
    following = {"observation": code[..., None].repeat(1, 1, 1, 30), **{n: code[..., None].clone() for n in names}}
    batch = TensorDict({"observation": code[..., None].repeat(1, 1, 1, 30), "action": code.clone()}, [2, 3, 1])
    batch["next"] = TensorDict(following, [2, 3, 1])
    got = rows(batch, DQNConfig(max_steps=9))
    assert got.batch_size == (3, 2)
    for world in range(3):
        for agent in range(2):
            leaves = got[world, agent].values(include_nested=True, leaves_only=True)
            assert {number for leaf in leaves for number in leaf.flatten().tolist()} == {10 * agent + world}


def test_20_updates_of_seed_1_among_3_are_those_of_seed_1_alone(tmp_path):
    settings = {"total_frames": 144, "learning_starts": 64, "n_worlds": 16, "target_update_frames": 32}
    settings |= {"lr": 1e-2, "compile": "off"}
    among = train(DQNConfig(n_seeds=3, **settings), out=tmp_path / "three", quiet=True)
    alone = train(DQNConfig(seed=1, **settings), out=tmp_path / "one", quiet=True)
    observation = torch.rand(50, 30)
    before = make_network(DQNConfig(seed=1))(observation[None])[0]
    values = [uavnav.load_policy(run.path, seed=1).values(observation) for run in (among, alone)]
    torch.testing.assert_close(values[0], values[1], rtol=1e-5, atol=1e-5)
    assert (values[0] - before).abs().max() > 1e-2  # it did learn
    own = among.episodes[among.episodes.seed == 1].reset_index(drop=True)
    assert own.equals(alone.episodes)


@pytest.mark.parametrize(("activation", "cap"), [("sigmoid", 0.9), ("leaky_relu", 0.37)])
def test_two_rounds_of_4_updates_from_the_same_weights_and_draws_equal_sb3s(activation, cap):
    """Buffer, target, loss, clipping and Adam: the weights after SB3's train() within 1e-5 of ours.

    Huber's slope is at most 1, so no reward takes these networks' gradients to the default cap of 10: a cap among
    their norms clips some of the updates and leaves others alone.
    """
    kinds = {"sigmoid": torch.nn.Sigmoid, "leaky_relu": torch.nn.LeakyReLU}
    theirs = DQN(
        "MlpPolicy",
        gymnasium.make("uavnav/Drone-v0"),
        policy_kwargs={"activation_fn": kinds[activation]},
        learning_rate=1e-3,
        max_grad_norm=cap,
        buffer_size=100,
        seed=0,
    )
    config = DQNConfig(activation=activation, max_grad_norm=cap, lr=1e-3, n_worlds=16, max_steps=1000)
    network = make_network(config)
    loss = make_loss(network, config)
    other = make_network(DQNConfig(activation=activation, seed=7))
    with torch.no_grad():
        for target, value in zip(
            loss.target_value_network_params.values(True, True),
            TensorDict.from_module(other).values(True, True),
            strict=True,
        ):
            target.copy_(value)
    for ours, sb3 in ((network, theirs.q_net), (other, theirs.q_net_target)):
        linears = [layer for layer in sb3.q_net if isinstance(layer, torch.nn.Linear)]
        for layer, linear in zip(ours[::2], linears, strict=True):
            linear.weight.data.copy_(layer.weight[0].T)
            linear.bias.data.copy_(layer.bias[0, 0])

    learner = make_learner(loss, config, compile=False)
    norms, step = [], learner.step

    def watch(minibatch):
        losses = step(minibatch)
        norms.append(losses["grad_norm"].item())
        return losses

    learner.step = watch
    buffer = make_buffer(AgentSampler([0], "replay", replace=True), config, total=96)
    draws = Streams([0], "replay")
    theirs._setup_learn(1)
    for filled in (48, 96):  # a round after three steps of 16 worlds, and another after three more
        for seed in range(3):
            batch = transitions(1, 16, 1, seed=filled + seed)
            batch["next", "reward"] *= filled / 48 * 3  # errors on both sides of Huber's knee
            buffer.extend(rows(batch, config))
        learn(buffer, learner, config)
        everything = buffer[:][:, 0]
        drawn = draws.draw(torch.randint, filled, (4 * 32,), device="cpu")[0].split(32)
        samples = iter(
            ReplayBufferSamples(
                batch["observation"],
                batch["action"][:, None],
                batch["next", "observation"],
                batch["next", "terminated"].float(),
                batch["next", "reward"],
            )
            for batch in (everything[index] for index in drawn)
        )
        theirs.replay_buffer.sample = lambda *args, samples=samples, **kwargs: next(samples)
        theirs.train(gradient_steps=4, batch_size=32)
    assert len(norms) == 8
    assert min(norms) < cap < max(norms)
    linears = [layer for layer in theirs.q_net.q_net if isinstance(layer, torch.nn.Linear)]
    start = make_network(config)
    for layer, linear, first in zip(network[::2], linears, start[::2], strict=True):
        torch.testing.assert_close(layer.weight[0].T, linear.weight, rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(layer.bias[0, 0], linear.bias, rtol=1e-5, atol=1e-5)
        assert (layer.weight - first.weight).abs().max() > 1e-3


# -- a whole run, watched --------------------------------------------------------------------------------------------

SWITCHES = {"slots": "listed", "padding": "zeros"}
WATCHED = DQNConfig(
    seed=3,
    n_seeds=2,
    n_worlds=16,
    total_frames=640,
    learning_starts=256,
    batch_size=8,
    target_update_frames=96,
    hidden=(32,),
    activation="relu",
    init="orthogonal",
    lr=5e-3,
    adam_eps=1e-3,
    gamma=0.5,
    loss="squared",
    max_grad_norm=1.0,
    epsilon_start=0.9,
    epsilon_end=0.2,
    exploration_fraction=0.75,
    max_steps=20,
    reward="initial",
    compile="off",
    **SWITCHES,
)
"""40 steps of 16 worlds, of which the last 24 are each followed by 4 updates, and no default that matters."""


def watch(config, folder):
    """A run, its buffer, and what each step saw of it: epsilon, minibatches [A, N] and what they were learned with."""
    seen = SimpleNamespace(epsilons=[], minibatches=[], losses=[], learned=[])
    step, act, checkpoint = Learner.step, ExploringPolicy.act, Recorder.checkpoint

    def watch_buffer(sampler, config, total):
        seen.buffer = make_buffer(sampler, config, total)
        return seen.buffer

    def watch_step(self, minibatch):
        seen.minibatches.append(minibatch.clone())
        seen.losses.append(step(self, minibatch))
        return seen.losses[-1]

    def watch_act(self, observation):
        seen.epsilons.append(self.epsilon.item())
        return act(self, observation)

    def watch_checkpoint(self, frames, parts, replay=None):
        seen.learned.append(len(seen.minibatches) - sum(seen.learned))
        checkpoint(self, frames, parts, replay)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("uavnav.algorithms.dqn.make_buffer", watch_buffer)
        patch.setattr("uavnav.algorithms.dqn.LOG_FRAMES", 32)
        patch.setattr(Learner, "step", watch_step)
        patch.setattr(ExploringPolicy, "act", watch_act)
        patch.setattr(Recorder, "checkpoint", watch_checkpoint)
        seen.run = train(config, out=folder, quiet=True)
    return seen


@pytest.fixture(scope="module")
def watched(tmp_path_factory):
    return watch(WATCHED, tmp_path_factory.mktemp("watched") / "run")


def test_each_step_of_16_worlds_after_frame_256_is_followed_by_4_updates_of_8_rows_an_agent(watched):
    assert watched.learned == [0] * 16 + [4] * 24
    assert all(batch.batch_size == (2, 8) for batch in watched.minibatches)


def test_each_4th_step_of_a_single_world_after_frame_10_is_followed_by_one_update(tmp_path):
    settings = {"n_worlds": 1, "total_frames": 25, "learning_starts": 10, "batch_size": 8, "compile": "off"}
    seen = watch(DQNConfig(**settings), tmp_path / "run")
    assert [step for step, learned in enumerate(seen.learned, start=1) if learned] == [12, 16, 20, 24]
    assert sum(seen.learned) == 4


def test_the_buffer_holds_the_640_transitions_that_gymnasiums_worlds_fly_with_the_same_actions(watched):
    """Where an episode ends, the next observation is its own last one, and only a collision is terminated."""
    stored = watched.buffer[:]
    assert stored.batch_size == (640, 2)
    ends = {"terminated": 0, "truncated": 0, "seen": 0}
    for agent, seed in enumerate(WATCHED.seeds):
        vector = DroneVectorEnv(16, world=World(**SWITCHES), max_steps=20, reward="initial")
        observation, _ = vector.reset(seed=seed)
        for row in stored[:, agent].split(16):
            np.testing.assert_array_equal(row["observation"], observation)
            observation, reward, terminated, truncated, info = vector.step(row["action"].numpy())
            following = observation.copy()
            for world in np.flatnonzero(terminated | truncated):
                following[world] = info["final_obs"][world]
                ends["seen"] += (following[world] != observation[world]).any()
            np.testing.assert_array_equal(row["next", "observation"], following)
            np.testing.assert_array_equal(row["next", "reward"].squeeze(-1), reward.astype(np.float32))
            np.testing.assert_array_equal(row["next", "terminated"].squeeze(-1), terminated)
            np.testing.assert_array_equal(row["next", "done"].squeeze(-1), terminated | truncated)
            ends["terminated"] += terminated.sum()
            ends["truncated"] += truncated.sum()
    assert min(ends.values()) >= 3


def whole(batch):
    """All of a transition in one vector."""
    following = [batch["next", name].float() for name in ("observation", "reward", "done", "terminated")]
    return torch.cat([batch["observation"], batch["action"][..., None].float(), *following], -1)


def test_each_agent_learns_from_4_draws_of_its_own_a_round_from_all_that_it_did_so_far(watched):
    for agent, seed in enumerate(WATCHED.seeds):
        stored = whole(watched.buffer[:][:, agent])
        draws = Streams([seed], "replay")
        for index in range(24):
            used = whole(torch.cat([batch[agent] for batch in watched.minibatches[4 * index : 4 * index + 4]]))
            frames = 256 + 16 * (index + 1)
            assert torch.equal(used, stored[draws.draw(torch.randint, frames, (4 * 8,), device="cpu")[0]])


@pytest.mark.parametrize("agent", [0, 1])
def test_the_runs_96_updates_are_those_of_plain_pytorch_with_the_runs_own_numbers(watched, agent):
    """Every number that is not a default is written out here once more; the target is copied at 96, 192, ... 576."""
    network = make_network(DQNConfig(**vars(WATCHED) | {"n_seeds": 1, "seed": 3 + agent}))
    optimiser = torch.optim.Adam(network.parameters(), lr=5e-3, eps=1e-3)
    target, norms = copy.deepcopy(network), []
    minibatches = iter(batch[agent : agent + 1] for batch in watched.minibatches)
    for frames in range(16, 641, 16):
        if frames % 96 == 0:
            target = copy.deepcopy(network)
        for _ in range(4 if frames > 256 else 0):
            batch = next(minibatches)
            with torch.no_grad():
                following = target(batch["next", "observation"]).amax(-1, keepdim=True)
            worth = batch["next", "reward"] + 0.5 * following * ~batch["next", "terminated"]
            values = network(batch["observation"]).gather(-1, batch["action"][..., None])
            loss = (values - worth).square().mean()
            assert watched.losses[len(norms)]["loss"][agent].item() == pytest.approx(loss.item(), rel=1e-3)
            optimiser.zero_grad()
            loss.backward()
            norms.append(torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0).item())
            optimiser.step()
    assert len(norms) == 96
    assert min(norms) < 1.0 < max(norms)
    saved = load_file(watched.run.path / "policy.safetensors")
    for name, own in network.state_dict().items():
        torch.testing.assert_close(saved[f"policy.{name}"][agent : agent + 1], own, rtol=1e-4, atol=1e-4)


def test_every_step_explores_with_the_epsilon_of_the_frames_before_it(watched):
    assert watched.epsilons == pytest.approx([WATCHED.epsilon(frames) for frames in range(0, 640, 16)], abs=1e-6)
    assert watched.epsilons[15:18] == pytest.approx([1.0, 0.9 - 0.7 * 256 / 480, 0.9 - 0.7 * 272 / 480], abs=1e-6)
    assert watched.epsilons[-1] == pytest.approx(0.2, abs=1e-6)


def test_a_row_of_progress_every_32_frames_has_its_epsilon_and_the_means_of_its_4_updates(watched):
    progress = watched.run.progress
    assert progress.frame.tolist() == [frames for frames in range(32, 641, 32) for _ in (3, 4)]
    assert progress.seed.tolist() == [3, 4] * 20
    assert progress.epsilon.tolist() == pytest.approx([WATCHED.epsilon(frames) for frames in progress.frame], abs=1e-6)
    for name in ("loss", "grad_norm"):
        assert progress[name][progress.frame <= 256].isna().all()
        by_round = torch.stack([losses[name] for losses in watched.losses]).reshape(24, 4, 2)
        assert by_round.std(1).min() > 0
        expected = by_round.mean(1)[1::2].flatten()  # frames 288, 320, ...: every other round
        np.testing.assert_allclose(progress[name][progress.frame > 256], expected, rtol=1e-5)


def test_the_run_flew_in_the_world_that_its_settings_and_its_cap_describe(watched):
    stored = watched.buffer[:]
    action, terminated = stored["action"], stored["next", "terminated"].squeeze(-1)
    expected = torch.where(terminated, -10.0, 0.01 * (action % 10))
    torch.testing.assert_close(stored["next", "reward"].squeeze(-1), expected)
    slots = stored["observation"].unflatten(-1, (10, 3))
    assert (slots == 0).all(-1).any()  # padding=zeros
    assert (slots[..., -1].diff(dim=-1)[(slots != 0).any(-1)[..., 1:]] < 0).any()  # slots=listed: not by distance
    episodes = watched.run.episodes
    assert episodes.steps.max() == 20
    assert (episodes.steps[episodes.truncated] == 20).all()
    assert episodes.truncated.sum() >= 20
    assert episodes.terminated.sum() == terminated.sum() >= 3
    earned = (0.01 * episodes.distance - episodes.reward).round(9)
    assert (earned[~episodes.terminated] == 0).all()
    assert earned[episodes.terminated].between(10, 10.09).all()  # the step into the collision pays nothing else


def test_half_of_4000_actions_at_epsilon_one_half_are_explored_and_q_value_is_the_mean_of_the_best(tmp_path):
    config = DQNConfig(
        n_worlds=16,
        total_frames=4_000,
        learning_starts=0,
        frames_per_update=1_600,
        lr=0.0,  # so that the greedy action of every step is known
        epsilon_start=0.5,
        epsilon_end=0.5,
        start_heading="random",
        max_steps=100,
        compile="off",
    )
    seen = watch(config, tmp_path / "run")
    stored = seen.buffer[:][:, 0]
    with torch.no_grad():
        values = make_network(config)(stored["observation"][None])[0]
    explored = stored["action"] != values.argmax(-1)
    assert explored.float().mean().item() == pytest.approx(0.5 * 0.99, abs=0.03)
    for digit in (stored["action"] // 10, stored["action"] % 10):  # of every turn and distance a tenth
        assert (torch.bincount(digit[explored], minlength=10) / explored.sum()).sub(0.1).abs().max() < 0.03
    best = values.amax(-1).reshape(250, 16).mean(1)
    progress = seen.run.progress
    np.testing.assert_allclose(progress.q_value, best[progress.frame.to_numpy() // 16 - 1], rtol=1e-4)
    assert progress.q_value.std() > 0


def test_random_start_headings_of_a_run_differ_and_follow_its_seed(tmp_path, monkeypatch):
    """Headings of the last step's states that have just begun an episode: every one, at a cap of one step."""
    headings, add = [], Recorder.add_open_episodes

    def watch_state(self, state, frame):
        headings.append(state.heading.flatten().tolist())
        add(self, state, frame)

    monkeypatch.setattr(Recorder, "add_open_episodes", watch_state)
    settings = {"total_frames": 32, "max_steps": 1, "start_heading": "random", "compile": "off"}
    for index, seed in enumerate((0, 0, 1)):
        train(DQNConfig(seed=seed, **settings), out=tmp_path / str(index), quiet=True)
    assert headings[0] == headings[1] != headings[2]
    assert len(set(headings[0])) > 10


def test_train_takes_one_thread_and_gives_its_callers_3_back(tmp_path):
    config = DQNConfig(total_frames=64, compile="off")
    try:
        torch.set_num_threads(3)
        with pytest.raises(Interrupted):
            train(config, out=tmp_path / "run", quiet=True, until=32)
        assert torch.get_num_threads() == 3
        assert train(config, out=tmp_path / "run", quiet=True).meta["threads"] == 1
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(1)


# -- its schedules ---------------------------------------------------------------------------------------------------


def test_epsilon_falls_from_1_to_5_percent_over_a_tenth_of_the_frames_once_learning_starts():
    config = DQNConfig()
    assert [config.epsilon(frames) for frames in (0, 49_984)] == [1.0, 1.0]
    assert config.epsilon(50_000) == pytest.approx(0.525)
    assert config.epsilon(75_000) == pytest.approx(0.2875)
    assert config.epsilon(100_000) == config.epsilon(1_000_000) == pytest.approx(0.05)
    assert PRESETS["paper-2.3"].epsilon(50_000) == pytest.approx(0.525)
    assert PRESETS["paper-2.3"].epsilon(1_000) == pytest.approx(0.9905)


def test_before_learning_starts_every_action_is_random_and_no_weight_moves(tmp_path):
    run = train(
        DQNConfig(total_frames=4_000, learning_starts=4_000, n_worlds=16, compile="off"), out=tmp_path / "r", quiet=True
    )
    counts = run.episodes.sum()
    assert abs(counts.turns / counts.steps - 0.9) < 0.02
    observation = torch.rand(5, 30)
    before = make_network(DQNConfig())(observation[None])[0]
    assert torch.equal(uavnav.load_policy(run.path).values(observation), before)


def test_the_target_is_copied_every_64_frames(tmp_path, monkeypatch):
    """At 16 worlds: after steps 4, 8 and 12, and what was copied are the weights of that moment."""
    settings = {"learning_starts": 16, "target_update_frames": 64, "n_worlds": 16}
    config = DQNConfig(total_frames=16 * 13, lr=1e-2, compile="off", **settings)
    kept = {}
    monkeypatch.setattr(
        "uavnav.algorithms.dqn.make_loss", lambda network, config: kept.setdefault("loss", make_loss(network, config))
    )
    targets, online = [], []
    original = uavnav.training.recorder.Recorder.add_episodes

    def watch(self, following, frame):
        targets.append(torch.cat([v.flatten() for v in kept["loss"].target_value_network_params.values(True, True)]))
        online.append(torch.cat([v.detach().flatten() for v in kept["loss"].value_network_params.values(True, True)]))
        original(self, following, frame)

    monkeypatch.setattr("uavnav.training.recorder.Recorder.add_episodes", watch)
    train(config, out=tmp_path / "r", quiet=True)
    copied = [step for step in range(1, 13) if not torch.equal(targets[step], targets[step - 1])]
    assert copied == [4, 8, 12]  # seen at the beginning of the step after
    for step in copied:
        assert torch.equal(targets[step], online[step - 1])  # before that step's own updates


def test_sixteen_updates_follow_each_step_of_64_worlds_and_four_of_16():
    assert DQNConfig().updates_per_step == 16
    assert DQNConfig().iterations * 16 == 250_000
    assert DQNConfig(n_worlds=16).updates_per_step == 4
    assert DQNConfig(n_worlds=1).updates_per_step == 1
    assert DQNConfig(n_worlds=1).steps_between_updates == 4
    with pytest.raises(ConfigError, match=r"n_worlds=6; give a multiple or a divisor of frames_per_update=4"):
        DQNConfig(n_worlds=6)


def test_explored_actions_of_a_seed_do_not_depend_on_the_other_seeds():
    many, one = DQNConfig(n_seeds=3), DQNConfig(seed=2)
    observation = torch.rand(3, 16, 30)
    among = ExploringPolicy(make_network(many), many, compile=False)
    alone = ExploringPolicy(make_network(one), one, compile=False)
    for epsilon in (1.0, 0.5, 0.0):
        among.epsilon.fill_(epsilon)
        alone.epsilon.fill_(epsilon)
        actions = among.act(observation)
        assert torch.equal(actions[2], alone.act(observation[2:])[0])
        if epsilon == 1.0:
            assert len(actions.unique(dim=0)) == 3


def test_a_buffer_of_48_keeps_the_newest_48_of_80_frames(tmp_path):
    settings = {"total_frames": 80, "learning_starts": 16, "batch_size": 4, "n_worlds": 16, "max_steps": 1000}
    settings |= {"lr": 0.0, "compile": "off"}
    ring, everything = (
        watch(DQNConfig(buffer_size=size, **settings), tmp_path / str(size)).buffer[:] for size in (48, 80)
    )
    assert (ring.shape, everything.shape) == ((48, 1), (80, 1))
    newest = whole(everything)[32:]
    assert torch.equal(whole(ring), torch.cat([newest[16:], newest[:16]]))  # frames 48 to 79, then 32 to 47


@pytest.mark.parametrize("size", [400, 88])
def test_a_buffer_without_next_observations_gives_the_transitions_that_one_with_them_holds(tmp_path, size):
    """25 steps of 16 worlds in which nothing is learned: the two runs fly alike, one of them under a cap out of reach.

    A buffer of 88 rows is full after five and a half steps, so that later ones lie across its end.
    """
    settings = {"n_seeds": 2, "n_worlds": 16, "total_frames": 400, "learning_starts": 32, "lr": 0.0, "batch_size": 64}
    config = DQNConfig(**settings, buffer_size=size, compile="off")
    lean = watch(config, tmp_path / "lean")
    full = watch(replace(config, max_steps=10_000, buffer_size=400), tmp_path / "full")
    assert "observation" not in lean.buffer[:]["next"].keys()  # noqa: SIM118  (a TensorDict is not a dict)
    assert len(lean.minibatches) == len(full.minibatches) == 23 * 4
    for agent in (0, 1):
        everything = full.buffer[:][:, agent]
        collided = everything["next", "terminated"].squeeze(-1)
        everything["next", "observation"][collided] = 0.0  # worth nothing, and in the lean buffer another episode's
        places = defaultdict(list)  # those of equal transitions are told apart by none
        for place, row in enumerate(whole(everything).tolist()):
            places[tuple(row)].append(place)
        assert collided.sum() > 5
        for index, batch in enumerate(lean.minibatches):
            drawn = batch[agent].clone()
            drawn["next", "observation"][drawn["next", "terminated"].squeeze(-1)] = 0.0
            frames = 16 * (3 + index // 4)
            known = range(max(0, frames - size), frames - 16)  # of the newest step no successor is known
            assert all(any(place in known for place in places[tuple(row)]) for row in whole(drawn).tolist())


def test_targets_of_3_steps_sum_the_rewards_up_to_a_collision_and_bootstrap_where_there_was_none(tmp_path):
    """25 steps of 16 worlds in which nothing is learned, and every world's flight once more by a slow loop."""
    settings = {"n_seeds": 2, "n_worlds": 16, "total_frames": 400, "learning_starts": 32, "lr": 0.0, "batch_size": 64}
    seen = watch(DQNConfig(**settings, n_steps=3, gamma=0.5, compile="off"), tmp_path / "run")
    stored = seen.buffer[:]
    assert len(seen.minibatches) == 22 * 4  # the first step after frame 48
    for agent in (0, 1):
        own = stored[:, agent].reshape(25, 16)  # step, world
        reward, over = own["next", "reward"].squeeze(-1), own["next", "terminated"].squeeze(-1)
        expected = {}
        for step, world in itertools.product(range(22), range(16)):
            total, n, collided = 0.0, 0, False
            while n < 3 and not collided:
                total += 0.5**n * reward[step + n, world].item()
                collided = over[step + n, world].item()
                n += 1
            start = tuple(own["observation"][step, world].tolist()), own["action"][step, world].item()
            following = None if collided else tuple(own["observation"][step + 3, world].tolist())
            expected.setdefault(start, []).append((total, collided, following))
        drawn = torch.cat([batch[agent] for batch in seen.minibatches])
        assert 100 < drawn["next", "terminated"].sum() < 5000
        for row in drawn:
            worth = expected[tuple(row["observation"].tolist()), row["action"].item()]
            collided = row["next", "terminated"].item()
            following = None if collided else tuple(row["next", "observation"].tolist())
            assert any(
                total == pytest.approx(row["next", "reward"].item(), abs=1e-5) and (ends, then) == (collided, following)
                for total, ends, then in worth
            )


@pytest.mark.slow
@pytest.mark.compiled
def test_a_compiled_run_equals_an_eager_one_to_rounding(tmp_path):
    settings = {"n_seeds": 2, "total_frames": 160, "learning_starts": 32}
    runs = [train(DQNConfig(compile=c, **settings), out=tmp_path / c, quiet=True) for c in ("on", "off")]
    observation = torch.rand(50, 30)
    for seed in (0, 1):
        values = [uavnav.load_policy(run.path, seed=seed).values(observation) for run in runs]
        torch.testing.assert_close(values[0], values[1], rtol=1e-4, atol=1e-4)
    columns = ["frame", "layout", "steps", "turns", "distance"]
    assert runs[0].episodes[columns].equals(runs[1].episodes[columns])
