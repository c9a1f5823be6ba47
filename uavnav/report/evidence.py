"""The one table of evidence: a row a claim, with its grades, its parts and what our seeds say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import pandas as pd

from uavnav.report import tables
from uavnav.report.claims import CLAIMS, COLUMNS, EVERY, LOG
from uavnav.report.content import Content
from uavnav.report.frames import least_to_most
from uavnav.report.verdicts import COUNTS, OPEN


class Row(NamedTuple):
    number: int
    sentence: str  # of the paper
    note: str
    column: str  # that its sentence is about
    grade: str  # in that column
    grades: dict[str, str]  # by column, with the seeds; a dash where it cannot answer
    said: str  # what our seeds say, in Markdown
    parts: dict[str, tables.Rows]  # by column that answers


def rows(content: Content) -> list[Row]:
    """A row a claim; 12 to 16 where a folder has that study."""
    grades, verdicts, found = content.tables["grades"], content.tables["verdicts"], []
    for claim in EVERY if "places" in content.tables else CLAIMS:
        graded, parts, own = dict.fromkeys(COLUMNS, tables.NOTHING), {}, OPEN
        judged = verdicts[verdicts["claim"] == claim.number]
        for place, one in grades[grades["claim"] == claim.number].to_dict("index").items():
            column, seeds = one["column"], least_to_most([one["least"], one["most"]])
            counts = f" {one['replicating']}/{one['counting']}" * (one["counting"] > 0)
            grade = tables.linked(one["grade"], "grades", place)
            graded[column] = f"{grade}{counts}, n\u00a0=\u00a0{seeds}"
            parts[column] = tables.listed(judged[judged["column"] == column], "verdicts")
            own = one["grade"] if column == claim.column else own
        said = content.said[f"claim_{claim.number}"] or _generic(judged[judged["column"] == claim.column])
        found.append(Row(claim.number, claim.sentence, claim.note, claim.column, own, graded, said, parts))
    return found


def _generic(judged: pd.DataFrame) -> str:
    """The first part of a claim that counts, of a folder that no sentence was written for."""
    for place, one in judged[judged["standing"] == COUNTS].to_dict("index").items():
        effect = tables.with_interval(one["value"], one["low"], one["high"], tables.digits(one))
        return f"{one['text']}: {tables.linked(effect, 'verdicts', place)}"
    return "No part that counts has runs."


def table(found: Sequence[Row]) -> tables.Rows:
    """A claim's sentence in the paper and its grade in each column."""
    rows = ([str(one.number), one.sentence, *one.grades.values()] for one in found)
    return [["", "the paper says", *COLUMNS], *rows]


def against_itself(numbers: Mapping[str, pd.DataFrame]) -> tables.Rows:
    """The parts of claims that the paper's own tables, as printed, do not show: they should be above zero."""
    shown = [["claim", "what it says", "the paper's own tables"]]
    verdicts = numbers["verdicts"]
    for place, one in verdicts[(verdicts["column"] == LOG) & (verdicts["paper"] <= 0)].iterrows():
        number = tables.linked(tables.number(one["paper"]), "verdicts", place)
        shown.append([str(one["claim"]), one["text"], number])
    return shown
