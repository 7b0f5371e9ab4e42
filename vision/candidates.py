"""Where in an image the target may be: candidates for the photometric fit, the cheapest and likeliest first."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vision.camera import Camera
from vision.ellipse import plane_rotations
from vision.plane import LevelPlane, rotation_to_level, rotation_vector_xy
from vision.redness import ratio_table, red_mask
from vision.rings import Contours, Hypothesis, Labeller, find_contours, halve, identify_circles
from vision.votes import identify_votes

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

MAX_DECK_TILT_RAD = 0.27


@dataclass(frozen=True, slots=True)
class Candidate:
    """A hypothesis, the plane it holds in, and that plane's tilt against the level (2,) [rad]."""

    hypothesis: Hypothesis
    plane: LevelPlane
    tilt: Array


class Search:
    """Finds candidates for a target of edges ``edges_m`` (k,) in images of one camera.

    ``labeller`` is ``vision.rings.label_circles`` or its compiled form.
    """

    def __init__(self, camera: Camera, edges_m: Array, labeller: Labeller) -> None:
        self._camera, self._edges, self._label = camera, edges_m, labeller
        self._tables = tuple(ratio_table(ratio) for ratio in (1.3, 1.8, 1.12))

    def contour_sets(self, image: Image) -> Iterator[Contours]:
        """Yield the boundaries of what is red: at half the resolution, in full, by a stricter and by a laxer rule."""
        table, strict, lax = self._tables
        yield find_contours(red_mask(halve(image), table), True)
        yield find_contours(red_mask(image, table), False)
        yield find_contours(red_mask(image, strict), False)
        yield find_contours(red_mask(image, lax), False)

    def candidates(
        self, contours: Contours, rotation: Array | None, rate: Array | None
    ) -> Iterator[list[Candidate]]:
        """Yield lists of candidates; ``rotation`` is the camera's attitude where it is known, ``rate`` (3,) its angular
        velocity.
        """
        if not len(contours):
            return
        level = np.zeros(2)
        if rotation is not None:
            plane = LevelPlane(self._camera, rotation, rate)
            yield self._circles(contours, plane, level)
            yield [Candidate(h, plane, level) for h in identify_votes(contours, plane, self._edges)]
        found: list[Candidate] = []
        for plane in self._ellipse_planes(contours, rate):
            tilt = level
            if rotation is not None:
                # A deck that is tilted against the level: its normal stays near the vertical.
                turn = rotation_to_level(rotation @ plane.rotation[2])
                tilt = rotation_vector_xy(turn)
                if np.hypot(*tilt) > MAX_DECK_TILT_RAD:
                    continue
                plane = LevelPlane(self._camera, turn @ rotation, rate)
            found += self._circles(contours, plane, tilt)
        yield sorted(found, key=lambda c: -c.hypothesis.score)

    def _circles(self, contours: Contours, plane: LevelPlane, tilt: Array) -> list[Candidate]:
        found = identify_circles(contours, plane.view, self._edges, self._label)
        return [Candidate(h, plane, tilt) for h in found]

    def _ellipse_planes(self, contours: Contours, rate: Array | None) -> Iterator[LevelPlane]:
        """Yield the planes in which one of the longest contours is a circle."""
        plane = LevelPlane(self._camera, np.eye(3), rate)
        x, y = plane.rays(contours.u, contours.v)
        inside = plane.inside(contours.u, contours.v, contours.step_px)
        count = np.diff(contours.start)
        for i in np.argsort(-count, kind="stable")[:6]:
            mine = slice(contours.start[i], contours.start[i + 1])
            ok = inside[mine]
            if ok.sum() >= 16:
                max_rms = 0.7 * contours.step_px / self._camera.fx
                for rotation in plane_rotations(x[mine][ok], y[mine][ok], max_rms):
                    yield LevelPlane(self._camera, rotation, rate)
