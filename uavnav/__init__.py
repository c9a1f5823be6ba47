"""uavnav: DQN against PPO, four activation functions, and a drone that must learn to avoid obstacles.

`import uavnav` is cheap: every name below is loaded on first use.
"""

from __future__ import annotations

import os
import sys

from uavnav.cli.terminal import end_quietly

_folder, _program = os.path.split("".join(sys.argv[:1]))
if _program in ("-m", "uavnav") or os.path.basename(_folder) == "recipes":
    end_quietly("uavnav")  # a command begins: the imports that follow may be stopped too

import importlib
import warnings
from typing import TYPE_CHECKING, Any

import gymnasium

from uavnav.algorithms import ALGORITHMS
from uavnav.errors import did_you_mean
from uavnav.tasks.protocol import TASK_NAMES

if TYPE_CHECKING:
    from uavnav import evaluation, networks, plugins, report, stats
    from uavnav.algorithms import a2c, c51, dqn, ppo, pqn, sac
    from uavnav.envs.env import DroneEnv
    from uavnav.errors import ConfigError
    from uavnav.evaluation import evaluate_policy
    from uavnav.runs import Run
    from uavnav.runs.policies import Policy, PolicyError, load_policy
    from uavnav.runs.tables import RunError
    from uavnav.tasks import layouts, rewards, sensing
    from uavnav.tasks.layouts import LayoutError
    from uavnav.tasks.world import World

__version__ = "0.2.0"

_NAMES = {
    "ConfigError": "errors",
    "DroneEnv": "envs.env",
    "evaluate_policy": "evaluation",
    "LayoutError": "tasks.layouts",
    "Policy": "runs.policies",
    "PolicyError": "runs.policies",
    "load_policy": "runs.policies",
    "Run": "runs",
    "RunError": "runs.tables",
    "World": "tasks.world",
}
_ROOMS = {
    "algorithms": ("replay", "rollout"),
    "envs": ("env", "gym", "sb3", "scalar"),
    "evaluation": ("episodes", "verify"),
    "report": ("compare",),
    "runs": ("export", "metrics", "paper", "policies", "definitions"),
    "tasks": (
        "baselines",
        "dynamics",
        "faults",
        "goal",
        "layouts",
        "moving",
        "rewards",
        "sensing",
        "space",
        "table",
        "task",
        "world",
    ),
    "training": ("config", "loggers"),
    "views": ("render",),
    "views.browser": ("playground",),
}
HOMES = {name: f"uavnav.{room}.{name}" for room, names in _ROOMS.items() for name in names}
HOMES |= {name: algorithm.module for name, algorithm in ALGORITHMS.items()}
"""Modules that are also known without their folder: `uavnav.layouts` is `uavnav.tasks.layouts`."""
_MODULES = ("bench", "evaluation", "networks", "plugins", "report", "runs", "stats")

_SHOWN = ("evaluation", "layouts", "networks", "plugins", "report", "rewards", "sensing", "stats")
__all__ = sorted({*_NAMES, *ALGORITHMS, *_SHOWN})
"""What most programs need; every other module is found too, by its short name or in its folder."""

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL reads it once, when it is imported
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # threads that spin starve each other on a busy machine
# huge pages: rows from all over a replay buffer arrive sooner
os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
warnings.filterwarnings("ignore", message=".*inline_inbuilt_nn_modules is deprecated", category=FutureWarning)

for _task in TASK_NAMES:
    gymnasium.register(
        id=f"uavnav/{_task.title().replace('-', '')}-v0",  # uavnav/SpaceMoving-v0
        entry_point="uavnav.envs.gym:DroneGymEnv",
        vector_entry_point="uavnav.envs.gym:DroneVectorEnv",
        kwargs={"task": _task},
    )


def __getattr__(name: str) -> Any:
    if name in _NAMES:
        return getattr(importlib.import_module(f"uavnav.{_NAMES[name]}"), name)
    if name in HOMES or name in _MODULES:
        return importlib.import_module(HOMES.get(name, f"uavnav.{name}"))
    near = did_you_mean(name, __all__)
    raise AttributeError(f"module 'uavnav' has no attribute {name!r}{near}; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
