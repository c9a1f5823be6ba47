"""The report as a page and as Markdown, out of their templates."""

from __future__ import annotations

import importlib.metadata
import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import jinja2
import numpy as np
from markupsafe import Markup, escape

from uavnav import evaluation
from uavnav.report import (
    arena,
    evidence,
    frames,
    studies,
    tables,
    whys,
    worlds,
)
from uavnav.report.claims import PRIMARY
from uavnav.report.configurations import BINS, label
from uavnav.report.content import Content
from uavnav.report.quotes import prose
from uavnav.report.verdicts import GRADES, SEEDS
from uavnav.runs import paper
from uavnav.runs.definitions import LOG_CURVE, SAMPLED
from uavnav.runs.metrics import LAST, MODES
from uavnav.style import RULE, drawing, save
from uavnav.tasks.world import World
from uavnav.views import browser
from uavnav.views.replays import paths, together

SECTIONS = {
    "verdicts": "Verdicts",
    "tables": "Tables",
    "curves": "Curves",
    "episodes": "Episodes",
    "statistics": "Statistics",
    "behaviour": "Behaviour",
    "why": "Why",
    "sensitivity": "Sensitivity",
    "algorithms": "Algorithms",
    "worlds": "Worlds",
    "baselines": "Baselines",
    "speed": "Speed",
    "methods": "Methods",
}
"""By their ids; a report has those of further studies where there are some."""
TITLE = "DQN against PPO, four activation functions: what holds of the paper"
"""Of a report on other runs than the study's."""
PREVIEWED = 240
"""Steps of the episodes that the picture of a link shows."""
HERE = Path(__file__).parent
DECISIONS = [
    line.strip("| ").split(" | ")
    for line in (HERE / "templates" / "decisions.md").read_text(encoding="utf-8").splitlines()
    if not line.startswith("|--")
]
"""What the paper leaves open, and what was decided: the table of docs/decisions.md, its header first."""
PLAYER = (*browser.PLAYER, browser.HERE / "together.js")
"""Scripts of the player, in the order in which a browser reads them."""
_TEMPLATES = jinja2.Environment(
    loader=jinja2.PackageLoader("uavnav.report"),
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
    undefined=jinja2.StrictUndefined,
    autoescape=jinja2.select_autoescape(),
)
_INTERVAL = re.compile(r"([−\d][^\[]*|–) (\[[^\]]+, [^\]]+\])(.*)")
_LINK = re.compile(r"\[([^\[\]]+)\]\(([^()\s]+)\)")
_MARKDOWN = re.compile(r"`([^`]+)`|\[([^\]]+)\]\([^)]+\)")


def _table_cell(text: str) -> Markup:
    """A cell of a table: an interval below its number; of Markdown, code is code and a link its
    words.
    """
    if found := _INTERVAL.fullmatch(text):
        return Markup('{} <span class="interval">{}</span>{}').format(*found.groups())
    parts = []
    for place, part in enumerate(_MARKDOWN.split(text)):
        parts.append(
            Markup("<code>{}</code>").format(part) if place % 3 == 1 and part else escape(part or "")
        )
    return Markup("").join(parts)


def linked(text: str) -> Markup:
    """A line of Markdown with its links."""
    words, *links = _LINK.split(text)
    parts = [escape(words)]
    for shown, where, after in zip(links[::3], links[1::3], links[2::3], strict=True):
        parts.append(Markup('<a href="{}">{}</a>{}').format(where, shown, after))
    return Markup("").join(parts)


def plain(text: str) -> str:
    """A line of Markdown without its links."""
    return _LINK.sub(r"\1", text)


def listed(text: str) -> list[str]:
    """The lines of a list in Markdown."""
    return [line.removeprefix("- ") for line in text.splitlines()]


def _json(data: Any) -> Markup:
    """Data as a page's script holds it."""
    return Markup(json.dumps(data, separators=(",", ":")).replace("<", "\\u003c"))


_TEMPLATES.filters |= {
    "json": _json,
    "cell": _table_cell,
    "of_words": tables.of_words,
    "markdown": tables.markdown,
}
_TEMPLATES.filters |= {"linked": linked, "plain": plain, "listed": listed}
_TEMPLATES.globals |= {"evaluation": evaluation, "evidence": evidence, "frames": frames}
_TEMPLATES.globals |= {"studies": studies, "whys": whys, "worlds": worlds}
_TEMPLATES.globals |= {
    "tables": tables,
    "primary": PRIMARY,
    "last": LAST,
    "sampled": SAMPLED,
    "log_curve": LOG_CURVE,
    "least_seeds": SEEDS,
}
_TEMPLATES.globals |= {"decisions": DECISIONS, "kinds": GRADES, "TITLE": TITLE}


def contents(content: Content, first: Path) -> dict[str, bytes]:
    """All files of a report, by their paths in its folder. first: the report's first folder of runs."""
    found: dict[str, bytes] = {}
    pictures = {}
    for figure in content.figures:
        svg, png = save(figure.drawn.figure)
        found |= {f"figures/{figure.name}.svg": svg, f"figures/{figure.name}.png": png}
        pictures[figure.name] = [_embedded(svg)]
    for figure in content.narrow:
        pictures[figure.name].append(_embedded(drawing(figure.drawn.figure)))
    for stem, frame in content.tables.items():
        found[f"tables/{stem}.csv"] = frame.to_csv(
            index=False, float_format="%.6g", lineterminator="\n"
        ).encode()
    for algorithm, (header, *rows) in content.paper_tables.items():
        shown = [row for row in rows if row[1].startswith(("the paper", "missing", PRIMARY))]
        found[f"tables/paper-{algorithm}.tex"] = tables.latex([header, *shown]).encode()
    if episodes := first_episodes(content):
        drones = paths(episodes, PREVIEWED)
        firsts = {drone["name"]: drone["episodes"][0] for drone in episodes["drones"]}
        ends = {name: one["ended"] for name, one in firsts.items() if one["steps"] <= PREVIEWED}
        collided = {name for name, ended in ends.items() if ended == "collision"}
        title, obstacles = plain(said(content)["headline"] or TITLE), np.array(episodes["layouts"][0])
        drawn = arena.preview(title, drones, collided, obstacles, World())
        found["preview.png"] = save(drawn)[1]
    found["report.html"] = page(content, pictures, first).encode()
    found["report.md"] = markdown(content).encode()
    return found


def _grouped(marks: re.Match[bytes]) -> bytes:
    """Marks of one style, which their group has once."""
    style = marks[2]
    if b"opacity" in style.replace(b"-opacity", b""):  # a group fades as one
        return marks[0]
    return b"<g " + style + b">" + marks[0].replace(b" " + style, b"") + b"</g>"


_PLACES, _NEEDLESS = re.compile(rb' (?:d|x|y)="[^"]*"'), re.compile(rb"(\.\d\d)\d+|(?<=[MLCQ]) ")
_SHORTER: dict[bytes, bytes | Callable[[re.Match[bytes]], bytes]] = {
    rb"\s*\n\s*": b"",
    rb' id="(?!C[0-9a-f]+_)[\w.]+_\d+"': b"",  # marks of a scatter are asked for by such a name
    rb' transform="rotate\(-0 [^"]*"': b"",
    rb"font-family: 'DejaVu[^;\"]*(?:; )?": b"",
    rb'<style type="text/css">\*\{': b"<style>*{font-family: 'DejaVu Sans', Verdana, Arial, sans-serif; ",
    rb"([:;]) (?=[^<>]*>)": rb"\1",
    rb'="([^"\']*)"': rb"='\1'",
    # a group of nothing but its parts
    rb"<g>((?:<(?!g\b|defs)[^<>]*/>|<text[^<>]*>[^<>]*</text>)*)</g>|<g/>": rb"\1",
    rb"(<use [^<>]*) (style='[^']*')/>(?:<use [^<>]* \2/>)+": _grouped,
}
"""What of matplotlib's SVG a page does without or writes shorter, in this order."""


def _embedded(svg: bytes) -> Markup:
    """A drawing as an address in a page holds it: places to a hundredth of a point, and nothing that is
    not drawn.
    """
    short = _PLACES.sub(lambda found: _NEEDLESS.sub(rb"\1", found[0]), svg)
    for pattern, instead in _SHORTER.items():
        short = re.sub(pattern, instead, short)
    return Markup(quote(short[short.index(b"<svg") :], safe="/:;=,'()!*+$@?"))


def said(content: Content, root: str = "") -> dict[str, str]:
    """The study's prose by block (`quotes`), empty in the report of other runs."""
    found = prose(content.tables, root)
    return found if content.of_the_study else dict.fromkeys(found, "")


def render(template: str, content: Content, root: str = "", **more: Any) -> str:
    """A template filled with the content, the modules that make rows of it (its globals), and more; root:
    of links.
    """
    found = said(content, root)
    return _TEMPLATES.get_template(template).render(
        more,
        content=content,
        numbers=content.tables,
        of_paper=studies.paper_configurations(content.studies.main),
        said=found,
        claims=evidence.rows(content, found, root),
        root=root,
    )


def page(content: Content, pictures: Mapping[str, Sequence[str]], first: Path) -> str:
    """The one HTML file: styles, figures, replays and the player's code are in it.

    pictures: SVG by the figure's name, quoted, for a page and for a phone; first: the report's first folder,
    for what a command needs.
    """
    styles = [HERE / "templates" / "page.css", browser.HERE / "replay.css", browser.HERE / "first.css"]
    return render(
        "page.html",
        content,
        css=Markup(browser.joined(styles)),
        js=Markup(browser.joined(PLAYER)),
        folding=Markup(browser.joined([HERE / "templates" / "page.js"])),
        replays=content.replays,
        together=first_episodes(content),
        version=importlib.metadata.version("uavnav"),
        sections=sections(content),
        paper_tables=[(_table_name(algorithm), rows) for algorithm, rows in content.paper_tables.items()],
        pictures=pictures,
        first=first,
    )


def sections(content: Content) -> list[tuple[str, str]]:
    """The ids and titles of the page's sections, in order; of further studies only where there are some."""
    there = {"algorithms": bool({"tuning", "carried"} & {*content.tables}), "worlds": bool(content.worlds)}
    return [(id_, title) for id_, title in SECTIONS.items() if there.get(id_, True)]


def first_episodes(content: Content) -> dict[str, Any] | None:
    """What flies on the first screen, where at least one policy can beside the rule."""
    gaps = content.tables["gaps"]
    best = [frames.best(gaps, MODES[1], algorithm) for algorithm in paper.TABLE_OF]
    flown = gaps.loc[[place for place in best if place is not None]].sort_values("reward", ascending=False)
    configurations = {who: tables.in_words(who) for who in flown["who"]}
    shown = together(content.replays, configurations, RULE) if content.replays else None
    return shown if shown and len(shown["drones"]) > 1 else None


def _table_name(algorithm: str) -> str:
    number = paper.TABLE_OF.get(algorithm)
    return f"Table {number}: {algorithm.upper()}" if number else algorithm.upper()


def markdown(content: Content) -> str:
    """report.md: the verdicts, the tables in every metric definition, how the runs were made."""
    parts = []
    # each has a table of its own
    questions = (
        *content.studies.why.values(),
        *content.studies.switches.values(),
    )
    answered = {
        id(configuration) for configurations in questions for configuration in configurations.values()
    }
    for algorithm in content.paper_tables:
        mine = [
            configuration
            for configuration in content.configurations
            if configuration.algorithm == algorithm and id(configuration) not in answered
        ]
        part, usual = label(mine)
        parts.append({"name": algorithm, "usual": usual, "table": tables.table(part, algorithm)})
    return render("report.md", content, sections=parts, bins=BINS).strip() + "\n"
