"""uavnav: DQN against PPO, four activation functions, and a drone that must learn to avoid obstacles.

`import uavnav` is cheap: every name below is loaded on first use.
"""

from __future__ import annotations

import os
import sys

from uavnav.help.terminal import end_quietly

_folder, _program = os.path.split("".join(sys.argv[:1]))
if _program in ("-m", "uavnav") or os.path.basename(_folder) == "recipes":
    end_quietly("uavnav")  # a command begins: the imports that follow may be stopped too

import importlib
import importlib.util
import warnings
from importlib.machinery import ModuleSpec, SourceFileLoader
from types import ModuleType
from typing import TYPE_CHECKING, Any

import gymnasium

from uavnav.algorithms import ALGORITHMS
from uavnav.help.choices import did_you_mean

if TYPE_CHECKING:
    from uavnav import evaluate, networks, plugins, report, stats
    from uavnav.algorithms import a2c, c51, dqn, ppo, sac
    from uavnav.envs.env import DroneEnv
    from uavnav.evaluate import evaluate_policy
    from uavnav.help.choices import ConfigError
    from uavnav.policies import Policy, PolicyError, load_policy
    from uavnav.runs import Run
    from uavnav.runs.tables import RunError
    from uavnav.tasks import layouts, rewards, sensing
    from uavnav.tasks.layouts import LayoutError
    from uavnav.tasks.world import World

__version__ = "0.1.0"

_NAMES = {
    "ConfigError": "help.choices",
    "DroneEnv": "envs.env",
    "evaluate_policy": "evaluate",
    "LayoutError": "tasks.layouts",
    "Policy": "policies",
    "PolicyError": "policies",
    "load_policy": "policies",
    "Run": "runs",
    "RunError": "runs.tables",
    "World": "tasks.world",
}
_ROOMS = {
    "envs": ("env", "gym", "sb3", "scalar"),
    "policies": ("export",),
    "report": ("compare",),
    "runs": ("metrics", "paper", "readings"),
    "studies": ("study",),
    "tasks": (
        "baselines",
        "dynamics",
        "faults",
        "goal",
        "layouts",
        "moving",
        "rewards",
        "sensing",
        "simulator",
        "space",
        "world",
    ),
    "train": ("verify",),
    "training": ("config", "loggers", "sampler"),
    "views": ("render",),
    "views.browser": ("playground",),
    "views.window": ("play",),
}
"""Modules that are also known without their folder: `uavnav.layouts` is `uavnav.tasks.layouts`."""
HOMES = {name: f"uavnav.{room}.{name}" for room, names in _ROOMS.items() for name in names}
HOMES |= {name: algorithm.module for name, algorithm in ALGORITHMS.items()}
_MODULES = (
    "bench",
    "evaluate",
    "flights",
    "networks",
    "plugins",
    "policies",
    "report",
    "runs",
    "stats",
)

_SHOWN = ("evaluate", "layouts", "networks", "plugins", "report", "rewards", "sensing", "stats")
__all__ = sorted({*_NAMES, *ALGORITHMS, *_SHOWN})
"""What most programs need; every other module is found too, by its short name or in its folder."""

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")  # TorchRL reads it once, when it is imported
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # threads that spin starve each other on a busy machine
os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")  # huge pages: rows from all over a replay buffer arrive sooner
warnings.filterwarnings("ignore", message=".*inline_inbuilt_nn_modules is deprecated", category=FutureWarning)

_WORLDS = {"Drone": "drone", "Moving": "moving", "Goal": "goal", "Space": "space", "SpaceMoving": "space-moving"}
for _name, _task in _WORLDS.items():
    gymnasium.register(
        id=f"uavnav/{_name}-v0",
        entry_point="uavnav.envs.gym:DroneGymEnv",
        vector_entry_point="uavnav.envs.gym:DroneVectorEnv",
        kwargs={"task": _task},
    )


class _ShortName(SourceFileLoader):
    """Finds `uavnav.layouts` in its folder, also for `python -m uavnav.layouts`; it is one module by two names."""

    @classmethod
    def find_spec(cls, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        package, _, short = name.rpartition(".")
        home = importlib.util.find_spec(HOMES[short]) if package == __name__ and short in HOMES else None
        if home is None:
            return None
        command = os.path.join(__path__[0], "commands", f"{short}.py")
        run = command if os.path.exists(command) else str(home.origin)  # by `python -m`
        spec = ModuleSpec(name, cls(name, run), origin=home.origin)
        spec.submodule_search_locations = home.submodule_search_locations  # of a folder, whose `__main__` -m looks for
        return spec

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = importlib.import_module(HOMES[spec.name.rpartition(".")[2]])
        self._home = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self._home


sys.meta_path.append(_ShortName)


def __getattr__(name: str) -> Any:
    if name in _NAMES:
        return getattr(importlib.import_module(f"uavnav.{_NAMES[name]}"), name)
    if name in HOMES or name in _MODULES:
        return importlib.import_module(HOMES.get(name, f"uavnav.{name}"))
    choices = f"{', '.join(__all__)}{did_you_mean(name, __all__)}"
    raise AttributeError(f"module 'uavnav' has no attribute {name!r}; it has {choices}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
