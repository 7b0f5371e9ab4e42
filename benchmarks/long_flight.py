"""Ten minutes of flight over a heaving deck: how long a replay takes, with recorded fixes and with images.

* ``engines``: IMU 200 Hz, GPS 5 Hz, barometer, compass and recorded vision fixes 20 Hz, the platform's states on;
  estimates only, from recorded events to the last estimate. Process time (CPU seconds of this process) of the filterpy
  engine over that of the compiled one: of the whole flight once, and of its first minute in turns, median
  (smallest..largest, n); wanted >= 15. With the heave learned on the way as by default, and without (what both engines
  share is then alignment and bookkeeping). Compilation is excluded by a run beforehand.
* ``images``: a hover whose camera takes 640x480 pictures at 20 Hz; the replay looks at them in one process and in two.
  Fixes and estimates must be the same bits; printed are pictures a second, the ratio of wall times and the share that
  the pictures are of a replay.

    python benchmarks/long_flight.py [--only engines images] [--seconds 600] [--pictures 400] [--repetitions 3]
                                     [--json FILE] [--no-gate]

Exit status 1 when a target is missed, unless --no-gate is given.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from engines import beginning, timed
from msgspec.structs import replace
from targets import Target, Targets, provenance

import deckfix
from estimation.frames import R_CB_NOMINAL, quat_to_matrix
from estimation.output import Run
from logs.images import TOPIC
from logs.writer import FlightWriter
from simulation.flight import SimulatedFlight, parse_scenario, simulate
from simulation.renderer import Renderer
from vision import Camera, RingTarget

FASTER = 15.0
CAMERA = Camera.from_fov(640, 480, np.deg2rad(62.2))
TARGET = RingTarget.recommended()
RATE_HZ = 20.0
FLIGHT = """
description = "a long hover over a raft"
[plan]
rest_s = 4.0
climb_s = 6.0
leg_s = 8.0
hover_s = {hover}
descent_s = 10.0
deck_s = 1.0
altitude_m = 6.0
start_m = [-12.0, -9.0, -1.0]
legs_m = []
yaw_rad = [0.6, 0.4]
[sea]
beaufort = 2
[streams]
timesync = {{ rate_hz = 10.0, delay_s = 0.001, delay_spread_s = 0.0005 }}
vision = {{ rate_hz = 20.0, delay_s = 0.06 }}
[clocks]
companion = {{ offset_s = 700.0, skew_ppm = 30.0 }}
[filter.platform]
use = true
[filter.imu]
gyro_noise = 3e-4
"""
AROUND_S = 29.0
"""All of the plan but the hover."""
ARRIVED_S = 18.0
Row = dict[str, Any]


def flight_of(seconds: float) -> SimulatedFlight:
    """Return a flight of so many seconds."""
    return simulate(parse_scenario(FLIGHT.format(hover=seconds - AROUND_S)), 1)


def engines(seconds: float, repetitions: int, targets: Targets) -> list[Row]:
    """Print and return the ratios of the two engines."""
    flight = flight_of(seconds)
    rows: list[Row] = []
    print(f"{seconds:.0f} s of flight, {len(flight.batch)} events")
    for label, learn_s in (
        ("heave learned", flight.scenario.config.platform.learn_s),
        ("heave not learned", 0.0),
    ):
        own = flight.scenario.config
        config = replace(own, platform=replace(own.platform, learn_s=learn_s))
        whole = ("whole", flight.batch, flight.facts, config)
        minute = ("minute", beginning(flight.batch, min(60.0, seconds)), flight.facts, config)
        timed(minute, "compiled")
        pairs = [(timed(minute, "compiled")[0], timed(minute, "filterpy")[0]) for _ in range(repetitions)]
        ratios = sorted(slow / quick for quick, slow in pairs)
        compiled_s, filterpy_s = timed(whole, "compiled")[0], timed(whole, "filterpy")[0]
        row: Row = {
            "case": label, "seconds": seconds, "events": len(flight.batch), "compiled_s": compiled_s,
            "filterpy_s": filterpy_s, "ratio": filterpy_s / compiled_s,
            "first_minute": [ratios[0], statistics.median(ratios), ratios[-1]], "repetitions": repetitions,
        }  # fmt: skip
        rows.append(row)
        print(
            f"{label}: filterpy {filterpy_s:.1f} s, compiled {compiled_s:.2f} s of CPU: {row['ratio']:.1f}x; first "
            f"minute {row['first_minute'][1]:.1f}x ({ratios[0]:.1f}..{ratios[-1]:.1f}, n {repetitions})",
            flush=True,
        )
        name, spread = f"long flight, {label}: filterpy over compiled", ratios[-1] - ratios[0]
        targets.add(Target(name, row["ratio"], FASTER, at_least=True, spread=spread))
    return rows


def write_pictures(path: Path, pictures: int) -> None:
    """Write a flight without fixes, with so many pictures from when it hovers on."""
    flight = flight_of(ARRIVED_S + pictures / RATE_HZ + AROUND_S - ARRIVED_S)
    recording = flight.recording()
    recording.series = [s for s in recording.series if s.topic != "/vision/fix"]
    for name, one in (("camera.toml", CAMERA), ("target.toml", TARGET)):
        recording.attachments[name] = ("application/toml", one.to_toml().encode())
    draw, rng = Renderer(CAMERA, TARGET), np.random.default_rng(5)
    taken = ARRIVED_S + np.arange(pictures) / RATE_HZ
    m, deck = flight.trajectory.motion(taken), flight.trajectory.platform.motion(taken)
    stamps = flight.clock.stamp_ns(taken)
    with FlightWriter(path) as writer:
        writer.write_recording(recording)
        for k in range(pictures):
            R_nc = quat_to_matrix(m.quaternion[k]) @ R_CB_NOMINAL.T
            place = m.position_m[k] - deck.position[0][k]
            done, data = cv2.imencode(".jpg", draw.render(R_nc, place, rng), [cv2.IMWRITE_JPEG_QUALITY, 90])
            assert done
            writer.write_message(
                TOPIC, {"format": "jpeg", "data": bytes(data)}, stamp_ns=int(stamps[k]), clock="autopilot",
                arrival_ns=flight.place.utc_ns + round((taken[k] + 0.03) * 1e9),
            )  # fmt: skip


def same_bits(a: Run, b: Run) -> bool:
    """Tell whether two runs give the same estimates and records, to the last bit."""
    names = ("t_ns", "nominal", "sigma", "covariance", "deck", "deck_covariance", "records")
    return all(getattr(a, n).tobytes() == getattr(b, n).tobytes() for n in names)


def images(pictures: int, repetitions: int, targets: Targets) -> Row:
    """Print and return what looking at pictures takes, in one process and in two."""
    walls: dict[int, list[float]] = {1: [], 2: []}
    results: dict[int, deckfix.Result] = {}
    with tempfile.TemporaryDirectory() as scratch:
        log = Path(scratch) / "pictures.mcap"
        write_pictures(log, pictures)
        deckfix.replay(log, jobs=2)
        for _ in range(repetitions):
            for jobs in (1, 2):
                begin = time.perf_counter()
                results[jobs] = deckfix.replay(log, jobs=jobs)
                walls[jobs].append(time.perf_counter() - begin)
    seen = [r.images for r in results.values()]
    assert all(s is not None and s.fixes is not None for s in seen)
    fixes = [s.fixes.rows.tobytes() for s in seen if s is not None and s.fixes is not None]
    same = fixes[0] == fixes[1] and same_bits(results[1].run, results[2].run)
    count = 0 if seen[0] is None or seen[0].fixes is None else len(seen[0].fixes)
    ratios = sorted(a / b for a, b in zip(walls[1], walls[2], strict=True))
    estimates_s = results[1].wall_s
    share = 1.0 - estimates_s / statistics.median(walls[1])
    row: Row = {
        "pictures": pictures, "fixes": count, "wall_s": {str(j): v for j, v in walls.items()},
        "ratio": [ratios[0], statistics.median(ratios), ratios[-1]], "repetitions": repetitions,
        "share_of_pictures": share, "same": same, "cores": os.cpu_count(), "load": os.getloadavg()[0],
    }  # fmt: skip
    rate = pictures / statistics.median(walls[1])
    print(
        f"{pictures} pictures, {count} fixes: {rate:.0f} a second in one process ({share:.0%} of the replay); one over "
        f"two processes {row['ratio'][1]:.2f}x ({ratios[0]:.2f}..{ratios[-1]:.2f}, n {repetitions}; load "
        f"{row['load']:.1f}); {'the same bits' if same else 'DIFFERENT results'}"
    )
    targets.add(Target("images: results of one and two processes differ", float(not same), 0))
    targets.add(Target("images: fixes over pictures", count / pictures, 0.5, at_least=True))
    return row


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables; return 0 when the targets are met (or not asked for), else 1."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", choices=["engines", "images"], default=["engines", "images"])
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--pictures", type=int, default=400)
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--no-gate", action="store_true", help="exit with 0 also where a target is missed")
    options = parser.parse_args(arguments)
    begin = time.perf_counter()
    targets = Targets()
    out: Row = {"benchmark": "long_flight", **provenance()}
    if "engines" in options.only:
        out["engines"] = engines(options.seconds, options.repetitions, targets)
    if "images" in options.only:
        out["images"] = images(options.pictures, options.repetitions, targets)
    good = targets.report()
    out["targets"] = targets.as_rows()
    print(f"{time.perf_counter() - begin:.0f} s")
    if options.json:
        options.json.write_text(json.dumps(out, indent=1) + "\n")
    return 0 if good or options.no_gate else 1


if __name__ == "__main__":
    raise SystemExit(main())
