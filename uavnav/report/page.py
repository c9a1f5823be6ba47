"""The report as a page and as Markdown, out of their templates."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from uavnav import evaluation
from uavnav.report import (
    activations,
    ambiguities,
    arena,
    evidence,
    frames,
    horizon,
    learned,
    longer,
    noise,
    studies,
    tables,
    whys,
    worlds,
)
from uavnav.report.claims import PRIMARY
from uavnav.report.configurations import BINS, MODE
from uavnav.report.content import Content
from uavnav.report.mine import Mine
from uavnav.report.templating import HERE, TEMPLATES, Source, files_of, plain, source
from uavnav.report.templating import page as fill
from uavnav.report.verdicts import SEEDS
from uavnav.runs import paper
from uavnav.runs.definitions import LOG_CURVE, SAMPLED
from uavnav.runs.metrics import LAST
from uavnav.style import SCRIPTED_NAME, png
from uavnav.tasks.world import World
from uavnav.training import machine
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
    "worlds": "Tasks",
    "longer": "Longer",
    "ambiguities": "Open choices",
    "noise": "Noise",
    "activations": "Activations",
    "horizon": "Horizon",
    "learned": "Learned or classical",
    "baselines": "Baselines",
    "speed": "Speed",
    "methods": "Methods",
    "rows": "Rows",
}
"""By their ids; a report has those of further studies where there are some."""
FURTHER = {one.STUDY: {one.STUDY} for one in (longer, noise, activations, horizon, learned)}
FURTHER |= {"ambiguities": {ambiguities.DRAWS}}
"""Sections of further studies, and the tables of which each needs one."""
TITLE = "DQN against PPO, four activation functions: what replicates of the paper"
"""Of a report on other runs than the study's."""
PREVIEWED = 240
"""Steps of the episodes that the picture of a link shows."""
DECISIONS = [
    re.sub(r"\[(.*?)\]\(.*?\)", r"\1", line).strip("| ").split(" | ")  # no links: docs may be elsewhere
    for line in (HERE / "decisions.md").read_text(encoding="utf-8").splitlines()
    if not line.startswith("|--")
]
"""What the paper leaves open, and what was decided: the table of docs/decisions.md, its header first."""
TEMPLATES.globals |= {
    "ambiguities": ambiguities,
    "evaluation": evaluation,
    "evidence": evidence,
    "frames": frames,
    "learned": learned,
    "studies": studies,
    "whys": whys,
    "worlds": worlds,
    "tables": tables,
    "primary": PRIMARY,
    "last": LAST,
    "sampled": SAMPLED,
    "log_curve": LOG_CURVE,
    "least_seeds": SEEDS,
    "decisions": DECISIONS,
    "TITLE": TITLE,
}


def contents(
    content: Content, first: Path, own: Mine | None = None, watched: bool = False
) -> dict[str, bytes]:
    """All files of a report, by their paths in its folder.

    first: the report's first folder; own: what stands before the study; watched: the page renews itself.
    """
    shown = [*(own.figures if own else []), *content.figures]
    with machine.forked(lambda: (markdown(content), [source(one.narrow) for one in shown])) as beside:
        found = files_of(shown)
        for stem, frame in content.tables.items():
            found[f"tables/{stem}.csv"] = frame.to_csv(
                index=False, float_format="%.6g", lineterminator="\n"
            ).encode()
        if episodes := first_episodes(content):
            drones = paths(episodes, PREVIEWED)
            firsts = {drone["name"]: drone["episodes"][0] for drone in episodes["drones"]}
            collided = {
                name
                for name, one in firsts.items()
                if one["steps"] <= PREVIEWED and one["ended"] == "collision"
            }
            title, obstacles = plain(content.said["headline"] or TITLE), np.array(episodes["layouts"][0])
            found["preview.png"] = png(arena.preview(title, drones, collided, obstacles, World()))
        text, phones = beside()
        pictures = {one.name: [source(one.drawn), phone] for one, phone in zip(shown, phones, strict=True)}
        found["report.html"] = page(content, pictures, first, own, watched).encode()
        found["report.md"] = text.encode()
    return found


def told(content: Content, **more: Any) -> dict[str, Any]:
    """What a template is filled with: the content, the study's prose, and more."""
    return more | {
        "content": content,
        "numbers": content.tables,
        "of_paper": studies.paper_configurations(content.studies.main),
        "said": content.said,
        "claims": evidence.rows(content),
    }


def render(template: str, content: Content, root: str = "", **more: Any) -> str:
    """A template of Markdown, filled with the content and more; root: the report's folder, with a slash."""
    text = TEMPLATES.get_template(template).render(told(content, **more))
    return re.sub(r"\]\((?=tables/|figures/|report\.)", f"]({root}", text)


def page(
    content: Content,
    pictures: Mapping[str, Sequence[Source]],
    first: Path,
    own: Mine | None = None,
    watched: bool = False,
) -> str:
    """The one HTML file: styles, figures, replays and the player's code are in it.

    pictures: by the figure's name, for a page and for a phone; others: as of `contents`.
    """
    tables_of_paper = [
        (f"Table {paper.TABLE_OF[one]}: {one.upper()}" if one in paper.TABLE_OF else one.upper(), rows)
        for one, rows in content.paper_tables.items()
    ]
    return fill(
        "page.html",
        also=render("results.md", content),
        **told(
            content,
            replays=content.replays,
            together=first_episodes(content),
            sections=[("runs", "My runs")] * bool(own) + sections(content),
            paper_tables=tables_of_paper,
            pictures=pictures,
            first=first,
            mine=own,
            watched=watched,
            left_out=content.left_out,
        ),
    )


def sections(content: Content) -> list[tuple[str, str]]:
    """The ids and titles of the page's sections, in order; of further studies only where there are some."""
    needed = {"algorithms": {"tuning", "carried"}, "worlds": {"places"}} | FURTHER
    return [one for one in SECTIONS.items() if one[0] not in needed or needed[one[0]] & content.tables.keys()]


def first_episodes(content: Content) -> dict[str, Any] | None:
    """What flies on the first screen, where at least one policy can, and the scripted policy."""
    gaps = content.tables["gaps"]
    sampled = gaps[(gaps["mode"] == MODE) & gaps["algorithm"].isin(paper.TABLE_OF)]
    sampled = sampled.sort_values("reward", ascending=False).drop_duplicates("algorithm")
    configurations = {who: tables.in_words(who) for who in sampled["who"]}
    shown = together(content.replays, configurations, SCRIPTED_NAME) if content.replays else None
    return shown if shown and len(shown["drones"]) > 1 else None


def markdown(content: Content) -> str:
    """report.md: the verdicts and the tables in every metric definition."""
    text = render("report.md", content, bins=BINS)
    return re.sub(r"\n{3,}", "\n\n", text).strip() + "\n"
