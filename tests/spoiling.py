"""Ways to spoil a file or a folder, each a function of its path; what tests of bad input do first."""

import itertools
import json
import math
import os
import pickle
import shutil
from unittest import mock

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from filelock import FileLock
from safetensors import safe_open
from safetensors.torch import save_file

from uavnav.tasks import layouts
from uavnav.training import provenance


def nothing(path):
    """The call alone is wrong."""


def missing(path):
    shutil.rmtree(path) if path.is_dir() else path.unlink()


def a_folder(path):
    missing(path)
    path.mkdir()


def a_file(path):
    missing(path)
    path.write_text("x")


def itself(path):
    missing(path)
    path.symlink_to(path)


def a_pipe(path):
    """Which nobody writes into: whoever opens it as a file waits."""
    missing(path)
    os.mkfifo(path)


def endless(path):
    missing(path)
    path.symlink_to("/dev/full")  # which reads as zeros


def large(path):
    """A file without end for whoever reads all of it, which takes no room."""
    os.truncate(path, 2**40)


YAML_BOMB = "a: &a [x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n" for before, name in itertools.pairwise("abcdefghijkl")
)
"""Some hundred bytes for 2 * 9^11 words."""


def unfolding(path):
    """A table of 10^7 rows in each of 50 columns, in some kilobytes."""
    nulls = pa.nulls(10**7)
    pq.write_table(pa.table({f"column {index}": nulls for index in range(50)}), path)
    assert path.stat().st_size < 2**20


def columns(**content):
    """A table with other columns, each of one row."""
    return lambda path: pq.write_table(pa.table({name: [value] for name, value in content.items()}), path)


def lying(**entry):
    """A safetensors header that says something else of its first tensor, or of its whole."""

    def spoil(path):
        content = path.read_bytes()
        size = int.from_bytes(content[:8], "little")
        header = json.loads(content[8 : 8 + size])
        first = next(name for name in header if name != "__metadata__")
        text = json.dumps(header | {first: header[first] | entry}).encode()
        put(path, len(text).to_bytes(8, "little") + text + content[8 + size :])

    return spoil


def headed(text):
    """A safetensors file of nothing but a header."""
    return lambda path: put(path, len(text).to_bytes(8, "little") + text.encode())


def written(content):
    return lambda path: put(path, content)


def put(path, content):
    """Write a file, whatever there was."""
    if isinstance(content, str):
        content = content.encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def cut(share):
    def spoil(path):
        content = path.read_bytes()
        put(path, content[: int(len(content) * share)])

    return spoil


def cut_before(word):
    """Cut where a word begins."""
    return lambda path: put(path, path.read_text().partition(word)[0])


def added(text):
    return lambda path: put(path, path.read_text() + text)


def flipped(position):
    def spoil(path):
        content = bytearray(path.read_bytes())
        content[position] ^= 1
        put(path, content)

    return spoil


def replaced(old, new):
    def spoil(path):
        content = path.read_text()
        assert old in content
        path.write_text(content.replace(old, new, 1))

    return spoil


class Bomb:
    def __reduce__(self):
        return os.mkdir, ("a pickle was executed",)


def pickled(path):
    put(path, pickle.dumps(Bomb()))


def torch_saved(path):
    torch.save({"obstacles": torch.zeros(2, 3), "policy": Bomb()}, path)


def tensors(change, header=lambda old: old):
    """Rewrite a safetensors file with other tensors, or another header."""

    def spoil(path):
        with safe_open(path, framework="pt") as file:
            kept = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            old = file.metadata()
        change(kept)
        save_file({name: value.contiguous() for name, value in kept.items()}, path, metadata=header(old))

    return spoil


def obstacles(change=lambda bank: bank, **header):
    def rewrite(kept):
        kept["obstacles"] = change(kept["obstacles"])

    return tensors(rewrite, lambda old: old | header)


def entry(row, column, value):
    def change(bank):
        bank[1, row, column] = value
        return bank

    return change


def consistent(path):
    """Another obstacle, and the checksum that belongs to it."""
    bank = entry(2, 2, 77.0)(layouts.load(path))
    layouts.save(bank, path, seed=0, split="train")


def facts(**changes):
    """Other facts in a policy's header; ... deletes one."""

    def header(old):
        inner = json.loads(old["uavnav"]) | changes
        return {"uavnav": json.dumps({key: value for key, value in inner.items() if value is not ...})}

    return tensors(lambda kept: None, header)


def header(content):
    return tensors(lambda kept: None, lambda old: None if content is None else {"uavnav": content})


def tensor(name, change):
    def rewrite(kept):
        value = change(kept.pop(name))
        if value is not None:
            kept[name] = value

    return tensors(rewrite)


def widened(value):
    return torch.cat([value, value[:, :1]], 1)


def to_nan(value):
    value[0, 0, 0] = math.nan
    return value


def meta(**changes):
    def spoil(path):
        content = json.loads(path.read_text()) | changes
        path.write_text(json.dumps({key: value for key, value in content.items() if value is not ...}))

    return spoil


def table(change):
    def spoil(path):
        change(pd.read_parquet(path)).to_parquet(path, index=False)

    return spoil


def in_use(path):
    path.mkdir(exist_ok=True)
    return FileLock(path / ".lock")


def read_only(path):
    """As `chmod a-w` does for all but root."""
    return mock.patch.object(os, "access", return_value=False)


def newer_torch(path):
    facts = provenance.facts()
    facts["versions"]["torch"] = "9.9.9"
    return mock.patch.object(provenance, "facts", return_value=facts)


def reseeded(path):
    replaced("\nseed: 0\n", "\nseed: 7\n")(path.parent / "config.yaml")


def replay_gone(path):
    for chunk in path.glob("replay-*"):
        chunk.unlink()


def status(word):
    return lambda path: meta(status=word)(path / "meta.json")


def snapshots(spoil):
    def each(path):
        found = sorted(path.glob("state-*"))
        assert found
        for state in found:
            spoil(state)

    return each
