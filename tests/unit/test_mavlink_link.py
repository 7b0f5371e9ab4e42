"""The link to the autopilot: whom it listens to, signing, clock exchanges, and streams asked for until they come."""

from __future__ import annotations

from collections import deque
from typing import Any

import log_bytes as lb
import pytest
from pymavlink.dialects.v20 import ardupilotmega as m

from deckfix.mavlink_link import LONGEST_TRIP_NS, LOST_NS, Link
from deckfix.stream_requests import PATIENCE, StreamRequests
from estimation.events import Event, TimeSync

MS = 1_000_000
BEGIN = 1_795_000_000_000_000_000


class Wire:
    """A wire in memory: ``put`` what arrives, ``out`` what was sent."""

    datagrams = True

    def __init__(self) -> None:
        self.waiting: deque[tuple[bytes, str]] = deque()
        self.out: list[Any] = []
        self.raw: list[bytes] = []
        self.peer = self.last = ""
        self.parser = m.MAVLink(None, 255, 1)

    def receive(self, timeout_s: float) -> bytes:
        if not self.waiting:
            return b""
        data, self.last = self.waiting.popleft()
        return data

    def send(self, data: bytes) -> bool:
        self.raw.append(data)
        self.out += self.parser.parse_buffer(data) or []
        return True

    def accept(self) -> None:
        self.peer = self.last

    def foreign(self) -> bool:
        return bool(self.peer) and self.last != self.peer

    def close(self) -> None:
        return


class Bench:
    """A link with a clock that is set by hand."""

    def __init__(self, **options: Any) -> None:
        self.now = BEGIN
        self.wire, self.events = Wire(), list[Event]()
        self.link = Link(self.wire, lambda: self.now, self.events.extend, **options)
        self.writer = m.MAVLink(None, 1, 1)

    def put(self, message: Any, *, source: str = "a", system: int = 1, component: int = 1) -> None:
        self.writer.srcSystem, self.writer.srcComponent = system, component
        self.raw(bytes(message.pack(self.writer)), source)

    def raw(self, data: bytes, source: str = "a") -> None:
        self.wire.waiting.append((data, source))
        self.link.read(0.0)

    def beat(self, **where: Any) -> None:
        self.put(m.MAVLink_heartbeat_message(2, 3, 129, 4, 4, 3), **where)


def highres(boot_ms: int) -> Any:
    return m.MAVLink_highres_imu_message(**lb.highres_imu(boot_ms * 1000))


def test_the_first_autopilot_is_listened_to_and_no_other_system() -> None:
    bench = Bench()
    bench.put(m.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3), system=255)  # a ground station
    assert not bench.link.vehicle.system
    bench.beat(system=7)
    bench.beat(system=8)
    assert bench.link.vehicle.system == 7
    assert bench.link.counts["foreign system"] == 1
    assert bench.link.vehicle.mode_name == "GUIDED"
    assert bench.link.vehicle.armed


def test_only_the_system_asked_for_is_listened_to() -> None:
    bench = Bench(system=8)
    bench.beat(system=7)
    assert not bench.link.vehicle.system
    bench.beat(system=8)
    assert bench.link.vehicle.system == 8


def test_another_address_is_refused_while_the_first_one_speaks() -> None:
    bench = Bench()
    bench.beat()
    bench.beat(source="b")
    assert bench.link.counts["foreign address"] == 1
    bench.now += LOST_NS + MS
    bench.beat(source="b")
    assert bench.wire.peer == "b"
    assert bench.link.alive


def test_with_a_key_only_right_signatures_count() -> None:
    key = b"0123456789abcdef0123456789abcdef"
    bench = Bench(key=key)
    bench.beat()
    assert not bench.link.vehicle.system
    bench.writer.signing.secret_key = b"x" * 32
    bench.writer.signing.sign_outgoing = True
    bench.writer.signing.timestamp = (BEGIN // 1000 - 1_420_070_400_000_000) // 10
    bench.beat()
    assert not bench.link.vehicle.system
    bench.writer.signing.secret_key = key
    bench.beat()
    assert bench.link.vehicle.system == 1
    assert (bench.link.counts["unsigned"], bench.link.counts["wrong signature"]) == (1, 1)
    replayed = bytes(m.MAVLink_heartbeat_message(2, 3, 0, 9, 4, 3).pack(bench.writer))
    bench.raw(replayed)
    heard = bench.link.heard["HEARTBEAT"]
    bench.raw(replayed)
    assert bench.link.heard["HEARTBEAT"] == heard
    bench.link.heartbeat(4, 0)
    assert bench.wire.raw[-1][2] & 1  # ours is signed


def test_answers_to_questions_of_others_are_ignored() -> None:
    bench = Bench()
    bench.beat()
    bench.link.ask_time()
    asked = next(x for x in bench.wire.out if x.get_type() == "TIMESYNC")
    assert asked.tc1 == 0
    bench.now += 2 * MS
    bench.put(m.MAVLink_timesync_message(5_000 * MS, asked.ts1 + 1))
    assert bench.events == []
    bench.put(m.MAVLink_timesync_message(5_000 * MS, asked.ts1))
    bench.put(m.MAVLink_timesync_message(5_000 * MS, asked.ts1))
    (sync,) = bench.events
    assert isinstance(sync, TimeSync)
    assert (sync.sent_ns, sync.remote_ns, sync.received_ns) == (BEGIN, 5_000 * MS, BEGIN + 2 * MS)
    assert bench.link.counts["timesync of others"] == 2


def test_an_answer_that_took_too_long_is_none() -> None:
    bench = Bench()
    bench.beat()
    bench.link.ask_time()
    bench.now += LONGEST_TRIP_NS
    bench.put(m.MAVLink_timesync_message(5_000 * MS, BEGIN))
    assert bench.events == []


def test_the_autopilots_question_is_answered_with_our_time() -> None:
    bench = Bench()
    bench.beat()
    bench.put(m.MAVLink_timesync_message(0, 4242))
    answer = bench.wire.out[-1]
    assert (answer.tc1, answer.ts1) == (BEGIN, 4242)


def test_what_the_autopilot_says_of_itself_is_kept() -> None:
    bench = Bench()
    bench.beat()
    bench.put(m.MAVLink_param_value_message(b"INS_GYRO_FILTER", 20.0, 9, 5, 0))
    bench.put(m.MAVLink_extended_sys_state_message(0, 1))
    bench.put(m.MAVLink_statustext_message(4, b"Plnd: Frame not supported"))
    vehicle = bench.link.vehicle
    assert vehicle.parameters == {"INS_GYRO_FILTER": 20.0}
    assert vehicle.on_ground
    assert not vehicle.in_air
    assert bench.link.texts[-1][2] == "Plnd: Frame not supported"


def test_streams_are_asked_for_again_when_they_stop_and_another_imu_when_it_never_comes() -> None:
    bench = Bench()
    bench.beat()
    requests = StreamRequests(imu_rate_hz=10.0)

    def asked() -> set[int]:
        bench.wire.out.clear()
        bench.now += 2_000 * MS
        requests.check(bench.link, bench.now)
        return {int(c.param1) for c in bench.wire.out if c.get_type() == "COMMAND_LONG"}

    assert {105, 24, 30} <= asked()
    for k in range(20):
        bench.put(highres(1000 + 100 * k))
    assert 105 not in asked()
    assert 105 in asked()
    for _ in range(PATIENCE):
        asked()
    assert 27 in asked()


@pytest.mark.parametrize("text", ["deckfix: no estimate", "x" * 80])
def test_texts_fit_into_a_message(text: str) -> None:
    bench = Bench()
    bench.link.say(4, text)
    assert bench.wire.out[-1].text == text[:50]
