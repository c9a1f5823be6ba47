"""Run the notebooks and keep their outputs in them (`python docs/outputs.py`)."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).parent / "notebooks"
READS_RESULTS = "3-compare-and-conclude"
"""This one looks for `results/` above its folder and trains nothing there; the others write runs."""


def main() -> None:
    """Run each notebook from top to bottom and write it with what its cells print and show."""
    for path in sorted(FOLDER.glob("*.ipynb")):
        book = nbformat.read(path, 4)
        with TemporaryDirectory() as scratch:
            where = str(FOLDER) if path.stem == READS_RESULTS else scratch
            how = {"record_timing": False, "coalesce_streams": True}
            NotebookClient(book, resources={"metadata": {"path": where}}, **how).execute()
        book.metadata.language_info = {"name": "python"}
        for output in (output for cell in book.cells for output in cell.get("outputs", [])):
            if len(output.get("data", ())) > 1:
                del output.data["text/plain"]  # where a picture or a table is shown
        nbformat.write(book, path)


if __name__ == "__main__":
    main()
