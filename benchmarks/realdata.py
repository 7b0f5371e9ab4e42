"""Real recordings as events: what the benchmarks and the tests on real data read.

Autopilots' logs go the whole way of the product (import, MCAP file, read back). The two recordings that are no
autopilot's logs are plain CSV and are turned into events here.
"""

from __future__ import annotations

import gzip
import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimation.events import Barometer, Event, EventBatch, GpsPosition, GpsVelocity, Imu
from estimation.frames import euler_to_quat, ned_to_geodetic, quat_to_matrix
from logs.importer import import_files
from logs.reader import Flight, open_flight
from logs.writer import FlightWriter

Array = NDArray[np.float64]
Times = NDArray[np.int64]

SITL_FLIGHTS = ("calm", "heave06", "sea3a")
RTK_FLIGHTS = ("vertical_path_1", "vertical_path_7", "vertical_path_9")

FLU_TO_FRD = np.array([1.0, -1.0, -1.0])
"""Mounting of the strapped-on inertial sensor: forward, left, up. See ``fit_mounting``."""
RTK_ORIGIN = np.array([math.radians(32.8), math.radians(35.0), 0.0])
"""Where the RTK flights are put: their record is local (north, east, down from the first fix)."""
RTK_SIGMA_M = (0.02, 0.04)
"""1-sigma that is stated for an RTK fix, horizontal and vertical; the record states none."""


def data_folder() -> Path | None:
    """Return the folder of real recordings ($DECKFIX_DATA, or shared/data beside the repository), if it exists."""
    beside = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("DECKFIX_DATA") or beside)
    return folder if folder.is_dir() else None


def imported(files: list[Path], folder: Path) -> Flight:
    """Return a flight that was imported from an autopilot's logs into an MCAP file in ``folder``.

    Raises ``logs.errors.LogError`` as the importer, the writer and the reader do.
    """
    target = folder / ("+".join(f.name for f in files) + ".mcap")
    with FlightWriter(target) as writer:
        writer.write_recording(import_files(files))
    return open_flight(target)


def table(path: Path) -> dict[str, Array]:
    """Return the columns of a CSV file (gzip where its name says so) by their names."""
    opener = gzip.open if path.suffix == ".gz" else open
    with opener(path, "rt") as file:
        names = [name.strip() for name in file.readline().split(",")]
        values = np.genfromtxt(file, delimiter=",")
    return {name: values[:, i] for i, name in enumerate(names)}


@dataclass(frozen=True, slots=True)
class RtkFlight:
    """A flight of a quadrotor with RTK and, on the same time axis, an inertial sensor that was strapped on.

    ``fix_ns`` (n,); ``position_m`` (n, 3) NED from the first fix; ``euler_rad`` (n, 3) roll, pitch, heading of
    the quadrotor's own estimator; ``imu_ns`` (m,); ``gyro_radps`` and ``accel_mps2`` (m, 3) FRD.
    """

    name: str
    fix_ns: Times
    position_m: Array
    euler_rad: Array
    imu_ns: Times
    gyro_radps: Array
    accel_mps2: Array

    def events(self, every: int = 10, first: int = 0, heading: bool = True) -> EventBatch:
        """Return the inertial samples and each ``every``-th fix from ``first`` on, as position only.

        With ``heading`` the quadrotor's own attitude comes with each of these fixes; the estimator starts from
        it and uses it for nothing else, unless its configuration says so.
        """
        from estimation.events import Attitude

        h, v = RTK_SIGMA_M[0] ** 2, RTK_SIGMA_M[1] ** 2
        out: list[Event] = [
            Imu(t, t, (w[0], w[1], w[2]), (f[0], f[1], f[2]))
            for t, w, f in zip(
                self.imu_ns.tolist(), self.gyro_radps.tolist(), self.accel_mps2.tolist(), strict=True
            )
        ]
        for i in range(first, len(self.fix_ns), every):
            t = int(self.fix_ns[i])
            latitude, longitude, altitude = ned_to_geodetic(self.position_m[i], RTK_ORIGIN).tolist()
            out.append(GpsPosition(t, t, latitude, longitude, altitude, (h, 0.0, 0.0, h, 0.0, v), 3))
            if heading:
                w, x, y, z = euler_to_quat(*self.euler_rad[i].tolist()).tolist()
                out.append(Attitude(t, t, (w, x, y, z)))
        out.sort(key=lambda event: event.arrival_ns)
        return EventBatch.from_events(out)


def read_rtk(folder: Path) -> RtkFlight:
    """Return one of the RTK flights: ``GT.csv`` and ``IMU_1.csv`` of a folder."""
    g, m = table(folder / "GT.csv"), table(folder / "IMU_1.csv")
    euler = np.radians(
        np.column_stack([g["roll(degrees)"], g["pitch(degrees)"], g["compass_heading(degrees)"]])
    )
    return RtkFlight(
        folder.name,
        _ns(g["time"]),
        np.column_stack([g["North"], g["East"], g["Down"]]),
        euler,
        _ns(m["time"]),
        np.radians(np.column_stack([m["Gyr_X"], m["Gyr_Y"], m["Gyr_Z"]])) * FLU_TO_FRD,
        np.column_stack([m["Acc_X"], m["Acc_Y"], m["Acc_Z"]]) * FLU_TO_FRD,
    )


def _ns(seconds: Array) -> Times:
    return np.rint(seconds * 1e9).astype(np.int64)


@dataclass(frozen=True, slots=True)
class Mounting:
    """How the inertial sensor sits: its axes to the quadrotor's body, and its clock to the quadrotor's.

    ``rotation`` (3, 3) takes the sensor's axes (as recorded in FRD) to the body; ``angle_deg`` is its angle;
    ``offset_s`` is what is added to a stamp of the quadrotor's file to get the sensor's; ``unexplained`` is the
    share of the angular velocity's variance that the best rotation and offset leave.
    """

    rotation: Array
    angle_deg: float
    offset_s: float
    unexplained: float


def fit_mounting(flight: RtkFlight, offsets_s: Array | None = None) -> Mounting:
    """Fit rotation and time offset between sensor and body on angular velocities (Wahba's problem).

    The body's angular velocity is the difference of the quadrotor's attitudes 0.2 s apart; the sensor's is
    averaged over the same time. Means are taken off, so that gyro biases play no part. The rotation is free: the
    sensor's orientation comes out, it is not put in.
    """
    offsets = np.arange(-0.1, 0.1001, 0.01) if offsets_s is None else offsets_s
    R = np.array([quat_to_matrix(euler_to_quat(*e)) for e in flight.euler_rad])
    turn = np.einsum("nji,njk->nik", R[:-2], R[2:])
    span = (flight.fix_ns[2:] - flight.fix_ns[:-2]) * 1e-9
    skewed = np.stack(
        [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], axis=1
    )
    body = skewed / (2.0 * span[:, None])
    t_imu = flight.imu_ns * 1e-9
    angle = np.zeros_like(flight.gyro_radps)
    steps = 0.5 * (flight.gyro_radps[1:] + flight.gyro_radps[:-1]) * np.diff(t_imu)[:, None]
    angle[1:] = np.cumsum(steps, axis=0)
    best: Mounting | None = None
    for offset in offsets.tolist():
        begin, end = flight.fix_ns[:-2] * 1e-9 + offset, flight.fix_ns[2:] * 1e-9 + offset
        inside = (begin >= t_imu[0]) & (end <= t_imu[-1])
        sensor = np.stack(
            [np.interp(end, t_imu, angle[:, i]) - np.interp(begin, t_imu, angle[:, i]) for i in range(3)],
            axis=1,
        )
        sensor = (sensor / span[:, None])[inside]
        sensor = sensor - sensor.mean(axis=0)
        reference = body[inside] - body[inside].mean(axis=0)
        U, _, Vt = np.linalg.svd(reference.T @ sensor)
        rotation = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        left = float(((reference - sensor @ rotation.T) ** 2).sum() / (reference**2).sum())
        if best is None or left < best.unexplained:
            angle_deg = math.degrees(math.acos(min(1.0, 0.5 * (float(np.trace(rotation)) - 1.0))))
            best = Mounting(rotation, angle_deg, offset, left)
    assert best is not None
    return best


def read_px4_tables(folder: Path) -> EventBatch:
    """Return the PX4 flight whose topics were exported as CSV: inertial sensor, GPS, barometer, no magnetometer.

    The arrival is the stamp: the export has no other.
    """
    s = table(folder / "sensor_combined.csv.gz")
    g = table(folder / "vehicle_gps_position.csv.gz")
    a = table(folder / "vehicle_air_data.csv.gz")
    gyro = np.column_stack([s[f"gyro_rad[{i}]"] for i in range(3)]).tolist()
    accel = np.column_stack([s[f"accelerometer_m_s2[{i}]"] for i in range(3)]).tolist()
    out: list[Event] = []
    for t, w, f in zip(_from_us(s["timestamp"]), gyro, accel, strict=True):
        out.append(Imu(t, t, (w[0], w[1], w[2]), (f[0], f[1], f[2])))
    for i, t in enumerate(_from_us(g["timestamp"])):
        fix_type = int(min(1, max(0, g["fix_type"][i] - 2)))
        h, v = float(g["eph"][i]) ** 2, float(g["epv"][i]) ** 2
        speed = float(g["s_variance_m_s"][i]) ** 2
        latitude, longitude = (math.radians(float(g[k][i]) * 1e-7) for k in ("lat", "lon"))
        velocity = (float(g["vel_n_m_s"][i]), float(g["vel_e_m_s"][i]), float(g["vel_d_m_s"][i]))
        own = (h, 0.0, 0.0, h, 0.0, v)
        out.append(GpsPosition(t, t, latitude, longitude, float(g["alt"][i]) * 1e-3, own, fix_type))
        own = (speed, 0.0, 0.0, speed, 0.0, speed)
        out.append(GpsVelocity(t, t, velocity, own, fix_type))
    for t, pressure in zip(_from_us(a["timestamp"]), a["baro_pressure_pa"].tolist(), strict=True):
        out.append(Barometer(t, t, pressure))
    out.sort(key=lambda event: event.arrival_ns)
    return EventBatch.from_events(out)


def _from_us(microseconds: Array) -> list[int]:
    return [int(t) * 1000 for t in microseconds.tolist()]
