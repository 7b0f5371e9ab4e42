"""Screening one measurement and screening columns of them is the same."""

from __future__ import annotations

import math

from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.events import Kind
from estimation.rows import Rows
from estimation.screening import malformed, malformed_one

SIX = st.tuples(*[st.sampled_from([0.0, 1.0, -1.0, 0.5, 50.0, -150.0, 2000.0, 1e-9, math.nan, math.inf])] * 6)


@settings(max_examples=300, deadline=None)
@given(kind=st.sampled_from(Kind), value=SIX, own=SIX | st.just((math.nan,) * 6))
def test_one_is_screened_as_many_are(kind: Kind, value: tuple[float, ...], own: tuple[float, ...]) -> None:
    rows = Rows.empty(1)
    rows.kind[0], rows.value[0], rows.own[0] = kind, value, own
    assert malformed_one(int(kind), value, own) == malformed(rows)[0]
