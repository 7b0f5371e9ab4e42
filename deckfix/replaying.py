"""Replay: a log goes through the estimator, and the result is compared with the references that the log
holds.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from deckfix.clock_track import clock_tracks
from deckfix.deck_reference import compare_deck, raw_fixes
from deckfix.log_images import images_told
from deckfix.reference import (
    Column,
    Times,
    Trajectory,
    Window,
    column,
    compare,
    contact_time_ns,
    densest,
    quaternion_column,
    window,
)
from deckfix.result import AtReference, LogMessage, Result
from deckfix.streams import streams, vibration_mps2
from estimation.config import Config, dump_config, load_config, parse_config
from estimation.estimator import EngineName, LandingEstimator
from estimation.events import AUTOPILOT, EventBatch, Kind
from estimation.output import Facts, Run, with_facts
from estimation.state import CAMERA_LATENCY, NOMINAL

if TYPE_CHECKING:
    from estimation.filter import Model
    from logs.reader import Flight
    from logs.recording import Series

CONFIG_NAME = "config.toml"
"""Attachment in which a log carries the configuration that its estimates were made with."""
LATENCY_CONVENTION = "positive: the content is older than its stamp; t_content = t_stamp - latency"
"""What the sign of every latency that is shown means."""


def open(path: str | Path) -> Flight:
    """Open a log for reading; raises ``logs.errors.LogError``."""
    from logs.reader import open_flight

    return open_flight(path)


def replay(
    flight: Flight | str | Path,
    config: Config | str | Path | None = None,
    engine: EngineName = "auto",
    *,
    smooth: bool = False,
    images: bool | None = None,
    jobs: int | None = None,
    sensors: Mapping[str, tuple[Model, float]] | None = None,
) -> Result:
    """Run the estimator over a log and return what came out.

    ``config`` is a configuration or the path of one; without it the log's own is used, or else the default. With
    ``smooth`` the result has the smoothed estimates too (docs/smoothing.md). ``images`` says whether the log's images
    are looked at, in ``jobs`` processes (None: one a core): True always, False never, None where the log holds
    neither vision fixes nor estimates (docs/video.md). ``sensors`` are those of the user's on /user, by name: each with
    its model and its latency [s], for ``LandingEstimator.add_sensor`` (docs/add-a-sensor.md); they need the reference
    engine, which ``auto`` then is.
    Raises ``logs.errors.LogError`` where the log cannot be read or holds no inertial samples,
    ``deckfix.files.InputError`` for images that cannot be looked at and for sensors that the log lacks, and
    ``estimation.config.ConfigError`` for a configuration or an engine that cannot be used.
    """
    opened = open(flight) if isinstance(flight, str | Path) else flight
    settings, source = configuration(opened, config)
    batch = opened.events()
    imu = batch.rows["stamp_ns"][batch.rows["kind"] == int(Kind.IMU)]
    if not len(imu):
        from logs.errors import LogError

        raise LogError(
            opened.path, "holds no inertial samples (/imu)", "log the IMU, or import the file that has it"
        )
    for name in sensors or {}:
        if name not in batch.sensors:
            from deckfix.files import InputError

            told = f"{opened.path}: holds no measurements of the sensor {name!r}"
            raise InputError(f"{told}; write them to /user, or give the name that they have there")
    known = facts(opened)
    seen = images_told(opened, batch, settings, known, engine, wanted=images, jobs=jobs)
    if seen is not None and seen.fixes is not None:
        batch, known = (
            seen.replace_in(batch),
            dataclasses.replace(known, vision_by_arrival=False, vision=True),
        )
    begin = time.perf_counter()
    chosen: EngineName = "filterpy" if sensors and engine == "auto" else engine
    estimator = LandingEstimator(settings, engine=chosen, facts=known, smooth=smooth)
    for name, (model, latency_s) in (sensors or {}).items():
        estimator.add_sensor(name, model, latency_s)
    run = estimator.run(batch)
    wall_s = time.perf_counter() - begin
    result = present(opened, run, batch, settings, source, wall_s, known)
    result.images = seen
    if smooth:
        take_smoothed(result, estimator.smoothed(run))
    return result


def configuration(flight: Flight, config: Config | str | Path | None) -> tuple[Config, str]:
    """Return the configuration to use and where it comes from, in words."""
    if isinstance(config, Config):
        return config, "the configuration given"
    if config is not None:
        return load_config(config), f"the configuration in {config}"
    own = flight.attachments.get(CONFIG_NAME)
    if own is not None:
        text = own[1].decode("utf-8", errors="replace")
        return parse_config(text, f"{flight.path}: its configuration"), "the configuration in the log"
    return Config(), "the default configuration"


def facts(flight: Flight) -> Facts:
    """Return what the log itself says about the sensors: the inertial filters' delay, the declination."""
    return Facts(
        imu_latency_s=_stated(flight, "/imu", "latency_s") or 0.0,
        declination_rad=_stated(flight, "/magnetic_field", "autopilot_declination_rad"),
        vision_by_arrival=any(
            i.metadata.get("stamps") == "arrival" for i in flight.topics.get("/vision/fix", [])
        ),
        vision=any(i.count for i in flight.topics.get("/vision/fix", [])),
    )


def _stated(flight: Flight, topic: str, key: str) -> float | None:
    for info in flight.topics.get(topic, []):
        try:
            value = float(info.metadata[key])
        except (KeyError, ValueError):
            continue
        if np.isfinite(value):
            return value
    return None


def present(
    flight: Flight, run: Run, batch: EventBatch, config: Config, source: str, wall_s: float, known: Facts
) -> Result:
    """Return the result of a run over a log's events, compared with the references in the log."""
    text = dump_config(config)
    config = with_facts(config, known)
    imu = batch.rows["stamp_ns"][batch.rows["kind"] == int(Kind.IMU)]
    start_ns, end_ns = int(imu.min()), int(imu.max())
    offsets = flight.clock_offsets_ns
    truth = trajectory(flight, "/truth/odometry", offsets)
    platform = trajectory(flight, "/truth/platform", offsets)
    contact = contact_time_ns(truth, platform) if truth is not None else None
    autopilot = trajectory(flight, "/autopilot/odometry", offsets)
    result = Result(
        flight=Path(flight.path).name,
        run=run,
        streams=streams(batch),
        start_ns=start_ns,
        end_ns=end_ns,
        judged=window(start_ns, end_ns, contact),
        config_text=text,
        config_source=source,
        wall_s=wall_s,
        truth=truth,
        autopilot=autopilot,
        problems=tuple(flight.problems),
        messages=_messages(flight, offsets),
        metadata={name: dict(entries) for name, entries in flight.metadata.items()},
        vibration_mps2=vibration_mps2(batch),
        source=flight,
        clocks=clock_blocks(run, config),
        clock_tracks=clock_tracks(batch),
        platform=platform,
        vision_latency_s=config.vision.latency_s,
    )
    if run.deck.shape[1]:
        result.fixes = raw_fixes(run, batch, config)
        if truth is not None and platform is not None:
            result.deck_errors = compare_deck(run, truth, platform, result.judged)
    if truth is not None and len(run.t_ns) > 1:
        own = (run.t_ns, run.position_m, run.velocity_mps, run.quaternion)
        result.truth_errors = compare(*own, truth, result.judged, run.covariance)
        if autopilot is not None:
            result.at_autopilot = at_reference(run, autopilot, truth, result.judged)
    return result


def take_smoothed(result: Result, smoothed: Run) -> None:
    """Give a result its smoothed estimates, compared with the same references as the filter's."""
    result.smoothed = smoothed
    if result.truth is None or len(smoothed.t_ns) < 2:
        return
    own = (smoothed.t_ns, smoothed.position_m, smoothed.velocity_mps, smoothed.quaternion)
    result.smoothed_errors = compare(*own, result.truth, result.judged, smoothed.covariance)
    if result.platform is not None and smoothed.deck.shape[1]:
        result.smoothed_deck_errors = compare_deck(smoothed, result.truth, result.platform, result.judged)


def clock_blocks(run: Run, config: Config) -> dict[str, dict[str, Any]]:
    """Return what was found of every clock but the inertial one.

    ``offset_ms`` is that clock less the inertial one. ``latency_ms`` is the age of a vision fix at its stamp (positive:
    the content is older than the stamp), given where the platform's states were on, for the clock of the fixes.
    """
    out: dict[str, dict[str, Any]] = {}
    for c in run.clocks:
        values: dict[str, Any] = {
            "offset_ms": c.offset_ns * 1e-6,
            "skew_ppm": c.skew_ppm,
            "sigma_ms": c.sigma_ns * 1e-6,
            "status": str(c.status),
            "source": c.source,
        }
        out[c.clock] = {k: v for k, v in values.items() if not isinstance(v, float) or math.isfinite(v)}
    if run.deck.shape[1] and len(run.t_ns):
        k = run.state_names.index("camera_latency.t")
        age = config.vision.latency_s + float(run.nominal[-1, NOMINAL[CAMERA_LATENCY]])
        sigma = float(run.sigma[-1, k])
        learned = sigma < 0.5 * config.vision.latency_sigma_s
        for values in out.values():
            values["latency_ms"], values["latency_sigma_ms"] = age * 1e3, sigma * 1e3
            values["latency_status"] = "estimated" if learned else "unobservable"
            values["latency_convention"] = LATENCY_CONVENTION
    return out


def at_reference(run: Run, autopilot: Trajectory, truth: Trajectory, judged: Window) -> AtReference | None:
    """Return both estimates' errors against the truth at the times of the autopilot's estimate."""
    leading = autopilot.position_m or autopilot.velocity_mps or autopilot.quaternion
    q_run = quaternion_column(run.t_ns, run.quaternion)
    ours = Trajectory(column(run.t_ns, run.position_m), column(run.t_ns, run.velocity_mps), q_run)
    if leading is None or ours.position_m is None:
        return None
    t = leading.t_ns

    def errors(
        source: Trajectory,
    ) -> tuple[Times, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        nothing = np.full((len(t), 3), np.nan)
        position = source.position_m.at(t) if source.position_m else nothing
        velocity = source.velocity_mps.at(t) if source.velocity_mps else nothing
        return t, position, velocity, source.quaternion_at(t)

    return AtReference(
        ours=compare(*errors(ours), truth, judged), autopilot=compare(*errors(autopilot), truth, judged)
    )


def trajectory(flight: Flight, topic: str, offsets: dict[str, int]) -> Trajectory | None:
    """Return a reference on the inertial clock: of its sources the densest for each quantity."""
    series = [s for s in flight.series(topic) if len(s)] if topic in flight.topics else []
    times = [_on_inertial_clock(s, offsets) for s in series]
    position: list[Column | None] = []
    velocity: list[Column | None] = []
    attitude: list[Column | None] = []
    for s, t in zip(series, times, strict=True):
        position.append(column(t, s.data["pose_pose_position"]))
        velocity.append(column(t, _velocity_ned(s)))
        attitude.append(quaternion_column(t, s.data["pose_pose_orientation"][:, [3, 0, 1, 2]]))
    out = Trajectory(densest(position), densest(velocity), densest(attitude))
    empty = out.position_m is None and out.velocity_mps is None and out.quaternion is None
    return None if empty else out


def _velocity_ned(series: Series) -> NDArray[np.float64]:
    """Return the velocities (n, 3) in NED: the twist is in body axes unless the channel says otherwise."""
    if series.metadata.get("twist_frame") == "ned":
        velocity: NDArray[np.float64] = series.data["twist_twist_linear"]
        return velocity
    from logs.estimates import odometry_columns

    return odometry_columns(series).velocity_mps


def _on_inertial_clock(series: Series, offsets: dict[str, int]) -> Times:
    if series.clock == AUTOPILOT:
        return series.stamp_ns
    shift = offsets.get(series.clock, 0) - offsets.get(AUTOPILOT, 0)
    return series.stamp_ns + shift


def _messages(flight: Flight, offsets: dict[str, int]) -> tuple[LogMessage, ...]:
    """Return the texts in the log, the first 5000; a damaged one is left out (the reader tells of it)."""
    from logs.errors import LogError

    out: list[LogMessage] = []
    if "/log" not in flight.topics:
        return ()
    base = offsets.get(AUTOPILOT, 0)
    for message in flight.messages(["/log"]):
        try:
            said = message.decoded
        except LogError:
            continue
        level = said.level[0] if isinstance(said.level, bytes) else int(said.level)
        out.append(LogMessage(message.log_time_ns - base, level, str(said.name), str(said.msg)))
        if len(out) == 5000:
            break
    return tuple(out)
