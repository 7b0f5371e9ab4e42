"""Several clocks together: any stamp taken to the estimator's clock.

``ClockBank`` holds a ``ClockMap`` for every pair of clocks that exchange times, and an ``ArrivalMap`` for
every clock whose messages arrive. A stamp goes to the estimator's clock by the shortest chain of exchanges;
without one by way of the arrivals, where the unknown transport delay is part of the sigma. Latency (the
content being older than its stamp) is not corrected here: that is the filter's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from estimation.clock import ClockMap, ClockSettings, ClockUpdate, SyncStatus
from estimation.events import AUTOPILOT, TimeSync
from estimation.outcome import Outcome

ARRIVAL = "arrival"
"""Name of the clock that ``arrival_ns`` is read from."""


@dataclass(frozen=True, slots=True)
class ArrivalSettings:
    """Parameters of a map that rests on arrivals alone."""

    transport_sigma_ns: float = 50_000_000.0
    """1 sigma of the transport delay that is in every arrival and that nothing here can show."""
    window_ns: int = 20_000_000_000
    """The smallest difference is taken over the last one to two of these, so that drift is followed."""
    jump_ns: int = 200_000_000
    """A difference this far from the expected one is set aside."""
    agreeing: int = 10
    agreeing_span_ns: int = 500_000_000
    """So many set aside in a row, over at least this time and equal within half a jump, are believed."""
    skew_ppm: float = 50.0


@dataclass(slots=True)
class ArrivalMap:
    """Offset of a clock from the arrivals of its messages: the smallest arrival less stamp of late.

    ``to_reference(stamp)`` is the time of a prompt arrival. It is later than the moment of stamping by the
    shortest transport delay, which is unknown: see ``sigma_ns``.
    """

    settings: ArrivalSettings = field(default_factory=ArrivalSettings)
    window_start_ns: int = 0
    current_ns: int | None = None
    previous_ns: int | None = None
    last_arrival_ns: int = 0
    steps: int = 0
    suspects: list[tuple[int, int]] = field(default_factory=list)

    @property
    def ready(self) -> bool:
        """True from the first arrival on."""
        return self.current_ns is not None

    @property
    def delay_ns(self) -> int:
        """Smallest arrival less stamp; 0 before the first arrival."""
        if self.current_ns is None:
            return 0
        return self.current_ns if self.previous_ns is None else min(self.current_ns, self.previous_ns)

    def to_reference(self, stamp_ns: int) -> int:
        """Take a stamp of the source's clock to the arrival clock."""
        return stamp_ns + self.delay_ns

    def from_reference(self, arrival_ns: int) -> int:
        """Take a time of the arrival clock to the source's clock."""
        return arrival_ns - self.delay_ns

    def sigma_ns(self, arrival_ns: int) -> float:
        """1 sigma: the unknown transport delay, and drift since the smallest difference was met."""
        if not self.ready:
            return math.inf
        drift = self.settings.skew_ppm * 1e-6 * (2 * self.settings.window_ns)
        age = max(0, arrival_ns - self.last_arrival_ns) * self.settings.skew_ppm * 1e-6
        return math.hypot(self.settings.transport_sigma_ns, drift + age)

    def update(self, stamp_ns: int, arrival_ns: int) -> ClockUpdate:
        """Take one arrival. A jump of either clock is believed after ``settings.agreeing`` agreeing arrivals.

        A burst that was held up by the transport does not count as a jump: its differences do not agree.
        """
        settings, difference = self.settings, arrival_ns - stamp_ns
        if self.current_ns is None:
            self._begin(arrival_ns, difference)
            return ClockUpdate(Outcome.FUSED)
        residual = difference - self.delay_ns
        if abs(residual) >= settings.jump_ns or arrival_ns < self.last_arrival_ns - settings.jump_ns:
            return self._suspect(difference, arrival_ns, residual)
        self.suspects.clear()
        if arrival_ns - self.window_start_ns >= settings.window_ns:
            self.previous_ns, self.current_ns = self.current_ns, difference
            self.window_start_ns = arrival_ns
        self.current_ns = min(self.current_ns, difference)
        self.last_arrival_ns = max(self.last_arrival_ns, arrival_ns)
        return ClockUpdate(Outcome.FUSED, float(residual), settings.transport_sigma_ns)

    def _begin(self, arrival_ns: int, difference: int) -> None:
        self.window_start_ns = self.last_arrival_ns = arrival_ns
        self.current_ns, self.previous_ns = difference, None
        self.suspects = []

    def _suspect(self, difference: int, arrival_ns: int, residual: int) -> ClockUpdate:
        settings, kept = self.settings, self.suspects
        kept.append((difference, arrival_ns))
        while max(d for d, _ in kept) - min(d for d, _ in kept) > settings.jump_ns // 2:
            kept.pop(0)
        if len(kept) > 10 * settings.agreeing:
            kept.pop(1)
        believed = len(kept) >= settings.agreeing and kept[-1][1] - kept[0][1] >= settings.agreeing_span_ns
        if not believed:
            return ClockUpdate(Outcome.REJECTED_GATE, float(residual), settings.transport_sigma_ns)
        jump = min(d for d, _ in kept) - self.delay_ns
        self._begin(arrival_ns, min(d for d, _ in kept))
        self.steps += 1
        return ClockUpdate(Outcome.FUSED, float(residual), settings.transport_sigma_ns, -jump)


@dataclass(frozen=True, slots=True)
class Reading:
    """A stamp on the estimator's clock, its 1 sigma, and what the conversion rests on."""

    time_ns: int
    sigma_ns: float
    source: str
    """``same`` (no conversion), ``exchanges`` or ``arrivals``."""


@dataclass(frozen=True, slots=True)
class ClockSummary:
    """One clock against the estimator's: offset = this clock less the estimator's."""

    clock: str
    source: str
    status: SyncStatus
    offset_ns: int
    skew_ppm: float
    skew_sigma_ppm: float
    sigma_ns: float
    asymmetry_bound_ns: float
    steps: int
    slips: int


_Edge = tuple[str, str]


class ClockBank:
    """All clocks of a flight, and the way from each to the estimator's clock.

    The law: of two stamps of one clock, the later one is never given the earlier time, whichever is converted
    first, unless a step or a change of source was reported in between (``reacquired`` counts these, ``held``
    the stamps that were held back to keep the order).
    """

    def __init__(
        self,
        estimator_clock: str = AUTOPILOT,
        settings: ClockSettings | None = None,
        arrival_settings: ArrivalSettings | None = None,
    ) -> None:
        self.estimator_clock = estimator_clock
        self.settings = settings or ClockSettings()
        self.arrival_settings = arrival_settings or ArrivalSettings()
        self.held = 0
        self.reacquired = 0
        self._maps: dict[_Edge, ClockMap] = {}
        self._arrivals: dict[str, ArrivalMap] = {}
        self._highest: dict[str, tuple[int, int]] = {}
        self._routes: dict[str, list[tuple[str, str]]] = {}

    def exchange(self, event: TimeSync) -> ClockUpdate:
        """Take one exchange between ``event.clock`` and ``event.reference_clock``."""
        if event.clock == event.reference_clock:
            return ClockUpdate(Outcome.REJECTED_NOT_READY)
        edge = (event.reference_clock, event.clock)
        pair = self._maps.get(edge)
        if pair is None:
            pair = self._maps[edge] = ClockMap(self.settings)
        first = not pair.ready
        update = pair.update(event.sent_ns, event.remote_ns, event.received_ns)
        if first and pair.ready:
            self._forget(set(self._highest))
        elif update.step_ns or (update.outcome is Outcome.DOWNWEIGHTED):
            self._forget({c for c in self._highest if edge in self._crossed(c)})
        return update

    def observe(self, clock: str, stamp_ns: int, arrival_ns: int) -> ClockUpdate:
        """Take the arrival of any message stamped by ``clock``."""
        seen = self._arrivals.get(clock)
        if seen is None:
            seen = self._arrivals[clock] = ArrivalMap(self.arrival_settings)
        update = seen.update(stamp_ns, arrival_ns)
        if update.step_ns:
            by_arrivals = {c for c in self._highest if not self._route(c)}
            self._forget(by_arrivals if clock == self.estimator_clock else by_arrivals & {clock})
        return update

    def convert(self, clock: str, stamp_ns: int) -> Reading | None:
        """Take a stamp to the estimator's clock, or return None where nothing connects the two yet."""
        reading = self.look(clock, stamp_ns)
        if reading is None or clock == self.estimator_clock:
            return reading
        highest = self._highest.get(clock)
        if highest is None:
            self._highest[clock] = (stamp_ns, reading.time_ns)
            return reading
        later = stamp_ns >= highest[0]
        if (later and reading.time_ns < highest[1]) or (not later and reading.time_ns > highest[1]):
            self.held += 1
            reading = Reading(highest[1], reading.sigma_ns, reading.source)
        if later:
            self._highest[clock] = (stamp_ns, reading.time_ns)
        return reading

    def look(self, clock: str, stamp_ns: int) -> Reading | None:
        """Return what ``convert`` would, but for the order of stamps, which is neither kept nor changed."""
        if clock == self.estimator_clock:
            return Reading(stamp_ns, 0.0, "same")
        return self._by_exchanges(clock, stamp_ns) or self._by_arrivals(clock, stamp_ns)

    def summary(self, at_ns: int) -> list[ClockSummary]:
        """Return every clock met so far against the estimator's, at a time of the estimator's clock."""
        clocks = {c for edge in self._maps for c in edge} | set(self._arrivals)
        rows = []
        for clock in sorted(clocks - {self.estimator_clock}):
            row = self._summary_of(clock, at_ns)
            if row is not None:
                rows.append(row)
        return rows

    def snapshot(self) -> dict[str, Any]:
        """Return the whole state as plain values, for a checkpoint."""
        return {
            "maps": [[*edge, m.snapshot()] for edge, m in self._maps.items()],
            "arrivals": {
                c: {k: v for k, v in asdict(m).items() if k != "settings"} for c, m in self._arrivals.items()
            },
            "highest": dict(self._highest),
            "held": self.held,
            "reacquired": self.reacquired,
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Return to a state that ``snapshot`` gave."""
        self._maps = {}
        for reference, clock, state in snapshot["maps"]:
            self._maps[(reference, clock)] = restored = ClockMap(self.settings)
            restored.restore(state)
        self._arrivals = {}
        for clock, state in snapshot["arrivals"].items():
            suspects = [(d, a) for d, a in state["suspects"]]
            self._arrivals[clock] = ArrivalMap(self.arrival_settings, **{**state, "suspects": suspects})
        self._highest = {c: (s, t) for c, (s, t) in snapshot["highest"].items()}
        self.held, self.reacquired = snapshot["held"], snapshot["reacquired"]
        self._routes = {}

    def _forget(self, clocks: set[str]) -> None:
        """Drop the order kept for clocks whose conversion has changed at once."""
        self._routes = {}
        for clock in clocks:
            del self._highest[clock]
            self.reacquired += 1

    def _route(self, clock: str) -> list[tuple[str, str]]:
        """Shortest way from ``clock`` to the estimator's over ready exchanges, as pairs; [] if none."""
        if clock in self._routes:
            return self._routes[clock]
        before: dict[str, str] = {clock: clock}
        queue = [clock]
        for here in queue:
            for edge, pair in self._maps.items():
                if pair.ready and here in edge:
                    there = edge[1] if edge[0] == here else edge[0]
                    if there not in before:
                        before[there] = here
                        queue.append(there)
        steps: list[tuple[str, str]] = []
        node = self.estimator_clock
        while node in before and node != clock:
            steps.append((before[node], node))
            node = before[node]
        self._routes[clock] = steps[::-1]
        return self._routes[clock]

    def _crossed(self, clock: str) -> set[_Edge]:
        pairs = self._route(clock)
        return {p if p in self._maps else (p[1], p[0]) for p in pairs}

    def _by_exchanges(self, clock: str, stamp_ns: int) -> Reading | None:
        route = self._route(clock)
        if not route:
            return None
        time_ns, variance = stamp_ns, 0.0
        for here, there in route:
            pair = self._maps.get((there, here))
            if pair is not None:
                time_ns = pair.to_reference(time_ns)
                variance += pair.sigma_ns(time_ns) ** 2
            else:
                pair = self._maps[(here, there)]
                variance += pair.sigma_ns(time_ns) ** 2
                time_ns = pair.from_reference(time_ns)
        return Reading(time_ns, math.sqrt(variance), "exchanges")

    def _by_arrivals(self, clock: str, stamp_ns: int) -> Reading | None:
        own = self._arrivals.get(self.estimator_clock)
        if own is None:
            return None
        if clock == ARRIVAL:
            return Reading(own.from_reference(stamp_ns), own.sigma_ns(stamp_ns), "arrivals")
        other = self._arrivals.get(clock)
        if other is None:
            return None
        arrival_ns = other.to_reference(stamp_ns)
        sigma = math.hypot(other.sigma_ns(arrival_ns), own.sigma_ns(arrival_ns))
        return Reading(own.from_reference(arrival_ns), sigma, "arrivals")

    def _summary_of(self, clock: str, at_ns: int) -> ClockSummary | None:
        crossed = sorted(self._crossed(clock))
        if crossed:
            guess = at_ns
            for _ in range(3):  # offset at the estimator's time: the inverse of the chain, by iteration
                reading = self._by_exchanges(clock, guess)
                if reading is None:
                    return None
                guess += at_ns - reading.time_ns
            pairs = [self._maps[e] for e in crossed]
            worst = max((p.status() for p in pairs), key=list(SyncStatus).index)
            skew = sum(
                self._maps[(b, a)].skew_ppm if (b, a) in self._maps else -self._maps[(a, b)].skew_ppm
                for a, b in self._route(clock)
            )
            return ClockSummary(
                clock,
                "exchanges",
                worst,
                guess - at_ns,
                skew,
                math.sqrt(sum(p.skew_sigma_ppm**2 for p in pairs)),
                reading.sigma_ns if reading else math.inf,
                sum(p.asymmetry_bound_ns for p in pairs),
                sum(p.steps for p in pairs),
                sum(p.slips for p in pairs),
            )
        by_arrivals = self._by_arrivals(clock, at_ns)
        if by_arrivals is None:
            return None
        own, other = self._arrivals[self.estimator_clock], self._arrivals.get(clock)
        steps = own.steps + (other.steps if other else 0)
        offset = at_ns - by_arrivals.time_ns
        arrival_ns = own.to_reference(at_ns)
        sigma = math.hypot(own.sigma_ns(arrival_ns), other.sigma_ns(arrival_ns) if other else 0.0)
        return ClockSummary(
            clock, "arrivals", SyncStatus.ACQUIRING, offset, 0.0, math.inf, sigma, math.inf, steps, 0
        )
