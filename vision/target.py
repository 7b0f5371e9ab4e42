"""Ring targets: concentric red rings on white, as data.

A target is its edge radii, from the outside in: red lies between edges 0 and 1, 2 and 3, ...; with an odd
number of edges the middle is a red disc. Everything that looks for, draws or prints a target takes it from
here.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vision import tables

Colour = tuple[int, int, int]

RED: Colour = (200, 22, 30)
"""Signal red as sRGB; what a printer makes of it decides nothing, the detector looks at ratios."""
WHITE: Colour = (245, 245, 245)

THESIS_DIAMETER_M = 0.21
"""Outer diameter [m] of the thesis's target as it is rebuilt here.

The thesis prints figure 4.1 without a size. Of all sizes with six equally spaced contours, this is the only
one for which three of them pass the filter of Table 5.4 at both ends of its vertical trial, 0.2 m and 2 m, in
640x480 pixels at 62.2 deg: the third contour from the middle has 278 px at 0.2 m (279.7 allowed), the fourth
37.1 px at 2 m (37 needed).
"""

_RECOMMENDED = (1.0, 0.515, 0.2725, 0.1625, 0.112, 0.0775)


@dataclass(frozen=True)
class RingTarget:
    """A target of concentric rings.

    Parameters
    ----------
    edges_m
        Radii of the edges [m], strictly descending, at least two.
    board_m
        Side of the white square board [m], centred on the rings; 1.3 outer diameters where it is not given,
        which is a white margin of 15 % of the diameter all round. Without white around it the outer edge is
        measured against whatever the deck is painted with.
    red_rgb, white_rgb
        Colours to print and to render with, sRGB 0..255.
    name
        What it is called on the print.

    Raises ``ValueError`` naming the argument.
    """

    edges_m: tuple[float, ...]
    board_m: float | None = None
    red_rgb: Colour = RED
    white_rgb: Colour = WHITE
    name: str = "ring target"

    def __post_init__(self) -> None:
        try:
            edges = tuple(float(r) for r in self.edges_m)
        except (TypeError, ValueError) as error:
            raise ValueError(f"edges_m: {self.edges_m!r} is not a sequence of radii in metres") from error
        if len(edges) < 2:
            raise ValueError(f"edges_m: {len(edges)} radii; a ring has two edges")
        if not all(math.isfinite(r) and r > 0.0 for r in edges):
            raise ValueError(f"edges_m: {edges} are not all positive and finite")
        if any(inner >= outer for outer, inner in itertools.pairwise(edges)):
            raise ValueError(f"edges_m: {edges} do not descend; list the edges from the outside in")
        object.__setattr__(self, "edges_m", edges)
        board = 2.6 * edges[0] if self.board_m is None else float(self.board_m)
        if not (math.isfinite(board) and board >= 2.0 * edges[0]):
            raise ValueError(f"board_m: a board of {board!r} m does not hold rings of {2.0 * edges[0]:g} m")
        object.__setattr__(self, "board_m", board)
        for field in ("red_rgb", "white_rgb"):
            colour = tuple(int(c) for c in getattr(self, field))
            if len(colour) != 3 or not all(0 <= c <= 255 for c in colour):
                raise ValueError(f"{field}: {colour} is not three values from 0 to 255")
            object.__setattr__(self, field, colour)
        if not isinstance(self.name, str) or not self.name.isprintable():
            raise ValueError(f"name: {self.name!r} is not a line of printable text")
        red, green, blue = self.red_rgb
        if red <= 1.3 * max(green, blue):
            raise ValueError(f"red_rgb: {self.red_rgb} is not red: R must exceed 1.3 times G and B")

    @classmethod
    def thesis(cls, diameter_m: float = THESIS_DIAMETER_M) -> RingTarget:
        """Return the target of seed figure 4.1: three rings, six equally spaced contours (seed 4.18)."""
        outer = _radius(diameter_m)
        return cls(tuple(outer * k / 6.0 for k in range(6, 0, -1)), name="equally spaced rings")

    @classmethod
    def recommended(cls, diameter_m: float = 1.0) -> RingTarget:
        """Return the target for 0.3 to 40 times its diameter away.

        Radii shrink about geometrically, so that some edges are wide apart at every distance; the outer ring
        is thick, so that it is the last to melt into its neighbours (4 px at 34 m for 1 m and f = 530 px).
        Their ratios are all different: any two edges of known kind (outer or inner edge of a ring) say which
        they are, because the ratios of equal kinds differ by 14 % or more. A regular progression would look
        the same one ring further in.
        """
        outer = _radius(diameter_m)
        return cls(tuple(outer * fraction for fraction in _RECOMMENDED), name="recommended rings")

    @property
    def diameter_m(self) -> float:
        """Outer diameter [m]."""
        return 2.0 * self.edges_m[0]

    @property
    def side_m(self) -> float:
        """Side of the white board [m]."""
        assert self.board_m is not None  # filled in by __post_init__
        return self.board_m

    @property
    def red_bands_m(self) -> list[tuple[float, float]]:
        """Outer and inner radius [m] of every red ring; the inner one of a disc is zero."""
        edges = (*self.edges_m, 0.0) if len(self.edges_m) % 2 else self.edges_m
        return list(zip(edges[::2], edges[1::2], strict=True))

    @property
    def spacing_m(self) -> float | None:
        """The ``d_real`` of seed (4.18) [m] where all edges are equally spaced, else None."""
        steps = -np.diff(self.edges_m)
        return float(steps.mean()) if np.ptp(steps) <= 1e-6 * steps.mean() else None

    def is_red(self, radius_m: ArrayLike) -> NDArray[np.bool_]:
        """Return where points at these distances from the centre [m] are red."""
        edges_around = np.searchsorted(-np.asarray(self.edges_m), -np.asarray(radius_m))
        return np.asarray(edges_around % 2 == 1)

    def to_toml(self) -> str:
        """Return the text of a ``target.toml``. Law: ``RingTarget.from_toml(t.to_toml()) == t``."""
        return (
            "# Concentric red rings on white. edges_m: radii of the edges from the outside in; red is from\n"
            "# the 1st to the 2nd, the 3rd to the 4th, ... Measure the print and correct them: an error of\n"
            "# 1 % here is an error of 1 % in every distance.\n"
            f"name = {msgspec.json.encode(self.name).decode()}\n"
            f"edges_m = [{', '.join(repr(r) for r in self.edges_m)}]\n"
            f"board_m = {self.side_m!r}\n"
            f"red_rgb = {list(self.red_rgb)}\n"
            f"white_rgb = {list(self.white_rgb)}\n"
        )

    @classmethod
    def from_toml(cls, text: str) -> RingTarget:
        """Read a ``target.toml``; unknown or missing fields and wrong types are a ``ValueError`` naming the
        field.
        """
        return tables.from_toml(text, cls, "target")

    @classmethod
    def load(cls, path: str | Path) -> RingTarget:
        """Read a ``target.toml`` file; ``ValueError`` names the file."""
        return tables.load(path, cls, "target")


def _radius(diameter_m: Any) -> float:
    """Return half of a positive diameter or raise ``ValueError``."""
    try:
        diameter = float(diameter_m)
    except (TypeError, ValueError) as error:
        raise ValueError(f"diameter_m: {diameter_m!r} is not a number") from error
    if not (math.isfinite(diameter) and diameter > 0.0):
        raise ValueError(f"diameter_m: {diameter!r} is not a positive length")
    return diameter / 2.0
