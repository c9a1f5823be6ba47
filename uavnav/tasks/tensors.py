"""Files of tensors (safetensors), which are read whole and never trusted."""

from __future__ import annotations

from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load
from torch import Tensor

from uavnav import files

METADATA = "__metadata__"


def read(path: str | Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors of a file by name, and what its header says of them.

    Raises:
        OSError: it is no regular file that fits into memory, or cannot be read.
        ValueError: it is no safetensors.
    """
    return parsed(files.read(path))


def parsed(content: bytes) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The same of what a file contains; raises a ValueError where it is no safetensors."""
    try:
        found = load(content)
    except (SafetensorError, AssertionError, KeyError, TypeError, RuntimeError) as error:
        # all but the first of torch
        raise ValueError(str(error) or type(error).__name__) from error
    size = int.from_bytes(content[:8], "little")
    return dict(sorted(found.items())), files.parsed(content[8 : 8 + size]).get(METADATA) or {}
