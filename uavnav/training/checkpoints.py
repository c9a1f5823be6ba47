"""Snapshots of a run that is under way: whole or not there, checked when read, never unpickled.

A folder contains the two newest states and, where there is one, the replay buffer as a chain of chunks to
which each snapshot adds what is new. A file's name ends in the first half of its SHA-256, so that a cut or a
flipped byte shows.

    state-<frames>-<sha>.safetensors        tensors by dotted path; its header has facts and names of chunks
    replay-<first row>-<sha>.safetensors    a chunk
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, Protocol

import torch
from pydantic import Field
from safetensors.torch import save
from tensordict import TensorDict
from torch import Tensor

from uavnav import files
from uavnav.errors import one_line
from uavnav.runs import Count
from uavnav.runs.tables import RunError
from uavnav.tasks import tensors

if TYPE_CHECKING:
    from torchrl.data import ReplayBuffer

KEPT = 2  # states that are kept: the newest, and the one before in case that the newest is damaged

CHUNK_BYTES = 8 * 2**20
"""Of the replay buffer in one file, at most: what is written is copied twice on its way."""

Nested = Mapping[str, Any]  # tensors and further such mappings by name


class Stateful(Protocol):
    """What a snapshot is made of."""

    def state_dict(self) -> dict[str, Any]:
        """Tensors by name, nested."""

    def load_state_dict(self, state_dict: Any, /) -> Any:
        """Go on from there."""


class Header(files.Facts):
    """What a state file says besides its tensors. Its chunks are files of its own folder."""

    facts: dict[str, Any]
    chunks: list[Annotated[str, Field(pattern=r"^replay-\d{12}-[0-9a-f]{32}\.safetensors$")]]
    identity: dict[str, Any]


class Frames(files.Facts):
    """What every snapshot says in its facts: the frames per seed before it."""

    frames: Count


class Snapshot(NamedTuple):
    """What a state file contains."""

    path: Path
    state: dict[str, Any]
    facts: dict[str, Any]
    chunks: list[str]

    @property
    def frames(self) -> int:
        """Per seed, before it."""
        return int(self.facts["frames"])


Take = Callable[[Snapshot], object]
"""Goes on from a snapshot, or raises a RunError and leaves everything as it was."""


class Checkpoints:
    """The snapshots in a folder.

    Args:
        folder: where they are; made when the first one is saved.
        identity: what a snapshot must share with the run that resumes from it (configuration, versions).
    """

    def __init__(self, folder: Path, identity: Nested) -> None:
        self.folder = folder
        self.identity = json.loads(json.dumps(identity))
        self._chunks: list[str] = []
        self._kept: list[list[str]] = []  # the chunks of each state that is kept, the newest first
        self._rows_saved = 0

    def save(self, frames: int, state: Nested, facts: Nested, replay: ReplayBuffer | None = None) -> None:
        """Write a state and what the buffer has gained since; then drop the states before the last two."""
        self.folder.mkdir(exist_ok=True)
        if replay is not None:
            self._save_new_rows(replay, frames)
        header = {"facts": dict(facts), "chunks": self._chunks, "identity": self.identity}
        self._write(f"state-{frames:012d}", TensorDict(state), header)
        for old in self._states()[KEPT:]:
            _remove(old)
        self._kept = [self._chunks, *self._kept][:KEPT]
        self._drop_strays()

    def _save_new_rows(self, replay: ReplayBuffer, rows: int) -> None:
        capacity = replay.storage.max_size
        first = max(self._rows_saved, rows - capacity)
        step = max(CHUNK_BYTES // replay[:1].nbytes, 1) if first < rows else 1
        for begin in range(first, rows, step):
            end = min(begin + step, rows)
            positions = [row % capacity for row in range(begin, end)]
            self._chunks = [
                *self._chunks,
                self._write(f"replay-{begin:012d}", TensorDict({"rows": replay[positions]}), {}),
            ]
            self._rows_saved = end
        ends = [*(_first_row(name) for name in self._chunks[1:]), rows]
        self._chunks = [name for name, end in zip(self._chunks, ends, strict=False) if end > rows - capacity]

    def _write(self, stem: str, nested: TensorDict, header: Nested) -> str:
        flat = {name: value.contiguous() for name, value in nested.flatten_keys("/").items()}
        content = save(flat, {"uavnav": json.dumps(header)})
        name = f"{stem}-{_digest(content)}.safetensors"
        files.write(self.folder / name, content)
        return name

    def load(self, replay: ReplayBuffer | None = None, take: Take = lambda snapshot: None) -> Snapshot | None:
        """The newest snapshot that is whole, which `take` has taken; the buffer, if one is given, is filled
        from it.

        None where there is none.

        Raises:
            RunError: there are snapshots, and none can be used.
        """
        states, problems = self._states(), list[RunError]()
        for index, path in enumerate(states):
            try:
                snapshot = self._read_state(path)
                self._check_chunks(snapshot, replay)
                take(snapshot)
            except RunError as error:
                problems.append(error)
                continue
            for problem in problems:
                warnings.warn(one_line(f"{problem}; going on from the one before"), stacklevel=2)
            if replay is not None:
                for name in snapshot.chunks:
                    _refill(replay, _first_row(name), self._read(self.folder / name)[0])
            for damaged in states[:index]:  # they would count among the two that are kept
                damaged.rename(damaged.with_name(f"damaged-{damaged.name}"))
            self._chunks = snapshot.chunks
            others = self._readable(states[index + 1 :])
            self._kept = [snapshot.chunks, *(one.chunks for one in others)]
            self._rows_saved = snapshot.frames
            self._drop_strays()
            return snapshot
        if states:
            raise RunError(f"{problems[-1]}, and there is no other; overwrite=true starts the run anew")
        return None

    def newest(self) -> Snapshot:
        """The newest snapshot that can be read; a run may be at work and change them meanwhile.

        Raises:
            RunError: there is none.
        """
        for snapshot in self._readable(self._states()):
            return snapshot
        raise RunError(f"{self.folder.parent}: has no snapshot")

    def _read_state(self, path: Path) -> Snapshot:
        found, metadata = self._read(path)
        try:
            header = files.facts(Header, files.parsed(metadata.get("uavnav", "{}")))
            files.facts(Frames, header.facts)
            state = TensorDict(found).unflatten_keys("/").to_dict()
        except (ValueError, KeyError, TypeError) as error:  # KeyError: a name that is also a table's
            raise RunError(f"{path}: not a snapshot ({error})") from error
        for key in self.identity:
            if header.identity.get(key) != self.identity[key]:
                raise RunError(
                    f"{path}: saved with {key}={header.identity.get(key)}, not {self.identity[key]}"
                )
        return Snapshot(path, state, header.facts, header.chunks)

    def _check_chunks(self, snapshot: Snapshot, replay: ReplayBuffer | None) -> None:
        """Raise a RunError unless the chunks are whole and follow each other to the snapshot's last row.

        They are read one by one, and again when they are used: all would fill the memory.
        """
        firsts = [_first_row(name) for name in snapshot.chunks]
        kinds = set()
        for name, first, end in zip(snapshot.chunks, firsts, [*firsts[1:], snapshot.frames], strict=False):
            found, _ = self._read(self.folder / name)
            rows = found["rows"] if found.keys() == {"rows"} else torch.empty(0)
            if rows.ndim != 3 or not 0 < end - first == len(rows):
                raise RunError(f"{snapshot.path}: its {name} has other rows")
            kinds.add(tuple(sorted((key, str(one.dtype), *one.shape[1:]) for key, one in found.items())))
        wanted = 0 if replay is None else max(snapshot.frames - replay.storage.max_size, 0)
        if len(kinds) > 1 or (
            replay is not None and snapshot.frames and not (firsts and firsts[0] <= wanted)
        ):
            raise RunError(f"{snapshot.path}: its chunks do not belong together")

    def _readable(self, states: list[Path]) -> Iterator[Snapshot]:
        for path in states:
            with contextlib.suppress(RunError):
                yield self._read_state(path)

    def _read(self, path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
        try:
            content = files.read(path)
        except OSError as error:
            raise RunError(f"{path}: missing or not readable") from error
        if _digest(content) != path.stem.rsplit("-", 1)[-1]:
            raise RunError(f"{path}: damaged, its checksum does not match")
        try:
            return tensors.parsed(content)
        except ValueError as error:
            raise RunError(f"{path}: not a snapshot") from error

    def _states(self) -> list[Path]:
        """Newest first."""
        return sorted(self.folder.glob("state-*.safetensors"), reverse=True)

    def _drop_strays(self) -> None:
        """Remove files half-written, which a killed process left, and chunks that no kept state knows."""
        known = set().union(*self._kept)
        for path in [*self.folder.glob(".*"), *self.folder.glob("replay-*.safetensors")]:
            if path.name not in known:
                _remove(path)


def _remove(path: Path) -> None:
    shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:32]


def _first_row(chunk: str) -> int:
    """Of the chunk with this name, counted from the first row that was ever written."""
    return int(chunk.split("-")[1])


def _refill(replay: ReplayBuffer, first: int, chunk: Mapping[str, Tensor]) -> None:
    """Append rows to a buffer so that they are where they were: row `first` at its place in the ring."""
    rows = chunk["rows"]
    while skipped := (first - replay.write_count) % replay.storage.max_size:
        # more than the whole ring was written between two snapshots: no row counts yet
        replay.extend(rows[:skipped])
    replay.extend(rows)
