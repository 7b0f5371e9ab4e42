"""The result of a replay: estimates, the fate of each measurement, and comparisons with references."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from deckfix.clock_track import ClockTrack
from deckfix.deck_reference import DeckErrors, RawFixes, height_seen_later, true_height
from deckfix.forecasts import HORIZONS_S, QUIET_RATE_MPS, QUIET_S, Forecasts, Scores, forecasts, judge
from deckfix.reference import (
    Errors,
    Trajectory,
    Window,
    column,
    compare,
    quaternion_column,
    ratio_block,
    rmse_block,
)
from deckfix.streams import Stream
from estimation.frames import quat_to_euler_columns
from estimation.outcome import Outcome

if TYPE_CHECKING:
    import pandas as pd
    import plotly.graph_objects as go

    from deckfix.log_images import ImagesTold
    from estimation.heave.model import HeaveModel
    from estimation.output import Run
    from logs.reader import Flight

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class LogMessage:
    """A line of text from the log: ``t_ns`` on the inertial clock, level as in rcl_interfaces/msg/Log."""

    t_ns: int
    level: int
    source: str
    text: str


@dataclass(frozen=True, slots=True)
class NisStatistics:
    """Of one sensor's ``count`` normalised innovations squared: mean over their degrees of freedom (1 when
    the filter is honest, less when it is cautious), the share inside their two-sided 95 % band (0.95 when it is
    honest), and the share above the band (0.025 then, more when the filter is too sure of itself).
    """

    count: int
    mean_over_dof: float
    inside_95: float
    above_95: float


@dataclass(slots=True)
class AtReference:
    """Both estimates less the truth, at the times of the autopilot's own estimate."""

    ours: Errors
    autopilot: Errors


@dataclass
class Result:
    """Everything that a replay gave.

    ``run`` holds the estimates and the measurements' records; ``t_s`` are seconds from ``start_ns``, the
    first inertial sample. ``truth_errors`` are at the estimates' times; ``at_autopilot`` at the
    autopilot's; both are None where the log holds no such reference, as ``deck_errors`` is. ``platform`` is the
    platform's truth, ``fixes`` what each vision fix says by itself, ``clock_tracks`` every other clock over time,
    ``vision_latency_s`` the configured age of a fix. ``smoothed`` has the smoothed estimates in ``run``'s columns, with
    their own errors, where they were asked for. ``images`` tells what became of the log's images. ``source`` is the log
    it came from, for ``write``.
    """

    flight: str
    run: Run
    streams: tuple[Stream, ...]
    start_ns: int
    end_ns: int
    judged: Window
    config_text: str
    config_source: str
    wall_s: float = 0.0
    truth: Trajectory | None = None
    autopilot: Trajectory | None = None
    truth_errors: Errors | None = None
    at_autopilot: AtReference | None = None
    platform: Trajectory | None = None
    deck_errors: DeckErrors | None = None
    fixes: RawFixes | None = None
    clocks: dict[str, dict[str, Any]] = field(default_factory=dict)
    clock_tracks: tuple[ClockTrack, ...] = ()
    vision_latency_s: float = 0.0
    smoothed: Run | None = None
    smoothed_errors: Errors | None = None
    smoothed_deck_errors: DeckErrors | None = None
    problems: tuple[str, ...] = ()
    messages: tuple[LogMessage, ...] = ()
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    vibration_mps2: float | None = None
    images: ImagesTold | None = None
    source: Flight | None = None

    @cached_property
    def t_s(self) -> Array:
        """Times of the estimates [s] from the first inertial sample, shape (n,)."""
        return self.seconds_of(self.run.t_ns)

    @cached_property
    def euler_rad(self) -> Array:
        """Roll, pitch, yaw [rad] of the estimates, shape (n, 3)."""
        return quat_to_euler_columns(self.run.quaternion)

    @cached_property
    def state_values(self) -> Array:
        """Values (n, k) of the states that ``run.state_names`` names; the attitude as rotation vector."""
        from deckfix.estimate_log import state_values

        return state_values(self.run)

    @cached_property
    def has_deck(self) -> bool:
        """True where the platform's states were on and at least one vision fix was fused."""
        from deckfix.deck_reference import first_fix_ns

        return bool(self.run.deck.shape[1]) and len(self.run.t_ns) > 1 and first_fix_ns(self.run) is not None

    @cached_property
    def forecasts(self) -> Forecasts:
        """The forecast of every heave model of the flight."""
        return forecasts(self.run.heave)

    @cached_property
    def forecast_scores(self) -> Scores | None:
        """The forecasts against what happened: the truth where the log has it, else the later estimate.

        None where there are none, or nothing to compare with.
        """
        if not len(self.forecasts):
            return None
        happened = true_height(self.run, self.platform) if self.platform is not None else None
        if happened is not None:
            return judge(self.forecasts, happened, "truth")
        later = height_seen_later(self.run)
        return None if later is None else judge(self.forecasts, later, "estimate")

    @property
    def duration_s(self) -> float:
        """Time from the first to the last inertial sample [s]."""
        return (self.end_ns - self.start_ns) * 1e-9

    def seconds_of(self, t_ns: NDArray[np.int64]) -> Array:
        """Return times on the inertial clock as seconds from the first inertial sample."""
        return (t_ns - self.start_ns).astype(np.float64) * 1e-9

    def seconds(self, t_ns: int) -> float:
        """Return a time on the inertial clock as seconds from the first inertial sample."""
        return (t_ns - self.start_ns) * 1e-9

    def sensor_records(self, name: str) -> NDArray[np.void]:
        """Return the records of one sensor's measurements."""
        records: NDArray[np.void] = self.run.records
        chosen: NDArray[np.void] = records[records["sensor"] == self.run.sensors.index(name)]
        return chosen

    @cached_property
    def measured(self) -> tuple[str, ...]:
        """Names of the sensors that have records, in the estimator's order."""
        present = set(np.unique(self.run.records["sensor"]).tolist())
        return tuple(name for i, name in enumerate(self.run.sensors) if i in present)

    @cached_property
    def unused(self) -> tuple[str, ...]:
        """Names of the sensors whose measurements were never compared: switched off, or never ready.

        At least nine in ten met ``REJECTED_NOT_READY``; single ones may have been late or repeated before.
        """
        out = []
        for name in self.measured:
            counts = self.outcomes(name)
            idle = counts.get(Outcome.REJECTED_NOT_READY, 0) >= 0.9 * sum(counts.values())
            if idle and self.nis(name) is None:
                out.append(name)
        return tuple(out)

    @cached_property
    def tried(self) -> NDArray[np.void]:
        """The records of the sensors that are in use, from the first estimate on."""
        records = self.run.records
        if not len(self.run.t_ns):
            return records[:0]
        off = [self.run.sensors.index(n) for n in self.unused]
        tried: NDArray[np.void] = records[
            ~np.isin(records["sensor"], off) & (records["t_ns"] >= self.run.t_ns[0])
        ]
        return tried

    def outcomes(self, name: str) -> dict[Outcome, int]:
        """Return how often each outcome befell a sensor's measurements; those that never did are left out."""
        values, counts = np.unique(self.sensor_records(name)["outcome"], return_counts=True)
        return {Outcome(int(v)): int(c) for v, c in zip(values, counts, strict=True)}

    def nis(self, name: str) -> NisStatistics | None:
        """Return the consistency of one sensor's innovations; None where none was formed."""
        records = self.sensor_records(name)
        records = records[np.isfinite(records["nis"]) & (records["dof"] > 0)]
        if not len(records):
            return None
        dof = records["dof"].astype(np.float64)
        low, high = nis_band(dof)
        nis = records["nis"]
        inside, above = np.mean((nis >= low) & (nis <= high)), np.mean(nis > high)
        return NisStatistics(len(records), float(np.mean(nis / dof)), float(inside), float(above))

    def summary(self) -> dict[str, Any]:
        """Return the summary that ``deckfix replay --json`` writes (docs/json.md); what is absent is left
        out.
        """
        out: dict[str, Any] = {
            "flight": self.flight,
            "duration_s": self.duration_s,
            "engine": self.run.engine,
            "wall_s": self.wall_s,
            "events": {
                s.name: {"count": s.count, "rate_hz": s.rate_hz, "gaps": len(s.gaps)} for s in self.streams
            },
            "fusion": {n: {o.name: c for o, c in self.outcomes(n).items()} for n in self.measured},
            "nis": {
                n: {"mean_over_dof": s.mean_over_dof, "inside_95": s.inside_95, "above_95": s.above_95}
                for n in self.measured
                if (s := self.nis(n)) is not None
            },
        }
        if self.images is not None:
            out["vision"] = self.images.block()
        if self.truth_errors is not None:
            out["truth"] = {"odometry": rmse_block(self.truth_errors, self.judged)}
            if self.deck_errors is not None:
                out["truth"] |= self.deck_errors.blocks()
        if self.smoothed is not None:
            out["smoothed"] = self._smoothed_block(self.smoothed)
        if self.at_autopilot is not None:
            ours, theirs = self.at_autopilot.ours, self.at_autopilot.autopilot
            out["autopilot"] = rmse_block(theirs, self.judged)
            out["ratio"] = ratio_block(ours, theirs, self.judged) | {
                "window_s": [self.seconds(self.judged.start_ns), self.seconds(self.judged.end_ns)]
            }
            if self.judged.contact_ns is not None:
                out["ratio"]["contact_s"] = self.seconds(self.judged.contact_ns)
        if self.clocks:
            out["clock"] = self.clocks
        if self.run.heave:
            out["heave"] = heave_block(self.run.heave[-1][1], self.forecasts)
            if self.forecast_scores is not None:
                out["heave"]["forecast"] = self.forecast_scores.block()
        return out

    def _smoothed_block(self, smoothed: Run) -> dict[str, Any]:
        """Return the smoothed estimates' errors; without a truth the filter's less the smoothed ones."""
        block: dict[str, Any] = {"estimates": len(smoothed.t_ns)}
        if self.smoothed_errors is not None:
            block["odometry"] = rmse_block(self.smoothed_errors, self.judged)
            if self.smoothed_deck_errors is not None:
                block |= self.smoothed_deck_errors.blocks()
        elif len(smoothed.t_ns) > 1:
            t = smoothed.t_ns
            attitude = quaternion_column(t, smoothed.quaternion)
            reference = Trajectory(column(t, smoothed.position_m), column(t, smoothed.velocity_mps), attitude)
            own = (self.run.t_ns, self.run.position_m, self.run.velocity_mps, self.run.quaternion)
            block["filter_less_smoothed"] = rmse_block(compare(*own, reference, self.judged), self.judged)
        return block

    def to_pandas(self) -> pd.DataFrame:
        """Return the estimates as a table: one row each, indexed by seconds, with every state and its sigma.

        Raises ``ImportError`` with the remedy where pandas is not installed.
        """
        try:
            import pandas
        except ImportError:
            raise ImportError("to_pandas() needs pandas; install it with: pip install pandas") from None
        columns: dict[str, Any] = {"t_ns": self.run.t_ns}
        for i, axis in enumerate("ned"):
            columns[f"position_{axis}_m"] = self.run.position_m[:, i]
        for i, axis in enumerate("ned"):
            columns[f"velocity_{axis}_mps"] = self.run.velocity_mps[:, i]
        for i, angle in enumerate(("roll", "pitch", "yaw")):
            columns[f"{angle}_rad"] = self.euler_rad[:, i]
        for i, part in enumerate("wxyz"):
            columns[f"quaternion_{part}"] = self.run.quaternion[:, i]
        for i, name in enumerate(self.run.state_names):
            columns[f"state {name}"] = self.state_values[:, i]
            columns[f"sigma {name}"] = self.run.sigma[:, i]
        return pandas.DataFrame(columns, index=pandas.Index(self.t_s, name="t_s"))

    def figure(self) -> go.Figure:
        """Return the track, the height and the errors as one plotly figure."""
        import plotly.graph_objects as go

        from deckfix.figures import overview

        return go.Figure(overview(self))

    def report(self) -> str:
        """Return the report as one self-contained HTML page."""
        from deckfix.report import render

        return render(self)

    def write(self, path: str | Path, *, force: bool = False, inputs: Sequence[str | Path] = ()) -> None:
        """Write the sensors as they were recorded and the estimates to an MCAP file; same bytes each time.

        Raises ``deckfix.files.OutputError`` where the file may not be written.
        """
        from deckfix.estimate_log import write

        write(self, path, force=force, inputs=inputs)


def heave_block(model: HeaveModel, made: Forecasts | None = None) -> dict[str, Any]:
    """Return a heave model in the terms of the summary: components are (A [m], T [s], phi [rad]) of seed (3.6), largest
    first, with t = 0 at the model's last fix. ``made`` has the model's forecast in its last row.
    """
    largest = sorted(model.components, key=lambda c: -c[0])[:8]
    made = forecasts([(0, model)]) if made is None else made
    at = dict(zip(HORIZONS_S, range(len(HORIZONS_S)), strict=True))
    return {
        "method": model.method,
        "reason": model.reason,
        "hs_m": float(model.hs_m),
        "tp_s": float(model.tp_s),
        "dominant_period_s": float(model.dominant_period_s),
        "level_m": float(model.level_m),
        "level_sigma_m": float(model.level_sigma_m),
        "components": [[float(v) for v in c] for c in largest],
        "skill": {f"{h:g}": float(made.skill[-1, k]) for h, k in at.items() if h > 0},
        "window": {
            "rate_limit_mps": QUIET_RATE_MPS,
            "duration_s": QUIET_S,
            "probability": {f"{h:g}": float(made.window_probability[-1, k]) for h, k in at.items()},
        },
    }


def nis_band(dof: Array) -> tuple[Array, Array]:
    """Return the bounds between which 95 % of chi-square values with these degrees of freedom lie."""
    from scipy.special import gammaincinv

    return 2.0 * gammaincinv(dof / 2.0, 0.025), 2.0 * gammaincinv(dof / 2.0, 0.975)
