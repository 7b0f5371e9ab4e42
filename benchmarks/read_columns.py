"""Reading IMU and GPS from a log with video: columns against the stock reader's messages.

A synthetic flight (IMU 200 Hz, attitude 50 Hz, GPS 5 Hz, JPEG-like images of 40 kB at 30 Hz) is written
twice: by our writer (images in chunks of their own) and by the stock ``mcap`` writer (all topics in the
same zstd chunks). Of each file the IMU and GPS topics are read in four ways, interleaved, and timed in CPU
seconds:

- columns: ``logs.open_flight(path).load(topics)``, opening, check sums and decoding to NumPy included;
- iterate: ``mcap.reader.make_reader(...).iter_messages(topics)``, bytes only, default options;
- checked: the same with ``validate_crcs=True``, as our reader always does;
- decode: ``iter_decoded_messages(topics)`` with the decoder of ``mcap-ros2-support``.

Ratios are formed within each round; printed are their median, smallest and largest. The work of writing
each message to the log in bulk, and of one live event, is printed beside them.

    python benchmarks/read_columns.py [--duration 120] [--rounds 5] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from targets import Target, Targets, provenance

from estimation.events import Imu
from logs import FlightWriter, Series, open_flight
from logs.topics import new_rows

UTC = 1_700_000_000_000_000_000
TOPICS = ("/imu", "/gps/fix", "/gps/velocity")
RATES_HZ = {"/imu": 200, "/attitude": 50, "/gps/fix": 5, "/gps/velocity": 5}
IMAGE_HZ = 30
IMAGE_BYTES = 40_000


def sensors(duration_s: float, rng: np.random.Generator) -> list[Series]:
    """Return the sensors' series; values are noise with the few digits that real sensors have."""
    found = []
    for topic, rate in RATES_HZ.items():
        n = int(duration_s * rate)
        stamp = (np.arange(n) * (1e9 / rate)).astype(np.int64)
        data = new_rows(topic, n)
        for name in data.dtype.names or ():
            if data.dtype[name].base.kind == "f" and "covariance" not in name:
                data[name] = rng.normal(size=data[name].shape).round(4)
        found.append(Series(topic, stamp, stamp + UTC, data))
    return found


def write_ours(path: Path, series: list[Series], duration_s: float, rng: np.random.Generator) -> float:
    """Write the flight with our writer; return the CPU time of the sensors' part [s]."""
    with FlightWriter(path, clock_offsets_ns={"autopilot": UTC, "camera": UTC}) as writer:
        start = time.process_time()
        writer.write_series(*series)
        spent = time.process_time() - start
        for i in range(int(duration_s * IMAGE_HZ)):
            stamp = int(i * 1e9 / IMAGE_HZ)
            image = {"format": "jpeg", "data": rng.bytes(IMAGE_BYTES)}
            writer.write_message(
                "/camera/image/compressed", image, arrival_ns=UTC + stamp, stamp_ns=stamp, clock="camera"
            )
    return spent


def rewrite_mixed(source: Path, target: Path) -> None:
    """Copy a file with the stock writer, so that images and numbers share chunks."""
    with source.open("rb") as stream, target.open("wb") as out:
        writer = Writer(out, chunk_size=1 << 20)
        writer.start("ros2", "benchmark")
        ids: dict[int, int] = {}
        for schema, channel, message in make_reader(stream).iter_messages():
            if channel.id not in ids:
                assert schema is not None
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schema_id, channel.metadata
                )
            writer.add_message(
                ids[channel.id], message.log_time, message.data, message.publish_time, message.sequence
            )
        writer.finish()  # type: ignore[no-untyped-call]


def columns(path: Path) -> int:
    return sum(len(s) for parts in open_flight(path).load(TOPICS).values() for s in parts)


def iterate(path: Path) -> int:
    with path.open("rb") as stream:
        return sum(1 for _ in make_reader(stream).iter_messages(topics=list(TOPICS)))


def checked(path: Path) -> int:
    with path.open("rb") as stream:
        return sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages(topics=list(TOPICS)))


def decode(path: Path) -> int:
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return sum(1 for _ in reader.iter_decoded_messages(topics=list(TOPICS)))


WAYS: dict[str, Callable[[Path], int]] = {
    "columns": columns,
    "iterate": iterate,
    "checked": checked,
    "decode": decode,
}


def measure(path: Path, rounds: int, expected: int) -> dict[str, Any]:
    """Time each way of reading in each round and compare within the rounds."""
    seconds: dict[str, list[float]] = {name: [] for name in WAYS}
    for _ in range(rounds):
        for name, way in WAYS.items():
            start = time.process_time()
            count = way(path)
            seconds[name].append(time.process_time() - start)
            assert count == expected, f"{name} read {count} of {expected} messages"
    result: dict[str, Any] = {"megabytes": round(path.stat().st_size / 1e6, 1), "messages": expected}
    for name, times in seconds.items():
        result[f"{name}_s"] = spread(np.array(times))
        result[f"{name}_us_per_message"] = round(float(np.median(times)) / expected * 1e6, 3)
    for name in ("iterate", "checked", "decode"):
        result[f"{name}_over_columns"] = spread(np.array(seconds[name]) / np.array(seconds["columns"]))
    return result


def spread(values: np.ndarray[Any, np.dtype[np.float64]]) -> dict[str, float]:
    """Return median, smallest and largest."""
    return {
        "median": round(float(np.median(values)), 4),
        "min": round(float(values.min()), 4),
        "max": round(float(values.max()), 4),
    }


def live(folder: Path, count: int = 4000) -> float:
    """Return the CPU time of writing one IMU event of a live recording [us]."""
    events = [
        Imu(i * 5_000_000, UTC + i * 5_000_000, (0.1, 0.2, 0.3), (0.0, 0.1, -9.8)) for i in range(count)
    ]
    with FlightWriter(folder / "live.mcap") as writer:
        start = time.process_time()
        for event in events:
            writer.write_event(event)
        return (time.process_time() - start) / count * 1e6


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--duration", type=float, default=120.0, help="length of the flight [s]")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rng = np.random.default_rng(2)
    series = sensors(arguments.duration, rng)
    expected = sum(len(s) for s in series if s.topic in TOPICS)
    with tempfile.TemporaryDirectory() as folder:
        ours, mixed = Path(folder) / "ours.mcap", Path(folder) / "mixed.mcap"
        bulk = write_ours(ours, series, arguments.duration, rng)
        rewrite_mixed(ours, mixed)
        results: dict[str, Any] = {
            "benchmark": "read_columns",
            **provenance(),
            "duration_s": arguments.duration,
            "rounds": arguments.rounds,
            "mcap": version("mcap"),
            "mcap_ros2_support": version("mcap-ros2-support"),
            "bulk_write_us_per_message": round(bulk / sum(map(len, series)) * 1e6, 2),
            "live_event_us": round(live(Path(folder)), 1),
            "files": {
                name: measure(path, arguments.rounds, expected)
                for name, path in (("ours", ours), ("mixed", mixed))
            },
        }
    print(
        f"{expected} IMU and GPS messages, {arguments.duration:.0f} s, n = {arguments.rounds} rounds, CPU time"
    )
    print(
        f"{'file':8}{'MB':>8}{'columns us':>12}{'iterate us':>12}{'checked us':>12}{'decode us':>11}", end=""
    )
    print(f"{'iterate/columns':>25}{'checked/columns':>25}{'decode/columns':>25}")
    for name, found in results["files"].items():
        print(f"{name:8}{found['megabytes']:8.1f}", end="")
        for way, width in (("columns", 12), ("iterate", 12), ("checked", 12), ("decode", 11)):
            print(f"{found[f'{way}_us_per_message']:{width}.2f}", end="")
        for way in ("iterate", "checked", "decode"):
            r = found[f"{way}_over_columns"]
            text = f"{r['median']:.1f} ({r['min']:.1f} - {r['max']:.1f})"
            print(f"{text:>25}", end="")
        print()
    targets = Targets()
    for way, bound in (("iterate", 3.0), ("decode", 20.0)):
        r = results["files"]["ours"][f"{way}_over_columns"]
        spread = r["max"] - r["min"]
        targets.add(Target(f"columns: {way} over ours", r["median"], bound, at_least=True, spread=spread))
    print(f"bulk write {results['bulk_write_us_per_message']:.2f} us a message,", end=" ")
    print(f"live event {results['live_event_us']:.1f} us")
    good = targets.report()
    results["targets"] = targets.as_rows()
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
