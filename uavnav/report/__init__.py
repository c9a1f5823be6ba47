"""From run folders to a report: verdicts on the paper's claims, tables, figures, replays, methods.

`python -m uavnav.report [FOLDER...] [--out DIR]` writes report.html, report.md, tables/ and figures/. Read are the rows
that runs left, and their policies fly a little; nothing here trains.
"""

from __future__ import annotations

import base64
import importlib.metadata
import json
import os
import re
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import pandas as pd
from markupsafe import Markup, escape

from uavnav.report import conclusions, frames, studies, tables
from uavnav.report.cells import BINS, label
from uavnav.report.claims import CLAIMS, CONTRADICTED, PRIMARY, SUPPORTED, UNDECIDED, verdict
from uavnav.report.content import LOOKED_AT, Content, gather
from uavnav.report.figures import save
from uavnav.runs import paper
from uavnav.runs.metrics import LAST
from uavnav.runs.tables import RunError

SECTIONS = {
    "verdicts": "Verdicts",
    "tables": "Tables",
    "curves": "Curves",
    "flights": "Flights",
    "statistics": "Statistics",
    "behaviour": "Behaviour",
    "why": "Why",
    "sensitivity": "Sensitivity",
    "baselines": "Baselines",
    "speed": "Speed",
    "methods": "Methods",
}
STATISTICS = {"mean": "means", "interquartile_mean": "interquartile means"}
_TEMPLATES = jinja2.Environment(
    loader=jinja2.PackageLoader("uavnav.report"),
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
    undefined=jinja2.StrictUndefined,
    autoescape=lambda template: template == "page.html",
)
_INTERVAL = re.compile(r"([−\d][^\[]*|–) (\[[^\]]+, [^\]]+\])(.*)")
_MARKDOWN = re.compile(r"`([^`]+)`|\[([^\]]+)\]\([^)]+\)")


def _cell(text: str) -> Markup:
    """A cell of a table: an interval below its number; of Markdown, code is code and a link its words."""
    if found := _INTERVAL.fullmatch(text):
        return Markup('{} <span class="interval">{}</span>{}').format(*found.groups())
    parts = []
    for place, part in enumerate(_MARKDOWN.split(text)):
        parts.append(Markup("<code>{}</code>").format(part) if place % 3 == 1 and part else escape(part or ""))
    return Markup("").join(parts)


_TEMPLATES.filters |= {"cell": _cell, "of_words": tables.of_words}


class Written(NamedTuple):
    """Where a report is, and one line for each run or table that is not in it."""

    path: Path
    left_out: list[str]


def report(folders: Sequence[str | Path] = ("results",), out: str | Path | None = None) -> Written:
    """Write the report on all runs in some folders; `out` is the first of them by default.

    Raises:
        RunError: a folder is missing or holds no run, no run can be used, or `out` cannot be written: nothing is.
    """
    content = gather([Path(folder) for folder in folders])
    files: dict[str, bytes] = {}
    data = {}
    for figure in content.figures:
        svg, png = save(figure.drawn.figure)
        files |= {f"figures/{figure.name}.svg": svg, f"figures/{figure.name}.png": png}
        data[figure.name] = base64.b64encode(svg).decode()
    for stem, frame in content.tables.items():
        files[f"tables/{stem}.csv"] = frame.to_csv(index=False, float_format="%.6g", lineterminator="\n").encode()
    for algorithm in ("dqn", "ppo"):
        rows = tables.beside_paper(_primary(content.tables["metrics"]), algorithm)
        files[f"tables/paper-{algorithm}.tex"] = tables.latex(rows).encode()
    files["report.html"] = page(content, data, Path(folders[0])).encode()
    files["report.md"] = markdown(content).encode()
    out = Path(folders[0] if out is None else out)
    _write_all(out, files)
    return Written(out / "report.html", content.left_out)


def _primary(metrics: pd.DataFrame) -> pd.DataFrame:
    return metrics[metrics["reading"] == PRIMARY]


def _claims(content: Content) -> list[dict[str, Any]]:
    found = []
    for claim in CLAIMS:
        mine = [one for one in content.findings if one.claim == claim.number]
        others = [(reading, findings) for reading, findings in content.audits.items() if reading != PRIMARY]
        found.append(
            {
                "number": claim.number,
                "sentence": claim.sentence,
                "verdict": verdict(mine),
                "text": f"{conclusions.sentence(claim, mine)} {conclusions.turned(mine, content.audits)}".strip(),
                "headline": conclusions.headline(mine),
                "rows": tables.audit_rows(mine),
                "table": tables.markdown(tables.audit_rows(mine)),
                "readings": [
                    (reading, tables.in_reading([one for one in findings if one.claim == claim.number]))
                    for reading, findings in others
                ],
            }
        )
    return found


def page(content: Content, pictures: dict[str, str], first: Path) -> str:
    """The one HTML file: styles, figures, replays and the player's code are in it.

    pictures: SVG by the figure's name, base64; first: the report's first folder, for what a command needs.
    """
    here = Path(__file__).parent
    frame, shown = content.tables, (PRIMARY, "sampled evaluation")
    replays = json.dumps(content.replays, separators=(",", ":")).replace("<", "\\u003c") if content.replays else ""
    drawn = [
        {
            "name": figure.name,
            "section": figure.section,
            "alt": figure.drawn.alt,
            "caption": figure.caption,
            "data": pictures[figure.name],
            "size": [round(96 * inches) for inches in figure.drawn.figure.get_size_inches()],
        }
        for figure in content.figures
    ]
    audited, of_paper = _claims(content), studies.paper_cells(content.studies.main)
    return _TEMPLATES.get_template("page.html").render(
        css=Markup((here / "templates" / "page.css").read_text() + (here / "replay.css").read_text()),
        js=Markup((here / "replay.js").read_text()),
        replays=Markup(replays),
        version=importlib.metadata.version("uavnav"),
        seeds=frames.total_seeds(of_paper),
        frames=frames.total_frames(of_paper),
        lead=conclusions.lead(content.audits[PRIMARY]),
        missing=content.missing,
        sections=list(SECTIONS.items()),
        rule=conclusions.RULE,
        fixed=conclusions.FIXED,
        not_of_training=conclusions.NOT_OF_TRAINING,
        counts={one: sum(claim["verdict"] == one for claim in audited) for one in (SUPPORTED, CONTRADICTED, UNDECIDED)},
        claims=audited,
        primary=PRIMARY,
        cap=f"{frames.CAP:,}",
        paper_tables=[
            (
                f"Table {number}: {algorithm.upper()}, {STATISTICS[statistic]}",
                tables.beside_paper(frame["metrics"], algorithm, statistic),
                statistic == "mean",
            )
            for number, algorithm in ((1, "dqn"), (2, "ppo"))
            for statistic in STATISTICS
        ],
        drawn=drawn,
        interaction_rows=tables.interactions(frame["interaction"]),
        survival_rows=tables.survivals(frame["survival"]),
        power_rows=tables.powers(frame["power"]),
        behaviour_text=conclusions.BEHAVIOUR,
        behaviour_rows=tables.measured(frame["behaviour"], LOOKED_AT),
        why_rows=tables.pivot(frame["diagnostics"], "diagnostic"),
        overestimation_rows=tables.overestimated(frame["overestimation"]),
        sensitivity_text=conclusions.sensitivity(content.studies, frame["sensitivity"]),
        sensitivity_rows=tables.sensitivities(frame["sensitivity"]),
        by_default_caption=conclusions.by_default(content.studies, frame["by_default"]),
        by_default_rows=tables.by_default(frame["by_default"]) if len(frame["tuned"]) else [],
        tuned_rows=tables.of_metrics(frame["tuned"], ("reward", "steps", "speed"), shown),
        wide_frames=frames.total_frames(studies.wide(content.studies)),
        wide_rows=tables.of_metrics(frame["wide"], ("reward", "steps", "speed"), shown),
        baseline_rows=tables.baselines(content.baselines, of_paper),
        first=first,
        speed_rows=tables.speeds(frame["speed"]),
        facts=tables.facts([run for cell in content.cells for run in cell.runs]),
        run_rows=tables.run_table(content.cells),
        decision_rows=tables.decisions(),
        left_out=content.left_out,
    )


def markdown(content: Content) -> str:
    """report.md: the verdicts, the tables in every reading, how the runs were made."""
    sections = []
    of_cells = {cell.algorithm for cell in content.cells}
    for algorithm in dict.fromkeys([*(which for which, _ in paper.TABLES), *sorted(of_cells)]):
        part, usual = label([cell for cell in content.cells if cell.algorithm == algorithm])
        pictures = [
            {"file": f"figures/{figure.name}.png", "alt": figure.drawn.alt}
            for figure in content.figures
            if figure.name.startswith(f"curves-{algorithm}-")
        ]
        found = tables.estimated(part)
        shown = [tables.markdown(tables.table(found, algorithm, ratio)) for ratio in (False, True)]
        sections.append({"name": algorithm, "usual": usual, "pictures": pictures, "tables": shown})
    others = tables.baselines(content.baselines, studies.paper_cells(content.studies.main))
    text = _TEMPLATES.get_template("report.md").render(
        missing=content.missing,
        rule=conclusions.RULE,
        fixed=conclusions.FIXED,
        verdicts=tables.markdown(tables.overview(CLAIMS, content.audits, PRIMARY)),
        not_of_training=conclusions.NOT_OF_TRAINING,
        behaviour_text=conclusions.BEHAVIOUR,
        claims=_claims(content),
        sections=sections,
        baselines=tables.markdown(others) if len(others) > 1 else "",
        facts=tables.facts([run for cell in content.cells for run in cell.runs]),
        runs=tables.markdown(tables.run_table(content.cells)),
        left_out=content.left_out,
        last=LAST,
        bins=BINS,
    )
    return text.strip() + "\n"


def _write_all(out: Path, files: dict[str, bytes]) -> None:
    """Write all files aside, then rename them into place, the last one last; or a RunError."""
    try:
        targets = [out / name for name in files]
        for target in targets:
            if target.is_dir():
                raise IsADirectoryError(f"{target} is a folder")
            if target.parent.is_file():
                raise NotADirectoryError(f"{target.parent} is a file")
        for target in targets:
            target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".report-", dir=out) as aside:
            for place, content in enumerate(files.values()):
                Path(aside, str(place)).write_bytes(content)
            for place, name in enumerate(files):
                os.replace(Path(aside, str(place)), out / name)
    except OSError as error:
        raise RunError(f"{out}: cannot be written ({error}); give another folder with --out") from error
