"""PPO and DQN in plain PyTorch in CleanRL's single-file manner, at the preset `paper`'s settings, to measure against.

One function an algorithm, top to bottom, no abstraction. They follow CleanRL's `ppo.py` and `dqn.py` but for the
hyper-parameters, which are Stable-Baselines3's, and its Huber loss and gradient norm in DQN. `keep_on(frames)` is
called between iterations and says whether to go on.
"""

# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torch import Tensor, nn, optim
from torch.distributions import Categorical
from torch.nn import functional as F

MakeEnv = Callable[[], gymnasium.Env[Any, Any]]
KeepOn = Callable[[int], bool]


def layer_init(layer: nn.Linear, gain: float = 2**0.5) -> nn.Linear:
    """Orthogonal weights, zero biases."""
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


class Agent(nn.Module):
    """Separate value and policy networks of 64-64 tanh units."""

    def __init__(self, inputs: int, actions: int) -> None:
        super().__init__()
        hidden = [(inputs, 64), (64, 64)]
        self.critic = nn.Sequential(
            *(part for sizes in hidden for part in (layer_init(nn.Linear(*sizes)), nn.Tanh())),
            layer_init(nn.Linear(64, 1), 1.0),
        )
        self.actor = nn.Sequential(
            *(part for sizes in hidden for part in (layer_init(nn.Linear(*sizes)), nn.Tanh())),
            layer_init(nn.Linear(64, actions), 0.01),
        )

    def get_action_and_value(self, x: Tensor, action: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        probs = Categorical(logits=self.actor(x), validate_args=False)
        action = probs.sample() if action is None else action
        return action, probs.log_prob(action), probs.entropy(), self.critic(x)


def ppo(make_env: MakeEnv, seed: int, keep_on: KeepOn, num_steps: int = 2048, num_envs: int = 1) -> None:
    """Proximal Policy Optimization."""
    minibatch_size, update_epochs, gamma, gae_lambda, clip_coef = 64, 10, 0.99, 0.95, 0.2
    vf_coef, max_grad_norm, batch_size = 0.5, 0.5, num_steps * num_envs
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - as CleanRL does
    torch.manual_seed(seed)
    envs = SyncVectorEnv([make_env] * num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
    agent = Agent(envs.single_observation_space.shape[0], int(envs.single_action_space.n))  # type: ignore
    optimizer = optim.Adam(agent.parameters(), lr=3e-4, eps=1e-5)

    obs = torch.zeros((num_steps, num_envs, *envs.single_observation_space.shape))  # type: ignore
    actions, logprobs, rewards, dones, values = (torch.zeros((num_steps, num_envs)) for _ in range(5))
    frames = 0
    next_obs = torch.Tensor(envs.reset(seed=seed)[0])
    next_done = torch.zeros(num_envs)
    while keep_on(frames):
        for step in range(num_steps):
            frames += num_envs
            obs[step], dones[step] = next_obs, next_done
            with torch.no_grad():
                action, logprob, _, value = agent.get_action_and_value(next_obs)
                values[step] = value.flatten()
            actions[step], logprobs[step] = action, logprob
            observation, reward, terminations, truncations, _ = envs.step(action.numpy())
            rewards[step] = torch.tensor(reward).view(-1)
            next_obs = torch.Tensor(observation)
            next_done = torch.Tensor(np.logical_or(terminations, truncations))

        with torch.no_grad():
            next_value = agent.critic(next_obs).reshape(1, -1)
            advantages = torch.zeros_like(rewards)
            lastgaelam = torch.zeros(num_envs)
            for t in reversed(range(num_steps)):
                nextnonterminal = 1.0 - (next_done if t == num_steps - 1 else dones[t + 1])
                nextvalues = next_value if t == num_steps - 1 else values[t + 1]
                delta = rewards[t] + gamma * nextvalues * nextnonterminal - values[t]
                advantages[t] = lastgaelam = delta + gamma * gae_lambda * nextnonterminal * lastgaelam
            returns = advantages + values

        b_obs = obs.reshape(batch_size, -1)
        b_logprobs, b_actions, b_advantages, b_returns = (
            part.reshape(-1) for part in (logprobs, actions, advantages, returns)
        )
        b_inds = np.arange(batch_size)
        for _ in range(update_epochs):
            np.random.shuffle(b_inds)  # noqa: NPY002 - as CleanRL does
            for start in range(0, batch_size, minibatch_size):
                mb_inds = b_inds[start : start + minibatch_size]
                _, newlogprob, _, newvalue = agent.get_action_and_value(b_obs[mb_inds], b_actions.long()[mb_inds])
                ratio = (newlogprob - b_logprobs[mb_inds]).exp()
                mb_advantages = b_advantages[mb_inds]
                mb_advantages = (mb_advantages - mb_advantages.mean()) / (mb_advantages.std() + 1e-8)
                pg_loss1 = -mb_advantages * ratio
                pg_loss2 = -mb_advantages * torch.clamp(ratio, 1 - clip_coef, 1 + clip_coef)
                pg_loss = torch.max(pg_loss1, pg_loss2).mean()
                v_loss = ((newvalue.view(-1) - b_returns[mb_inds]) ** 2).mean()
                loss = pg_loss + vf_coef * v_loss
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), max_grad_norm)
                optimizer.step()


def dqn(make_env: MakeEnv, seed: int, keep_on: KeepOn, learning_starts: int, buffer_size: int = 1_000_000) -> None:
    """Deep Q-Network; epsilon is at its final 0.05 as soon as learning starts, as in nine tenths of a whole run."""
    batch_size, gamma, train_frequency, target_network_frequency, epsilon = 32, 0.99, 4, 10_000, 0.05
    rng = np.random.default_rng(seed)
    random.seed(seed)
    torch.manual_seed(seed)
    env = make_env()
    inputs, n_actions = env.observation_space.shape[0], int(env.action_space.n)  # type: ignore

    def make_network() -> nn.Sequential:
        return nn.Sequential(nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, n_actions))

    q_network, target_network = make_network(), make_network()
    optimizer = optim.Adam(q_network.parameters(), lr=1e-4)
    target_network.load_state_dict(q_network.state_dict())

    b_obs, b_next_obs = (np.zeros((buffer_size, inputs), dtype=np.float32) for _ in range(2))
    b_actions = np.zeros((buffer_size, 1), dtype=np.int64)
    b_rewards, b_dones = (np.zeros(buffer_size, dtype=np.float32) for _ in range(2))
    obs, _ = env.reset(seed=seed)
    frames = 0
    while keep_on(frames):
        if frames < learning_starts or random.random() < epsilon:
            action = random.randrange(n_actions)
        else:
            with torch.no_grad():
                action = int(q_network(torch.from_numpy(obs)).argmax())
        next_obs, reward, termination, truncation, _ = env.step(action)
        row = frames % buffer_size
        b_obs[row], b_actions[row], b_next_obs[row] = obs, action, next_obs
        b_rewards[row], b_dones[row] = float(reward), termination
        obs = env.reset()[0] if termination or truncation else next_obs
        frames += 1
        if frames > learning_starts and frames % train_frequency == 0:
            rows = rng.integers(min(frames, buffer_size), size=batch_size)
            data = [torch.from_numpy(part[rows]) for part in (b_obs, b_actions, b_next_obs, b_rewards, b_dones)]
            observations, chosen, following, earned, ended = data
            with torch.no_grad():
                td_target = earned + gamma * target_network(following).max(1).values * (1 - ended)
            loss = F.smooth_l1_loss(q_network(observations).gather(1, chosen).squeeze(1), td_target)
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(q_network.parameters(), 10.0)
            optimizer.step()
        if frames % target_network_frequency == 0:
            target_network.load_state_dict(q_network.state_dict())
