"""Where a MAVLink link's bytes go and come from: UDP, TCP or a serial line, none of which ever blocks.

udpin:HOST:PORT     listens; answers go to whoever sent last
udpout:HOST:PORT    sends there; answers come back
tcp:HOST:PORT       connects
serial:DEVICE:BAUD  or DEVICE:BAUD, with DEVICE under /dev
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
from dataclasses import dataclass
from typing import Protocol

from deckfix.files import InputError

LARGEST_DATAGRAM = 65535
BAUDS = (9600, 19200, 38400, 57600, 115200, 230400, 460800, 500000, 921600, 1000000, 1500000, 2000000)


class Transport(Protocol):
    """What a link needs of its wire."""

    datagrams: bool
    """True where bytes come in packets, which no frame spans."""

    def receive(self, timeout_s: float) -> bytes:
        """Return what has come, waiting at most so long for it; nothing where nothing came."""

    def send(self, data: bytes) -> bool:
        """Send, or return False at once where the wire takes nothing now."""

    def accept(self) -> None:
        """Take whoever sent what was last received for the autopilot."""

    def foreign(self) -> bool:
        """Tell whether what was last received came from another address than the autopilot's."""

    def close(self) -> None:
        """Let go of the wire; closing twice does nothing."""


def open_transport(url: str) -> Transport:
    """Open the wire that a URL names; raises ``InputError`` with what is wrong and what to do."""
    kind, _, rest = url.partition(":")
    if kind in ("udpin", "udpout", "tcp"):
        host, port = _address(url, rest)
        try:
            if kind == "tcp":
                return _tcp(host, port)
            return _udp(host, port, listen=kind == "udpin")
        except OSError as error:
            raise InputError(f"{url}: {_reason(error)}; {_remedy(kind)}") from None
    device = rest if kind == "serial" else url
    name, _, baud = device.partition(":")
    if not name.startswith("/"):
        raise InputError(
            f"{url}: is no MAVLink address; give udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or "
            "serial:/dev/NAME:BAUD"
        )
    if not baud.isdigit() or int(baud) not in BAUDS:
        raise InputError(
            f"{url}: baud rate {baud!r} is not supported; use one of {', '.join(map(str, BAUDS))}"
        )
    return _serial(url, name, int(baud))


def _address(url: str, rest: str) -> tuple[str, int]:
    host, colon, port = rest.rpartition(":")
    if not colon or not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise InputError(f"{url}: host or port is missing; write it like udpin:127.0.0.1:14550")
    return host.strip("[]"), int(port)


def _reason(error: OSError) -> str:
    return (error.strerror or str(error)).lower()


def _remedy(kind: str) -> str:
    if kind == "udpin":
        return "is another program listening there? choose another port, or end it"
    if kind == "tcp":
        return "is the autopilot (or its router) running and the address right?"
    return "check the address"


@dataclass(slots=True)
class _Datagrams:
    """UDP. ``peer`` is where to send; ``last`` where the last datagram came from."""

    wire: socket.socket
    peer: tuple[str, int] | None
    last: tuple[str, int] | None = None
    datagrams: bool = True

    def receive(self, timeout_s: float) -> bytes:
        if not select.select([self.wire], [], [], timeout_s)[0]:
            return b""
        try:
            data, self.last = self.wire.recvfrom(LARGEST_DATAGRAM)
        except OSError:
            return b""  # the other side is not there (yet): it said so by ICMP
        return data

    def send(self, data: bytes) -> bool:
        if self.peer is None:
            return False
        try:
            self.wire.sendto(data, self.peer)
        except OSError:
            return False
        return True

    def accept(self) -> None:
        self.peer = self.last

    def foreign(self) -> bool:
        return self.peer is not None and self.last != self.peer

    def close(self) -> None:
        self.wire.close()


def _udp(host: str, port: int, *, listen: bool) -> _Datagrams:
    family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
    wire = socket.socket(family, socket.SOCK_DGRAM)
    wire.setblocking(False)
    with contextlib.suppress(OSError):
        wire.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    peer = (str(address[0]), int(address[1]))
    try:
        if listen:
            wire.bind(address)
    except OSError:
        wire.close()
        raise
    return _Datagrams(wire, None if listen else peer)


@dataclass(slots=True)
class _Stream:
    """A TCP connection or a serial line, by its file descriptor. ``rest`` is what the wire did not take whole."""

    number: int
    owner: socket.socket | None = None
    rest: bytes = b""
    datagrams: bool = False
    closed: bool = False

    def receive(self, timeout_s: float) -> bytes:
        if self.closed or not select.select([self.number], [], [], timeout_s)[0]:
            return b""
        try:
            data = os.read(self.number, 1 << 14)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise ConnectionError(_reason(error)) from None
        if not data:
            raise ConnectionError("the other side closed the connection")
        return data

    def send(self, data: bytes) -> bool:
        """Send whole frames only: what is left of one goes first, and while it waits no other is taken."""
        if self.closed:
            return False
        try:
            if self.rest:
                self.rest = self.rest[os.write(self.number, self.rest) :]
            if self.rest:
                return False
            self.rest = data[os.write(self.number, data) :]
        except OSError:
            return False
        return True

    def accept(self) -> None:
        return

    def foreign(self) -> bool:
        return False

    def close(self) -> None:
        if self.closed:
            return
        self.closed = True
        if self.owner is not None:
            self.owner.close()
        else:
            os.close(self.number)


def _tcp(host: str, port: int) -> _Stream:
    wire = socket.create_connection((host, port), timeout=5.0)
    wire.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    wire.setblocking(False)
    return _Stream(wire.fileno(), wire)


def _serial(url: str, device: str, baud: int) -> _Stream:
    import termios

    try:
        number = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError as error:
        raise InputError(
            f"{url}: {_reason(error)}; check the device, its cable and your permissions"
        ) from None
    try:
        settings = termios.tcgetattr(number)
        speed = getattr(termios, f"B{baud}")
        control = termios.CS8 | termios.CREAD | termios.CLOCAL
        minimum = settings[6]
        minimum[termios.VMIN], minimum[termios.VTIME] = 0, 0
        termios.tcsetattr(number, termios.TCSANOW, [0, 0, control, 0, speed, speed, minimum])
        termios.tcflush(number, termios.TCIOFLUSH)
    except (termios.error, AttributeError) as error:
        os.close(number)
        raise InputError(f"{url}: is no serial line ({error}); give the autopilot's port") from None
    return _Stream(number)
