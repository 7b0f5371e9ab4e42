"""How a picture comes about once it is known what is where: clutter, light, blur, noise, gamma and
compression.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]


@dataclass(frozen=True)
class Conditions:
    """What differs from frame to frame. The defaults are a sharp daylight picture with a little noise.

    Lengths "of the target" are in its outer radius as it appears at its centre, angles in the image are rad
    from the u axis towards v.

    Parameters
    ----------
    light
        Light level; whites clip at 255 above about 1.04.
    cast_rgb
        Factors on R, G, B: (1.2, 1, 0.7) is warm.
    gamma
        2.2 mixes light linearly and then encodes it; 1 is a camera that reports light itself.
    shadow, shadow_offset, shadow_angle_rad
        Factor on the light in the shaded half plane (1: none), distance of its edge from the target's centre
        (of the target), direction in which the shadow lies.
    glare, glare_radius, glare_offset
        Peak of a Gaussian blob of white light added (1: full white), its sigma and its place (of the target).
    bar_px, bar_offset, bar_angle_rad, bar_rgb
        Width of a straight occluding bar across the picture (0: none), its middle's distance from the
        target's centre (of the target), its direction, its colour.
    defocus_px
        Sigma of the lens's blur.
    motion_px, motion_angle_rad
        Length and direction of motion blur.
    read_noise, shot_noise
        Noise in units of 8 bits: variance = read_noise**2 + shot_noise * value.
    distractors, boats
        Number of red discs, ellipses and rings, and of boats, drawn at random places on the sea.
    jpeg_quality
        0..100, None for no compression.
    target
        False leaves the deck out altogether.
    """

    light: float = 1.0
    cast_rgb: tuple[float, float, float] = (1.0, 1.0, 1.0)
    gamma: float = 1.0
    shadow: float = 1.0
    shadow_offset: float = 0.0
    shadow_angle_rad: float = 0.5
    glare: float = 0.0
    glare_radius: float = 0.25
    glare_offset: tuple[float, float] = (0.3, 0.2)
    bar_px: float = 0.0
    bar_offset: float = 0.3
    bar_angle_rad: float = 0.4
    bar_rgb: Colour = (25, 25, 28)
    defocus_px: float = 0.5
    motion_px: float = 0.0
    motion_angle_rad: float = 0.0
    read_noise: float = 2.0
    shot_noise: float = 0.0
    distractors: int = 0
    boats: int = 0
    jpeg_quality: int | None = None
    target: bool = True

    def __post_init__(self) -> None:
        for name in ("light", "gamma"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise ValueError(f"{name}: {getattr(self, name)!r} is not positive")
        for name in (
            "shadow",
            "glare",
            "glare_radius",
            "bar_px",
            "defocus_px",
            "motion_px",
            "read_noise",
            "shot_noise",
        ):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise ValueError(f"{name}: {getattr(self, name)!r} is negative or not finite")
        if len(self.cast_rgb) != 3 or not all(math.isfinite(c) and c >= 0.0 for c in self.cast_rgb):
            raise ValueError(f"cast_rgb: {self.cast_rgb!r} is not three factors")
        if self.jpeg_quality is not None and not 0 <= self.jpeg_quality <= 100:
            raise ValueError(f"jpeg_quality: {self.jpeg_quality!r} is not from 0 to 100")


def tone_table(seen: Conditions) -> NDArray[np.float32]:
    """Return the table from colours 0..255 to light (255: full scale) under this light and cast, (256, 1,
    3).
    """
    level = 255.0 * (np.arange(256) / 255.0) ** seen.gamma
    factors = seen.light * np.array(seen.cast_rgb[::-1])
    return (level[:, None, None] * factors).astype(np.float32)


def draw_clutter(sea: Image, seen: Conditions, rng: np.random.Generator) -> None:
    """Draw red discs, ellipses, rings and boats at random places, in place."""
    import cv2

    height, width = sea.shape[:2]
    for _ in range(seen.distractors):
        kind = rng.choice(("disc", "ellipse", "ring"))
        centre = (int(rng.integers(0, width)), int(rng.integers(0, height)))
        size = int(rng.uniform(4.0, 0.12 * width))
        other = int(size * rng.uniform(0.3, 0.9)) if kind == "ellipse" else size
        red = int(rng.integers(120, 256))
        colour = (int(red * rng.uniform(0.05, 0.4)), int(red * rng.uniform(0.05, 0.4)), red)
        outline = cv2.ellipse2Poly(centre, (size, other), int(rng.integers(0, 180)), 0, 360, 3)
        if kind == "ring":
            thickness = max(2, int(size * rng.uniform(0.1, 0.5)))
            cv2.polylines(sea, [outline], True, colour, thickness, cv2.LINE_AA)
        else:
            cv2.fillPoly(sea, [outline], colour, cv2.LINE_AA)
    for _ in range(seen.boats):
        length = rng.uniform(0.08, 0.35) * width
        hull = np.array([[-0.5, -0.14], [0.3, -0.14], [0.5, 0.0], [0.3, 0.14], [-0.5, 0.14]]) * length
        stripe = np.array([[-0.45, -0.05], [0.2, -0.05], [0.2, 0.05], [-0.45, 0.05]]) * length
        angle = rng.uniform(0.0, 2.0 * math.pi)
        turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        place = rng.uniform(0.0, 1.0, 2) * (width, height)
        for shape, colour in ((hull, (225, 228, 230)), (stripe, (30, 25, 190))):
            outline = np.rint((shape @ turn.T + place) * 16).astype(np.int32)
            cv2.fillPoly(sea, [outline], colour, cv2.LINE_AA, 4)


def draw_light(
    image: NDArray[np.float32], seen: Conditions, centre: tuple[float, float], radius_px: float
) -> None:
    """Apply shadow, glare and bar, in place. Their edges are anti-aliased over one pixel."""
    height, width = image.shape[:2]
    u = (np.arange(width) - centre[0]).astype(np.float32)[None, :]
    v = (np.arange(height) - centre[1]).astype(np.float32)[:, None]
    if seen.shadow != 1.0:
        c, s = math.cos(seen.shadow_angle_rad), math.sin(seen.shadow_angle_rad)
        depth = u * np.float32(c) + v * np.float32(s) - np.float32(seen.shadow_offset * radius_px)
        image *= 1.0 + np.float32(seen.shadow - 1.0) * np.clip(depth + 0.5, 0.0, 1.0)[..., None]
    if seen.glare > 0.0:
        du, dv = u - seen.glare_offset[0] * radius_px, v - seen.glare_offset[1] * radius_px
        sigma = max(seen.glare_radius * radius_px, 0.5)
        blob = np.exp(-(du**2) / (2.0 * sigma**2)) * np.exp(-(dv**2) / (2.0 * sigma**2))
        image += (255.0 * seen.glare * blob).astype(np.float32)[..., None]
    if seen.bar_px > 0.0:
        c, s = math.cos(seen.bar_angle_rad), math.sin(seen.bar_angle_rad)
        off = np.abs(v * np.float32(c) - u * np.float32(s) - np.float32(seen.bar_offset * radius_px))
        share = np.clip(0.5 * seen.bar_px - off + 0.5, 0.0, 1.0)[..., None].astype(np.float32)
        colour = tone_table(seen)[list(seen.bar_rgb[::-1]), 0, [0, 1, 2]]
        image += share * (colour - image)


def blur(
    image: NDArray[np.float32], seen: Conditions, where: tuple[slice, slice] | None
) -> NDArray[np.float32]:
    """Apply the lens's and the motion's blur; a lens blur below a pixel only where there are sharp edges."""
    import cv2

    if seen.defocus_px > 0.0:
        width = 2 * math.ceil(3.5 * seen.defocus_px) + 1
        plain = seen.defocus_px <= 1.0 and seen.bar_px == 0.0 and seen.shadow == 1.0
        plain = plain and not seen.distractors and not seen.boats
        if plain and where is not None:
            part = image[where]
            image[where] = cv2.GaussianBlur(
                part, (width, width), seen.defocus_px, borderType=cv2.BORDER_REPLICATE
            )
        elif not plain:
            image = cv2.GaussianBlur(image, (width, width), seen.defocus_px, borderType=cv2.BORDER_REPLICATE)
    if seen.motion_px > 0.0:
        image = cv2.filter2D(
            image, -1, _motion_kernel(seen.motion_px, seen.motion_angle_rad), borderType=cv2.BORDER_REPLICATE
        )
    return image


def _motion_kernel(length_px: float, angle_rad: float) -> NDArray[np.float32]:
    """Return the picture of a point that moves evenly along a line, by bilinear splatting; its sum is 1."""
    half = math.ceil(length_px / 2.0) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), dtype=np.float32)
    for along in (np.arange(400) + 0.5) / 400.0 - 0.5:
        u, v = half + along * length_px * math.cos(angle_rad), half + along * length_px * math.sin(angle_rad)
        i, j = math.floor(v), math.floor(u)
        for di, wi in ((0, 1.0 - v + i), (1, v - i)):
            for dj, wj in ((0, 1.0 - u + j), (1, u - j)):
                kernel[i + di, j + dj] += wi * wj
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)


def develop(
    image: NDArray[np.float32], seen: Conditions, bank: NDArray[np.float32], rng: np.random.Generator | None
) -> Image:
    """Return the picture of this light (255: full scale): noise from a bank of normal deviates, gamma,
    clipping, JPEG.

    Without ``rng`` there is no noise. The bank is longer than a picture and is read from a random place.
    """
    import cv2

    if rng is not None and (seen.read_noise > 0.0 or seen.shot_noise > 0.0):
        start = int(rng.integers(0, bank.size - image.size + 1))
        noise = bank[start : start + image.size].reshape(image.shape)
        sign = float(rng.integers(0, 2) * 2 - 1)
        if seen.shot_noise > 0.0:
            variance = cv2.max(image, 0.0) * np.float32(seen.shot_noise) + np.float32(seen.read_noise**2)
            image = image + cv2.sqrt(variance) * noise * np.float32(sign)
        else:
            image = cv2.scaleAdd(noise, sign * seen.read_noise, image)
    if seen.gamma == 1.0:
        picture: Image = cv2.add(image, 0.0, dtype=cv2.CV_8U)
    else:
        levels = np.arange(4096) / 4095.0
        encoded = np.rint(255.0 * levels ** (1.0 / seen.gamma)).astype(np.uint8)
        picture = encoded[np.clip(image * np.float32(4095.0 / 255.0) + 0.5, 0, 4095).astype(np.uint16)]
    if seen.jpeg_quality is not None:
        done, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, int(seen.jpeg_quality)])
        if not done:
            raise RuntimeError("the picture could not be compressed as JPEG")
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), dtype=np.uint8)
    return picture
