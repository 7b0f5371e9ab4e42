"""Red pixels: the equations, and the integer form against them."""

import colorsys

import numpy as np
import pytest

from vision.redness import (
    HSV_SETS,
    RGB_SETS,
    HsvThresholds,
    RgbThresholds,
    hsv,
    normalised_rgb,
    ratio_table,
    red_by_hsv,
    red_by_rgb,
    red_mask,
    sum_table,
)


@pytest.fixture(scope="module")
def colours():
    return np.random.default_rng(1).integers(0, 256, (60, 100, 3), dtype=np.uint8)


def test_normalised_colours_sum_to_one_and_black_is_zero(colours):
    rgb = normalised_rgb(colours)
    np.testing.assert_allclose(rgb.sum(axis=-1), 1.0)
    assert (normalised_rgb(np.zeros((1, 1, 3), np.uint8)) == 0.0).all()


def test_normalising_undoes_a_change_of_light():
    image = np.array([[[20, 30, 100]]], np.uint8)
    np.testing.assert_allclose(normalised_rgb(image), normalised_rgb(2 * image))


@pytest.mark.parametrize("name", RGB_SETS)
def test_integer_tables_equal_the_equations_away_from_ties(colours, name):
    limits = RGB_SETS[name]
    blue, green, red = (colours[..., i].astype(float) for i in range(3))
    tie = np.isclose(red, limits.t1 * np.maximum(green, blue)) | np.isclose(red, limits.t2 * (green + blue))
    fast = red_mask(colours, ratio_table(limits.t1, 0), sum_table(limits.t2)) > 0
    assert (fast == red_by_rgb(colours, limits))[~tie].all()
    assert tie.mean() < 0.01


def test_floor_rejects_dark_noise_that_the_ratio_alone_takes_for_red():
    dark = np.array([[[2, 2, 4]]], np.uint8)
    assert red_by_rgb(dark)[0, 0]
    assert red_mask(dark)[0, 0] == 0
    assert red_mask(np.array([[[30, 20, 180]]], np.uint8))[0, 0] == 255


def test_second_condition_is_void_for_sets_a_and_f(colours):
    """T2 <= T1 / 2: erratum 17."""
    for name in ("A", "F"):
        limits = RGB_SETS[name]
        only_first = RgbThresholds(limits.t1, 1e-9)
        assert (red_by_rgb(colours, limits) == red_by_rgb(colours, only_first)).all()
    stricter = red_by_rgb(colours, RGB_SETS["D"])
    assert stricter.sum() < red_by_rgb(colours, RgbThresholds(1.165, 1e-9)).sum()


def test_hsv_agrees_with_the_standard_library(colours):
    ours = hsv(colours)
    for row, column in [(0, 0), (5, 7), (30, 99), (59, 50)]:
        blue, green, red = colours[row, column] / 255.0
        np.testing.assert_allclose(ours[row, column], colorsys.rgb_to_hsv(red, green, blue), atol=1e-12)


def test_hue_of_grey_is_undefined_and_not_red():
    grey = np.full((1, 1, 3), 90, np.uint8)
    assert np.isnan(hsv(grey)[0, 0, 0])
    assert not red_by_hsv(grey)[0, 0]
    assert red_by_hsv(np.array([[[20, 20, 200]]], np.uint8), HSV_SETS["A"])[0, 0]


def test_tables_of_the_thesis_are_complete():
    assert list(RGB_SETS) == list(HSV_SETS) == list("ABCDEFG")
    assert RgbThresholds() == RGB_SETS["G"]


def test_thresholds_are_checked():
    with pytest.raises(ValueError, match=r"^t1:"):
        RgbThresholds(t1=0.0)
    with pytest.raises(ValueError, match=r"^hue:"):
        HsvThresholds(hue=(0.9, 0.1))
    with pytest.raises(ValueError, match=r"^floor:"):
        ratio_table(floor=300)
    with pytest.raises(ValueError, match=r"^t2:"):
        sum_table(-1.0)
