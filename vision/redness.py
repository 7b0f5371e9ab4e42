"""Which pixels are red: the two colour tests of seed 4.1.2, and the integer form of the one that is used.

Images are uint8 BGR, shape (height, width, 3), as OpenCV reads them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class RgbThresholds:
    """T1 and T2 of seed (4.1), (4.2); the default is set G of Table 5.3, the thesis's choice.

    With T2 <= T1 / 2 the second condition follows from the first (sets A and F); with set G it matters only
    where the smaller of G and B exceeds 0.83 of the larger (erratum 17).
    """

    t1: float = 1.3
    t2: float = 0.71

    def __post_init__(self) -> None:
        for name in ("t1", "t2"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name}: {value!r} is not a positive factor")


@dataclass(frozen=True)
class HsvThresholds:
    """Lower and upper bounds of hue, saturation and value, each in 0..1 (seed 4.1.2); hue is red *outside*
    its pair.
    """

    hue: tuple[float, float] = (0.05, 0.97)
    saturation: tuple[float, float] = (0.3, 1.0)
    value: tuple[float, float] = (0.01, 1.0)

    def __post_init__(self) -> None:
        for name in ("hue", "saturation", "value"):
            low, high = getattr(self, name)
            if not 0.0 <= low <= high <= 1.0:
                raise ValueError(f"{name}: ({low}, {high}) is not an ascending pair in 0..1")


RGB_SETS: dict[str, RgbThresholds] = {
    "A": RgbThresholds(1.165, 0.51),
    "B": RgbThresholds(1.165, 0.61),
    "C": RgbThresholds(1.165, 0.71),
    "D": RgbThresholds(1.165, 0.81),
    "E": RgbThresholds(1.2, 0.61),
    "F": RgbThresholds(1.25, 0.61),
    "G": RgbThresholds(1.3, 0.71),
}
"""Seed Table 5.3."""

HSV_SETS: dict[str, HsvThresholds] = {
    "A": HsvThresholds((0.05, 0.97), (0.3, 1.0), (0.01, 1.0)),
    "B": HsvThresholds((0.01, 0.97), (0.3, 1.0), (0.01, 1.0)),
    "C": HsvThresholds((0.05, 0.97), (0.4, 1.0), (0.02, 1.0)),
    "D": HsvThresholds((0.05, 0.97), (0.5, 1.0), (0.03, 1.0)),
    "E": HsvThresholds((0.01, 0.50), (0.6, 1.0), (0.04, 1.0)),
    "F": HsvThresholds((0.00, 0.97), (0.3, 1.0), (0.01, 1.0)),
    "G": HsvThresholds((0.03, 0.97), (0.3, 1.0), (0.01, 1.0)),
}
"""Seed Table 5.2, where spaces lost in print are restored: [0.31] is [0.3 1]."""


def normalised_rgb(image_bgr: Image) -> Array:
    """Return R, G, B over their sum, seed (2.11), shape (height, width, 3); zeros for black, where it is
    undefined.
    """
    rgb = image_bgr[..., ::-1].astype(np.float64)
    total = rgb.sum(axis=-1, keepdims=True)
    return np.asarray(rgb / np.maximum(total, 1.0))


def condition_1(rgb: Array, t1: float) -> Mask:
    """Return R > T1 G and R > T1 B, seed (4.1); brackets and the second "and" restored (erratum 17).

    Holds or fails alike for raw and for normalised colours (erratum 18).
    """
    red, green, blue = np.moveaxis(rgb, -1, 0)
    return np.asarray((red > t1 * green) & (red > t1 * blue))


def condition_2(rgb: Array, t2: float) -> Mask:
    """Return R > T2 (G + B), seed (4.2): red holds more than T2 / (1 + T2) of the sum."""
    red, green, blue = np.moveaxis(rgb, -1, 0)
    return np.asarray(red > t2 * (green + blue))


def red_by_rgb(image_bgr: Image, thresholds: RgbThresholds | None = None) -> Mask:
    """Return the binary image of seed 4.1.2 by (4.1) and (4.2), by the equations as they stand: slow, and
    plain.
    """
    limits = RgbThresholds() if thresholds is None else thresholds
    rgb = normalised_rgb(image_bgr)
    return condition_1(rgb, limits.t1) & condition_2(rgb, limits.t2)


def hsv(image_bgr: Image) -> Array:
    """Return hue, saturation and value (seed 2.12), each in 0..1, shape (height, width, 3); hue NaN where
    undefined.

    The hue's second and third lines are 2 + (B - R) / range and 4 + (R - G) / range, modulo 360 deg; it is
    undefined where R = G = B (erratum 3).
    """
    rgb = image_bgr[..., ::-1].astype(np.float64)
    red, green, blue = np.moveaxis(rgb, -1, 0)
    high, low = rgb.max(axis=-1), rgb.min(axis=-1)
    spread = high - low
    with np.errstate(invalid="ignore", divide="ignore"):
        sixths = np.where(
            red == high,
            (green - blue) / spread,
            np.where(green == high, 2.0 + (blue - red) / spread, 4.0 + (red - green) / spread),
        )
        saturation = np.where(high > 0.0, spread / high, 0.0)
    hue = np.where(spread > 0.0, (sixths / 6.0) % 1.0, np.nan)
    return np.stack([hue, saturation, high / 255.0], axis=-1)


def red_by_hsv(image_bgr: Image, thresholds: HsvThresholds | None = None) -> Mask:
    """Return the binary image of seed 4.1.2 by hue, saturation and value; an undefined hue is not red."""
    limits = HsvThresholds() if thresholds is None else thresholds
    hue, saturation, value = np.moveaxis(hsv(image_bgr), -1, 0)
    mask = (hue <= limits.hue[0]) | (hue >= limits.hue[1])
    mask &= (saturation >= limits.saturation[0]) & (saturation <= limits.saturation[1])
    return np.asarray(mask & (value >= limits.value[0]) & (value <= limits.value[1]))


def ratio_table(t1: float = 1.3, floor: int = 4) -> Image:
    """Return the table with ``R > table[max(G, B)]`` as condition (4.1), shape (256,).

    ``floor`` is added to it: a dark, noisy pixel such as (4, 2, 2) is red by (4.1) alone (erratum 18). With
    floor 0 this is (4.1) exactly.
    """
    if not (math.isfinite(t1) and t1 > 0.0):
        raise ValueError(f"t1: {t1!r} is not a positive factor")
    if not 0 <= floor <= 255:
        raise ValueError(f"floor: {floor!r} is not from 0 to 255")
    levels = np.floor(t1 * np.arange(256) + 1e-9) + floor
    return np.asarray(np.minimum(levels, 255.0), dtype=np.uint8)


def sum_table(t2: float = 0.71) -> Image:
    """Return the table with ``R > table[G + B]`` as condition (4.2), shape (511,)."""
    if not (math.isfinite(t2) and t2 > 0.0):
        raise ValueError(f"t2: {t2!r} is not a positive factor")
    return np.asarray(np.minimum(np.floor(t2 * np.arange(511) + 1e-9), 255.0), dtype=np.uint8)


def red_mask(image_bgr: Image, ratio: Image | None = None, total: Image | None = None) -> Image:
    """Return 255 where red and 0 elsewhere, shape (height, width), by integer tables: (4.1), and (4.2) if
    asked for.

    ``ratio`` is a ``ratio_table`` (the default one where not given), ``total`` a ``sum_table``. Without it
    (4.2) is left out, which changes little, see ``RgbThresholds``; on raw colours both conditions are what
    they are on normalised ones (erratum 18).
    """
    import cv2

    blue, green, red = cv2.split(image_bgr)
    limit = cv2.LUT(cv2.max(green, blue), ratio_table() if ratio is None else ratio)
    if total is not None:
        limit = cv2.max(limit, np.take(total, cv2.add(green, blue, dtype=cv2.CV_16U)))
    return np.asarray(cv2.compare(red, limit, cv2.CMP_GT), dtype=np.uint8)
