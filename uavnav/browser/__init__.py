"""What runs in a browser: the world and its drawing, one home each for every page, without a build step or a framework.

`world.js` is the world, held to Python's by tests/test_playground.py. `drawing.js` draws it. `replay.js` plays recorded
flights on a report, and `uavnav.playground` flies live. A page holds the scripts that it needs, one after the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).parent
WORLD = (HERE / "world.js", HERE / "drawing.js")
"""What every page with a drone needs, in the order in which a browser reads it."""


def joined(paths: Sequence[Path]) -> str:
    """Scripts or styles as one text."""
    return "".join(path.read_text(encoding="utf-8") for path in paths)
