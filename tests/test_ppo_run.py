"""A whole run of PPO, watched: what it drew, estimated, learned and noted, against slow loops and plain
PyTorch.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from stable_baselines3.common.utils import explained_variance
from torch.distributions import Categorical

import uavnav
from uavnav.algorithms.ppo import PPOConfig, estimate, make_networks, train
from uavnav.tasks.seeding import Streams
from uavnav.tasks.world import World
from uavnav.training.update import Learner

CLOSE = {"rtol": 1e-5, "atol": 1e-5}

SWITCHES = {"slots": "listed", "padding": "zeros", "start_heading": "random"}
WATCHED = PPOConfig(
    seed=3,
    n_seeds=2,
    n_envs=4,
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
    world=SWITCHES,
)
"""Two iterations of three epochs of four minibatches, and no default that matters."""


@pytest.fixture(scope="module")
def watched(tmp_path_factory):
    """The run, its rollouts [A, W, T] as estimated, each minibatch [A, N] and what the learner returned
    for it.
    """
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


def test_each_of_192_rows_is_learned_from_once_an_epoch_by_its_own_agent(watched):
    def whole(batch):
        names = ("observation", "action", "action_log_prob", "advantage", "value_target")
        return torch.cat([batch[name].reshape(192, -1) for name in names], 1)

    for agent, seed in enumerate(WATCHED.seeds):
        order = Streams([seed], "minibatches")
        for epoch in range(6):
            collected = whole(watched.rollouts[epoch // 3][agent])
            used = whole(
                torch.cat([batch[agent] for batch in watched.minibatches[4 * epoch : 4 * epoch + 4]])
            )
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
        network.load_state_dict(
            {key: saved[f"{name}.{key}"][agent : agent + 1] for key in network.state_dict()}
        )
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


def same_episode(a, b):
    keys = ("observation", *[("next", name) for name in ("observation", "reward", "done", "terminated")])
    return all(torch.equal(a[key], b[key]) for key in keys)


def test_the_run_flew_in_the_world_that_its_4_settings_and_its_limit_describe(watched):
    batch = torch.cat(watched.rollouts, 2)
    how = {"world": World(**SWITCHES), "reward": "initial", "max_steps": 20}
    assert same_episode(batch, flown(batch["action"], **how))
    for other in (
        {"reward": "eq14"},
        {"max_steps": None},
        *(
            {"world": World(**{name: value for name, value in SWITCHES.items() if name != left})}
            for left in SWITCHES
        ),
    ):
        assert not same_episode(batch, flown(batch["action"], **how | other))
