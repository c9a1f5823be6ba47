"""The pages of docs/ and the README: their text, their blocks of code and their tables."""

import re
from pathlib import Path

from uavnav.algorithms import ALGORITHMS

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
ALL = {
    str(path.relative_to(ROOT)): path.read_text()
    for path in [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
}
MINE = ("start", "environment", "tasks", *ALGORITHMS, "extending")
PAGES = {name: ALL[f"docs/{name}.md"] for name in MINE}
CONFIGS = {name: one.config for name, one in ALGORITHMS.items()}
"""Of each algorithm: every one of the table has its page."""


def blocks(page, language):
    return re.findall(rf"```{language}\n(.*?)```", page, flags=re.DOTALL)


def table(page, header):
    """The rows of the first table with this header, as lists of cells."""
    rest = page.split(f"\n{header}\n", 1)[1]
    lines = rest.split("\n\n", 1)[0].splitlines()[1:]
    return [[cell.strip() for cell in line.strip("|").split(" |")] for line in lines]


def code(configuration):
    return re.findall(r"`([^`]+)`", configuration)
