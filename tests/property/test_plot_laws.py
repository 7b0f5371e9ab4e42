"""Laws of the plots' decimation and of embedding data in a page."""

from __future__ import annotations

import json

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from deckfix.page import embedded_json, text
from deckfix.plotting import decimate, label

NUMBERS = st.floats(-1e6, 1e6) | st.just(float("nan"))


@settings(max_examples=60, deadline=None)
@given(st.lists(NUMBERS, min_size=1, max_size=400), st.integers(1, 40))
def test_decimation_keeps_extremes_order_and_size(values: list[float], buckets: int) -> None:
    y = np.array(values)
    x = np.arange(len(y), dtype=np.float64)
    xs, ys = decimate(x, y, buckets)
    assert len(xs) <= max(2 * buckets, 1)
    assert (np.diff(xs) > 0).all()
    assert np.array_equal(ys, y[xs.astype(int)], equal_nan=True)
    if np.isfinite(y).any():
        assert np.nanmin(ys) == np.nanmin(y)
        assert np.nanmax(ys) == np.nanmax(y)


@settings(max_examples=200, deadline=None)
@given(st.text())
def test_no_text_leaves_its_place(value: str) -> None:
    data = embedded_json({"name": value})
    assert "<" not in data
    assert ">" not in data
    assert "\u2028" not in data
    assert json.loads(data) == {"name": value}
    for escaped in (text(value), label(value)):
        assert "<" not in escaped
        assert ">" not in escaped
        assert '"' not in escaped
    assert label(value).isprintable()
