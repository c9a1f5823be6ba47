"""docs/results.md, and the blocks of results in README.md and three pages of docs, from the report's source.

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

TEN, TIME, MEMORY = "uavnav, 10 seeds", "1 M frames", "peak [GB]"
"""A row and two columns of the tables in docs/benchmarks.md."""
RESULTS, BENCHMARKS = "docs/results.md", "docs/benchmarks.md"
BLOCKS = {
    "README.md": ("summary.md", "results/"),
    "docs/algorithms.md": ("choice.md", "../results/"),
    "docs/activations.md": ("activation.md", "../results/"),
    "docs/learned-or-classical.md": ("learned.md", "../results/"),
}
"""Pages with a block of results: its template, and the folder of the tables that it links to."""


def results(content: Content) -> str:
    """docs/results.md."""
    return render("results.md", content, root="../results/").strip() + "\n"


def block(content: Content, page: str, benchmarks: str = "") -> str:
    """The results in a page of `BLOCKS`; benchmarks: the text of `BENCHMARKS`, which has the costs."""
    template, root = BLOCKS[page]
    return render(template, content, root, costs=costs(benchmarks)).strip()


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
            if TIME in row and who.startswith(TEN):  # the last: in many environments
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
    """Write docs/results.md and the blocks of results in README.md and three pages of docs."""
    parser = Parser(prog="python -m uavnav.report.docs", description=main.__doc__)
    parser.add_argument(
        "folder", nargs="?", default="results", metavar="FOLDER", help="of runs (default: results)"
    )
    arguments = parser.parse_args(argv)
    try:
        content = gather([Path(arguments.folder)])
        measured, texts = Path(BENCHMARKS), {RESULTS: results(content)}
        benchmarks = measured.read_text() if measured.exists() else ""
        for page in BLOCKS:
            texts[page] = between_marks(Path(page).read_text(), block(content, page, benchmarks), page)
        for page, text in texts.items():
            files.write(Path(page), text.encode())
    except (RunError, OSError) as error:
        print(f"uavnav.report.docs: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("uavnav.report.docs: stopped; nothing was written", file=sys.stderr)
        return 130
    print(f"wrote {RESULTS} and the blocks of results in {', '.join(BLOCKS)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
