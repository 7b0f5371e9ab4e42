"""Circles through contours and their labels as loops, in place of ``vision.rings``."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numba.extending import overload
from numpy.typing import NDArray

from vision import rings
from vision.rings import MIN_POINTS, is_around, is_match, kasa_centre
from vision.view import View, inside, pixel_rays, rays_to_plane

Array = NDArray[np.float64]
Bool = NDArray[np.bool_]
Int = NDArray[np.int64]


@overload(rings.contour_sums)
def _contour_sums(
    view: View, u: Array, v: Array, start: Int, stride: Int, margin_px: float
) -> Callable[..., tuple[Array, Int]]:
    def sums(view: View, u: Array, v: Array, start: Int, stride: Int, margin_px: float) -> tuple[Array, Int]:
        m = len(start) - 1
        out, count = np.zeros((m, 4)), np.zeros(m, dtype=np.int64)
        qx, qy = np.empty(len(u)), np.empty(len(u))
        for i in range(m):
            first = start[i]
            n = 0
            mx, my = 0.0, 0.0
            for k in range(start[i], start[i + 1], stride[i]):
                if inside(view, u[k], v[k], margin_px):
                    x, y = pixel_rays(view, u[k], v[k])
                    qx[first + n], qy[first + n] = rays_to_plane(view, x, y, v[k])
                    mx += qx[first + n]
                    my += qy[first + n]
                    n += 1
            count[i] = n
            if n < MIN_POINTS:
                continue
            mx /= n
            my /= n
            sxx, syy, sxy, sxz, syz = 0.0, 0.0, 0.0, 0.0, 0.0
            for k in range(first, first + n):
                x, y = qx[k] - mx, qy[k] - my
                z = x * x + y * y
                sxx += x * x
                syy += y * y
                sxy += x * y
                sxz += x * z
                syz += y * z
            ax, ay = kasa_centre(sxx, syy, sxy, sxz, syz)
            s1, s2 = 0.0, 0.0
            for k in range(first, first + n):
                rho = math.hypot(qx[k] - mx - ax, qy[k] - my - ay)
                s1 += rho
                s2 += rho * rho
            out[i, 0], out[i, 1] = ax + mx, ay + my
            out[i, 2], out[i, 3] = s1 / n, math.sqrt(max(s2 / n - (s1 / n) ** 2, 0.0))
        return out, count

    return sums


@overload(rings.match_trials)
def _match_trials(
    centre: Array,
    radius: Array,
    side: Array,
    weight: Array,
    unit: Array,
    circle: Int,
    edge: Int,
    edges_m: Array,
) -> Callable[..., tuple[Array, Int, Bool]]:
    def match(
        centre: Array,
        radius: Array,
        side: Array,
        weight: Array,
        unit: Array,
        circle: Int,
        edge: Int,
        edges_m: Array,
    ) -> tuple[Array, Int, Bool]:
        t, m, k = len(circle), len(radius), len(edges_m)
        score, label, matched = (
            np.empty(t),
            np.zeros((t, m), dtype=np.int64),
            np.zeros((t, m), dtype=np.bool_),
        )
        for i in range(t):
            kappa = radius[circle[i]] / edges_m[edge[i]]
            cx, cy = centre[circle[i], 0], centre[circle[i], 1]
            support, n, enclosed = 0.0, 0, False
            for j in range(m):
                best = math.inf
                for e in range(k):
                    if (e % 2 == 0) == (side[j] > 0.0):
                        error = abs(kappa * edges_m[e] - radius[j])
                        if error < best:
                            best, label[i, j] = error, e
                apart = math.hypot(cx - centre[j, 0], cy - centre[j, 1])
                matched[i, j] = is_match(best, apart, radius[j], unit[j])
                if matched[i, j]:
                    support += weight[j]
                    n += 1
                enclosed |= is_around(apart, radius[j], side[j], unit[j], kappa * edges_m[0])
            expected = 1e-12
            for e in range(k):
                if kappa * edges_m[e] > 1.5 * unit[circle[i]]:
                    expected += 2.0 * math.pi * kappa * edges_m[e]
            lonely = n < 2 and not (edge[i] == 0 and radius[circle[i]] < 25.0 * unit[circle[i]])
            score[i] = 0.0 if lonely or enclosed else support / expected * min(1.0, 0.5 * n)
        return score, label, matched

    return match


REPLACED = (rings.contour_sums, rings.match_trials)
