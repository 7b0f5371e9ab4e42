"""Square markers (ArUco, AprilTag) through the renderer that draws the rings: same deck, light, blur and
noise."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from simulation.renderer import Conditions, Renderer, Scene
from vision.camera import Camera
from vision.target import RingTarget

Array = NDArray[np.float64]
BLACK_BGR = np.array([28.0, 25.0, 25.0])
SAMPLES = 8


class MarkerRenderer(Renderer):
    """Draws a marker of ``side_m`` (its black border's outside) where the rings would be.

    ``bits`` (n, n) is one where the marker is white. The share of a pixel that is black is the mean of 8x8
    rays.
    """

    def __init__(self, camera: Camera, bits: NDArray[np.int_], side_m: float, board_m: float) -> None:
        dot = RingTarget((1e-4, 5e-5), board_m=board_m)
        super().__init__(camera, dot, Scene(deck_m=2.4 * side_m))
        self._bits, self._side_m = bits, side_m

    def _draw_deck(
        self,
        image: NDArray[np.float32],
        attitude: Array,
        position: Array,
        deck: Array,
        rate: Array,
        seen: Conditions,
    ) -> Any:
        where = super()._draw_deck(image, attitude, position, deck, rate, seen)
        corners = 0.5 * self._side_m * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float)
        u, v = self.camera.project((corners @ deck.T - position) @ attitude)
        w, h = self.camera.width, self.camera.height
        if not np.isfinite(u).all():
            u, v = np.array([0.0, w]), np.array([0.0, h])
        u0, u1 = int(max(0, u.min() - 1)), int(min(w, u.max() + 2))
        v0, v1 = int(max(0, v.min() - 1)), int(min(h, v.max() + 2))
        if u0 >= u1 or v0 >= v1:
            return where
        rotation, relative = deck.T @ attitude, deck.T @ position
        # A pixel whose corners lie in one cell is of one colour; the others are sampled.
        corner = self._cells(
            rotation, relative, np.arange(u0, u1 + 1) - 0.5, np.arange(v0, v1 + 1)[:, None] - 0.5
        )
        first = corner[:-1, :-1]
        mixed = (corner[:-1, 1:] != first) | (corner[1:, :-1] != first) | (corner[1:, 1:] != first)
        # The marker's own corner may lie inside a pixel whose corners all lie beside it.
        mixed = cv2.dilate(mixed.astype(np.uint8), np.ones((3, 3), dtype=np.uint8)) > 0
        black = self._is_black(first).astype(np.float64)
        row, column = np.nonzero(mixed)
        offset = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
        share = np.zeros(len(row))
        for dv in offset:
            for du in offset:
                cells = self._cells(rotation, relative, u0 + column + du, v0 + row + dv)
                share += self._is_black(cells)
        black[row, column] = share / SAMPLES**2
        part = image[v0:v1, u0:u1]
        part += (black[..., None] * (BLACK_BGR * seen.light - part)).astype(np.float32)
        return where

    def _cells(self, rotation: Array, relative: Array, u: Array, v: Array) -> NDArray[np.intp]:
        """Return the number of the marker's cell that pixels show, -1 beside it."""
        x, y = self.camera.rays(*np.broadcast_arrays(u, v))
        ray = [rotation[i, 0] * x + rotation[i, 1] * y + rotation[i, 2] for i in range(3)]
        scale = -relative[2] / ray[2]
        n = len(self._bits)
        cell = self._side_m / n
        i = np.floor((relative[1] + scale * ray[1] + 0.5 * self._side_m) / cell).astype(np.intp)
        j = np.floor((relative[0] + scale * ray[0] + 0.5 * self._side_m) / cell).astype(np.intp)
        inside = (i >= 0) & (i < n) & (j >= 0) & (j < n)
        return np.where(inside, i * n + j, -1)

    def _is_black(self, cell: NDArray[np.intp]) -> NDArray[np.bool_]:
        dark: NDArray[np.bool_] = (cell >= 0) & (self._bits.ravel()[np.maximum(cell, 0)] == 0)
        return dark


def marker_bits(dictionary: int, marker_id: int) -> NDArray[np.int_]:
    """Return the cells of one of OpenCV's markers with its border, one for white."""
    book = cv2.aruco.getPredefinedDictionary(dictionary)
    side = int(book.markerSize) + 2
    return (cv2.aruco.generateImageMarker(book, marker_id, side) > 127).astype(np.int_)
