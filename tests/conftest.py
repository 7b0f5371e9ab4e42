"""Fixtures for all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Return the folder of real recordings, or skip the test."""
    beside = Path(__file__).parents[2] / "shared" / "data"
    path = Path(os.environ.get("DECKFIX_DATA", beside))
    if not path.is_dir():
        pytest.skip("real data not found: set DECKFIX_DATA")
    return path
