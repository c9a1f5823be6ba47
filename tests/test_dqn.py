"""DQN: the target by hand, Stable-Baselines3's own update, its schedules."""

import gymnasium
import peers
import pytest
import torch
from batches import transitions
from stable_baselines3 import DQN
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from tensordict import TensorDict

from uavnav.algorithms.dqn import PRESETS, DQNConfig, make_loss, make_network
from uavnav.tasks.seeding import Streams


def losses_by_row(batch, config):
    network = make_network(config)
    loss = make_loss(network, config)
    with torch.no_grad():
        for target in loss.target_value_network_params.values(True, True):
            target.mul_(0.5)  # so that online and target network differ
        return loss(batch.clone())["loss"].flatten(), network, loss


@pytest.mark.parametrize(
    ("kind", "gamma", "how"),
    [
        ("huber", 0.99, {}),
        ("squared", 0.99, {}),
        ("huber", 0.5, {}),
        ("squared", 0.99, {"double": True}),
        ("squared", 0.9, {"double": True, "n_steps": 4}),
        ("squared", 0.9, {"double": True, "n_steps": 4, "dueling": True, "max_steps": 9}),
        ("huber", 0.9, {"dueling": True}),
    ],
)
def test_the_loss_of_each_row_is_that_of_the_target_by_hand(kind, gamma, how):
    """Under a time limit, each row says after how many of its four steps it bootstraps."""
    config = DQNConfig(loss=kind, gamma=gamma, **how)
    batch = transitions(1, 8)
    # both ends, and what goes on
    assert 0 < batch["next", "terminated"].sum() < batch["next", "done"].sum() < 8
    steps = torch.full((1, 8, 1), config.n_steps)
    if config.max_steps:
        batch["steps_to_next_obs"] = steps = torch.arange(8).reshape(1, 8, 1) % 4 + 1
    got, network, _ = losses_by_row(batch, config)
    halved = make_network(config)
    for parameter in halved.parameters():
        parameter.data.mul_(0.5)

    def values(one, observation):
        outputs = one(observation)
        return (
            outputs[..., :1] + outputs[..., 1:] - outputs[..., 1:].mean(-1, True)
            if config.dueling
            else outputs
        )

    best_of = [values(one, batch["next", "observation"]).argmax(-1) for one in (network, halved)]
    assert (best_of[0] != best_of[1]).sum() > 2  # or the double estimate would be the same
    for row in range(8):
        observation, following = batch["observation"][:, row], batch["next", "observation"][:, row]
        prediction = values(network, observation)[0, batch["action"][0, row]].item()
        best = values(network if config.double else halved, following).argmax()
        worth = gamma ** steps[0, row].item() * values(halved, following)[0, best].item()
        bootstrap = 0.0 if batch["next", "terminated"][0, row] else worth
        error = abs(prediction - (batch["next", "reward"][0, row].item() + bootstrap))
        expected = error**2 if kind == "squared" else (0.5 * error**2 if error < 1 else error - 0.5)
        assert got[row].item() == pytest.approx(expected, abs=1e-5)


def test_two_rounds_of_4_updates_from_the_same_weights_and_draws_equal_sb3s():
    """Buffer, target, loss, clipping and Adam: the weights after SB3's train() within 1e-5 of ours.

    Six steps of 16 environments; a round follows the fifth and the sixth. Huber's slope is at most 1, so no
    reward takes this network's gradients to the default limit of 10: a limit among their norms clips some
    of the updates and leaves others alone.
    """
    limit = 0.75
    theirs = DQN(
        "MlpPolicy",
        gymnasium.make("uavnav/Drone-v0"),
        policy_kwargs={"activation_fn": peers.KINDS["sigmoid"]},
        learning_rate=1e-3,
        max_grad_norm=limit,
        buffer_size=100,
        seed=0,
    )
    config = DQNConfig(
        activation="sigmoid",
        max_grad_norm=limit,
        lr=1e-3,
        n_envs=16,
        total_frames=96,
        learning_starts=64,
        max_steps=1000,
    )
    ours = config.make(compile=False)
    network, other = ours.network, make_network(DQNConfig(activation="sigmoid", seed=7))
    with torch.no_grad():
        for target, value in zip(
            ours.loss.target_value_network_params.values(True, True),
            TensorDict.from_module(other).values(True, True),
            strict=True,
        ):
            target.copy_(value)
        for own, layers in ((network, theirs.q_net.q_net), (other, theirs.q_net_target.q_net)):
            for value, sb3 in peers.same_layers(own, layers):
                sb3.copy_(value)

    norms, step = [], ours.learner.step

    def watch(minibatch):
        losses = step(minibatch)
        norms.append(losses["grad_norm"].item())
        return losses

    ours.learner.step = watch
    draws = Streams([0], "replay")
    theirs._setup_learn(1)
    for filled in range(16, 97, 16):
        batch = transitions(1, 16, 1, seed=filled)
        batch["next", "reward"] *= filled / 16  # errors on both sides of Huber's knee
        ours.learn(batch, filled)
        assert len(norms) == 4 * max(0, filled // 16 - 4)
        if filled <= 64:
            continue
        assert len(ours.replay) == filled
        ring = ours.transitions.storage.ring
        drawn = draws.draw(torch.randint, filled, (4 * 32,), device="cpu")[0].split(32)
        samples = iter(
            ReplayBufferSamples(
                batch["observation"],
                batch["action"][:, None],
                batch["next", "observation"],
                batch["next", "terminated"].float(),
                batch["next", "reward"],
            )
            for batch in (
                ours.transitions.read(TensorDict({"places": index[:, None]}), ring) for index in drawn
            )
        )
        theirs.replay_buffer.sample = lambda *args, samples=samples, **kwargs: next(samples)
        theirs.train(gradient_steps=4, batch_size=32)
    assert len(norms) == 8
    assert min(norms) < limit < max(norms)
    for (value, sb3), (first, _) in zip(
        peers.same_layers(network, theirs.q_net.q_net),
        peers.same_layers(make_network(config), theirs.q_net.q_net),
        strict=True,
    ):
        torch.testing.assert_close(value, sb3.detach(), rtol=1e-5, atol=1e-5)
        assert (value - first).abs().max() > 1e-3


# -- its schedules -------------------------------------------------------------------------------------------


def test_epsilon_falls_from_1_to_5_percent_over_a_tenth_of_the_frames_once_learning_starts():
    config = DQNConfig()
    assert [config.epsilon(frames) for frames in (0, 49_984)] == [1.0, 1.0]
    assert config.epsilon(50_000) == pytest.approx(0.525)
    assert config.epsilon(75_000) == pytest.approx(0.2875)
    assert config.epsilon(100_000) == config.epsilon(1_000_000) == pytest.approx(0.05)
    assert PRESETS["vectorised-2.3"].epsilon(50_000) == pytest.approx(0.525)
    assert PRESETS["vectorised-2.3"].epsilon(1_000) == pytest.approx(0.9905)


def test_sixteen_updates_follow_each_step_of_64_worlds_and_four_of_16():
    assert DQNConfig(n_envs=64).updates_per_step == 16
    assert DQNConfig(n_envs=64).iterations * 16 == 250_000
    assert DQNConfig(n_envs=16).updates_per_step == 4
    assert DQNConfig(n_envs=1).updates_per_step == 1
    assert DQNConfig(n_envs=1).frames_per_iteration == 4
