"""Laws of the state: adding an error and taking the difference undo each other, whatever blocks are on."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from estimation.config import Config, parse_config
from estimation.frames import Array, quat_exp
from estimation.state import (
    ATTITUDE,
    BLOCKS,
    GPS_BIAS,
    NOMINAL,
    NOMINAL_SIZE,
    Q0,
    SIZES,
    Layout,
    minus,
    nominal_zero,
    plus,
)

layouts = st.sets(st.integers(GPS_BIAS, len(BLOCKS) - 1)).map(lambda on: Layout.with_blocks(sorted(on)))


def nominal(rng: np.random.Generator) -> Array:
    x = 10.0 * rng.standard_normal(NOMINAL_SIZE)
    x[Q0 : Q0 + 4] = quat_exp(1.5 * rng.uniform(-1.0, 1.0, 3))
    return x


@given(layouts, st.integers(0, 1 << 32))
def test_minus_undoes_plus(layout: Layout, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = nominal(rng)
    error = rng.uniform(-1.7, 1.7, layout.size)
    np.testing.assert_allclose(
        minus(plus(x, error, layout.offsets), x, layout.offsets, layout.size), error, atol=1e-13
    )
    np.testing.assert_allclose(minus(x, x, layout.offsets, layout.size), np.zeros(layout.size), atol=1e-15)


@given(layouts, st.integers(0, 1 << 32))
def test_plus_undoes_minus_where_blocks_are_on(layout: Layout, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y = nominal(rng), nominal(rng)
    back = plus(x, minus(y, x, layout.offsets, layout.size), layout.offsets)
    for block, size in enumerate(SIZES):
        places = slice(NOMINAL[block], NOMINAL[block] + size + (block == ATTITUDE))
        expected = (y if layout.offsets[block] >= 0 else x)[places]
        if block == ATTITUDE and back[Q0 : Q0 + 4] @ expected < 0.0:
            expected = -expected
        np.testing.assert_allclose(back[places], expected, atol=1e-12)


@given(layouts)
def test_layouts_are_dense_and_named(layout: Layout) -> None:
    taken = np.concatenate(
        [np.arange(o, o + s) for o, s in zip(layout.offsets, SIZES, strict=True) if o >= 0]
    )
    np.testing.assert_array_equal(np.sort(taken), np.arange(layout.size))
    assert len(layout.names) == len(set(layout.names)) == len(layout.units) == layout.size
    assert layout.names[0] == "position.n"
    assert np.all(layout.offsets[:GPS_BIAS] >= 0)


def test_configuration_chooses_the_blocks() -> None:
    everything = Layout.of(Config())
    assert "gps_bias.n" in everything.names
    assert "baro_bias.h" in everything.names
    bare = Layout.of(parse_config("[gps]\nbias = false\n[barometer]\nuse = false\n"))
    assert bare.size == 15


def test_zero_is_level_and_unit() -> None:
    x = nominal_zero()
    assert x[Q0] == 1.0
    assert np.count_nonzero(x) == 1
