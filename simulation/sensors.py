"""Sensors of a simulated vehicle, drawn from the very description that the estimator uses (``Config``).

What the noise parameters mean here:

- inertial white noise of density N gives each sample the standard deviation N / sqrt(dt). The estimator
integrates the mean of neighbouring samples, in which each sample counts for dt in the end: the sum over a
time T has the variance N^2 T, which is what its process noise says. With ``imu.vibration_gain`` above zero
it adds the scatter that it measures, these samples' own white noise included, and is then cautious by a
factor of 1 + gain; - an inertial sample is the instantaneous value at the time of its content, as the
estimator takes it, and not a mean over the interval before; - bias walks, the GPS position's Gauss-Markov
error and the barometer's offset are drawn exactly, for any interval; - the receiver states the whole of its
position error (white and slow) as its accuracy; - the magnetometer's error is one of heading: the field is
turned about the vertical; - the time of the content is that of the stamp less the latency; - vision fixes are
those of ``simulation.fixes``.

A filter that is told something else than what was drawn sees a mismatch; scenarios name it (``[mismatch]``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from estimation.config import Config
from estimation.events import AUTOPILOT, CAMERA, COMPANION, EVENT_DTYPE, EventBatch, Kind
from estimation.frames import ned_to_geodetic, quat_exp, quat_multiply
from estimation.sensor_config import GpsConfig
from simulation.fixes import CameraErrors, View, draw_fixes
from simulation.jets import Array
from simulation.trajectory import Motion, Trajectory

Times = NDArray[np.int64]

_Positive = Annotated[float, msgspec.Meta(gt=0.0)]
_NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]
_Share = Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)]

CLOCKS = (AUTOPILOT, COMPANION, CAMERA)
START_S = 1.0
"""About when the state of an estimator that waits at rest begins [s]."""


class Stream(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """How one sensor's messages come: rate, first sample, jitter of the stamp (1-sigma), way to the log
    (constant part and mean of an exponential one), share lost, clock of the stamps.
    """

    rate_hz: _Positive
    first_s: _NotNegative = 0.0
    jitter_s: _NotNegative = 0.0
    delay_s: _NotNegative = 0.002
    delay_spread_s: _NotNegative = 0.0
    drop: _Share = 0.0
    clock: str = AUTOPILOT


class VisionStream(Stream, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """How vision fixes come: late, and stamped by the companion. ``covariance`` says whether they state theirs.

    Without a ``view`` it is ``View()``, or that of the mission's target.
    """

    rate_hz: _Positive = 30.0
    first_s: _NotNegative = 0.005
    delay_s: _NotNegative = 0.06
    clock: str = COMPANION
    view: View | None = None
    covariance: bool = True


class Streams(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """The messages of all sensors. ``timesync`` are exchanges of the companion with the autopilot; there is no
    ``vision`` unless it is asked for.
    """

    imu: Stream = Stream(rate_hz=200.0)
    gps: Stream = Stream(rate_hz=5.0, first_s=0.03)
    barometer: Stream = Stream(rate_hz=20.0, first_s=0.011)
    magnetometer: Stream = Stream(rate_hz=25.0, first_s=0.017)
    attitude: Stream = Stream(rate_hz=10.0, first_s=0.023)
    rangefinder: Stream = Stream(rate_hz=20.0, first_s=0.007)
    timesync: Stream | None = None
    vision: VisionStream | None = None


class Clock(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """A clock that shows ``offset_s`` at true time 0 and gains ``skew_ppm``."""

    offset_s: float = 0.0
    skew_ppm: float = 0.0

    def stamp_ns(self, t_s: Array) -> Times:
        """Return what the clock shows at the true times (n,)."""
        shown: Times = np.round((self.offset_s + t_s * (1.0 + self.skew_ppm * 1e-6)) * 1e9).astype(np.int64)
        return shown

    def true_s(self, stamp_ns: Times) -> Array:
        """Return the true times at which it shows these stamps; inverse of ``stamp_ns`` to a nanosecond."""
        return np.asarray((stamp_ns * 1e-9 - self.offset_s) / (1.0 + self.skew_ppm * 1e-6), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Place:
    """Where the flight is and what the Earth does there.

    ``origin`` is latitude [rad], longitude [rad], altitude [m] of the NED origin; ``declination_rad`` east
    positive, ``dip_rad`` positive down; ``utc_ns`` is the true time 0.
    """

    origin: Array
    declination_rad: float
    dip_rad: float
    field_t: float
    utc_ns: int


@dataclass(frozen=True, slots=True)
class SlowError:
    """A slow error at the true times of its sensor's samples: ``t_s`` (n,), ``values`` (n, k)."""

    t_s: Array
    values: Array

    def at(self, t_s: Array) -> Array:
        """Return the error at other times, interpolated, shape (m, k)."""
        return np.stack([np.interp(t_s, self.t_s, column) for column in self.values.T], axis=1)


@dataclass(frozen=True, slots=True)
class Drawn:
    """What sensors gave: their events in the order of arrival, and the true slow errors by the state's block."""

    batch: EventBatch
    slow: dict[str, SlowError]


@dataclass(frozen=True, slots=True)
class Sensors:
    """All sensors of a vehicle. ``config`` describes their errors, ``streams`` their messages, ``clocks``
    what these are stamped with. ``vibration_mps2`` is a white scatter of the specific force in flight which
    no filter is told of.
    """

    config: Config
    streams: Streams
    clocks: Mapping[str, Clock]
    place: Place
    vibration_mps2: float = 0.0

    def draw(self, trajectory: Trajectory, rng: np.random.Generator) -> Drawn:
        """Return everything that arrives during a flight, and the slow errors that were drawn.

        Each sensor draws from a generator of its own, so that switching one on or off changes no other.
        """
        generators = iter(rng.spawn(8))
        c, s = self.config, self.streams
        slow: dict[str, SlowError] = {}
        parts = [
            self._imu(trajectory, s.imu, next(generators), slow),
            self._gps(trajectory, s.gps, next(generators), slow),
            self._barometer(trajectory, s.barometer, next(generators), slow),
            self._magnetometer(trajectory, s.magnetometer, next(generators)),
            self._attitude(trajectory, s.attitude, next(generators)),
            self._rangefinder(trajectory, s.rangefinder, next(generators)),
        ]
        used = [True, True, c.barometer.use, c.magnetometer.use, c.attitude.use != "off", c.rangefinder.use]
        batches = [p for p, on in zip(parts, used, strict=True) if on]
        exchanging, seeing = generators
        if s.timesync is not None:
            batches.append(self._timesync(trajectory, s.timesync, exchanging))
        if s.vision is not None:
            batches.append(self._vision(trajectory, s.vision, seeing, slow))
        return Drawn(self._as_they_arrive(EventBatch.concatenate(batches)), slow)

    def _as_they_arrive(self, batch: EventBatch) -> EventBatch:
        """Return the events in the order of arrival. An exchange says the companion's time instead, of its middle."""
        rows = batch.rows
        when = rows["arrival_ns"].copy()
        exchange = rows["kind"] == Kind.TIMESYNC
        answered = when[exchange] + rows["value"][exchange, 1].astype(np.int64)
        true_s = self.clocks.get(COMPANION, Clock()).true_s(answered)
        when[exchange] = self.place.utc_ns + np.round(true_s * 1e9).astype(np.int64)
        order = np.argsort(when, kind="stable")
        return EventBatch(rows[order], batch.sensors, batch.clocks, batch.timesync_reference)

    def _imu(
        self, trajectory: Trajectory, stream: Stream, rng: np.random.Generator, slow: dict[str, SlowError]
    ) -> EventBatch:
        c = self.config.imu
        t = sample_times(stream, trajectory.plan.duration_s)
        dt = 1.0 / stream.rate_hz
        m = trajectory.motion(t)
        n = len(t)
        rate, force = m.angular_velocity_radps.copy(), m.specific_force_mps2.copy()
        for name, values, sigma, walk, noise in (
            ("gyro_bias", rate, c.gyro_bias_sigma, c.gyro_bias_walk, c.gyro_noise),
            ("accel_bias", force, c.accel_bias_sigma, c.accel_bias_walk, c.accel_noise),
        ):
            steps = walk * math.sqrt(dt) * rng.standard_normal((n, 3))
            steps[0] = sigma * rng.standard_normal(3)
            slow[name] = SlowError(t, np.cumsum(steps, axis=0))
            values += slow[name].values + noise / math.sqrt(dt) * rng.standard_normal((n, 3))
        shake = self.vibration_mps2 * rng.standard_normal((n, 3))
        flying = (t > trajectory.plan.rest_s) & (t < trajectory.plan.touchdown_s)
        force += np.where(flying[:, None], shake, 0.0)
        value = np.hstack([rate, force])
        return self._batch("imu", Kind.IMU, t, value, None, c.latency_s or 0.0, stream, rng)

    def _gps(
        self, trajectory: Trajectory, stream: Stream, rng: np.random.Generator, slow: dict[str, SlowError]
    ) -> EventBatch:
        c = self.config.gps
        t = sample_times(stream, trajectory.plan.duration_s)
        n = len(t)
        m = trajectory.motion(t)
        lever = np.array(c.lever_arm_m)
        sigma = np.array([c.position_sigma_m, c.position_sigma_m, c.height_sigma_m])
        position = m.position_m + m.R_nb @ lever + sigma * rng.standard_normal((n, 3))
        wander = np.zeros(3)
        if c.bias:
            wander = np.array([c.bias_sigma_m, c.bias_sigma_m, c.height_bias_sigma_m])
            slow["gps_bias"] = SlowError(t, gps_wander(c, n, 1.0 / stream.rate_hz, rng))
            position += slow["gps_bias"].values
        place = np.array([ned_to_geodetic(p, self.place.origin) for p in position]).reshape(-1, 3)
        swing = np.cross(m.angular_velocity_radps, lever)
        speed_sigma = np.array([c.velocity_sigma_mps, c.velocity_sigma_mps, c.climb_sigma_mps])
        velocity = m.velocity_mps + np.einsum("nij,nj->ni", m.R_nb, swing)
        velocity += speed_sigma * rng.standard_normal((n, 3))
        fix = np.ones((n, 1))
        # One message carries both: they share stamp, way and loss.
        seed = rng.integers(1 << 62)
        both = (
            ("gps_position", Kind.GPS_POSITION, place, sigma**2 + wander**2),
            ("gps_velocity", Kind.GPS_VELOCITY, velocity, speed_sigma**2),
        )
        batches = []
        for name, kind, value, variance in both:
            again = np.random.default_rng(seed)
            values = np.hstack([value, fix])
            stated = np.array([variance[0], 0.0, 0.0, variance[1], 0.0, variance[2]])
            batches.append(self._batch(name, kind, t, values, stated, c.latency_s, stream, again))
        return EventBatch.concatenate(batches)

    def _barometer(
        self, trajectory: Trajectory, stream: Stream, rng: np.random.Generator, slow: dict[str, SlowError]
    ) -> EventBatch:
        c = self.config.barometer
        t = sample_times(stream, trajectory.plan.duration_s)
        steps = c.bias_walk / math.sqrt(stream.rate_hz) * rng.standard_normal(len(t))
        steps[0] = c.bias_sigma_m * rng.standard_normal()
        height = -trajectory.motion(t).position_m[:, 2] + self.place.origin[2]
        slow["baro_bias"] = SlowError(t, np.cumsum(steps)[:, None])
        height += slow["baro_bias"].values[:, 0] + c.sigma_m * rng.standard_normal(len(t))
        value = np.stack([standard_pressure(height), np.full(len(t), 288.15)], axis=1)
        return self._batch("barometer", Kind.BAROMETER, t, value, None, c.latency_s, stream, rng)

    def _magnetometer(self, trajectory: Trajectory, stream: Stream, rng: np.random.Generator) -> EventBatch:
        c = self.config.magnetometer
        t = sample_times(stream, trajectory.plan.duration_s)
        place = self.place
        heading = place.declination_rad + c.heading_sigma_rad * rng.standard_normal(len(t))
        level = math.cos(place.dip_rad)
        down = np.full(len(t), math.sin(place.dip_rad))
        north = place.field_t * np.stack([level * np.cos(heading), level * np.sin(heading), down], axis=1)
        value = np.einsum("nji,nj->ni", trajectory.motion(t).R_nb, north)
        return self._batch("magnetometer", Kind.MAGNETOMETER, t, value, None, c.latency_s, stream, rng)

    def _attitude(self, trajectory: Trajectory, stream: Stream, rng: np.random.Generator) -> EventBatch:
        c = self.config.attitude
        t = sample_times(stream, trajectory.plan.duration_s)
        sigma = np.array([c.tilt_sigma_rad, c.tilt_sigma_rad, c.yaw_sigma_rad])
        errors = sigma * rng.standard_normal((len(t), 3))
        q = trajectory.motion(t).quaternion
        value = np.array([quat_multiply(quat_exp(e), r) for e, r in zip(errors, q, strict=True)]).reshape(
            -1, 4
        )
        return self._batch("attitude", Kind.ATTITUDE, t, value, None, c.latency_s, stream, rng)

    def _rangefinder(self, trajectory: Trajectory, stream: Stream, rng: np.random.Generator) -> EventBatch:
        c = self.config.rangefinder
        t = sample_times(stream, trajectory.plan.duration_s)
        m = trajectory.motion(t)
        height = -m.position_m[:, 2] - c.surface_height_m - (m.R_nb @ np.array(c.lever_arm_m))[:, 2]
        distance = height / m.R_nb[:, 2, 2]
        distance += np.hypot(c.sigma_m, c.sigma_per_m * distance) * rng.standard_normal(len(t))
        value = np.stack([distance, np.zeros(len(t)), np.full(len(t), 100.0)], axis=1)
        return self._batch("rangefinder", Kind.RANGEFINDER, t, value, None, c.latency_s, stream, rng)

    def _vision(
        self,
        trajectory: Trajectory,
        stream: VisionStream,
        rng: np.random.Generator,
        slow: dict[str, SlowError],
    ) -> EventBatch:
        c = self.config.vision
        t = sample_times(stream, trajectory.plan.duration_s)
        errors = CameraErrors.draw(c, t, rng)
        found = draw_fixes(c, stream.view or View(), trajectory, t, errors, rng)
        constant = np.ones((len(t), 1))
        slow["range_scale"] = SlowError(t, errors.scale * constant)
        slow["camera_latency"] = SlowError(t, errors.latency_s[:, None])
        slow["camera_mount"] = SlowError(t, errors.mount_rad * constant)
        stated = found.covariance_m2 if stream.covariance else None
        age = c.latency_s + errors.latency_s
        return self._batch(
            "vision", Kind.VISION, t, found.position_cam_m, stated, age, stream, rng, found.seen
        )

    def _timesync(self, trajectory: Trajectory, stream: Stream, rng: np.random.Generator) -> EventBatch:
        """Exchanges that the companion asks for: each way takes the stream's delay."""
        t = sample_times(stream, trajectory.plan.duration_s)
        there, back = (stream.delay_s + rng.exponential(stream.delay_spread_s, len(t)) for _ in range(2))
        asking = self.clocks.get(COMPANION, Clock())
        sent, received = asking.stamp_ns(t), asking.stamp_ns(t + there + back)
        rows = np.zeros(len(t), dtype=EVENT_DTYPE)
        rows["stamp_ns"] = self.clocks.get(AUTOPILOT, Clock()).stamp_ns(t + there)
        rows["kind"] = Kind.TIMESYNC
        rows["value"], rows["covariance"] = np.nan, np.nan
        # As ``estimation.events.pack`` has it: the mid-point and the round trip; it is known at the answer.
        rows["arrival_ns"] = sent + (received - sent) // 2
        rows["value"][:, 0] = received - sent
        rows["value"][:, 1] = received - rows["arrival_ns"]
        return EventBatch(rows[rng.random(len(t)) >= stream.drop], ("timesync",), CLOCKS)

    def _batch(
        self, name: str, kind: Kind, t: Array, value: Array, stated: Array | None, latency_s: float | Array,
        stream: Stream, rng: np.random.Generator, there: NDArray[np.bool_] | None = None,
    ) -> EventBatch:  # fmt: skip
        """Return messages whose content is of the times t [s]. ``stated`` is the upper triangle of the covariance that
        the source gives, (6,) or (n, 6); ``there`` (n,) says which messages there are (None: all).
        """
        n = len(t)
        rows = np.zeros(n, dtype=EVENT_DTYPE)
        jitter = stream.jitter_s * rng.standard_normal(n)
        way = stream.delay_s + rng.exponential(stream.delay_spread_s, n)
        clock = self.clocks.get(stream.clock, Clock())
        rows["stamp_ns"] = clock.stamp_ns(t + latency_s + jitter)
        rows["arrival_ns"] = self.place.utc_ns + np.round((t + latency_s + way) * 1e9).astype(np.int64)
        rows["kind"] = kind
        rows["clock"] = CLOCKS.index(stream.clock)
        rows["value"], rows["covariance"] = np.nan, np.nan
        rows["value"][:, : value.shape[1]] = value
        if stated is not None:
            rows["covariance"] = stated
        kept = rng.random(n) >= stream.drop
        if there is not None:
            kept &= there
        return EventBatch(rows[kept], (name,), CLOCKS)


def gps_wander(config: GpsConfig, n: int, dt_s: float, rng: np.random.Generator) -> Array:
    """Return n samples (n, 3) of a receiver's slow error, NED [m]: horizontally with a mean, in height without.

    A random walk has the size that an estimator is told of at one time only: when the estimator starts.
    """
    across = gauss_markov(n, dt_s, np.full(2, config.bias_sigma_m), np.full(2, config.bias_time_s), rng)
    steps = config.height_bias_walk * math.sqrt(dt_s) * rng.standard_normal(n)
    walk = np.cumsum(steps)
    walk += config.height_bias_sigma_m * rng.standard_normal() - walk[min(n - 1, round(START_S / dt_s))]
    return np.column_stack([across, walk])


def gauss_markov(n: int, dt_s: float, sigma: Array, time_s: Array, rng: np.random.Generator) -> Array:
    """Return n samples (n, k) of stationary first-order Gauss-Markov processes, exact at this interval."""
    decay = np.exp(-dt_s / time_s)
    drive = sigma * np.sqrt(1.0 - decay**2) * rng.standard_normal((n, len(sigma)))
    out = np.empty_like(drive)
    out[:1] = sigma * rng.standard_normal(len(sigma))
    for k in range(1, n):
        out[k] = decay * out[k - 1] + drive[k]
    return out


def standard_pressure(altitude_m: Array) -> Array:
    """Return the pressure [Pa] of the International Standard Atmosphere; inverse of
    ``models.pressure_altitude``.
    """
    pressure: Array = 101325.0 * (1.0 - altitude_m / 44330.769) ** (1.0 / 0.190263)
    return pressure


def sample_times(stream: Stream, duration_s: float) -> Array:
    """Return the true times at which a sensor samples."""
    return np.arange(stream.first_s, duration_s, 1.0 / stream.rate_hz)


def truth_at(trajectory: Trajectory, clock: Clock, stamp_ns: Times) -> Motion:
    """Return the true motion at stamps of a clock."""
    return trajectory.motion(clock.true_s(stamp_ns))
