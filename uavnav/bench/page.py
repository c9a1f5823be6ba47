"""The file of benchmarks: a section each, every one with the date and the commit of its measurement."""

from __future__ import annotations

import importlib.metadata
import io
import os
import platform
import re
from contextlib import suppress
from pathlib import Path

from matplotlib.figure import Figure

from uavnav import files
from uavnav.bench.plan import CORES
from uavnav.bench.results import clock, when
from uavnav.bench.sections import SECTIONS
from uavnav.cli.benches import BY_DEFAULT
from uavnav.tasks.world import VERSION
from uavnav.training.provenance import processor

HEADER = """# Benchmarks

Written by `uavnav bench`, on one machine, one measurement after the other, each in a fresh process. Figures
are medians over rounds; a ratio is the median of the rounds' ratios. Machines differ and drift: compare
ratios only."""
MARK = re.compile(r"^<!-- bench: (\w+) -->\n", flags=re.MULTILINE)
TITLES = {
    "machine": "The machine",
    "targets": "What must be reached",
    **{name: section.title for name, section in SECTIONS.items()},
}
PACKAGES = ("uavnav", "torch", "torchrl", "tensordict", "numpy", "gymnasium", "stable-baselines3", "sbx-rl", "jax")


def machine() -> str:
    """The machine and the versions, in a sentence."""
    versions = [f"python {platform.python_version()}", f"world {VERSION}"]
    for name in PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            versions.append(f"{name} {importlib.metadata.version(name)}")
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    return f"{processor()}, {CORES} cores in use, {memory:.0f} GB, {platform.system()}; {', '.join(versions)}"


def read_sections(path: Path) -> dict[str, str]:
    """The sections of a file as they stand; none where there is no file."""
    if not path.is_file():
        return {}
    _, *parts = MARK.split(path.read_text())
    return dict(zip(parts[::2], (text.strip() for text in parts[1::2]), strict=True))


def write_sections(path: Path, sections: dict[str, list[str]], seconds: float, mark: str = "") -> None:
    """Put sections into the file in place of the old ones; the file is whole or as it was.

    The machine has a section of its own, as of the last plain run; a section that is measured apart says its own.

    Args:
        path: the file.
        sections: the lines of each.
        seconds: how long it took to measure them.
        mark: what to say beside the date.

    Raises:
        OSError: it cannot be written.
    """
    now = f"{when()}{mark and f', {mark}'}"
    apart = f"{now}, in {clock(seconds)}; {machine()}"
    plain = {*BY_DEFAULT, "targets"}
    fresh = {name: [f"*{now if name in plain else apart}.*", "", *lines] for name, lines in sections.items()}
    if plain & set(sections):
        fresh["machine"] = [f"{apart}."]
    every = read_sections(path) | {name: "\n".join([f"## {TITLES[name]}", "", *lines]) for name, lines in fresh.items()}
    parts = [f"<!-- bench: {name} -->\n{every[name]}" for name in TITLES if name in every]
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write(path, ("\n\n".join([HEADER, *parts]) + "\n").encode())


def write_figure(path: Path, figure: Figure) -> None:
    """Write a picture; it is whole or as it was. Raises OSError."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110)
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write(path, content.getvalue())
