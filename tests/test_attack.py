"""Hostile input is refused in one line, or accepted; and the judge of that sees what is planted for it.

`attack` has the cases and the judge. The same cases are tried every time, so many that they end within a
minute on an idle machine of two cores; on a busy one they take longer, and the bounds of each case grow with
the load.
"""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ATTACK = Path(__file__).parent / "attack.py"
CLASSES = ("settings", "command-lines", "library", "study-files", "files")
EACH = 12
"""Cases of a class."""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="forks and /proc are Linux's"),
]


def attacked(*words):
    """The rows of the table by class, each with a number by verdict; and the lines of what failed."""
    done = subprocess.run([sys.executable, ATTACK, *words], capture_output=True, text=True, check=False)
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in done.stdout.splitlines()
        if line[:1] == "|"
    ]
    assert rows, done.stderr
    head, _, *found = rows
    failed = [line for line in done.stdout.splitlines() if re.match(r"[a-z-]+:\d+:\d+ ", line)]
    assert done.returncode == bool(failed)
    return {row[0]: dict(zip(head[1:], map(int, row[1:]), strict=True)) for row in found}, failed


@pytest.fixture(scope="module")
def outcome(warm_module):
    return attacked("--n", str(EACH * len(CLASSES)), "--seed", "0", "--seconds", "60")


@pytest.mark.parametrize("kind", CLASSES)
def test_hostile_input_is_refused_in_one_line_or_accepted(kind, outcome):
    counts, failed = outcome
    assert [line for line in failed if line.startswith(f"{kind}:")] == []
    assert counts[kind]["tried"] == EACH
    assert counts[kind]["refused in one line"] + counts[kind]["accepted"] == EACH
    assert counts[kind]["refused in one line"] >= EACH // 4  # or it is not hostile


@pytest.fixture(scope="module")
def planted(warm_module):
    """A machine may need many seconds to hand out 4 GiB, so the bound of memory is met long before that
    of time.
    """
    return attacked("--class", "planted", "--n", "8", "--seconds", "15", "--memory", "1")


@pytest.mark.parametrize("verdict", ["traceback", "hang", "memory", "long line", "half-written"])
def test_the_judge_sees_each_fault_that_is_planted(verdict, planted):
    """Eight faults that are all different; each is called by its name."""
    counts, failed = planted
    told = [(seen, meant) for _, seen, meant, *_ in (line.split("  ") for line in failed)]
    assert len({*told}) == 8
    assert {seen for seen, meant in told if meant.startswith(f"{verdict}, ")} == {verdict}
    assert counts["planted"]["refused in one line"] == counts["planted"]["accepted"] == 0


@pytest.mark.usefixtures("warm_module")
def test_a_seed_stands_for_the_same_100_cases_in_every_process():
    """In a fork, and in a process that hashes strings otherwise."""
    words = [sys.executable, ATTACK, "--list", "--n", "100", "--seed", "0"]
    first, again = (
        subprocess.run([*by, *words], capture_output=True, text=True, check=True).stdout.splitlines()
        for by in ([], ["env"])
    )
    assert first == again
    assert len(first) == 100
    assert len({line.partition(" ")[2] for line in first}) > 80
