"""Writing a result: the log's own messages as they were, and beside them what the filter made of them.

The output holds no time of writing and no path, so that the same log and configuration give the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from deckfix._version import __version__
from deckfix.files import output_file
from deckfix.reference import rotation_vector_columns
from estimation.events import AUTOPILOT
from estimation.state import ATTITUDE, BLOCKS, NOMINAL

if TYPE_CHECKING:
    from deckfix.forecasts import Forecasts
    from deckfix.result import Result
    from estimation.output import Run
    from logs.reader import Flight
    from logs.recording import Series
    from logs.writer import FlightWriter

OURS = ("/estimate/", "/smoothed/", "/fusion", "/heave/")
"""Topics that a replay writes; those of an earlier replay are not copied."""
VISION = "deckfix.vision"
"""Metadata record that tells what the images showed that the fixes in a log come from."""
_DAY_NS = 86_400_000_000_000
SOFTWARE = "deckfix.estimate"
"""Metadata record that tells what made the estimates."""


def write(
    result: Result, path: str | Path, *, force: bool = False, inputs: Sequence[str | Path] = ()
) -> None:
    """Write a result's log and estimates to an MCAP file.

    Raises ``deckfix.files.OutputError`` where the file may not be written, and ``ValueError`` for a result
    that did not come from a log.
    """
    from deckfix.replaying import CONFIG_NAME
    from logs.events import series_of_batch
    from logs.writer import FlightWriter

    flight = result.source
    if flight is None:
        raise ValueError("this result did not come from a log; there is nothing to write it beside")
    with (
        output_file(path, force=force, inputs=(flight.path, *inputs)) as partial,
        FlightWriter(partial, force=True, clock_offsets_ns=flight.clock_offsets_ns) as writer,
    ):
        seen = result.images
        fixes = [] if seen is None or seen.fixes is None else series_of_batch(seen.fixes)
        copy_source(flight, writer, attachments=(CONFIG_NAME,), cameras=seen.sensors if seen else ())
        writer.add_attachment(CONFIG_NAME, "application/toml", result.config_text.encode())
        writer.add_metadata(SOFTWARE, {"software": f"deckfix {__version__}", "engine": result.run.engine})
        if seen is not None and seen.source == "images":
            told = {k: str(v) for k, v in seen.block().items() if not isinstance(v, dict)}
            writer.add_metadata(VISION, told | {f"no fix: {why}": str(n) for why, n in seen.no_fix.items()})
        utc_offset_ns = flight.clock_offsets_ns.get(AUTOPILOT, 0)
        series = estimate_series(result.run, utc_offset_ns, result.forecasts)
        writer.write_series(*fixes, *series, *smoothed_series(result.smoothed, utc_offset_ns))


def copy_source(
    flight: Flight, writer: FlightWriter, *, attachments: Sequence[str] = (), cameras: Sequence[str] = ()
) -> None:
    """Copy metadata, attachments and messages of a log, in the order of their arrival, without our own
    topics, without the ``attachments`` and without the fixes of the ``cameras`` (sensors) that are replaced.
    """
    from logs.writer import CLOCKS

    for name, entries in flight.metadata.items():
        if name not in (CLOCKS, SOFTWARE) and not (cameras and name == VISION):
            writer.add_metadata(name, entries)
    for name, (media_type, data) in flight.attachments.items():
        if name not in attachments:
            writer.add_attachment(name, media_type, data)
    channels: dict[int, int] = {}
    for info in flight.channels:
        seen_by = info.metadata.get("sensor", "vision") if info.topic == "/vision/fix" else None
        if info.count and not info.topic.startswith(OURS) and seen_by not in cameras:
            schema = (info.message_type, info.schema_encoding, info.schema) if info.message_type else None
            channels[info.id] = writer.open_channel(info.topic, info.message_encoding, schema, info.metadata)
    topics = {info.topic for info in flight.channels if info.id in channels}
    media = {i.id for i in flight.channels if i.message_type.endswith(("CompressedImage", "CompressedVideo"))}
    for message in flight.messages(topics):
        writer.write_raw(
            channels[message.channel.id],
            message.log_time_ns,
            message.publish_time_ns,
            message.data,
            compress=message.channel.id not in media,
        )


def estimate_series(run: Run, utc_offset_ns: int, made: Forecasts) -> list[Series]:
    """Return the topics of a run: odometry, the whole state, the platform and its heave where they are on, and one
    series of fusion records a sensor.

    Fusion records are stamped with the time of their content and logged at their arrival; ``utc_offset_ns``
    takes the inertial clock to UTC. Where the content's time is not known on that clock yet (a fix before the clocks
    were compared) the arrival stands for it.
    """
    from logs.estimates import fusion_series, state_series

    out = []
    if len(run.t_ns):
        arrival = run.t_ns + utc_offset_ns
        out.extend(_pose_series("/estimate", run, arrival))
        out.append(state_series(run.state_names, run.t_ns, arrival, state_values(run), run.sigma))
    out.extend(_heave_series(run, utc_offset_ns, made))
    for index in np.unique(run.records["sensor"]):
        r = run.records[run.records["sensor"] == index]
        t_ns = np.where(
            np.abs(r["t_ns"] + utc_offset_ns - r["arrival_ns"]) < _DAY_NS,
            r["t_ns"],
            r["arrival_ns"] - utc_offset_ns,
        )
        told = (r["outcome"].astype(np.uint8), r["nis"], r["dof"].astype(np.uint8))
        name = run.sensors[int(index)]
        rest = (r["innovation"], r["sigma"], r["age_s"])
        out.append(fusion_series(name, t_ns, r["arrival_ns"], *told, *rest))
    return out


def smoothed_series(run: Run | None, utc_offset_ns: int) -> list[Series]:
    """Return the topics of smoothed estimates, ``/smoothed/...``, logged at their own times; none for None."""
    return (
        [] if run is None or not len(run.t_ns) else _pose_series("/smoothed", run, run.t_ns + utc_offset_ns)
    )


def _pose_series(root: str, run: Run, arrival: NDArray[np.int64]) -> list[Series]:
    """Return the vehicle, and where its states were on the vehicle relative to the platform and the platform."""
    from logs.estimates import odometry_series

    pose = (run.position_m, run.velocity_mps, run.quaternion, run.covariance)
    vehicle = odometry_series(f"{root}/odometry", run.t_ns, arrival, *pose)
    if not run.deck.shape[1]:
        return [vehicle]
    n, covariance, deck = len(run.t_ns), run.covariance.copy(), run.deck_covariance
    covariance[:, :6, :6] = deck[:, :6, :6]
    relative = (run.deck[:, :3], run.deck[:, 3:6], run.quaternion, covariance)
    place, speed = run.position_m - run.deck[:, :3], run.velocity_mps - run.deck[:, 3:6]
    level = np.zeros((n, 4))
    level[:, 0] = 1.0
    own = np.zeros((n, 9, 9))
    own[:, 2, 2], own[:, 5, 5] = deck[:, 6, 6], deck[:, 7, 7]
    for axis, name in enumerate(("n", "e")):
        k = run.state_names.index(f"platform_offset.{name}")
        own[:, axis, axis] = run.sigma[:, k] ** 2
    return [
        vehicle,
        odometry_series(f"{root}/relative", run.t_ns, arrival, *relative),
        odometry_series(f"{root}/platform", run.t_ns, arrival, place, speed, level, own),
    ]


def _heave_series(run: Run, utc_offset_ns: int, made: Forecasts) -> list[Series]:
    """Return the heave models and their forecasts, logged at the time that each was due."""
    from deckfix.forecasts import QUIET_RATE_MPS, QUIET_S
    from logs.heave import heave_forecast_series, heave_model_series

    if not len(made):
        return []
    arrival = np.array([due for due, _ in run.heave], np.int64) + utc_offset_ns
    columns = {
        "heave_m": made.heave_m,
        "heave_sigma_m": made.sigma_m,
        "rate_mps": made.rate_mps,
        "rate_sigma_mps": made.rate_sigma_mps,
        "skill": made.skill,
        "fallback": made.fallback.astype(np.float64),
        "window_probability": made.window_probability,
    }
    told = (made.horizon_s, columns, QUIET_RATE_MPS, QUIET_S)
    return [
        *heave_model_series(made.origin_ns, arrival, [model for _, model in run.heave]),
        heave_forecast_series(made.origin_ns, arrival, *told),
    ]


def state_values(run: Run) -> NDArray[np.float64]:
    """Return the values (n, k) of the states that ``run.state_names`` names; the attitude as rotation
    vector.
    """
    identity = np.zeros_like(run.quaternion)
    identity[:, 0] = 1.0
    attitude = rotation_vector_columns(identity, run.quaternion)
    values = np.zeros((len(run.t_ns), len(run.state_names)))
    for i, name in enumerate(run.state_names):
        block, component = name.split(".", 1)
        number = next(b for b, (n, _, _) in enumerate(BLOCKS) if n == block)
        place = BLOCKS[number][1].index(component)
        values[:, i] = attitude[:, place] if number == ATTITUDE else run.nominal[:, NOMINAL[number] + place]
    return values
