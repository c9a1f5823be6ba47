"""Banks of obstacle sets: generate, save, load and validate; the disjoint splits `train`, `validation` and `test`.

A bank is a float32 tensor [n, k, 3] of (x, y, radius) in px, stored as safetensors with a header that says how it was
made. `uavnav layouts` writes the three that ship with the package, or others; see its --help.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialize
from torch import Tensor

from uavnav import commands, files
from uavnav.choices import did_you_mean
from uavnav.tasks.protocol import DEFAULT_K
from uavnav.tasks.protocol import SPLITS as SPLITS  # also asked for as a name of this module
from uavnav.tasks.world import VERSION, World


class LayoutError(ValueError):
    """A bank cannot be found, read or trusted; the message says what is wrong and what would be right."""


def generate(n: int, k: int = DEFAULT_K, seed: int = 0, world: World | None = None) -> Tensor:
    """Draw n sets of k obstacles: radius uniform in [30, 100], centre uniform in the window, drawn again until the
    edge is at least 50 px from the start (sec. 4.1). Obstacles may overlap each other and the border.

    Returns:
        Tensor [n, k, 3] float32 of (x, y, radius) px; the same for the same arguments on every machine.

    Raises:
        LayoutError: n, k or seed is negative.
    """
    world = world or World()
    if min(n, k, seed) < 0:
        raise LayoutError(f"n={n}, k={k}, seed={seed}; give whole numbers of at least 0")
    rng = np.random.Generator(np.random.PCG64(seed))
    smallest, largest = np.float32(world.obstacle_radius_min), np.float32(world.obstacle_radius_max)
    bank = np.empty((n, k, 3), dtype=np.float32)
    bank[..., 2] = smallest + (largest - smallest) * rng.random((n, k), dtype=np.float32)
    misplaced = np.ones((n, k), dtype=bool)
    while misplaced.any():
        size = np.array([world.width, world.height], dtype=np.float32)
        bank[misplaced, :2] = rng.random((int(misplaced.sum()), 2), dtype=np.float32) * size
        misplaced = _edge_to_start(bank, world) < world.safe_zone
    return torch.from_numpy(bank)


def save(bank: Tensor, path: str | Path, *, seed: int, split: str) -> None:
    """Write a bank [n, k, 3] with its header; the file appears whole or not at all.

    Raises:
        LayoutError: the bank is not valid, or the place cannot be written.
    """
    validate(bank)
    path = Path(path)
    header = {
        "world_version": VERSION,
        "generator_seed": str(seed),
        "n": str(bank.shape[0]),
        "k": str(bank.shape[1]),
        "split": split,
        "sha256": checksum(bank),
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        files.write(path, _in_order(serialize({"obstacles": bank.contiguous()}, header)))
    except (OSError, SafetensorError) as error:
        raise LayoutError(f"{path}: cannot be written ({error}); give a path that can be written") from error


def load(layouts: str | Path) -> Tensor:
    """Read a bank: `train`, `validation`, `test`, or the path of a file that `uavnav layouts` wrote.

    Returns:
        Tensor [n, k, 3] float32 of (x, y, radius) px.

    Raises:
        LayoutError: there is no such file, or its header, shape, numbers or checksum are not right.
    """
    return read(layouts)[0]


def resolve(layouts: str | Path | Tensor, world: World) -> Tensor:
    """A bank from its name or path, or the tensor itself, valid for this world; raises as `load` does."""
    if isinstance(layouts, Tensor):
        validate(layouts, world)
        return layouts
    bank = load(layouts)
    try:
        validate(bank, world)
    except LayoutError as error:
        raise LayoutError(f"layouts={str(layouts)!r}: {error}; give a bank that fits this world") from error
    return bank


def read(layouts: str | Path) -> tuple[Tensor, dict[str, str]]:
    """The bank and its header; raises as `load` does."""
    path = Path(__file__).parent / "banks" / f"{layouts}.safetensors" if layouts in SPLITS else Path(layouts)
    if not os.path.isfile(path):  # as Path.is_file, which raises for a name that is too long
        choices = f"{', '.join(SPLITS)} or a file's path{did_you_mean(layouts, SPLITS)}"
        raise LayoutError(f"layouts={str(layouts)!r}: no such bank; choose from {choices}")
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            bank = file.get_tensor("obstacles") if "obstacles" in file.keys() else None  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        raise LayoutError(f"{path}: not a readable bank ({error}); make one with uavnav layouts") from error
    if bank is None:
        raise LayoutError(f"{path}: holds no tensor `obstacles`; make one with uavnav layouts")
    if header.get("world_version") != VERSION:
        raise LayoutError(
            f"{path}: made for world version {header.get('world_version')}, this is {VERSION}; generate it anew"
        )
    try:
        validate(bank)
    except LayoutError as error:
        raise LayoutError(f"{path}: {error}; generate it anew") from error
    n, k = bank.shape[:2]
    if (header.get("n"), header.get("k")) != (str(n), str(k)):
        raise LayoutError(
            f"{path}: its header says n={header.get('n')}, k={header.get('k')}, not n={n}, k={k} as its obstacles are;"
            " generate it anew"
        )
    if header.get("sha256") != checksum(bank):
        raise LayoutError(f"{path}: the checksum does not match, the file is damaged; generate it anew")
    return bank, header


def check(layouts: str | Path) -> tuple[Tensor, dict[str, str]]:
    """The bank and its header, if it is what the seed in its header generates.

    Raises:
        LayoutError: it is not, or as `load` does.
    """
    bank, header = read(layouts)
    n, k, seed = *bank.shape[:2], header.get("generator_seed", "")
    if not seed.isdecimal() or not torch.equal(bank, generate(n, k, int(seed))):
        raise LayoutError(f"{layouts}: is not what seed {seed} generates; generate it anew")
    return bank, header


def validate(bank: Tensor, world: World | None = None) -> None:
    """Check shape, type, finiteness, the range of radii and the safe zone.

    Raises:
        LayoutError: naming the first set that is wrong.
    """
    world = world or World()
    if bank.ndim != 3 or bank.shape[-1] != 3 or bank.shape[0] == 0:
        raise LayoutError(f"a bank has the shape [n > 0, k, 3], not {list(bank.shape)}")
    if bank.dtype != torch.float32:
        raise LayoutError(f"a bank holds float32, not {str(bank.dtype).removeprefix('torch.')}")
    numbers = bank.cpu().numpy()
    radius = numbers[..., 2]
    edge = _edge_to_start(np.nan_to_num(numbers), world)
    smallest, largest = world.obstacle_radius_min, world.obstacle_radius_max
    for wrong, rule in (
        (~np.isfinite(numbers).all(-1), "is not finite"),
        (~((radius >= smallest) & (radius <= largest)), f"has a radius outside {smallest:g} ... {largest:g} px"),
        (edge < world.safe_zone, f"is nearer than {world.safe_zone:g} px to the start"),
    ):
        if wrong.any():
            row, obstacle = np.argwhere(wrong)[0]
            raise LayoutError(f"obstacle {obstacle} of set {row} {rule}")


def _edge_to_start(bank: np.ndarray, world: World) -> np.ndarray:
    """Distance from the start to every obstacle's edge [n, k] px, in float64."""
    offset = bank[..., :2].astype(np.float64) - np.array(world.start)
    edge: np.ndarray = np.hypot(offset[..., 0], offset[..., 1]) - bank[..., 2]
    return edge


def _in_order(content: bytes) -> bytes:
    """The same safetensors with a sorted header, which the library writes in any order: same bank, same bytes."""
    size = int.from_bytes(content[:8], "little")
    header = json.dumps(json.loads(content[8 : 8 + size]), sort_keys=True).encode()
    header += b" " * (-len(header) % 8)
    return len(header).to_bytes(8, "little") + header + content[8 + size :]


def checksum(bank: Tensor) -> str:
    """SHA-256 of a bank's numbers."""
    return hashlib.sha256(bank.cpu().contiguous().numpy().tobytes()).hexdigest()


def main(argv: list[str] | None = None) -> int:
    """Generate banks, or check that files are what their headers say."""
    arguments = commands.parse("layouts", argv)
    try:
        if arguments.check:
            for layouts in arguments.check:
                bank, header = check(layouts)
                made = f"as generated by seed {header['generator_seed']}"
                print(f"{layouts}: {len(bank)} sets of {bank.shape[1]} obstacles, world {VERSION}, {made}")
            return 0
        if arguments.seed is not None and arguments.split == "all":
            raise LayoutError(f"--seed {arguments.seed}: give --split too, or all banks would hold the same sets")
        for split in SPLITS if arguments.split == "all" else [arguments.split]:
            n = SPLITS[split].n if arguments.n is None else arguments.n
            seed = SPLITS[split].seed if arguments.seed is None else arguments.seed
            path = arguments.out / f"{split}.safetensors"
            save(generate(n, arguments.k, seed), path, seed=seed, split=split)
            print(f"wrote {path}: {n} sets of {arguments.k} obstacles from seed {seed}")
    except LayoutError as error:
        print(f"uavnav layouts: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
