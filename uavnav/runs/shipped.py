"""Policies that ship with the package: `ppo-tanh` is the paper's, `ppo-fast-tanh` of the preset `fast`, and
`ppo-best` and `pqn-best` of the presets `best`.

`uavnav.evaluation.choose` writes them: of the seeds of each run whose policies are committed, the best on the
validation split.
"""

from __future__ import annotations

import difflib
import os
from pathlib import Path
from typing import Any

from uavnav import files
from uavnav.errors import did_you_mean
from uavnav.tasks.protocol import SCRIPTED

FOLDER = Path(__file__).parent / "trained"
SUFFIX = ".safetensors"
CHOSEN = FOLDER / "chosen.json"
"""By name: the run that a policy is of, its seed, and its rewards on the splits `validation` and `test`."""


def shipped() -> dict[str, Path]:
    """The file of each policy by its name: `<algorithm>[-<preset>]-<activation>`, or `<algorithm>-best`."""
    return {path.stem: path for path in sorted(FOLDER.glob(f"*{SUFFIX}"))}


def chosen() -> dict[str, dict[str, Any]]:
    """What is known of each policy, by its name: see `CHOSEN`."""
    return dict(files.read_json(CHOSEN))


def rows() -> list[dict[str, Any]]:
    """The policies as `uavnav runs` lists runs."""
    return [
        {
            "run": name,
            **{key: one[key] for key in ("algorithm", "activation", "preset", "frames")},
            "task": "drone",
            "seeds": [one["seed"], one["seed"]],
            "total": one["frames"],
            "status": "shipped",
            **{f"reward_{mode}": reward for mode, reward in one["test"].items()},
            "age": None,
        }
        for name, one in chosen().items()
    ]


def is_shipped(run: str | Path) -> bool:
    """Whether a word names a policy that ships; what is at this path comes first."""
    return not os.path.exists(run) and str(run) in shipped()


def found(run: str | Path) -> Path:
    """The path of a run, or of the policy that ships under this name."""
    return shipped()[str(run)] if is_shipped(run) else Path(run)


def instead(run: str | Path) -> str:
    """The end of a message about a run that is not there: the nearest path or name, and the names."""
    if os.path.exists(run):
        return ""
    path = Path(run)
    try:
        beside = [one.name for one in path.parent.iterdir() if one.is_dir()]
    except OSError:
        beside = []
    if near := difflib.get_close_matches(path.name, beside, n=1):
        return f" (did you mean {path.with_name(near[0])}?)"
    near_name = did_you_mean(run, [*shipped(), *SCRIPTED])
    return f"{near_name}, or one of {', '.join(shipped())}" if path.name == str(run) else near_name
