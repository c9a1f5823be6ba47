"""What the README shows runs."""

import re
from pathlib import Path

import pytest

from uavnav.networks import ACTIVATIONS
from uavnav.report.page import DECISIONS

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


@pytest.mark.parametrize("code", [code for code in blocks("python") if "import" in code])
def test_each_snippet_of_the_readme_runs(code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {})


def test_the_line_that_adds_an_activation_fits_the_table(monkeypatch):
    (line,) = [code for code in blocks("python") if "import" not in code]
    from torch.nn import functional as F

    added = eval("{" + line + "}", {"F": F})
    assert len(added) == 1
    assert not set(added) & set(ACTIVATIONS)


def test_every_file_that_the_readme_links_to_exists():
    for target in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (ROOT / target).is_file(), target


def test_the_table_of_the_decisions_is_the_modules_row_by_row():
    lines = (ROOT / "docs" / "decisions.md").read_text().splitlines()
    header, *decisions = (f"| {' | '.join(decision)} |" for decision in DECISIONS)
    begin = lines.index(header)
    assert lines[begin + 2 : begin + 3 + len(decisions)] == [*decisions, ""]
    assert [number for number, *_ in DECISIONS[1:]] == [str(number) for number in range(1, 17)]
