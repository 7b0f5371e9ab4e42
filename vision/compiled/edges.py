"""Lines across single edges as loops, in place of ``vision.lines``, ``vision.profile`` and ``vision.refine``."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numba.extending import overload
from numpy.typing import NDArray

from vision import lines, profile, refine, robust
from vision.lines import (
    BEND,
    CLIPPED,
    CLIPPED_LEVEL,
    CONSIDERED,
    DESIGN,
    DISTANCE,
    ENOUGH_SEEN,
    GAP_PX,
    HALF_PX,
    INWARD_BEND,
    INWARD_PX,
    LEAST_SEEN,
    LEVEL,
    MIN_LINES,
    NU,
    NV,
    OUTWARD_BEND,
    OUTWARD_PX,
    RED,
    SAMPLES,
    SIDE,
    STEP,
    TOTAL,
    U0,
    V0,
    VALUE,
    WEIGHT,
    Edges,
    Lines,
    bend_factor,
    empty_lines,
    line_angle,
    line_considered,
    line_counts,
    line_design,
    line_half_px,
    neighbours,
)
from vision.profile import (
    FAR_PX,
    box_across,
    edge_profile,
    gaussian_part,
    line_blur,
    line_displacement,
    line_solution,
    line_solution_sharp,
    motion_of,
)
from vision.refine import is_contrary
from vision.view import View, inside, pixel_rays, plane_gradient, rays_to_plane, to_pixels

Array = NDArray[np.float64]
Bool = NDArray[np.bool_]
Image = NDArray[np.uint8]
Int = NDArray[np.int64]


@overload(lines.lay_lines)
def _lay_lines(
    image: Image, view: View, centre: Array, kappa: float, edges: Edges, blur_px: float, n_lines: int
) -> Callable[..., Lines]:
    def lay(
        image: Image, view: View, centre: Array, kappa: float, edges: Edges, blur_px: float, n_lines: int
    ) -> Lines:
        usable, want = line_counts(view, centre, kappa, edges, blur_px, n_lines)
        larger = STEP * kappa * edges.radius_m[0]
        out = empty_lines(0)
        n = 0
        for attempt in range(2):
            count = want.astype(np.int64)
            laid = count.sum()
            out = empty_lines(laid)
            n = 0
            for e in range(len(usable)):
                edge = usable[e]
                radius = kappa * edges.radius_m[edge]
                for index in range(count[e]):
                    angle = line_angle(index, count[e], edge)
                    cos, sin = math.cos(angle), math.sin(angle)
                    u0, v0 = to_pixels(view, centre[0] + radius * cos, centre[1] + radius * sin)
                    if inside(view, u0, v0, 1.5):
                        out.edge[n] = edge
                        row = out.row[n]
                        row[U0], row[V0], row[NU], row[NV] = u0, v0, cos, sin
                        n += 1
            seen = n / max(laid, 1)
            if attempt == 1 or seen >= ENOUGH_SEEN:
                break
            want = want / max(seen, LEAST_SEEN)
        if n < MIN_LINES:
            return empty_lines(0)
        outward, inward = neighbours(edges)
        w, h = view.width - 1.0, view.height - 1.0
        for i in range(n):
            row, pixels = out.row[i], out.pixels[i]
            edge = out.edge[i]
            u0, v0, cos, sin = row[U0], row[V0], row[NU], row[NV]
            rk = kappa * edges.radius_m[edge]
            u1, v1 = to_pixels(view, centre[0] + (rk + larger) * cos, centre[1] + (rk + larger) * sin)
            du, dv = u1 - u0, v1 - v0
            length = math.hypot(du, dv)
            gap = edges.near_m[edge] * (length / (STEP * edges.radius_m[0]))
            half = line_half_px(gap, blur_px)
            xm, ym = pixel_rays(view, u0, v0)
            qxm, qym = centre[0] + rk * cos, centre[1] + rk * sin
            gu, gv = plane_gradient(view, cos, sin, qxm, qym, xm, ym)
            slope = math.hypot(gu, gv)
            per = 1.0 / slope
            total, level, clipped = 0.0, 0.0, 0.0
            before_u, before_v = -1e9, -1e9
            for m in range(SAMPLES):
                reach = half / length * (2.0 * m / (SAMPLES - 1) - 1.0)
                ui, vi = np.rint(u0 + reach * du), np.rint(v0 + reach * dv)
                weight = 1.0 if ui != before_u or vi != before_v else 0.0
                before_u, before_v = ui, vi
                if ui < 0.0 or vi < 0.0 or ui > w or vi > h:
                    weight = 0.0
                    ui, vi = min(max(ui, 0.0), w), min(max(vi, 0.0), h)
                at = image[int(vi), int(ui)]
                value = 0.5 * (float(at[0]) + float(at[1]))
                if at[0] >= CLIPPED_LEVEL or at[1] >= CLIPPED_LEVEL:
                    clipped = 1.0
                total += weight
                level += weight * value
                x, y = pixel_rays(view, ui, vi)
                qx, qy = rays_to_plane(view, x, y, vi)
                pixel = pixels[m]
                pixel[DISTANCE] = (math.hypot(qx - centre[0], qy - centre[1]) - rk) * per
                pixel[VALUE], pixel[RED], pixel[WEIGHT] = value, float(at[2]), weight
            row[TOTAL], row[LEVEL] = total, level / max(total, 1.0)
            row[SIDE], row[HALF_PX], row[GAP_PX] = edges.side[edge], half, gap
            bent = bend_factor(view, qxm, qym, slope)
            row[BEND] = 0.5 * slope / rk * bent
            scale = kappa * per
            row[OUTWARD_PX] = (outward[edge] - edges.radius_m[edge]) * scale
            row[INWARD_PX] = (edges.radius_m[edge] - inward[edge]) * scale
            row[OUTWARD_BEND] = 0.5 / (outward[edge] * scale) * bent
            row[INWARD_BEND] = 0.5 / (max(inward[edge], 0.1 * edges.radius_m[-1]) * scale) * bent
            d = line_design(cos, sin, qxm, qym, edges.radius_m[edge], per, edges.side[edge])
            for k in range(6):
                row[DESIGN + k] = d[k]
            c = line_considered(view, gu, gv, xm, ym, per)
            for k in range(3):
                row[CONSIDERED + k] = c[k]
            row[CONSIDERED + 3] = 1.0
            row[CLIPPED] = clipped
            row[NU], row[NV] = c[1], c[2]
        return Lines(out.pixels[:n], out.edge[:n], out.row[:n])

    return lay


@overload(profile.line_boxes)
def _line_boxes(lines: Lines, blur: Array, blur_xy: Array) -> Callable[..., Array]:
    def boxes(lines: Lines, blur: Array, blur_xy: Array) -> Array:
        motion = motion_of(blur_xy)
        out = np.empty(len(blur))
        for i in range(len(blur)):
            out[i] = box_across(motion, lines.row[i, NU], lines.row[i, NV], blur[i])
        return out

    return boxes


@overload(profile.line_moments)
def _line_moments(
    lines: Lines, shift_px: Array, growth_px: float, blur: Array, box: Array, with_neighbours: bool
) -> Callable[..., Array]:
    def moments(
        lines: Lines, shift_px: Array, growth_px: float, blur: Array, box: Array, with_neighbours: bool
    ) -> Array:
        p, m = lines.pixels.shape[:2]
        gram = np.zeros((p, 4, 4))
        column, sums = np.empty(4), np.empty(4)
        for i in range(p):
            row, pixels = lines.row[i], lines.pixels[i]
            s, square = row[SIDE], blur[i] * blur[i]
            sigma = gaussian_part(blur[i], box[i])
            reach = 0.5 * box[i] + 7.0 * sigma
            moved = shift_px[i] - square * row[BEND]
            grown = 2.0 * growth_px * s - square * row[BEND]
            outer = grown - row[OUTWARD_PX] + square * row[OUTWARD_BEND]
            inner = grown + row[INWARD_PX] + square * row[INWARD_BEND]
            sums[:] = 0.0
            for j in range(m):
                if pixels[j, WEIGHT] == 0.0:
                    continue
                distance = pixels[j, DISTANCE] - moved
                rise, slope, wider = edge_profile(distance, sigma, box[i])
                if with_neighbours:
                    for offset in (outer, inner):
                        away = min(max(distance + offset, -FAR_PX), FAR_PX)
                        if abs(away) > reach:
                            # All of the step, or none: what the profile gives there, to 1e-10.
                            r, d, w = (1.0 if away > 0.0 else 0.0), 0.0, 0.0
                        else:
                            r, d, w = edge_profile(away, sigma, box[i])
                        rise -= r
                        slope -= d
                        wider -= w
                column[0] = s * rise
                column[1] = -s * slope
                column[2] = s * square / sigma * wider
                column[3] = pixels[j, VALUE] - row[LEVEL]
                for k in range(4):
                    sums[k] += column[k]
                    for l in range(k + 1):
                        gram[i, k, l] += column[k] * column[l]
            total = max(row[TOTAL], 1.0)
            for k in range(4):
                for l in range(k + 1):
                    gram[i, k, l] -= sums[k] * sums[l] / total
                    gram[i, l, k] = gram[i, k, l]
        return gram

    return moments


@overload(profile.solve_lines)
def _solve_lines(gram: Array, free_blur: bool) -> Callable[..., tuple[Array, Array, Array, Array, Array]]:
    def solve(gram: Array, free_blur: bool) -> tuple[Array, Array, Array, Array, Array]:
        n = len(gram)
        contrast, shift, wider = np.empty(n), np.empty(n), np.zeros(n)
        inverse, rest = np.empty(n), np.empty(n)
        for i in range(n):
            g = gram[i]
            h0, h1, h2 = g[0, 3], g[1, 3], g[2, 3]
            if free_blur:
                contrast[i], shift[i], wider[i], inverse[i] = line_solution(
                    g[0, 0], g[0, 1], g[0, 2], g[1, 1], g[1, 2], g[2, 2], h0, h1, h2
                )
            else:
                contrast[i], shift[i], inverse[i] = line_solution_sharp(g[0, 0], g[0, 1], g[1, 1], h0, h1)
            rest[i] = max(g[3, 3] - (contrast[i] * h0 + shift[i] * h1 + wider[i] * h2), 0.0)
        return contrast, shift, wider, inverse, rest

    return solve


@overload(profile.displacements)
def _displacements(
    lines: Lines,
    gram: Array,
    contrast: Array,
    shift: Array,
    inverse: Array,
    rest: Array,
    middle: float,
    noise: float,
) -> Callable[..., tuple[Array, Array, Bool]]:
    def judge(
        lines: Lines,
        gram: Array,
        contrast: Array,
        shift: Array,
        inverse: Array,
        rest: Array,
        middle: float,
        noise: float,
    ) -> tuple[Array, Array, Bool]:
        n = len(gram)
        delta, sigma2, valid = np.empty(n), np.empty(n), np.empty(n, dtype=np.bool_)
        for i in range(n):
            delta[i], sigma2[i], valid[i] = line_displacement(
                contrast[i],
                shift[i],
                inverse[i],
                rest[i],
                gram[i, 3, 3],
                lines.row[i, TOTAL],
                lines.row[i, HALF_PX],
                middle,
                noise,
            )
        return delta, sigma2, valid

    return judge  # fmt: skip


@overload(profile.line_blurs)
def _line_blurs(lines: Lines, blur_xy: Array) -> Callable[..., Array]:
    def blurs(lines: Lines, blur_xy: Array) -> Array:
        n = len(lines.edge)
        out = np.empty(n)
        for i in range(n):
            out[i] = line_blur(blur_xy, lines.row[i, NU], lines.row[i, NV])
        return out

    return blurs


@overload(profile.crowded)
def _crowded(lines: Lines, blur: Array) -> Callable[..., bool]:
    def any_near(lines: Lines, blur: Array) -> bool:
        near = False
        for i in range(len(blur)):
            near |= lines.row[i, GAP_PX] - lines.row[i, HALF_PX] < 3.0 * blur[i]
        return near

    return any_near


@overload(refine.counted)
def _counted(edge: Int, inlier: Bool, n_edges: int) -> Callable[..., tuple[Array, Array]]:
    def count(edge: Int, inlier: Bool, n_edges: int) -> tuple[Array, Array]:
        laid, agreeing = np.zeros(n_edges), np.zeros(n_edges)
        for i in range(len(edge)):
            laid[edge[i]] += 1.0
            if inlier[i]:
                agreeing[edge[i]] += 1.0
        return laid, agreeing

    return count


@overload(refine.agreement)
def _agreement(
    lines: Lines, edges: Edges, laid: Array, inlier: Bool, contrast: float
) -> Callable[..., tuple[float, float, float]]:
    def judge(
        lines: Lines, edges: Edges, laid: Array, inlier: Bool, contrast: float
    ) -> tuple[float, float, float]:
        n = len(inlier)
        level = np.empty(n)
        agreed, covariance, variance = 0, 0.0, 0.0
        for i in range(n):
            if inlier[i]:
                level[agreed] = lines.row[i, LEVEL]
                agreed += 1
                if lines.edge[i] > 0:
                    for j in range(SAMPLES):
                        value = lines.pixels[i, j, VALUE] - lines.row[i, LEVEL]
                        weighted = lines.pixels[i, j, WEIGHT] * value
                        covariance += weighted * lines.pixels[i, j, RED]
                        variance += weighted * value
        slope = covariance / max(variance, 1e-9)
        if agreed in (0, n):
            return 1.0, 0.0, slope
        white = robust.median(level[:agreed]) + 0.5 * contrast
        contrary, matching, whole = 0, 0.0, 0.0
        for i in range(n):
            length = edges.radius_m[lines.edge[i]] / laid[lines.edge[i]]
            whole += length
            if inlier[i]:
                matching += length
                continue
            largest, red = 0.0, 0.0
            for j in range(SAMPLES):
                largest = max(largest, abs(lines.pixels[i, j, VALUE] - lines.row[i, LEVEL]))
                red += lines.pixels[i, j, RED] / SAMPLES
            if largest < 0.2 * contrast and is_contrary(lines.row[i, LEVEL], red, white, contrast):
                contrary += 1
        return matching / whole, contrary / n, slope

    return judge


REPLACED = (
    lines.lay_lines,
    profile.line_boxes,
    profile.line_moments,
    profile.solve_lines,
    profile.displacements,
    profile.line_blurs,
    profile.crowded,
    refine.counted,
    refine.agreement,
)
