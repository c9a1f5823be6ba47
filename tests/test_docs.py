"""What the README shows runs."""

import re
from pathlib import Path

import pytest

from uavnav.report.page import DECISIONS

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


@pytest.mark.parametrize("code", blocks("python"))
def test_each_snippet_of_the_readme_runs(code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {})


def test_every_file_that_the_readme_links_to_exists():
    for target in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (ROOT / target).is_file(), target


def test_the_table_of_the_decisions_is_the_modules_row_by_row():
    lines = (ROOT / "docs" / "decisions.md").read_text().splitlines()
    header, *decisions = (f"| {' | '.join(decision)} |" for decision in DECISIONS)
    begin = lines.index(header)
    assert lines[begin + 2 : begin + 3 + len(decisions)] == [*decisions, ""]
    assert [number for number, *_ in DECISIONS[1:]] == [str(number) for number in range(1, 17)]
