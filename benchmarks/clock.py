"""Clock layer: error of the offset after some time, against the autopilot's own kind of filter.

Two-way exchanges at 10 Hz over 120 s; each direction takes 0.5 ms and an exponential queueing delay of the
given mean; the remote clock runs 20 ppm fast and its rate wanders by 0.02 ppm per root second. Printed: RMS
error of the offset in microseconds over the trials, with the filters run on the same exchanges, and the
normalised squared error (NEES) of the map, which is 1 for an honest sigma.

    python benchmarks/clock.py [--trials 100] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from targets import Target, Targets, provenance

from estimation.clock import ClockMap

BASE_NS = 1_700_000_000_000_000_000
REMOTE_BASE_NS = 3_600_000_000_000
JITTER_S = (0.3e-3, 2e-3, 5e-3)
TIMES_S = (30.0, 115.0)


@dataclass(slots=True)
class GainScheduledFilter:
    """Double exponential smoothing of offset and skew with gains that fall over 500 samples.

    The scheme of PX4's time synchronisation (gains 0.05 to 0.003, round trips above 10 ms dropped), in us.
    """

    offset_us: float = 0.0
    skew_us: float = 0.0
    sequence: int = 0

    def update(self, offset_us: float, round_trip_us: float) -> None:
        if round_trip_us > 10_000.0:
            return
        progress = min(self.sequence / 500.0, 1.0)
        blend = 1.0 if progress >= 1.0 else 1.0 - math.exp(0.5 * (1.0 - 1.0 / (1.0 - progress)))
        gain = blend * 0.003 + (1.0 - blend) * 0.05
        if self.sequence == 0:
            self.offset_us = offset_us
        else:
            before = self.offset_us
            self.offset_us = gain * offset_us + (1.0 - gain) * (self.offset_us + self.skew_us)
            self.skew_us = gain * (self.offset_us - before) + (1.0 - gain) * self.skew_us
        self.sequence += 1


@dataclass(slots=True)
class MeanOfFiveSeconds:
    """Mean of the mid-points of the last 50 exchanges."""

    kept: deque[float] = field(default_factory=lambda: deque(maxlen=50))

    @property
    def offset_us(self) -> float:
        return sum(self.kept) / len(self.kept)


@dataclass(frozen=True, slots=True)
class Exchanges:
    """Times of n exchanges and the true offset (remote less reference, less its constant) at each [ns]."""

    sent: NDArray[np.int64]
    remote: NDArray[np.int64]
    received: NDArray[np.int64]
    offset: NDArray[np.float64]


def simulate(rng: np.random.Generator, jitter_s: float, duration_s: float = 120.0) -> Exchanges:
    """Exchanges at 10 Hz with exponential queueing per direction."""
    n, dt = int(duration_s * 10), 0.1
    t = np.arange(n) * dt + rng.uniform(0.0, 0.01, n)
    skew = 20e-6 + np.cumsum(rng.normal(0.0, 0.02e-6 * math.sqrt(dt), n))
    offset = 0.25 + np.cumsum(skew * dt)
    there, back = (0.5e-3 + rng.exponential(jitter_s, n) for _ in range(2))
    at_remote = t + there
    remote = at_remote + np.interp(at_remote, t, offset)
    received = at_remote + back

    def whole(seconds: NDArray[np.float64], base: int) -> NDArray[np.int64]:
        return base + np.rint(seconds * 1e9).astype(np.int64)

    return Exchanges(whole(t, BASE_NS), whole(remote, REMOTE_BASE_NS), whole(received, BASE_NS), offset * 1e9)


def errors_us(exchanges: Exchanges, times_s: Sequence[float]) -> dict[str, list[float]]:
    """Offset errors [us] of every method at the given times, and the map's normalised squared error."""
    mapped, scheduled, mean = ClockMap(), GainScheduledFilter(), MeanOfFiveSeconds()
    constant = REMOTE_BASE_NS - BASE_NS
    out: dict[str, list[float]] = {"map": [], "gain-scheduled": [], "5 s mean": [], "nees": []}
    marks = [int(t * 10) for t in times_s]
    rows = zip(
        exchanges.sent.tolist(),
        exchanges.remote.tolist(),
        exchanges.received.tolist(),
        exchanges.offset.tolist(),
        strict=True,
    )
    for k, (sent, remote, received, truth) in enumerate(rows):
        mapped.update(sent, remote, received)
        middle_us = (remote - (sent + received) // 2 - constant) / 1e3
        scheduled.update(middle_us, (received - sent) / 1e3)
        mean.kept.append(middle_us)
        if k in marks:
            error = (mapped.offset_ns(sent) - constant) - truth
            out["map"].append(error / 1e3)
            out["gain-scheduled"].append(scheduled.offset_us - truth / 1e3)
            out["5 s mean"].append(mean.offset_us - truth / 1e3)
            out["nees"].append((error / mapped.sigma_ns(sent)) ** 2)
    return out


def run(trials: int, seed: int = 20) -> list[dict[str, float | str]]:
    """RMS error over the trials, one row per jitter, time and method."""
    rows: list[dict[str, float | str]] = []
    for jitter in JITTER_S:
        rng = np.random.default_rng(seed)
        results = [errors_us(simulate(rng, jitter), TIMES_S) for _ in range(trials)]
        for i, at in enumerate(TIMES_S):
            row: dict[str, float | str] = {"jitter_ms": jitter * 1e3, "time_s": at, "trials": trials}
            for method in ("map", "gain-scheduled", "5 s mean"):
                values = np.array([r[method][i] for r in results])
                row[method + "_rms_us"] = float(np.sqrt(np.mean(values**2)))
            row["map_worst_us"] = float(max(abs(r["map"][i]) for r in results))
            row["map_nees"] = float(np.mean([r["nees"][i] for r in results]))
            rows.append(row)
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0] if __doc__ else None)
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    began = time.perf_counter()
    rows = run(arguments.trials)
    print("jitter  after   map rms (worst)  NEES   gain-scheduled   5 s mean    [us]")
    for r in rows:
        print(
            f"{r['jitter_ms']:4.1f} ms {r['time_s']:4.0f} s {r['map_rms_us']:8.1f} ({r['map_worst_us']:6.1f})"
            f" {r['map_nees']:6.2f} {r['gain-scheduled_rms_us']:12.1f} {r['5 s mean_rms_us']:13.1f}"
        )
    target = next(r for r in rows if r["jitter_ms"] == 2.0 and r["time_s"] == TIMES_S[-1])
    targets = Targets()
    name = "clock layer at 2 min with 2 ms jitter, rms [us]"
    targets.add(Target(name, float(target["map_rms_us"]), 100.0))
    good = targets.report()
    print(f"{arguments.trials} trials, {time.perf_counter() - began:.1f} s")
    if arguments.json:
        out = {"benchmark": "clock", **provenance(), "rows": rows, "targets": targets.as_rows()}
        arguments.json.write_text(json.dumps(out, indent=1) + "\n")
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
