"""Made-up rows of any shape, as algorithms learn from them."""

import torch
from tensordict import TensorDict


def rollout(*shape, dtype=torch.float32, seed=0):
    """What the losses of PPO and A2C need; the policy of then is far from one of today."""
    g = torch.Generator().manual_seed(seed)
    return TensorDict(
        {
            "observation": torch.rand(*shape, 30, generator=g, dtype=dtype),
            "action": torch.randint(100, shape, generator=g),
            "action_log_prob": -5.0 + torch.randn(*shape, generator=g, dtype=dtype),
            "advantage": torch.randn(*shape, 1, generator=g, dtype=dtype),
            "value_target": torch.randn(*shape, 1, generator=g, dtype=dtype),
        },
        list(shape),
    )


def transitions(*shape, dtype=torch.float32, seed=0):
    """What learning from replay needs; a quarter end in a collision, and a quarter of the rest at the
    time limit.
    """
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
