"""The camera's latency from a whole flight: the likelihood of all innovations as a function of it.

The flight is replayed once for the platform's motion to be learned, and then, with that and the latency held, at each
value of a grid, then of finer ones about the best. What a replay says of a latency is the log-likelihood of its
innovations, ``sum -(rho(NIS) + log det S) / 2`` with rho Huber's function at the filter's own bound, over the
measurements that every replay compared. Its peak is the latency. The sigma is the largest of three: that of the peak's
curvature, which is right if the models are; that of the slopes of disjoint parts of the flight, which needs no such
trust ("sandwich"); and the filter's own in the first replay, which carries the camera's mounting and the gyro's noise:
both can pass for an age all flight long.

Latency >= 0: the content is older than its stamp, t_content = map(t_stamp) - latency. No content is newer, but what the
map errs by is found with it: where the exchanges of the clocks take longer one way than the other, up to half their
round trip. So the filter's own state may be below zero, and so may what is found here; ``BELOW_ZERO`` then says it.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import StrEnum

import msgspec
import numpy as np
from numpy.typing import NDArray

from estimation.clockbank import ARRIVAL, ClockBank, ClockSummary
from estimation.config import Config
from estimation.estimator import EngineName, LandingEstimator
from estimation.events import AUTOPILOT, EventBatch, Kind, TimeSync, unpack
from estimation.intake import latencies_s
from estimation.output import Facts, Run
from estimation.parameters import chi_square_bound
from estimation.update import MAX_LATENCY_S, MIN_LATENCY_S

Array = NDArray[np.float64]
KEY_DTYPE = np.dtype([("stamp_ns", np.int64), ("kind", np.int16), ("sensor", np.int16)])
"""What tells a measurement from the others: its own stamp, ``events.Kind`` and the sensor's index."""
Replay = Callable[[float], tuple[NDArray[np.void], Array]]

COARSE_S = 0.01
"""Spacing of the first grid, which spans all from ``MIN_LATENCY_S`` to ``MAX_LATENCY_S``."""
MIDDLE_S = 0.003
FINEST_S = 2e-4
"""Least spacing of the last grid: below it the rounding of the replays would show."""
KNOWN_S = 0.005
"""A latency with a larger sigma than this counts as unobservable."""
UNKNOWN_S = MAX_LATENCY_S / math.sqrt(12.0)
"""Sigma of a latency of which nothing is known but that it lies between 0 and ``MAX_LATENCY_S`` [s]."""
HARDLY_TURNED = "the vehicle turned too little while it saw the target"
PARTS = 20
"""Disjoint parts of the flight whose slopes are compared."""
LEAST_FIXES = 60
DIP = 2.0
"""A second peak counts when the profile falls by this much between the two, and it is within ``RIVAL`` of the first."""
RIVAL = 8.0
NEGATIVE_SIGMA = 3.0
"""A latency that is below zero by more than this many of its sigmas is told to be so."""
BELOW_ZERO = "below zero: the map of the clocks sets the fixes too early, or their stamps are wrong"
APART_SIGMA = 4.0
"""Halves of the flight that differ by more than this many of their sigmas contradict each other."""


class LatencyStatus(StrEnum):
    """What a profile says of the latency."""

    ESTIMATED = "estimated"
    UNOBSERVABLE = "unobservable"
    INCONSISTENT = "inconsistent"


@dataclass(frozen=True, slots=True)
class LatencyProfile:
    """The latency [s] and its 1-sigma, status with its reason, and what they rest on.

    ``grid_s`` (n,) ascending and ``log_likelihood`` (n,) are the profile, largest value 0; ``halves`` the latency and
    the sigma of each half of the flight; ``fixes`` how many vision fixes were compared; ``rotation_radps`` how fast the
    vehicle turned meanwhile (rms, less noise); ``by_arrival`` says that the fixes' own stamps were thrown away;
    ``clocks`` are the other clocks against the inertial one at the flight's end.
    """

    latency_s: float
    sigma_s: float
    status: LatencyStatus
    reason: str
    grid_s: Array
    log_likelihood: Array
    halves: tuple[tuple[float, float], ...]
    fixes: int
    rotation_radps: float = 0.0
    by_arrival: bool = False
    clocks: list[ClockSummary] = field(default_factory=list)


@dataclass(slots=True)
class _Profile:
    """Replays that were made: for each latency the measurements' keys and their log-likelihoods."""

    replay: Replay
    jobs: int
    found: dict[float, tuple[NDArray[np.void], Array]] = field(default_factory=dict)

    def add(self, latencies_s: Array) -> None:
        from joblib import Parallel, delayed

        new = sorted({round(float(v), 9) for v in latencies_s.tolist()} - set(self.found))
        results = Parallel(n_jobs=min(self.jobs, max(1, len(new))))(delayed(self.replay)(v) for v in new)
        self.found.update(zip(new, results, strict=True))

    def common(self) -> tuple[Array, NDArray[np.int64], Array]:
        """Return latencies (n,), stamps (m,) of what all replays compared, and log-likelihoods (n, m)."""
        grid = sorted(self.found)
        keys = self.found[grid[0]][0]
        for v in grid[1:]:
            if not np.array_equal(keys, self.found[v][0]):
                keys = np.intersect1d(keys, self.found[v][0])
        values = [self.found[v][1][np.searchsorted(self.found[v][0], keys)] for v in grid]
        return np.array(grid), keys["stamp_ns"].astype(np.int64), np.array(values)

    def fixes(self) -> int:
        """Return how many vision fixes all replays compared, at least."""
        return min(int(np.count_nonzero(keys["kind"] == Kind.VISION)) for keys, _ in self.found.values())


def latency_profile(
    batch: EventBatch,
    config: Config,
    facts: Facts | None = None,
    engine: EngineName = "auto",
    *,
    by_arrival: bool = False,
    jobs: int | None = None,
) -> LatencyProfile:
    """Return the latency of a flight's vision fixes from replays of it; the configured one is not used.

    ``by_arrival`` throws the fixes' own stamps away and takes their arrivals. ``jobs`` replays run at a time (None: as
    many as there are processors). Raises ``ValueError`` where there are no vision fixes or the filter never starts.
    """
    if not np.any(batch.rows["kind"] == Kind.VISION):
        raise ValueError(
            "holds no vision fixes; import the file that has them, or run deckfix replay on its images"
        )
    mapped, clocks = on_inertial_clock(batch, by_arrival)
    # The replays hold the latency themselves: no prior of the log's own may come in between.
    known = replace(facts or Facts(), vision_by_arrival=False)
    informed, sigma = _with_sea(mapped, config, known, engine)
    found = profile_of(_Replay(mapped, informed, known, engine), jobs, sigma)
    found = replace(found, rotation_radps=rotation_radps(mapped), by_arrival=by_arrival, clocks=clocks)
    if found.rotation_radps < config.vision.latency_rate_radps:
        # What is left then is how the vehicle moves against the raft, and that tells of the raft's sway as well.
        return replace(found, status=LatencyStatus.UNOBSERVABLE, reason=HARDLY_TURNED, sigma_s=UNKNOWN_S)
    if by_arrival and found.status is LatencyStatus.ESTIMATED and _below_zero(found.latency_s, found.sigma_s):
        # An arrival is on the clock that the others arrive by: there is no map to err.
        reason = "fixes cannot be newer than their arrival: the stamps of the inertial samples are wrong"
        return replace(found, status=LatencyStatus.INCONSISTENT, reason=reason)
    return found


def _with_sea(batch: EventBatch, config: Config, facts: Facts, engine: EngineName) -> tuple[Config, float]:
    """Return the configuration with the platform's motion as a flight's estimator has learned it in the end, and the
    least 1-sigma [s] that this estimator's own age of the fixes came to.

    A replay that learned it anew would not be comparable with the others; one that knows only any sea takes the
    platform's motion for the vehicle's, and the vehicle's for an age.
    """
    c = msgspec.structs.replace
    config = c(config, platform=c(config.platform, use=True))
    estimator = LandingEstimator(config, engine, facts)
    run = estimator.run(batch)
    sigma = run.sigma[:, run.state_names.index("camera_latency.t")]
    informed = c(config, platform=c(config.platform, motion=tuple(estimator.motion.tolist())))
    return informed, float(sigma.min()) if len(sigma) else 0.0


def profile_of(replay: Replay, jobs: int | None = None, least_sigma_s: float = 0.0) -> LatencyProfile:
    """Return the latency that ``replay`` shows: latency [s] -> keys of the measurements compared, ascending, and the
    log-likelihood of each. It is known no better than to ``least_sigma_s``.
    """
    profile = _Profile(replay, jobs or os.cpu_count() or 1)
    coarse = np.arange(MIN_LATENCY_S, MAX_LATENCY_S + 1e-9, COARSE_S)
    profile.add(coarse)
    grid, stamps, values = profile.common()
    total = values.sum(axis=1)
    rival = _rival(grid, total)
    best = int(np.clip(total.argmax(), 1, len(grid) - 2))
    peak, sigma = _parabola(grid[best - 1 : best + 2], total[best - 1 : best + 2])
    for largest in (MIDDLE_S, MIDDLE_S / 2.0):
        step = float(np.clip(sigma, FINEST_S, largest))
        middle = np.clip(peak, MIN_LATENCY_S + 2.0 * step, MAX_LATENCY_S - 2.0 * step)
        around = np.round(middle + step * np.arange(-2, 3), 9)
        profile.add(around)
        grid, stamps, values = profile.common()
        near = np.searchsorted(grid, around)
        peak, sigma = _parabola(grid[near], values[near].sum(axis=1))
    parts = _parts(grid[near], stamps, values[near], PARTS)
    sigma = max(sigma, _sandwich(parts, peak), least_sigma_s)
    fixes = profile.fixes()
    halves = tuple(_half(parts[:, h]) for h in (slice(0, PARTS // 2), slice(PARTS // 2, PARTS)))
    status, reason = _judged(peak, sigma, halves, fixes, rival)
    total = values.sum(axis=1)
    return LatencyProfile(
        latency_s=peak,
        sigma_s=min(sigma, UNKNOWN_S),
        status=status,
        reason=reason,
        grid_s=grid,
        log_likelihood=total - total.max(),
        halves=halves,
        fixes=fixes,
    )


def on_inertial_clock(batch: EventBatch, by_arrival: bool = False) -> tuple[EventBatch, list[ClockSummary]]:
    """Return a batch in which every stamp is on the inertial clock, as the estimator takes it there in flight, without
    the exchanges; and the clocks at its end. ``by_arrival``: a vision fix is stamped with its arrival.
    """
    rows = batch.rows.copy()
    home = batch.clocks.index(AUTOPILOT) if AUTOPILOT in batch.clocks else -1
    bank = ClockBank(AUTOPILOT)
    known = np.ones(len(rows), dtype=bool)
    last = 0
    told = (rows["clock"] != home) | (rows["kind"] == Kind.TIMESYNC) | (rows["kind"] == Kind.GPS_POSITION)
    for i in np.flatnonzero(told):
        event = unpack(batch.rows[i], batch.sensors, batch.clocks, batch.timesync_reference)
        if isinstance(event, TimeSync):
            bank.exchange(event)
            continue
        bank.observe(event.clock, event.stamp_ns, event.arrival_ns)
        if by_arrival and rows["kind"][i] == Kind.VISION:
            reading = bank.look(ARRIVAL, event.arrival_ns)
        else:
            reading = bank.convert(event.clock, event.stamp_ns)
        known[i] = reading is not None
        if reading is not None:
            rows["stamp_ns"][i] = last = reading.time_ns
    rows["clock"] = 0
    kept = known & (rows["kind"] != Kind.TIMESYNC)
    return EventBatch(rows[kept], batch.sensors, (AUTOPILOT,)), bank.summary(last)


@dataclass(frozen=True, slots=True)
class _Replay:
    """One replay of a batch on the inertial clock with the latency held; events go in the order of their content."""

    batch: EventBatch
    config: Config
    facts: Facts
    engine: EngineName

    def __call__(self, latency_s: float) -> tuple[NDArray[np.void], Array]:
        """Return keys (stamp, kind, sensor), ascending, and the log-likelihood of every measurement compared."""
        run = self.run(latency_s)
        r = run.records[(run.records["dof"] > 0) & np.isfinite(run.records["log_det"])]
        bounds = [chi_square_bound(self.config.filter.huber_sigma, m) for m in (1, 2, 3)]
        b = np.array([0.0, *bounds])[r["dof"]]
        rho = np.where(r["nis"] <= b, r["nis"], 2.0 * np.sqrt(b * np.maximum(r["nis"], b)) - b)
        keys = np.zeros(len(r), dtype=KEY_DTYPE)
        keys["stamp_ns"], keys["sensor"] = r["stamp_ns"], r["sensor"]
        kinds = np.full(len(run.sensors), -1)
        kinds[self.batch.rows["sensor"]] = self.batch.rows["kind"]
        keys["kind"] = kinds[r["sensor"]]
        keys["stamp_ns"][keys["kind"] == Kind.VISION] += round(latency_s * 1e9)
        unique, first = np.unique(keys, return_index=True)
        return unique, -0.5 * (rho + r["log_det"])[first]

    def run(self, latency_s: float) -> Run:
        """Return the run; the fixes' stamps are those of their content then."""
        c = msgspec.structs.replace
        config = c(
            self.config,
            vision=c(self.config.vision, latency_s=0.0, latency_sigma_s=1e-7, latency_walk=0.0),
            platform=c(self.config.platform, use=True, learn_s=0.0),
            filter=c(self.config.filter, output_rate_hz=1.0),
        )
        rows = self.batch.rows.copy()
        rows["stamp_ns"][rows["kind"] == Kind.VISION] -= round(latency_s * 1e9)
        age = np.round(latencies_s(config, self.facts) * 1e9).astype(np.int64)[rows["kind"]]
        order = np.argsort(rows["stamp_ns"] - age, kind="stable")
        ordered = EventBatch(rows[order], self.batch.sensors, self.batch.clocks)
        run = LandingEstimator(config, self.engine, self.facts).run(ordered)
        if not len(run.t_ns):
            raise ValueError(f"the filter did not start: it waited for {run.missing}")
        return run


def _parabola(grid: Array, values: Array) -> tuple[float, float]:
    """Return the vertex of the parabola through points about a peak, and its sigma.

    The vertex lies within the points' width of their best. Where the profile is not curved downwards: that one, inf.
    """
    k = int(np.argmax(values))
    square, line, _ = _quadratic(grid - grid[k], values - values[k])
    if not square < 0.0:
        return float(grid[k]), math.inf
    width = float(grid[-1] - grid[0])
    return float(grid[k] + np.clip(-0.5 * line / square, -width, width)), float(
        1.0 / math.sqrt(-2.0 * square)
    )


def _quadratic(x: Array, y: Array) -> tuple[float, float, float]:
    """Return a, b, c of the parabola a x^2 + b x + c that is nearest to the points."""
    unit = float(np.abs(x).max())
    a, b, c = np.polyfit(x / unit, y, 2)
    return float(a) / unit**2, float(b) / unit, float(c)


def _parts(grid: Array, stamps: NDArray[np.int64], values: Array, count: int) -> Array:
    """Return slope and curvature of each part's log-likelihood at the middle of the grid, with that, (3, count)."""
    place = np.argsort(np.argsort(stamps, kind="stable"), kind="stable") * count // max(1, len(stamps))
    middle = float(grid.mean())
    out = np.zeros((3, count))
    out[2] = middle
    for k in range(count):
        y = values[:, place == k].sum(axis=1)
        square, line, _ = _quadratic(grid - middle, y - y.mean())
        out[0, k], out[1, k] = line, -2.0 * square
    return out


def _sandwich(parts: Array, peak: float) -> float:
    """Return the sigma that the scatter of the parts' slopes at the peak shows."""
    curvature = float(parts[1].sum())
    if not curvature > 0.0:
        return math.inf
    slopes = parts[0] - parts[1] * (peak - parts[2])
    return float(np.sqrt(np.sum(slopes**2)) / curvature)


def _half(parts: Array) -> tuple[float, float]:
    """Return the latency that some parts show by themselves, and its sigma: the parabola of their sum."""
    curvature = float(parts[1].sum())
    if not curvature > 0.0:
        return float(parts[2, 0]), math.inf
    latency = float(parts[2, 0] + parts[0].sum() / curvature)
    return latency, max(1.0 / math.sqrt(curvature), _sandwich(parts, latency))


def _rival(grid: Array, total: Array) -> float | None:
    """Return the place of a second peak that is nearly as high as the best, or None."""
    best = int(np.argmax(total))
    for k in range(len(grid)):
        low = total[min(k, best) : max(k, best) + 1].min()
        if k != best and total[k] > total[best] - RIVAL and low < min(total[k], total[best]) - DIP:
            return float(grid[k])
    return None


def _judged(
    peak: float,
    sigma: float,
    halves: tuple[tuple[float, float], ...],
    fixes: int,
    rival: float | None,
) -> tuple[LatencyStatus, str]:
    """Return the status and, in words, why."""
    unobservable, inconsistent = LatencyStatus.UNOBSERVABLE, LatencyStatus.INCONSISTENT
    if fixes < LEAST_FIXES:
        return unobservable, f"only {fixes} fixes were compared"
    if rival is not None:
        return inconsistent, f"the likelihood has a second peak at {rival * 1e3:.0f} ms"
    (a, sa), (b, sb) = halves
    if math.isfinite(sa + sb) and abs(a - b) > APART_SIGMA * math.hypot(sa, sb):
        first, second = (f"{v * 1e3:.1f} ± {s * 1e3:.1f} ms" for v, s in halves)
        return inconsistent, f"the halves of the flight disagree: {first} and {second}"
    if not sigma <= KNOWN_S:
        return unobservable, HARDLY_TURNED
    if not MIN_LATENCY_S < peak < MAX_LATENCY_S:
        span = f"{MIN_LATENCY_S * 1e3:.0f} to {MAX_LATENCY_S * 1e3:.0f} ms"
        return inconsistent, f"the likelihood still rises at the end of what is searched, {span}"
    agreed = "one peak, and the halves of the flight agree"
    return LatencyStatus.ESTIMATED, f"{agreed}; {BELOW_ZERO}" if _below_zero(peak, sigma) else agreed


def _below_zero(latency_s: float, sigma_s: float) -> bool:
    return latency_s < -NEGATIVE_SIGMA * sigma_s


def rotation_radps(batch: EventBatch) -> float:
    """Return the rms angular velocity [rad/s] over the time in which there are fixes, without the gyro's white noise:
    that of half the mean squared difference of neighbouring samples, as the filter takes it.
    """
    rows = batch.rows
    seen = rows["stamp_ns"][rows["kind"] == Kind.VISION]
    imu = rows[rows["kind"] == Kind.IMU]
    imu = imu[(imu["stamp_ns"] >= seen.min()) & (imu["stamp_ns"] <= seen.max())]
    rates = imu["value"][:, :3]
    rates = rates[np.isfinite(rates).all(axis=1)]
    if len(rates) < 2:
        return 0.0
    noise = 0.5 * np.mean(np.sum(np.diff(rates, axis=0) ** 2, axis=1))
    return math.sqrt(max(0.0, float(np.mean(np.sum(rates**2, axis=1)) - noise)))
