"""What went wrong with the platform: fixes lost, latency unknown, clocks untied, heave not learned."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from deckfix.deck_reference import fused_fixes_ns
from deckfix.finding import Finding, Severity
from deckfix.result import Result
from estimation.events import Kind

LONGEST_LOSS_S = 2.0
LOST_S = 5.0
FEWEST_JUDGED = 30
LEAST_COVERAGE = 0.85
EXCITATION = (
    "for 20 s over the target rock the vehicle to and fro by 6 deg, first in roll and then in pitch, each way in about "
    "0.6 s, and run deckfix sync; or set the calibrated age as vision.latency_s with its vision.latency_sigma_s"
)


def deck_findings(result: Result) -> Iterator[Finding]:
    """Yield what is worth telling of the platform, its clocks and its heave; nothing without vision fixes."""
    fixes = [s for s in result.streams if s.kind is Kind.VISION]
    if not fixes or not len(result.run.t_ns):
        return
    if not result.run.deck.shape[1]:
        yield Finding(
            Severity.NOTE,
            "the log holds vision fixes, but the platform is switched off",
            "platform.use is false in the configuration",
            "leave platform.use at 'auto', or set it to true, to estimate the platform",
        )
        return
    yield from _clocks(result)
    if not result.has_deck:
        yield Finding(
            Severity.WARNING,
            "no vision fix was ever fused",
            "all were rejected, or came before the filter was ready",
            "see the outcomes of the vision sensor",
        )
        return
    yield from _losses(result)
    yield from _latency(result)
    yield from _heave(result)


def _clocks(result: Result) -> Iterator[Finding]:
    for name, told in result.clocks.items():
        if told.get("source") == "arrivals":
            yield Finding(
                Severity.WARNING,
                f"the clock {name} is tied to the inertial one by arrivals only",
                "no exchange of times with it is in the log, so that the delay of its link is part of the latency",
                "let the companion ask for TIMESYNC a few times a second, and log it",
            )
        elif told.get("status") not in (None, "locked"):
            yield Finding(
                Severity.WARNING,
                f"the clock {name} ends {told['status']}",
                "too few exchanges of times, a slow link, or a clock that stepped",
                "see the clock over time, and the round trips of TIMESYNC",
            )


def _losses(result: Result) -> Iterator[Finding]:
    times = fused_fixes_ns(result.run)
    contact = result.judged.contact_ns
    times = times if contact is None else times[times <= contact]
    steps = np.diff(times) * 1e-9
    lost = np.flatnonzero(steps > LONGEST_LOSS_S)
    if not len(lost):
        return
    worst = int(lost[np.argmax(steps[lost])])
    again = "" if len(lost) == 1 else f", the longest of {len(lost)} losses"
    yield Finding(
        Severity.WARNING if steps[worst] > LOST_S else Severity.NOTE,
        f"no vision fix was fused for {steps[worst]:.1f} s from {result.seconds(int(times[worst])):.1f} s{again}",
        "the target was out of sight, the detector failed, or the fixes were rejected",
        "see the outcomes of vision then; meanwhile GPS with its learned bias carries the relative position",
    )


def _latency(result: Result) -> Iterator[Finding]:
    told = next((c for c in result.clocks.values() if "latency_status" in c), None)
    if told is not None and told["latency_status"] == "unobservable":
        yield Finding(
            Severity.NOTE,
            f"the latency of the fixes was not observed: {told['latency_ms']:.1f} ms ± "
            f"{told['latency_sigma_ms']:.1f} ms (1 sigma) is what was assumed",
            "the vehicle turned too little while it saw the target",
            EXCITATION,
        )


def _heave(result: Result) -> Iterator[Finding]:
    models = [model for _, model in result.run.heave]
    learned = [model for model in models if model.method != "mean"]
    if not learned:
        times = fused_fixes_ns(result.run)
        span = (times[-1] - times[0]) * 1e-9
        reason = models[-1].reason if models else f"fixes over {span:.0f} s"
        yield Finding(
            Severity.NOTE if span < 15.0 else Severity.WARNING,
            f"the heave was not learned ({reason})",
            "the target was seen too shortly, or too rarely",
            "hover over the target for 20 to 60 s before landing",
        )
        return
    made, scores = result.forecasts, result.forecast_scores
    second = int(np.argmin(np.abs(made.horizon_s - 1.0)))
    fallback = float(np.mean(made.fallback[:, second]))
    if fallback > 0.5:
        yield Finding(
            Severity.NOTE,
            f"{100 * fallback:.0f} % of the forecasts 1 s ahead fell back to the level",
            "the deck hardly moves, or moves too irregularly to be foreseen",
            "nothing, on a quiet deck; else lower the fixes' noise and observe for longer",
        )
    if scores is None or scores.count[second] < FEWEST_JUDGED:
        return
    coverage = float(scores.coverage_95[second])
    if coverage < LEAST_COVERAGE:
        yield Finding(
            Severity.WARNING,
            f"only {100 * coverage:.0f} % of what happened 1 s ahead lay in the forecasts' 95 % intervals",
            "the sea changed faster than it is learned, or the fixes are noisier than they state",
            "shorten platform.learn_window_s, or raise the fixes' noise",
        )
