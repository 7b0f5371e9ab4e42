"""Estimates, truth and reports of fusion <-> the columns of their topics.

``nav_msgs/Odometry`` has the rotational covariance about the fixed axes of ``header.frame_id``; the estimator has
the attitude error as a rotation vector in the body frame. These functions turn the one into the other and back:

- twist.linear is the velocity in NED axes, as in every odometry topic of this project, and the channel's metadata say
  so (``twist_frame`` = ``ned``); a series without that is read as the message defines it, in the body's axes;
- rotational pose covariance is ``R_nb P_b R_nb^T``;
- correlations of velocity with position and attitude have no place in the message and come back as zero;
- no covariance at all (truth, another estimator's attitude) is written as zeros.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.events import AUTOPILOT
from estimation.modes import Decision
from logs.recording import Series
from logs.topics import TOPICS, new_rows

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_POSE = np.array([0, 1, 2, 6, 7, 8])
_NED_TO_ENU_WXYZ = (0.0, 0.5**0.5, 0.5**0.5, 0.0)
_FRD_TO_FLU_WXYZ = (0.0, 1.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class OdometryColumns:
    """An odometry topic in the estimator's terms.

    ``position_m`` (n, 3) and ``velocity_mps`` (n, 3) in the axes of the header's frame (NED),
    ``quaternion_wxyz`` (n, 4) body to NED, ``angular_velocity_radps`` (n, 3) in the body frame,
    ``covariance`` (n, 9, 9) of position, velocity and attitude error (rotation vector in the body frame).
    """

    stamp_ns: I64
    arrival_ns: I64
    position_m: F64
    velocity_mps: F64
    quaternion_wxyz: F64
    angular_velocity_radps: F64
    covariance: F64


def odometry_series(
    topic: str,
    stamp_ns: I64,
    arrival_ns: I64,
    position_m: F64,
    velocity_mps: F64,
    quaternion_wxyz: F64,
    covariance: F64 | None = None,
    angular_velocity_radps: F64 | None = None,
    *,
    clock: str = AUTOPILOT,
    metadata: Mapping[str, str] | None = None,
) -> Series:
    """Return a ``nav_msgs/Odometry`` series; shapes and frames as in ``OdometryColumns``.

    Law: ``odometry_columns`` gives the arguments back, but for rounding and the correlations of velocity.
    """
    data = new_rows(topic, len(stamp_ns))
    rotation = _matrices(quaternion_wxyz)
    data["pose_pose_position"] = position_m
    data["pose_pose_orientation"] = quaternion_wxyz[:, [1, 2, 3, 0]]
    data["twist_twist_linear"] = velocity_mps
    if angular_velocity_radps is not None:
        data["twist_twist_angular"] = angular_velocity_radps
    if covariance is not None:
        pose = covariance[:, _POSE[:, None], _POSE].copy()
        pose[:, 3:] = rotation @ pose[:, 3:]
        pose[:, :, 3:] = pose[:, :, 3:] @ rotation.transpose(0, 2, 1)
        data["pose_covariance"] = pose.reshape(-1, 36)
        twist = np.zeros((len(stamp_ns), 6, 6))
        twist[:, :3, :3] = covariance[:, 3:6, 3:6]
        data["twist_covariance"] = twist.reshape(-1, 36)
    known = TOPICS[topic]
    return Series(
        topic,
        np.asarray(stamp_ns, dtype=np.int64),
        np.asarray(arrival_ns, dtype=np.int64),
        data,
        clock,
        known.frame_id,
        dict(known.strings),
        {"twist_frame": "ned", **(metadata or {})},
    )


def odometry_columns(series: Series) -> OdometryColumns:
    """Return an odometry series in the estimator's terms."""
    data = series.data
    quaternion = data["pose_pose_orientation"][:, [3, 0, 1, 2]]
    rotation = _matrices(quaternion)
    back = rotation.transpose(0, 2, 1)
    pose = data["pose_covariance"].reshape(-1, 6, 6).copy()
    pose[:, 3:] = back @ pose[:, 3:]
    pose[:, :, 3:] = pose[:, :, 3:] @ rotation
    covariance = np.zeros((len(data), 9, 9))
    covariance[:, _POSE[:, None], _POSE] = pose
    twist = data["twist_covariance"].reshape(-1, 6, 6)[:, :3, :3]
    velocity = data["twist_twist_linear"].copy()
    if series.metadata.get("twist_frame") != "ned":
        velocity = np.einsum("nij,nj->ni", rotation, velocity)
        twist = rotation @ twist @ back
    covariance[:, 3:6, 3:6] = twist
    return OdometryColumns(
        series.stamp_ns,
        series.arrival_ns,
        data["pose_pose_position"].copy(),
        velocity,
        quaternion,
        data["twist_twist_angular"].copy(),
        covariance,
    )


def state_series(
    names: Sequence[str],
    stamp_ns: I64,
    arrival_ns: I64,
    values: F64,
    sigmas: F64,
    *,
    clock: str = AUTOPILOT,
) -> Series:
    """Return all states (n, k) with their standard deviations (n, k) as ``/estimate/state``.

    Raises:
        ValueError: there are not as many names as states.
    """
    if not len(names) == values.shape[1] == sigmas.shape[1]:
        raise ValueError(f"{len(names)} names for {values.shape[1]} values and {sigmas.shape[1]} sigmas")
    data = new_rows("/estimate/state", len(stamp_ns), values=len(names), sigmas=len(names))
    data["values"], data["sigmas"] = values, sigmas
    strings = {f"names_{i}": name for i, name in enumerate(names)}
    return Series("/estimate/state", stamp_ns, arrival_ns, data, clock, "ned", strings)


def state_names(series: Series) -> list[str]:
    """Return the names of the states of a ``/estimate/state`` series."""
    return [series.strings[f"names_{i}"] for i in range(series.data["values"].shape[1])]


def fusion_series(
    sensor: str,
    stamp_ns: I64,
    arrival_ns: I64,
    outcome: NDArray[np.uint8],
    nis: F64,
    dof: NDArray[np.uint8],
    innovation: F64,
    sigma: F64,
    age_s: F64,
    *,
    clock: str = AUTOPILOT,
) -> Series:
    """Return one sensor's fusion records as ``/fusion``; innovation and its sigma (n, 3), NaN beyond
    ``dof``."""
    data = new_rows("/fusion", len(stamp_ns))
    data["outcome"], data["nis"], data["dof"] = outcome, nis, dof
    data["innovation"], data["sigma"], data["age_s"] = innovation, sigma, age_s
    metadata = {"sensor": sensor}
    return Series("/fusion", stamp_ns, arrival_ns, data, clock, sensor, {"sensor": sensor}, metadata)


def landing_series(
    stamp_ns: I64, arrival_ns: I64, decisions: Sequence[Decision], *, clock: str = AUTOPILOT
) -> list[Series]:
    """Return what the landing decided as ``/landing/mode``: a series for each reason, whose strings are constant."""
    known = TOPICS["/landing/mode"]
    made = []
    reasons = np.array([str(d.reason) for d in decisions])
    for reason in dict.fromkeys(reasons.tolist()):
        rows = np.flatnonzero(reasons == reason)
        data = new_rows("/landing/mode", len(rows))
        for row, k in zip(data, rows.tolist(), strict=True):
            d = decisions[k]
            row["mode"], row["setpoint"], row["velocity"] = int(d.mode), d.relative_m, d.velocity_mps
            row["setpoint_yaw_rad"] = d.yaw_rad
            row["inside_probability"], row["quiet_probability"] = d.inside_probability, d.quiet_probability
        strings = {"reason": reason}
        made.append(
            Series(known.name, stamp_ns[rows], arrival_ns[rows], data, clock, known.frame_id, strings)
        )
    return made


def static_transforms(
    camera_to_body_wxyz: Sequence[float] | None = None, camera_position_m: Sequence[float] = (0.0, 0.0, 0.0)
) -> dict[str, object]:
    """Return the message for ``/tf_static``: map (ENU) -> ned, base_link (FLU) -> base_link_frd -> camera.

    A transform's rotation takes vectors of the child's axes to the parent's. ``camera_to_body_wxyz`` is
    ``q_bc``, ``camera_position_m`` the camera in the body frame (FRD).
    """
    transforms = [
        _transform("map", "ned", _NED_TO_ENU_WXYZ, (0.0, 0.0, 0.0)),
        _transform("base_link", "base_link_frd", _FRD_TO_FLU_WXYZ, (0.0, 0.0, 0.0)),
    ]
    if camera_to_body_wxyz is not None:
        transforms.append(_transform("base_link_frd", "camera", camera_to_body_wxyz, camera_position_m))
    return {"transforms": transforms}


def _transform(
    parent: str, child: str, wxyz: Sequence[float], translation: Sequence[float]
) -> dict[str, object]:
    w, x, y, z = wxyz
    return {
        "header": {"frame_id": parent},
        "child_frame_id": child,
        "transform": {
            "translation": dict(zip("xyz", translation, strict=True)),
            "rotation": {"x": x, "y": y, "z": z, "w": w},
        },
    }


def _matrices(q: F64) -> F64:
    """Return the rotation matrices (n, 3, 3) of unit quaternions (n, 4: w x y z)."""
    w, x, y, z = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrices: F64 = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    return matrices
