"""What figures share: their look, the colours of activations, marks, names, and how they are saved.

A configuration's label is `PPO tanh`, perhaps with settings in brackets. Letters: S seeds.
"""

from __future__ import annotations

import functools
import io
import re
import textwrap
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.typing import RcKeyType
from PIL import Image

from uavnav import colours, stats
from uavnav.colours import PILOTS
from uavnav.stats import Array, Interval

COLOURS = {"tanh": "#0072B2", "sigmoid": "#D55E00", "relu": "#009E73", "leaky_relu": "#CC79A7"}
OTHER_COLOURS = ("#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's, without the yellow."""
LINES = ("-", ":", "-.")
"""Lines of a colour that comes again; dashes are the paper's."""
INK, PALE, OBSTACLE = "#333333", "#767676", "#c8ccd2"
CLEAR, OPEN = "#0072B2", "#D55E00"
"""Colours of what the seeds decide and of what they leave open."""
SCRIPTED = PILOTS["reactive"]
"""The colour of the scripted policy."""
NIGHT = {
    "#000000": "#e8e9e6",
    "#333333": "#dcdedc",
    "#545860": "#a3abb5",
    "#767676": "#a3abb5",
    "#b0b0b0": "#7d858f",
    "#c8ccd2": "#4c5560",
    "#ffffff": "#1c2026",
    "#0072b2": "#4a9fe0",
    "#d55e00": "#ff9a5c",
    "#009e73": "#4fd0a4",
    "#cc79a7": "#e59cc6",
    "#e69f00": "#f2b83a",
    "#56b4e9": "#a9dcff",
    "#882255": "#d65c96",
    "#999933": "#cfcf63",
}
"""Colours of a figure by day, and what they are on a dark page."""
DASHED: dict[str, Any] = {"color": INK, "linestyle": "--", "linewidth": 1.2}
"""The look of a line that no configuration drew."""
SCRIPTED_LINE = DASHED | {"color": SCRIPTED}
"""The look of what the scripted policy reaches."""
SCRIPTED_NAME = "scripted policy"
"""The label of the scripted policy that everything learned is compared with."""
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
WIDTH, NARROW = 8.0, 5.0
"""Of a figure on a page and on a phone [inches]; letters are as large on both."""


_NAMES = re.compile(rf"(?<![\w/-])({'|'.join(colours.NAMES)})(?![\w/-])")


@dataclass(eq=False)
class Drawn:
    """A figure and one sentence with its main numbers."""

    figure: Figure
    alt: str

    def __post_init__(self) -> None:
        self.alt = spelled(self.alt)

    @functools.cached_property
    def svg(self) -> bytes:
        """The same bytes for the same figure."""
        return _saved(self.figure, "svg", dict.fromkeys(("Date", "Creator", "Format", "Type")))


def png(figure: Figure) -> bytes:
    """PNG, the same bytes on every call; one without a map has 256 colours."""
    drawn, few = _saved(figure, "png", {"Software": None}), io.BytesIO()
    if any(axes.images for axes in figure.axes):
        return drawn
    image = Image.open(io.BytesIO(drawn)).convert("RGB")
    image.quantize(dither=Image.Dither.NONE).save(few, "PNG", optimize=True)
    return few.getvalue()


def _saved(figure: Figure, kind: str, metadata: Mapping[str, None]) -> bytes:
    content = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        if isinstance(engine := figure.get_layout_engine(), ConstrainedLayoutEngine) and figure.axes:
            engine.execute(figure)
            figure.set_layout_engine(None)  # laid out once: a second time would move things by a hair
        figure.savefig(content, format=kind, metadata=metadata)
    return content.getvalue()


_PLACES, _NEEDLESS = re.compile(rb' (?:d|x|y)="[^"]*"'), re.compile(rb"(\.\d\d)\d+|(?<=[MLCQ]) ")
_COLOUR = re.compile(rb"#[0-9a-f]{6}(?=[;'\"])")


def _grouped(marks: re.Match[bytes]) -> bytes:
    """Marks of one style, which their group has once."""
    style = marks[2]
    if b"opacity" in style.replace(b"-opacity", b""):  # a group fades as one
        return marks[0]
    return b"<g " + style + b">" + marks[0].replace(b" " + style, b"") + b"</g>"


_SHORTER: dict[bytes, bytes | Callable[[re.Match[bytes]], bytes]] = {
    rb"\s*\n\s*": b"",
    rb' id="(?!C[0-9a-f]+_)[\w.]+_\d+"': b"",  # marks of a scatter are asked for by such a name
    rb' transform="rotate\(-0 [^"]*"': b"",
    rb"font-family: 'DejaVu[^;\"]*(?:; )?": b"",
    rb'<style type="text/css">\*\{': b"<style>*{font-family: 'DejaVu Sans', Verdana, Arial, sans-serif; ",
    rb"([:;]) (?=[^<>]*>)": rb"\1",
    rb'="([^"\']*)"': rb"='\1'",
    # a group without attributes is its parts
    rb"<g>((?:<(?!g\b|defs)[^<>]*/>|<text[^<>]*>[^<>]*</text>)*)</g>|<g/>": rb"\1",
    rb"(<use [^<>]*) (style='[^']*')/>(?:<use [^<>]* \2/>)+": _grouped,
}
"""What of matplotlib's SVG a page does without or writes shorter, in this order."""


def embedded(drawing: bytes) -> str:
    """A drawing in SVG as an address in a page, by day and by night as the page is.

    Places are to a hundredth of a point, and nothing is in it that is not drawn.
    """
    short = _PLACES.sub(lambda found: _NEEDLESS.sub(rb"\1", found[0]), drawing)
    for pattern, instead in _SHORTER.items():
        short = re.sub(pattern, instead, short)
    names = {day.encode(): f"var(--{place})".encode() for place, day in enumerate(NIGHT)}
    short = _COLOUR.sub(lambda found: names.get(found[0], found[0]), short[short.index(b"<svg") :])
    day, night = (
        "".join(f"--{place}:{one};" for place, one in enumerate(of_time))
        for of_time in (NIGHT, NIGHT.values())
    )
    looks = f"<style>svg{{{day}fill:var(--0)}}@media(prefers-color-scheme:dark){{svg{{{night}}}}}"
    return quote(short.replace(b"<style>", looks.encode(), 1), safe="/:;=,'()!*+$@?")


def panel(title: str, width: float = WIDTH) -> tuple[Figure, Axes]:
    """A figure of one panel; width [inches]."""
    figure = Figure(figsize=(width, 5.0), layout="constrained")
    axes = figure.subplots()
    if width >= WIDTH:
        axes.set_title(title)
    else:
        figure.suptitle(textwrap.fill(title, 48), x=0.02, ha="left", fontsize=12)
    return figure, axes


def nothing(title: str) -> Drawn:
    figure = Figure(figsize=(WIDTH, 1.6), layout="constrained")
    figure.text(0.5, 0.5, f"{title}: no data", ha="center", va="center", color=INK)
    return Drawn(figure, f"{title}: no data.")


def spelled(words: str) -> str:
    """Activations as prose writes them, where a name stands by itself."""
    return _NAMES.sub(lambda found: colours.NAMES[found[0]], words)


def legend(figure: Figure, handles: Sequence[Any], columns: int = 2) -> None:
    for handle in handles:
        handle.set_label(spelled(str(handle.get_label())))
    if any(len(str(handle.get_label())) > 38 for handle in handles):
        columns = 1
    if figure.get_figwidth() < WIDTH:
        longest = sorted(len(str(handle.get_label())) for handle in handles)[-2:]
        columns = 2 if sum(longest) <= 44 else 1
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, columnspacing=1.5)


def mark(marker: str, label: str, **look: Any) -> Line2D:
    """A handle of a legend, without a line."""
    return Line2D([], [], linestyle="none", marker=marker, color=INK, label=label, **look)


def scripted_mark() -> Line2D:
    """A handle of a legend for the line of the scripted policy."""
    return Line2D([], [], label=SCRIPTED_NAME, **SCRIPTED_LINE)


def legible(places: Array, limits: tuple[float, float]) -> tuple[float, float]:
    """Limits of an axis that show of wide intervals, as of two seeds, as much on each side as places take."""
    places = places[np.isfinite(places)]
    if not len(places) or not (room := np.ptp(places)) > 0:
        return limits
    return max(limits[0], places.min() - room), min(limits[1], places.max() + room)


def keep_lines_legible(axes: Axes) -> None:
    """Show of wide bands at most as much on each side as the lines need."""
    drawn = [np.empty(0), *(np.asarray(line.get_ydata(), dtype=np.float64) for line in axes.lines)]
    axes.set_ylim(legible(np.concatenate(drawn), axes.get_ylim()))


def row_of_seeds(axes: Axes, row: int, seeds: Array, colour: str, known: Interval | None = None) -> Interval:
    """A configuration's seeds [S], their mean and its interval, in a row of a chart; known: the mean."""
    found = known or stats.interval(np.where(np.isfinite(seeds), seeds, np.nan))
    spread = row + np.linspace(-0.14, 0.14, len(seeds)) if len(seeds) > 1 else [row] * len(seeds)
    axes.plot(
        seeds, spread, "o", color=colour, markersize=4.5, alpha=0.5, markeredgewidth=0, linestyle="none"
    )
    if np.isfinite(found.low):
        axes.plot(
            [found.low, found.high], [row, row], color=colour, linewidth=2.4, solid_capstyle="butt", zorder=3
        )
    axes.plot(found.value, row, "o", color=colour, markeredgecolor="white", markersize=10, zorder=3)
    return found


def wrapped(name: str) -> str:
    """A row's name in lines of at most 34 characters."""
    return "\n".join(textwrap.fill(line, 34) for line in name.splitlines())


def name_rows(axes: Axes, names: Sequence[str]) -> None:
    """Name a chart's rows, from the top."""
    axes.set_yticks(range(len(names)), [wrapped(spelled(name)) for name in names])
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")


def of_activations(labels: Iterable[str]) -> dict[str, tuple[str, str]]:
    """A colour and a line for each label of a configuration, by its activation."""
    named = {label: parts(label)[1] for label in labels}
    others = sorted({*named.values()}.difference(COLOURS))
    known = COLOURS | {name: OTHER_COLOURS[place % len(OTHER_COLOURS)] for place, name in enumerate(others)}
    return _with_lines({label: known[activation] for label, activation in named.items()})


def of_pilots(pilots: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """A colour and a line for each label, by who flies."""
    return _with_lines(dict(zip(pilots, colours.colours(pilots.values()), strict=True)))


def _with_lines(colour_of: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Colours by label, each with a line; a colour that comes again has another line."""
    found, drawn = {}, Counter[str]()
    for label, colour in colour_of.items():
        found[label] = colour, LINES[drawn[colour] % len(LINES)]
        drawn[colour] += 1
    return found


def of_pilot(label: str) -> str:
    """The colour of an algorithm, by a label that begins with it, or of the scripted policy."""
    return SCRIPTED if label == SCRIPTED_NAME else PILOTS.get(label.split()[0].lower(), colours.OTHERS[0])


def parts(label: str) -> tuple[str, str]:
    """The algorithm, if a label names one, and the activation."""
    words = label.split(" (")[0].split()
    return (words[0] if len(words) > 1 else "", words[-1] if words else "")


def number(value: float) -> str:
    """Three digits or so."""
    size = abs(value)
    return f"{value:.3g}" if size < 1 else f"{value:,.{0 if size >= 1000 else 1 if size >= 10 else 2}f}"


def said(found: Interval, beside: str = "") -> str:
    if not found.n or not np.isfinite(found.value):
        return "no data"
    inside = [f"95 % interval {number(found.low)} to {number(found.high)}"] * bool(np.isfinite(found.low))
    return f"{number(found.value)} ({'; '.join([*inside, f'n = {found.n}', *([beside] if beside else [])])})"
