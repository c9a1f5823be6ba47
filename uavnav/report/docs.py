"""docs/results.md and the table of the README, from the same source as the report.

`python -m uavnav.report.docs [FOLDER]`
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from uavnav.choices import Parser
from uavnav.report.conclusions import results, summary
from uavnav.report.content import gather
from uavnav.runs import RunError

BEGIN, END = "<!-- results -->", "<!-- end of results -->"


def between_marks(text: str, new: str) -> str:
    """A text with what lies between its marks replaced.

    Raises:
        RunError: it has no marks.
    """
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise RunError(f"README.md: has no lines {BEGIN} and {END}; put them where the results go")
    return f"{before}{BEGIN}\n{new}\n{END}{after}"


def main(argv: Sequence[str] | None = None) -> int:
    """Write docs/results.md and the README's table from the runs in a folder."""
    parser = Parser(prog="python -m uavnav.report.docs", description=main.__doc__)
    parser.add_argument("folder", nargs="?", default="results", metavar="FOLDER", help="of runs (default: results)")
    arguments = parser.parse_args(argv)
    try:
        content = gather([Path(arguments.folder)])
        readme, page = Path("README.md"), Path("docs/results.md")
        replaced = between_marks(readme.read_text(), summary(content))
        page.write_text(results(content))
        readme.write_text(replaced)
    except (RunError, OSError) as error:
        print(f"uavnav.report.docs: {error}", file=sys.stderr)
        return 2
    print(f"wrote {page} and the table in {readme}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
