"""Camera calibration from pictures of a flat board: a chessboard, or a ChArUco board (which may be partly in
view).

The result says how much it can be trusted: the residual, the standard deviation of every parameter from the
residuals, the same for the focal length from leaving out one picture at a time (which also feels what the
first one does not: bent boards, blurred pictures, too few views), and a picture of where in the image there
were corners at all.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vision.camera import Camera

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""Names of the calibrated parameters, in OpenCV's order."""

MIN_VIEWS = 4
_GRID = (8, 6)


@dataclass(frozen=True)
class Chessboard:
    """A chessboard with ``columns`` x ``rows`` *inner* corners and squares of ``square_m`` [m]."""

    columns: int
    rows: int
    square_m: float

    def __post_init__(self) -> None:
        if self.columns < 3 or self.rows < 3:
            raise ValueError(f"columns, rows: {self.columns} x {self.rows} inner corners; at least 3 x 3")
        _positive("square_m", self.square_m)


@dataclass(frozen=True)
class Charuco:
    """A ChArUco board with ``columns`` x ``rows`` *squares* of ``square_m`` and markers of ``marker_m``
    [m].
    """

    columns: int
    rows: int
    square_m: float
    marker_m: float
    dictionary: str = "DICT_4X4_50"

    def __post_init__(self) -> None:
        if self.columns < 3 or self.rows < 3:
            raise ValueError(f"columns, rows: {self.columns} x {self.rows} squares; at least 3 x 3")
        _positive("square_m", self.square_m)
        _positive("marker_m", self.marker_m)
        if self.marker_m >= self.square_m:
            raise ValueError(
                f"marker_m: markers of {self.marker_m} m do not fit into squares of {self.square_m} m"
            )
        self.board()

    def board(self) -> Any:
        """Return OpenCV's board; ``ValueError`` where the dictionary is unknown or has too few markers."""
        import cv2

        number = getattr(cv2.aruco, self.dictionary, None)
        if not self.dictionary.startswith("DICT_") or number is None:
            raise ValueError(f"dictionary: no ArUco dictionary {self.dictionary!r}; for example DICT_4X4_50")
        dictionary = cv2.aruco.getPredefinedDictionary(number)
        if self.columns * self.rows // 2 > len(dictionary.bytesList):
            raise ValueError(
                f"dictionary: {self.dictionary} has too few markers for {self.columns} x {self.rows}"
            )
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_m, self.marker_m, dictionary)


@dataclass(frozen=True)
class View:
    """The corners found in one picture: pixels (n, 2) and their places on the board (n, 3) [m]."""

    name: str
    pixels: NDArray[np.float32]
    board_m: NDArray[np.float32]


@dataclass(frozen=True)
class Calibration:
    """A calibrated camera and its trustworthiness.

    ``sigma`` has a standard deviation for each of ``PARAMETERS``, ``focal_spread_px`` is that of the mean
    focal length by leaving out one view at a time (jackknife). ``rms_px`` is over all corners used,
    ``view_rms_px`` per view. ``skipped`` tells why a picture was not used. ``coverage`` is the share of the
    image's 8 x 6 cells that hold corners.
    """

    camera: Camera
    sigma: Mapping[str, float]
    focal_spread_px: float
    rms_px: float
    view_rms_px: Mapping[str, float]
    skipped: Mapping[str, str]
    coverage: float
    views: tuple[View, ...]

    @property
    def focal_sigma(self) -> float:
        """Relative standard deviation of the focal length, the larger of the two estimates: it is that of
        all distances.
        """
        formal = 0.5 * (self.sigma["fx"] + self.sigma["fy"])
        return max(formal, self.focal_spread_px) / self.camera.fx

    def summary(self) -> str:
        """Return the result as lines of text."""
        c = self.camera
        values = dict(zip(PARAMETERS, (c.fx, c.fy, *c.centre, *_five(c.distortion)), strict=True))
        corners = sum(len(view.pixels) for view in self.views)
        lines = [f"{len(self.views)} views, {corners} corners, rms {self.rms_px:.3f} px"]
        lines += [f"  {name:>3} = {values[name]:10.4f} +- {self.sigma[name]:.4f}" for name in PARAMETERS]
        lines.append(
            f"focal length known to {100 * self.focal_sigma:.2f} % (1 sigma), and with it every distance"
        )
        lines.append(f"corners in {100 * self.coverage:.0f} % of the image")
        if self.coverage < 0.7:
            lines.append("  elsewhere the lens model is a guess: add pictures with the board at the borders")
        lines += [f"not used: {name}: {reason}" for name, reason in self.skipped.items()]
        return "\n".join(lines)


def find_corners(
    image: Image, board: Chessboard | Charuco
) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    """Return the corners' pixels (n, 2) and places on the board (n, 3), or None where the board is not
    found.
    """
    import cv2

    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if isinstance(board, Charuco):
        corners, ids, _, _ = cv2.aruco.CharucoDetector(board.board()).detectBoard(grey)
        if ids is None or np.size(ids) < 6:
            return None
        places = np.asarray(board.board().getChessboardCorners(), dtype=np.float32)
        return np.asarray(corners, dtype=np.float32).reshape(-1, 2), places[np.asarray(ids).ravel()]
    size = (board.columns, board.rows)
    found, corners = cv2.findChessboardCornersSB(
        grey, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
    )
    if not found:
        found, corners = cv2.findChessboardCorners(grey, size)
        if not found:
            return None
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)
        corners = cv2.cornerSubPix(grey, corners, (5, 5), (-1, -1), stop)
    place = np.zeros((board.columns * board.rows, 3), dtype=np.float32)
    place[:, :2] = np.mgrid[: board.columns, : board.rows].T.reshape(-1, 2) * np.float32(board.square_m)
    return np.asarray(corners, dtype=np.float32).reshape(-1, 2), place


def calibrate(
    images: Iterable[tuple[str, Image]], board: Chessboard | Charuco, readout_s: float = 0.0
) -> Calibration:
    """Return the camera that took these pictures, given as pairs of name and image (uint8, grey or BGR).

    Views with more than three times the median residual are left out, once. ``ValueError`` where pictures
    differ in size, are not uint8, or fewer than four show the board.
    """
    size: tuple[int, int] | None = None
    views: list[View] = []
    skipped: dict[str, str] = {}
    for name, image in images:
        if (
            not isinstance(image, np.ndarray)
            or image.dtype != np.uint8
            or image.ndim not in (2, 3)
            or not image.size
        ):
            raise ValueError(f"images: {name} is not a picture of 8 bits a channel")
        if size is None:
            size = (image.shape[1], image.shape[0])
        if (image.shape[1], image.shape[0]) != size:
            raise ValueError(
                f"images: {name} is {image.shape[1]}x{image.shape[0]}, the ones before are "
                f"{size[0]}x{size[1]}; calibrate every mode of a camera by itself"
            )
        corners = find_corners(image, board)
        if corners is None:
            skipped[name] = "the board was not found"
        else:
            views.append(View(name, *corners))
    if size is None or len(views) < MIN_VIEWS:
        raise ValueError(
            f"images: the board was found in {len(views)} pictures, {MIN_VIEWS} or more are needed; "
            "are the numbers of corners right (inner corners of a chessboard, squares of a ChArUco board)?"
        )
    rms, k, d, sigma, per_view = _solve(views, size)
    bad = per_view > 3.0 * float(np.median(per_view))
    if bad.any() and np.count_nonzero(~bad) >= MIN_VIEWS:
        for view, residual in zip(views, per_view, strict=True):
            if residual > 3.0 * float(np.median(per_view)):
                skipped[view.name] = f"residual {residual:.2f} px, more than three times the others'"
        views = [view for view, is_bad in zip(views, bad, strict=True) if not is_bad]
        rms, k, d, sigma, per_view = _solve(views, size)

    focal = []
    for left_out in range(len(views) if len(views) > MIN_VIEWS else 0):
        _, other, _, _, _ = _solve(views[:left_out] + views[left_out + 1 :], size)
        focal.append(0.5 * (other[0, 0] + other[1, 1]))
    n = len(focal)
    spread = (
        math.sqrt((n - 1) / n * float(((np.array(focal) - np.mean(focal)) ** 2).sum())) if n else math.inf
    )
    camera = Camera.from_matrix(size[0], size[1], k, tuple(float(c) for c in d), readout_s)
    return Calibration(
        camera,
        dict(zip(PARAMETERS, (float(s) for s in sigma), strict=True)),
        spread,
        rms,
        {view.name: float(residual) for view, residual in zip(views, per_view, strict=True)},
        skipped,
        float((_cells(views, size) > 0).mean()),
        tuple(views),
    )


def coverage_picture(calibration: Calibration) -> Image:
    """Return a picture of the image plane: cells shaded by how many corners fell into them, corners as
    dots.
    """
    import cv2

    size = (calibration.camera.width, calibration.camera.height)
    cells = _cells(list(calibration.views), size)
    shade = 255.0 - 150.0 * np.minimum(cells / max(1.0, float(np.median(cells[cells > 0]))), 1.0)
    level = cv2.resize(shade.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    picture: Image = np.stack([np.full_like(level, 235), level, level], axis=-1)
    picture[level == 255] = (235, 235, 255)
    for view in calibration.views:
        for u, v in view.pixels:
            cv2.circle(picture, (round(float(u)), round(float(v))), 2, (120, 40, 20), -1, cv2.LINE_AA)
    centre = tuple(round(c) for c in calibration.camera.centre)
    cv2.drawMarker(picture, centre, (0, 0, 200), cv2.MARKER_CROSS, 20, 1, cv2.LINE_AA)
    text = f"{len(calibration.views)} views, {100 * calibration.coverage:.0f} % covered"
    text += f", rms {calibration.rms_px:.2f} px"
    cv2.putText(picture, text, (8, size[1] - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (40, 40, 40), 1, cv2.LINE_AA)
    return picture


def _solve(views: list[View], size: tuple[int, int]) -> tuple[float, Array, Array, Array, Array]:
    """Return rms, K, the five coefficients, standard deviations of ``PARAMETERS`` and the residual of each
    view.
    """
    import cv2

    result = cv2.calibrateCameraExtended(
        [view.board_m for view in views], [view.pixels[:, None] for view in views], size, None, None
    )
    rms, k, d, _, _, deviation, _, per_view = result
    return (
        float(rms),
        np.asarray(k),
        np.ravel(d)[:5],
        np.ravel(deviation)[: len(PARAMETERS)],
        np.ravel(per_view),
    )


def _cells(views: list[View], size: tuple[int, int]) -> Array:
    """Return the number of corners in each cell of the image, shape (6, 8)."""
    pixels = np.concatenate([view.pixels for view in views])
    edges = [np.linspace(-0.5, side - 0.5, cells + 1) for side, cells in zip(size, _GRID, strict=True)]
    count, _, _ = np.histogram2d(pixels[:, 1], pixels[:, 0], bins=(edges[1], edges[0]))
    return np.asarray(count)


def _five(distortion: tuple[float, ...]) -> tuple[float, ...]:
    """Return the first five distortion coefficients, missing ones zero."""
    return (distortion + (0.0,) * 5)[:5]


def _positive(name: str, value: float) -> None:
    """Raise ``ValueError`` where a length is not positive."""
    if not (math.isfinite(value) and value > 0.0):
        raise ValueError(f"{name}: {value!r} is not a positive length in metres")
