"""PPO: closed forms, each agent alone, and Stable-Baselines3's own update."""

import gymnasium
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from tensordict import TensorDict
from torchrl.objectives.value import GAE

import uavnav
from uavnav.ppo import PPOConfig, SampledPolicy, agent_losses, estimate, make_learner, make_loss, make_networks, train


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
    """Advantages of one world by TorchRL's GAE as PPO uses it; values has one more entry than rewards."""
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
    GAE(gamma=gamma, lmbda=lmbda, value_network=None, vectorized=False)(batch)
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
    estimate(batch, loss, GAE(gamma=0.99, lmbda=0.95, value_network=None, vectorized=False))
    v = value(batch["observation"]).flatten()
    terminal = value(batch["next", "observation"]).flatten()[2]
    torch.testing.assert_close(batch["advantage"].flatten()[2], 0.09 + 0.99 * terminal - v[2], rtol=1e-5, atol=1e-6)


def test_the_gradient_of_3_agents_is_each_ones_own():
    config = PPOConfig(n_seeds=3, entropy_coeff=0.01)
    batch = rollout(3, 64, dtype=torch.float64)

    def gradient(policy, value, rows):
        return make_learner(make_loss(policy, value, config), config, compile=False).gradient(rows)[0]

    policy, value = (network.double() for network in make_networks(config))
    population = gradient(policy, value, batch)
    for agent in range(3):
        alone = PPOConfig(seed=agent, entropy_coeff=0.01)
        own = gradient(*(network.double() for network in make_networks(alone)), batch[agent : agent + 1])
        for name, part in own.items():
            assert part.abs().max() > 0
            torch.testing.assert_close(population[name][agent], part[0], rtol=1e-12, atol=1e-12)


def test_20_updates_of_seed_1_among_3_are_those_of_seed_1_alone(tmp_path):
    settings = {"total_frames": 128, "frames_per_batch": 128, "epochs": 10, "n_worlds": 8, "compile": "off"}
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
    among = SampledPolicy(make_networks(many)[0], many, compile=False)
    alone = SampledPolicy(make_networks(one)[0], one, compile=False)
    for _ in range(5):
        assert torch.equal(among(observation)[2], alone(observation[2:])[0])


class KeepNextObservations(BaseCallback):
    """Collects what SB3's rollout buffer does not hold."""

    def _on_training_start(self):
        self.observations, self.rewards, self.dones = [], [], []

    def _on_step(self):
        self.observations.append(torch.as_tensor(self.locals["new_obs"]).clone())
        self.rewards.append(torch.as_tensor(self.locals["rewards"]).clone())
        self.dones.append(torch.as_tensor(self.locals["dones"]).clone())
        return True


@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_ten_epochs_from_the_same_weights_and_rollout_equal_sb3s(activation):
    """GAE, the loss, clipping and Adam: the weights after SB3's train() within 1e-5 of ours."""
    steps = 128
    theirs = PPO(
        "MlpPolicy",
        gymnasium.make("uavnav/Drone-v0"),
        n_steps=steps,
        batch_size=steps,  # one minibatch an epoch, so that its order does not matter
        n_epochs=10,
        policy_kwargs={"activation_fn": {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}[activation]},
        seed=0,
    )
    config = PPOConfig(activation=activation, frames_per_batch=steps, minibatch_size=steps)
    policy, value = make_networks(config)
    copy_to_sb3(policy, [*theirs.policy.mlp_extractor.policy_net, theirs.policy.action_net])
    copy_to_sb3(value, [*theirs.policy.mlp_extractor.value_net, theirs.policy.value_net])

    keep = KeepNextObservations()
    _, callback = theirs._setup_learn(steps, keep)
    callback.on_training_start({}, {})
    assert theirs.collect_rollouts(theirs.env, callback, theirs.rollout_buffer, steps)
    buffer = theirs.rollout_buffer
    following = torch.stack(keep.observations).transpose(0, 1)[None]
    done = torch.stack(keep.dones).transpose(0, 1)[None, ..., None]
    assert done.sum() >= 1
    batch = TensorDict(
        {
            "observation": torch.as_tensor(buffer.observations).transpose(0, 1)[None],
            "action": torch.as_tensor(buffer.actions).long().squeeze(-1).T[None],
            "next": {
                "observation": following,
                "reward": torch.stack(keep.rewards).T[None, ..., None].float(),
                "done": done,
                "terminated": done,
            },
        },
        [1, 1, steps],
    )
    loss = make_loss(policy, value, config)
    estimate(batch, loss, GAE(gamma=config.gamma, lmbda=config.gae_lambda, value_network=None, vectorized=False))
    close = {"rtol": 1e-5, "atol": 1e-5}
    torch.testing.assert_close(batch["action_log_prob"].flatten(), torch.as_tensor(buffer.log_probs).flatten(), **close)
    torch.testing.assert_close(batch["advantage"].flatten(), torch.as_tensor(buffer.advantages).flatten(), **close)
    torch.testing.assert_close(batch["value_target"].flatten(), torch.as_tensor(buffer.returns).flatten(), **close)

    learner = make_learner(loss, config, compile=False)
    for _ in range(10):
        learner.step(batch.reshape(1, steps))
    theirs._current_progress_remaining = 1.0
    theirs.train()
    for network, layers in (
        (policy, [*theirs.policy.mlp_extractor.policy_net, theirs.policy.action_net]),
        (value, [*theirs.policy.mlp_extractor.value_net, theirs.policy.value_net]),
    ):
        for ours, sb3 in weights(network, layers):
            torch.testing.assert_close(ours, sb3.detach(), **close)
    before = make_networks(config)[0]
    moved = max((a - b).abs().max().item() for a, b in zip(before.parameters(), policy.parameters(), strict=True))
    assert moved > 1e-3


def weights(network, layers):
    """Pairs of our agent 0's tensors, in PyTorch's layout, and those of PyTorch's layers."""
    linears = [layer for layer in layers if isinstance(layer, torch.nn.Linear)]
    for ours, theirs in zip(network[::2], linears, strict=True):
        yield ours.weight.detach()[0].T, theirs.weight
        yield ours.bias.detach()[0, 0], theirs.bias


def copy_to_sb3(network, layers):
    for ours, theirs in weights(network, layers):
        theirs.data.copy_(ours)


def test_agent_losses_are_means_over_each_agents_rows():
    losses = TensorDict({"loss_objective": torch.arange(6.0).reshape(2, 3), "loss_critic": torch.ones(2, 3, 1)}, [])
    result = agent_losses(losses)
    assert result["loss_objective"].tolist() == [1.0, 4.0]
    assert result["loss_critic"].tolist() == [1.0, 1.0]


def test_one_million_frames_are_489_whole_iterations():
    config = PPOConfig()
    assert config.iterations == 489
    assert config.iterations * config.frames_per_batch == 1_001_472


@pytest.mark.slow
@pytest.mark.compiled
def test_a_compiled_run_equals_an_eager_one_to_rounding(tmp_path):
    settings = {"n_seeds": 2, "total_frames": 256, "frames_per_batch": 128, "epochs": 2, "n_worlds": 8}
    runs = [train(PPOConfig(compile=c, **settings), out=tmp_path / c, quiet=True) for c in ("on", "off")]
    observation = torch.rand(50, 30)
    for seed in (0, 1):
        values = [uavnav.load_policy(run.path, seed=seed).values(observation) for run in runs]
        torch.testing.assert_close(values[0], values[1], rtol=1e-4, atol=1e-4)
    columns = ["frame", "layout", "steps", "turns", "distance"]
    assert runs[0].episodes[columns].equals(runs[1].episodes[columns])
