"""The one table of evidence: a row a claim of the paper, 1 to 16, with its grade, its parts and what our
seeds say.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import pandas as pd

from uavnav.report import tables
from uavnav.report.claims import CLAIMS, EVERY, Claim
from uavnav.report.content import Content
from uavnav.report.quotes import Quotes
from uavnav.report.verdicts import NO_RUNS, Finding, Grade, grade, of_claim
from uavnav.runs.definitions import ALL


class Row(NamedTuple):
    """What becomes of a claim."""

    number: int
    sentence: str  # of the paper
    note: str
    grade: Grade
    said: str  # what our seeds say, in Markdown
    parts: tables.Rows
    definitions: dict[str, str]  # its grade in each metric definition beside the one that decides
    waits: bool  # some of its parts have no runs, of a claim that has some

    @property
    def bar(self) -> str:
        """How many of its parts replicate, drawn."""
        replicating, counting = self.grade[1:]
        return "▰" * replicating + "▱" * (counting - replicating) or tables.NOTHING


def rows(content: Content, prose: Mapping[str, str], root: str = "") -> list[Row]:
    """A row a claim; those on other worlds where a folder has that study. prose: of `quotes`; root: of
    its links.
    """
    quotes = Quotes(content.tables, root)
    return [_row(claim, content, prose, quotes) for claim in (EVERY if content.worlds else CLAIMS)]


def _row(claim: Claim, content: Content, prose: Mapping[str, str], quotes: Quotes) -> Row:
    asked = {definition: of_claim(found, claim.number) for definition, found in content.audits.items()}
    of = {definition: parts for definition, parts in asked.items() if parts}
    mine = of[claim.decides]
    shown = mine[claim.shown]
    verdicts = content.tables["verdicts"]
    lines = verdicts.index[(verdicts["definition"] == claim.decides) & (verdicts["claim"] == claim.number)]
    effect = quotes.link(tables.effect(shown), "verdicts", int(lines[claim.shown]))
    generic = f"{shown.text}: {effect}" if shown.n else "Some of its runs are missing."
    return Row(
        claim.number,
        claim.sentence,
        claim.note,
        grade(mine),
        prose[f"claim_{claim.number}"] or generic,
        tables.audit_rows(mine),
        {definition: _graded(found) for definition, found in of.items() if definition != claim.decides},
        any(one.standing == NO_RUNS for one in mine) and any(one.n for one in mine),
    )


def _graded(findings: Sequence[Finding]) -> str:
    """A claim's grade; a dash where a metric definition has no runs for any part of it."""
    return str(grade(findings)) if any(one.n for one in findings) else tables.NOTHING


def table(found: Sequence[Row]) -> tables.Rows:
    """A claim's sentence in the paper, its grade with a bar of its parts, and ours."""
    shown = [["", "the paper says", "grade", "our seeds say"]]
    for one in found:
        graded = f"{one.bar} {one.grade}{', so far: some parts have no runs' * one.waits}"
        shown.append([str(one.number), one.sentence, graded, one.said])
    return shown


def overview(found: Sequence[Row]) -> tables.Rows:
    """A claim's grade in the metric definition that decides and in the others; a dash where another says
    nothing of it.
    """
    others = list(found[0].definitions)
    shown = [["", "the paper says", "grade", "parts that replicate", *others]]
    for one in found:
        rest = [one.definitions.get(definition, tables.NOTHING) for definition in others]
        shown.append([str(one.number), one.sentence, str(one.grade), one.bar, *rest])
    return shown


def against_itself(numbers: Mapping[str, pd.DataFrame], root: str = "") -> tables.Rows:
    """The parts of claims that the paper's own tables, as printed, do not show: they should be above zero."""
    shown, quotes = [["claim", "what it says", "the paper's own tables"]], Quotes(numbers, root)
    verdicts = numbers["verdicts"]
    for place, one in verdicts[(verdicts["definition"] == ALL) & (verdicts["paper"] <= 0)].iterrows():
        number = quotes.link(tables.number(one["paper"]), "verdicts", int(str(place)))
        shown.append([str(one["claim"]), one["text"], number])
    return shown
