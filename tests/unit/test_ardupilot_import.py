"""What ArduPilot's dataflash messages become: units, stamps, datum, delay of the filters."""

from __future__ import annotations

import json
import math
from pathlib import Path

import log_bytes as lb
import numpy as np
import pytest

from estimation.frames import euler_to_quat, geodetic_to_ned
from logs.ardupilot import filter_delay, import_dataflash, interpret
from logs.dataflash import decode_dataflash
from logs.datum import ARDUPILOT_RADIUS_M, ardupilot_origin, ardupilot_positions, sphere_scales
from logs.recording import Recording
from logs.sensors import quaternions_from_euler
from logs.stamps import gps_to_utc_ns, in_order, to_ns


def imported(data: bytes) -> Recording:
    return interpret(decode_dataflash(lb.as_bytes(data)))


def test_imu_and_its_filters_delay() -> None:
    (imu,) = imported(lb.flight()).find("/imu")
    np.testing.assert_allclose(imu.data["angular_velocity"][0], [0.01, 0.02, 0.03], rtol=1e-6)
    np.testing.assert_allclose(imu.data["linear_acceleration"][0], [0.1, 0.2, -9.8], rtol=1e-6)
    gyro, accel = (math.sqrt(2) / (2 * math.pi * f) for f in (20.0, 10.0))
    assert float(imu.metadata["gyro_latency_s"]) == pytest.approx(gyro)
    assert float(imu.metadata["accelerometer_latency_s"]) == pytest.approx(accel)
    assert float(imu.metadata["latency_s"]) == pytest.approx((gyro + accel) / 2)


def test_the_delay_formula_is_that_of_the_filter() -> None:
    cutoff = 20.0
    delay = float(filter_delay({"INS_GYRO_FILTER": cutoff, "INS_ACCEL_FILTER": cutoff})["latency_s"])
    w0, w = 2 * math.pi * cutoff, 2 * math.pi * 0.05
    phase = np.angle(w0**2 / ((1j * w) ** 2 + math.sqrt(2) * w0 * 1j * w + w0**2))
    assert delay == pytest.approx(-phase / w, rel=1e-4)
    assert delay == pytest.approx(0.01125, abs=1e-5)
    assert filter_delay({"INS_GYRO_FILTER": 20.0}) == {}
    assert filter_delay({"INS_GYRO_FILTER": 0.0, "INS_ACCEL_FILTER": 0.0})["latency_s"] == "0.0"


def test_gps_in_si_units_and_utc() -> None:
    recording = imported(lb.flight())
    (fix,) = recording.find("/gps/fix")
    (velocity,) = recording.find("/gps/velocity")
    assert (fix.data["latitude"][0], fix.data["longitude"][0]) == (54.0, 7.5)
    assert fix.data["altitude"][0] == 12.34
    assert fix.metadata["altitude_datum"] == "mean sea level"
    assert fix.data["status_status"][0] == 0
    assert fix.data["position_covariance_type"][0] == 0
    np.testing.assert_allclose(velocity.data["twist_twist_linear"][0], [0.0, 1.5, -0.5], atol=1e-12)
    assert not velocity.data["twist_covariance"].any()
    utc_ns = (315964800 + 2300 * 604800 - 18) * 1_000_000_000
    assert recording.clock_offsets_ns["autopilot"] == utc_ns
    assert fix.arrival_ns[0] == utc_ns + fix.stamp_ns[0] == utc_ns + 1_000_000_000


def test_without_a_fix_there_is_no_velocity_and_no_utc() -> None:
    parts = [lb.definition(k) for k in (lb.FMT, lb.IMU, lb.GPS)]
    parts += [lb.imu(k) + lb.gps(k, status=1) for k in range(1000, 6000, 1000)]
    recording = imported(b"".join(parts))
    assert recording.find("/gps/fix")[0].data["status_status"].tolist() == [-1] * 5
    assert np.isnan(recording.find("/gps/velocity")[0].data["twist_twist_linear"]).all()
    assert recording.clock_offsets_ns["autopilot"] == 0
    assert any("no GPS time" in p for p in recording.problems)


def test_leap_seconds_follow_the_date() -> None:
    week, ms = np.array([2300, 1500, 1700]), np.array([0, 1000, 0])
    utc = gps_to_utc_ns(week, ms)
    leap = [18, 14, 16]  # February 2024, October 2008, August 2012
    expected = [315964800 + w * 604800 + m // 1000 - n for w, m, n in zip(week, ms, leap, strict=True)]
    assert (utc // 1_000_000_000).tolist() == expected


def test_further_instances_have_their_own_topics() -> None:
    parts = [lb.definition(k) for k in (lb.FMT, lb.IMU)]
    parts += [lb.imu(1000 * k, instance, -9.0 - instance) for k in range(1, 9) for instance in (0, 1)]
    recording = imported(b"".join(parts))
    assert recording.find("/imu")[0].data["linear_acceleration"][0, 2] == np.float32(-9.0)
    (second,) = recording.find("/imu/1")
    assert second.data["linear_acceleration"][0, 2] == np.float32(-10.0)
    assert second.metadata["message_type"] == "sensor_msgs/msg/Imu"


def test_stamps_that_run_backwards_cost_themselves_only() -> None:
    stamps = [1000, 2000, 999_000_000_000_000, 3000, 10, 4000, 5000, 2**64 - 1, 6000]
    data = b"".join([lb.definition(lb.FMT), lb.definition(lb.IMU), *(lb.imu(t) for t in stamps)])
    recording = imported(data)
    assert recording.find("/imu")[0].stamp_ns.tolist() == [10**6 * k for k in range(1, 7)]
    assert any("IMU 3" in p for p in recording.problems)


def test_in_order_keeps_the_longest_part() -> None:
    stamps = np.concatenate([np.arange(50), np.arange(20)]).astype(np.int64)
    assert in_order(stamps).tolist() == [True] * 50 + [False] * 20
    assert to_ns(np.array([np.nan, np.inf, 1.5])).tolist() == [-1000, 9_000_000_000_000_000_000, 1500]


def test_columns_of_quaternions_equal_the_scalar_function() -> None:
    rng = np.random.default_rng(1)
    angles = rng.uniform([-3.1, -1.5, 0.0], [3.1, 1.5, 6.2], (50, 3))
    made = quaternions_from_euler(*angles.T)
    expected = np.array([euler_to_quat(*a) for a in angles])
    np.testing.assert_allclose(made, expected, atol=1e-14)


def test_local_positions_and_their_origin_are_inverse() -> None:
    rng = np.random.default_rng(2)
    origin = (54.0, 7.5, 10.0)
    places = np.array(origin) + rng.uniform(-1e-3, 1e-3, (20, 3)) * [1, 1, 1e4]
    found = ardupilot_origin(places, ardupilot_positions(places, origin))
    assert found == pytest.approx(origin, abs=1e-9)
    assert ardupilot_origin(places, np.full((20, 3), np.nan)) is None


def test_the_scales_take_sphere_metres_to_the_ellipsoid() -> None:
    origin = (54.0, 7.5, 0.0)
    place = np.array([[54.001, 7.502, 0.0]])
    sphere = ardupilot_positions(place, origin)[0]
    north, east = sphere_scales(54.0, ARDUPILOT_RADIUS_M)
    exact = geodetic_to_ned(*np.radians(place[0, :2]), 0.0, np.array([*np.radians(origin[:2]), 0.0]))
    np.testing.assert_allclose(sphere[:2] * [north, east], exact[:2], atol=2e-3)
    assert abs(sphere[1] - exact[1]) > 0.2


@pytest.mark.parametrize(
    ("flight", "rows", "end_s"), [("calm", 30595, 118.0), ("heave06", 26589, 108.0), ("sea3a", 58195, 187.0)]
)
def test_real_flights(data_dir: Path, flight: str, rows: int, end_s: float) -> None:
    recording = import_dataflash(data_dir / "ardupilot_sitl" / f"{flight}.BIN")
    (imu,) = recording.find("/imu")
    assert len(imu) == rows
    assert imu.stamp_ns[-1] * 1e-9 == pytest.approx(end_s, abs=1.0)
    assert float(imu.metadata["latency_s"]) == pytest.approx(0.01125, abs=1e-5)
    assert 395 < len(imu) / ((imu.stamp_ns[-1] - imu.stamp_ns[0]) * 1e-9) < 405
    (truth,) = recording.find("/truth/odometry")
    (own,) = recording.find("/autopilot/odometry")
    assert np.all(np.isin(own.stamp_ns, truth.stamp_ns))
    position = truth.data["pose_pose_position"]
    assert position[0] == pytest.approx([0, 0, -0.1], abs=0.01)
    assert position[-1, :2] == pytest.approx([2.0, 2.236], abs=0.1)
    origins = recording.metadata["deckfix.origin"]
    assert float(origins["truth_origin_latitude_deg"]) == pytest.approx(54.0, abs=1e-7)
    assert float(origins["truth_origin_altitude_m"]) == pytest.approx(10.0, abs=0.01)
    shift = float(origins["truth_origin_altitude_m"]) - float(origins["autopilot_origin_altitude_m"])
    flying = slice(len(position) // 4, len(position) // 2)
    apart = own.data["pose_pose_position"][flying] - position[flying]
    assert np.median(apart[:, 2]) == pytest.approx(shift, abs=0.35)
    assert np.abs(apart[:, :2]).max() < 1.0
    q, w = own.data["pose_pose_orientation"], truth.data["pose_pose_orientation"][: len(own)]
    assert np.degrees(2 * np.arccos(np.clip(np.abs(np.sum(q * w, axis=1)), 0, 1))).max() < 10.0
    (field,) = recording.find("/magnetic_field")
    assert np.linalg.norm(field.data["magnetic_field"], axis=1).mean() == pytest.approx(5e-5, rel=0.05)
    assert float(field.metadata["autopilot_declination_rad"]) == pytest.approx(math.radians(3.02), abs=1e-3)
    (baro,) = recording.find("/baro")
    assert 1.0e5 < baro.data["fluid_pressure"].min() < baro.data["fluid_pressure"].max() < 1.02e5
    (distance,) = recording.find("/range")
    assert distance.data["min_range"][0] == np.float32(0.1)
    assert distance.data["max_range"][0] == 40.0
    parameters = json.loads(recording.attachments["parameters.json"][1])
    assert parameters["PLND_ENABLED"] == 1.0
    assert "XKF4" not in recording.metadata["deckfix.source"]["not_imported"]
    assert any(s.strings["msg"].startswith("SIM Hit ground") for s in recording.find("/log"))
