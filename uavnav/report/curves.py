"""Figures of lines: learning curves, diagnostics of networks over training, how many episodes last longer.

Every function takes plain data and returns a figure with its words. Letters: S seeds of a configuration, B
bins of frames.
"""

from __future__ import annotations

import functools
import textwrap
from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, PercentFormatter, StrMethodFormatter

from uavnav import stats, style
from uavnav.report.configurations import Configuration, curve
from uavnav.runs.definitions import PER_FRAME, words
from uavnav.stats import Array, Interval

RESAMPLES = 1_000
"""Bootstrap draws of the band of a curve."""


@matplotlib.rc_context(style.STYLE)
def curves(
    configurations: Mapping[str, Configuration],
    printed: Mapping[str, float],
    title: str = "",
    width: float = style.WIDTH,
    looks: Mapping[str, tuple[str, str]] | None = None,
    rule: float = np.nan,
) -> style.Drawn:
    """Learning curves as the paper's figures 4 and 5: a line and a band each, the paper's mean dashed.

    configurations: by label; printed: the paper's mean by label; width: [inches]; looks: a colour and a line
    by label, or else by activation; rule: what the scripted policy earns per frame.
    """
    metric = words("reward", PER_FRAME)
    title = f"{title}{metric} in training"
    if not any(len(one.episodes) for one in configurations.values()):
        return style.nothing(title)
    figure, axes = style.panel(title, width=width)
    colours, ends = {}, []
    for name, (colour, dashes) in (looks or dict(style.coloured(configurations))).items():
        line, n = band(curve(configurations[name])), configurations[name].n_seeds
        _line(axes, line, colour, dashes, f"{name}, n = {n}")
        if name in printed:
            axes.axhline(printed[name], color=colour, linestyle="--", linewidth=1)
        beside = f"the paper's mean {style.number(printed[name])}" if name in printed else ""
        colours[name] = colour
        end = Interval(*line.iloc[-1]) if len(line) else Interval(np.nan, np.nan, np.nan, 0)
        ends.append(f"{name} {style.said(end._replace(n=int(end.n)), beside)}")
    if np.isfinite(rule):
        axes.axhline(rule, label=style.RULE, **style.RULED)
    axes.set_ylabel(metric)
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:,g}"))
    _name_dashes(axes, printed, colours)
    axes.set_xlabel("frames per seed")
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.xaxis.set_major_locator(MaxNLocator(6 if width >= style.WIDTH else 3))
    several = any(one.n_seeds > 1 for one in configurations.values())
    shade = Line2D([], [], color=style.PALE, linewidth=8, alpha=0.4, label="95 % interval over seeds")
    handles = [shade] * several
    handles += [Line2D([], [], color=style.PALE, linestyle="--", label="the paper's mean")] * bool(printed)
    style.legend(figure, [*axes.get_legend_handles_labels()[0], *handles], 3)
    return style.Drawn(figure, f"{title} against frames per seed; in the last bin: {'; '.join(ends)}.")


def _name_dashes(axes: Axes, printed: Mapping[str, float], colours: Mapping[str, str]) -> None:
    """The paper's means at the right end of their lines, in their colours, none over another."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high)
    means = sorted((mean, name) for name, mean in printed.items())
    for (mean, name), place in zip(
        means, _apart([(mean - low) / (high - low) for mean, _ in means], 0.055), strict=True
    ):
        axes.annotate(
            f"{name} {style.number(mean)}",
            (1, mean),
            (1.06, place),
            xycoords=axes.get_yaxis_transform(),
            textcoords="axes fraction",
            color=colours[name],
            fontsize=11,
            va="center",
            annotation_clip=False,
            arrowprops={
                "arrowstyle": "-",
                "color": colours[name],
                "linewidth": 0.8,
                "shrinkA": 1,
                "shrinkB": 0,
            },
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


def band(seeds: pd.DataFrame) -> pd.DataFrame:
    """Mean, low, high and n a bin [B] of values [B, S], by percentile bootstrap; NaN without two seeds."""
    values = seeds.to_numpy(dtype=np.float64)
    there = np.isfinite(values)
    filled, n = np.where(there, values, 0.0), values.shape[1]
    tail = (1 - stats.CONFIDENCE) / 2
    found = np.full((len(values), 3), np.nan)
    sums, counts = (
        _draws(n) @ np.stack([filled, there]).transpose(0, 2, 1) if n else np.empty((2, 0, len(values)))
    )
    for row, (own, known) in enumerate(zip(filled, there, strict=True)):
        if known.any():
            found[row, 0] = own[known].mean()
        if known.sum() > 1:
            drawn = counts[:, row] > 0
            means = sums[drawn, row] / counts[drawn, row]
            found[row, 1:] = np.quantile(means, [tail, 1 - tail])
    return pd.DataFrame(found, seeds.index, ["mean", "low", "high"]).assign(n=there.sum(1))


@functools.lru_cache(maxsize=2)
def _draws(n: int) -> Array:
    """How often each of n seeds is drawn: [RESAMPLES, n]."""
    drawn = np.random.default_rng(0).multinomial(n, np.full(n, 1 / n), size=RESAMPLES)
    return drawn.astype(np.float64)


def _line(axes: Axes, line: pd.DataFrame, colour: str, dashes: str, legend: str, width: float = 1.8) -> None:
    words = textwrap.fill(legend, 50)
    axes.plot(line.index, line["mean"], dashes, marker=".", color=colour, linewidth=width, label=words)
    known = line["low"].notna()
    if known.any():
        axes.fill_between(
            line.index.to_numpy(), line["low"], line["high"], color=colour, alpha=0.2, linewidth=0
        )
    alone = line[known & ~known.shift(fill_value=False) & ~known.shift(-1, fill_value=False)]
    if len(alone):  # a band has no width there
        axes.vlines(alone.index.to_numpy(), alone["low"], alone["high"], color=colour, alpha=0.2, linewidth=6)


@matplotlib.rc_context(style.STYLE)
def survival(
    curves: Mapping[str, pd.Series[float]],
    limit: int,
    width: float = style.WIDTH,
    looks: Mapping[str, tuple[str, str]] | None = None,
) -> style.Drawn:
    """Kaplan and Meier's share of test episodes that last longer, against steps: a line a configuration.

    curves: label -> shares by steps, as of `stats.survival`; limit: where episodes end [steps]; width:
    [inches]; looks: a colour and a line by label, or else by activation.
    """
    title = "Test episodes that last longer"
    curves = {name: shares for name, shares in curves.items() if len(shares)}
    if not curves:
        return style.nothing(title)
    figure, axes = style.panel(title, width=width)
    most, said = max(float(shares.index.max()) for shares in curves.values()), []
    for name, (colour, dashes) in (looks or dict(style.coloured(curves))).items():
        shares = curves[name]
        seen = (shares * 500).round().diff().ne(0)  # finer steps are less than a pixel high
        seen.iloc[[0, -1]] = True
        look = {"color": colour, "linestyle": dashes, "linewidth": 1.8} if name != style.RULE else style.RULED
        axes.step(seen.index[seen], shares[seen], where="post", label=name, **look)
        over = shares.index[shares <= 0.5]
        half = f"half of them after {over[0]:,.0f} steps" if len(over) else "half of them never"
        said.append(f"{name} {half}, {100 * shares.iloc[-1]:.0f} % up at {shares.index[-1]:,.0f}")
    axes.axvline(limit, **style.DASHED)
    words, corner = f"time limit{f': {limit:,} steps' * (width >= style.WIDTH)} ", axes.get_xaxis_transform()
    axes.annotate(
        words, (limit, 0.98), xycoords=corner, color=style.INK, fontsize=11, rotation=90, va="top", ha="right"
    )
    axes.set_xscale("log")
    first = [float(shares.index[(shares < 1) & (shares.index > 0)].min()) for shares in curves.values()]
    axes.set_xlim(max(np.nanmin([*first, most]) * 0.8, 1.0), max(most, limit) * 1.1)
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set(xlabel="steps", ylabel="episodes that last longer [%]", ylim=(0, 1.02))
    style.legend(figure, axes.get_legend_handles_labels()[0])
    return style.Drawn(figure, f"{title}, against steps: {'; '.join(said)}.")
