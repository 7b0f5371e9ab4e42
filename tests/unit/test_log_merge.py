"""Files to one recording: recognised by content, merged by their clocks, refused with a reason."""

from __future__ import annotations

import shutil
from pathlib import Path

import log_bytes as lb
import numpy as np
import pytest

from logs.errors import LogError
from logs.importer import DATAFLASH, TELEMETRY, ULOG, import_files, recognise
from logs.stamps import gps_to_utc_ns


def write(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


def utc_of_boot_us(week: int = 2300) -> int:
    return int(gps_to_utc_ns(np.array([week]), np.array([0]))[0]) // 1000


def system_time(boot_us: int, week: int = 2300) -> tuple[int, str, dict[str, int], tuple[int, int]]:
    fields = {"time_unix_usec": utc_of_boot_us(week) + boot_us, "time_boot_ms": boot_us // 1000}
    return lb.UTC_US + boot_us, "SYSTEM_TIME", fields, (1, 1)


@pytest.mark.parametrize(
    ("name", "data", "kind"),
    [
        ("a.tlog", lb.flight(), DATAFLASH),
        ("b.BIN", lb.telemetry(lb.telemetry_flight()), TELEMETRY),
        ("c.mcap", lb.text_log().encode(), DATAFLASH),
        ("d", b"\x00" * 300 + lb.flight(), DATAFLASH),
        ("e.txt", b"ULog\x01\x12\x35\x01", ULOG),
    ],
)
def test_kinds_are_told_by_content(tmp_path: Path, name: str, data: bytes, kind: str) -> None:
    assert recognise(write(tmp_path, name, data)) == kind


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"", "the file is empty"),
        (b"\x89MCAP0\r\n" + b"\0" * 50, "MCAP file already"),
        (b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 20, "no log that can be imported"),
        (b"time,lat,lon\n1,2,3\n" * 50, "no log that can be imported"),
    ],
)
def test_foreign_files_are_refused(tmp_path: Path, data: bytes, problem: str) -> None:
    path = write(tmp_path, "x.BIN", data)
    with pytest.raises(LogError, match=problem) as caught:
        import_files([path])
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_missing_files_folders_and_nothing_are_refused(tmp_path: Path) -> None:
    for paths, problem in (([tmp_path / "no"], "no such file"), ([tmp_path], "folder"), ([], "no file")):
        with pytest.raises(LogError, match=problem):
            import_files(paths)


def test_a_flight_of_two_files_is_one_recording(tmp_path: Path) -> None:
    onboard = write(tmp_path, "flight.BIN", lb.flight(seconds=3.0))
    items = [*lb.telemetry_flight(seconds=4.0), system_time(2_000_000)]
    telemetry = write(tmp_path, "flight.tlog", lb.telemetry(items))
    for paths in ([onboard, telemetry], [telemetry, onboard]):
        recording = import_files(paths)
        (imu,) = recording.find("/imu")
        assert len(imu) == 300
        offset = recording.clock_offsets_ns["autopilot"]
        assert offset == (lb.UTC_US + 1000) * 1000
        np.testing.assert_array_equal(imu.arrival_ns, imu.stamp_ns + offset)
        assert len(recording.find("/vision/fix")[0]) == 40
        assert len(recording.find("/timesync")[0]) == 20
        assert len(recording.find("/magnetic_field")[0]) == 20
        left_out = recording.metadata["deckfix.merge"]["left_out"]
        assert "/imu 200" in left_out
        assert "/baro" in left_out
        assert "off GPS time" in " ".join(recording.problems)
        assert "flight.BIN (ArduPilot dataflash log" in " ".join(recording.metadata["deckfix.files"].values())


def test_files_of_different_flights_are_refused(tmp_path: Path) -> None:
    onboard = write(tmp_path, "a.BIN", lb.flight())
    other = write(
        tmp_path, "b.tlog", lb.telemetry([*lb.telemetry_flight(), system_time(2_000_000, week=2301)])
    )
    with pytest.raises(LogError, match=r"different flights.*604800 s apart"):
        import_files([onboard, other])
    late = lb.telemetry(lb.telemetry_flight(start_us=500_000_000))
    with pytest.raises(LogError, match="do not overlap"):
        import_files([onboard, write(tmp_path, "c.tlog", late)])


def test_files_of_different_vehicles_are_refused(tmp_path: Path) -> None:
    named = lb.flight() + lb.message(lb.PARM, 3_000_000, "SYSID_THISMAV", 4.0, 1.0)
    onboard = write(tmp_path, "a.BIN", named)
    telemetry = write(tmp_path, "b.tlog", lb.telemetry(lb.telemetry_flight()))
    with pytest.raises(LogError, match=r"different vehicles \(system 4 and 1\)"):
        import_files([onboard, telemetry])


def test_two_of_a_kind_are_refused(tmp_path: Path) -> None:
    paths = [write(tmp_path, n, lb.flight()) for n in ("a.BIN", "b.BIN")]
    with pytest.raises(LogError, match="same kind"):
        import_files(paths)


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    no_imu = b"".join(
        [lb.definition(lb.FMT), lb.definition(lb.GPS), *(lb.gps(200_000 * k, 1) for k in range(1, 9))]
    )
    problems = " ".join(import_files([write(tmp_path, "a.BIN", no_imu)]).problems)
    assert "no IMU data" in problems
    assert "the GPS never had a fix" in problems
    no_gps = b"".join(
        [lb.definition(lb.FMT), lb.definition(lb.IMU), *(lb.imu(10_000 * k) for k in range(1, 99))]
    )
    assert any("no GPS data" in p for p in import_files([write(tmp_path, "b.BIN", no_gps)]).problems)


def test_gaps_and_numbers_that_are_none_are_said(tmp_path: Path) -> None:
    pause = b"".join(lb.imu(303_000_000 + 10_000 * k, acc_z=float("nan")) for k in range(10))
    problems = import_files([write(tmp_path, "a.BIN", lb.flight() + pause)]).problems
    assert any(p.startswith("/imu has gaps: 300.0 s at 2.0 s") for p in problems)
    assert any("10 of 210 messages on /imu" in p and "not finite" in p for p in problems)


def test_a_log_of_nothing_useful_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, "a.BIN", lb.definition(lb.FMT) + lb.definition(lb.IMU))
    with pytest.raises(LogError, match="no message that can be used"):
        import_files([path])


@pytest.mark.parametrize("flight", ["calm", "heave06", "sea3a"])
def test_real_flights_merge(data_dir: Path, flight: str) -> None:
    folder = data_dir / "ardupilot_sitl"
    recording = import_files([folder / f"{flight}.BIN", folder / f"{flight}.tlog"])
    alone = import_files([folder / f"{flight}.BIN"])
    for topic in ("/imu", "/gps/fix", "/gps/velocity", "/baro", "/magnetic_field", "/truth/odometry"):
        (both,), (one,) = recording.find(topic), alone.find(topic)
        np.testing.assert_array_equal(both.stamp_ns, one.stamp_ns)
        assert both.data.tobytes() == one.data.tobytes()
    (fixes,) = recording.find("/vision/fix")
    (sync,) = recording.find("/timesync")
    assert len(fixes) == {"calm": 1142, "heave06": 1080, "sea3a": 2533}[flight]
    assert len(sync) > 500
    trip = sync.data["received_ns"] - sync.data["sent_ns"]
    assert 0 < np.median(trip) < 5_000_000
    assert "PL" not in " ".join(p.split(":")[0] for p in recording.problems)
    assert any("PL" in p for p in alone.problems)


def test_real_vision_fixes_are_what_was_measured(data_dir: Path) -> None:
    folder = data_dir / "ardupilot_sitl"
    (fixes,) = import_files([folder / "sea3a.tlog"]).find("/vision/fix")
    sent = np.genfromtxt(folder / "sea3a.vis.csv", delimiter=",", names=True)
    rows = np.searchsorted(sent["capture_mono_us"], fixes.stamp_ns // 1000)
    np.testing.assert_array_equal(sent["capture_mono_us"][rows], fixes.stamp_ns // 1000)
    x, y, z = fixes.data["pose_pose_position"].T
    np.testing.assert_allclose(np.stack([-y, x, z]), [sent[f"meas_{a}"][rows] for a in "xyz"], atol=1e-5)


def test_real_flights_of_two_names_are_refused(data_dir: Path) -> None:
    folder = data_dir / "ardupilot_sitl"
    with pytest.raises(LogError, match=r"different flights \(the autopilot booted 990 s apart\)"):
        import_files([folder / "calm.BIN", folder / "heave06.tlog"])


@pytest.mark.parametrize(
    ("name", "imu", "fixes"), [("sample_log_small", 1298, 32), ("sample_appended_multiple", 2373, 0)]
)
def test_real_px4_logs(data_dir: Path, tmp_path: Path, name: str, imu: int, fixes: int) -> None:
    pytest.importorskip("pyulog")
    copy = tmp_path / "renamed.bin"
    shutil.copy(data_dir / "ulog" / f"{name}.ulg", copy)
    recording = import_files([copy])
    (found,) = recording.find("/imu")
    assert len(found) == imu
    assert np.linalg.norm(np.median(found.data["linear_acceleration"], axis=0)) == pytest.approx(9.8, abs=0.3)
    assert sum(len(s) for s in recording.find("/gps/fix")) == fixes
    (baro,), (field,) = recording.find("/baro"), recording.find("/magnetic_field")
    assert 9e4 < np.median(baro.data["fluid_pressure"]) < 1.05e5
    assert 2e-5 < np.median(np.linalg.norm(field.data["magnetic_field"], axis=1)) < 2e-4
    assert np.linalg.norm(recording.find("/attitude")[0].data["quaternion"][0]) == pytest.approx(
        1.0, abs=1e-3
    )
    assert 0.001 < float(found.metadata["latency_s"]) < 0.005


def test_pressure_from_px4s_barometric_altitude(data_dir: Path) -> None:
    pytest.importorskip("pyulog")
    (baro,) = import_files([data_dir / "ulog" / "sample_appended_multiple.ulg"]).find("/baro")
    # The first altitude in the log is 328.789 m; the standard atmosphere has 97 440 Pa there.
    assert baro.data["fluid_pressure"][0] == pytest.approx(97_440, abs=40)
    assert "standard atmosphere" in baro.metadata["pressure"]
