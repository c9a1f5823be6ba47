"""PPO: closed forms, each agent alone, Stable-Baselines3's own update, and compiled as eager."""

import numpy as np
import peers
import pytest
import stable_baselines3
import torch
from tensordict import TensorDict

import uavnav
from uavnav.algorithms.ppo import (
    PPOConfig,
    estimate,
    make_advantage,
    make_learner,
    make_loss,
    make_networks,
    rows,
    train,
)
from uavnav.tasks.seeding import Streams
from uavnav.training.recorder import Interrupted

CLOSE = {"rtol": 1e-5, "atol": 1e-5}


def rollout(*shape, dtype=torch.float32, seed=0):
    """A made-up rollout of any shape with what the loss needs."""
    g = torch.Generator().manual_seed(seed)
    return TensorDict(
        {
            "observation": torch.rand(*shape, 30, generator=g, dtype=dtype),
            "action": torch.randint(100, shape, generator=g),
            "action_log_prob": -4.6 + 0.3 * torch.randn(*shape, generator=g, dtype=dtype),
            "advantage": torch.randn(*shape, 1, generator=g, dtype=dtype),
            "value_target": torch.randn(*shape, 1, generator=g, dtype=dtype),
        },
        list(shape),
    )


def gae(rewards, values, terminated, truncated, gamma=0.9, lmbda=0.8):
    """Advantages of one world as PPO's; values has one more entry than rewards."""
    steps = len(rewards)
    done = torch.tensor(terminated) | torch.tensor(truncated)
    batch = TensorDict(
        {
            "state_value": torch.tensor(values[:steps])[None, None, :, None],
            "next": {
                "state_value": torch.tensor(values[1:])[None, None, :, None],
                "reward": torch.tensor(rewards)[None, None, :, None],
                "done": done[None, None, :, None],
                "terminated": torch.tensor(terminated)[None, None, :, None],
            },
        },
        [1, 1, steps],
    )
    make_advantage(gamma, lmbda)(batch)
    torch.testing.assert_close(batch["value_target"], batch["advantage"] + batch["state_value"])
    return batch["advantage"].flatten().tolist()


NO = [False, False, False]


def test_gae_of_three_steps_is_the_sum_by_hand():
    d0, d1, d2 = 1 + 0.9 * 5 - 4, 2 + 0.9 * 6 - 5, 3 + 0.9 * 7 - 6
    expected = [d0 + 0.72 * (d1 + 0.72 * d2), d1 + 0.72 * d2, d2]
    assert gae([1.0, 2.0, 3.0], [4.0, 5.0, 6.0, 7.0], NO, NO) == pytest.approx(expected, abs=1e-6)


def test_a_collision_cuts_both_the_value_and_the_sum():
    expected_1 = 2 - 5.0
    got = gae([1.0, 2.0, 3.0], [4.0, 5.0, 6.0, 7.0], [False, True, False], NO)
    assert got == pytest.approx([1 + 0.9 * 5 - 4 + 0.72 * expected_1, expected_1, 3 + 0.9 * 7 - 6], abs=1e-6)


def test_a_truncation_bootstraps_the_value_and_cuts_the_sum():
    expected_1 = 2 + 0.9 * 6 - 5.0
    got = gae([1.0, 2.0, 3.0], [4.0, 5.0, 6.0, 7.0], NO, [False, True, False])
    assert got == pytest.approx([1 + 0.9 * 5 - 4 + 0.72 * expected_1, expected_1, 3 + 0.9 * 7 - 6], abs=1e-6)
    taken_for_a_collision = gae([1.0, 2.0, 3.0], [4.0, 5.0, 6.0, 7.0], [False, True, False], NO)
    assert abs(got[1] - taken_for_a_collision[1]) > 5  # the negative control: 0.9 x V(s') = 5.4


def test_estimate_bootstraps_a_truncated_flight_from_its_own_last_observation():
    config = PPOConfig()
    policy, value = make_networks(config)
    loss = make_loss(policy, value, config)
    env = uavnav.DroneEnv([1, 1], max_steps=3)
    batch = env.rollout(7, lambda td: td.set("action", torch.full((1, 1), 9)), break_when_any_done=False)
    assert batch["next", "truncated"].flatten().tolist() == [False, False, True] * 2 + [False]
    estimate(batch, loss, make_advantage(config.gamma, config.gae_lambda))
    v = value(batch["observation"]).flatten()
    terminal = value(batch["next", "observation"]).flatten()[2]
    torch.testing.assert_close(batch["advantage"].flatten()[2], 0.09 + 0.99 * terminal - v[2], rtol=1e-5, atol=1e-6)


def test_rows_keep_agent_world_and_time_together():
    """Entry (agent 1, world 2, time 3) is 123 in every key."""
    agent, world, time = torch.meshgrid(torch.arange(2), torch.arange(3), torch.arange(4), indexing="ij")
    code = (100 * agent + 10 * world + time).float()
    names = ("action", "action_log_prob")
    batch = TensorDict({name: code.clone() for name in names}, [2, 3, 4])
    batch["observation"] = code[..., None].repeat(1, 1, 1, 30)
    batch["advantage"], batch["value_target"] = code[..., None].clone(), code[..., None].clone()
    got = rows(batch)
    assert got.batch_size == (12, 2)
    for row in range(12):
        for column in range(2):
            entry = got[row, column]
            assert len({number for value in entry.values() for number in value.flatten().tolist()}) == 1
    for column in range(2):
        assert sorted(got["action"][:, column].tolist()) == code[column].flatten().tolist()


def test_the_gradient_of_3_agents_is_each_ones_own():
    config = PPOConfig(n_seeds=3, entropy_coeff=0.01)
    batch = rollout(3, 64, dtype=torch.float64)

    def gradient(policy, value, rows):
        return make_learner(make_loss(policy, value, config), config, compile=False).gradient(rows)

    policy, value = (network.double() for network in make_networks(config))
    population = gradient(policy, value, batch)
    for agent in range(3):
        alone = PPOConfig(seed=agent, entropy_coeff=0.01)
        own = gradient(*(network.double() for network in make_networks(alone)), batch[agent : agent + 1])
        for name, part in own.items():
            assert part.abs().max() > 0
            torch.testing.assert_close(population[name][agent], part[0], rtol=1e-12, atol=1e-12)


def test_20_updates_of_seed_1_among_3_are_those_of_seed_1_alone(tmp_path):
    settings = {"total_frames": 128, "frames_per_batch": 128, "epochs": 10, "n_envs": 8, "compile": "off"}
    among = train(PPOConfig(n_seeds=3, **settings), out=tmp_path / "three", quiet=True)
    alone = train(PPOConfig(seed=1, **settings), out=tmp_path / "one", quiet=True)
    observation = torch.rand(50, 30)
    before = make_networks(PPOConfig(seed=1))[0](observation[None])[0]
    values = [uavnav.load_policy(run.path, seed=1).values(observation) for run in (among, alone)]
    torch.testing.assert_close(values[0], values[1], rtol=1e-5, atol=1e-5)
    assert (values[0] - before).abs().max() > 1e-3  # it did learn
    own = among.episodes[among.episodes.seed == 1].reset_index(drop=True)
    assert own.equals(alone.episodes)


def test_collected_actions_of_a_seed_do_not_depend_on_the_other_seeds():
    many, one = PPOConfig(n_seeds=3), PPOConfig(seed=2)
    observation = torch.rand(3, 16, 30)
    among, alone = many.make(compile=False).actor, one.make(compile=False).actor
    for _ in range(5):
        assert torch.equal(among.act(observation)[2], alone.act(observation[2:])[0])


def test_100_000_collected_actions_of_2_seeds_follow_the_same_softmax_and_are_not_the_same():
    config = PPOConfig(n_seeds=2)
    ppo = config.make(compile=False)
    policy = ppo.policy
    logits = torch.linspace(-3, 3, 100)
    policy[-1].weight.data.zero_()
    policy[-1].bias.data.copy_(logits.expand(2, 1, 100))
    actions = ppo.actor.act(torch.rand(2, 100_000, 30))
    for drawn in actions:
        shares = torch.bincount(drawn, minlength=100) / 100_000
        assert (shares - logits.softmax(0)).abs().max() < 0.004
    assert logits.softmax(0).max() > 0.05
    assert (actions[0] == actions[1]).float().mean() < 0.1


# -- an iteration, against Stable-Baselines3's -----------------------------------------------------------------------


@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_12_minibatches_of_a_rollout_in_the_same_order_equal_sb3s_train(activation, monkeypatch):
    """Two worlds of 64 steps, three epochs of four minibatches: weights within 1e-5, with ratios and norms clipped."""
    shared = {"ent_coef": 0.02, "max_grad_norm": 1.5, "learning_rate": 3e-3, "n_epochs": 3, "batch_size": 32}
    theirs = peers.on_policy(stable_baselines3.PPO, activation, steps=64, max_steps=24, **shared)
    config = PPOConfig(
        activation=activation,
        n_envs=2,
        frames_per_batch=128,
        minibatch_size=32,
        epochs=3,
        entropy_coeff=0.02,
        max_grad_norm=1.5,
        lr=3e-3,
    )
    ours = config.make(compile=False)
    pairs = peers.actor_critic(ours.policy, ours.value, theirs)
    before = [own.clone() for own, _ in pairs]
    for own, sb3 in pairs:
        sb3.data.copy_(own)
    batch, buffer = peers.rollout(theirs, 128), theirs.rollout_buffer
    done, terminated = batch["next", "done"], batch["next", "terminated"]
    assert (done & ~terminated).sum() >= 2
    assert terminated.sum() >= 1
    norms, step = [], ours.learner.step

    def watch(minibatch):
        losses = step(minibatch)
        norms.append(losses["grad_norm"].item())
        return losses

    ours.learner.step = watch
    ours.learn(batch, 128)
    torch.testing.assert_close(batch["action_log_prob"][0].T, torch.as_tensor(buffer.log_probs), **CLOSE)
    torch.testing.assert_close(batch["advantage"][0, ..., 0].T, torch.as_tensor(buffer.advantages), **CLOSE)
    torch.testing.assert_close(batch["value_target"][0, ..., 0].T, torch.as_tensor(buffer.returns), **CLOSE)
    order = Streams([0], "minibatches")
    with monkeypatch.context() as patch:
        patch.setattr(np.random, "permutation", lambda n: order.draw(torch.randperm, n, device="cpu")[0].numpy())
        theirs._current_progress_remaining = 1.0
        theirs.train()
    assert len(norms) == 12
    assert min(norms) < config.max_grad_norm < max(norms)
    assert theirs.logger.name_to_value["train/clip_fraction"] > 0.05
    for (own, sb3), first in zip(pairs, before, strict=True):
        torch.testing.assert_close(own, sb3.detach(), **CLOSE)
        assert (own - first).abs().max() > 1e-3


def test_train_takes_one_thread_and_gives_its_callers_3_back(tmp_path):
    config = PPOConfig(total_frames=128, frames_per_batch=64, n_envs=2, epochs=1, compile="off")
    try:
        torch.set_num_threads(3)
        with pytest.raises(Interrupted):
            train(config, out=tmp_path / "run", quiet=True, until=64)
        assert torch.get_num_threads() == 3
        assert train(config, out=tmp_path / "run", quiet=True).meta["threads"] == 1
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(1)


def test_one_million_frames_are_489_whole_iterations():
    config = PPOConfig()
    assert config.iterations == 489
    assert config.frames == 1_001_472


def test_without_a_clip_the_loss_is_the_plain_ratio_times_advantage_and_with_0_2_it_is_not():
    """An objective of ratios far from 1, as `clip_epsilon=null` asks: -mean(ratio A)."""
    losses = {}
    for clip in (None, 0.2):
        config = PPOConfig(n_seeds=2, clip_epsilon=clip, compile="off")
        loss = make_loss(*make_networks(config), config)
        generator = torch.Generator().manual_seed(0)
        batch = TensorDict(
            {
                "observation": torch.rand(2, 64, 30, generator=generator),
                "action": torch.randint(100, (2, 64), generator=generator),
                "action_log_prob": -5.0 + torch.randn(2, 64, generator=generator),
                "advantage": torch.randn(2, 64, 1, generator=generator),
                "value_target": torch.zeros(2, 64, 1),
            },
            [2, 64],
        )
        log_prob = loss.actor_network.get_dist(batch).log_prob(batch["action"])
        advantage = batch["advantage"] - batch["advantage"].mean(1, keepdim=True)
        advantage = (advantage / batch["advantage"].std(1, keepdim=True))[..., 0]
        plain = -(log_prob - batch["action_log_prob"]).exp() * advantage
        losses[clip] = loss(batch)["loss_objective"].squeeze(-1), plain
    torch.testing.assert_close(*losses[None], rtol=1e-4, atol=1e-5)
    assert not torch.allclose(*losses[0.2], rtol=0.1)
