"""What went wrong: each kind of trouble is told, with a cause and a remedy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from synthetic_result import synthetic_result

from deckfix.finding import Severity
from deckfix.findings import findings, verdict
from deckfix.result import Result
from deckfix.streams import stream
from estimation.events import Kind
from estimation.outcome import Outcome


def symptoms(result: Result) -> dict[str, Severity]:
    found = findings(result)
    assert all(f.cause and f.remedy for f in found)
    assert [f.severity for f in found] == sorted((f.severity for f in found), reverse=True)
    return {f.symptom: f.severity for f in found}


def having(told: dict[str, Severity], text: str) -> Severity:
    matching = [s for t, s in told.items() if text in t]
    assert matching, (text, list(told))
    return matching[0]


def test_a_good_flight_has_none() -> None:
    result = synthetic_result()
    assert findings(result) == []
    assert verdict(result, []).startswith("Nothing went wrong")


def test_rejections_are_told_by_outcome() -> None:
    result = synthetic_result()
    records = result.run.records.copy()
    gps = np.flatnonzero(records["sensor"] == 0)
    records["outcome"][gps[: len(gps) * 2 // 3]] = int(Outcome.REJECTED_GATE)
    baro = np.flatnonzero(records["sensor"] == 2)
    records["outcome"][baro[::10]] = int(Outcome.REJECTED_TOO_OLD)
    mag = np.flatnonzero(records["sensor"] == 3)
    records["outcome"][mag[::5]] = int(Outcome.REJECTED_DUPLICATE)
    told = symptoms(replace(result, run=replace(result.run, records=records)))
    assert (
        having(told, "gps_position: 253 of 380 (67 %) rejected: innovation outside the gate")
        is Severity.SERIOUS
    )
    assert (
        having(told, "barometer: 152 of 1520 (10 %) rejected: older than the rewind window")
        is Severity.WARNING
    )
    assert having(told, "magnetometer: 456 of 2280") is Severity.NOTE


def test_a_sensor_that_is_switched_off_is_no_trouble() -> None:
    result = synthetic_result()
    records = result.run.records.copy()
    records["outcome"][records["sensor"] == 2] = int(Outcome.REJECTED_NOT_READY)
    records["nis"][records["sensor"] == 2] = np.nan
    changed = replace(result, run=replace(result.run, records=records))
    assert changed.unused == ("barometer",)
    assert findings(changed) == []


def test_inconsistent_innovations_and_offsets_are_told() -> None:
    result = synthetic_result()
    records = result.run.records.copy()
    gps = records["sensor"] == 0
    records["nis"][gps] *= 4.0
    mag = records["sensor"] == 3
    records["innovation"][mag, 0] += 2.0 * records["sigma"][mag, 0]
    told = symptoms(replace(result, run=replace(result.run, records=records)))
    assert having(told, "gps_position: innovations are 1.9 times larger than expected") is Severity.WARNING
    assert having(told, "magnetometer: innovation 1 of 1 is off by +2.0 sigma") is Severity.WARNING


def test_missing_sensors_gaps_and_slow_imu_are_told() -> None:
    result = synthetic_result()
    t = result.start_ns + (np.arange(0, 76, 0.04) * 1e9).astype(np.int64)
    t[500:] += 2 * 10**9
    told = symptoms(replace(result, streams=(stream("imu", Kind.IMU, t),)))
    assert having(told, "no gps position in the log") is Severity.SERIOUS
    assert having(told, "no barometer in the log") is Severity.WARNING
    assert having(told, "imu comes at 25 Hz") is Severity.WARNING
    assert having(told, "imu: 1 gap, the longest 2.04 s") is Severity.WARNING


def test_vibration_biases_notes_and_problems_are_told() -> None:
    result = synthetic_result()
    run = result.run
    bad = replace(
        run,
        gyro_bias=run.gyro_bias + np.deg2rad(2.0),
        accel_bias=run.accel_bias + 0.8,
        notes=[(int(run.t_ns[100]), "no inertial sample for 2.1 s: aligning again")],
    )
    changed = replace(result, run=bad, vibration_mps2=6.2, problems=("3 chunks are damaged",))
    told = symptoms(changed)
    for text in (
        "specific force scatters by 6.2",
        "gyro bias ends at 1.99",
        "accelerometer bias ends at 0.80",
    ):
        assert having(told, text) is Severity.WARNING
    assert having(told, "at 2.0 s: no inertial sample for 2.1 s") is Severity.WARNING
    assert having(told, "3 chunks are damaged") is Severity.WARNING
    assert "deserve a look" in verdict(changed, findings(changed))


def test_a_diverged_filter_is_serious() -> None:
    result = synthetic_result(with_truth=False)
    position = result.run.position_m.copy()
    position[100:] = np.nan
    changed = replace(result, run=replace(result.run, position_m=position))
    assert having(symptoms(changed), "the estimate is not finite") is Severity.SERIOUS
    assert verdict(changed, findings(changed)).startswith("Do not rely on this estimate")


def test_an_impossible_speed_is_serious() -> None:
    result = synthetic_result(with_truth=False)
    velocity = result.run.velocity_mps.copy()
    velocity[500:505] = 4000.0
    changed = replace(result, run=replace(result.run, velocity_mps=velocity))
    assert having(symptoms(changed), "which no multirotor does") is Severity.SERIOUS
