"""The numbers that hand-written prose quotes, and what each sentence takes for granted of them.

`templates/study.md` is the prose on the committed results: a block is a sentence or a few. Each number
has the sign that its interval must have, and each comparison has a check. A block that is not true
over a folder's tables is left out of that folder's report, so prose is never false. Over `results/` the tests
ask that every block is: whoever changes a result rewrites the sentence.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jinja2
import pandas as pd

from uavnav.report.claims import COLUMNS, EVERY
from uavnav.report.tables import NOTHING, in_brackets, interval_of, linked
from uavnav.report.verdicts import BESIDE, COUNTS


class Untrue(ValueError):
    """A sentence is not true of these tables."""


class Quotes:
    """What the prose asks of a report's tables."""

    def __init__(self, numbers: Mapping[str, pd.DataFrame]) -> None:
        self.numbers = numbers

    def table(self, name: str) -> pd.DataFrame:
        """A table by the name of its CSV."""
        if name not in self.numbers or self.numbers[name].empty:
            raise Untrue(f"there is no table {name}")
        return self.numbers[name]

    def quote(
        self,
        name: str,
        sign: str,
        of: str = "value",
        times: float = 1,
        unit: str = "",
        places: int | None = None,
        **where: Any,
    ) -> str:
        """A number of the one row with these values, its interval and a link; negative ones without sign.

        sign: of its interval: `+` above zero, `−` below it, `0` across it, and an empty one anywhere; places:
        decimals, where two significant digits of the interval are not wanted.
        """
        table = self.table(name)
        chosen = (table[[*where]] == pd.Series(where)).all(axis=1)
        if chosen.sum() != 1:
            raise Untrue(f"{name} has {chosen.sum()} rows of {where}")
        place = int(chosen.to_numpy().argmax())
        values = [float(table.iloc[place].get(one, float("nan"))) for one in interval_of(of)]
        low, high = values[1:]
        if sign and sign != ("+" if low > 0 else "−" if high < 0 else "0" if low <= high else None):
            raise Untrue(f"{name}, {where}: {of} {low} to {high} is not {sign}")
        times = -times if sign == "−" else times
        value, low, high = (times * one for one in values)
        found = {"value": value, "low": min(low, high), "high": max(low, high)}
        return linked(in_brackets(found, unit, places), name, place)

    def claim(self, number: int, sign: str, *how: Any, **more: Any) -> str:
        """The effect, or its ratio to the paper's, of a part of a claim that counts: the one that its
        sentence is about, or another `column` and `text`; how, more: as `quote` takes them.
        """
        claim = EVERY[number - 1]
        if claim.shown is None:
            raise Untrue(f"no part of claim {number} counts")
        row = {"column": claim.column, "text": claim.asks(claim.column)[claim.shown].text, **more}
        verdicts = self.table("verdicts")
        part = verdicts[(verdicts["claim"] == number) & (verdicts["column"] == row["column"])]
        if part.set_index("text").standing.get(row["text"]) not in (COUNTS, BESIDE):
            raise Untrue(f"claim {number}: {row['text']} does not count")
        return self.quote("verdicts", sign, *how, claim=number, **row)

    def grade(self, number: int, *grades: str) -> str:
        """Nothing, if a claim has these grades in the columns of `COLUMNS`; a dash where it has none."""
        grades_of = self.table("grades")
        table = grades_of[grades_of["claim"] == number].set_index("column")["grade"]
        found = [table.get(column, NOTHING) for column in COLUMNS]
        return self.check(found == [*grades])

    def check(self, holds: bool) -> str:
        """Nothing, if something is true."""
        if not holds:
            raise Untrue("a comparison is not true")
        return ""


_TEMPLATES = jinja2.Environment(  # its own: the page's loads torch
    loader=jinja2.PackageLoader("uavnav.report"), undefined=jinja2.StrictUndefined
)
STUDY = _TEMPLATES.get_template("study.md")


def block(name: str, quotes: Quotes) -> str:
    """A block of the prose, in Markdown; raises Untrue, with its name, where it is not true or asks for a row
    or a column that is not there.
    """
    asks = {one: getattr(quotes, one) for one in ("table", "quote", "claim", "grade", "check")}
    try:
        return "".join(STUDY.blocks[name](STUDY.new_context(asks | {"link": linked}))).strip()
    except (ValueError, LookupError, pd.errors.UndefinedVariableError, jinja2.UndefinedError) as error:
        raise Untrue(f"{name}: {error}") from error


def prose(numbers: Mapping[str, pd.DataFrame]) -> dict[str, str]:
    """Every block by its name; one that is not true is empty."""
    found, quotes = {}, Quotes(numbers)
    for name in STUDY.blocks:
        try:
            found[name] = block(name, quotes)
        except Untrue:
            found[name] = ""
    return found
