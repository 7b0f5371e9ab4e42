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
    from deckfix.result import Result
    from estimation.estimator import Run
    from logs.reader import Flight
    from logs.recording import Series
    from logs.writer import FlightWriter

OURS = ("/estimate/", "/fusion")
"""Topics that a replay writes; those of an earlier replay are not copied."""
SOFTWARE = "deckfix.estimate"
"""Metadata record that tells what made the estimates."""


def write(
    result: Result, path: str | Path, *, force: bool = False, inputs: Sequence[str | Path] = ()
) -> None:
    """Write a result's log and estimates to an MCAP file.

    Raises ``deckfix.files.OutputError`` where the file may not be written, and ``ValueError`` for a result that
    did not come from a log.
    """
    from deckfix.replay import CONFIG_NAME
    from logs.writer import FlightWriter

    flight = result.source
    if flight is None:
        raise ValueError("this result did not come from a log; there is nothing to write it beside")
    with (
        output_file(path, force=force, inputs=(flight.path, *inputs)) as partial,
        FlightWriter(partial, force=True, clock_offsets_ns=flight.clock_offsets_ns) as writer,
    ):
        copy_source(flight, writer)
        writer.add_attachment(CONFIG_NAME, "application/toml", result.config_text.encode())
        writer.add_metadata(SOFTWARE, {"software": f"deckfix {__version__}", "engine": result.run.engine})
        writer.write_series(*estimate_series(result.run, flight.clock_offsets_ns.get(AUTOPILOT, 0)))


def copy_source(flight: Flight, writer: FlightWriter) -> None:
    """Copy metadata, attachments and messages of a log, in the order of their arrival, without our own topics."""
    from deckfix.replay import CONFIG_NAME
    from logs.writer import CLOCKS

    for name, entries in flight.metadata.items():
        if name not in (CLOCKS, SOFTWARE):
            writer.add_metadata(name, entries)
    for name, (media_type, data) in flight.attachments.items():
        if name != CONFIG_NAME:
            writer.add_attachment(name, media_type, data)
    channels: dict[int, int] = {}
    for info in flight.channels:
        if info.count and not info.topic.startswith(OURS):
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


def estimate_series(run: Run, utc_offset_ns: int) -> list[Series]:
    """Return the topics of a run: odometry, the whole state, and one series of fusion records a sensor."""
    out = [odometry_series(run, utc_offset_ns), state_series(run, utc_offset_ns)] if len(run.t_ns) else []
    return out + fusion_series(run)


def odometry_series(run: Run, utc_offset_ns: int) -> Series:
    """Return ``/estimate/odometry``: NED pose and velocity with their covariances, body-frame for the rotation."""
    from logs.recording import Series
    from logs.topics import TOPICS, new_rows

    topic = TOPICS["/estimate/odometry"]
    rows = new_rows(topic.name, len(run.t_ns))
    rows["pose_pose_position"] = run.position_m
    rows["pose_pose_orientation"] = run.quaternion[:, [1, 2, 3, 0]]
    pose = [0, 1, 2, 6, 7, 8]
    rows["pose_covariance"] = run.covariance[:, pose][:, :, pose].reshape(-1, 36)
    twist = np.zeros((len(run.t_ns), 6, 6))
    twist[:, :3, :3] = run.covariance[:, 3:6, 3:6]
    rows["twist_twist_linear"] = run.velocity_mps
    rows["twist_covariance"] = twist.reshape(-1, 36)
    return Series(
        topic.name, run.t_ns, run.t_ns + utc_offset_ns, rows, AUTOPILOT, topic.frame_id, dict(topic.strings)
    )


def state_values(run: Run) -> NDArray[np.float64]:
    """Return the values (n, k) of the states that ``run.state_names`` names; the attitude as rotation vector."""
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


def state_series(run: Run, utc_offset_ns: int) -> Series:
    """Return ``/estimate/state``: every state with its sigma."""
    from logs.recording import Series
    from logs.topics import TOPICS, new_rows

    topic, size = TOPICS["/estimate/state"], len(run.state_names)
    rows = new_rows(topic.name, len(run.t_ns), values=size, sigmas=size)
    rows["values"], rows["sigmas"] = state_values(run), run.sigma
    names = {f"names_{i}": name for i, name in enumerate(run.state_names)}
    return Series(topic.name, run.t_ns, run.t_ns + utc_offset_ns, rows, AUTOPILOT, topic.frame_id, names)


def fusion_series(run: Run) -> list[Series]:
    """Return ``/fusion``, one series a sensor: stamped with the time of the content, logged at its arrival."""
    from logs.recording import Series
    from logs.topics import new_rows

    out = []
    for index in np.unique(run.records["sensor"]):
        records = run.records[run.records["sensor"] == index]
        rows = new_rows("/fusion", len(records))
        for name in ("outcome", "nis", "dof", "innovation", "sigma", "age_s"):
            rows[name] = records[name]
        name = run.sensors[int(index)]
        out.append(
            Series("/fusion", records["t_ns"], records["arrival_ns"], rows, AUTOPILOT, "", {"sensor": name})
        )
    return out
