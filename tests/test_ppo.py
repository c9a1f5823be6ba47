"""PPO: closed forms, each agent alone, Stable-Baselines3's own update, and a whole run against plain PyTorch."""

import functools
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import explained_variance
from stable_baselines3.common.vec_env import DummyVecEnv
from tensordict import TensorDict
from torch.distributions import Categorical

import uavnav
from uavnav.algorithms.ppo import (
    PPOConfig,
    SampledPolicy,
    estimate,
    learn,
    make_advantage,
    make_buffer,
    make_learner,
    make_loss,
    make_networks,
    rows,
    train,
)
from uavnav.tasks.seeding import Streams
from uavnav.tasks.world import World
from uavnav.training.learner import Learner
from uavnav.training.recorder import Interrupted
from uavnav.training.sampler import AgentSampler

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
    make_advantage(PPOConfig(gamma=gamma, gae_lambda=lmbda))(batch)
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
    estimate(batch, loss, make_advantage(config))
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
        assert torch.equal(among.act(observation)[2], alone.act(observation[2:])[0])


def test_100_000_collected_actions_of_2_seeds_follow_the_same_softmax_and_are_not_the_same():
    config = PPOConfig(n_seeds=2)
    policy, _ = make_networks(config)
    logits = torch.linspace(-3, 3, 100)
    policy[-1].weight.data.zero_()
    policy[-1].bias.data.copy_(logits.expand(2, 1, 100))
    actions = SampledPolicy(policy, config, compile=False).act(torch.rand(2, 100_000, 30))
    for drawn in actions:
        shares = torch.bincount(drawn, minlength=100) / 100_000
        assert (shares - logits.softmax(0)).abs().max() < 0.004
    assert logits.softmax(0).max() > 0.05
    assert (actions[0] == actions[1]).float().mean() < 0.1


# -- an iteration, against Stable-Baselines3's -----------------------------------------------------------------------


class Transitions(BaseCallback):
    """What SB3's rollout buffer does not hold: where each step really led, its bare reward, and how it ended."""

    def _on_training_start(self):
        self.steps = []

    def _on_step(self):
        infos, done = self.locals["infos"], self.locals["dones"]
        following = self.locals["new_obs"].copy()
        for world in np.flatnonzero(done):
            following[world] = infos[world]["terminal_observation"]
        truncated = np.array([info["TimeLimit.truncated"] for info in infos])
        self.steps.append((following, self.locals["rewards"].copy(), done.copy(), done & ~truncated))
        return True

    def by_world(self):
        """Each as [1, W, T, ...]."""
        return [torch.as_tensor(np.stack(field, axis=1))[None] for field in zip(*self.steps, strict=True)]


@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_12_minibatches_of_a_rollout_in_the_same_order_equal_sb3s_train(activation, monkeypatch):
    """Two worlds of 64 steps, three epochs of four minibatches: weights within 1e-5, with ratios and norms clipped."""
    steps, frames = 64, 128
    shared = {"ent_coef": 0.02, "max_grad_norm": 1.5, "learning_rate": 3e-3, "n_epochs": 3, "batch_size": 32}
    theirs = PPO(
        "MlpPolicy",
        DummyVecEnv([functools.partial(gymnasium.make, "uavnav/Drone-v0", max_steps=24)] * 2),
        n_steps=steps,
        policy_kwargs={"activation_fn": {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU}[activation]},
        seed=0,
        **shared,
    )
    config = PPOConfig(
        activation=activation,
        n_worlds=2,
        frames_per_batch=frames,
        minibatch_size=32,
        epochs=3,
        entropy_coeff=0.02,
        max_grad_norm=1.5,
        lr=3e-3,
    )
    policy, value = make_networks(config)
    extractor = theirs.policy.mlp_extractor
    pairs = [
        *same_layers(policy, [*extractor.policy_net, theirs.policy.action_net]),
        *same_layers(value, [*extractor.value_net, theirs.policy.value_net]),
    ]
    before = [ours.clone() for ours, _ in pairs]
    for ours, sb3 in pairs:
        sb3.data.copy_(ours)

    kept = Transitions()
    _, callback = theirs._setup_learn(frames, kept)
    callback.on_training_start({}, {})
    buffer = theirs.rollout_buffer
    assert theirs.collect_rollouts(theirs.env, callback, buffer, steps)
    following, reward, done, terminated = kept.by_world()
    assert (done & ~terminated).sum() >= 2
    assert terminated.sum() >= 1
    batch = TensorDict(
        {
            "observation": torch.as_tensor(buffer.observations).transpose(0, 1)[None],
            "action": torch.as_tensor(buffer.actions).long().squeeze(-1).T[None],
            "next": {
                "observation": following,
                "reward": reward[..., None],
                "done": done[..., None],
                "terminated": terminated[..., None],
            },
        },
        [1, 2, steps],
    )
    loss = make_loss(policy, value, config)
    estimate(batch, loss, make_advantage(config))
    torch.testing.assert_close(batch["action_log_prob"][0].T, torch.as_tensor(buffer.log_probs), **CLOSE)
    torch.testing.assert_close(batch["advantage"][0, ..., 0].T, torch.as_tensor(buffer.advantages), **CLOSE)
    torch.testing.assert_close(batch["value_target"][0, ..., 0].T, torch.as_tensor(buffer.returns), **CLOSE)

    learner = make_learner(loss, config, compile=False)
    norms, step = [], learner.step

    def watch(minibatch):
        losses = step(minibatch)
        norms.append(losses["grad_norm"].item())
        return losses

    learner.step = watch
    learn(batch, make_buffer(AgentSampler([0], "minibatches", replace=False), config), learner, config)
    order = Streams([0], "minibatches")
    with monkeypatch.context() as patch:
        patch.setattr(np.random, "permutation", lambda n: order.draw(torch.randperm, n, device="cpu")[0].numpy())
        theirs._current_progress_remaining = 1.0
        theirs.train()
    assert len(norms) == 12
    assert min(norms) < config.max_grad_norm < max(norms)
    assert theirs.logger.name_to_value["train/clip_fraction"] > 0.05
    for (ours, sb3), first in zip(pairs, before, strict=True):
        torch.testing.assert_close(ours, sb3.detach(), **CLOSE)
        assert (ours - first).abs().max() > 1e-3


def same_layers(network, layers):
    """Pairs of our agent 0's tensors, in PyTorch's layout, and those of PyTorch's layers."""
    linears = [layer for layer in layers if isinstance(layer, torch.nn.Linear)]
    for ours, theirs in zip(network[::2], linears, strict=True):
        yield ours.weight.detach()[0].T, theirs.weight
        yield ours.bias.detach()[0, 0], theirs.bias


# -- a whole run, watched --------------------------------------------------------------------------------------------

SWITCHES = {"slots": "listed", "padding": "zeros", "start_heading": "random"}
WATCHED = PPOConfig(
    seed=3,
    n_seeds=2,
    n_worlds=4,
    total_frames=384,
    frames_per_batch=192,
    minibatch_size=48,
    epochs=3,
    hidden=(32,),
    init="default",
    activation="relu",
    lr=2e-2,
    adam_eps=1e-4,
    gamma=0.8,
    gae_lambda=0.6,
    clip_epsilon=0.1,
    critic_coeff=0.7,
    entropy_coeff=0.05,
    max_grad_norm=0.4,
    max_steps=20,
    reward="initial",
    compile="off",
    **SWITCHES,
)
"""Two iterations of three epochs of four minibatches, and no default that matters."""


@pytest.fixture(scope="module")
def watched(tmp_path_factory):
    """The run, its rollouts [A, W, T] as estimated, each minibatch [A, N] and what the learner returned for it."""
    rollouts, minibatches, losses = [], [], []
    step = Learner.step

    def watch_estimate(batch, *how):
        estimate(batch, *how)
        rollouts.append(batch.clone())

    def watch_step(self, minibatch):
        minibatches.append(minibatch.clone())
        losses.append(step(self, minibatch))
        return losses[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("uavnav.algorithms.ppo.estimate", watch_estimate)
        patch.setattr(Learner, "step", watch_step)
        run = train(WATCHED, out=tmp_path_factory.mktemp("watched") / "run", quiet=True)
    return SimpleNamespace(run=run, rollouts=rollouts, minibatches=minibatches, losses=losses)


def test_2_iterations_of_3_epochs_learn_24_times_from_48_rows_of_each_agent(watched):
    assert [batch.batch_size for batch in watched.rollouts] == [(2, 4, 48)] * 2
    assert [batch.batch_size for batch in watched.minibatches] == [(2, 48)] * 24


def test_each_of_192_rows_is_learned_from_once_an_epoch_by_its_own_agent(watched):
    def whole(batch):
        names = ("observation", "action", "action_log_prob", "advantage", "value_target")
        return torch.cat([batch[name].reshape(192, -1) for name in names], 1)

    for agent, seed in enumerate(WATCHED.seeds):
        order = Streams([seed], "minibatches")
        for epoch in range(6):
            collected = whole(watched.rollouts[epoch // 3][agent])
            used = whole(torch.cat([batch[agent] for batch in watched.minibatches[4 * epoch : 4 * epoch + 4]]))
            assert torch.equal(used, collected[order.draw(torch.randperm, 192, device="cpu")[0]])


def test_a_row_of_progress_is_the_mean_over_its_iterations_12_minibatches(watched):
    progress = watched.run.progress
    assert progress.frame.tolist() == [192, 192, 384, 384]
    assert progress.seed.tolist() == [3, 4, 3, 4]
    for name in ("loss_objective", "loss_critic", "loss_entropy", "grad_norm"):
        by_step = torch.stack([losses[name] for losses in watched.losses]).reshape(2, 12, 2)
        assert by_step.std(1).min() > 0
        np.testing.assert_allclose(progress[name], by_step.mean(1).flatten(), rtol=1e-5, atol=1e-7)


def test_the_runs_advantages_are_the_sums_by_hand_with_its_gamma_of_0_8_and_lambda_of_0_6(watched):
    ends = 0
    for batch in watched.rollouts:
        value, following = batch["state_value"][..., 0], batch["next", "state_value"][..., 0]
        reward, done, terminated = (batch["next", name][..., 0] for name in ("reward", "done", "terminated"))
        ends += terminated.sum().item()
        total = torch.zeros(2, 4)
        for t in reversed(range(48)):
            bootstrap = torch.where(terminated[..., t], 0.0, 0.8 * following[..., t])
            delta = reward[..., t] + bootstrap - value[..., t]
            total = delta + torch.where(done[..., t], 0.0, 0.8 * 0.6 * total)
            torch.testing.assert_close(batch["advantage"][..., t, 0], total, **CLOSE)
    assert ends >= 1


def final_networks(run, agent):
    """One agent's policy and value network at the end of the run."""
    saved = load_file(run.path / "policy.safetensors")
    networks = make_networks(PPOConfig(**vars(WATCHED) | {"n_seeds": 1}))
    for name, network in zip(("policy", "value"), networks, strict=True):
        network.load_state_dict({key: saved[f"{name}.{key}"][agent : agent + 1] for key in network.state_dict()})
    return networks


@pytest.mark.parametrize("agent", [0, 1])
def test_the_runs_24_updates_are_those_of_plain_pytorch_with_the_runs_own_numbers(watched, agent):
    """Every number that is not a default is written out here once more: the run used its configuration's."""
    policy, value = make_networks(PPOConfig(**vars(WATCHED) | {"n_seeds": 1, "seed": 3 + agent}))
    parameters = [*policy.parameters(), *value.parameters()]
    optimiser = torch.optim.Adam(parameters, lr=2e-2, eps=1e-4)
    clipped, norms = [], []
    for index, batch in enumerate(minibatch[agent : agent + 1] for minibatch in watched.minibatches):
        distribution = Categorical(logits=policy(batch["observation"]))
        ratio = (distribution.log_prob(batch["action"]) - batch["action_log_prob"]).exp()
        if index % 12 == 0:  # a rollout's log-probabilities are of the policy that its learning begins with
            torch.testing.assert_close(ratio, torch.ones(1, 48), rtol=0, atol=1e-4)
        clipped.append(((ratio - 1).abs() > 0.1).float().mean().item())
        advantage = batch["advantage"][..., 0]
        advantage = (advantage - advantage.mean()) / advantage.std()
        objective = torch.min(ratio * advantage, ratio.clamp(0.9, 1.1) * advantage).mean()
        error = (value(batch["observation"]) - batch["value_target"]).square().mean()
        entropy = distribution.entropy().mean()
        losses = watched.losses[index]
        for name, own in (("objective", -objective), ("critic", 0.7 * error), ("entropy", -0.05 * entropy)):
            torch.testing.assert_close(losses[f"loss_{name}"][agent], own.detach(), rtol=1e-4, atol=1e-4)
        optimiser.zero_grad()
        (-objective + 0.7 * error - 0.05 * entropy).backward()
        norms.append(torch.nn.utils.clip_grad_norm_(parameters, 0.4).item())
        optimiser.step()
    assert max(clipped) > 0.2
    assert min(norms) < 0.4 < max(norms)
    for network, final in zip((policy, value), final_networks(watched.run, agent), strict=True):
        for own, saved in zip(network.parameters(), final.parameters(), strict=True):
            torch.testing.assert_close(saved, own, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("agent", [0, 1])
def test_the_last_row_of_progress_compares_the_final_policy_with_its_rollout(watched, agent):
    policy, _ = final_networks(watched.run, agent)
    batch = watched.rollouts[1][agent].flatten()
    distribution = Categorical(logits=policy(batch["observation"][None])[0].detach())
    ratio = (distribution.log_prob(batch["action"]) - batch["action_log_prob"]).exp()
    row = watched.run.progress.iloc[2 + agent]
    assert row["entropy"] == pytest.approx(distribution.entropy().mean().item(), abs=1e-4)
    assert row["kl_approx"] == pytest.approx((ratio - 1 - ratio.log()).mean().item(), abs=1e-4)
    assert row["clip_fraction"] == pytest.approx(((ratio - 1).abs() > 0.1).float().mean().item(), abs=0.006)
    values, targets = (batch[name].flatten().numpy() for name in ("state_value", "value_target"))
    assert row["explained_variance"] == pytest.approx(explained_variance(values, targets), abs=1e-4)
    assert row["kl_approx"] > 0.01
    assert row["clip_fraction"] > 0.1


def flown(actions, **how):
    """What an environment [2, 4] of seeds 3 and 4 makes of actions [A, W, T]."""
    env = uavnav.DroneEnv([2, 4], seeds=[3, 4], **how)
    now, steps = env.reset(), []
    for action in actions.unbind(2):
        after, now = env.step_and_maybe_reset(now.set("action", action))
        steps.append(after.clone())
    return torch.stack(steps, 2)


def same_flight(a, b):
    keys = ("observation", *[("next", name) for name in ("observation", "reward", "done", "terminated")])
    return all(torch.equal(a[key], b[key]) for key in keys)


def test_the_run_flew_in_the_world_that_its_4_settings_and_its_cap_describe(watched):
    batch = torch.cat(watched.rollouts, 2)
    how = {"world": World(**SWITCHES), "reward": "initial", "max_steps": 20}
    assert same_flight(batch, flown(batch["action"], **how))
    for other in (
        {"reward": "eq14"},
        {"max_steps": None},
        *({"world": World(**{name: value for name, value in SWITCHES.items() if name != left})} for left in SWITCHES),
    ):
        assert not same_flight(batch, flown(batch["action"], **how | other))


def test_the_runs_episodes_last_at_most_20_steps_and_earn_a_hundredth_of_their_distance(watched):
    batch = torch.cat(watched.rollouts, 2)
    terminated = batch["next", "terminated"][..., 0]
    expected = torch.where(terminated, -10.0, 0.01 * (batch["action"] % 10))
    torch.testing.assert_close(batch["next", "reward"][..., 0], expected)
    episodes = watched.run.episodes
    assert episodes.steps.max() == 20
    assert (episodes.steps[episodes.truncated] == 20).all()
    assert episodes.truncated.sum() >= 10
    assert episodes.terminated.sum() == terminated.sum() >= 1
    earned = (0.01 * episodes.distance - episodes.reward).round(9)
    assert (earned[~episodes.terminated] == 0).all()
    assert earned[episodes.terminated].between(10, 10.09).all()  # the step into the collision pays nothing else


def test_train_takes_one_thread_and_gives_its_callers_3_back(tmp_path):
    config = PPOConfig(total_frames=128, frames_per_batch=64, n_worlds=2, epochs=1, compile="off")
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
