"""What the camera sees: a ring target on a deck on the sea, with exact geometry.

Every pixel's ray meets the deck's plane exactly (any camera, lens distortion and rolling shutter included),
and the edges of rings, board and deck are drawn by the exact area that they cover of a pixel
(``coverage.py``). Light is mixed where light mixes, before the camera's gamma, and clips at 255 where it is
too bright.

Order of effects: geometry, light level and colour cast, shadow, glare, bar, lens and motion blur, sensor
noise, gamma and clipping, JPEG. Colours are what the camera reports at light level 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simulation.coverage import PlaneMap, disc, square
from simulation.imaging import Colour, Conditions, Image, blur, develop, draw_clutter, draw_light, tone_table
from vision.camera import Camera, check_rotation
from vision.target import RingTarget

Array = NDArray[np.float64]

__all__ = ["Conditions", "Renderer", "Scene"]

_EDGE = 128
_CODES = 8192


@dataclass(frozen=True)
class Scene:
    """What stands still from frame to frame.

    ``deck_m`` is the side of the square deck [m] (2.4 target diameters where not given), ``freeboard_m`` its
    height above the sea. Colours are RGB 0..255. ``sea_contrast`` scales the waves and glints (0: a flat
    sea).
    """

    deck_m: float | None = None
    freeboard_m: float = 0.4
    deck_rgb: Colour = (118, 122, 120)
    sea_rgb: Colour = (38, 82, 120)
    sky_rgb: Colour = (170, 190, 210)
    sea_contrast: float = 1.0
    seed: int = 1

    def __post_init__(self) -> None:
        if self.deck_m is not None and not (math.isfinite(self.deck_m) and self.deck_m > 0.0):
            raise ValueError(f"deck_m: {self.deck_m!r} is not a positive length")
        if not (math.isfinite(self.freeboard_m) and self.freeboard_m >= 0.0):
            raise ValueError(f"freeboard_m: {self.freeboard_m!r} is not a height above the sea")


class Renderer:
    """Renders one target through one camera; keeps what does not change between frames."""

    def __init__(self, camera: Camera, target: RingTarget, scene: Scene | None = None) -> None:
        self.camera, self.target = camera, target
        self.scene = Scene() if scene is None else scene
        self.deck_m = 2.4 * target.diameter_m if self.scene.deck_m is None else self.scene.deck_m
        if self.deck_m < target.side_m:
            raise ValueError(f"deck_m: {self.deck_m} m of deck do not hold the board of {target.side_m} m")
        generator = np.random.default_rng(self.scene.seed)
        self._sea = _sea_texture(self.scene, generator)
        self._bank = generator.standard_normal(camera.width * camera.height * 3 + (1 << 20), dtype=np.float32)
        table = camera.ray_table
        self._slopes = np.gradient(table, axis=1), np.gradient(table, axis=0)
        self._coarse_rays = np.ascontiguousarray(table[::2, ::2])

    def render(
        self,
        R_nc: ArrayLike,
        position_m: ArrayLike,
        rng: np.random.Generator | None = None,
        conditions: Conditions | None = None,
        R_nd: ArrayLike | None = None,
        rate_c_radps: ArrayLike = (0.0, 0.0, 0.0),
    ) -> Image:
        """Return the picture, uint8 BGR of shape (height, width, 3).

        Parameters
        ----------
        R_nc
            Camera to NED, at the time of the middle row.
        position_m
            Camera less target centre in NED [m]; the third component is negative above the deck. What a
            detector should find is ``P_c = -R_nc.T @ position_m``.
        rng
            Source of noise and of distractors; None gives a picture without either.
        R_nd
            Deck to NED (deck axes x, y along its sides, z down into it); level and facing north where not
            given.
        rate_c_radps
            Angular rate of the camera in its own frame [rad/s], for a camera with read-out time.

        Raises ``ValueError`` naming the argument where a matrix is no rotation or the camera is not above the
        deck.
        """
        import cv2

        seen = Conditions() if conditions is None else conditions
        attitude = check_rotation(R_nc, "R_nc")
        deck = np.eye(3) if R_nd is None else check_rotation(R_nd, "R_nd")
        position, rate = np.asarray(position_m, dtype=np.float64), np.asarray(rate_c_radps, dtype=np.float64)
        if position.shape != (3,) or not np.isfinite(position).all():
            raise ValueError(f"position_m: {position_m!r} is not three finite numbers")
        if rate.shape != (3,) or not np.isfinite(rate).all():
            raise ValueError(f"rate_c_radps: {rate_c_radps!r} is not three finite numbers")
        if (deck.T @ position)[2] >= 0.0:
            raise ValueError("position_m: the camera is not above the deck (Z is negative above it, NED)")

        sea = self._sea_image(attitude, position)
        if rng is not None and (seen.distractors or seen.boats):
            draw_clutter(sea, seen, rng)
        image = cv2.LUT(sea, tone_table(seen))
        where = None
        if seen.target:
            where = self._draw_deck(image, attitude, position, deck, rate, seen)
        centre, radius_px = self._apparent(attitude, position)
        draw_light(image, seen, centre, radius_px)
        image = blur(image, seen, where)
        return develop(image, seen, self._bank, rng)

    def _apparent(self, attitude: Array, position: Array) -> tuple[tuple[float, float], float]:
        """Return the pixel of the target's centre and its apparent outer radius [px] (far off behind the
        camera).
        """
        centre = -attitude.T @ position
        u, v = self.camera.project(centre)
        radius = self.camera.fx * self.target.edges_m[0] / max(float(np.linalg.norm(position)), 1e-6)
        if not np.isfinite(u):
            return (-1e6, -1e6), radius
        return (float(u), float(v)), radius

    def _sea_image(self, attitude: Array, position: Array) -> Image:
        """Return the sea (and sky) alone, at half the resolution and enlarged: it has no sharp edges."""
        import cv2

        height = self.scene.freeboard_m - position[2]
        tile_m = 4.0 * 2.0 ** round(math.log2(max(height, 0.1)))
        plane = _plane_matrix(attitude, np.array([position[0], position[1], -height]))
        plane[:2] *= self._sea.shape[0] / tile_m
        rays = self._coarse_rays
        down = rays @ plane[2, :2].astype(np.float32) + np.float32(plane[2, 2])
        sky = down < 0.02
        points = cv2.perspectiveTransform(rays, plane)
        if sky.any():
            points[sky] = 0.0
        size = np.float32(self._sea.shape[0])
        points -= size * np.floor(points / size)
        sea = cv2.remap(self._sea, points, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        if sky.any():
            sea[sky] = self.scene.sky_rgb[::-1]
        image: Image = cv2.resize(
            sea, (self.camera.width, self.camera.height), interpolation=cv2.INTER_LINEAR
        )
        return image

    def _region(
        self, attitude: Array, position: Array, deck: Array, reach_px: float
    ) -> tuple[slice, slice] | None:
        """Return the rows and columns that the deck can touch, or None where it is out of the picture."""
        width, height = self.camera.width, self.camera.height
        side = np.linspace(-0.5, 0.5, 17) * self.deck_m
        half = np.full_like(side, 0.5 * self.deck_m)
        pairs = ((side, half), (side, -half), (half, side), (-half, side))
        outline = np.concatenate([np.stack(pair) for pair in pairs], axis=1)
        points = (deck[:, :2] @ outline).T - position
        seen = points @ attitude
        limit = 1.3 * float(np.abs(self.camera.ray_table).max())
        ratio = np.abs(seen[:, :2]) / np.maximum(seen[:, 2:], 1e-9)
        if (ratio > limit).any():
            return slice(0, height), slice(0, width)
        u, v = self.camera.project(seen)
        rows = slice(max(0, math.floor(v.min() - reach_px)), min(height, math.ceil(v.max() + reach_px) + 1))
        columns = slice(max(0, math.floor(u.min() - reach_px)), min(width, math.ceil(u.max() + reach_px) + 1))
        return (rows, columns) if rows.start < rows.stop and columns.start < columns.stop else None

    def _draw_deck(
        self,
        image: NDArray[np.float32],
        attitude: Array,
        position: Array,
        deck: Array,
        rate: Array,
        seen: Conditions,
    ) -> tuple[slice, slice] | None:
        """Draw deck, board and rings into ``image`` and return the rows and columns touched."""
        import cv2

        rolling = bool(self.camera.readout_s > 0.0 and np.any(rate))
        swing_rad = float(np.linalg.norm(rate)) * self.camera.readout_s if rolling else 0.0
        region = self._region(attitude, position, deck, 3.0 + 2.0 * self.camera.fx * swing_rad)
        if region is None:
            return None
        rows, columns = region
        relative = deck.T @ position
        if rolling:
            turned = attitude @ _rotations(rate, self.camera.row_time_s(np.arange(self.camera.height)))
            matrices = _plane_matrix(deck.T, relative) @ turned
        else:
            matrices = _plane_matrix(deck.T @ attitude, relative)[None]

        rays = self.camera.ray_table[rows, columns]
        points, in_front = _map_rays(rays, matrices[rows] if rolling else matrices)
        reach = 0.75 * self._pixel_on_deck_m(attitude, position, deck)
        code = self._classify(points, reach)
        code[~in_front] = 0
        palette = cv2.LUT(_palette(self.scene, self.target), tone_table(seen))[:, 0]
        flat = np.zeros((256, 1, 3), dtype=np.float32)
        flat[: len(palette), 0] = palette
        picture = image[rows, columns]
        inside = code & 0x7F
        filled = cv2.LUT(cv2.merge([inside, inside, inside]), flat)

        edge = np.flatnonzero(code & _EDGE)
        row, column = np.divmod(edge, code.shape[1])
        before = picture[row, column]
        cv2.copyTo(filled, inside, picture)
        if edge.size:
            plane = self._plane_map(row + rows.start, column + columns.start, matrices)
            shares = np.zeros((3, edge.size))
            shares[0], shares[1] = square(plane, self.deck_m), square(plane, self.target.side_m)
            for k, radius in enumerate(self.target.edges_m):
                shares[2] += (1.0 - 2.0 * (k % 2)) * disc(plane, radius)
            mixed = before * (1.0 - shares[0])[:, None]
            mixed += np.outer(shares[0] - shares[1], palette[1])
            mixed += np.outer(shares[1] - shares[2], palette[2]) + np.outer(shares[2], palette[3])
            picture[row, column] = mixed
        image[rows, columns] = picture
        return region

    def _pixel_on_deck_m(self, attitude: Array, position: Array, deck: Array) -> float:
        """Return the largest length on the deck that one pixel's side covers where the deck is in the
        picture.
        """
        side = np.linspace(-0.5, 0.5, 7) * self.deck_m
        x, y = (axis.ravel() for axis in np.meshgrid(side, side))
        seen = (deck[:, :2] @ np.stack([x, y])).T @ attitude - position @ attitude
        seen = seen[seen[:, 2] > 1e-3]
        limit = 1.2 * float(np.abs(self.camera.ray_table).max())
        ray = seen[:, :2] / seen[:, 2:]
        visible = (np.abs(ray) < limit).all(axis=1)
        if not visible.any():
            return float(np.linalg.norm(position)) / self.camera.fx * 4.0
        seen = seen[visible]
        length = np.linalg.norm(seen, axis=1)
        slant = np.abs(seen @ (attitude.T @ deck[:, 2])) / length
        stretch = float(np.abs(self._slopes[0]).max() * self.camera.fx)
        longest = float((length / np.maximum(slant, 0.05)).max())
        return longest / min(self.camera.fx, self.camera.fy) * max(1.1, stretch)

    def _classify(self, points: NDArray[np.float32], reach_m: float) -> NDArray[np.uint8]:
        """Return what each point of the deck's plane is: 0 sea, 1 deck, 2 board, 3 red; plus _EDGE near an
        edge.
        """
        import cv2

        x, y = cv2.split(points)
        scale = np.float32((_CODES - 1) / (0.5 * self.deck_m + 2.0 * reach_m))
        bins = (np.arange(_CODES) + 0.5) / scale
        reach_m += 1.0 / float(scale)
        straight = np.where(bins < 0.5 * self.deck_m, 1, 0)
        straight[bins < 0.5 * self.target.side_m] = 2
        for side in (self.deck_m, self.target.side_m):
            straight[np.abs(bins - 0.5 * side) < reach_m] |= _EDGE
        round_ = self.target.is_red(bins).astype(np.int64)
        for radius in self.target.edges_m:
            round_[np.abs(bins - radius) < reach_m] |= _EDGE
        largest = np.float32(_CODES - 1)
        square_bin = np.minimum(cv2.max(cv2.absdiff(x, 0.0), cv2.absdiff(y, 0.0)) * scale, largest).astype(
            np.uint16
        )
        ring_bin = np.minimum(cv2.magnitude(x, y) * scale, largest).astype(np.uint16)
        code: NDArray[np.uint8] = np.take(straight.astype(np.uint8), square_bin)
        code |= np.take(round_.astype(np.uint8), ring_bin)
        return code

    def _plane_map(self, row: NDArray[np.intp], column: NDArray[np.intp], matrices: Array) -> PlaneMap:
        """Return the exact map from some pixels to the deck's plane."""
        if self.camera.distortion:
            ray = self.camera.ray_table[row, column].astype(np.float64).T
            along_u, along_v = (slope[row, column].astype(np.float64).T for slope in self._slopes)
        else:
            ray = np.stack(self.camera.rays(column, row))
            along_u, along_v = (
                np.array([[1.0 / self.camera.fx], [0.0]]),
                np.array([[0.0], [1.0 / self.camera.fy]]),
            )
        if len(matrices) == 1:
            m = matrices[0]
            return PlaneMap(m[:, :2] @ ray + m[:, 2:], m[:, :2] @ along_u, m[:, :2] @ along_v)
        m, turned = matrices[row], np.gradient(matrices, axis=0)[row]
        ones = np.concatenate([ray, np.ones((1, row.size))])
        value = np.einsum("nij,jn->in", m, ones)
        by_column = np.einsum("nij,jn->in", m[:, :, :2], np.broadcast_to(along_u, ray.shape))
        by_row = np.einsum("nij,jn->in", m[:, :, :2], np.broadcast_to(along_v, ray.shape))
        return PlaneMap(value, by_column, by_row + np.einsum("nij,jn->in", turned, ones))


def _plane_matrix(attitude: Array, position: Array) -> Array:
    """Return M such that a ray d meets the plane z = 0 at (n0 / n2, n1 / n2), n = M d.

    ``attitude`` takes rays to the plane's axes (z down), ``position`` is the camera's in them (z negative
    above).
    """
    x, y, z = position
    lift = np.array([[-z, 0.0, x], [0.0, -z, y], [0.0, 0.0, 1.0]])
    matrix: Array = lift @ attitude
    return matrix


def _map_rays(rays: NDArray[np.float32], matrices: Array) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Map rays (rows, columns, 2) to the plane, by one matrix or by one for each row; also: which meet it."""
    import cv2

    if len(matrices) == 1:
        m = matrices[0].astype(np.float32)
        down = rays[..., 0] * m[2, 0] + (rays[..., 1] * m[2, 1] + m[2, 2])
        return cv2.perspectiveTransform(np.ascontiguousarray(rays), matrices[0]), down > 1e-6
    m = matrices.astype(np.float32)[:, None]
    x, y = rays[..., 0], rays[..., 1]
    n = [m[..., i, 0] * x + m[..., i, 1] * y + m[..., i, 2] for i in range(3)]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([n[0] / n[2], n[1] / n[2]], axis=-1), n[2] > 1e-6


def _rotations(rate_radps: Array, times_s: Array) -> Array:
    """Return the rotations after turning at a constant rate for some times, shape (times, 3, 3)
    (Rodrigues).
    """
    speed = float(np.linalg.norm(rate_radps))
    x, y, z = rate_radps / speed
    axis = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = (speed * times_s)[:, None, None]
    return np.asarray(np.eye(3) + np.sin(angle) * axis + (1.0 - np.cos(angle)) * (axis @ axis))


def _palette(scene: Scene, target: RingTarget) -> Image:
    """Return the colours of codes 0..3 as BGR, shape (4, 1, 3)."""
    colours = (scene.sea_rgb, scene.deck_rgb, target.white_rgb, target.red_rgb)
    return np.array([colour[::-1] for colour in colours], dtype=np.uint8)[:, None]


def _sea_texture(scene: Scene, generator: np.random.Generator, size: int = 1024) -> Image:
    """Return a tile of sea, BGR, that continues across its borders: waves of all lengths, some glints."""
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :]) * size
    spectrum = np.fft.rfft2(generator.standard_normal((size, size))) / np.maximum(frequency, 4.0) ** 1.2
    spectrum[frequency > size / 6.0] = 0.0
    waves = np.fft.irfft2(spectrum, s=(size, size))
    waves /= waves.std()
    shade = np.array(scene.sea_rgb[::-1]) * (1.0 + 0.13 * scene.sea_contrast * waves[..., None])
    glint = np.clip(waves - 2.3, 0.0, None)[..., None] * 90.0 * scene.sea_contrast
    return np.clip(shade + glint, 0, 255).astype(np.uint8)
