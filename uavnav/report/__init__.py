"""From run folders to a report: one's own runs and the scripted policy, and the paper's study.

`python -m uavnav.report [FOLDER...] [--out DIR]` writes report.html, report.md, tables/ and figures/.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from uavnav import files
from uavnav.runs import run_folders
from uavnav.runs.tables import RunError

RUNS, RESULTS, OUT = "runs", "results", "report"
"""Folders of one's own runs, of the committed ones, and of a report on these that nobody asked to renew."""


class Written(NamedTuple):
    """Where a report is, and one line for each run or table that is not in it."""

    path: Path
    left_out: list[str]


def places(folders: Sequence[str | Path], out: str | Path | None) -> tuple[list[Path], Path]:
    """The folders that a report reads, and where it goes: by default `runs`, into itself, or `results`.

    `results` is committed, so that a report on it that nobody asked to renew goes to `report`.
    """
    committed = Path(RESULTS).is_dir() and not Path(RUNS).is_dir()
    read = [Path(folder) for folder in folders or [RESULTS if committed else RUNS]]
    usual = OUT if committed and not folders else read[0]
    return read, Path(usual if out is None else out)


def report(
    folders: Sequence[str | Path] = (),
    out: str | Path | None = None,
    tell: Callable[[str], None] = lambda step: None,
    watched: bool = False,
) -> Written:
    """Write the report on all runs in some folders; without folders and `out` as `places` says.

    tell: is told each step of the work; watched: the page renews itself.

    Raises:
        RunError: no run can be used, or `out` cannot be written: nothing is.
    """
    read, where = places(folders, out)
    try:
        files.check_out(where / "report.html")  # before the work
    except ValueError as error:
        raise RunError(str(error)) from error
    for folder in read:
        run_folders(folder)
    tell("loading PyTorch")
    from uavnav.report import mine, page  # which fly, and so load torch
    from uavnav.report.configurations import collect
    from uavnav.report.content import gather

    tell("loading runs")
    begun = mine.unfinished(read)
    try:
        found = collect(read)
    except RunError:
        if not begun:
            raise
        found = [], []
    finished = {run.path for one in found[0] for run in one.runs}  # some of them since the line above
    begun = {path: one for path, one in begun.items() if path not in finished}
    own = mine.gather(found[0], begun, read, where, tell)
    left_out = [line for line in found[1] if not line.startswith(tuple(f"{path}:" for path in begun))]
    if own is not None and own.claims:
        _write_all(where, mine.contents(own, left_out, watched))
        return Written(where / "report.html", [*left_out, *own.left_out])
    content = gather(read, found=(found[0], left_out), tell=tell)
    tell("writing the page")
    _write_all(where, page.contents(content, read[0], own, watched))
    return Written(where / "report.html", content.left_out)


def _write_all(out: Path, contents: Mapping[str, bytes]) -> None:
    """Write some files, by their paths below `out`; raises a RunError, before any is written if it can."""
    targets = {out / name: content for name, content in contents.items()}
    try:
        for target in targets:
            if target.is_dir():
                raise IsADirectoryError(f"{target} is a folder")
            if target.parent.is_file():
                raise NotADirectoryError(f"{target.parent} is a file")
        for target, content in targets.items():
            target.parent.mkdir(parents=True, exist_ok=True)
            files.write(target, content)
    except OSError as error:
        raise RunError(f"{out}: cannot be written ({error}); give another folder with --out") from error
