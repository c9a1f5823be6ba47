"""A rollout of Stable-Baselines3's as this package's algorithms get theirs, and its layers beside ours."""

import functools

import gymnasium
import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv
from tensordict import TensorDict

KINDS = {
    "tanh": torch.nn.Tanh,
    "relu": torch.nn.ReLU,
    "sigmoid": torch.nn.Sigmoid,
}


class _Transitions(BaseCallback):
    """What SB3's rollout buffer does not hold: where each step really led, its bare reward, and how it
    ended.
    """

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


def on_policy(kind, activation, steps, max_steps, **settings):
    """An agent of SB3's that learns from so many steps of two environments with a time limit."""
    envs = DummyVecEnv([functools.partial(gymnasium.make, "uavnav/Drone-v0", max_steps=max_steps)] * 2)
    how = {"activation_fn": KINDS[activation]}
    return kind("MlpPolicy", envs, n_steps=steps, policy_kwargs=how, seed=0, **settings)


def rollout(theirs, frames):
    """SB3 collects once into its rollout buffer; the same as a batch [1, W, T] of ours."""
    kept = _Transitions()
    _, callback = theirs._setup_learn(frames, kept)
    callback.on_training_start({}, {})
    buffer = theirs.rollout_buffer
    assert theirs.collect_rollouts(theirs.env, callback, buffer, theirs.n_steps)
    following, reward, done, terminated = kept.by_world()
    return TensorDict(
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
        done.shape,
    )


def actor_critic(policy, value, theirs):
    """Pairs of our agent 0's tensors and SB3's, of both networks."""
    extractor = theirs.policy.mlp_extractor
    return [
        *same_layers(policy, [*extractor.policy_net, theirs.policy.action_net]),
        *same_layers(value, [*extractor.value_net, theirs.policy.value_net]),
    ]


def same_layers(network, layers):
    """Pairs of our agent 0's tensors, in PyTorch's layout, and those of PyTorch's layers."""
    linears = [layer for layer in layers if isinstance(layer, torch.nn.Linear)]
    for ours, theirs in zip(network[::2], linears, strict=True):
        yield ours.weight.detach()[0].T, theirs.weight
        yield ours.bias.detach()[0, 0], theirs.bias
