"""uavnav: DQN against PPO, four activation functions, and a drone that must learn to avoid obstacles.

`import uavnav` is cheap: every name below is loaded on first use.
"""

from __future__ import annotations

import importlib
import os
import warnings
from typing import TYPE_CHECKING, Any

import gymnasium

from uavnav.choices import did_you_mean

if TYPE_CHECKING:
    from uavnav import (
        baselines,
        bench,
        dqn,
        dynamics,
        env,
        evaluate,
        export,
        gym,
        layouts,
        loggers,
        metrics,
        networks,
        paper,
        policies,
        ppo,
        render,
        replay,
        report,
        rewards,
        runs,
        sb3,
        scalar,
        sensing,
        simulator,
        stats,
        verify,
        world,
    )
    from uavnav.config import ConfigError
    from uavnav.env import DroneEnv
    from uavnav.evaluate import evaluate_policy
    from uavnav.layouts import LayoutError
    from uavnav.policies import Policy, PolicyError, load_policy
    from uavnav.runs import Run, RunError
    from uavnav.world import World

__version__ = "0.1.0"

_HOMES = {
    "ConfigError": "config",
    "DroneEnv": "env",
    "evaluate_policy": "evaluate",
    "LayoutError": "layouts",
    "Policy": "policies",
    "PolicyError": "policies",
    "load_policy": "policies",
    "Run": "runs",
    "RunError": "runs",
    "World": "world",
}
_MODULES = (
    "baselines",
    "bench",
    "dqn",
    "dynamics",
    "env",
    "evaluate",
    "export",
    "gym",
    "layouts",
    "loggers",
    "metrics",
    "networks",
    "paper",
    "policies",
    "ppo",
    "render",
    "replay",
    "report",
    "rewards",
    "runs",
    "sb3",
    "scalar",
    "sensing",
    "simulator",
    "stats",
    "verify",
    "world",
)

__all__ = [*_HOMES, *_MODULES]

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL reads it once, when it is imported
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # threads that spin starve each other on a busy machine
warnings.filterwarnings("ignore", message=".*inline_inbuilt_nn_modules is deprecated", category=FutureWarning)

gymnasium.register(
    id="uavnav/Drone-v0",
    entry_point="uavnav.gym:DroneGymEnv",
    vector_entry_point="uavnav.gym:DroneVectorEnv",
)


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(f"uavnav.{_HOMES[name]}"), name)
    if name in _MODULES:
        return importlib.import_module(f"uavnav.{name}")
    choices = f"{', '.join(__all__)}{did_you_mean(name, __all__)}"
    raise AttributeError(f"module 'uavnav' has no attribute {name!r}; it has {choices}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
