"""``deckfix onboard`` at work: latency from frame to LANDING_TARGET, processor and memory, against the served vehicle.

The vehicle is simulated in a process of its own, in real time: it hovers over the deck, guided over its link, while
640x480 pictures come at 20 Hz and inertial samples at 100 Hz. ``onboard`` runs as a user runs it, with recording. What
is printed is what it measured itself:

- latency: from an image's arrival to the LANDING_TARGET that holds it (the last 1000);
- cpu: processor time of all its threads over the time of the flight, without the start;
- memory: resident, over the flight; its growth is that of a straight line from a third of the flight on.

The two processes share this machine with whatever else runs on it: the load average is printed beside the numbers.

    python benchmarks/onboard.py [--seconds 90] [--full] [--json FILE]

``--full`` soaks for thirty minutes.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from targets import Target, Targets, provenance

from logs import open_flight

LATENCY_MS, CPU_SHARE, GROWTH_MB = 40.0, 0.5, 10.0
"""Targets: 95th percentile of the latency, share of a core, and growth of the memory in 30 minutes."""
MISSION = """
description = "hover over the deck"
closed_loop = true
start_m = [-2.0, -1.0, -2.0]
rest_s = 3.0
take_off_s = 2.0
longest_s = {longest}
[sea]
beaufort = 2
[streams]
imu = {{ rate_hz = 100.0 }}
gps = {{ rate_hz = 5.0, first_s = 0.03 }}
vision = {{ rate_hz = 20.0, first_s = 0.005, clock = "companion" }}
[clocks.autopilot]
offset_s = 21.0
skew_ppm = 12.0
[filter.origin]
latitude_deg = 63.4394
longitude_deg = 10.3986
altitude_m = 0.0
[filter.platform]
use = true
anchor_radius_m = 2.0
[filter.landing]
search_altitude_m = 10.0
observe_s = 7200.0
observe_max_s = 7200.0
stale_s = 2.0
lost_s = 4.0
"""
"""Observation lasts for ever, so that the flight is as long as is asked; wide limits keep it so on a busy machine."""


def measure(seconds: float) -> dict[str, Any]:
    """Return what onboard measured of itself in a flight of so many seconds."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "hover.toml").write_text(MISSION.format(longest=seconds + 120.0))
        port, camera = free(socket.SOCK_DGRAM), free(socket.SOCK_STREAM)
        world = start(
            place, "simulate", "hover.toml", "--serve", "--flight-files", "files", "--mavlink-port", str(port),
            "--camera-port", str(camera), said=subprocess.DEVNULL,
        )  # fmt: skip
        until = time.monotonic() + 60.0
        while not (place / "files" / "flight.toml").exists() and time.monotonic() < until:
            time.sleep(0.1)
        time.sleep(3.0)
        companion = start(
            place, "onboard", "--mavlink", f"udpin:127.0.0.1:{port}", "--guide", "--record", "o.mcap",
            "--camera", f"http://127.0.0.1:{camera}/camera.mjpg", "--config", "files/flight.toml",
            "--seconds", str(seconds), "--wait", "60",
        )  # fmt: skip
        try:
            said, _ = companion.communicate(timeout=seconds + 300.0)
        finally:
            world.kill()
            companion.kill()
        return read(said, place / "o.mcap")


def start(place: Path, *arguments: str, said: int = subprocess.PIPE) -> subprocess.Popen[str]:
    """Start a command of deckfix; a pipe that nobody reads would fill and stop it, so that ``said`` may be DEVNULL."""
    command = [sys.executable, "-m", "deckfix.cli", *arguments]
    return subprocess.Popen(command, cwd=place, text=True, stdout=said, stderr=subprocess.STDOUT)


def free(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as wire:
        wire.bind(("127.0.0.1", 0))
        return int(wire.getsockname()[1])


def read(said: str, log: Path) -> dict[str, Any]:
    """Return the numbers in onboard's last words and in its log."""
    end = re.search(
        r"median ([\d.]+) ms, p95 ([\d.]+) ms, largest ([\d.]+) ms, n (\d+); cpu (\d+) % of a core, "
        r"resident (\d+) MB",
        said,
    )
    counts = re.search(r"(\d+) estimates, (\d+) images, (\d+) fixes, (\d+) fused, (\d+) LANDING_TARGET", said)
    if end is None or counts is None:
        raise SystemExit(f"onboard did not tell its numbers:\n{said}")
    flight = open_flight(log)
    memory = []
    for message in flight.messages(["/log"]):
        found = re.search(r"resident (\d+) MB", str(message.decoded.msg))
        if found:
            memory.append((message.log_time_ns * 1e-9, float(found[1])))
    return {
        "latency_ms": {
            "median": float(end[1]), "p95": float(end[2]), "largest": float(end[3]), "n": int(end[4]),
        },
        "cpu_share": 0.01 * float(end[5]),
        "memory_mb": {
            "end": float(end[6]),
            "growth_per_30_min": growth(np.array(memory)),
            "every_10_s": [m for _, m in memory],
        },
        "counts": dict(zip(("estimates", "images", "fixes", "fused", "landing_target"), map(int, counts.groups()),
                           strict=True)),
        "load_average": os.getloadavg()[1],
    }  # fmt: skip


def growth(memory: np.ndarray) -> float | None:
    """Return the slope of the memory (n, 2: s, MB) over its later two thirds, in MB per 30 minutes."""
    later = memory[len(memory) // 3 :] if len(memory) else memory
    if len(later) < 4:
        return None
    return float(np.polyfit(later[:, 0] - later[0, 0], later[:, 1], 1)[0] * 1800.0)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=90.0)
    parser.add_argument("--full", action="store_true", help="thirty minutes")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    seconds = 1800.0 if arguments.full else arguments.seconds
    found = measure(seconds)
    latency, memory = found["latency_ms"], found["memory_mb"]
    print(
        f"latency frame to LANDING_TARGET: median {latency['median']:.1f} ms, p95 {latency['p95']:.1f} ms "
        f"(target {LATENCY_MS:g}), largest {latency['largest']:.1f} ms, n {latency['n']}"
    )
    print(f"cpu: {100 * found['cpu_share']:.0f} % of a core (target {100 * CPU_SHARE:g})")
    slope = memory["growth_per_30_min"]
    told = "not known" if slope is None else f"{slope:+.0f} MB in 30 min (target below {GROWTH_MB:g})"
    print(f"memory: {memory['end']:.0f} MB, growth {told}, over {seconds:g} s")
    print(f"counts: {found['counts']}; load average {found['load_average']:.1f} on {os.cpu_count()} cores")
    targets = Targets()
    targets.add(Target("onboard: frame to LANDING_TARGET, p95 [ms]", latency["p95"], LATENCY_MS))
    targets.add(Target("onboard: share of a core", found["cpu_share"], CPU_SHARE))
    if arguments.full:
        targets.add(Target("onboard: growth in 30 min [MB]", slope, GROWTH_MB))
    good = targets.report()
    if arguments.json:
        stamp = {"benchmark": "onboard", **provenance(), "seconds": seconds, "targets": targets.as_rows()}
        arguments.json.write_text(json.dumps({**stamp, **found}, indent=1) + "\n", encoding="utf-8")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
