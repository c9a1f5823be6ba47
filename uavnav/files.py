"""Files that appear whole or not at all, and that are read only up to the size of their kind."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import stat
import tempfile
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

SETTINGS_BYTES = 2**18
"""The most bytes of a YAML or JSON file: a run's own have a few thousand."""
MOST_NESTED = 100
"""The most levels of lists and mappings in YAML."""
TABLE_BYTES = 2**31
"""The most bytes of a table."""
MEMORY_BYTES = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
"""The most bytes of a file of tensors: the machine's memory."""
WHOLE_BITS = 64
"""The most bits of a whole number in YAML or JSON."""
ASIDE = ".aside"
"""How a file's name ends while it is written."""


class Facts(BaseModel):
    """What a file says, in the very types of its fields; it may say more."""

    model_config = ConfigDict(strict=True, extra="allow", frozen=True, allow_inf_nan=False)


Kind = TypeVar("Kind", bound=Facts)


def write(path: Path, content: bytes) -> None:
    """Write aside, then rename: the file is whole or not there; raises OSError."""
    if path.exists() and not path.is_file():  # a rename would put the file in its place
        raise FileExistsError(errno.EEXIST, "it is no file", str(path))
    aside = path.with_name(f".{path.name}.{os.getpid()}{ASIDE}")
    try:
        aside.write_bytes(content)
        os.replace(aside, path)
    finally:
        remove(aside)


def remove(path: Path) -> None:
    """Remove a file that may be there; it stays where a disk has become read-only meanwhile."""
    with contextlib.suppress(OSError):
        path.unlink()


def _at_once(name: str, flags: int) -> int:
    return os.open(name, flags | os.O_NONBLOCK)  # a pipe would wait


def read(path: str | Path, most: int = MEMORY_BYTES) -> bytes:
    """What a file contains; raises an OSError where it is no regular one, or has more than so many bytes."""
    with open(_named(path), "rb", opener=_at_once) as file:
        there = os.fstat(file.fileno())
        if not stat.S_ISREG(there.st_mode):
            raise OSError(errno.EINVAL, "it is no file")
        if there.st_size > most:
            raise OSError(errno.EFBIG, f"it has {there.st_size:,} bytes, more than {most:,}")
        return file.read()


def facts(kind: type[Kind], said: Any) -> Kind:
    """What a file says as its kind of facts; a ValueError names the first that is wrong: `frames=many`."""
    try:
        return kind.model_validate(said)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        value = None if first["type"] == "missing" else first["input"]
        raise ValueError(f"{'.'.join(map(str, first['loc'])) or 'all'}={value!s}") from None


def read_json(path: str | Path) -> Any:
    """What a JSON file says; raises an OSError as `read` does, and a ValueError where it is no JSON."""
    return parsed(read(path, SETTINGS_BYTES))


def parsed(text: str | bytes) -> Any:
    """What JSON says; raises a ValueError where it is none, or nested too deeply."""
    try:
        return json.loads(text, parse_int=_whole)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


class _Loader(yaml.CSafeLoader):
    """Plain YAML, of whole numbers that can be computed with; 1e6 is a number, as in YAML 1.2."""

    def construct_yaml_int(self, node: Any) -> int:
        return _whole(super().construct_yaml_int(node))


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)
_NUMBER = re.compile(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+$")
_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _NUMBER, [*"-+0123456789"])


def read_yaml(path: str | Path) -> Any:
    """What a YAML file says; raises an OSError as `read` does, and a ValueError where it is no plain YAML."""
    return parsed_yaml(read(path, SETTINGS_BYTES))


def parsed_yaml(text: str | bytes) -> Any:
    """What YAML says; raises a ValueError where it is none, has aliases, or is nested too deeply."""
    depth = 0
    try:
        for event in yaml.parse(text, yaml.CSafeLoader):
            if isinstance(event, yaml.AliasEvent):  # with which a few lines stand for billions
                raise ValueError("aliases are not taken")
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > MOST_NESTED:
                raise ValueError("nested too deeply")
        return yaml.load(text, _Loader)
    except (yaml.YAMLError, TypeError, AttributeError, KeyError, OverflowError) as error:
        # odd keys and dates raise others than YAMLError
        raise ValueError(" ".join(str(error).split()) or type(error).__name__) from error


def nearest(path: Path) -> Path:
    """The path, or the nearest folder above it that is there."""
    return next(one for one in (path, *path.absolute().parents) if one.exists())


def check_out(path: Path) -> None:
    """Raise a ValueError for a file that could not be written; its folders may yet be made."""
    try:
        folder = nearest(Path(_named(path)).absolute().parent)
        if path.is_dir():
            raise IsADirectoryError("it is a folder")
        if path.exists() and not path.is_file():
            raise FileExistsError("it is no file")
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        reason = error.strerror or error
        raise ValueError(f"{path}: cannot be written ({reason}); give a path that can be written") from error


def _whole(number: str | int) -> int:
    """A whole number; raises a ValueError where it is too large to compute with or to print."""
    whole = int(number)
    if whole.bit_length() > WHOLE_BITS:
        raise ValueError(f"a whole number has more than {WHOLE_BITS} bits")
    return whole


def _named(path: str | Path) -> str | Path:
    if "\0" in str(path):  # Python would raise a ValueError
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
    return path
