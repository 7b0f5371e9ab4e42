"""Events of columns that importers and other programs make."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation.events import GpsPosition, GpsVelocity, Rangefinder
from estimation.outcome import Outcome
from estimation.rows import PENDING, Rows
from estimation.screening import malformed
from logs.event_columns import FOREIGN
from logs.events import as_logged, events_of_series
from logs.recording import Series
from logs.topics import new_rows

STAMPS = np.array([100, 200, 300], dtype=np.int64)


def fixes(status: list[int], stamps: NDArray[np.int64] = STAMPS, **more: str) -> Series:
    data = new_rows("/gps/fix", len(stamps))
    data["status_status"] = status
    return Series("/gps/fix", stamps, stamps + 5, data, metadata=dict(more))


def velocities(stamps: NDArray[np.int64] = STAMPS, **more: str) -> Series:
    return Series(
        "/gps/velocity", stamps, stamps + 6, new_rows("/gps/velocity", len(stamps)), metadata=dict(more)
    )


def types(series: list[Series], kind: type) -> list[int]:
    found = [e for e in events_of_series(series) if isinstance(e, kind)]
    return [e.fix_type for e in found if isinstance(e, GpsPosition | GpsVelocity)]


def test_a_velocity_takes_the_fix_type_of_the_fix_with_its_stamp() -> None:
    later = np.array([100, 300, 301], dtype=np.int64)
    assert types([velocities(later), fixes([-1, 0, 2])], GpsVelocity) == [0, 3, 1]
    assert types([velocities(later, fix_type="2"), fixes([-1, 0, 2])], GpsVelocity) == [2, 2, 2]


def test_the_second_receiver_keeps_to_its_own_fixes() -> None:
    first = fixes([0, 0, 0], sensor="gps_position")
    second = fixes([2, 2, 2], sensor="gps2_position")
    assert types([first, second, velocities(sensor="gps2_velocity")], GpsVelocity) == [3, 3, 3]


def test_status_of_other_programs_has_no_rtk_float() -> None:
    assert types([fixes([-1, 1, 2])], GpsPosition) == [0, 2, 3]
    assert types([fixes([-2, 1, 2], source=FOREIGN)], GpsPosition) == [0, 1, 3]


def test_covariance_of_a_fix_is_turned_from_enu_to_ned() -> None:
    series = fixes([0, 0, 0])
    enu = np.array([[4.0, 0.5, 0.1], [0.5, 1.0, 0.2], [0.1, 0.2, 9.0]])
    series.data["position_covariance"] = enu.ravel()
    series.data["position_covariance_type"] = [3, 0, 2]
    turn = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    ned = turn @ enu @ turn.T
    known, unknown, diagonal = events_of_series([series])
    assert isinstance(known, GpsPosition)
    assert known.covariance_ned_m2 == tuple(ned[np.triu_indices(3)])
    assert isinstance(unknown, GpsPosition)
    assert unknown.covariance_ned_m2 is None
    assert isinstance(diagonal, GpsPosition)
    assert diagonal.covariance_ned_m2 is not None


def test_a_covariance_that_is_not_symmetric_is_rejected_as_none() -> None:
    data = new_rows("/vision/fix", 3)
    data["pose_pose_position"] = [1.0, 2.0, 8.0]
    block = np.zeros((3, 6, 6))
    block[:, :3, :3] = np.diag([0.01, 0.02, 0.03])
    block[1, 0, 2] = 0.004
    block[2] = 0.0
    data["pose_covariance"] = block.reshape(3, 36)
    batch = events_of_series([Series("/vision/fix", STAMPS, STAMPS + 5, data, clock="autopilot")])
    rows = Rows.empty(3)
    rows.kind[:], rows.value[:], rows.own[:] = (
        batch.rows["kind"],
        batch.rows["value"],
        batch.rows["covariance"],
    )
    assert malformed(rows).tolist() == [PENDING, Outcome.REJECTED_COVARIANCE, PENDING]


def test_a_range_is_logged_in_single_precision_and_stays_there() -> None:
    event = Rangefinder(1, 2, 1.23, 0.1, 40.0)
    logged = as_logged(event)
    assert isinstance(logged, Rangefinder)
    assert logged.range_m == float(np.float32(1.23))
    assert as_logged(logged) == logged


def test_events_are_in_the_order_of_arrival() -> None:
    batch = events_of_series([velocities(), fixes([0, 0, 0])])
    assert batch.rows["arrival_ns"].tolist() == [105, 106, 205, 206, 305, 306]
    assert batch.sensors == ("gps_velocity", "gps_position")


def test_series_with_other_columns_are_passed_over() -> None:
    other = velocities()
    other.topic = "/gps/fix"
    damaged = velocities(fix_type="one")
    batch = events_of_series([other, damaged])
    assert len(batch) == 3
    assert batch.sensors == ("gps_velocity",)
    assert batch.rows["value"][:, 3].tolist() == [1.0, 1.0, 1.0]
