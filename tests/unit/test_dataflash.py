"""Decoding dataflash logs: every message found, every value right, damage passed over and said."""

from __future__ import annotations

import math
from pathlib import Path

import log_bytes as lb
import numpy as np
import pytest

from logs.chain import chain, gaps
from logs.dataflash import decode_dataflash, is_dataflash, read_dataflash
from logs.dataflash_text import is_dataflash_text, read_dataflash_text
from logs.errors import LogError


def decode(data: bytes):
    return decode_dataflash(lb.as_bytes(data))


def test_a_sound_log_is_decoded_whole() -> None:
    log = decode(lb.flight(seconds=2.0))
    assert {n: len(t) for n, t in log.tables.items()} == {
        "FMT": 6, "PARM": 2, "MSG": 1, "IMU": 200, "GPS": 10, "BARO": 20,
    }  # fmt: skip
    assert log.problems == []
    assert log.tables["IMU"]["TimeUS"].tolist() == [1_000_000 + 10_000 * k for k in range(200)]
    assert log.tables["IMU"]["AccZ"].tolist() == [np.float32(-9.8)] * 200


def test_scaled_characters_are_divided_as_the_format_says() -> None:
    kind = ("SCL", 7, "cCeELafgqQMbn", "c,C,e,E,L,a,f,g,q,Q,M,b,n")
    numbers = np.arange(32, dtype="<i2").tobytes()
    stored = (-1234, 40000, -123456, 123456, 539999999, numbers, 1.5, 0.5, -5, 5, 9, -3, b"ab")
    row = decode(lb.definition(lb.FMT) + lb.definition(kind) + lb.message(kind, *stored)).tables["SCL"][0]
    assert row["c"] == -12.34
    assert row["C"] == 400.0
    assert row["e"] == -1234.56
    assert row["E"] == 1234.56
    assert row["L"] == 539999999 / 1e7
    assert row["a"].tolist() == list(range(32))
    assert (row["f"], row["g"], row["q"], row["Q"], row["M"], row["b"]) == (1.5, 0.5, -5, 5, 9, -3)
    assert row["n"] == b"ab"


def test_a_header_inside_a_payload_is_no_message() -> None:
    trap = lb.message(lb.MSG, 1, b"\xa3\x95" + bytes([lb.IMU[1]]) + b"not an IMU message")
    log = decode(lb.flight() + trap + lb.imu(4_000_000))
    assert len(log.tables["IMU"]) == 201
    assert len(log.tables["MSG"]) == 2
    assert log.problems == []


def test_garbage_is_passed_over_and_counted() -> None:
    garbage = bytes(range(60)) + b"\xa3\x95\xa3\x95\xa3" + b"\xff" * 11
    log = decode(lb.flight() + garbage + lb.imu(4_000_000) + lb.imu(4_010_000))
    assert len(log.tables["IMU"]) == 202
    assert log.problems == [
        f"{len(garbage)} bytes in 1 places are not readable messages and were passed over"
    ]


def test_a_message_that_lost_bytes_is_dropped_and_the_next_one_kept() -> None:
    log = decode(lb.flight() + lb.imu(4_000_000)[:20] + lb.imu(4_010_000) + lb.imu(4_020_000))
    assert log.tables["IMU"]["TimeUS"][-2:].tolist() == [4_010_000, 4_020_000]
    assert len(log.tables["IMU"]) == 202


@pytest.mark.parametrize("cut", [1, 2, 3, 20])
def test_a_log_that_was_cut_off_says_so(cut: int) -> None:
    log = decode(lb.flight() + lb.imu(4_000_000)[:cut])
    assert len(log.tables["IMU"]) == 200
    assert log.problems == [f"the log ends within a message, whose {cut} bytes are lost"]


def test_unknown_types_are_named() -> None:
    log = decode(lb.flight() + b"\xa3\x95\xee" + bytes(10) + lb.imu(4_000_000))
    assert len(log.tables["IMU"]) == 201
    assert any("238" in p and "FMT" in p for p in log.problems)


def test_a_redefined_type_is_read_with_the_layout_that_held() -> None:
    again = ("IMU", 163, "QBf", "TimeUS,I,GyrX")
    log = decode(
        lb.flight() + lb.definition(again) + lb.message(again, 4_000_000, 0, 0.25) + lb.gps(4_000_000)
    )
    assert len(log.tables["IMU"]) == 200
    assert log.tables["IMU#2"]["GyrX"].tolist() == [0.25]
    assert len(log.tables["GPS"]) == 11
    assert any("IMU is defined in 2 ways" in p for p in log.problems)


def test_a_damaged_definition_costs_its_own_messages_only() -> None:
    broken = bytearray(lb.definition(lb.GPS))
    broken[4] ^= 0x40  # its length no longer fits its format
    parts = [lb.definition(k) for k in (lb.FMT, lb.IMU)] + [bytes(broken)]
    body = [lb.imu(k) + lb.gps(k) + lb.imu(k + 1) for k in range(10)]
    log = decode(b"".join(parts + body))
    assert len(log.tables["IMU"]) == 20
    assert "GPS" not in log.tables
    assert any("definitions (FMT) are damaged" in p for p in log.problems)


@pytest.mark.parametrize("data", [b"\x00" * 100, b"hello world", b"\xa3\x95" * 50, lb.imu(5) * 20])
def test_without_definitions_nothing_can_be_decoded(data: bytes) -> None:
    with pytest.raises(LogError, match="no format definition"):
        decode(data)


def test_an_empty_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "empty.BIN"
    path.touch()
    with pytest.raises(LogError, match="empty"):
        read_dataflash(path)


def test_text_logs_give_the_same_columns(tmp_path: Path) -> None:
    path = tmp_path / "flight.log"
    path.write_text(lb.text_log() + "IMU, 1, 2\nIMU, x, 0, 0, 0, 0, 0, 0, 0\nXYZ, 3\n")
    log = read_dataflash_text(path)
    assert is_dataflash_text(path.read_bytes()[:1000])
    assert not is_dataflash(path.read_bytes()[:1000])
    assert len(log.tables["IMU"]) == 100
    assert log.tables["IMU"].dtype == decode(lb.flight()).tables["IMU"].dtype
    assert log.tables["GPS"]["Lat"].tolist() == [54.0] * 5
    assert log.tables["GPS"]["HDop"][0] == 0.9
    assert log.tables["MSG"]["Message"].tolist() == [b"ArduCopter V4.6.0, with a comma"]
    assert log.problems == ["3 lines of the text log could not be read and were left out"]


def test_units_come_from_the_log() -> None:
    unit = ("UNIT", 117, "QbZ", "TimeUS,Id,Label")
    link = ("FMTU", 121, "QBNN", "TimeUS,FmtType,UnitIds,MultIds")
    parts = [lb.definition(k) for k in (lb.FMT, lb.BARO, unit, link)]
    parts += [lb.message(unit, 1, ord("m"), "m"), lb.message(unit, 1, ord("P"), "Pa")]
    parts += [lb.message(link, 1, lb.BARO[1], "--mmP-", "------")]
    parts += [lb.message(lb.BARO, 5, 0, 1.0, 2.0, 3.0, 4)]
    log = decode(b"".join(parts))
    assert log.units["BARO"]["Alt"] == "m"
    assert log.units["BARO"]["Press"] == "Pa"


def test_the_chain_of_a_file_of_false_starts_is_empty_or_short() -> None:
    at = np.arange(0, 1000, 2, dtype=np.int64)
    keep = chain(at, at + 7, 1001)
    starts, stops = gaps(at[keep], at[keep] + 7, 1001)
    assert keep.sum() * 7 + (stops - starts).sum() == 1001
    assert np.all(np.diff(at[keep]) >= 7)


@pytest.mark.parametrize("flight", ["calm", "heave06", "sea3a"])
def test_real_logs_equal_pymavlink_message_by_message(data_dir: Path, flight: str) -> None:
    from pymavlink.DFReader import DFReader_binary

    path = data_dir / "ardupilot_sitl" / f"{flight}.BIN"
    log = read_dataflash(path)
    reader = DFReader_binary(str(path))
    wanted = [
        "IMU",
        "GPS",
        "GPA",
        "BARO",
        "MAG",
        "XKF1",
        "SIM",
        "SIM2",
        "PARM",
        "MSG",
        "ORGN",
        "RFND",
        "UNIT",
    ]
    seen = dict.fromkeys(wanted, 0)
    while (m := reader.recv_match(type=wanted)) is not None:
        name = m.get_type()
        row = log.tables[name][seen[name]]
        seen[name] += 1
        if seen[name] > 200:
            continue
        for column in m.get_fieldnames():
            theirs, ours = getattr(m, column), row[column]
            if isinstance(theirs, str):
                assert ours == theirs.encode()
            else:
                assert ours == theirs or (math.isnan(theirs) and math.isnan(ours))
    assert seen == {name: len(log.tables[name]) for name in wanted}
    cut_off = sum(reader.counts) - log.count()  # pymavlink's index counts a last message that is not whole
    assert cut_off == any("ends within a message" in p and "1 bytes" not in p for p in log.problems)
