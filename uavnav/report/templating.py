"""What the templates of all pages share: how Markdown becomes HTML, and the rows that numbers lead to."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import pandas as pd
from markdown_it import MarkdownIt
from markupsafe import Markup

from uavnav import style
from uavnav.report import tables
from uavnav.views import browser

HERE = Path(__file__).parent / "templates"
MOST = 100
"""Rows of a table that a page shows whole, where a number stands for all of it."""
_MARKDOWN = MarkdownIt("zero").enable(["link", "backticks", "emphasis"])
_ROW = re.compile(r'(?<=\]\(|=")[\w./]*tables/(\w+)\.csv(?:#L(\d+))?')
_QUOTED = re.compile(r"#row-(\w+?)-(\d*)(?=[\")])")
_INTERVAL = re.compile(r"([−\d][^\[]*|–) (\[[^\]]+, [^\]]+\])(.*)")


def inline(text: str) -> Markup:
    """A line of Markdown: links, code and emphasis. A line of a CSV is a row of this page."""
    return Markup(anchored(_MARKDOWN.renderInline(text)))


def anchored(text: str) -> str:
    """A text, of which links to a row of a table lead to where it is on the page."""
    return _ROW.sub(lambda found: f"#row-{found[1]}-{found[2] or ''}", text)


def plain(text: str) -> str:
    """A line of Markdown without its marks."""
    (line,) = _MARKDOWN.parseInline(text)
    return "".join(one.content for one in line.children or ())


def listed(text: str) -> list[str]:
    """The lines of a list in Markdown."""
    return [line.removeprefix("- ") for line in text.splitlines()]


def cell(text: str) -> Markup:
    """A cell of a table: an interval below its number, or a line of Markdown."""
    if found := _INTERVAL.fullmatch(text):
        return Markup('{} <span class="interval">{}</span>{}').format(*found.groups())
    return inline(text)


def played(recorded: Mapping[str, Any]) -> Markup:
    """What `views.replays.record` gives as the player's script reads it: without what only Python reads."""
    seen = {key: part for key, part in recorded.items() if key not in ("scripted", "left_out")}
    return browser.as_json(seen)


def quoted(page: str, numbers: Mapping[str, pd.DataFrame]) -> list[dict[str, Any]]:
    """The rows to which a page's links lead; a link to a table as a whole wants all rows of a small one.

    A table each: its name, the columns that are shown, `rows` by their lines in the CSV, and how many it
    has in all (`of`).
    """
    wanted: dict[str, set[int]] = {}
    for name, line in _QUOTED.findall(page):
        whole = range(2, 2 + len(numbers[name])) if len(numbers[name]) <= MOST else ()
        wanted.setdefault(name, set()).update([int(line)] if line else whole)
    found = []
    for name in sorted(wanted):
        lines = sorted(wanted[name])
        rows = numbers[name].iloc[[line - 2 for line in lines]]
        shown = {
            str(column): [_shown(one, str(column)) for one in rows.to_dict("records")]
            for column in rows
            if not re.search(r"(^|_)(low|high)$", str(column)) and rows[column].notna().any()
        }
        cells = zip(*shown.values(), strict=True)
        by_line = [*zip(lines, map(list, cells), strict=True)]
        found.append({"name": name, "columns": [*shown], "rows": by_line, "of": len(numbers[name])})
    return found


def _shown(row: Mapping[Any, Any], column: str) -> str:
    """A cell of a quoted row, with its interval where it has one."""
    value, *ends = (row.get(name, math.nan) for name in tables.interval_of(column))
    if pd.isna(value):
        return tables.NOTHING
    if isinstance(value, float):
        inside = "" if any(pd.isna(one) for one in ends) else " [{:.4g}, {:.4g}]".format(*ends)
        shown = f"{value:,.0f}" if value.is_integer() else f"{value:.4g}"
        return f"{shown}{inside}".replace("-", "−")
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)


Source = tuple[str, int, int]
"""Of a picture in a page: its address, and its width and height [px]."""


def source(drawn: style.Drawn) -> Source:
    """A figure as a page contains it."""
    width, height = (round(96 * side) for side in drawn.figure.get_size_inches())
    return Markup(style.embedded(drawn.svg)), width, height


class Figure(NamedTuple):
    """A figure, where it belongs, and what the reader should see in it."""

    name: str  # of its files
    section: str
    drawn: style.Drawn
    caption: str
    narrow: style.Drawn  # the same, for a phone
    question: str = ""  # that it answers


def sized(
    name: str,
    section: str,
    caption: str,
    draw: Callable[..., style.Drawn],
    *args: Any,
    question: str = "",
    **more: Any,
) -> Figure:
    """A figure for a page and for a phone; draw: takes args, more and a `width`."""
    page, phone = (draw(*args, width=width, **more) for width in (style.WIDTH, style.NARROW))
    return Figure(name, section, page, caption, phone, question)


def pictures(figures: Iterable[Figure]) -> dict[str, list[Source]]:
    """Figures by their names, for a page and for a phone."""
    return {one.name: [source(drawn) for drawn in (one.drawn, one.narrow)] for one in figures}


def files_of(figures: Iterable[Figure]) -> dict[str, bytes]:
    """Figures as files."""
    found: dict[str, bytes] = {}
    for one in figures:
        found[f"figures/{one.name}.svg"] = one.drawn.svg
        found[f"figures/{one.name}.png"] = style.png(one.drawn.figure)
    return found


TEMPLATES = jinja2.Environment(
    loader=jinja2.PackageLoader("uavnav.report"),
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
    undefined=jinja2.StrictUndefined,
    autoescape=jinja2.select_autoescape(),
)
TEMPLATES.filters |= {
    "cell": cell,
    "inline": inline,
    "plain": plain,
    "listed": listed,
    "played": played,
    "of_words": tables.of_words,
    "markdown": tables.markdown,
    "json": browser.as_json,
}
STYLES = (HERE / "page.css", *browser.STYLES, browser.HERE / "first.css")
PLAYER = (*browser.PLAYER, browser.HERE / "together.js")
"""Scripts of the player, in the order in which a browser reads them."""
TEMPLATES.globals |= {
    "css": Markup(browser.joined(STYLES)),
    "js": Markup(browser.joined(PLAYER)),
    "folding": Markup(browser.joined([HERE / "page.js"])),
    "renewing": Markup(browser.joined([HERE / "renew.js"])),
}


def page(template: str, numbers: Mapping[str, pd.DataFrame], also: str = "", **told: Any) -> str:
    """A page, and in it the rows that its numbers lead to; also: Markdown that leads to some too."""
    text = TEMPLATES.get_template(template).render(told, numbers=numbers)
    rows = TEMPLATES.get_template("rows.html").render(quoted=quoted(text + anchored(also), numbers))
    return text.replace("<!-- rows -->", rows)
