"""DQN: the target by hand, each agent alone, Stable-Baselines3's own update, and its schedules."""

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import DQN
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from tensordict import TensorDict

import uavnav
from uavnav.config import ConfigError
from uavnav.dqn import PRESETS, DQNConfig, ExploringPolicy, make_learner, make_loss, make_network, train


def transitions(*shape, dtype=torch.float32, seed=0):
    """Made-up transitions of any shape; a quarter of them end in a collision."""
    g = torch.Generator().manual_seed(seed)
    terminated = torch.rand(*shape, 1, generator=g) < 0.25
    return TensorDict(
        {
            "observation": torch.rand(*shape, 30, generator=g, dtype=dtype),
            "action": torch.randint(100, shape, generator=g),
            "next": TensorDict(
                {
                    "observation": torch.rand(*shape, 30, generator=g, dtype=dtype),
                    "reward": torch.randn(*shape, 1, generator=g, dtype=dtype),
                    "done": terminated,
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


@pytest.mark.parametrize("kind", ["huber", "squared"])
def test_the_loss_of_each_row_is_that_of_the_target_by_hand(kind):
    config = DQNConfig(loss=kind)
    batch = transitions(1, 8)
    got, network, _ = losses_by_row(batch, config)
    halved = make_network(config)
    for parameter in halved.parameters():
        parameter.data.mul_(0.5)
    for row in range(8):
        observation, following = batch["observation"][:, row], batch["next", "observation"][:, row]
        prediction = network(observation)[0, batch["action"][0, row]].item()
        bootstrap = 0.0 if batch["next", "terminated"][0, row] else 0.99 * halved(following).max().item()
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
    population, _ = make_learner(loss, population_config, compile=False).gradient(batch)
    for agent in range(3):
        config = DQNConfig(seed=agent)
        learner = make_learner(make_loss(make_network(config).double(), config), config, compile=False)
        own, _ = learner.gradient(batch[agent : agent + 1])
        for name, part in own.items():
            assert part.abs().max() > 0
            torch.testing.assert_close(population[name][agent], part[0], rtol=1e-12, atol=1e-12)


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


@pytest.mark.parametrize("activation", ["sigmoid", "leaky_relu"])
def test_five_updates_from_the_same_weights_and_batches_equal_sb3s(activation):
    """Target, loss, clipping and Adam: the weights after SB3's train() within 1e-5 of ours."""
    kinds = {"sigmoid": torch.nn.Sigmoid, "leaky_relu": torch.nn.LeakyReLU}
    theirs = DQN(
        "MlpPolicy",
        gymnasium.make("uavnav/Drone-v0"),
        policy_kwargs={"activation_fn": kinds[activation]},
        buffer_size=100,
        seed=0,
    )
    config = DQNConfig(activation=activation)
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
    batches = [transitions(1, 32, seed=seed) for seed in range(5)]
    samples = iter(
        ReplayBufferSamples(
            batch["observation"][0],
            batch["action"][0][:, None],
            batch["next", "observation"][0],
            batch["next", "terminated"][0].float(),
            batch["next", "reward"][0],
        )
        for batch in batches
    )
    theirs.replay_buffer.sample = lambda *args, **kwargs: next(samples)
    theirs._setup_learn(1)
    for batch in batches:
        learner.step(batch)
    theirs.train(gradient_steps=5, batch_size=32)
    linears = [layer for layer in theirs.q_net.q_net if isinstance(layer, torch.nn.Linear)]
    start = make_network(config)
    for layer, linear, first in zip(network[::2], linears, start[::2], strict=True):
        torch.testing.assert_close(layer.weight[0].T, linear.weight, rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(layer.bias[0, 0], linear.bias, rtol=1e-5, atol=1e-5)
        assert (layer.weight - first.weight).abs().max() > 1e-4


def test_epsilon_falls_from_1_to_5_percent_over_a_tenth_of_the_frames_once_learning_starts():
    config = DQNConfig()
    assert [config.epsilon(frames) for frames in (0, 49_984)] == [1.0, 1.0]
    assert config.epsilon(50_000) == pytest.approx(0.525)
    assert config.epsilon(75_000) == pytest.approx(0.2875)
    assert config.epsilon(100_000) == config.epsilon(1_000_000) == pytest.approx(0.05)
    assert PRESETS["paper-2.3"].epsilon(50_000) == pytest.approx(0.525)
    assert PRESETS["paper-2.3"].epsilon(1_000) == pytest.approx(0.9905)


def test_before_learning_starts_every_action_is_random_and_no_weight_moves(tmp_path):
    run = train(DQNConfig(total_frames=4_000, learning_starts=4_000, compile="off"), out=tmp_path / "r", quiet=True)
    counts = run.episodes.sum()
    assert abs(counts.turns / counts.steps - 0.9) < 0.02
    observation = torch.rand(5, 30)
    before = make_network(DQNConfig())(observation[None])[0]
    assert torch.equal(uavnav.load_policy(run.path).values(observation), before)


def test_the_target_is_copied_every_64_frames(tmp_path, monkeypatch):
    """At 16 worlds: after steps 4, 8 and 12, and what was copied are the weights of that moment."""
    config = DQNConfig(total_frames=16 * 13, learning_starts=16, target_update_frames=64, lr=1e-2, compile="off")
    kept = {}
    monkeypatch.setattr(
        "uavnav.dqn.make_loss", lambda network, config: kept.setdefault("loss", make_loss(network, config))
    )
    targets, online = [], []
    original = uavnav.runs.Recorder.add_episodes

    def watch(self, following, frame):
        targets.append(torch.cat([v.flatten() for v in kept["loss"].target_value_network_params.values(True, True)]))
        online.append(torch.cat([v.detach().flatten() for v in kept["loss"].value_network_params.values(True, True)]))
        original(self, following, frame)

    monkeypatch.setattr("uavnav.runs.Recorder.add_episodes", watch)
    train(config, out=tmp_path / "r", quiet=True)
    copied = [step for step in range(1, 13) if not torch.equal(targets[step], targets[step - 1])]
    assert copied == [4, 8, 12]  # seen at the beginning of the step after
    for step in copied:
        assert torch.equal(targets[step], online[step - 1])  # before that step's own updates


def test_four_updates_follow_each_step_of_16_worlds():
    assert DQNConfig().updates_per_step == 4
    assert DQNConfig().iterations * 4 == 250_000
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
        assert torch.equal(among(observation)[2], alone(observation[2:])[0])


def test_the_buffer_forgets_the_oldest_frames_beyond_its_size(tmp_path):
    """With 32 of 96 frames kept, learning goes on from recent ones alone, and nothing breaks at the seam."""
    run = train(
        DQNConfig(total_frames=96, buffer_size=32, learning_starts=16, batch_size=4, compile="off"),
        out=tmp_path / "r",
        quiet=True,
    )
    assert run.frames == 96
    assert np.isfinite(run.progress["loss"].iloc[-1])


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
