"""All pixels of a small target as loops, in place of ``vision.area_model`` and ``vision.area_light``."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numba.extending import overload, register_jitable
from numpy.typing import NDArray

from vision import area_covariance, area_light, area_model
from vision.area_covariance import BLOCK, window
from vision.area_light import Light, sector_of
from vision.area_model import (
    ALL,
    EX,
    EY,
    FAR,
    FILTER,
    FIRST,
    OUTERMOST,
    PARAMETERS,
    PATTERN,
    WIDTH,
    Blur,
    Pixels,
    bending_px,
    edge_bend,
    edge_distance,
    lens_px,
    node_columns,
    node_design,
    part_box,
    parts_of,
    sharp_rows,
)
from vision.lines import Edges
from vision.profile import FAR_PX, edge_profile, phi
from vision.view import View, pixel_rays, plane_gradient, rays_to_plane, to_pixels, units_per_pixel

Array = NDArray[np.float64]
Bool = NDArray[np.bool_]
Image = NDArray[np.uint8]
Int = NDArray[np.int64]


@register_jitable
def clamped(index: int, size: int) -> int:
    """Return the index, or the nearest that there is."""
    return min(max(index, 0), size - 1)


@overload(area_model.offsets)
def _offsets(view: View, pixels: Pixels, centre: Array) -> Callable[..., tuple[Array, Array]]:
    def offsets(view: View, pixels: Pixels, centre: Array) -> tuple[Array, Array]:
        n = len(pixels.u)
        ex, ey = np.empty(n), np.empty(n)
        for i in range(n):
            x, y = pixel_rays(view, pixels.u[i], pixels.v[i])
            qx, qy = rays_to_plane(view, x, y, pixels.v[i])
            ex[i], ey[i] = qx - centre[0], qy - centre[1]
        return ex, ey

    return offsets


@overload(area_model.share_beyond)
def _share_beyond(
    view: View, pixels: Pixels, centre: Array, radius: float, blur_px: float
) -> Callable[..., Array]:
    def share(view: View, pixels: Pixels, centre: Array, radius: float, blur_px: float) -> Array:
        ex, ey = area_model.offsets(view, pixels, centre)
        out = np.zeros(len(ex))
        for i in range(len(ex)):
            stretch = radius / max(math.sqrt(ex[i] * ex[i] + ey[i] * ey[i]), 1e-9 * radius)
            if stretch > 2.0:
                continue
            u, v = to_pixels(view, centre[0] + stretch * ex[i], centre[1] + stretch * ey[i])
            away = math.sqrt((u - pixels.u[i]) ** 2 + (v - pixels.v[i]) ** 2)
            out[i] = phi((away if stretch < 1.0 else -away) / blur_px)
        return out

    return share


@overload(area_model.circle_bounds)
def _circle_bounds(
    view: View, centre: Array, radius: float
) -> Callable[..., tuple[float, float, float, float]]:
    def bounds(view: View, centre: Array, radius: float) -> tuple[float, float, float, float]:
        u, v = np.empty(12), np.empty(12)
        for i in range(12):
            angle = i * (np.pi / 6.0)
            u[i], v[i] = to_pixels(
                view, centre[0] + radius * np.cos(angle), centre[1] + radius * np.sin(angle)
            )
        return u.min(), u.max(), v.min(), v.max()

    return bounds


@overload(area_model.pattern_rows)
def _pattern_rows(
    view: View, pixels: Pixels, centre: Array, kappa: float, edges: Edges, blur: Blur
) -> Callable[..., Array]:
    def rows(view: View, pixels: Pixels, centre: Array, kappa: float, edges: Edges, blur: Blur) -> Array:
        if not pixels.filtered:
            return sharp_rows(view, pixels.u, pixels.v, centre, kappa, edges, blur)
        across, down, n = pixels.across, pixels.down, len(pixels.u)
        # Only what a pixel or one of its neighbours needs.
        place = np.full(across * down, -1)
        for p in range(n):
            j, i = int(pixels.u[p] - pixels.corner[0]), int(pixels.v[p] - pixels.corner[1])
            for di in range(-1, 2):
                for dj in range(-1, 2):
                    place[clamped(i + di, down) * across + clamped(j + dj, across)] = 0
        u, v = np.empty(across * down), np.empty(across * down)
        needed = 0
        for at in range(across * down):
            if place[at] == 0:
                place[at] = needed
                u[needed], v[needed] = pixels.corner[0] + at % across, pixels.corner[1] + at // across
                needed += 1
        sharp = sharp_rows(view, u[:needed], v[:needed], centre, kappa, edges, blur)
        out = np.empty((n, WIDTH))
        b = blur.spill
        kept = 1.0 - 2.0 * b
        for p in range(n):
            j, i = int(pixels.u[p] - pixels.corner[0]), int(pixels.v[p] - pixels.corner[1])
            j0, j1 = clamped(j - 1, across), clamped(j + 1, across)
            i0, i1 = clamped(i - 1, down) * across, clamped(i + 1, down) * across
            i *= across
            m = sharp[place[i + j]]
            l, r, t, d = (
                sharp[place[i + j0]],
                sharp[place[i + j1]],
                sharp[place[i0 + j]],
                sharp[place[i1 + j]],
            )
            tl, tr, dl, dr = (
                sharp[place[i0 + j0]],
                sharp[place[i0 + j1]],
                sharp[place[i1 + j0]],
                sharp[place[i1 + j1]],
            )
            for c in range(WIDTH):
                next_ = l[c] + r[c] + t[c] + d[c]
                out[p, c] = kept * kept * m[c] + kept * b * next_ + b * b * (tl[c] + tr[c] + dl[c] + dr[c])
            out[p, EX], out[p, EY] = m[EX], m[EY]
            for k in range(2):
                c = PATTERN + k
                next_ = l[c] + r[c] + t[c] + d[c]
                corners = tl[c] + tr[c] + dl[c] + dr[c]
                spilt = next_ - 4.0 * m[c] + 2.0 * b * (corners - 2.0 * next_ + 4.0 * m[c])
                out[p, (ALL if k == 0 else FIRST) + FILTER] = spilt
        return out

    return rows


@overload(area_model.sharp_rows)
def _sharp_rows(
    view: View,
    u: Array,
    v: Array,
    centre: Array,
    kappa: float,
    edges: Edges,
    blur: Blur,
) -> Callable[..., Array]:
    def rows(
        view: View,
        u: Array,
        v: Array,
        centre: Array,
        kappa: float,
        edges: Edges,
        blur: Blur,
    ) -> Array:
        lens = lens_px(blur.width_px)
        square = blur.width_px * blur.width_px
        unit = units_per_pixel(view, centre[0], centre[1])
        outer = kappa * edges.radius_m[0]
        parts = parts_of(2.0 * outer / unit)
        across = bending_px(lens, parts)
        bending = 2.0 * square / (across * across)
        places, share = (np.arange(parts) + 0.5) / parts - 0.5, 1.0 / parts**2
        out = np.zeros((len(u), WIDTH))
        for p in range(len(out)):
            row = out[p]
            for dv in places:
                for du in places:
                    un, vn = u[p] + du, v[p] + dv
                    x, y = pixel_rays(view, un, vn)
                    qx, qy = rays_to_plane(view, x, y, vn)
                    ex, ey = qx - centre[0], qy - centre[1]
                    rho = max(math.sqrt(ex * ex + ey * ey), 1e-3 * unit)
                    nx, ny = ex / rho, ey / rho
                    gu, gv = plane_gradient(view, nx, ny, qx, qy, x, y)
                    per = 1.0 / max(math.sqrt(gu * gu + gv * gv), 0.2 * unit)
                    box, sigma = part_box(gu, gv, per, lens, parts)
                    reach = FAR * sigma + 0.5 * box
                    # Further out than this an edge is done with, whatever it bends.
                    beyond = reach + abs(blur.growth_px)
                    row[EX] += share * ex / outer
                    row[EY] += share * ey / outer
                    whole, steep, scaled, grown, wider = 0.0, 0.0, 0.0, 0.0, 0.0
                    touched = False
                    for k in range(len(edges.radius_m)):
                        side = edges.side[k]
                        radius = kappa * edges.radius_m[k]
                        bend, away = 0.0, FAR_PX
                        if (rho - radius) * per < beyond:
                            bend = edge_bend(across, unit * unit, per, radius)
                            away = edge_distance(rho, radius, per, bend, side * blur.growth_px)
                        if abs(away) < reach:
                            rise, steps, wide = edge_profile(away, sigma, box)
                            step = steps * side
                            whole += rise * side
                            steep += step
                            scaled += step * (edges.radius_m[k] * per + bend / kappa)
                            grown += step * side
                            wider += wide * side * square / sigma + step * bend * bending
                            touched = True
                        elif away > 0.0:
                            whole += side
                        if k == 0:
                            row[OUTERMOST] += share * whole
                            if touched:
                                design = node_design(view, nx, ny, qx, qy, gu, gv, x, y, per)
                                columns = node_columns(design, steep, scaled, grown, wider)
                                for c in range(PARAMETERS + 4):
                                    row[FIRST + c] += share * columns[c]
                    row[PATTERN] += share * whole
                    if touched:
                        design = node_design(view, nx, ny, qx, qy, gu, gv, x, y, per)
                        columns = node_columns(design, steep, scaled, grown, wider)
                        for c in range(PARAMETERS + 4):
                            row[ALL + c] += share * columns[c]
        return out

    return rows


@overload(area_light.colours)
def _colours(image: Image, column: Int, row: Int) -> Callable[..., tuple[Array, Array, Array]]:
    def seen(image: Image, column: Int, row: Int) -> tuple[Array, Array, Array]:
        n = len(row)
        blue, green, red = np.empty(n), np.empty(n), np.empty(n)
        for i in range(n):
            at = image[row[i], column[i]]
            blue[i], green[i], red[i] = float(at[0]), float(at[1]), float(at[2])
        return blue, green, red

    return seen


@overload(area_light.sector_sums)
def _sector_sums(sector: Int, agrees: Bool, sectors: int) -> Callable[..., tuple[Array, Array]]:
    def sums(sector: Int, agrees: Bool, sectors: int) -> tuple[Array, Array]:
        laid, agreeing = np.zeros(sectors), np.zeros(sectors)
        for i in range(len(sector)):
            laid[sector[i]] += 1.0
            if agrees[i]:
                agreeing[sector[i]] += 1.0
        return laid, agreeing

    return sums


@overload(area_light.light_columns)
def _light_columns(pattern: Array, sectors: int) -> Callable[..., Array]:
    def columns(pattern: Array, sectors: int) -> Array:
        n = len(pattern)
        out = np.zeros((n, 7 if sectors == 1 else 2 * sectors + 1))
        mine = np.zeros(n, dtype=np.int64)
        if sectors > 1:
            mine = sector_of(pattern[:, EX], pattern[:, EY], sectors)
        for i in range(n):
            ex, ey, whole = pattern[i, EX], pattern[i, EY], pattern[i, PATTERN]
            if sectors == 1:
                out[i, 0], out[i, 1], out[i, 2], out[i, 3] = 1.0, whole, pattern[i, OUTERMOST], ex
                out[i, 4], out[i, 5], out[i, 6] = ey, ex * whole, ey * whole
            else:
                out[i, mine[i]], out[i, sectors + mine[i]] = 1.0, whole
                out[i, 2 * sectors] = pattern[i, OUTERMOST]
        return out

    return columns


@overload(area_light.brightness_rows)
def _brightness_rows(pattern: Array, light: Light, free: Int) -> Callable[..., tuple[Array, Array]]:
    def moved(pattern: Array, light: Light, free: Int) -> tuple[Array, Array]:
        n, n_free, n_light = len(pattern), len(free), light.columns.shape[1]
        rows, considered = np.empty((n, n_free + n_light)), np.empty((n, 4))
        for i in range(n):
            contrast = light.pixel_contrast[i]
            for k in range(n_free):
                at = free[k]
                rows[i, k] = pattern[i, ALL + at] * contrast + pattern[i, FIRST + at] * light.outer
            for k in range(n_light):
                rows[i, n_free + k] = light.columns[i, k]
            for k in range(4):
                at = PARAMETERS + k
                considered[i, k] = pattern[i, ALL + at] * contrast + pattern[i, FIRST + at] * light.outer
        return rows, considered

    return moved


@overload(area_covariance.freedom)
def _freedom(turned: Array, weight: Array, pixels: Pixels) -> Callable[..., Array]:
    def degrees(turned: Array, weight: Array, pixels: Pixels) -> Array:
        n, wide = len(weight), pixels.across + 2 * BLOCK - 2
        box = np.zeros((wide * (pixels.down + 2 * BLOCK - 2), 3))
        at = np.empty(n, dtype=np.int64)
        for p in range(n):
            j, i = int(pixels.u[p] - pixels.corner[0]), int(pixels.v[p] - pixels.corner[1])
            at[p] = (i + BLOCK - 1) * wide + j + BLOCK - 1
            for c in range(3):
                box[at[p], c] = (turned[p, c] * weight[p]) ** 2
        total, together = np.zeros(3), np.zeros(3)
        for c in range(3):
            for p in range(n):
                total[c] += box[at[p], c]
        for di in range(1 - BLOCK, BLOCK):
            for dj in range(1 - BLOCK, BLOCK):
                square = window(di, dj) ** 2
                for p in range(n):
                    for c in range(3):
                        together[c] += square * box[at[p], c] * box[at[p] + di * wide + dj, c]
        return total**2 / np.maximum(together, 1e-300)

    return degrees


@overload(area_covariance.block_sums)
def _block_sums(turned: Array, score: Array, pixels: Pixels) -> Callable[..., Array]:
    def sums(turned: Array, score: Array, pixels: Pixels) -> Array:
        across, m = pixels.across + BLOCK - 1, turned.shape[1]
        place = np.full(across * (pixels.down + BLOCK - 1), -1)
        total = np.zeros((BLOCK * BLOCK * len(score), m))
        n = 0
        for p in range(len(score)):
            j, i = int(pixels.u[p] - pixels.corner[0]), int(pixels.v[p] - pixels.corner[1])
            for di in range(BLOCK):
                for dj in range(BLOCK):
                    at = (i + di) * across + j + dj
                    if place[at] < 0:
                        place[at] = n
                        n += 1
                    for c in range(m):
                        total[place[at], c] += turned[p, c] * score[p]
        return total[:n]

    return sums


REPLACED = (
    area_covariance.freedom,
    area_covariance.block_sums,
    area_model.offsets,
    area_model.share_beyond,
    area_model.circle_bounds,
    area_model.pattern_rows,
    area_model.sharp_rows,
    area_light.colours,
    area_light.sector_sums,
    area_light.light_columns,
    area_light.brightness_rows,
)
