"""The log of a mission: what arrived, what was decided and what is true, as an ordinary flight log."""

from __future__ import annotations

import numpy as np

from estimation.config import dump_config
from estimation.events import AUTOPILOT
from logs.estimates import landing_series
from logs.events import series_of_batch
from logs.recording import Recording, Series
from logs.sensors import Times, odometry_series
from simulation.flight import deck_axes
from simulation.sensors import CLOCKS, Clock
from simulation.trajectory import quaternions
from simulation.world import Flown


def mission_recording(flown: Flown) -> Recording:
    """Return a flown mission as a recording: sensors, decisions, truth, the configuration and how it was made."""
    m, place = flown.mission, flown.place
    series = series_of_batch(flown.batch)
    for one in series:
        if one.topic == "/imu":
            one.metadata["latency_s"] = repr(m.drawn.imu.latency_s or 0.0)
    used = {s.clock for s in series} | {AUTOPILOT}
    offsets = {}
    for name in CLOCKS:
        offset = round(m.clocks.get(name, Clock()).offset_s * 1e9)
        offsets[name] = place.utc_ns - offset if name == AUTOPILOT else -offset
    decided = _times(flown, flown.decided_s)
    contact = flown.contact
    touch = {} if contact is None else {
        "contact_s": f"{contact.t_s:.4f}",
        "contact_speed_mps": f"{contact.speed_mps:.4f}",
        "contact_miss_m": f"{contact.miss_m:.4f}",
    }  # fmt: skip
    return Recording(
        series=[
            *series,
            *landing_series(decided.stamp_ns, decided.arrival_ns, flown.decisions),
            *_truth(flown),
        ],
        clock_offsets_ns={name: offset for name, offset in offsets.items() if name in used},
        metadata={
            "deckfix.simulation": {
                "description": m.description,
                "seed": str(flown.seed),
                "end": flown.end,
                **touch,
            }
        },
        attachments={"config.toml": ("application/toml", dump_config(m.config).encode())},
    )


def _times(flown: Flown, t_s: np.ndarray[tuple[int], np.dtype[np.float64]]) -> Times:
    arrival = flown.place.utc_ns + np.round(t_s * 1e9).astype(np.int64)
    return Times(flown.instruments.stamp_ns(AUTOPILOT, t_s), arrival)


def _truth(flown: Flown) -> list[Series]:
    times, x, deck = _times(flown, flown.t_s), flown.truth, flown.deck
    source = {"sensor": "simulation"}
    level = quaternions(deck_axes(deck[:, 6:9]))
    return [
        odometry_series("/truth/odometry", times, x[:, :3], x[:, 3:6], x[:, 6:10], source),
        odometry_series("/truth/platform", times, deck[:, :3], deck[:, 3:6], level, source),
    ]
