"""docs/results.md, and the blocks of results in README.md and two pages of docs, from the report's source.

`python -m uavnav.report.docs [FOLDER]`
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from uavnav import files
from uavnav.errors import Parser
from uavnav.report.content import Content, gather
from uavnav.report.page import render
from uavnav.runs.tables import RunError

BEGIN, END = "<!-- results -->", "<!-- end of results -->"
TEN, TIME, MEMORY = "uavnav, 10 seeds", "1 M frames", "peak [GB]"
"""A row and two columns of the tables in docs/benchmarks.md."""
PAGES = "docs/results.md", "docs/algorithms.md", "docs/benchmarks.md", "docs/learned-or-classical.md"


def results(content: Content) -> str:
    """docs/results.md."""
    return render("results.md", content, root="../results/").strip() + "\n"


def summary(content: Content) -> str:
    """The README's findings, and the rewards in the paper, in training and on unseen layouts."""
    return render("summary.md", content, root="results/").strip()


def choice(content: Content, benchmarks: str) -> str:
    """The table in docs/algorithms.md; benchmarks: the text of docs/benchmarks.md, which has the costs."""
    return render("choice.md", content, costs=costs(benchmarks)).strip()


def classical(content: Content) -> str:
    """The results in docs/learned-or-classical.md."""
    return render("learned.md", content, root="../results/").strip()


def costs(benchmarks: str) -> dict[str, tuple[str, str]]:
    """Time and memory of a million frames of ten seeds, by algorithm; of full buffers where there are any."""
    times, memory = {}, {}
    for lines in benchmarks.split("\n\n"):
        head, *rows = (
            [cell.strip() for cell in line.strip("|").split("|")]
            for line in lines.strip().splitlines() or [""]
        )
        for first, *cells in rows if MEMORY in head else []:
            algorithm, _, who = first.lower().partition(", ")
            row = dict(zip(head[1:], cells, strict=True))
            if TIME in row and who == TEN:
                times[algorithm], memory[algorithm] = row[TIME], row[MEMORY]
            elif algorithm in times and not who:  # of full buffers
                memory[algorithm] = row[MEMORY]
    return {name: (time, memory[name]) for name, time in times.items()}


def between_marks(text: str, new: str, where: str = "README.md", block: str = "results") -> str:
    """A text with what is between its marks replaced; raises a RunError where it has no marks."""
    first, last = f"<!-- {block} -->", f"<!-- end of {block} -->"
    before, begin, rest = text.partition(first)
    _, end, after = rest.partition(last)
    if not begin or not end:
        raise RunError(f"{where}: has no lines {first} and {last}; put them where the {block} go")
    return f"{before}{first}\n{new}\n{last}{after}"


def main(argv: Sequence[str] | None = None) -> int:
    """Write docs/results.md and the blocks of results in README.md and two pages of docs."""
    parser = Parser(prog="python -m uavnav.report.docs", description=main.__doc__)
    parser.add_argument(
        "folder", nargs="?", default="results", metavar="FOLDER", help="of runs (default: results)"
    )
    arguments = parser.parse_args(argv)
    try:
        content = gather([Path(arguments.folder)])
        readme, page, chosen, measured, flown = map(Path, ("README.md", *PAGES))
        texts = {page: results(content)}
        texts[readme] = between_marks(readme.read_text(), summary(content))
        block = choice(content, measured.read_text() if measured.exists() else "")
        texts[chosen] = between_marks(chosen.read_text(), block, str(chosen))
        texts[flown] = between_marks(flown.read_text(), classical(content), str(flown))
        for path, text in texts.items():
            files.write(path, text.encode())
    except (RunError, OSError) as error:
        print(f"uavnav.report.docs: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("uavnav.report.docs: stopped; nothing was written", file=sys.stderr)
        return 130
    print(f"wrote {page} and the blocks of results in {readme}, {chosen} and {flown}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
