"""Odometry says what nav_msgs defines, and comes back in the estimator's terms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from estimation.frames import euler_to_quat, quat_exp, quat_multiply, quat_to_matrix
from logs import FlightWriter, open_flight
from logs.estimates import (
    fusion_series,
    odometry_columns,
    odometry_series,
    state_names,
    state_series,
    static_transforms,
)
from logs.topics import row_dtype

RNG = np.random.default_rng(3)
N = 20
STAMP = np.arange(N, dtype=np.int64) * 10_000_000
QUATERNIONS = np.array([quat_exp(v) for v in RNG.normal(size=(N, 3))])
POSITION, VELOCITY, RATE = RNG.normal(size=(3, N, 3))
ROOTS = RNG.normal(size=(N, 9, 9))
COVARIANCE = ROOTS @ ROOTS.transpose(0, 2, 1)


def test_odometry_comes_back() -> None:
    series = odometry_series(
        "/estimate/odometry", STAMP, STAMP + 5, POSITION, VELOCITY, QUATERNIONS, COVARIANCE, RATE
    )
    assert series.data.dtype == row_dtype("/estimate/odometry")
    assert (series.frame_id, series.strings) == ("ned", {"child_frame_id": "base_link_frd"})
    back = odometry_columns(series)
    assert np.array_equal(back.position_m, POSITION)
    assert np.array_equal(back.quaternion_wxyz, QUATERNIONS)
    assert np.array_equal(back.angular_velocity_radps, RATE)
    np.testing.assert_allclose(back.velocity_mps, VELOCITY, atol=1e-14)
    expected = COVARIANCE.copy()
    for other in (slice(0, 3), slice(6, 9)):
        expected[:, 3:6, other] = expected[:, other, 3:6] = 0.0
    np.testing.assert_allclose(back.covariance, expected, atol=1e-12)


def test_twist_and_rotation_are_about_fixed_axes() -> None:
    yaw = euler_to_quat(0.0, 0.0, np.pi / 2)
    covariance = np.diag([0, 0, 0, 1, 2, 3, 4, 5, 6]).astype(float)[None]
    series = odometry_series(
        "/truth/odometry",
        STAMP[:1],
        STAMP[:1],
        np.zeros((1, 3)),
        np.array([[0.0, 2.0, 0.0]]),
        yaw[None],
        covariance,
    )
    np.testing.assert_allclose(series.data["twist_twist_linear"][0], [0, 2, 0], atol=1e-12)
    assert series.metadata["twist_frame"] == "ned"
    # The same message without that mark is in the body's axes: heading east, its second axis points south.
    series.metadata.clear()
    np.testing.assert_allclose(odometry_columns(series).velocity_mps[0], [-2, 0, 0], atol=1e-12)
    pose = series.data["pose_covariance"][0].reshape(6, 6)
    np.testing.assert_allclose(np.diag(pose), [0, 0, 0, 5, 4, 6], atol=1e-12)
    twist = series.data["twist_covariance"][0].reshape(6, 6)
    np.testing.assert_allclose(np.diag(twist), [1, 2, 3, 0, 0, 0], atol=1e-12)
    assert series.data["pose_pose_orientation"][0].tolist() == yaw[[1, 2, 3, 0]].tolist()


def test_fixed_axes_rotation_covariance_is_that_of_the_perturbed_attitude() -> None:
    # A body-frame error d turns q into q * exp(d), which is exp(R d) * q: about NED axes it is R d.
    q, d = QUATERNIONS[0], np.array([1e-3, -2e-3, 3e-3])
    fixed = quat_to_matrix(q) @ d
    np.testing.assert_allclose(quat_multiply(q, quat_exp(d)), quat_multiply(quat_exp(fixed), q), atol=1e-15)


def test_states_and_fusion_reports_through_a_file(tmp_path: Path) -> None:
    names = ["position.x", "gyro_bias.z"]
    values = RNG.normal(size=(N, 2))
    state = state_series(names, STAMP, STAMP + 5, values, np.abs(values))
    nan = np.full((N, 3), np.nan)
    reports = [
        fusion_series(
            sensor,
            STAMP,
            STAMP + 5,
            np.full(N, 3, np.uint8),
            values[:, 0],
            np.full(N, 3, np.uint8),
            nan,
            nan,
            values[:, 1],
        )
        for sensor in ("gps_position", "barometer")
    ]
    with FlightWriter(tmp_path / "f.mcap", clock_offsets_ns={"autopilot": 0}) as writer:
        writer.write_series(state, *reports)
        writer.write_message("/tf_static", static_transforms((1.0, 0.0, 0.0, 0.0)), arrival_ns=0)
    flight = open_flight(tmp_path / "f.mcap")
    (back,) = flight.series("/estimate/state")
    assert state_names(back) == names
    assert np.array_equal(back.data["values"], values)
    assert [c.metadata["sensor"] for c in flight.topics["/fusion"]] == ["gps_position", "barometer"]
    for report, found in zip(reports, flight.series("/fusion"), strict=True):
        assert found.data.tobytes() == report.data.tobytes()
        assert found.strings == report.strings
    (message,) = flight.messages(["/tf_static"])
    frames = [(t.header.frame_id, t.child_frame_id) for t in message.decoded.transforms]
    assert frames == [("map", "ned"), ("base_link", "base_link_frd"), ("base_link_frd", "camera")]
    rotation = message.decoded.transforms[0].transform.rotation
    ned_to_enu = quat_to_matrix(np.array([rotation.w, rotation.x, rotation.y, rotation.z]))
    np.testing.assert_allclose(ned_to_enu @ [1.0, 2.0, 3.0], [2.0, 1.0, -3.0], atol=1e-12)


def test_names_must_match_the_states() -> None:
    with pytest.raises(ValueError, match="1 names for 2 values"):
        state_series(["a"], STAMP, STAMP, np.zeros((N, 2)), np.zeros((N, 2)))
