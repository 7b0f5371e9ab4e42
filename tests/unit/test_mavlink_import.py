"""Telemetry logs: frames found and checked, a vehicle and a boot chosen, the companion understood."""

from __future__ import annotations

import math
import struct
from collections import Counter
from pathlib import Path

import log_bytes as lb
import numpy as np
import pytest

from estimation.frames import R_CB_NOMINAL
from logs.errors import LogError
from logs.mavlink import import_telemetry
from logs.tlog import find_frames, read_telemetry


def frames(data: bytes):
    return find_frames(lb.as_bytes(data))


def imported(tmp_path: Path, data: bytes, system: int | None = None):
    path = tmp_path / "flight.tlog"
    path.write_bytes(data)
    return import_telemetry(path, system)


@pytest.mark.parametrize("version", [1, 2])
def test_frames_of_both_versions_are_decoded(version: int) -> None:
    items = [i for i in lb.telemetry_flight() if version == 2 or i[1] != "LANDING_TARGET"]
    log = frames(lb.telemetry(items, version=version))
    assert log.names() == Counter(name for _, name, _, _ in items)
    imu = log.messages("HIGHRES_IMU")
    wanted = [(a, f) for a, name, f, _ in items if name == "HIGHRES_IMU"]
    assert imu.arrival_ns.tolist() == [a * 1000 for a, _ in wanted]
    assert imu.data["time_usec"].tolist() == [f["time_usec"] for _, f in wanted]
    assert imu.data["zacc"].tolist() == [np.float32(-9.8)] * len(wanted)
    assert log.problems == []


def test_shortened_payloads_are_filled_with_zeros() -> None:
    target = lb.landing_target(5, position_valid=0, type=0, q=[0.0] * 4, z=0.0, y=0.0, x=0.0)
    full = lb.telemetry([(lb.UTC_US, "LANDING_TARGET", lb.landing_target(5), (1, 191))])
    short = lb.telemetry([(lb.UTC_US, "LANDING_TARGET", target, (1, 191))])
    assert len(short) < len(full)
    row = frames(short).messages("LANDING_TARGET").data[0]
    assert row["distance"] == 5.0
    assert row["position_valid"] == 0


def test_a_frame_with_a_wrong_check_sum_is_passed_over() -> None:
    items = lb.telemetry_flight()
    data = bytearray(lb.telemetry(items))
    data[200] ^= 1
    log = frames(bytes(data))
    assert len(log) == len(items) - 1
    assert any("not readable frames" in p for p in log.problems)


def test_garbage_and_a_cut_end_cost_nothing_else() -> None:
    items = lb.telemetry_flight()
    half = lb.telemetry(items[: len(items) // 2])
    rest = lb.telemetry(items[len(items) // 2 :])
    log = frames(half + b"\xfd\x20\xfe" * 30 + rest[:-5])
    assert len(log) == len(items) - 1


def test_signed_frames_are_read() -> None:
    from pymavlink.dialects.v20 import ardupilotmega

    writer = ardupilotmega.MAVLink(None, 1, 1)
    writer.signing.secret_key = b"k" * 32
    writer.signing.sign_outgoing = True
    packet = ardupilotmega.MAVLink_highres_imu_message(**lb.highres_imu(5)).pack(writer)
    one = struct.pack(">Q", lb.UTC_US) + packet
    assert packet[2] & 1
    assert len(frames(one * 3)) == 3


def test_sensors_stamps_and_arrivals(tmp_path: Path) -> None:
    recording = imported(tmp_path, lb.telemetry(lb.telemetry_flight(seconds=4.0)))
    (imu,) = recording.find("/imu")
    assert len(imu) == 200
    assert imu.stamp_ns[:2].tolist() == [1_000_000_000, 1_020_000_000]
    assert imu.arrival_ns[0] == (lb.UTC_US + 1_001_000) * 1000
    np.testing.assert_allclose(imu.data["linear_acceleration"][0], [0, 0, -9.8], rtol=1e-6)
    (field,) = recording.find("/magnetic_field")
    np.testing.assert_allclose(field.data["magnetic_field"][0], [2e-5, 0, 4e-5], rtol=1e-6)
    assert recording.find("/baro")[0].data["fluid_pressure"][0] == pytest.approx(101325.0, rel=1e-6)
    assert recording.clock_offsets_ns["autopilot"] == (lb.UTC_US + 1000) * 1000


def test_ardupilots_field_in_other_units_is_recognised(tmp_path: Path) -> None:
    items = lb.telemetry_flight()
    for _, name, fields, _ in items:
        if name == "HIGHRES_IMU":
            fields.update(xmag=200_000.0, zmag=400_000.0)
    (field,) = imported(tmp_path, lb.telemetry(items)).find("/magnetic_field")
    np.testing.assert_allclose(field.data["magnetic_field"][0], [2e-5, 0, 4e-5], rtol=1e-6)


def test_clock_exchanges_are_paired_by_the_askers_time(tmp_path: Path) -> None:
    items = lb.telemetry_flight(seconds=4.0)
    items.append((lb.UTC_US + 5_100_000, "TIMESYNC", {"tc1": 77, "ts1": 12345}, (1, 1)))
    items.append((lb.UTC_US + 5_200_000, "TIMESYNC", {"tc1": 0, "ts1": 5_200_000_000}, (1, 1)))
    recording = imported(tmp_path, lb.telemetry(items))
    (sync,) = recording.find("/timesync")
    assert len(sync) == 20
    assert sync.clock == "autopilot"
    assert sync.strings["reference_clock"] == "companion"
    np.testing.assert_array_equal(sync.data["received_ns"] - sync.data["sent_ns"], 4_000_000)
    np.testing.assert_array_equal(sync.data["sent_ns"] - sync.data["remote_ns"], 100_000_000_000 - 2_000_000)
    np.testing.assert_array_equal(sync.stamp_ns, sync.data["remote_ns"])
    assert recording.clock_offsets_ns["companion"] == (lb.UTC_US - 100_000_000) * 1000


def test_vision_fixes_are_in_the_camera_frame_and_the_companions_clock(tmp_path: Path) -> None:
    items = lb.telemetry_flight(seconds=4.0)
    at = lb.UTC_US + 5_000_000
    angles = lb.landing_target(
        104_950_000, position_valid=0, frame=0, angle_x=0.1, angle_y=-0.2, distance=5.0
    )
    nothing = lb.landing_target(104_960_000, position_valid=0, distance=0.0)
    local = lb.landing_target(104_970_000, frame=20)
    items += [(at, "LANDING_TARGET", m, (1, 191)) for m in (angles, nothing, local)]
    recording = imported(tmp_path, lb.telemetry(items))
    (fixes,) = recording.find("/vision/fix")
    assert len(fixes) == 41
    assert fixes.clock == "companion"
    assert fixes.stamp_ns[0] == 100_950_000_000
    body = fixes.data["pose_pose_position"] @ R_CB_NOMINAL
    np.testing.assert_allclose(body[0], [1.0, 0.5, 4.0])
    np.testing.assert_allclose(body[-1] / body[-1, 2], [math.tan(0.2), math.tan(0.1), 1.0], rtol=1e-6)
    assert np.linalg.norm(body[-1]) == pytest.approx(5.0)
    assert not fixes.data["pose_covariance"].any()
    assert any("2 LANDING_TARGET messages" in p for p in recording.problems)


def test_repeated_values_of_a_slow_sensor_are_thinned(tmp_path: Path) -> None:
    items = lb.telemetry_flight(seconds=4.0)
    imu = [fields for _, name, fields, _ in items if name == "HIGHRES_IMU"]
    for k, fields in enumerate(imu[:100]):
        fields["xmag"] = 0.1 + 0.01 * (k // 5)
    (field,) = imported(tmp_path, lb.telemetry(items)).find("/magnetic_field")
    steps = np.diff(field.stamp_ns) // 1_000_000
    assert steps[:19].tolist() == [100] * 19
    assert set(steps[20:].tolist()) == {200}


@pytest.mark.parametrize(("shift_us", "clock"), [(0, "companion"), (-100_000_000, "autopilot")])
def test_the_clock_of_vision_fixes_is_found(tmp_path: Path, shift_us: int, clock: str) -> None:
    items = lb.telemetry_flight(seconds=4.0)
    for _, name, fields, _ in items:
        if name == "LANDING_TARGET":
            fields["time_usec"] += shift_us
    (fixes,) = imported(tmp_path, lb.telemetry(items)).find("/vision/fix")
    assert fixes.clock == clock
    assert fixes.metadata["stamps"] == "own"


def test_fixes_without_a_time_are_said_to_be_stamped_by_arrival(tmp_path: Path) -> None:
    items = lb.telemetry_flight(seconds=4.0)
    for _, name, fields, _ in items:
        if name == "LANDING_TARGET":
            fields["time_usec"] = 0
    recording = imported(tmp_path, lb.telemetry(items))
    (fixes,) = recording.find("/vision/fix")
    assert fixes.metadata["stamps"] == "arrival"
    assert any("stamped with their arrival" in p for p in recording.problems)


def test_of_two_vehicles_the_one_with_most_imu_data_is_taken(tmp_path: Path) -> None:
    items = lb.telemetry_flight(seconds=4.0, system=7) + lb.telemetry_flight(seconds=2.0, system=3)
    data = lb.telemetry(sorted(items, key=lambda i: i[0]))
    recording = imported(tmp_path, data)
    assert len(recording.find("/imu")[0]) == 200
    assert recording.metadata["deckfix.source"]["system_id"] == "7"
    assert any("2 vehicles" in p for p in recording.problems)
    other = imported(tmp_path, data, system=3)
    assert len(other.find("/imu")[0]) == 100
    assert not any("vehicles" in p for p in other.problems)
    with pytest.raises(LogError, match=r"no autopilot has system id 9.*3, 7"):
        imported(tmp_path, data, system=9)


def test_of_a_restart_the_longest_boot_is_taken(tmp_path: Path) -> None:
    before = lb.telemetry_flight(seconds=3.0, start_us=60_000_000)
    after = lb.telemetry_flight(seconds=8.0, start_us=1_000_000, offset_us=lb.UTC_US + 70_000_000)
    recording = imported(tmp_path, lb.telemetry(before + after))
    (imu,) = recording.find("/imu")
    assert len(imu) == 400
    assert imu.stamp_ns[0] == 1_000_000_000
    assert np.all(np.diff(imu.stamp_ns) > 0)
    assert any("restarted 1 times" in p for p in recording.problems)


def test_gps_without_vertical_speed_says_so_in_its_covariance(tmp_path: Path) -> None:
    items = lb.telemetry_flight()
    fix = {"fix_type": 3, "lat": 540000000, "lon": 75000000, "alt": 12340, "eph": 90, "epv": 120, "vel": 150,
           "cog": 9000, "satellites_visible": 12, "alt_ellipsoid": 52340, "h_acc": 800, "v_acc": 1200,
           "vel_acc": 300, "hdg_acc": 0}  # fmt: skip
    for k in range(5):
        message = fix | {"time_usec": 1_000_000 + 200_000 * (k // 2)}
        items.append((lb.UTC_US + 4_000_000 + k, "GPS_RAW_INT", message, (1, 1)))
    recording = imported(tmp_path, lb.telemetry(items))
    (position,) = recording.find("/gps/fix")
    (velocity,) = recording.find("/gps/velocity")
    assert len(position) == len(velocity) == 3
    assert position.data["altitude"][0] == pytest.approx(52.34)
    assert position.data["position_covariance"][0, [0, 4, 8]].tolist() == pytest.approx([0.64, 0.64, 1.44])
    np.testing.assert_allclose(velocity.data["twist_twist_linear"][0], [0, 1.5, 0], atol=1e-12)
    assert velocity.data["twist_covariance"][0, [0, 7, 14]].tolist() == pytest.approx([0.09, 0.09, 1e6])
    np.testing.assert_array_equal(position.stamp_ns, velocity.stamp_ns)


def test_long_texts_are_put_together(tmp_path: Path) -> None:
    items = lb.telemetry_flight()
    for part, text in enumerate([b"a" * 50, b"b" * 10]):
        fields = {"severity": 3, "text": text, "id": 9, "chunk_seq": part}
        items.append((lb.UTC_US + 3_000_000 + part, "STATUSTEXT", fields, (1, 1)))
    (text,) = imported(tmp_path, lb.telemetry(items)).find("/log")
    assert text.strings["msg"] == "a" * 50 + "b" * 10
    assert text.data["level"].tolist() == [40]


def test_a_log_without_an_autopilot_is_refused(tmp_path: Path) -> None:
    items = [(lb.UTC_US + k, "HEARTBEAT", lb.heartbeat(8), (255, 190)) for k in range(5)]
    with pytest.raises(LogError, match="no autopilot"):
        imported(tmp_path, lb.telemetry(items))


@pytest.mark.parametrize("data", [b"x" * 1000, bytes(range(256)) * 8, b"\xfd" * 5000, b"\xfe\x00" * 900])
def test_what_is_no_telemetry_is_refused(data: bytes) -> None:
    with pytest.raises(LogError, match="no intact MAVLink frame"):
        frames(data)


def test_real_telemetry_equals_pymavlink(data_dir: Path) -> None:
    from pymavlink import mavutil

    path = data_dir / "ardupilot_sitl" / "heave06.tlog"
    log = read_telemetry(path)
    tables = {name: log.messages(name) for name in log.names()}
    reader = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
    seen: Counter[str] = Counter()
    while (m := reader.recv_msg()) is not None and sum(seen.values()) < 8000:
        name = m.get_type()
        table, k = tables[name], seen[name]
        seen[name] += 1
        assert (table.system[k], table.component[k]) == (m.get_srcSystem(), m.get_srcComponent())
        assert table.arrival_ns[k] / 1e9 == pytest.approx(m._timestamp, abs=1e-6)
        for column in m.get_fieldnames():
            theirs, ours = getattr(m, column), table.data[k][column]
            if isinstance(theirs, str):
                assert ours == theirs.encode()
            else:
                np.testing.assert_array_equal(np.asarray(ours), np.asarray(theirs))
    assert log.problems == []
