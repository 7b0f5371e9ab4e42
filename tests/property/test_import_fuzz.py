"""Any bytes given to an importer become a recording in order or a LogError of one line, in bounded memory."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from pathlib import Path

import log_bytes as lb
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from logs.chain import chain, gaps
from logs.errors import LogError
from logs.importer import import_files
from logs.writer import FlightWriter

EXTRA_MEMORY = 1 << 30
BINARY = lb.flight(seconds=0.6)
TELEMETRY = lb.telemetry(lb.telemetry_flight(seconds=0.6))
STARTS = [b"", b"\xa3\x95\x80", b"ULog\x01\x12\x35", b"FMT, 1"]
TEXT = lb.text_log(seconds=0.4).encode()

fuzzed = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(autouse=True)
def memory_limit() -> Iterator[None]:
    """Give the process one more GiB of address space and no more."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + EXTRA_MEMORY, hard))
    yield
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@st.composite
def damaged(draw: st.DrawFn, sound: bytes) -> bytes:
    """Draw a sound log with flipped bits, lost, repeated, overwritten or reversed parts, and a cut end."""
    data = bytearray(sound)
    for _ in range(draw(st.integers(1, 6))):
        at = draw(st.integers(0, max(len(data) - 1, 0)))
        size = draw(st.integers(1, 300))
        match draw(st.sampled_from(["flip", "remove", "repeat", "overwrite", "cut", "swap"])):
            case "flip":
                data[at : at + 1] = bytes([data[at] ^ (1 << draw(st.integers(0, 7)))]) if data else b""
            case "remove":
                del data[at : at + size]
            case "repeat":
                data[at:at] = data[at : at + size]
            case "overwrite":
                data[at : at + size] = draw(st.binary(min_size=1, max_size=40))
            case "cut":
                del data[max(at, len(data) // 2) :]
            case "swap":
                data[at : at + size] = data[at : at + size][::-1]
    return bytes(data)


def check(path: Path, data: bytes) -> None:
    """Import bytes: either a refusal of one line, or a recording that can be written."""
    path.write_bytes(data)
    try:
        recording = import_files([path])
    except LogError as error:
        assert "\n" not in str(error)
        assert str(error).startswith(str(path))
        assert len(str(error)) < 600
        return
    assert recording.series
    for series in recording.series:
        assert len(series) == len(series.stamp_ns) == len(series.arrival_ns) == len(series.data) > 0
        if series.topic not in ("/log", "/vision/fix", "/timesync", "/truth/odometry"):
            assert np.all(np.diff(series.stamp_ns) >= 0)
    assert all("\n" not in p for p in recording.problems)
    target = path.with_suffix(".mcap")
    with FlightWriter(target, force=True) as writer:
        writer.write_recording(recording)
    assert target.stat().st_size > 100


@fuzzed
@given(data=damaged(BINARY))
def test_damaged_dataflash_logs(tmp_path: Path, data: bytes) -> None:
    check(tmp_path / "x.BIN", data)


@fuzzed
@given(data=damaged(TELEMETRY))
def test_damaged_telemetry_logs(tmp_path: Path, data: bytes) -> None:
    check(tmp_path / "x.tlog", data)


@fuzzed
@given(data=damaged(TEXT))
def test_damaged_text_logs(tmp_path: Path, data: bytes) -> None:
    check(tmp_path / "x.log", data)


@fuzzed
@given(data=st.binary(max_size=2000), start=st.sampled_from(STARTS))
def test_any_bytes(tmp_path: Path, data: bytes, start: bytes) -> None:
    check(tmp_path / "x", start + data)


@fuzzed
@given(numbers=st.lists(st.integers(0, 2**64 - 1), min_size=1, max_size=30), values=st.floats(width=32))
def test_any_stamps_and_values(tmp_path: Path, numbers: list[int], values: float) -> None:
    parts = [lb.definition(k) for k in (lb.FMT, lb.IMU, lb.GPS)]
    for t in numbers:
        parts += [lb.imu(t, 0, values), lb.gps(t, status=t % 256, week=t % 65536, ms=t % 2**32)]
    check(tmp_path / "x.BIN", b"".join(parts))


@fuzzed
@given(
    arrivals=st.lists(st.integers(0, 2**64 - 1), min_size=1, max_size=30),
    boots=st.lists(st.integers(0, 2**64 - 1), min_size=30, max_size=30),
    ts1=st.integers(-(2**63), 2**63 - 1),
)
def test_any_times_in_telemetry(tmp_path: Path, arrivals: list[int], boots: list[int], ts1: int) -> None:
    items = [(0, "HEARTBEAT", lb.heartbeat(), (1, 1))]
    for arrival, boot in zip(arrivals, boots, strict=False):
        items.append((arrival, "HIGHRES_IMU", lb.highres_imu(boot), (1, 1)))
        items.append((arrival, "TIMESYNC", {"tc1": 0, "ts1": ts1}, (1, 191)))
        items.append((arrival, "TIMESYNC", {"tc1": boot % 2**63, "ts1": ts1}, (1, 1)))
        items.append((arrival, "LANDING_TARGET", lb.landing_target(boot), (1, 191)))
    check(tmp_path / "x.tlog", lb.telemetry(items))


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_px4_logs(tmp_path: Path, data_dir: Path, data: st.DataObject) -> None:
    pytest.importorskip("pyulog")
    sound = (data_dir / "ulog" / "sample_log_small.ulg").read_bytes()[:150_000]
    check(tmp_path / "x.ulg", data.draw(damaged(sound)))


@settings(max_examples=200, deadline=None)
@given(
    steps=st.lists(st.integers(1, 9), max_size=60),
    lengths=st.lists(st.integers(3, 20), min_size=60, max_size=60),
    tail=st.integers(0, 25),
)
def test_the_chain_never_overlaps_and_accounts_for_every_byte(
    steps: list[int], lengths: list[int], tail: int
) -> None:
    at = np.cumsum([0, *steps])[:-1].astype(np.int64) if steps else np.empty(0, dtype=np.int64)
    ends = at + np.array(lengths[: len(at)], dtype=np.int64)
    size = int(at[-1]) + 3 + tail if len(at) else tail
    keep = chain(at, ends, size)
    assert np.all(at[keep][1:] >= ends[keep][:-1])
    assert np.all(ends[keep] <= size)
    starts, stops = gaps(at[keep], ends[keep], size)
    assert int((stops - starts).sum() + (ends[keep] - at[keep]).sum()) == size


@settings(max_examples=100, deadline=None)
@given(noise=st.binary(max_size=200), position=st.integers(0, 30))
def test_noise_between_messages_costs_at_most_what_it_touches(noise: bytes, position: int) -> None:
    from logs.dataflash import decode_dataflash

    messages = [lb.imu(1000 * k) for k in range(1, 31)]
    data = b"".join(
        [lb.definition(lb.FMT), lb.definition(lb.IMU), *messages[:position], noise, *messages[position:]]
    )
    found = decode_dataflash(lb.as_bytes(data)).tables["IMU"]["TimeUS"].tolist()
    lost = 30 - len([t for t in found if t in range(1000, 31000, 1000)])
    assert lost <= (0 if b"\xa3\x95" not in noise + messages[0][:1] else 2)
