"""Fixtures for all tests."""

from __future__ import annotations

import os
from pathlib import Path

# Small matrices: threads of the linear algebra library only wait for each other. Read when numpy is imported.
for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import pytest  # noqa: E402


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Return the folder of real recordings, or skip the test."""
    beside = Path(__file__).parents[2] / "shared" / "data"
    path = Path(os.environ.get("DECKFIX_DATA") or beside)
    if not path.is_dir():
        pytest.skip("real data not found: set DECKFIX_DATA")
    return path
