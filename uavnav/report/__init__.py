"""From run folders to a report: verdicts on the paper's claims, tables, figures, replays, methods.

`python -m uavnav.report [FOLDER...] [--out DIR]` writes report.html, report.md, tables/ and figures/. It
reads the rows that runs left, and lets their policies fly a little; nothing here trains.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from uavnav import files
from uavnav.runs.tables import RunError


class Written(NamedTuple):
    """Where a report is, and one line for each run or table that is not in it."""

    path: Path
    left_out: list[str]


def report(folders: Sequence[str | Path] = ("results",), out: str | Path | None = None) -> Written:
    """Write the report on all runs in some folders; `out` is the first of them by default.

    Raises:
        RunError: a folder is missing or holds no run, no run can be used, or `out` cannot be written: nothing
            is.
    """
    from uavnav.report.content import gather  # which flies, and so loads torch
    from uavnav.report.page import contents
    from uavnav.views.replays import record_apart

    if out is not None:
        try:
            files.check_out(Path(out) / "report.html")  # before the work
        except ValueError as error:
            raise RunError(str(error)) from error
    content = gather([Path(folder) for folder in folders], record_apart)
    out = Path(folders[0] if out is None else out)
    _write_all(out, contents(content, Path(folders[0])))
    return Written(out / "report.html", content.left_out)


def _write_all(out: Path, contents: Mapping[str, bytes]) -> None:
    """Write some files, by their paths below `out`; or a RunError, before any is written where that can
    be foreseen.
    """
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
