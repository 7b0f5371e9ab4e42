"""Clocks: maps between the clocks of a flight, learned from exchanges or, failing these, from arrivals.

``ClockMap`` follows offset and skew of one remote clock against a reference clock with a Kalman filter on
two-way exchanges (MAVLink TIMESYNC). An exchange says: the remote clock read ``t`` while the reference clock
went from ``s`` to ``e``. With queueing delays a (there) and b (back) above the fastest path, the mid-point is
wrong by (a - b) / 2 and the round trip is longer than the shortest one by x = a + b; for exponential queueing
the error is then uniform in [-x/2, x/2], so that its variance is x^2 / 12. This is the weight of an exchange:
quick ones count, slow ones hardly do. What no exchange can see is a path that is slower one way than the
other even when it is quick; ``asymmetry_bound_ns`` states that limit (half of the shortest round trip).

All stamps are integer nanoseconds and are subtracted as integers before they meet a float, so that nothing is
lost at 1e18 ns. The law of the map: ``from_reference(to_reference(t))`` gives t back to the nanosecond
(within one: two clocks of different rates cannot number each other's nanoseconds one to one). No clock is
read here; the same exchanges give the same bits.

For sources that answer no exchanges, and for several clocks together, see ``estimation.clockbank``.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimation.outcome import Outcome

_NS = 1e9


class SyncStatus(StrEnum):
    """How far a map can be trusted."""

    NONE = "none"
    """Nothing has been received."""
    ACQUIRING = "acquiring"
    """Too few exchanges, or a sigma still above the limit."""
    LOCKED = "locked"
    SUSPECT = "suspect"
    """The latest exchanges contradict the map: an outlier or the beginning of a step."""
    STALE = "stale"
    """The last exchange is longer ago than allowed."""


@dataclass(frozen=True, slots=True)
class ClockSettings:
    """Parameters of the clock maps; every field has its unit in the name.

    Process noise is a rate: ``offset_wander_ns`` of 1000 means 1 us of offset after 1 s and 3.2 us after 10 s
    (1 sigma); ``skew_wander_ppb`` of 20 means 0.02 ppm of rate after 1 s and 0.063 ppm after 10 s.
    """

    offset_wander_ns: float = 1_000.0
    skew_wander_ppb: float = 20.0
    initial_skew_ppm: float = 50.0
    """1 sigma of the rate before the first exchange: ordinary crystals are within 20 to 50 ppm."""
    resolution_ns: float = 5_000.0
    """1 sigma of stamping itself, the floor of an exchange's weight."""
    gate_sigma: float = 5.0
    agreeing: int = 5
    """So many contradicting exchanges in a row that agree with each other are believed."""
    step_ns: int = 50_000_000
    """A believed contradiction of at least this size is called a step; below it is a slip of the clock."""
    longest_round_trip_ns: int = 1_000_000_000
    path_window_ns: int = 60_000_000_000
    """The shortest round trip is remembered for one to two of these, so that a changed path is learned."""
    locked_sigma_ns: float = 2_000_000.0
    stale_after_ns: int = 10_000_000_000


@dataclass(frozen=True, slots=True)
class ClockUpdate:
    """What became of one exchange.

    ``residual_ns`` is its offset less the predicted one and ``sigma_ns`` the residual's 1 sigma.
    ``step_ns`` is the size of a re-acquired jump, else 0: a map moves by so much at once only with this said.
    """

    outcome: Outcome
    residual_ns: float = 0.0
    sigma_ns: float = math.nan
    step_ns: int = 0


@dataclass(slots=True)
class _RunningMinimum:
    """The smallest value of the last one to two windows, and how many values were seen since the oldest."""

    window_ns: int
    start_ns: int = 0
    current: int | None = None
    previous: int | None = None
    count: int = 0
    previous_count: int = 0

    def add(self, at_ns: int, value: int) -> None:
        if self.current is None:
            self.start_ns = at_ns
        elif at_ns - self.start_ns >= self.window_ns:
            self.previous, self.previous_count = self.current, self.count
            self.current, self.count, self.start_ns = None, 0, at_ns
        self.current = value if self.current is None else min(self.current, value)
        self.count += 1

    @property
    def value(self) -> int:
        both = [v for v in (self.current, self.previous) if v is not None]
        return min(both) if both else 0

    @property
    def samples(self) -> int:
        return self.count + self.previous_count


@dataclass(slots=True)
class _Line:
    """The map itself: at ``reference_ns`` the remote clock is ahead by ``offset_ns`` + ``fraction_ns``."""

    reference_ns: int = 0
    offset_ns: int = 0
    fraction_ns: float = 0.0
    skew: float = 0.0

    def offset_at(self, reference_ns: int) -> tuple[int, float]:
        """Return the offset at a reference time as whole and broken nanoseconds."""
        broken = self.fraction_ns + self.skew * (reference_ns - self.reference_ns)
        whole = round(broken)
        return self.offset_ns + whole, broken - whole

    def to_reference(self, stamp_ns: int) -> int:
        elapsed = stamp_ns - (self.reference_ns + self.offset_ns)
        return (
            self.reference_ns + elapsed - round((self.skew * elapsed + self.fraction_ns) / (1.0 + self.skew))
        )

    def from_reference(self, reference_ns: int) -> int:
        return reference_ns + self.offset_at(reference_ns)[0]


@dataclass(slots=True)
class _State:
    line: _Line = field(default_factory=_Line)
    p_oo: float = 0.0
    p_os: float = 0.0
    p_ss: float = 0.0
    count: int = 0
    steps: int = 0
    slips: int = 0
    mean_excess_ns: float = 0.0
    last: tuple[int, int, int] = (0, 0, 0)
    suspects: list[tuple[int, int, int]] = field(default_factory=list)


class ClockMap:
    """Offset and skew of a remote clock against a reference clock, from two-way exchanges.

    The offset is remote minus reference. States: offset [ns] and skew [ns/ns], at the latest exchange.
    """

    __slots__ = ("_minimum", "_state", "settings")

    def __init__(self, settings: ClockSettings | None = None) -> None:
        self.settings = settings or ClockSettings()
        self._state = _State()
        self._minimum = _RunningMinimum(self.settings.path_window_ns)

    @property
    def ready(self) -> bool:
        """True from the first exchange on."""
        return self._state.count > 0

    @property
    def exchanges(self) -> int:
        """Exchanges taken so far."""
        return self._state.count

    @property
    def steps(self) -> int:
        """Jumps of at least ``settings.step_ns`` that were re-acquired."""
        return self._state.steps

    @property
    def slips(self) -> int:
        """Smaller jumps that were followed by opening the covariance."""
        return self._state.slips

    @property
    def skew_ppm(self) -> float:
        """Rate of the remote clock against the reference, in parts per million."""
        return self._state.line.skew * 1e6

    @property
    def skew_sigma_ppm(self) -> float:
        """1 sigma of ``skew_ppm``."""
        return math.sqrt(self._state.p_ss) * 1e6

    @property
    def asymmetry_bound_ns(self) -> float:
        """Largest error that no exchange can show: half of the shortest round trip."""
        return self._minimum.value / 2.0

    def offset_ns(self, reference_ns: int) -> int:
        """Remote minus reference clock at a reference time."""
        return self._state.line.offset_at(reference_ns)[0]

    def to_reference(self, stamp_ns: int) -> int:
        """Take a stamp of the remote clock to the reference clock."""
        self._require()
        return self._state.line.to_reference(int(stamp_ns))

    def from_reference(self, reference_ns: int) -> int:
        """Take a time of the reference clock to the remote clock."""
        self._require()
        return self._state.line.from_reference(int(reference_ns))

    def to_reference_array(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Take stamps (n,) of the remote clock to the reference clock, as ``to_reference`` does each."""
        self._require()
        line = self._state.line
        elapsed = np.asarray(stamps_ns, np.int64) - (line.reference_ns + line.offset_ns)
        correction = np.rint((line.skew * elapsed + line.fraction_ns) / (1.0 + line.skew))
        mapped: NDArray[np.int64] = line.reference_ns + elapsed - correction.astype(np.int64)
        return mapped

    def sigma_ns(self, reference_ns: int) -> float:
        """1 sigma of the offset at a reference time, from the exchanges' scatter (not their asymmetry)."""
        if not self.ready:
            return math.inf
        dt = abs(reference_ns - self._state.line.reference_ns)
        return math.sqrt(self._predicted(dt)[0])

    def status(self, reference_ns: int | None = None) -> SyncStatus:
        """Return how far the map can be trusted, at a reference time where one is given."""
        s = self._state
        if not self.ready:
            return SyncStatus.NONE
        if (
            reference_ns is not None
            and abs(reference_ns - s.line.reference_ns) > self.settings.stale_after_ns
        ):
            return SyncStatus.STALE
        if s.suspects:
            return SyncStatus.SUSPECT
        wide = math.sqrt(s.p_oo) > self.settings.locked_sigma_ns
        return SyncStatus.ACQUIRING if wide or s.count < self.settings.agreeing else SyncStatus.LOCKED

    def update(self, sent_ns: int, remote_ns: int, received_ns: int) -> ClockUpdate:
        """Take one exchange: the remote clock read ``remote_ns`` between ``sent_ns`` and ``received_ns``.

        An exchange that contradicts the map is set aside (REJECTED_GATE) until ``settings.agreeing`` in a row
        say the same; then the map is moved, at once and with ``step_ns`` said where it is a step.
        """
        s, settings = self._state, self.settings
        exchange = (int(sent_ns), int(remote_ns), int(received_ns))
        round_trip = exchange[2] - exchange[0]
        if not 0 <= round_trip <= settings.longest_round_trip_ns:
            return ClockUpdate(Outcome.REJECTED_NOT_READY)
        if s.count and (exchange == s.last or exchange in s.suspects):
            return ClockUpdate(Outcome.REJECTED_DUPLICATE)
        middle = exchange[0] + round_trip // 2
        measured = exchange[1] - middle
        if not self.ready:
            self._minimum.add(middle, round_trip)
            self._begin(middle, measured, self._variance(round_trip))
            s.last = exchange
            return ClockUpdate(Outcome.FUSED, 0.0, math.sqrt(s.p_oo))
        elapsed = middle - s.line.reference_ns
        whole, broken = s.line.offset_at(middle)
        residual = float(measured - whole) - broken
        predicted = self._predicted(abs(elapsed))
        variance = self._variance(round_trip)
        sigma = math.sqrt(predicted[0] + variance)
        excess = max(0, round_trip - self._minimum.value)
        bound = settings.gate_sigma * math.sqrt(predicted[0] + settings.resolution_ns**2) + excess
        backwards = elapsed < 0
        if backwards or abs(residual) > max(bound, settings.gate_sigma * sigma):
            outcome = Outcome.REJECTED_TOO_OLD if backwards else Outcome.REJECTED_GATE
            return self._suspect(exchange, residual, sigma, outcome)
        s.suspects.clear()
        self._minimum.add(middle, round_trip)
        s.mean_excess_ns += (excess - s.mean_excess_ns) / min(s.count + 1, 200)
        self._correct(middle, whole, broken, residual, predicted, variance)
        s.last = exchange
        return ClockUpdate(Outcome.FUSED, residual, sigma)

    def snapshot(self) -> dict[str, Any]:
        """Return the whole state as plain values, for a checkpoint."""
        return {"state": asdict(self._state), "minimum": asdict(self._minimum)}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Return to a state that ``snapshot`` gave."""
        state = dict(snapshot["state"])
        state["line"] = _Line(**state["line"])
        state["last"] = tuple(state["last"])
        state["suspects"] = [tuple(e) for e in state["suspects"]]
        self._state = _State(**state)
        self._minimum = _RunningMinimum(**snapshot["minimum"])

    def _require(self) -> None:
        if not self.ready:
            raise ValueError("the clock map has seen no exchange yet; ask .ready first")

    def _predicted(self, elapsed_ns: int) -> tuple[float, float, float]:
        """Covariance (offset, offset-skew, skew) after ``elapsed_ns``; offset in ns, skew in ns/ns."""
        s, dt = self._state, elapsed_ns / _NS
        q_offset = self.settings.offset_wander_ns**2
        q_skew = self.settings.skew_wander_ppb**2  # (ns/s)^2/s
        p_os, p_ss = s.p_os * _NS, s.p_ss * _NS**2
        oo = s.p_oo + 2 * dt * p_os + dt * dt * p_ss + q_offset * dt + q_skew * dt**3 / 3
        os = p_os + dt * p_ss + q_skew * dt * dt / 2
        return oo, os / _NS, (p_ss + q_skew * dt) / _NS**2

    def _variance(self, round_trip: int) -> float:
        """Variance of an exchange's mid-point from its round trip [ns^2].

        The shortest of n round trips is itself too long, on average by tau * sqrt(pi / (2 n)) for queueing of
        mean tau each way (the minimum of n Erlang-2 variables); the excess is corrected by half as much
        again, which was found to make the sigma honest from the first seconds on (``benchmarks/clock.py``).
        """
        s, shortest = self._state, self._minimum.value
        n = max(1, self._minimum.samples)
        mean_queue = s.mean_excess_ns / 2 + shortest / n
        bias = min(float(shortest), mean_queue * 1.5 * math.sqrt(math.pi / (2 * n)))
        excess = max(0, round_trip - shortest) + bias
        return excess**2 / 12.0 + self.settings.resolution_ns**2

    def _begin(self, middle: int, offset: int, variance: float) -> None:
        s = self._state
        s.line = _Line(middle, offset)
        s.p_oo, s.p_os, s.p_ss = variance, 0.0, (self.settings.initial_skew_ppm * 1e-6) ** 2
        s.count = 1

    def _correct(
        self,
        middle: int,
        whole: int,
        broken: float,
        residual: float,
        predicted: tuple[float, float, float],
        variance: float,
    ) -> None:
        """Joseph-form update of the two states, re-anchored at the exchange."""
        s = self._state
        oo, os, ss = predicted
        gain_o, gain_s = oo / (oo + variance), os / (oo + variance)
        moved = broken + gain_o * residual
        carry = round(moved)
        s.line = _Line(middle, whole + carry, moved - carry, s.line.skew + gain_s * residual)
        keep = 1.0 - gain_o
        s.p_oo = keep * keep * oo + gain_o * gain_o * variance
        s.p_os = keep * (os - gain_s * oo) + gain_o * gain_s * variance
        s.p_ss = ss - 2 * gain_s * os + gain_s * gain_s * (oo + variance)
        s.count += 1

    def _suspect(
        self, exchange: tuple[int, int, int], residual: float, sigma: float, outcome: Outcome
    ) -> ClockUpdate:
        """Set an exchange aside; believe it and its predecessors once enough of them agree."""
        s, settings = self._state, self.settings
        s.suspects.append(exchange)
        kept = s.suspects
        while len(kept) > 1 and not self._agree(kept):
            kept.pop(0)
        if len(kept) < settings.agreeing:
            return ClockUpdate(outcome, residual, sigma)
        best = min(kept, key=lambda e: e[2] - e[0])
        middle = best[0] + (best[2] - best[0]) // 2
        jump = best[1] - middle - s.line.offset_at(middle)[0]
        skew, count, restarted = s.line.skew, s.count, list(kept)
        backwards = middle < s.line.reference_ns
        self._minimum = _RunningMinimum(settings.path_window_ns)
        for e in restarted:
            self._minimum.add(e[0] + (e[2] - e[0]) // 2, e[2] - e[0])
        spread = self._variance(best[2] - best[0])
        p_ss = max(s.p_ss, (1e-6) ** 2)
        self._begin(middle, best[1] - middle, spread)
        s.line.skew, s.p_ss, s.count = skew, p_ss, count + 1
        s.suspects = []
        s.last = exchange
        if abs(jump) >= settings.step_ns or backwards:
            s.steps += 1
            return ClockUpdate(Outcome.FUSED, residual, sigma, jump)
        s.slips += 1
        return ClockUpdate(Outcome.DOWNWEIGHTED, residual, sigma)

    def _agree(self, exchanges: list[tuple[int, int, int]]) -> bool:
        """Return whether mid-points are in order and their offsets agree within their round trips."""
        middles = [e[0] + (e[2] - e[0]) // 2 for e in exchanges]
        offsets = [e[1] - m for e, m in zip(exchanges, middles, strict=True)]
        slack = [
            (e[2] - e[0]) / 2 + self.settings.gate_sigma * self.settings.resolution_ns for e in exchanges
        ]
        drift = 2 * self.settings.initial_skew_ppm * 1e-6 * (middles[-1] - middles[0])
        lowest = max(o - w for o, w in zip(offsets, slack, strict=True))
        highest = min(o + w for o, w in zip(offsets, slack, strict=True))
        ordered = all(b > a for a, b in itertools.pairwise(middles))
        return ordered and lowest <= highest + drift
