"""From run folders to report.md: the paper's two tables beside ours in every reading, learning curves, methods.

`python -m uavnav.report [FOLDER...] [--out DIR]`

A *cell* is an algorithm with an activation and all other settings; runs of one cell with other seeds are merged. Read
are the rows that runs left, nothing that trains. Frames are per seed throughout.
"""

from __future__ import annotations

import argparse
import datetime
import io
import json
import os
import re
import sys
import tempfile
import textwrap
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from uavnav import paper
from uavnav.metrics import EPISODE_COLUMNS, LAST, METRICS, MODES, finished, last_episodes, per_seed
from uavnav.runs import Run, RunError

BINS = 25
"""Of a run's frames, along a learning curve."""
CURVES = {"reward": "reward per episode", "steps": "steps per episode"}
COLOURS = {"tanh": "#0072B2", "sigmoid": "#D55E00", "relu": "#009E73", "leaky_relu": "#CC79A7"}
OTHER_COLOURS = ("#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's, without the yellow."""
LINES = ("-", ":", "-.")
"""Of the cells of one activation; dashes are the paper's."""
NAMED = ("preset", "frames", "n_worlds", "obstacles", "reward", "init")
"""Settings that every section names; others are named where cells differ in them, or from their preset."""
EMPTY = pd.DataFrame(columns=[*EPISODE_COLUMNS, "mode"]).astype(EPISODE_COLUMNS)


class Cell(NamedTuple):
    """Runs that differ in their seeds alone."""

    algorithm: str
    activation: str
    settings: dict[str, Any]  # all else that its runs share
    runs: list[Run]
    episodes: pd.DataFrame  # of training, the columns of `metrics.EPISODE_COLUMNS`
    evaluation: pd.DataFrame  # the same and `mode`; no rows where there is none
    label: str = ""


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
        tables = [_markdown(table(part, name, ratio_of_means)) for ratio_of_means in (False, True)]
        sections.append({"name": name, "usual": usual, "pictures": pictures, "tables": tables})
    text = _TEMPLATE.render(
        missing=[" ".join(cell) for cell in paper.TABLES if cell not in there],
        sections=sections,
        facts=_facts([run for cell in cells for run in cell.runs]),
        runs=_markdown(_run_table(cells)),
        left_out=left_out,
        last=LAST,
        bins=BINS,
    )
    out = Path(folders[0] if out is None else out)
    _write_all(out, figures | {"report.md": (text.strip() + "\n").encode()})
    return Written(out / "report.md", left_out)


# --- from folders to cells


def run_folders(folder: Path) -> list[Path]:
    """Every folder with a config.yaml in or below a folder, in order of name; hidden ones are not looked into.

    Raises:
        RunError: it is missing, a file, or holds none.
    """
    if not folder.is_dir():
        problem = "is a file" if folder.exists() else "there is no such folder"
        raise RunError(f"{folder}: {problem}; give a folder that holds runs")
    found = []
    for path, names, files in os.walk(folder):
        names[:] = sorted(name for name in names if not name.startswith(".") and name != "checkpoint")
        if "config.yaml" in files:
            found.append(Path(path))
    if not found:
        raise RunError(f"{folder}: holds no run; give a folder that does, or train one with out={folder}/ppo/tanh")
    return found


def collect(folders: Sequence[Path]) -> tuple[list[Cell], list[str]]:
    """The cells of all runs in some folders, and one line for each run that is of no use.

    Raises:
        RunError: a folder is missing or holds no run, or no run can be used.
    """
    paths = {path.resolve(): path for folder in folders for path in run_folders(folder)}
    cells: dict[str, Cell] = {}
    left_out = []
    for path in paths.values():
        try:
            cell = read(path)
            key = json.dumps(cell[:3], sort_keys=True, default=str)
            cells[key] = _merged(cells[key], cell) if key in cells else cell
        except RunError as error:
            left_out.append(_one_line(error))
    if not cells:
        raise RunError(f"{', '.join(map(str, folders))}: no run that can be used; {left_out[0]}")
    return list(cells.values()), left_out


def read(path: Path) -> Cell:
    """The cell of one run.

    Raises:
        RunError: it is missing, damaged, not finished, or lacks what a report needs.
    """
    run = Run(path)
    config = {"algorithm": run.algorithm} | run.config
    for key, kind in {"algorithm": str, "activation": str, "seed": int, "n_seeds": int}.items():
        if not isinstance(config.pop(key, None), kind):
            raise RunError(f"{path / 'config.yaml'}: has no {key}; not a run of this package")
    if not re.fullmatch(r"[\w-]+", run.algorithm) or not run.seeds:
        raise RunError(f"{path / 'config.yaml'}: names no algorithm or no seeds; not a run of this package")
    for key in ("bank", "versions", "beyond_preset"):
        if not isinstance(run.meta.setdefault(key, {}), dict):
            raise RunError(f"{path / 'meta.json'}: {key} is no table; not a run of this package")
    if not isinstance(run.meta.get("frames"), int) or run.frames < 1:
        raise RunError(f"{path / 'meta.json'}: does not say how many frames were run; not a run of this package")
    bank, world = run.meta["bank"], run.meta["versions"].get("world", "not known")
    facts = {"obstacles": bank.get("k", "not known"), "bank": bank.get("sha256", "not known"), "world": world}
    settings = config | {"frames": run.frames} | facts
    evaluation = run.evaluation()
    return Cell(
        run.algorithm,
        run.config["activation"],
        settings,
        [run],
        _checked(run, "episodes", run.episodes),
        EMPTY if evaluation is None else _checked(run, "evaluation", evaluation, "mode"),
    )


def _checked(run: Run, name: str, rows: pd.DataFrame, *more: str) -> pd.DataFrame:
    """The columns that rows of episodes have, in their types, and more; or a RunError."""
    try:
        rows = rows[[*EPISODE_COLUMNS, *more]].astype(EPISODE_COLUMNS)
    except (KeyError, ValueError, TypeError) as error:
        raise RunError(f"{run.path / name}.parquet: not a table of episodes ({error})") from error
    if not set(rows["seed"]) <= set(run.seeds):
        raise RunError(f"{run.path / name}.parquet: has seeds that config.yaml has not")
    return rows


def _merged(cell: Cell, other: Cell) -> Cell:
    (added,) = other.runs
    for run in cell.runs:
        if twice := sorted({*run.seeds} & {*added.seeds}):
            raise RunError(f"{added.path}: its seed {twice[0]} is in {run.path} already, with the same settings")
    return cell._replace(
        runs=[*cell.runs, added],
        episodes=_joined(cell.episodes, other.episodes),
        evaluation=_joined(cell.evaluation, other.evaluation),
    )


def _joined(*tables: pd.DataFrame) -> pd.DataFrame:
    filled = [table for table in tables if len(table)]
    return pd.concat(filled, ignore_index=True) if filled else tables[0]


def label(cells: list[Cell]) -> tuple[list[Cell], str]:
    """An algorithm's cells in the paper's order, labelled by how each differs from what is usual, and what is usual."""
    settings = [{key: _show(value) for key, value in cell.settings.items()} for cell in cells]
    differing = {key for one in settings for key in one if len({other.get(key) for other in settings}) > 1}
    differing -= {"total_frames"} if "frames" in differing else set()
    beyond = {key for cell in cells for run in cell.runs for key in run.meta["beyond_preset"]}
    named = [*NAMED, *sorted((differing | beyond).difference(NAMED))]
    usual = {key: Counter(one.get(key) for one in settings).most_common(1)[0][0] for key in named if cells}
    labelled = []
    for cell, own in zip(cells, settings, strict=True):
        changes = ", ".join(f"{key}={own.get(key)}" for key in usual if own.get(key) != usual[key])
        labelled.append(cell._replace(label=f"{cell.activation} ({changes})" if changes else cell.activation))
    order = [activation for _, activation in paper.TABLES]
    labelled.sort(key=lambda cell: ([*order, cell.activation].index(cell.activation), cell.label))
    return labelled, ", ".join(f"{key}={value}" for key, value in usual.items())


# --- tables


def readings(cell: Cell) -> dict[str, pd.DataFrame]:
    """The episodes that ended, in each reading of what the paper averages (decision 12)."""
    training = {"all training episodes": cell.episodes, f"last {LAST} training episodes": last_episodes(cell.episodes)}
    modes = {f"{mode} evaluation": cell.evaluation[cell.evaluation["mode"] == mode] for mode in MODES}
    return {name: finished(rows) for name, rows in (training | modes).items()}


def table(cells: list[Cell], algorithm: str, ratio_of_means: bool) -> list[list[str]]:
    """A header and rows: for each activation the paper's, then every reading of each cell.

    ratio_of_means: the ratios alone, as ratios of means (decision 13).
    """
    metrics = [name for name, metric in METRICS.items() if metric.scale is not None or not ratio_of_means]
    rows = [["activation", "reading", "seeds", "episodes", "cut off", *(METRICS[name].label for name in metrics)]]
    of_paper = [activation for name, activation in paper.TABLES if name == algorithm]
    for activation in dict.fromkeys([*of_paper, *(cell.activation for cell in cells)]):
        ours = [cell for cell in cells if cell.activation == activation]
        if activation in of_paper:
            printed = paper.TABLES[algorithm, activation]
            beside = [f"{printed[name]:,}" if name in printed else "-" for name in metrics]
            rows.append([activation, "the paper", "1", "-", "-", *beside])
        if not ours:
            rows.append([activation, "missing: no finished run", "0", *["-"] * (len(metrics) + 2)])
        for cell in ours:
            for name, part in readings(cell).items():
                reading = name if len(part) else f"{name}: missing"
                rows.append([cell.label, reading, *_values(part, metrics, ratio_of_means)])
    return rows


def _values(part: pd.DataFrame, metrics: list[str], ratio_of_means: bool) -> list[str]:
    """Seeds, episodes, share cut off, and each metric as mean ± standard deviation over seeds."""
    if part.empty:
        return ["0", "0", *["-"] * (len(metrics) + 1)]
    seeds, cut = per_seed(part, ratio_of_means), part[part["truncated"]]
    share = f"{len(cut) / len(part):.1%}" + (f" at {cut['steps'].max():,} steps" if len(cut) else "")
    return [str(len(seeds)), f"{len(part):,}", share, *(_spread(seeds[name], METRICS[name].digits) for name in metrics)]


def _spread(values: pd.Series[float], digits: int) -> str:
    mean = f"{values.mean():,.{digits}f}"
    return mean if len(values) == 1 else f"{mean} ± {values.std():,.{digits}f}"


# --- learning curves


def curve(cell: Cell, column: str) -> pd.DataFrame:
    """Means per bin of frames (index: its middle) and seed (columns), over the episodes that ended in it."""
    ended, width = finished(cell.episodes), cell.settings["frames"] / BINS
    middle = (((ended["frame"] - 1) // width).clip(0, BINS - 1) + 0.5) * width
    return ended.groupby([middle, "seed"])[column].mean().unstack("seed")


def draw(cells: list[Cell]) -> bytes:
    """A PNG of one algorithm's learning curves: a line a cell, a band from the lowest to the highest seed."""
    figure = Figure(figsize=(8, 7), dpi=120, layout="constrained")
    panels = figure.subplots(len(CURVES), 1, sharex=True)
    for axes, column in zip(panels, CURVES, strict=True):
        plot(axes, cells, column)
    panels[-1].set_xlabel("frames per seed")
    panels[-1].xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    panels[-1].xaxis.set_major_locator(MaxNLocator(6))
    dashed = Line2D([], [], color="grey", linestyle="--", linewidth=1, label="the paper's mean, in each colour")
    handles = [*panels[0].get_legend_handles_labels()[0], dashed]
    figure.legend(handles=handles, loc="outside upper center", ncols=2, frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def plot(axes: Axes, cells: list[Cell], column: str) -> None:
    """One panel: a metric's curves in their activations' colours, and the paper's means."""
    others = sorted({cell.activation for cell in cells}.difference(COLOURS))
    colours = COLOURS | {name: OTHER_COLOURS[place % len(OTHER_COLOURS)] for place, name in enumerate(others)}
    drawn: Counter[str] = Counter()
    for cell in cells:
        seeds, colour, style = curve(cell, column), colours[cell.activation], LINES[drawn[cell.activation] % len(LINES)]
        legend = textwrap.fill(f"{cell.label}, n = {sum(len(run.seeds) for run in cell.runs)}", 50)
        axes.plot(seeds.index, seeds.mean(axis=1), style, marker=".", color=colour, linewidth=1.5, label=legend)
        axes.fill_between(seeds.index, seeds.min(axis=1), seeds.max(axis=1), color=colour, alpha=0.2, linewidth=0)
        printed = paper.TABLES.get((cell.algorithm, cell.activation))
        if printed and not drawn[cell.activation]:
            axes.axhline(printed[column], color=colour, linestyle="--", linewidth=1)
        drawn[cell.activation] += 1
    axes.set_ylabel(CURVES[column])
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:,g}"))
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)


def describe(cells: list[Cell]) -> str:
    """The figure in words: where each line ends."""
    ends = []
    for cell in cells:
        last = {column: curve(cell, column).mean(axis=1).tail(1) for column in CURVES}
        ends.append(f"{cell.label} " + ", ".join(f"{name} {value:,.1f}" for name, end in last.items() for value in end))
    return f"{' and '.join(CURVES.values())} in training against frames per seed, in the last bin: {'; '.join(ends)}"


# --- the report


def _facts(runs: list[Run]) -> list[str]:
    """Versions, commits, machines and banks, and which runs have which where they are not the same."""
    lines = []
    for kind in ("versions", "git_commit", "machine", "bank"):
        groups: dict[str, list[str]] = {}
        for run in runs:
            fact = run.meta.get(kind)
            if isinstance(fact, dict):
                fact = ", ".join(f"{key} {_show(value)}" for key, value in fact.items())
            groups.setdefault(_one_line(fact or "not known"), []).append(str(run.path))
        for value, paths in groups.items():
            lines.append(f"{kind.replace('_', ' ')}: {value}" + (f" ({', '.join(paths)})" if len(groups) > 1 else ""))
    return lines


def _run_table(cells: list[Cell]) -> list[list[str]]:
    rows = [["run", "cell", "seeds", "frames per seed", "ended", "wall time", "threads", "compiled"]]
    for run, name in [(run, f"{cell.algorithm} {cell.activation}") for cell in cells for run in cell.runs]:
        seconds, first, last = run.meta.get("wall_seconds"), run.seeds[0], run.seeds[-1]
        wall = str(datetime.timedelta(seconds=round(seconds))) if isinstance(seconds, (int, float)) else "not known"
        how = [_show(run.meta.get(fact, "not known")) for fact in ("threads", "compiled")]
        seeds = str(first) if first == last else f"{first} ... {last}"
        ended = str(run.meta.get("ended", "not known")).partition("T")[0]
        rows.append([str(run.path), name, seeds, f"{run.frames:,}", ended, wall, *how])
    return rows


def _markdown(rows: list[list[str]]) -> str:
    """A table whose first row is its header and whose numbers, from the third column on, are right-aligned."""
    rule = ["---" if place < 2 else "---:" for place in range(len(rows[0]))]
    lines = (" | ".join(cell.replace("|", "\\|") for cell in row) for row in [rows[0], rule, *rows[1:]])
    return "\n".join(f"| {line} |" for line in lines)


def _show(value: object) -> str:
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else _one_line(value)


def _one_line(text: object) -> str:
    return " ".join(str(text).split())


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


def main(argv: Sequence[str] | None = None) -> int:
    """Write report.md: the paper's tables beside ours in every reading, learning curves, and how runs were made."""
    parser = argparse.ArgumentParser(prog="python -m uavnav.report", description=main.__doc__)
    parser.add_argument("folders", nargs="*", default=["results"], metavar="FOLDER", help="of runs (default: results)")
    parser.add_argument("--out", metavar="DIR", help="where the report goes (default: the first FOLDER)")
    arguments = parser.parse_args(argv)
    try:
        written = report(arguments.folders, arguments.out)
    except RunError as error:
        print(f"uavnav.report: {_one_line(error)}", file=sys.stderr)
        return 2
    for line in written.left_out:
        print(f"uavnav.report: left out: {line}", file=sys.stderr)
    print(f"the report is in {written.path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
