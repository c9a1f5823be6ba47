"""From run folders to a report: verdicts on the paper's claims, tables, figures, replays, methods.

`python -m uavnav.report [FOLDER...] [--out DIR]`

Read are the rows that runs left, and their policies fly a little; nothing here trains.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jinja2

from uavnav import paper
from uavnav.metrics import LAST
from uavnav.report.cells import BINS, collect, label
from uavnav.report.figures import describe, draw
from uavnav.report.tables import facts, markdown, run_table, table
from uavnav.runs import RunError


class Written(NamedTuple):
    """Where a report is, and one line for each run that is not in it."""

    path: Path
    left_out: list[str]


def report(folders: Sequence[str | Path] = ("results",), out: str | Path | None = None) -> Written:
    """Write report.md and its figures for all runs in some folders; `out` is the first of them by default.

    Raises:
        RunError: a folder is missing or holds no run, no run can be used, or `out` cannot be written: nothing is.
    """
    cells, left_out = collect([Path(folder) for folder in folders])
    there = {(cell.algorithm, cell.activation) for cell in cells}
    algorithms = dict.fromkeys([*(name for name, _ in paper.TABLES), *sorted(name for name, _ in there)])
    sections: list[dict[str, Any]] = []
    figures: dict[str, bytes] = {}
    for name in algorithms:
        part, usual = label([cell for cell in cells if cell.algorithm == name])
        apart = {name: [cell for cell in part if cell.label == cell.activation]}  # of its usual settings, and others
        apart[f"{name}-other-settings"] = [cell for cell in part if cell.label != cell.activation]
        drawn = {f"figures/{stem}.png": members for stem, members in apart.items() if members}
        figures |= {file: draw(members) for file, members in drawn.items()}
        pictures = [{"file": file, "alt": describe(members)} for file, members in drawn.items()]
        tables = [markdown(table(part, name, ratio_of_means)) for ratio_of_means in (False, True)]
        sections.append({"name": name, "usual": usual, "pictures": pictures, "tables": tables})
    text = _TEMPLATE.render(
        missing=[" ".join(cell) for cell in paper.TABLES if cell not in there],
        sections=sections,
        facts=facts([run for cell in cells for run in cell.runs]),
        runs=markdown(run_table(cells)),
        left_out=left_out,
        last=LAST,
        bins=BINS,
    )
    out = Path(folders[0] if out is None else out)
    _write_all(out, figures | {"report.md": (text.strip() + "\n").encode()})
    return Written(out / "report.md", left_out)


def _write_all(out: Path, files: dict[str, bytes]) -> None:
    """Write all files aside, then rename them into place, the last one last; or a RunError."""
    try:
        targets = [out / name for name in files]
        for target in targets:
            if target.is_dir():
                raise IsADirectoryError(f"{target} is a folder")
        for target in targets:
            target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".report-", dir=out) as aside:
            for place, content in enumerate(files.values()):
                Path(aside, str(place)).write_bytes(content)
            for place, name in enumerate(files):
                os.replace(Path(aside, str(place)), out / name)
    except OSError as error:
        raise RunError(f"{out}: cannot be written ({error}); give another folder with --out") from error


_TEMPLATE = jinja2.Environment(
    trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True, undefined=jinja2.StrictUndefined
).from_string("""\
# Results
{% if missing %}

**Not complete.** No finished run of {{ missing | join(", ") }}.
{% endif %}

Numbers of ours are means over training seeds of each seed's own mean, ± the standard deviation over seeds; one seed has
none. The paper printed one run a cell. What it averages is open: all training episodes, the last {{ last }} of each
seed, and evaluation on test sets of obstacles (greedy, and sampled as at the end of training) stand side by side. *cut
off* is the share of episodes that a cap on steps ended: no collisions, and they would have gone on. Episodes still open
at the end of training are in no mean. Steps, distance [px] and reward are per episode, speed is in px a step. *stops*
are steps of distance 0, *full stops* those without a turn too: what the paper's column is taken to mean.
{% for section in sections %}

## {{ section.name | upper }}

{% if section.usual %}
Unless a row says otherwise: {{ section.usual }} (frames and n_worlds per seed, obstacles a set).

{% for picture in section.pictures %}
![{{ section.name }}: {{ picture.alt }}]({{ picture.file }})

{% endfor %}
Lines are means over seeds of each seed's mean over the episodes that ended in each of {{ bins }} bins of frames; a seed
with none is not in that bin. Bands are from the lowest to the highest seed. Dashed: the paper's mean over its run.
{% if section.pictures | length > 1 %}
Cells with other settings are in the second figure.
{% endif %}
{% else %}
No finished run.
{% endif %}

### {{ section.name | upper }}: stops, turns and speed as means of each episode's ratio

{{ section.tables[0] }}

### {{ section.name | upper }}: stops, turns and speed as ratios of means

{{ section.tables[1] }}
{% endfor %}

## How the runs were made

{% for line in facts %}
- {{ line }}
{% endfor %}

A commit with + had changes beside it. Wall times, h:mm:ss, are of all seeds of a run together.

{{ runs }}
{% if left_out %}

## Left out

{% for line in left_out %}
- {{ line }}
{% endfor %}
{% endif %}
""")
