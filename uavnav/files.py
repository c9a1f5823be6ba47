"""Files that appear whole or not at all."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path


def write(path: Path, content: bytes) -> None:
    """Write aside, then rename: the file is whole or not there; raises OSError."""
    aside = path.with_name(f".{path.name}.{os.getpid()}.aside")
    try:
        aside.write_bytes(content)
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)


def check_out(path: Path) -> None:
    """Raises ValueError, before anyone flies, for a file that could not be written; its folders may yet be made."""
    try:
        folder = next(one for one in path.absolute().parents if one.exists())
        if path.is_dir():
            raise IsADirectoryError("it is a folder")
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        reason = error.strerror or error
        raise ValueError(f"{path}: cannot be written ({reason}); give a path that can be written") from error
