"""Jobs that train with uavnav."""

from __future__ import annotations

import importlib
import json
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uavnav.algorithms import ALGORITHMS
from uavnav.bench.watch import Clock, Result

if TYPE_CHECKING:
    from uavnav.runs import Run


def settings(algorithm: str, **changed: Any) -> Any:
    """An algorithm's configuration: the preset `vectorised`, and what differs from it."""
    return ALGORITHMS[algorithm].config(preset="vectorised", **changed)


def train(algorithm: str, config: Any, **how: Any) -> Run:
    """Train to the end; `how` are further arguments of `train`."""
    run: Run = importlib.import_module(ALGORITHMS[algorithm].module).train(config, quiet=True, **how)
    return run


class _Enough(Exception):
    """A run was watched for long enough."""


def watched(launched: float, algorithm: str, seconds: float, **changed: Any) -> Result:
    """A run that is watched for a while: what `Clock.result` gives, and its processes and their threads."""
    config = settings(algorithm, **changed)
    clock = Clock(launched, config, seconds)

    def tell(frames: int, rewards: list[float]) -> None:
        if not clock(frames):
            raise _Enough

    with tempfile.TemporaryDirectory() as scratch:
        with suppress(_Enough):
            train(algorithm, config, out=f"{scratch}/run", tell=tell)
        return clock.result() | {"how": _how(f"{scratch}/run")}


def whole(launched: float, algorithm: str, **changed: Any) -> Result:
    """A run to its end: its frames, its processes and their threads."""
    with tempfile.TemporaryDirectory() as scratch:
        run = train(algorithm, settings(algorithm, **changed), out=f"{scratch}/run", checkpoint_seconds=5.0)
        return {"frames": run.frames, "how": _how(f"{scratch}/run")}


def _how(run: str) -> str:
    meta = json.loads(Path(run, "meta.json").read_text())
    return f"{meta.get('processes', 1)} × {meta['threads']}"
