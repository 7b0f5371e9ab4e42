"""Every notebook runs from top to bottom, on smaller flights than it shows; nightly as it is."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).parents[2] / "notebooks"
SMALLER = {
    "01_replay_a_flight": {},
    "02_thesis_chapter_5": {"DRAWS = 2": "DRAWS = 1"},
    "03_heave_and_forecast": {"HOVER_S = 60.0": "HOVER_S = 25.0", "EVERY_S = 4.0": "EVERY_S = 26.0"},
    "04_camera_imu_clocks": {"ROCK_S = 8.0": "ROCK_S = 5.0"},
    "05_tune_a_filter": {
        "HOVER_S = 20.0": "HOVER_S = 4.0",
        '"--parameters", "magnetometer.heading_sigma_rad", ': "",
    },
    "06_your_own_sensor": {"HOVER_S = 20.0": "HOVER_S = 5.0"},
}
"""Notebook, and what in it is replaced by what."""
PROOF = {
    "01_replay_a_flight": "/estimate/odometry",
    "02_thesis_chapter_5": "smaller than the thesis's reported errors",
    "03_heave_and_forecast": "errors of height and heave [m]",
    "04_camera_imu_clocks": "estimated: ",
    "05_tune_a_filter": "identified, from",
    "06_your_own_sensor": "the Jacobian agrees with finite differences",
}
"""What a notebook prints at its end, or near it."""


def executed(name: str, replacements: dict[str, str], data: Path) -> list[Any]:
    """Execute a notebook and return its cells; the real recordings are looked for in ``data``."""
    nbformat = pytest.importorskip("nbformat", reason="notebooks need the extra [notebooks]")
    nbclient = pytest.importorskip("nbclient", reason="notebooks need the extra [notebooks]")
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    for before, after in replacements.items():
        cells = [c for c in notebook.cells if c.cell_type == "code" and before in c.source]
        assert cells, f"{name} says {before!r} no more"
        for cell in cells:
            cell.source = cell.source.replace(before, after)
    client = nbclient.NotebookClient(
        notebook, timeout=280, resources={"metadata": {"path": str(FOLDER)}}, kernel_name="python3"
    )
    client.execute(env={**os.environ, "DECKFIX_DATA": str(data)})
    return list(notebook.cells)


def printed(cells: list[Any]) -> str:
    outputs = (o for cell in cells if cell.cell_type == "code" for o in cell.outputs)
    return "".join(o.get("text", "") for o in outputs if o.get("name") == "stdout")


def test_every_notebook_is_run() -> None:
    assert {p.stem for p in FOLDER.glob("*.ipynb")} == set(SMALLER) == set(PROOF)


@pytest.mark.parametrize("name", SMALLER)
def test_a_notebook_runs_on_smaller_flights(name: str, tmp_path: Path) -> None:
    assert PROOF[name] in printed(executed(name, SMALLER[name], tmp_path / "no recordings"))


@pytest.mark.nightly
@pytest.mark.parametrize("name", SMALLER)
def test_a_notebook_runs_as_it_is(name: str) -> None:
    data = os.environ.get("DECKFIX_DATA") or FOLDER.parent.parent / "shared" / "data"
    assert PROOF[name] in printed(executed(name, {}, Path(data)))


@pytest.mark.parametrize("name", SMALLER)
def test_a_notebook_is_small_has_its_figures_and_no_error(name: str) -> None:
    nbformat = pytest.importorskip("nbformat", reason="notebooks need the extra [notebooks]")
    path = FOLDER / f"{name}.ipynb"
    assert path.stat().st_size < 320_000
    text = path.read_text(encoding="utf-8")
    assert '"image/png"' in text
    assert '"output_type": "error"' not in text
    assert "/tmp/" not in text
    for cell in nbformat.reads(text, as_version=4).cells:
        if cell.cell_type == "code":
            private = re.findall(r"^(?:from|import) .*\b_\w+", cell.source, re.M)
            assert not private, private
