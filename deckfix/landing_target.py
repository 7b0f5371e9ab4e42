"""What the autopilot is told of the deck: LANDING_TARGET as ArduPilot takes it, and ODOMETRY.

LANDING_TARGET is sent in MAV_FRAME_BODY_FRD with x, y, z, ``position_valid`` 1 and ``distance`` their norm (without it
ArduPilot ignores the message silently), at more than 10 Hz whether or not a new fix came: between two fixes from the
estimate. It is not sent on an estimate that is stale, or long after the target was last seen, so that the autopilot's
own "target lost" holds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from estimation.frames import Array, quat_exp, quat_multiply, quat_to_matrix
from estimation.landing_config import LandingConfig
from estimation.output import Estimate

BODY_FRD = 12
LOCAL_NED = 1
VISION_FIDUCIAL = 2
ESTIMATOR_VISION = 2
RATE_HZ = 20.0
AHEAD_S = 0.2
"""An estimate is carried forward by no more than this."""


@dataclass(frozen=True, slots=True)
class Newest:
    """The newest estimate with what is needed to use it a little later.

    ``arrival_ns`` is when the inertial sample behind it came (companion's clock), ``rate_radps`` (3,) that sample's
    angular velocity less the bias, ``seen_ns`` the time of the last fused fix's content on the inertial clock.
    """

    estimate: Estimate
    arrival_ns: int
    rate_radps: Array
    seen_ns: int | None = None

    def age_s(self, now_ns: int) -> float:
        """Return the time since the inertial sample came."""
        return (now_ns - self.arrival_ns) * 1e-9

    def seen_age_s(self, now_ns: int) -> float:
        """Return the time since the content of the last fused fix; infinite where there was none."""
        if self.seen_ns is None:
            return math.inf
        return max(0.0, (self.estimate.t_ns - self.seen_ns) * 1e-9 + self.age_s(now_ns))


def why_not(newest: Newest | None, now_ns: int, c: LandingConfig) -> str:
    """Return why the autopilot must be told nothing now, or an empty string."""
    if newest is None:
        return "no estimate"
    e = newest.estimate
    if not newest.age_s(now_ns) <= c.stale_s:
        return "the estimate is stale"
    if not len(e.deck):
        return "the platform is not estimated"
    low = -float(e.deck[2]) <= c.blind_height_m
    if newest.seen_age_s(now_ns) > c.lost_s and not (low and newest.seen_ns is not None):
        return "the target is lost"
    if not (np.isfinite(e.deck).all() and np.isfinite(e.quaternion).all()):
        return "the estimate is not finite"
    if not float(e.deck[2]) < 0.0:
        return "the vehicle is not above the deck"
    return ""


def target_in_body(newest: Newest, now_ns: int) -> Array:
    """Return the target (3,) [m] from the vehicle, body FRD, carried forward to now."""
    e = newest.estimate
    dt = min(AHEAD_S, max(0.0, newest.age_s(now_ns)))
    relative = e.deck[:3] + e.deck[3:6] * dt
    R_nb = quat_to_matrix(quat_multiply(e.quaternion, quat_exp(newest.rate_radps * dt)))
    out: Array = R_nb.T @ -relative
    return out


def landing_target(messages: Any, place_m: Array, time_us: int) -> Any:
    """Return the message for a target at ``place_m`` (3,), body FRD.

    The angles say the same as x, y, z: the direction is (-tan angle_y, tan angle_x, 1).
    """
    x, y, z = (float(v) for v in place_m)
    return messages.MAVLink_landing_target_message(
        time_us, 0, BODY_FRD, math.atan2(y, z), -math.atan2(x, z), math.sqrt(x * x + y * y + z * z), 0.0, 0.0,
        x, y, z, [1.0, 0.0, 0.0, 0.0], VISION_FIDUCIAL, 1,
    )  # fmt: skip


def odometry(messages: Any, newest: Newest, time_us: int, resets: int) -> Any:
    """Return the estimate as ODOMETRY: NED from the origin, velocity and rate in body axes, covariances (21,).

    MAVLink's covariances are upper triangles of 6 x 6: position and attitude, velocity and rate; what is not known is
    NaN. The attitude's error is given about the body axes, as the estimator has it.
    """
    e = newest.estimate
    R_bn = quat_to_matrix(e.quaternion).T
    pose = np.zeros((6, 6))
    places = np.array([0, 1, 2, 6, 7, 8])
    pose[:] = e.covariance[np.ix_(places, places)]
    twist = np.full((6, 6), np.nan)
    twist[:3, :3] = R_bn @ e.covariance[3:6, 3:6] @ R_bn.T
    upper = np.triu_indices(6)
    return messages.MAVLink_odometry_message(
        time_us, LOCAL_NED, BODY_FRD, *(float(v) for v in e.position_m), [float(v) for v in e.quaternion],
        *(float(v) for v in R_bn @ e.velocity_mps), *(float(v) for v in newest.rate_radps),
        [float(v) for v in pose[upper]], [float(v) for v in twist[upper]], resets % 256, ESTIMATOR_VISION, 0,
    )  # fmt: skip
