"""Sensors of a vehicle that is being flown: drawn as the flight goes on, from the same descriptions as
``simulation.sensors``.

What does not depend on the motion is drawn before the flight: when each message is sampled, stamped, on its way or
lost, its white noise and its slow errors. A row for every message lies ready in the order of arrival; the motion fills
its values once it is known, and ``until`` hands out what has arrived by then.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from estimation.config import Config
from estimation.events import AUTOPILOT, COMPANION, EVENT_DTYPE, EventBatch, Kind, Names, VisionFix, pack
from estimation.frames import Array, ned_to_geodetic, quat_exp, quat_multiply
from simulation.fixes import CameraErrors, View, noisy, seen_from
from simulation.sensors import (
    CLOCKS,
    Clock,
    Place,
    SlowError,
    Stream,
    Streams,
    VisionStream,
    gps_wander,
    sample_times,
    standard_pressure,
)

Times = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Instant:
    """The truth at one moment ``t_s``: the vehicle as in ``simulation.trajectory.Motion``, and the deck.

    Vectors (3,) NED but for the body's angular velocity and specific force; ``R_nb`` (3, 3); ``deck_m`` the deck's
    centre, ``deck_normal`` (3,) its downward normal.
    """

    t_s: float
    position_m: Array
    velocity_mps: Array
    quaternion: Array
    R_nb: Array
    angular_velocity_radps: Array
    specific_force_mps2: Array
    deck_m: Array
    deck_normal: Array


Seeing = Callable[[Instant], bool]
"""What is told the moment of each picture, in place of drawn fixes; it says whether the picture comes as a message of
this flight, whose fix ``settle`` then fills in.
"""


Fill = Callable[[Instant, int], Array | None]
"""What gives a message's values (and, from the seventh on, its covariance) at the time of its content, by number."""


@dataclass(slots=True)
class _Channel:
    """One sensor's messages: the times of their content (n,) [s], the age at the stamp (n,) [s], and what fills them.

    ``seed`` draws stamps, ways and losses; ``rows`` (n,) are their places once all channels are laid out.
    """

    name: str
    kind: Kind
    stream: Stream
    t_s: Array
    age_s: Array
    seed: int
    fill: Fill
    rows: Times = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    next: int = 0


@dataclass(slots=True)
class Instruments:
    """All sensors of one flight.

    ``rows`` are the messages in the order of their arrival at ``arrival_s`` (n,), ``there`` (n,) tells which of them
    there are; ``content_s`` (n,) are the true times of their content. ``slow`` holds the slow errors that were drawn,
    by the state's block. The companion's clock and the camera's show UTC, less the offsets that ``clocks`` give them.
    """

    config: Config
    place: Place
    clocks: Mapping[str, Clock]
    rows: NDArray[np.void] = field(init=False)
    arrival_s: Array = field(init=False)
    content_s: Array = field(init=False)
    there: NDArray[np.bool_] = field(init=False)
    slow: dict[str, SlowError] = field(default_factory=dict)
    _channels: list[_Channel] = field(default_factory=list)
    _given: int = 0

    @classmethod
    def draw(
        cls, config: Config, streams: Streams, clocks: Mapping[str, Clock], place: Place, duration_s: float,
        rng: np.random.Generator, see: Seeing | None = None, view: View | None = None,
    ) -> Instruments:  # fmt: skip
        """Draw everything that the motion does not decide, for a flight of at most ``duration_s``.

        ``see`` replaces the fixes that are drawn from the description; ``view`` tells where there are such, unless
        ``streams`` does. Each sensor draws from a generator of its own.
        """
        made = cls(config, place, clocks)
        generators = iter(rng.spawn(7))
        made._inertial(streams.imu, duration_s, next(generators))
        made._satellite(streams.gps, duration_s, next(generators))
        own = next(generators)
        if config.barometer.use:
            made._barometer(streams.barometer, duration_s, own)
        own = next(generators)
        if config.magnetometer.use:
            made._magnetometer(streams.magnetometer, duration_s, own)
        own = next(generators)
        if config.attitude.use != "off":
            made._attitude(streams.attitude, duration_s, own)
        own = next(generators)
        if streams.vision is not None:
            made._vision(streams.vision, duration_s, own, see, streams.vision.view or view or View())
        made._lay_out(streams.timesync, duration_s, next(generators))
        return made

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sensors, in the order of the rows' indices."""
        return (*(c.name for c in self._channels), "timesync")

    def stamp_ns(self, clock: str, t_s: Array) -> Times:
        """Return what a clock shows at true times (n,)."""
        shown = self.clocks.get(clock, Clock()).stamp_ns(t_s)
        return shown if clock == AUTOPILOT else shown + self.place.utc_ns

    def sense(self, moments: Callable[[float], Instant], until_s: float) -> None:
        """Fill the messages whose content lies before ``until_s``; ``moments`` gives the truth at such a time."""
        for channel in self._channels:
            while channel.next < len(channel.t_s) and channel.t_s[channel.next] < until_s:
                k = channel.next
                channel.next += 1
                row = int(channel.rows[k])
                if not self.there[row]:
                    continue
                values = channel.fill(moments(float(channel.t_s[k])), k)
                if values is None:
                    self.there[row] = False
                    continue
                self.rows["value"][row, : min(6, len(values))] = values[:6]
                self.rows["covariance"][row, : max(0, len(values) - 6)] = values[6:]

    def until(self, t_s: float) -> EventBatch:
        """Return what has arrived by a time and was not given before, in the order of arrival."""
        return EventBatch(self.rows[self.arrived(t_s)], self.names, CLOCKS)

    def arrived(self, t_s: float) -> Times:
        """Return the numbers of the rows that ``until`` would give."""
        begin = self._given
        self._given = max(begin, int(np.searchsorted(self.arrival_s, t_s, side="right")))
        numbers: Times = begin + np.flatnonzero(self.there[begin : self._given])
        return numbers

    def settle(self, number: int, fix: VisionFix | None) -> None:
        """Write what was found in a picture into its row, or take the row out where there was no fix."""
        if fix is None:
            self.there[number] = False
            return
        found = np.array([pack(fix, Names())], dtype=EVENT_DTYPE)[0]
        self.rows["value"][number], self.rows["covariance"][number] = found["value"], found["covariance"]

    def given(self) -> EventBatch:
        """Return all that was given out so far."""
        chosen = slice(0, self._given)
        return EventBatch(self.rows[chosen][self.there[chosen]], self.names, CLOCKS)

    def alter(self, name: str, change: Callable[[Instant, Array | None], Array | None]) -> None:
        """Let a sensor's messages be changed as they are filled; raises ``ValueError`` for one that is not there."""
        self.of(name)
        for channel in self._channels:
            if channel.name == name:
                channel.fill = _changed(channel.fill, change)

    def of(self, name: str) -> NDArray[np.bool_]:
        """Return which rows are a sensor's; raises ``ValueError`` for one that is not there."""
        if name not in self.names:
            raise ValueError(f"sensor {name!r} is not in this flight; it has {', '.join(self.names)}")
        mine: NDArray[np.bool_] = self.rows["sensor"] == self.names.index(name)
        return mine

    # -- what each sensor draws ------------------------------------------------------------------------------------

    def _inertial(self, stream: Stream, duration_s: float, rng: np.random.Generator) -> None:
        c = self.config.imu
        t = sample_times(stream, duration_s)
        dt = 1.0 / stream.rate_hz
        noise = np.zeros((len(t), 6))
        for k, (name, sigma, walk, white) in enumerate(
            (
                ("gyro_bias", c.gyro_bias_sigma, c.gyro_bias_walk, c.gyro_noise),
                ("accel_bias", c.accel_bias_sigma, c.accel_bias_walk, c.accel_noise),
            )
        ):
            steps = walk * math.sqrt(dt) * rng.standard_normal((len(t), 3))
            steps[0] = sigma * rng.standard_normal(3)
            self.slow[name] = SlowError(t, np.cumsum(steps, axis=0))
            part = noise[:, 3 * k : 3 * k + 3]
            part += self.slow[name].values + white / math.sqrt(dt) * rng.standard_normal((len(t), 3))

        def fill(now: Instant, k: int) -> Array:
            felt: Array = np.concatenate([now.angular_velocity_radps, now.specific_force_mps2]) + noise[k]
            return felt

        self._add("imu", Kind.IMU, stream, t, c.latency_s or 0.0, rng, fill)

    def _satellite(self, stream: Stream, duration_s: float, rng: np.random.Generator) -> None:
        c = self.config.gps
        t = sample_times(stream, duration_s)
        lever = np.array(c.lever_arm_m)
        sigma = np.array([c.position_sigma_m, c.position_sigma_m, c.height_sigma_m])
        wander = np.zeros(3)
        error = sigma * rng.standard_normal((len(t), 3))
        if c.bias:
            wander = np.array([c.bias_sigma_m, c.bias_sigma_m, c.height_bias_sigma_m])
            self.slow["gps_bias"] = SlowError(t, gps_wander(c, len(t), 1.0 / stream.rate_hz, rng))
            error += self.slow["gps_bias"].values
        speed_sigma = np.array([c.velocity_sigma_mps, c.velocity_sigma_mps, c.climb_sigma_mps])
        speed_error = speed_sigma * rng.standard_normal((len(t), 3))
        place_variance, speed_variance = sigma**2 + wander**2, speed_sigma**2

        def position(now: Instant, k: int) -> Array:
            place = ned_to_geodetic(now.position_m + now.R_nb @ lever + error[k], self.place.origin)
            return np.concatenate([place, [1.0, np.nan, np.nan], _diagonal(place_variance)])

        def velocity(now: Instant, k: int) -> Array:
            swing = now.R_nb @ np.cross(now.angular_velocity_radps, lever)
            value = now.velocity_mps + swing + speed_error[k]
            return np.concatenate([value, [1.0, np.nan, np.nan], _diagonal(speed_variance)])

        self._add("gps_position", Kind.GPS_POSITION, stream, t, c.latency_s, rng, position)
        # One message carries both: they share stamp, way and loss.
        self._add(
            "gps_velocity", Kind.GPS_VELOCITY, stream, t, c.latency_s, self._channels[-1].seed, velocity
        )

    def _barometer(self, stream: Stream, duration_s: float, rng: np.random.Generator) -> None:
        c = self.config.barometer
        t = sample_times(stream, duration_s)
        steps = c.bias_walk / math.sqrt(stream.rate_hz) * rng.standard_normal(len(t))
        steps[0] = c.bias_sigma_m * rng.standard_normal()
        self.slow["baro_bias"] = SlowError(t, np.cumsum(steps)[:, None])
        error = self.slow["baro_bias"].values[:, 0] + c.sigma_m * rng.standard_normal(len(t))
        datum = float(self.place.origin[2])

        def fill(now: Instant, k: int) -> Array:
            height = np.array([datum - now.position_m[2] + error[k]])
            return np.array([standard_pressure(height)[0], 288.15])

        self._add("barometer", Kind.BAROMETER, stream, t, c.latency_s, rng, fill)

    def _magnetometer(self, stream: Stream, duration_s: float, rng: np.random.Generator) -> None:
        c, place = self.config.magnetometer, self.place
        t = sample_times(stream, duration_s)
        heading = place.declination_rad + c.heading_sigma_rad * rng.standard_normal(len(t))
        level, down = math.cos(place.dip_rad), math.sin(place.dip_rad)

        def fill(now: Instant, k: int) -> Array:
            north = np.array([level * math.cos(heading[k]), level * math.sin(heading[k]), down])
            field_b: Array = place.field_t * now.R_nb.T @ north
            return field_b

        self._add("magnetometer", Kind.MAGNETOMETER, stream, t, c.latency_s, rng, fill)

    def _attitude(self, stream: Stream, duration_s: float, rng: np.random.Generator) -> None:
        c = self.config.attitude
        t = sample_times(stream, duration_s)
        errors = np.array([c.tilt_sigma_rad, c.tilt_sigma_rad, c.yaw_sigma_rad]) * rng.standard_normal(
            (len(t), 3)
        )

        def fill(now: Instant, k: int) -> Array:
            turned: Array = quat_multiply(quat_exp(errors[k]), now.quaternion)
            return turned

        self._add("attitude", Kind.ATTITUDE, stream, t, c.latency_s, rng, fill)

    # -- rows ------------------------------------------------------------------------------------------------------

    def _vision(
        self,
        stream: VisionStream,
        duration_s: float,
        rng: np.random.Generator,
        see: Seeing | None,
        view: View,
    ) -> None:
        c = self.config.vision
        t = sample_times(stream, duration_s)
        errors = CameraErrors.draw(c, t, rng)
        age = np.full(len(t), c.latency_s)
        white = int(rng.integers(1 << 62))
        if see is None:
            age += errors.latency_s
            self.slow["range_scale"] = SlowError(t, np.full((len(t), 1), errors.scale))
            self.slow["camera_latency"] = SlowError(t, errors.latency_s[:, None])
            self.slow["camera_mount"] = SlowError(t, errors.mount_rad * np.ones((len(t), 1)))

        def fill(now: Instant, k: int) -> Array | None:
            if see is not None:
                return np.full(12, np.nan) if see(now) else None
            true = seen_from(c, now.position_m[None], now.R_nb[None], now.deck_m[None], errors.mount_rad)
            one = noisy(c, view, t[k : k + 1], true, errors, np.random.default_rng([white, k]))
            if not one.seen[0]:
                return None
            stated = one.covariance_m2[0] if stream.covariance else np.full(6, np.nan)
            return np.concatenate([one.position_cam_m[0], np.full(3, np.nan), stated])

        self._add("vision", Kind.VISION, stream, t, age, rng, fill)

    # -- rows ------------------------------------------------------------------------------------------------------

    def _add(
        self, name: str, kind: Kind, stream: Stream, t_s: Array, age_s: Array | float,
        seed: int | np.random.Generator, fill: Fill,
    ) -> None:  # fmt: skip
        number = seed if isinstance(seed, int) else int(seed.integers(1 << 62))
        age = np.broadcast_to(np.asarray(age_s, dtype=np.float64), t_s.shape)
        self._channels.append(_Channel(name, kind, stream, t_s, age, number, fill))

    def _lay_out(self, timesync: Stream | None, duration_s: float, rng: np.random.Generator) -> None:
        """Give every message its row, in the order of arrival."""
        blocks, arrivals, content, kept = [], [], [], []
        for number, channel in enumerate(self._channels):
            stream, t, n = channel.stream, channel.t_s, len(channel.t_s)
            own = np.random.default_rng(channel.seed)
            jitter = stream.jitter_s * own.standard_normal(n)
            arrival = t + channel.age_s + stream.delay_s + own.exponential(stream.delay_spread_s, n)
            rows = np.zeros(n, dtype=EVENT_DTYPE)
            rows["stamp_ns"] = self.stamp_ns(stream.clock, t + channel.age_s + jitter)
            rows["arrival_ns"] = self.place.utc_ns + np.round(arrival * 1e9).astype(np.int64)
            rows["kind"], rows["sensor"], rows["clock"] = channel.kind, number, CLOCKS.index(stream.clock)
            rows["value"], rows["covariance"] = np.nan, np.nan
            blocks.append(rows)
            arrivals.append(arrival)
            content.append(t)
            kept.append(own.random(n) >= stream.drop)
        if timesync is not None:
            rows, arrival = self._exchanges(timesync, duration_s, rng)
            blocks.append(rows)
            arrivals.append(arrival)
            content.append(arrival)
            kept.append(rng.random(len(arrival)) >= timesync.drop)
        arrival = np.concatenate(arrivals)
        order = np.argsort(arrival, kind="stable")
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        self.rows, self.arrival_s = np.concatenate(blocks)[order], arrival[order]
        self.content_s, self.there = np.concatenate(content)[order], np.concatenate(kept)[order]
        start = 0
        for channel in self._channels:
            channel.rows = place[start : start + len(channel.t_s)]
            start += len(channel.t_s)

    def _exchanges(
        self, stream: Stream, duration_s: float, rng: np.random.Generator
    ) -> tuple[NDArray[np.void], Array]:
        """Return the companion's exchanges with the autopilot, and when their answers came [s]."""
        t = sample_times(stream, duration_s)
        there, back = (stream.delay_s + rng.exponential(stream.delay_spread_s, len(t)) for _ in range(2))
        sent, received = self.stamp_ns(COMPANION, t), self.stamp_ns(COMPANION, t + there + back)
        rows = np.zeros(len(t), dtype=EVENT_DTYPE)
        rows["stamp_ns"] = self.stamp_ns(AUTOPILOT, t + there)
        rows["kind"], rows["sensor"] = Kind.TIMESYNC, len(self._channels)
        rows["value"], rows["covariance"] = np.nan, np.nan
        # As ``estimation.events.pack`` has it: the mid-point and the round trip.
        rows["arrival_ns"] = sent + (received - sent) // 2
        rows["value"][:, 0] = received - sent
        rows["value"][:, 1] = received - rows["arrival_ns"]
        return rows, t + there + back


def _changed(fill: Fill, change: Callable[[Instant, Array | None], Array | None]) -> Fill:
    return lambda now, k: change(now, fill(now, k))


def _diagonal(variance: Array) -> Array:
    """Return the upper triangle (6,) of a diagonal matrix."""
    return np.array([variance[0], 0.0, 0.0, variance[1], 0.0, variance[2]])
