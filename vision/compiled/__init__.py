"""Identification and photometric fits compiled by numba: the drivers as they stand, the array work as loops.

The modules of this folder replace, inside compiled code only, those functions whose NumPy form is made of many small
array operations. All formulas are the same objects (``vision.view``, ``vision.lines``, ``vision.profile``,
``vision.robust``, ``vision.rings``, ``vision.area_model``). The machine code is kept in the user's cache folder, named
after the sources.
"""

from __future__ import annotations

import inspect
from pathlib import Path

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from estimation.codecache import jitted
from vision import (
    area,
    area_covariance,
    area_light,
    area_model,
    area_pixels,
    area_steps,
    lens,
    lines,
    plane,
    profile,
    refine,
    rings,
    robust,
    view,
)
from vision.area import AreaSolution, solve_area
from vision.camera import Camera
from vision.compiled import algebra, areas, circles, edges
from vision.lines import Edges, edges_of
from vision.refine import Solution, solve_profiles
from vision.rings import label_circles
from vision.view import View

Array = NDArray[np.float64]
Bool = NDArray[np.bool_]
Image = NDArray[np.uint8]
Int = NDArray[np.int64]

_MODULES = (
    area,
    area_covariance,
    area_light,
    area_model,
    area_pixels,
    area_steps,
    lens,
    lines,
    plane,
    profile,
    refine,
    rings,
    robust,
    view,
)
_LOOPS = (algebra, areas, circles, edges)
_NOT_INSIDE: set[object] = {
    *algebra.REPLACED, *areas.REPLACED, *circles.REPLACED, *edges.REPLACED, solve_profiles, label_circles, solve_area,
}  # fmt: skip
for _module in _MODULES:
    for _function in vars(_module).values():
        if (
            inspect.isfunction(_function)
            and _function.__module__ == _module.__name__
            and _function not in _NOT_INSIDE
        ):
            register_jitable(_function)

_SOURCES = [Path(inspect.getfile(m)) for m in (*_MODULES, *_LOOPS)] + [Path(__file__)]
_area = jitted(solve_area, _SOURCES)
_solve = jitted(solve_profiles, _SOURCES)
_label = jitted(label_circles, _SOURCES)


def solve(
    image: Image,
    view: View,
    centre: Array,
    kappa: float,
    tilt: Array,
    edges: Edges,
    tilt_sigma_rad: float,
    n_lines: int,
) -> Solution:
    """Do what ``vision.refine.solve_profiles`` does, for arrays of any layout with one compilation."""
    frozen = image.view()
    frozen.flags.writeable = False
    centre, tilt = np.array(centre, dtype=np.float64), np.array(tilt, dtype=np.float64)
    found: Solution = _solve(frozen, view, centre, kappa, tilt, edges, tilt_sigma_rad, n_lines)
    return found


def label(
    view: View, u: Array, v: Array, start: Int, hole: Bool, step_px: float, edges_m: Array, limit: int
) -> tuple[Array, Bool]:
    """Do what ``vision.rings.label_circles`` does."""
    found: tuple[Array, Bool] = _label(view, u, v, start, hole, step_px, edges_m, limit)
    return found


def compile_now() -> None:
    """Compile, or read from the cache, what has not been yet: so that no frame has to wait for it."""
    camera = Camera(16, 16, 10.0, 10.0)
    level = plane.LevelPlane(camera, np.eye(3)).view
    two = edges_of(np.array([2.0, 1.0]))
    solve(np.zeros((16, 16, 3), dtype=np.uint8), level, np.zeros(2), 0.1, np.zeros(2), two, 0.0, 8)
    u = np.arange(8.0)
    label(level, u, u, np.array([0, 8]), np.zeros(1, dtype=np.bool_), 2.0, two.radius_m, 4)
    solve_small(np.zeros((16, 16, 3), dtype=np.uint8), level, np.zeros(2), 0.1, two, 0.1, 0.0, 1, np.ones(1))


def solve_small(
    image: Image,
    view: View,
    centre: Array,
    kappa: float,
    edges: Edges,
    margin_m: float,
    tilt_sigma_rad: float,
    sectors: int,
    scales: Array,
) -> AreaSolution:
    """Do what ``vision.area.solve_area`` does."""
    frozen = image.view()
    frozen.flags.writeable = False
    centre = np.array(centre, dtype=np.float64)
    found: AreaSolution = _area(frozen, view, centre, kappa, edges, margin_m, tilt_sigma_rad, sectors, scales)
    return found
