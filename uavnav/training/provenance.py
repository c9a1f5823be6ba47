"""What a repeat on another machine, or with another version, would have to know."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
import subprocess
from pathlib import Path
from typing import Any

from uavnav import plugins
from uavnav.tasks.world import VERSION


def facts() -> dict[str, Any]:
    """Versions, commit, machine and plugins, as meta.json keeps them."""
    packages = ("uavnav", "torch", "torchrl", "tensordict", "numpy")
    versions = {name: importlib.metadata.version(name) for name in packages}
    return {
        "versions": {"python": platform.python_version(), "world": VERSION} | versions,
        "git_commit": git_commit(),
        "machine": {"system": platform.platform(), "processor": processor(), "cores": os.cpu_count()},
        **({"plugins": dict(plugins.LOADED)} if plugins.LOADED else {}),
    }


def git_commit(digits: int = 40) -> str | None:
    """The commit of the code that runs, with `+` where the tree differs from it; None outside a checkout."""
    if shutil.which("git") is None:
        return None
    describe = ["git", "describe", "--always", f"--abbrev={digits}", "--exclude=*", "--dirty=+"]
    result = subprocess.run(describe, cwd=Path(__file__).parent, capture_output=True, text=True, check=False)
    return result.stdout.strip() or None


def processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next(
        (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine()
    )
