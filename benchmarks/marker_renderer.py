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
        offset = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
        fine_u = (np.arange(u0, u1)[:, None] + offset).ravel()
        fine_v = (np.arange(v0, v1)[:, None] + offset).ravel()
        black = np.empty((v1 - v0, u1 - u0))
        rotation, relative = deck.T @ attitude, deck.T @ position
        cell = self._side_m / len(self._bits)
        x, _ = self.camera.rays(fine_u, np.zeros_like(fine_u))
        for row in range(v1 - v0):
            _, y = self.camera.rays(np.zeros(SAMPLES), fine_v[row * SAMPLES : (row + 1) * SAMPLES])
            ray = [rotation[i, 0] * x + rotation[i, 1] * y[:, None] + rotation[i, 2] for i in range(3)]
            scale = -relative[2] / ray[2]
            i = np.floor((relative[1] + scale * ray[1] + 0.5 * self._side_m) / cell).astype(np.intp)
            j = np.floor((relative[0] + scale * ray[0] + 0.5 * self._side_m) / cell).astype(np.intp)
            n = len(self._bits)
            inside = (i >= 0) & (i < n) & (j >= 0) & (j < n)
            dark = inside & (self._bits[np.clip(i, 0, n - 1), np.clip(j, 0, n - 1)] == 0)
            black[row] = dark.reshape(SAMPLES, -1, SAMPLES).mean(axis=(0, 2))
        part = image[v0:v1, u0:u1]
        part += (black[..., None] * (BLACK_BGR * seen.light - part)).astype(np.float32)
        return where


def marker_bits(dictionary: int, marker_id: int) -> NDArray[np.int_]:
    """Return the cells of one of OpenCV's markers with its border, one for white."""
    book = cv2.aruco.getPredefinedDictionary(dictionary)
    side = int(book.markerSize) + 2
    return (cv2.aruco.generateImageMarker(book, marker_id, side) > 127).astype(np.int_)
