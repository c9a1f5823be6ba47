"""The notebooks run from top to bottom as they are, say nothing on stderr, and define nothing that one
would reuse.
"""

import ast
import re
import sys
import time
from pathlib import Path

import pytest
from warm import Popen

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")

FOLDER = Path(__file__).parent.parent / "docs" / "notebooks"
RESULTS = FOLDER.parent.parent / "results"
PICTURES = {"1-the-world": 2, "2-train-and-watch": 3, "3-compare-and-conclude": 2, "4-your-own": 0}
SECONDS = 120
"""In which a notebook must be through, from its first cell on."""
FROM_NOTHING = "1-the-world"
"""The kernel that imports all by itself, and whose imports are heard; the others are forks, see the
module `warm`.
"""
THROWAWAY = {"2-train-and-watch": {"tell"}, "4-your-own": {"gentle", "acting"}}


def read(name):
    return nbformat.read(FOLDER / f"{name}.ipynb", 4)


def code(book):
    return [cell for cell in book.cells if cell.cell_type == "code"]


def execute(name, folder):
    """What the cells of a notebook print and show, when it is run in a folder: the text, how
    many pictures.
    """
    book = read(name)
    end = time.monotonic() + SECONDS
    left = {"timeout_func": lambda cell: max(1, round(end - time.monotonic()))}
    with pytest.MonkeyPatch.context() as patch:
        if name != FROM_NOTHING and sys.platform == "linux":
            patch.setattr("jupyter_client.launcher.Popen", Popen)
        nbclient.NotebookClient(book, resources={"metadata": {"path": str(folder)}}, **left).execute()
    outputs = [output for cell in code(book) for output in cell.outputs]
    assert [output.text for output in outputs if output.get("name") == "stderr"] == []
    shown = [output.get("data", {}) for output in outputs]
    printed = [output.get("text", "") for output in outputs] + [data.get("text/html", "") for data in shown]
    return "\n".join(printed), sum(any(kind.startswith("image/") for kind in data) for data in shown)


def test_there_are_four_notebooks():
    assert sorted(path.stem for path in FOLDER.glob("*.ipynb")) == sorted(PICTURES)


@pytest.mark.parametrize("name", PICTURES)
def test_a_notebook_is_committed_with_the_outputs_of_one_run_without_an_error_below_400_kb(name):
    book, text = read(name), (FOLDER / f"{name}.ipynb").read_text()
    nbformat.validate(book)
    outputs = [output for cell in code(book) for output in cell.outputs]
    assert [cell.execution_count for cell in code(book)] == [*range(1, len(code(book)) + 1)]
    assert (
        sum(f"image/{kind}" in one.get("data", {}) for one in outputs for kind in ("png", "gif"))
        == PICTURES[name]
    )
    assert not [one for one in outputs if one.output_type == "error" or one.get("name") == "stderr"]
    assert len(text) < 400_000
    assert not re.search(r"[\"' (](/home|/root|/tmp|/work|/Users)/| at 0x[0-9a-f]", text)


@pytest.mark.parametrize("name", PICTURES)
def test_a_notebook_defines_nothing_reusable(name):
    nodes = [node for cell in code(read(name)) for node in ast.walk(ast.parse(cell.source))]
    defined = {node.name for node in nodes if isinstance(node, (ast.FunctionDef, ast.ClassDef))}
    assert defined == THROWAWAY.get(name, set())


@pytest.mark.parametrize("name", PICTURES)
def test_links_between_notebooks_lead_somewhere(name):
    for cell in read(name).cells:
        if cell.cell_type == "markdown":
            for target in re.findall(r"\]\(([^)]+)\)", cell.source):
                assert (FOLDER / target).is_file(), target


@pytest.mark.slow
@pytest.mark.parametrize("name", PICTURES)
def test_a_notebook_runs_in_an_empty_folder(name, tmp_path):
    text, pictures = execute(name, tmp_path)
    assert pictures == PICTURES[name]
    if name == "1-the-world":
        assert "train: 10,000 layouts of 8 obstacles" in text
        assert "validation: 1,000 layouts of 8 obstacles" in text
    if name == "2-train-and-watch":
        assert "did you mean tanh?" in text
        assert "49,152 frames: reward" in text
    if name == "3-compare-and-conclude":
        assert "`make study` trains the whole study" in text
        # of the claims: three seeds of one algorithm decide next to nothing
        assert text.count(">open</td>") >= 8
    if name == "4-your-own":
        assert "30 matrices earn" in text
        assert "random search" in text


@pytest.mark.slow
@pytest.mark.skipif(not list(RESULTS.rglob("config.yaml")), reason="there is no folder results/ with runs")
def test_the_third_notebook_reads_the_committed_study():
    before = sorted(FOLDER.rglob("*"))
    text, pictures = execute("3-compare-and-conclude", FOLDER)
    assert pictures == 2
    assert "make study" not in text
    assert "<td>dqn</td>" in text
    assert "PPO minus DQN: 53.6 [52.6, 54.6] of reward in 1,000 frames, 40 seeds each" in text
    assert sorted(FOLDER.rglob("*")) == before  # it trains nothing
