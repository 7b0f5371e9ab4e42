"""A second renderer, independent of ``simulation.renderer``: rays, many for each pixel, in linear light.

It shares nothing with the other but the camera's calibration and the target's radii. Every pixel is the mean of
``samples`` x ``samples`` rays, of more where the target is small: the rays' lattice moves a circle's edge by some
n^-1.5 r^-0.5 px (n rays to a pixel, radius r), which with 8 rays is 0.002 px at 34 m, half of what noise does
there, and with 32 a tenth of it. Then a point spread (Gaussian, disc, or the sensor's own box alone), motion along a
straight path, photon and read noise, a tone curve and eight bits. The sea is a sum of random waves and speckle.
Slow, and plain; used to see that what the detector claims does not lean on one model of an edge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.camera import Camera
from vision.target import RingTarget

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


LATTICE, MAX_SAMPLES = 600.0, 32
"""Rays across a target's diameter, at least, and to a pixel's side, at most."""


@dataclass(frozen=True)
class Look:
    """How a picture comes about. Lengths in pixels; ``full_well`` electrons at brightness 255, ``read`` noise in
    units of brightness; ``light`` above one clips white.
    """

    spread_px: float = 0.5
    disc: bool = False
    motion_px: float = 0.0
    motion_angle_rad: float = 0.0
    full_well: float = 8000.0
    read: float = 1.5
    light: float = 1.0
    gamma: float = 1.0
    jpeg: int = 0
    samples: int = 8


class Raycast:
    """Draws one target through one camera without lens distortion."""

    def __init__(self, camera: Camera, target: RingTarget, seed: int = 5) -> None:
        self.camera, self.target = camera, target
        rng = np.random.default_rng(seed)
        self._waves = rng.normal(0.0, 1.0, (24, 2)) * rng.uniform(0.6, 6.0, (24, 1))
        self._phases = rng.uniform(0.0, 2.0 * np.pi, 24)

    def render(self, R_nc: Array, truth: Array, rng: np.random.Generator, look: Look) -> Image:
        """Return the picture (height, width, 3) uint8 BGR of a level target at P^c = ``truth``, attitude R_nc."""
        w, h = self.camera.width, self.camera.height
        diameter_px = 2.0 * self.target.edges_m[0] * self.camera.fx / float(np.linalg.norm(truth))
        n = max(look.samples, min(MAX_SAMPLES, math.ceil(LATTICE / diameter_px)))
        centre = R_nc @ truth
        v, u = np.mgrid[0:h, 0:w].astype(np.float64)
        light = self._colours(R_nc, centre, u, v, sea=True)
        u0, v0, u1, v1 = self._box(R_nc, truth)
        if u0 < u1 and v0 < v1:
            steps = (np.arange(n) + 0.5) / n - 0.5
            total = np.zeros((v1 - v0, u1 - u0, 3))
            for dv in steps:
                for du in steps:
                    total += self._colours(
                        R_nc, centre, u[v0:v1, u0:u1] + du, v[v0:v1, u0:u1] + dv, sea=False
                    )
            part = total / n**2
            light[v0:v1, u0:u1] = part
        light = light * look.light
        if look.motion_px > 0.0:
            light = cv2.filter2D(light, -1, _path(look), borderType=cv2.BORDER_REPLICATE)
        if look.spread_px > 0.0:
            light = cv2.filter2D(light, -1, _spread(look), borderType=cv2.BORDER_REPLICATE)
        electrons = rng.normal(light, np.sqrt(np.maximum(light, 0.0) * 255.0 / look.full_well))
        noisy = electrons + look.read * rng.standard_normal(light.shape)
        toned = 255.0 * (np.clip(noisy, 0.0, 255.0) / 255.0) ** (1.0 / look.gamma)
        image = np.clip(np.rint(toned), 0, 255).astype(np.uint8)
        if look.jpeg:
            image = cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, look.jpeg])[1], 1)
        return np.ascontiguousarray(image)

    def _box(self, R_nc: Array, truth: Array) -> tuple[int, int, int, int]:
        """Return the pixels that the board can touch."""
        half = 0.5 * self.target.side_m
        corners = np.array([[x, y, 0.0] for x in (-half, half) for y in (-half, half)])
        seen = truth + corners @ R_nc
        w, h = self.camera.width, self.camera.height
        if (seen[:, 2] < 0.05).any():
            return 0, 0, w, h
        u, v = self.camera.project(seen)
        return (
            max(0, int(u.min()) - 2),
            max(0, int(v.min()) - 2),
            min(w, int(u.max()) + 3),
            min(h, int(v.max()) + 3),
        )

    def _colours(self, R_nc: Array, centre: Array, u: Array, v: Array, sea: bool) -> Array:
        """Return linear brightness BGR 0..255 where the rays through (u, v) meet the target's plane."""
        x, y = (u - self.camera.centre[0]) / self.camera.fx, (v - self.camera.centre[1]) / self.camera.fy
        ray = [R_nc[i, 0] * x + R_nc[i, 1] * y + R_nc[i, 2] for i in range(3)]
        depth = np.maximum(ray[2], 0.02)
        north = centre[2] * ray[0] / depth - centre[0]
        east = centre[2] * ray[1] / depth - centre[1]
        colour = np.empty((*u.shape, 3))
        if sea:
            scale = 4.0 / max(float(centre[2]), 1.0)
            swell = sum(
                np.sin(scale * (a * north + b * east) + p)
                for (a, b), p in zip(self._waves, self._phases, strict=True)
            )
            speckle = np.sin(31.7 * scale * north + 3.1 * swell) * np.sin(27.1 * scale * east)
            colour[:] = (np.array([96.0, 74.0, 40.0]))[None, None] * (1.0 + 0.05 * swell + 0.08 * speckle)[
                ..., None
            ]
        else:
            colour[:] = (84.0, 70.0, 44.0)
        on_deck = (np.abs(north) < 1.2 * self.target.side_m) & (np.abs(east) < 0.9 * self.target.side_m)
        colour[on_deck] = (104.0, 108.0, 110.0)
        half = 0.5 * self.target.side_m
        colour[(np.abs(north) < half) & (np.abs(east) < half)] = (228.0, 230.0, 226.0)
        radius = np.hypot(north, east)
        inside = np.zeros(u.shape, dtype=np.intp)
        for edge in self.target.edges_m:
            inside += radius < edge
        colour[inside % 2 == 1] = (34.0, 26.0, 186.0)
        return colour


def _path(look: Look) -> Array:
    """Return the kernel of a straight motion, drawn by many points of it."""
    reach = math.ceil(0.5 * look.motion_px) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    for s in (np.arange(400) + 0.5) / 400 - 0.5:
        x = reach + s * look.motion_px * math.cos(look.motion_angle_rad)
        y = reach + s * look.motion_px * math.sin(look.motion_angle_rad)
        j, i = int(x), int(y)
        a, b = x - j, y - i
        for di, dj, share in (
            (0, 0, (1 - a) * (1 - b)),
            (0, 1, a * (1 - b)),
            (1, 0, (1 - a) * b),
            (1, 1, a * b),
        ):
            kernel[i + di, j + dj] += share / 400
    return kernel


def _spread(look: Look) -> Array:
    """Return the kernel of the lens: a Gaussian of 1-sigma ``spread_px``, or a disc of the same variance."""
    reach = math.ceil(3.5 * look.spread_px) + 1
    fine = (np.arange((2 * reach + 1) * 9) + 0.5) / 9 - 0.5 - reach
    r = np.hypot(*np.meshgrid(fine, fine))
    dense = (r < 2.0 * look.spread_px) * 1.0 if look.disc else np.exp(-0.5 * (r / look.spread_px) ** 2)
    kernel: Array = dense.reshape(2 * reach + 1, 9, 2 * reach + 1, 9).sum(axis=(1, 3))
    return kernel / kernel.sum()
