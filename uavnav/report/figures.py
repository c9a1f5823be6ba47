"""Figures, each saying one thing: axes with units, n, the paper's value, colours for colour-blind readers too.

Every function takes plain data and returns a figure with its words. A cell's label is its algorithm, a space and its
activation, then perhaps settings in brackets: `ppo tanh (lr=0.1)`. Letters: S seeds of a cell, B bins of frames.
"""

from __future__ import annotations

import io
import textwrap
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Rectangle
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, PercentFormatter, StrMethodFormatter
from matplotlib.typing import RcKeyType
from torch import Tensor

from uavnav import stats
from uavnav.report.cells import BINS, Cell, curve
from uavnav.runs import paper
from uavnav.runs.metrics import METRICS, finished
from uavnav.stats import Array, Interval
from uavnav.tasks.world import World

DIAGNOSTICS = {
    "dormant": "dormant hidden units [share]",
    "saturated": "saturated activations [share]",
    "effective_rank": "effective rank of the last hidden layer [dimensions]",
    "grad_norm": "gradient norm before clipping",
    "entropy": "entropy of the policy [nat]",
    "q_value": "mean of max Q in training [reward]",
}
"""What a run's progress tells of its networks: columns that may say why activations differ."""
MEASURES = {
    "clearance": "clearance [px]",
    "corridor": "steps in corridors [share]",
    "corridor_flown": "distance flown in corridors [share]",
    "reversals": "reversals of turn [share of steps]",
    "trembling": "trembling [share of steps]",
    "straight_speed": "speed going straight [px a step]",
    "turning_speed": "speed in turns [px a step]",
    "border": "steps nearest to the border [share]",
}
"""How a policy flies."""

COLOURS = {"tanh": "#0072B2", "sigmoid": "#D55E00", "relu": "#009E73", "leaky_relu": "#CC79A7"}
OTHER_COLOURS = ("#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's, without the yellow."""
LINES = ("-", ":", "-.")
"""Of the cells of one activation; dashes are the paper's."""
INK, PALE, OBSTACLE = "#333333", "#767676", "#c8ccd2"


RESAMPLES = 1_000
"""Of the seeds, for the band of a curve."""
STYLE: dict[RcKeyType, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans", "Verdana", "Arial"],
    "font.size": 12,
    "axes.titlesize": 12,
    "axes.titlelocation": "left",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.alpha": 0.3,
    "legend.fontsize": 12,
    "legend.frameon": False,
    "figure.dpi": 120,
    "figure.constrained_layout.w_pad": 0.08,
    "figure.constrained_layout.h_pad": 0.08,
    "figure.facecolor": "white",
    "axes.facecolor": "white",
    "svg.fonttype": "none",
    "svg.hashsalt": "uavnav",
}
WIDTH = 8.0  # [inches]


class Drawn(NamedTuple):
    """A figure and one sentence that holds its main numbers."""

    figure: Figure
    alt: str


def save(figure: Figure) -> tuple[bytes, bytes]:
    """SVG and PNG, the same bytes on every call."""
    svg, png = io.BytesIO(), io.BytesIO()
    with matplotlib.rc_context(STYLE):
        if isinstance(figure.get_layout_engine(), ConstrainedLayoutEngine):
            figure.draw_without_rendering()
            figure.set_layout_engine("none")  # laid out once: a second time would move things by a hair
        figure.savefig(svg, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
        figure.savefig(png, format="png", metadata={"Software": None})
    return svg.getvalue(), png.getvalue()


# Curves over training


@matplotlib.rc_context(STYLE)
def curves(cells: Sequence[Cell], column: str) -> Drawn:
    """Learning curves of one algorithm, as the paper's figures 4 and 5: a line a cell, a band, the paper's mean dashed.

    cells: labelled ones of one algorithm; column: of their episodes.
    """
    title = _title((cell.algorithm for cell in cells), f"{METRICS[column]} in training")
    if not any(len(finished(cell.episodes)) for cell in cells):
        return _nothing(title)
    figure, axes = _one(title)
    lines = plot(axes, cells, column)
    axes.set_xlabel("frames per seed")
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.xaxis.set_major_locator(MaxNLocator(6))
    _name_dashes(axes, cells, column)
    band = Line2D([], [], color=PALE, linewidth=8, alpha=0.4, label="95 % interval over seeds")
    dashed = Line2D([], [], color=PALE, linestyle="--", label="the paper's mean")
    _legend(figure, [*axes.get_legend_handles_labels()[0], band, dashed], 3)
    ends = []
    for cell, line in zip(cells, lines, strict=True):
        printed = paper.TABLES.get((cell.algorithm, cell.activation))
        beside = f"the paper's mean {_number(printed[column])}" if printed else ""
        ends.append(f"{cell.label or cell.activation} {_end(line, beside)}")
    return Drawn(figure, f"{title} against frames per seed; in the last bin: {'; '.join(ends)}.")


def plot(axes: Axes, cells: Sequence[Cell], column: str) -> list[pd.DataFrame]:
    """One panel: a metric's curves in their activations' colours, and the paper's means; returns what `band` gives."""
    lines: list[pd.DataFrame] = []
    seen: set[str] = set()
    for cell, (colour, style) in zip(cells, _looks(cell.activation for cell in cells), strict=True):
        lines.append(band(curve(cell, column)))
        _line(axes, lines[-1], colour, style, f"{cell.label or cell.activation}, n = {_seeds(cell)}")
        printed = paper.TABLES.get((cell.algorithm, cell.activation))
        if printed and column in printed and cell.activation not in seen:
            axes.axhline(printed[column], color=colour, linestyle="--", linewidth=1)
        seen.add(cell.activation)
    axes.set_ylabel(str(METRICS[column]))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:,g}"))
    return lines


def _name_dashes(axes: Axes, cells: Sequence[Cell], column: str) -> None:
    """The paper's means at the right end of their lines, in their colours, none over another."""
    named = {cell.activation: paper.TABLES.get((cell.algorithm, cell.activation), {}) for cell in cells}
    printed = sorted((row[column], activation) for activation, row in named.items() if column in row)
    if not printed:
        return
    low, high = axes.get_ylim()
    axes.set_ylim(low, high)
    places = _apart([(mean - low) / (high - low) for mean, _ in printed], 0.055)
    colours = dict(zip(named, (colour for colour, _ in _looks(named)), strict=True))
    for (mean, activation), place in zip(printed, places, strict=True):
        axes.annotate(
            f"{activation} {_number(mean)}",
            (1, mean),
            (1.06, place),
            xycoords=axes.get_yaxis_transform(),
            textcoords="axes fraction",
            color=colours[activation],
            fontsize=11,
            va="center",
            annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": colours[activation], "linewidth": 0.8, "shrinkA": 1, "shrinkB": 0},
        )


def _apart(places: Sequence[float], gap: float) -> list[float]:
    """Ascending places, moved as little as may be until each is a gap from the next."""
    moved = list(places)
    for _ in range(100):
        for below in range(len(moved) - 1):
            lack = gap - (moved[below + 1] - moved[below])
            if lack > 0:
                moved[below] -= lack / 2
                moved[below + 1] += lack / 2
    return moved


@matplotlib.rc_context(STYLE)
def why(progress: Mapping[str, pd.DataFrame], column: str, label: str, bound: float | None = None) -> Drawn:
    """A diagnostic of one algorithm's networks over training: a line a cell, with its band over seeds.

    Earlier lines are wider, so that one below another is seen.

    progress: label of the cell -> rows with the columns seed, frame and, if it was kept, `column`; bound: the most that
    the world allows, drawn in.
    """
    title = _title((_parts(name)[0] for name in progress), label)
    kept = {name: rows for name, rows in progress.items() if column in rows and rows[column].notna().any()}
    if not kept:
        return _nothing(title)
    figure, axes = _one(title)
    frames = max(int(rows["frame"].max()) for rows in kept.values())
    ends: list[str] = []
    for (name, rows), (colour, style) in zip(kept.items(), _looks(_parts(name)[1] for name in kept), strict=True):
        seeds = binned(rows, column, frames)
        line, own = band(seeds), name.split(" ", 1)[-1]
        width = 1.8 + 1.3 * (len(kept) - 1 - len(ends))
        _line(axes, line, colour, style, f"{own}, n = {seeds.shape[1]}", width)
        ends.append(f"{own} {_end(line)}")
    if bound is not None:
        axes.axhline(bound, color=INK, linestyle="--", linewidth=1.2)
        words = f"nothing can earn more: {_number(bound)}"
        axes.annotate(words, (0.01, bound), xycoords=axes.get_yaxis_transform(), color=INK, fontsize=11, va="bottom")
        ends.append(f"nothing can earn more than {_number(bound)}")
    axes.set(xlabel="frames per seed", ylabel=textwrap.fill(label.rpartition(": ")[2], 36))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.xaxis.set_major_locator(MaxNLocator(6))
    band_ = Line2D([], [], color=PALE, linewidth=8, alpha=0.4, label="95 % interval over seeds")
    _legend(figure, [*axes.get_legend_handles_labels()[0], band_], 3)
    return Drawn(figure, f"{title} against frames per seed; in the last bin: {'; '.join(ends)}.")


def binned(rows: pd.DataFrame, column: str, frames: int) -> pd.DataFrame:
    """Means per bin of frames (index: its middle) and seed (columns), as of `cells.curve`."""
    rows, width = rows[rows[column].notna()], frames / BINS
    middle = (((rows["frame"] - 1) // width).clip(0, BINS - 1) + 0.5) * width
    return rows.groupby([middle, "seed"])[column].mean().unstack("seed")


def band(seeds: pd.DataFrame) -> pd.DataFrame:
    """Of values [B, S]: columns mean, low, high and n [B], the percentile bootstrap over seeds.

    A seed without a value counts for none in that bin; from fewer than two there is no interval: NaN.
    """
    values = seeds.to_numpy(dtype=np.float64)
    there = np.isfinite(values)
    filled, n = np.where(there, values, 0.0), values.shape[1]
    tail = (1 - stats.CONFIDENCE) / 2
    result = pd.DataFrame({"mean": np.nan, "low": np.nan, "high": np.nan, "n": there.sum(1)}, index=seeds.index)
    if not n:
        return result
    draws = np.random.default_rng(0).multinomial(n, np.full(n, 1 / n), size=RESAMPLES)  # how often each seed
    for row, (own, known) in enumerate(zip(filled, there, strict=True)):
        if known.any():
            result.iloc[row, 0] = own[known].mean()
        if known.sum() > 1:
            counts = draws @ known
            means = (draws @ own)[counts > 0] / counts[counts > 0]
            result.iloc[row, 1:3] = np.quantile(means, [tail, 1 - tail])
    return result


def _line(axes: Axes, line: pd.DataFrame, colour: str, style: str, legend: str, width: float = 1.8) -> None:
    words = textwrap.fill(legend, 50)
    axes.plot(line.index, line["mean"], style, marker=".", color=colour, linewidth=width, label=words)
    known = line["low"].notna()
    if known.any():
        axes.fill_between(line.index.to_numpy(), line["low"], line["high"], color=colour, alpha=0.2, linewidth=0)
    alone = line[known & ~known.shift(fill_value=False) & ~known.shift(-1, fill_value=False)]
    if len(alone):  # a band has no width there
        axes.vlines(alone.index.to_numpy(), alone["low"], alone["high"], color=colour, alpha=0.2, linewidth=6)


def _end(line: pd.DataFrame, beside: str = "") -> str:
    if not len(line):
        return "no data"
    mean, low, high, n = line.iloc[-1]
    return _said(Interval(mean, low, high, int(n)), beside)


# Cells side by side


@matplotlib.rc_context(STYLE)
def intervals(rows: Mapping[str, Array], printed: Mapping[str, float], axis: str) -> Drawn:
    """A metric's mean with its 95 % interval, its interquartile mean, its seeds and the paper's value: a row a cell.

    rows: label of the cell -> [S]; printed: label -> the paper's value; axis: the metric with its unit. The algorithms
    share a scale unless that would squeeze one of them into a fifth of it.
    """
    if not any(np.isfinite(values).any() for values in rows.values()):
        return _nothing(axis)
    groups: dict[str, list[str]] = {}
    for name in rows:
        groups.setdefault(_parts(name)[0], []).append(name)
    drawn = {name: np.asarray([*rows[name], printed.get(name, np.nan)], dtype=np.float64) for name in rows}
    spans = [np.concatenate([drawn[name] for name in members]) for members in groups.values()]
    spans = [span[np.isfinite(span)] for span in spans]
    widths = [float(np.ptp(span)) for span in spans if len(span)]
    share = len(groups) == 1 or min(widths) * 5 >= float(np.ptp(np.concatenate(spans)))
    heights = [len(members) for members in groups.values()]
    figure = Figure(figsize=(WIDTH, 0.5 * sum(heights) + 0.6 * len(groups) + 1.3), layout="constrained")
    panels = figure.subplots(len(groups), 1, sharex=share, squeeze=False, height_ratios=heights)[:, 0]
    said = []
    for axes, (group, members) in zip(panels, groups.items(), strict=True):
        for row, (name, (colour, _)) in enumerate(zip(members, _looks(_parts(one)[1] for one in members), strict=True)):
            seeds = rows[name]
            found = _row(axes, row, seeds, colour)
            middle = stats.interquartile_mean(np.sort(seeds[np.isfinite(seeds)])) if found.n else np.nan
            axes.plot(middle, row, "|", color=INK, markersize=16, markeredgewidth=2, zorder=4)
            axes.plot(printed.get(name, np.nan), row, "D", color="white", markeredgecolor=INK, markersize=8, zorder=5)
            beside = f"the paper's {_number(printed[name])}" if name in printed else ""
            said.append(f"{_name(name)} {_said(found, beside)}")
        _name_rows(axes, [f"{name.split(' ', 1)[-1]}, n = {len(rows[name])}" for name in members])
        axes.set_title(group.upper() + ("" if share else ", on its own scale"))
    panels[-1].set_xlabel(axis)
    handles = [
        Line2D([], [], marker="o", markersize=9, color=INK, label="mean, 95 % interval"),
        _mark("|", "interquartile mean", markersize=14, markeredgewidth=2),
        _mark("o", "a seed", markersize=5, alpha=0.5),
        _mark("D", "the paper", markersize=8, markerfacecolor="white"),
    ]
    _legend(figure, handles, 4)
    return Drawn(figure, f"{axis}, mean over seeds: {'; '.join(said)}.")


@matplotlib.rc_context(STYLE)
def behaviours(table: pd.DataFrame) -> Drawn:
    """How the cells fly: a panel a measure, in it a row a cell: mean, 95 % interval and seeds.

    table: a row a seed; columns cell, algorithm, activation, seed, and the measures, of which `MEASURES` names some.
    """
    measures = [name for name in table.columns if name not in ("cell", "algorithm", "activation", "seed")]
    measures = [name for name in measures if table[name].notna().any()]
    if not measures:
        return _nothing("how the cells fly")
    names = list(dict.fromkeys(table["cell"]))
    columns = min(len(measures), 2)
    lines = -(-len(measures) // columns)
    figure = Figure(figsize=(WIDTH, lines * (0.3 * len(names) + 0.9) + 0.5), layout="constrained")
    panels = figure.subplots(lines, columns, sharey=True, squeeze=False).ravel()
    said = []
    for axes, measure in zip(panels, measures, strict=False):
        parts = []
        for row, (name, (colour, _)) in enumerate(zip(names, _looks(_parts(one)[1] for one in names), strict=True)):
            seeds = table.loc[table["cell"] == name, measure].to_numpy(dtype=np.float64)
            found = _row(axes, row, seeds, colour)
            parts.append(f"{_name(name)} {_number(found.value)}")
        label = MEASURES.get(measure, measure.replace("_", " "))
        axes.set_xlabel(label)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        said.append(f"{label}: {', '.join(parts)}")
    for axes in panels[len(measures) :]:
        axes.set_axis_off()
    counts = table["cell"].value_counts()
    _name_rows(figure.axes[0], [f"{_name(name)}, n = {counts[name]}" for name in names])
    handles = [
        Line2D([], [], marker="o", markersize=8, color=INK, label="mean, 95 % interval over seeds"),
        _mark("o", "a seed", markersize=5, alpha=0.5),
    ]
    _legend(figure, handles)
    return Drawn(figure, f"How the cells fly, means over seeds: {'; '.join(said)}.")


@matplotlib.rc_context(STYLE)
def improvement_matrix(table: pd.DataFrame, what: str) -> Drawn:
    """The probability that a seed of the row's cell beats one of the column's, starred where Holm's p is below 0.05.

    table: of `stats.improvement`, the larger the better; what: the metric in words.
    """
    names = list(dict.fromkeys([*table["a"], *table["b"]]))
    title = f"Probability that a seed of the row beats\none of the column in {what}"
    if not names or table["probability"].isna().all():
        return _nothing(title.replace("\n", " "))
    place = {name: index for index, name in enumerate(names)}
    counts = {**dict(zip(table["b"], table["n_b"], strict=True)), **dict(zip(table["a"], table["n_a"], strict=True))}
    matrix = np.full((len(names), len(names)), np.nan)
    starred = np.zeros(matrix.shape, dtype=bool)
    for pair in table.to_dict("records"):
        row, column, beats = place[pair["a"]], place[pair["b"]], float(pair["probability"])
        matrix[row, column], matrix[column, row] = beats, 1 - beats
        starred[row, column] = starred[column, row] = pair["p_holm"] < 0.05
    side = 0.62 * len(names)
    figure = Figure(figsize=(WIDTH, min(side + 2.4, 8.0)), layout="constrained")
    axes = figure.subplots()
    axes.set_title(title)
    image = axes.imshow(matrix, cmap="PuOr", vmin=0, vmax=1, aspect="auto")
    for (row, column), value in np.ndenumerate(matrix):
        if np.isfinite(value):
            dark = image.to_rgba(value)[:3] @ np.array([0.3, 0.6, 0.1]) < 0.5
            text = f"{value:.2f}{'*' if starred[row, column] else ''}"
            weight = "bold" if starred[row, column] else "normal"
            axes.text(column, row, text, ha="center", va="center", color="white" if dark else INK, weight=weight)
    axes.set_xticks(range(len(names)), [_name(name) for name in names], rotation=40, ha="right", rotation_mode="anchor")
    axes.set_yticks(range(len(names)), [f"{_name(name)}, n = {counts[name]}" for name in names])
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    figure.colorbar(image, ax=axes, label="probability (* Holm's p < 0.05)", fraction=0.05)
    found = int((table["p_holm"] < 0.05).sum())
    known = [(row[np.isfinite(row)], name) for row, name in zip(matrix, names, strict=True)]
    means = sorted(((float(row.mean()), name) for row, name in known if len(row)), reverse=True)
    ranked = ", ".join(f"{_name(name)} {mean:.2f}" for mean, name in means)
    pairs = f"{found} of {len(table)} pairs differ with Holm's p below 0.05"
    return Drawn(figure, f"{title} (mean over the columns): {ranked}; {pairs}.".replace("\n", " "))


@matplotlib.rc_context(STYLE)
def survival(curves: Mapping[str, pd.Series[float]], cap: int | None = None, log: bool = True) -> Drawn:
    """Kaplan and Meier's share of test flights that are still up, against steps: a line a cell.

    curves: label -> shares, indexed by steps, as of `stats.survival`; cap: where flights were cut off [steps].
    """
    title = "Test flights that are still up"
    curves = {name: shares for name, shares in curves.items() if len(shares)}
    if not curves:
        return _nothing(title)
    figure, axes = _one(title)
    most, said = max(float(shares.index.max()) for shares in curves.values()), []
    for (name, shares), (colour, style) in zip(curves.items(), _looks(_parts(name)[1] for name in curves), strict=True):
        seen = (shares * 500).round().diff().ne(0)  # finer steps are less than a pixel high
        seen.iloc[[0, -1]] = True
        axes.step(seen.index[seen], shares[seen], style, where="post", color=colour, linewidth=1.8, label=_name(name))
        over = shares.index[shares <= 0.5]
        half = f"half of them after {over[0]:,.0f} steps" if len(over) else "half of them never"
        said.append(f"{_name(name)} {half}, {100 * shares.iloc[-1]:.0f} % up at {shares.index[-1]:,.0f}")
    if cap is not None:
        axes.axvline(cap, color=INK, linestyle="--", linewidth=1.2)
        words, corner = f"cap: {cap:,} steps ", axes.get_xaxis_transform()
        axes.annotate(words, (cap, 0.98), xycoords=corner, color=INK, fontsize=11, rotation=90, va="top", ha="right")
    if log:
        axes.set_xscale("log")
        first = [float(shares.index[(shares < 1) & (shares.index > 0)].min()) for shares in curves.values()]
        axes.set_xlim(max(np.nanmin([*first, most]) * 0.8, 1.0), max(most, cap or 0) * 1.1)
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set(xlabel="steps", ylabel="flights still up [%]", ylim=(0, 1.02))
    _legend(figure, axes.get_legend_handles_labels()[0])
    return Drawn(figure, f"{title}, against steps: {'; '.join(said)}.")


# In the arena


@matplotlib.rc_context(STYLE)
def trajectories(
    tables: Mapping[str, pd.DataFrame],
    bank: Tensor | Array,
    layouts: Sequence[int],
    world: World,
    mode: str = "greedy",
    seed: int | None = None,
) -> Drawn:
    """Flown paths of one seed a cell, as the paper's figures 6 and 7: a row a set of obstacles, a column a cell.

    tables: label -> rows with the columns seed, layout, step, x, y, clearance and mode; bank: [L, K, 3] px; layouts:
    indices into it; seed: the first that a table has by default.
    """
    one = {name: _of_one_seed(rows, mode, seed) for name, rows in tables.items()}
    if not layouts or not any(len(rows) for rows in one.values()):
        return _nothing(f"Paths flown, {mode}")
    across = min(len(one), 4)  # further cells come below
    blocks = -(-len(one) // across)
    width = (WIDTH - 0.5) / across
    height = blocks * (len(layouts) * (width * world.height / world.width + 0.27) + 0.45) + 0.5
    figure = Figure(figsize=(WIDTH, height), layout=ConstrainedLayoutEngine(w_pad=0.04, h_pad=0.04))
    panels = figure.subplots(blocks * len(layouts), across, squeeze=False)
    said = []
    for place, ((name, rows), (colour, _)) in enumerate(
        zip(one.items(), _looks(_parts(name)[1] for name in one), strict=True)
    ):
        first, ends = place // across * len(layouts), []
        for axes, layout in zip(panels[first:, place % across], layouts, strict=False):
            _arena(axes, np.asarray(bank[layout]), world)
            path = rows[rows["layout"] == layout].sort_values("step")
            x, y = ([start, *path[axis]] for start, axis in zip(world.start, "xy", strict=True))
            crashed = len(path) > 0 and path["clearance"].iloc[-1] <= world.drone_radius
            axes.plot(x, y, color=colour, linewidth=1.6, solid_joinstyle="round")
            axes.plot(*world.start, "^", color=INK, markersize=6)
            axes.add_patch(Circle((x[-1], y[-1]), world.drone_radius, facecolor=colour, alpha=0.35, linewidth=0))
            axes.plot(x[-1], y[-1], "X" if crashed else "o", color=colour, markeredgecolor=INK, markersize=7)
            axes.set_xlabel(f"{len(path)} steps" if len(path) else "not flown", fontsize=11, labelpad=2)
            ends.append(f"{len(path)} {'crash' if crashed else 'still up'}" if len(path) else "not flown")
        seeds = f", seed {rows['seed'].iloc[0]}" if len(rows) else ""
        panels[first, place % across].set_title(
            "\n".join([*textwrap.wrap(_name(name), 72 // across), seeds[2:]]), fontsize=11
        )
        said.append(f"{_name(name)}{seeds}: {', '.join(ends)}")
    for place in range(len(one), blocks * across):
        for axes in panels[place // across * len(layouts) :, place % across]:
            axes.set_axis_off()
    for row, axes in enumerate(panels[:, 0]):
        axes.set_ylabel(f"obstacle set {layouts[row % len(layouts)]}", fontsize=11)
    handles = [
        _mark("^", "start"),
        _mark("X", "crash", markerfacecolor=PALE, markersize=8),
        _mark("o", "still up", markerfacecolor=PALE, markersize=7),
        Patch(color=OBSTACLE, label="obstacle"),
    ]
    _legend(figure, handles, 4)
    sets = ", ".join(map(str, layouts))
    return Drawn(figure, f"Paths flown, {mode}, and their steps on obstacle sets {sets}: {'; '.join(said)}.")


def _of_one_seed(rows: pd.DataFrame, mode: str, seed: int | None) -> pd.DataFrame:
    rows = rows[rows["mode"] == mode]
    return rows[rows["seed"] == (rows["seed"].min() if seed is None else seed)]


def _arena(axes: Axes, obstacles: Array, world: World) -> None:
    """The border and a set of obstacles [K, 3], to scale."""
    width, height, border = world.width, world.height, world.border
    axes.add_collection(PatchCollection([Circle((x, y), r) for x, y, r in obstacles], color=OBSTACLE, linewidth=0))
    walls = [(0, 0, width, border), (0, height - border, width, border), (0, 0, border, height)]
    for x, y, across, up in [*walls, (width - border, 0, border, height)]:
        axes.add_patch(Rectangle((x, y), across, up, color="#545860", linewidth=0))
    axes.set(xlim=(0, width), ylim=(0, height), aspect="equal", xticks=[], yticks=[])
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)


@matplotlib.rc_context(STYLE)
def heat_maps(maps: Mapping[str, Array], world: World) -> Drawn:
    """Where the cells fly: a panel a cell, one scale of colours (its square root, so that rare places show).

    maps: label -> shares of steps [rows of y, columns of x], from the lower-left corner.
    """
    title = "Where the cells fly"
    if not maps or not any(np.nansum(share) > 0 for share in maps.values()):
        return _nothing(title)
    columns = min(len(maps), 2 if len(maps) in (2, 4) else 4)
    lines = -(-len(maps) // columns)
    height = lines * ((WIDTH - 0.8) / columns * world.height / world.width + 0.25) + 1.25
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True)
    norm, said = PowerNorm(0.5, 0, max(float(np.nanmax(share)) for share in maps.values())), []
    for axes, (name, share) in zip(panels.flat, maps.items(), strict=False):
        image = axes.imshow(share, origin="lower", extent=(0, world.width, 0, world.height), norm=norm, cmap="viridis")
        axes.plot(*world.start, "^", color="white", markeredgecolor=INK, markersize=7)
        axes.set_title(_name(name))
        axes.grid(visible=False)
        axes.set(xticks=[0, world.width // 2, world.width], yticks=[0, world.height // 2, world.height])
        ordered = np.sort(np.nan_to_num(share), axis=None)[::-1].cumsum()
        half = (int(np.searchsorted(ordered, ordered[-1] / 2 - 1e-9)) + 1) / share.size
        said.append(f"{_name(name)} {100 * half:.0f} %")
    for axes in panels.flat[len(maps) :]:
        axes.set_axis_off()
    for axes in panels[-1]:
        axes.set_xlabel("x [px]")
    for axes in panels[:, 0]:
        axes.set_ylabel("y [px]")
    rows, across = next(iter(maps.values())).shape
    label = f"share of steps in {world.width / across:.0f} x {world.height / rows:.0f} px (triangle: the start)"
    look: dict[str, Any] = {"location": "bottom", "fraction": 0.05, "aspect": 50, "ticks": MaxNLocator(5)}
    figure.colorbar(image, ax=panels, label=label, format=PercentFormatter(1.0), **look)
    return Drawn(figure, f"{title}: half of the steps fall into this share of the window: {', '.join(said)}.")


# How sure it is, and what it costs


@matplotlib.rc_context(STYLE)
def sensitivity(table: pd.DataFrame) -> Drawn:
    """Whether conclusions hold under other choices: a panel a conclusion, in it a row a switch; the default shaded.

    table: columns switch (one is `default`), conclusion, value, low, high (a difference in mean reward), n.
    """
    title = "Differences in mean reward under other choices"
    if not len(table) or table["value"].isna().all():
        return _nothing(title)
    names, conclusions = list(dict.fromkeys(table["switch"])), list(dict.fromkeys(table["conclusion"]))
    names.sort(key=lambda name: name != "default")
    figure = Figure(figsize=(WIDTH, 0.42 * len(names) + 2.0), layout="constrained")
    panels = figure.subplots(1, len(conclusions), sharey=True, squeeze=False)[0]
    said = []
    for axes, conclusion in zip(panels, conclusions, strict=True):
        rows = table[table["conclusion"] == conclusion].set_index("switch")
        usual = rows.loc["default"] if "default" in rows.index else None
        if usual is not None and np.isfinite(usual["low"]):
            axes.axvspan(usual["low"], usual["high"], color="#0072B2", alpha=0.15, linewidth=0)
        axes.axvline(0, color=INK, linewidth=1.2)
        for name, row in rows.iterrows():
            clear = row["low"] > 0 or row["high"] < 0
            look = {"color": "#0072B2" if clear else PALE, "linewidth": 2.2}
            axes.plot([row["low"], row["high"]], [names.index(str(name))] * 2, **look)
            axes.plot(row["value"], names.index(str(name)), "o", color=look["color"], markersize=7)
        axes.set_title(textwrap.fill(conclusion, 14))
        axes.set_xlabel("difference\nin mean reward")
        axes.xaxis.set_major_locator(MaxNLocator(3))
        if usual is not None:
            others = rows.drop(index="default")
            sign = np.sign(usual["value"])
            same = int((np.sign(others["value"]) == sign).sum())
            found = Interval(usual["value"], usual["low"], usual["high"], int(usual["n"]))
            count = f"of the same sign under {same} of {len(others)} other choices"
            said.append(f"{conclusion} {_said(found)} by default, {count}")
    least = table.groupby("switch")["n"].min()
    _name_rows(panels[0], [f"{name}, n = {least[name]:.0f}" for name in names])
    handles = [
        Line2D([], [], marker="o", color="#0072B2", linewidth=2, label="95 % interval without 0"),
        Line2D([], [], marker="o", color=PALE, linewidth=2, label="with 0"),
        Patch(color="#0072B2", alpha=0.15, label="the default's"),
    ]
    _legend(figure, handles, 3)
    return Drawn(figure, f"{title}: {'; '.join(said) or f'{len(names)} choices, none of them the default'}.")


@matplotlib.rc_context(STYLE)
def power(table: pd.DataFrame, n: int | None = None, most: int = 10_000) -> Drawn:
    """Seeds a cell that would tell the means of two cells apart in 80 % of studies: a row a pair, the easiest first.

    table: columns pair and seeds (infinite: no difference was seen; NaN: not known); n: seeds that there are; most:
    beyond it a number is drawn as an arrow.
    """
    title = "Seeds a cell to tell two cells apart\n(80 % power, t test at 5 %)"
    if not len(table):
        return _nothing(title.replace("\n", " "))
    table = table.sort_values("seeds", kind="stable", na_position="last", ignore_index=True)
    seeds = table["seeds"].to_numpy(dtype=np.float64)
    finite, endless, unknown = np.isfinite(seeds), np.isposinf(seeds), np.isnan(seeds)
    figure = Figure(figsize=(WIDTH, 0.27 * len(table) + 1.7), layout="constrained")
    axes = figure.subplots()
    axes.set_title(title)
    drawn, rows = np.minimum(seeds, most), np.arange(len(table))
    behind = {"facecolor": "white", "linewidth": 0, "pad": 1}
    within = finite & (seeds <= (n or np.inf))
    for some, colour in ((within, "#0072B2"), (finite & ~within, "#D55E00")):
        axes.hlines(rows[some], 1, drawn[some], color=colour, linewidth=1.2, alpha=0.5)
        for marker, beyond in (("o", seeds <= most), (">", seeds > most)):
            axes.plot(drawn[some & beyond], rows[some & beyond], marker, color=colour, markersize=6)
        for row in rows[some]:
            words = f"{seeds[row]:,.0f}" if seeds[row] <= most else f"> {most:,}"
            look: dict[str, Any] = {"va": "center", "fontsize": 11, "color": INK, "bbox": behind, "zorder": 4}
            axes.annotate(words, (drawn[row], row), (8, 0), textcoords="offset points", **look)
    for some, words in ((endless, "no difference seen: no number would do"), (unknown, "not known")):
        for row in rows[some]:
            axes.text(1.12, row, words, va="center", fontsize=11, color=PALE, style="italic", bbox=behind, zorder=4)
    axes.set(xscale="log", xlim=(1, 4 * max([*drawn[finite], n or 2, 10])), xlabel="seeds a cell")
    axes.xaxis.set_major_locator(LogLocator(10))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    _name_rows(axes, list(table["pair"]), fontsize=11)
    if n is not None:
        axes.axvline(n, color=INK, linestyle="--", linewidth=1.2, label=f"seeds that there are: {n}")
        _legend(figure, axes.get_legend_handles_labels()[0])
    said = [f"no difference seen in {int(endless.sum())}"] * bool(endless.any())
    said += [f"not known of {int(unknown.sum())}"] * bool(unknown.any())
    if finite.any():
        told = [f"{one:,.0f}" if one <= most else f"more than {most:,}" for one in (*seeds, np.median(seeds[finite]))]
        first, last = (f"{table['pair'][row]} {told[row]}" for row in (0, int(finite.sum()) - 1))
        said = [f"from {first} to {last}, median {told[-1]}", *said]
    if n is not None:
        said.append(f"of {len(table)} pairs {int(within.sum())} need no more than the {n} that there are")
    return Drawn(figure, f"{title}: {'; '.join(said)}.".replace("\n", " "))


@matplotlib.rc_context(STYLE)
def speed(table: pd.DataFrame) -> Drawn:
    """Wall time of a million frames of one seed, a row a cell, and the distance to the paper's ten hours.

    table: columns cell, seconds and seeds (side by side in that run, which share its time alike), a row a run.
    """
    title = "Wall time of a million frames of one seed"
    known = table[np.isfinite(table["seconds"]) & (table["seconds"] > 0)] if len(table) else table
    if not len(known):
        return _nothing(title)
    beside = " to ".join(f"{n}" for n in dict.fromkeys([known["seeds"].min(), known["seeds"].max()]))
    title += f":\nits share of a run of {beside} side by side"
    groups = known.groupby("cell", sort=False)["seconds"]
    hours = groups.mean() / 3600
    figure = Figure(figsize=(WIDTH, 0.42 * len(hours) + 1.6), layout="constrained")
    axes = figure.subplots()
    axes.set_title(title)
    said = []
    for row, (name, value) in enumerate(hours.items()):
        ((colour, _),) = _looks([_parts(str(name))[1]])
        axes.plot([value, paper.HOURS], [row, row], color=colour, linewidth=6, alpha=0.3, solid_capstyle="butt")
        axes.plot(groups.get_group(name) / 3600, [row] * len(groups.get_group(name)), "o", color=colour, markersize=4)
        axes.plot(value, row, "o", color=colour, markersize=9)
        ratio = paper.HOURS / value
        times = f"{_plain(ratio)} × faster" if ratio >= 1 else f"{_plain(1 / ratio)} × slower"
        behind = {"facecolor": "white", "linewidth": 0, "pad": 1.5}
        axes.text(np.sqrt(value * paper.HOURS), row, f"{_time(value)}: {times}", ha="center", va="center", bbox=behind)
        said.append(f"{_name(str(name))} {_time(value)}")
    axes.axvline(paper.HOURS, color=INK, linestyle="--", linewidth=1.4, label=f"the paper: about {paper.HOURS:g} hours")
    axes.set(xscale="log", xlim=(min(hours.min(), paper.HOURS) / 1.6, max(hours.max(), paper.HOURS) * 1.6))
    ticks = {1 / 60: "1 min", 1 / 20: "3 min", 1 / 6: "10 min", 0.5: "30 min", 1.0: "1 h", 3.0: "3 h", 10.0: "10 h"}
    low, high = axes.get_xlim()
    shown = {place: words for place, words in ticks.items() if low <= place <= high}
    axes.set_xticks(list(shown), list(shown.values()))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("wall time (logarithmic)")
    _name_rows(axes, [_name(str(name)) for name in hours.index])
    _legend(figure, axes.get_legend_handles_labels()[0])
    alt = f"{title}: {', '.join(said)}; the paper took about {paper.HOURS:g} hours."
    return Drawn(figure, alt.replace("\n", " "))


# What they share


def _one(title: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(WIDTH, 5.0), layout="constrained")
    axes = figure.subplots()
    axes.set_title(title)
    return figure, axes


def _title(algorithms: Iterable[str], what: str) -> str:
    return f"{' and '.join(sorted({name.upper() for name in algorithms}))}: {what}".lstrip(": ")


def _nothing(title: str) -> Drawn:
    figure = Figure(figsize=(WIDTH, 1.6), layout="constrained")
    figure.text(0.5, 0.5, f"{title}: no data", ha="center", va="center", color=INK)
    return Drawn(figure, f"{title}: no data.")


def _legend(figure: Figure, handles: Sequence[Any], columns: int = 2) -> None:
    if any(len(str(handle.get_label())) > 38 for handle in handles):
        columns = 1
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, columnspacing=1.5)


def _mark(marker: str, label: str, **look: Any) -> Line2D:
    """One of a legend, without a line."""
    return Line2D([], [], linestyle="none", marker=marker, color=INK, label=label, **look)


def _row(axes: Axes, row: int, seeds: Array, colour: str, size: float = 4.5) -> Interval:
    """A cell's seeds [S], their mean and its interval, in one row of a chart."""
    found = stats.interval(np.where(np.isfinite(seeds), seeds, np.nan))
    spread = row + np.linspace(-0.14, 0.14, max(len(seeds), 1))[: len(seeds)] if len(seeds) > 1 else [row] * len(seeds)
    axes.plot(seeds, spread, "o", color=colour, markersize=size, alpha=0.5, markeredgewidth=0, linestyle="none")
    if np.isfinite(found.low):
        axes.plot([found.low, found.high], [row, row], color=colour, linewidth=2.4, solid_capstyle="butt", zorder=3)
    axes.plot(found.value, row, "o", color=colour, markeredgecolor="white", markersize=2 * size + 1, zorder=3)
    return found


def _name_rows(axes: Axes, names: Sequence[str], **look: Any) -> None:
    """Rows from the top."""
    axes.set_yticks(range(len(names)), [textwrap.fill(name, 34) for name in names], **look)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")


def _looks(activations: Iterable[str]) -> list[tuple[str, str]]:
    """A colour an activation, and for each further cell of it another line."""
    named, drawn = list(activations), Counter[str]()
    others = sorted({*named}.difference(COLOURS))
    colours = COLOURS | {name: OTHER_COLOURS[place % len(OTHER_COLOURS)] for place, name in enumerate(others)}
    result = []
    for name in named:
        result.append((colours[name], LINES[drawn[name] % len(LINES)]))
        drawn[name] += 1
    return result


def _parts(label: str) -> tuple[str, str]:
    """The algorithm, if a label names one, and the activation."""
    words = label.split(" (")[0].split()
    return (words[0] if len(words) > 1 else "", words[-1] if words else "")


def _name(label: str) -> str:
    algorithm = _parts(label)[0]
    return algorithm.upper() + label.removeprefix(algorithm)


def _seeds(cell: Cell) -> int:
    return sum(len(run.seeds) for run in cell.runs)


def _number(value: float) -> str:
    """Three digits or so."""
    size = abs(value)
    return f"{value:.3g}" if size < 1 else f"{value:,.{0 if size >= 1000 else 1 if size >= 10 else 2}f}"


def _plain(ratio: float) -> str:
    return f"{ratio:,.0f}" if ratio >= 10 else f"{ratio:.2g}"


def _time(hours: float) -> str:
    if hours * 60 < 1:
        return f"{3600 * hours:.0f} s"
    return f"{60 * hours:.3g} min" if hours < 1 else f"{hours:.3g} h"


def _said(found: Interval, beside: str = "") -> str:
    if not found.n or not np.isfinite(found.value):
        return "no data"
    inside = [f"95 % interval {_number(found.low)} to {_number(found.high)}"] * bool(np.isfinite(found.low))
    return f"{_number(found.value)} ({'; '.join([*inside, f'n = {found.n}', *([beside] if beside else [])])})"
