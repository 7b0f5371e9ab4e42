"""The notebook of the thesis's chapter 5 runs from top to bottom."""

from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[2] / "notebooks" / "02_thesis_chapter_5.ipynb"


def test_chapter_5_notebook_executes():
    nbformat = pytest.importorskip("nbformat", reason="notebooks need the extra [notebooks]")
    nbclient = pytest.importorskip("nbclient", reason="notebooks need the extra [notebooks]")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    setup = next(cell for cell in notebook.cells if "DRAWS = 2" in cell.source)
    setup.source = setup.source.replace("DRAWS = 2", "DRAWS = 1")
    client = nbclient.NotebookClient(
        notebook, timeout=240, resources={"metadata": {"path": str(NOTEBOOK.parent)}}
    )
    client.execute()
    printed = "".join(
        output.get("text", "")
        for cell in notebook.cells
        if cell.cell_type == "code"
        for output in cell.outputs
    )
    assert "smaller than the thesis's reported errors" in printed
