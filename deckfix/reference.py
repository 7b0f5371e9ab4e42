"""Comparison of an estimate with a reference: the truth, or the autopilot's own estimate.

All times are int64 nanoseconds on the clock of the inertial sensor; positions, velocities and their errors
are NED, attitude errors are differences of roll, pitch and yaw wrapped to [-pi, pi).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.frames import quat_to_euler_columns

Array = NDArray[np.float64]
Times = NDArray[np.int64]

LONGEST_BRIDGE_S = 0.5
"""A reference is interpolated across gaps up to this long, and not beyond."""

TOUCHDOWN_STEP_MPS = 0.15
TOUCHDOWN_TIME_S = 0.05
TOUCHDOWN_HEIGHT_M = 0.12


@dataclass(frozen=True, slots=True)
class Column:
    """One quantity over time: ``t_ns`` (n,) ascending, ``values`` (n, k), all finite."""

    t_ns: Times
    values: Array

    def at(self, t_ns: Times) -> Array:
        """Return the values, shape (m, k), interpolated linearly; NaN outside and inside long gaps."""
        out = np.full((len(t_ns), self.values.shape[1]), np.nan)
        if len(self.t_ns) < 2:
            return out
        right = np.searchsorted(self.t_ns, t_ns, side="left").clip(1, len(self.t_ns) - 1)
        left = right - 1
        span = (self.t_ns[right] - self.t_ns[left]).astype(np.float64)
        inside = (t_ns >= self.t_ns[0]) & (t_ns <= self.t_ns[-1]) & (span <= LONGEST_BRIDGE_S * 1e9)
        share = np.where(span > 0, (t_ns - self.t_ns[left]) / np.where(span > 0, span, 1.0), 0.0)[:, None]
        mixed = (1.0 - share) * self.values[left] + share * self.values[right]
        out[inside] = mixed[inside]
        return out


@dataclass(frozen=True, slots=True)
class Trajectory:
    """A reference: each quantity where, and as often as, its source gives it.

    ``quaternion`` is w, x, y, z, body to NED, with signs that do not jump.
    """

    position_m: Column | None
    velocity_mps: Column | None
    quaternion: Column | None

    def quaternion_at(self, t_ns: Times) -> Array:
        """Return unit quaternions, shape (m, 4), interpolated; NaN where the source has none."""
        if self.quaternion is None:
            return np.full((len(t_ns), 4), np.nan)
        q = self.quaternion.at(t_ns)
        unit: Array = q / np.linalg.norm(q, axis=1, keepdims=True)
        return unit


def column(t_ns: Times, values: Array) -> Column | None:
    """Return the finite rows as a column in ascending time (the last of equal stamps), or None if too few."""
    keep = np.isfinite(values).all(axis=1)
    t, v = t_ns[keep], values[keep]
    if len(t) < 2:
        return None
    order = np.argsort(t, kind="stable")
    t, v = t[order], v[order]
    last = np.append(t[1:] != t[:-1], True)
    if np.count_nonzero(last) < 2:
        return None
    return Column(np.ascontiguousarray(t[last]), np.ascontiguousarray(v[last], dtype=np.float64))


def quaternion_column(t_ns: Times, quaternion_wxyz: Array) -> Column | None:
    """Return a column of quaternions without jumps of sign; rows of zeros (ROS 2: unknown) are left out."""
    norm = np.linalg.norm(quaternion_wxyz, axis=1)
    given = np.isfinite(norm) & (norm > 0.5)
    out = column(t_ns[given], quaternion_wxyz[given] / norm[given, None])
    if out is None:
        return None
    q = out.values
    flips = np.sum(q[1:] * q[:-1], axis=1) < 0.0
    sign = np.where(np.cumsum(flips) % 2 == 1, -1.0, 1.0)
    q[1:] *= sign[:, None]
    return out


def densest(columns: Sequence[Column | None]) -> Column | None:
    """Return the column with the most rows, the first of equals; None if there is none."""
    present = [c for c in columns if c is not None]
    return max(present, key=lambda c: len(c.t_ns)) if present else None


@dataclass(frozen=True, slots=True)
class Errors:
    """An estimate less a reference at the times ``t_ns`` (m,); NaN where the reference gives nothing.

    ``position_m`` (m, 3) is less its constant ``datum_m`` (3,), the median over the window;
    ``velocity_mps`` (m, 3); ``attitude_rad`` (m, 3) roll, pitch, yaw; ``nees`` (m,) of position, velocity
    and attitude (9 degrees of freedom; 6 or 3 where the reference lacks a part, see ``nees_dof``).
    """

    t_ns: Times
    position_m: Array
    velocity_mps: Array
    attitude_rad: Array
    datum_m: Array
    nees: Array
    nees_dof: int


@dataclass(frozen=True, slots=True)
class Window:
    """Where errors are judged: from 10 s after the start to 0.5 s before contact (or to the end)."""

    start_ns: int
    end_ns: int
    contact_ns: int | None

    def inside(self, t_ns: Times) -> NDArray[np.bool_]:
        """Return which times lie in the window."""
        return (t_ns >= self.start_ns) & (t_ns <= self.end_ns)


def window(start_ns: int, end_ns: int, contact_ns: int | None) -> Window:
    """Return the window of judgement; the whole flight where the usual one would be shorter than 5 s."""
    first = start_ns + 10_000_000_000
    last = end_ns if contact_ns is None else contact_ns - 500_000_000
    if last - first < 5_000_000_000:
        first, last = start_ns, end_ns
    return Window(first, last, contact_ns)


def contact_time_ns(truth: Trajectory, platform: Trajectory | None = None) -> int | None:
    """Return when the vehicle touched down, from the truth alone; None where it did not.

    After the highest point: the most abrupt arrest of the descent, where the downward velocity falls by at
    least 0.15 m/s within 50 ms (3 m/s^2 at once, which only a touchdown does; the deck may move or not).
    Without one: the first time from which the height above the starting level, or above the platform where its
    truth is given, stays below 0.12 m.
    """
    if truth.position_m is None:
        return None
    t, down = truth.position_m.t_ns, truth.position_m.values[:, 2]
    top = int(np.argmin(down))
    if down[0] - down[top] < 2.0 * TOUCHDOWN_HEIGHT_M:
        return None
    if truth.velocity_mps is not None:
        step_ns = int(TOUCHDOWN_TIME_S * 1e9)
        tv = truth.velocity_mps.t_ns
        tv = tv[(tv >= t[top]) & (tv <= truth.velocity_mps.t_ns[-1] - step_ns)]
        change = truth.velocity_mps.at(tv + step_ns)[:, 2] - truth.velocity_mps.at(tv)[:, 2]
        change = np.where(np.isfinite(change), change, 0.0)
        if len(change) and change.min() <= -TOUCHDOWN_STEP_MPS:
            return int(tv[int(np.argmin(change))])
    height = down[0] - down
    if platform is not None and platform.position_m is not None:
        deck = platform.position_m.at(t)[:, 2]
        height = np.where(np.isfinite(deck), deck - down, height)
    above = np.flatnonzero(height[top:] >= TOUCHDOWN_HEIGHT_M)
    after = top + (int(above[-1]) + 1 if len(above) else 0)
    return int(t[after]) if after < len(t) else None


def compare(
    t_ns: Times,
    position_m: Array,
    velocity_mps: Array,
    quaternion: Array,
    reference: Trajectory,
    judged: Window,
    covariance: Array | None = None,
) -> Errors:
    """Return an estimate's errors against a reference, which is interpolated to the estimate's times.

    ``position_m`` and ``velocity_mps`` are (n, 3), ``quaternion`` (n, 4) w x y z; ``covariance`` (n, 9, 9)
    is of position, velocity and the rotation vector in the body frame (true attitude = estimate x
    exp(vector)).
    """
    nothing = np.full((len(t_ns), 3), np.nan)
    position = position_m - reference.position_m.at(t_ns) if reference.position_m else nothing
    velocity = velocity_mps - reference.velocity_mps.at(t_ns) if reference.velocity_mps else nothing
    q_ref = reference.quaternion_at(t_ns)
    euler = quat_to_euler_columns(quaternion) - quat_to_euler_columns(q_ref)
    attitude = (euler + np.pi) % (2.0 * np.pi) - np.pi
    datum = median_in_window(position, judged.inside(t_ns))
    position = position - np.where(np.isfinite(datum), datum, 0.0)
    values, dof = np.full(len(t_ns), np.nan), 0
    if covariance is not None:
        error = np.hstack([position, velocity, rotation_vector_columns(quaternion, q_ref)])
        values, dof = nees(error, covariance)
    return Errors(t_ns, position, velocity, attitude, datum, values, dof)


def median_in_window(values: Array, inside: NDArray[np.bool_]) -> Array:
    """Return the median of each column over the rows of the window that are finite (NaN where none is)."""
    rows = values[inside & np.isfinite(values).all(axis=1)]
    return np.median(rows, axis=0) if len(rows) else np.full(values.shape[1], np.nan)


def rotation_vector_columns(q_from: Array, q_to: Array) -> Array:
    """Return the body-frame rotation vectors [rad], shape (n, 3), that take ``q_from`` to ``q_to`` (n, 4)."""
    w1, v1, w2, v2 = q_from[:, :1], -q_from[:, 1:], q_to[:, :1], q_to[:, 1:]
    w = w1[:, 0] * w2[:, 0] - np.sum(v1 * v2, axis=1)
    v = w1 * v2 + w2 * v1 + np.cross(v1, v2)
    v = np.where(w[:, None] < 0.0, -v, v)
    length = np.linalg.norm(v, axis=1)
    angle = 2.0 * np.arctan2(length, np.abs(w))
    scale = np.where(length > 1e-12, angle / np.where(length > 1e-12, length, 1.0), 2.0)
    return v * scale[:, None]


def nees(error: Array, covariance: Array) -> tuple[Array, int]:
    """Return the normalised error squared (n,) and its degrees of freedom, over the parts that are known.

    ``error`` (n, 9) has whole columns of NaN where the reference lacks a part; other rows with NaN give NaN.
    """
    out = np.full(len(error), np.nan)
    known = np.flatnonzero(np.isfinite(error).any(axis=0))
    if not len(known):
        return out, 0
    rows = np.flatnonzero(np.isfinite(error[:, known]).all(axis=1))
    e = error[np.ix_(rows, known)]
    p = covariance[np.ix_(rows, known, known)]
    regular = np.isfinite(p).all(axis=(1, 2))
    rows, e, p = rows[regular], e[regular], p[regular]
    # Scaled to a unit diagonal, so that metres and radians do not spoil the solution.
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", p), 1e-30))
    p = p / (scale[:, :, None] * scale[:, None, :])
    try:
        solved = np.linalg.solve(p, (e / scale)[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        solved = np.einsum("nij,nj->ni", np.linalg.pinv(p, hermitian=True), e / scale)
    out[rows] = np.sum(solved * e / scale, axis=1)
    return out, len(known)


def euler_sigmas(quaternion: Array, rotation_covariance: Array) -> Array:
    """Return 1-sigma of roll, pitch, yaw [rad], shape (n, 3), of a body-frame rotation vector's covariance.

    First order: d(roll, pitch, yaw) = E(roll, pitch) d(rotation vector), with E the matrix that takes body
    rates to Euler rates; near pitch = +-90 deg it grows without bound, as the angles themselves do.
    """
    e = quat_to_euler_columns(quaternion)
    sr, cr = np.sin(e[:, 0]), np.cos(e[:, 0])
    cp = np.where(np.abs(np.cos(e[:, 1])) > 1e-3, np.cos(e[:, 1]), 1e-3)
    tp = np.sin(e[:, 1]) / cp
    zero, one = np.zeros_like(sr), np.ones_like(sr)
    rows = [
        np.stack([one, sr * tp, cr * tp], axis=1),
        np.stack([zero, cr, -sr], axis=1),
        np.stack([zero, sr / cp, cr / cp], axis=1),
    ]
    m = np.stack(rows, axis=1)
    variance = np.einsum("nij,njk,nik->ni", m, rotation_covariance, m)
    sigma: Array = np.sqrt(np.maximum(variance, 0.0))
    return sigma


def rms(values: Array) -> float | None:
    """Return the root mean square of the finite values, or None where there is none."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else None


def rmse_block(errors: Errors, judged: Window) -> dict[str, object]:
    """Return the block of ``replay --json`` for these errors; what the reference lacks is absent."""
    inside = judged.inside(errors.t_ns)
    block: dict[str, object] = {}
    for key, values, unit in (
        ("position_rmse_m", errors.position_m, 1.0),
        ("velocity_rmse_mps", errors.velocity_mps, 1.0),
        ("attitude_rmse_deg", errors.attitude_rad, 180.0 / np.pi),
    ):
        axes = [rms(values[inside, i] * unit) for i in range(3)]
        if all(a is not None for a in axes):
            block[key] = axes
    finite = errors.nees[inside & np.isfinite(errors.nees)]
    if errors.nees_dof and len(finite):
        block["nees_over_dof"] = float(np.mean(finite) / errors.nees_dof)
    return block


RATIOS = (
    ("horizontal_position", "position_m", (0, 1)),
    ("height", "position_m", (2,)),
    ("horizontal_velocity", "velocity_mps", (0, 1)),
    ("vertical_velocity", "velocity_mps", (2,)),
    ("roll_pitch", "attitude_rad", (0, 1)),
    ("yaw", "attitude_rad", (2,)),
)
"""Name, field of ``Errors`` and axes of each ratio."""


def ratio_block(ours: Errors, theirs: Errors, judged: Window) -> dict[str, float]:
    """Return our RMSE over theirs in the window, both at the same times; what cannot be formed is absent.

    Rows where either error is unknown are left out on both sides.
    """
    if not np.array_equal(ours.t_ns, theirs.t_ns):
        raise ValueError("the two errors are at different times")
    inside = judged.inside(ours.t_ns)
    block = {}
    for name, field, axes in RATIOS:
        a, b = getattr(ours, field)[:, axes], getattr(theirs, field)[:, axes]
        rows = inside & np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
        top, bottom = rms(a[rows]), rms(b[rows])
        if top is not None and bottom:
            block[name] = top / bottom
    return block
