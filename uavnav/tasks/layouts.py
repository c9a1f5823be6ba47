"""Layouts and layout files: generate, save, load and validate; the disjoint splits `train`, `validation` and
`test`.

A layout file is a float32 tensor [n, k, 3] of (x, y, radius) in px, stored as safetensors with a header that
says how it was made; other tasks have more columns. `uavnav layouts` writes the three that ship with the
package, or others; see its --help.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import re
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError
from safetensors.torch import save as serialize
from torch import Tensor

from uavnav import files
from uavnav.errors import MOST_WHOLE, did_you_mean, told
from uavnav.tasks import circles, goal, moving, slalom, space, tensors
from uavnav.tasks.circles import (
    LayoutError as LayoutError,  # this and the next two are also names of this module
)
from uavnav.tasks.circles import generate as generate
from uavnav.tasks.circles import validate as validate
from uavnav.tasks.protocol import DEFAULT_K
from uavnav.tasks.protocol import SPLITS as SPLITS  # also asked for as a name of this module
from uavnav.tasks.world import VERSION, World

SILENT_LAYOUTS = 1_000
"""Layouts with goals that are drawn without a word: ten seconds."""


class Kind(NamedTuple):
    """The layouts of a world: how layouts are drawn, and what makes them valid."""

    world: type[World]
    generate: Callable[[int, int, int, World], Tensor]  # n, k, seed, world -> layouts
    validate: Callable[[Tensor, World], None]
    reads: tuple[str, ...] = ()  # fields of the world that layouts are drawn by, besides those of the paper's
    ships: bool = False  # the splits of the world's defaults are files of the package
    beside: int = 0  # rows of a layout that are no obstacles
    k: int = DEFAULT_K  # obstacles of a layout where nothing else is said


KINDS = {
    "drone": Kind(World, circles.generate, circles.validate, ships=True),
    "moving": Kind(moving.MovingWorld, moving.generate, moving.validate, ("speed_min", "speed_max")),
    "goal": Kind(goal.GoalWorld, goal.generate, goal.validate, ("goal_radius",), ships=True, beside=1),
    "space": Kind(space.SpaceWorld, circles.generate, circles.validate, k=space.DEFAULT_K),
    "space-moving": Kind(
        space.SpaceMovingWorld,
        moving.generate,
        moving.validate,
        ("speed_min", "speed_max"),
        k=space.DEFAULT_K,
    ),
}
"""By the task that they were made for, which is written into the header of all but the first."""


DRAWN_BY = (
    *("width", "height", "depth", "border", "drone_radius"),
    *("obstacle_radius_min", "obstacle_radius_max", "safe_zone"),
)
"""Fields that a world's layouts are drawn by."""
SHAPES = (*DRAWN_BY, "sensor_radius", "sensor_arc", "n_slots")
"""The same, and those that its size must fit; a header has those that are not as usual."""

RUNGS = ("density", "slalom")
"""By difficulty: `density-12/test` has 12 obstacles a layout, `slalom-80/test` gaps of 80 px."""


def is_rung(layouts: str | Path) -> bool:
    """Whether a layout file's name is that of a rung, such as `density-12/test`, and no file's."""
    return str(layouts).startswith(tuple(f"{ladder}-" for ladder in RUNGS)) and not os.path.isfile(layouts)


def split_of(layouts: str | Path) -> str:
    """The split, or the rung and its split, that a name stands for, or that its file's header says."""
    file = layouts not in SPLITS and os.path.isfile(layouts)
    return _open(Path(layouts))[1].get("split", "") if file else str(layouts)


def kind_of(world: World) -> str:
    """The name in `KINDS` of a world's layouts: of its class, or of the nearest that it derives from."""
    names = {kind.world: name for name, kind in KINDS.items()}
    found = next((names[one] for one in type(world).__mro__ if one in names), None)
    if found is None:
        raise LayoutError(f"world={told(world)}; give a World")
    return found


def _ships(world: World) -> bool:
    """Whether its splits are files of the package: the paper's are for every `World`, those of goals, whose
    files contain lengths of ways, for the usual constants.
    """
    kind = KINDS[kind_of(world)]
    fields = (*kind.reads, *(DRAWN_BY if kind.beside else ()))
    usual = kind.world()
    return kind.ships and all(getattr(world, field, None) == getattr(usual, field, None) for field in fields)


def save(layouts: Tensor, path: str | Path, *, seed: int, split: str, world: World | None = None) -> None:
    """Write a layout file [n, k, 3] with its header; the file appears whole or not at all.

    world: whose split it is, with the fields that its layouts were drawn by.

    Raises:
        LayoutError: the split is not valid, or the place cannot be written.
    """
    world = World() if world is None else world
    if not isinstance(path, (str, Path)) or not isinstance(split, str):
        raise LayoutError(f"path={told(path)}, split={told(split)}; give a file's path and a name")
    KINDS[kind_of(world)].validate(layouts, world)
    path = Path(path)
    header = _header(layouts, seed, split, world)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        files.write(path, _in_order(serialize({"obstacles": layouts.contiguous()}, header)))
    except (OSError, ValueError, SafetensorError) as error:
        raise LayoutError(f"{path}: cannot be written ({error}); give a path that can be written") from error


def _header(layouts: Tensor, seed: int, split: str, world: World) -> dict[str, str]:
    """What the header of a layout file says."""
    name = kind_of(world)
    kind = KINDS[name]
    header = {
        "world_version": VERSION,
        "generator_seed": str(seed),
        "n": str(layouts.shape[0]),
        "k": str(layouts.shape[1] - kind.beside),
        "split": split,
        "sha256": checksum(layouts),
    }
    own = {"task": name} if name != "drone" else {}
    usual = kind.world().model_dump()
    shape = [field for field in SHAPES if field in usual and getattr(world, field) != usual[field]]
    return header | own | {field: json.dumps(getattr(world, field)) for field in (*kind.reads, *shape)}


def load(layouts: str | Path, world: World | None = None) -> Tensor:
    """Read a layout file: `train`, `validation`, `test`, a rung's such as `density-12/test` and
    `slalom-80/test`, or the path of a file that `uavnav layouts` wrote.

    world: whose split it is; the paper's by default.

    Returns:
        Tensor [n, k, 3] float32 of (x, y, radius) px; in other tasks as they say.

    Raises:
        LayoutError: there is no such file, or its header, shape, numbers or checksum are not right.
    """
    return read(layouts, world)[0]


def resolve(layouts: str | Path | Tensor, world: World) -> Tensor:
    """A layout file by name or path, or the tensor itself, valid for this world; raises as `load` does."""
    validate = KINDS[kind_of(world)].validate
    if isinstance(layouts, Tensor):
        validate(layouts, world)
        return layouts
    all_layouts = load(layouts, world)
    try:
        validate(all_layouts, world)
    except LayoutError as error:
        raise LayoutError(
            f"layouts={str(layouts)!r}: {error}; give a layout file that fits this world"
        ) from error
    return all_layouts


def read(layouts: str | Path, world: World | None = None) -> tuple[Tensor, dict[str, str]]:
    """The split and its header; raises as `load` does.

    The paper's splits are files of the package, and so are those of goals. Others are drawn when they are
    asked for, by the fields of their world.
    """
    world = World() if world is None else world
    name = kind_of(world)
    if not isinstance(layouts, (str, Path)):
        raise LayoutError(f"layouts={told(layouts)}; give {', '.join(SPLITS)} or a file's path")
    if is_rung(layouts) or (layouts in SPLITS and not _ships(world)):
        all_layouts, header = _drawn(str(layouts), World() if name == "drone" else world)
        return all_layouts.clone(), dict(header)
    file = str(layouts) if name == "drone" else f"{name}-{layouts}"
    path = Path(__file__).parent / "splits" / f"{file}.safetensors" if layouts in SPLITS else Path(layouts)
    if not os.path.isfile(path):  # as Path.is_file, which raises for a name that is too long
        choices = f"{', '.join(SPLITS)} or a file's path"
        near = did_you_mean(layouts, SPLITS)
        raise LayoutError(f"layouts={str(layouts)!r}: no such layout file{near}; choose from {choices}")
    all_layouts, header = _open(path)
    if header.get("task", "drone") != name:
        raise LayoutError(
            f"{path}: a layout file of task={header.get('task', 'drone')}, not of task={name}; give one of "
            "those"
        )
    drawn_by = _drawn_by(header, path)
    try:
        KINDS[name].validate(all_layouts, drawn_by)
    except LayoutError as error:
        raise LayoutError(f"{path}: {error}; generate it anew") from error
    n, k = len(all_layouts), all_layouts.shape[1] - KINDS[name].beside
    if (header.get("n"), header.get("k")) != (str(n), str(k)):
        raise LayoutError(
            f"{path}: its header says n={header.get('n')}, k={header.get('k')}, not n={n}, k={k} as its "
            "obstacles are; generate it anew"
        )
    if header.get("sha256") != checksum(all_layouts):
        raise LayoutError(f"{path}: the checksum does not match, the file is damaged; generate it anew")
    return all_layouts, header


# a ladder has up to 11 rungs, 110 s to draw where layouts have goals
@functools.lru_cache(maxsize=24)
def _drawn(layouts: str, world: World) -> tuple[Tensor, dict[str, str]]:
    """A split that is no file of the package, or a rung's such as `density-12/test`; and its header."""
    split, k = (layouts, KINDS[kind_of(world)].k) if layouts in SPLITS else _rung(layouts, world)
    n, seed = SPLITS[split]
    if isinstance(world, goal.GoalWorld) and n > SILENT_LAYOUTS:
        _generate(layouts, 0, k, seed, world)  # what is refused is not waited for
        told = f"{n:,} layouts with goals are drawn for this world, {n / 100:.0f} s of a core"
        warnings.warn(f"layouts={layouts}: {told}", stacklevel=2)
    all_layouts = _generate(layouts, n, k, seed, world)
    return all_layouts, _header(all_layouts, seed, layouts, world)


def _rung(layouts: str, world: World) -> tuple[str, int]:
    """The split and the difficulty that a rung's name says, such as `density-12/test`."""
    parts = re.fullmatch(r"([a-z]+)-([^/]*)/?(.*)", layouts, re.DOTALL)
    ladder, rung, split = parts.groups()  # type: ignore[union-attr]
    if len(rung) > len(str(MOST_WHOLE)):  # whatever it says is too much
        raise LayoutError(f"layouts={told(layouts)}: no such layout file; give fewer digits")
    if split not in SPLITS or not rung.isdecimal():
        near = did_you_mean(split, SPLITS)
        example = rung if rung.isdecimal() else {"density": 12}.get(ladder, 100)
        raise LayoutError(
            f"layouts={layouts!r}: no such layout file; give a rung and a split, such as "
            f"{ladder}-{example}/test{near}"
        )
    if ladder == "slalom" and (name := kind_of(world)) != "drone":
        raise LayoutError(
            f"layouts={layouts!r}: a slalom is of task=drone, not of task={name}; give density-8/{split}"
        )
    return split, int(rung)


def _generate(split: str, n: int, k: int, seed: int, world: World) -> Tensor:
    """The layouts of a split, of k obstacles each, or of a slalom's rung, whose name says its gap."""
    gap = re.match(r"slalom-(\d+)/", split)
    return slalom.generate(n, int(gap[1]), seed) if gap else KINDS[kind_of(world)].generate(n, k, seed, world)


def _open(path: Path) -> tuple[Tensor, dict[str, str]]:
    """The contents of a file, if it is a layout file of this version."""
    try:
        found, header = tensors.read(path)
    except (OSError, ValueError) as error:
        raise LayoutError(
            f"{path}: not a readable layout file ({error}); make one with uavnav layouts"
        ) from error
    if (layouts := found.get("obstacles")) is None:
        raise LayoutError(f"{path}: contains no tensor `obstacles`; make one with uavnav layouts")
    if header.get("world_version") != VERSION:
        raise LayoutError(
            f"{path}: made for world version {header.get('world_version')}, this is {VERSION}; generate it "
            "anew"
        )
    return layouts, header


def check(layouts: str | Path) -> tuple[Tensor, dict[str, str]]:
    """The split and its header, if it is what the seed in its header generates.

    Raises:
        LayoutError: it is not, or as `load` does.
    """
    named = not isinstance(layouts, (str, Path)) or layouts in SPLITS
    if not named and not os.path.isfile(layouts):
        return read(layouts)  # a rung, which is generated just now
    world = World() if named else _drawn_by(_open(Path(layouts))[1], layouts)
    all_layouts, header = read(layouts, world)
    kind, seed = KINDS[kind_of(world)], header.get("generator_seed", "")
    drawn = header.get("split", ""), len(all_layouts), all_layouts.shape[1] - kind.beside
    if not re.fullmatch(r"[0-9]{1,20}", seed) or not torch.equal(
        all_layouts, _generate(*drawn, int(seed), world)
    ):
        raise LayoutError(f"{layouts}: is not what seed {seed} generates; generate it anew")
    return all_layouts, header


def _drawn_by(header: Mapping[str, str], path: str | Path) -> World:
    """The world that a header names, with the fields that its layouts were drawn by."""
    kind = KINDS.get(header.get("task", "drone"), KINDS["drone"])
    try:
        own: dict[str, Any] = {name: float(header[name]) for name in kind.reads}
        return kind.world(**own, **{name: files.parsed(header[name]) for name in SHAPES if name in header})
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise LayoutError(
            f"{path}: its header does not say how it was drawn ({error}); generate it anew"
        ) from error


def judged_on(layouts: str | Path) -> str:
    """The test layouts of a training split: of a rung its own, such as `density-12/test`; else `test`."""
    rung, _, split = str(layouts).rpartition("/")
    return f"{rung}/test" if split in SPLITS and is_rung(layouts) else "test"


def name_of(layouts: str | Path) -> str:
    """A layout file's name as part of a file's: `test`, `density-12-test`, or a path's with a checksum."""
    if layouts in SPLITS or not os.path.isfile(layouts):
        return str(layouts).replace("/", "-")
    return f"{Path(layouts).stem}-{checksum(_open(Path(layouts))[0])[:8]}"


def _in_order(content: bytes) -> bytes:
    """The same safetensors with a sorted header: of the same layouts the same bytes."""
    size = int.from_bytes(content[:8], "little")
    header = json.dumps(json.loads(content[8 : 8 + size]), sort_keys=True).encode()
    header += b" " * (-len(header) % 8)
    return len(header).to_bytes(8, "little") + header + content[8 + size :]


def checksum(layouts: Tensor) -> str:
    """SHA-256 of a layout file's numbers."""
    return hashlib.sha256(layouts.cpu().contiguous().numpy().tobytes()).hexdigest()
