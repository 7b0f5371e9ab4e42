"""Fixed layouts: the CDR encoding of a ROS 2 message as one packed NumPy structured type.

CDR has no tags: once the strings and the lengths of the sequences of a message are known, every number of it
stands at a known byte. ``Layout`` holds that knowledge, so that messages are packed and read as whole
columns:

    array = layout.pack(stamp_ns, columns)      # array.tobytes() is n messages of array.itemsize bytes
    stamp_ns, columns = layout.unpack(array)    # law: gives back what was packed, bit for bit

Columns are named by the path of the field, joined with underscores; three (four) float64 called x, y, z (, w)
that make up a whole nested message are one column of shape (3,) or (4,). The header is not a column: its
stamp is the message's stamp and its frame_id one of the strings.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from logs.definition import PRIMITIVES, TIME, Definition, Field

STAMP_SEC = "/sec"
STAMP_NANOSEC = "/nanosec"
FRAME_ID = "header_frame_id"
_MAX_LEAVES = 4096
_MAX_BYTES = 1 << 22
_NS = 1_000_000_000
_XYZ = (Field("x", "float64"), Field("y", "float64"), Field("z", "float64"))
_FOLDED = {_XYZ: 3, (*_XYZ, Field("w", "float64")): 4}


class LayoutError(ValueError):
    """A message has no fixed layout (wide strings, too many fields), or its bytes end early."""


class Source(Protocol):
    """What a message leaves open: the lengths of its sequences and its strings."""

    def length(self, path: str, offset: int, element: str) -> int:
        """Return the number of elements of the sequence at ``path`` (``offset``: of its length field)."""

    def string(self, path: str, offset: int) -> bytes:
        """Return the bytes of the string at ``path``, without the closing NUL."""


@dataclass(slots=True)
class Given:
    """Lengths and strings from dictionaries; a sequence without a length is empty, a missing string is ''."""

    strings: Mapping[str, str] = field(default_factory=dict)
    lengths: Mapping[str, int] = field(default_factory=dict)

    def length(self, path: str, offset: int, element: str) -> int:
        """Return the given length."""
        return self.lengths.get(path, 0)

    def string(self, path: str, offset: int) -> bytes:
        """Return the given string."""
        return self.strings.get(path, "").encode()


@dataclass(slots=True)
class Columns:
    """Lengths read off the columns and strings that a message is to be packed from."""

    dtype: np.dtype[np.void]
    strings: Mapping[str, str]

    def length(self, path: str, offset: int, element: str) -> int:
        """Return the length of a column, or count the columns and strings of a sequence of messages."""
        if element in PRIMITIVES:
            if self.dtype.names is None or path not in self.dtype.names:
                raise LayoutError(f"column {path!r} is missing")
            shape = self.dtype[path].shape
            return int(shape[0]) if shape else 0
        names = [*(self.dtype.names or ()), *self.strings]
        count = 0
        while any(n == f"{path}_{count}" or n.startswith(f"{path}_{count}_") for n in names):
            count += 1
        return count

    def string(self, path: str, offset: int) -> bytes:
        """Return the given string."""
        return self.strings.get(path, "").encode()


@dataclass(slots=True)
class Message:
    """Lengths and strings as one encoded message has them; ``offset`` counts from behind its header."""

    data: bytes | memoryview
    little: bool = True

    def length(self, path: str, offset: int, element: str) -> int:
        """Read the length; it is refused where the message is too short for it."""
        count = self._uint32(offset)
        size = np.dtype(PRIMITIVES[element]).itemsize if element in PRIMITIVES else 1
        if count * size > len(self.data) - 8 - offset:
            raise LayoutError(f"the sequence {path!r} is longer than its message")
        return count

    def string(self, path: str, offset: int) -> bytes:
        """Read the string, without its closing NUL."""
        size = self._uint32(offset)
        if size > len(self.data) - 8 - offset:
            raise LayoutError(f"the string {path!r} is longer than its message")
        return bytes(self.data[offset + 8 : offset + 8 + max(size - 1, 0)])

    def _uint32(self, offset: int) -> int:
        if offset + 8 > len(self.data):
            raise LayoutError("the message ends early")
        value: int = struct.unpack_from("<I" if self.little else ">I", self.data, offset + 4)[0]
        return value


@dataclass(frozen=True)
class Layout:
    """One message type with its strings and lengths fixed.

    ``dtype`` is the packed type of a whole message, encapsulation header included; ``template`` the bytes of
    a message whose numbers are all zero; ``fixed`` (itemsize,) bool marks those of them that are lengths or
    strings; ``strings`` by path, the header's under ``header_frame_id``.
    """

    dtype: np.dtype[np.void]
    template: bytes
    fixed: NDArray[np.bool_]
    strings: dict[str, str]
    columns: tuple[str, ...]
    stamped: bool

    @cached_property
    def row_dtype(self) -> np.dtype[np.void]:
        """Native, packed type of the columns alone."""
        kinds = [(name, _native(self.dtype[name])) for name in self.columns]
        return np.dtype(kinds)

    def pack(self, stamp_ns: NDArray[np.int64], columns: NDArray[np.void]) -> NDArray[np.void]:
        """Encode n messages: stamps (n,) [ns] and columns (n,) of ``row_dtype`` to (n,) of ``dtype``.

        Raises:
            LayoutError: a stamp does not fit into the 32-bit seconds of a ROS 2 time.
        """
        out = np.empty(len(columns), dtype=self.dtype)
        out.view(np.uint8).reshape(len(columns), -1)[:] = np.frombuffer(self.template, dtype=np.uint8)
        if self.stamped:
            check_stamps(stamp_ns)
            seconds, nanoseconds = np.divmod(np.asarray(stamp_ns, dtype=np.int64), _NS)
            out[STAMP_SEC] = seconds
            out[STAMP_NANOSEC] = nanoseconds
        for name in self.columns:
            out[name] = columns[name]
        return out

    def unpack(self, messages: NDArray[np.void]) -> tuple[NDArray[np.int64], NDArray[np.void]]:
        """Return stamps (n,) [ns], zero for a message without one, and columns (n,) of ``row_dtype``."""
        stamp = np.zeros(len(messages), dtype=np.int64)
        if self.stamped:
            stamp += messages[STAMP_SEC]
            stamp *= _NS
            stamp += messages[STAMP_NANOSEC]
        columns = np.empty(len(messages), dtype=self.row_dtype)
        for name in self.columns:
            columns[name] = messages[name]
        return stamp, columns

    def matches(self, messages: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Tell which of n messages, as bytes (n, >= itemsize), have this layout's lengths and strings."""
        expected = np.frombuffer(self.template, dtype=np.uint8)[self.fixed]
        same: NDArray[np.bool_] = (messages[:, : len(self.template)][:, self.fixed] == expected).all(axis=1)
        return same


def check_stamps(stamp_ns: NDArray[np.int64]) -> None:
    """Check that a ROS 2 time can hold the stamps (n,) [ns].

    Raises:
        LayoutError: one does not fit into its 32-bit seconds.
    """
    if len(stamp_ns) and not (stamp_ns.min() >= -(2**31) * _NS and stamp_ns.max() < 2**31 * _NS):
        raise LayoutError("a stamp is outside the years 1901 to 2038 that a ROS 2 time can hold")


def layout(definition: Definition, source: Source, little: bool = True) -> Layout:
    """Lay out a message.

    Raises:
        LayoutError: it has wide strings, more than 4096 fields or 4 MiB, or its source does not hold it.
    """
    return _Builder(definition, source, little).build()


def layout_of_message(definition: Definition, message: bytes | memoryview) -> Layout:
    """Lay out a message after an example: one encoded message, little- or big-endian CDR.

    Raises:
        LayoutError: the bytes are no plain CDR, or end before the message does.
    """
    if len(message) < 4 or message[0] != 0 or message[1] > 1:
        raise LayoutError("the message does not start with a plain CDR header")
    little = message[1] == 1
    built = layout(definition, Message(message, little), little)
    if built.dtype.itemsize > len(message):
        raise LayoutError("the message ends early")
    return built


def _native(dtype: np.dtype[Any]) -> Any:
    base, shape = dtype.subdtype if dtype.subdtype is not None else (dtype, ())
    return (base.newbyteorder("="), shape) if shape or dtype.subdtype is not None else base.newbyteorder("=")


class _Builder:
    """Walks a definition once, keeping the offset behind the encapsulation header."""

    def __init__(self, definition: Definition, source: Source, little: bool) -> None:
        self.definition, self.source = definition, source
        self.order = "<" if little else ">"
        self.offset = 0
        self.template = bytearray([0, int(little), 0, 0])
        self.fixed = [True, True, False, False]
        self.names: list[str] = []
        self.formats: list[Any] = []
        self.offsets: list[int] = []
        self.strings: dict[str, str] = {}
        self.stamped = False

    def build(self) -> Layout:
        for index, item in enumerate(self.definition.fields[self.definition.name]):
            self.add(item, item.name, outermost=index == 0)
        columns = tuple(n for n in self.names if n not in (STAMP_SEC, STAMP_NANOSEC))
        spec = {
            "names": self.names,
            "formats": self.formats,
            "offsets": self.offsets,
            "itemsize": len(self.template),
        }
        fixed = np.array(self.fixed, dtype=np.bool_)
        return Layout(
            np.dtype(spec),  # type: ignore[call-overload]
            bytes(self.template),
            fixed,
            self.strings,
            columns,
            self.stamped,
        )

    def add(self, item: Field, path: str, outermost: bool = False) -> None:
        if item.length is None:
            self.single(item.type, path, outermost)
            return
        count = item.length
        if count < 0:
            self.align(4)
            count = self.source.length(path, self.offset, item.type)
            self.constant(struct.pack(self.order + "I", count))
        if item.type in PRIMITIVES:
            self.number(path, PRIMITIVES[item.type], (count,))
            return
        if count > _MAX_LEAVES:
            raise LayoutError(f"{path!r} has {count} elements, too many for columns")
        for index in range(count):
            self.single(item.type, f"{path}_{index}", outermost=False)

    def single(self, type_name: str, path: str, outermost: bool) -> None:
        if type_name in PRIMITIVES:
            self.number(path, PRIMITIVES[type_name], None)
        elif type_name == "string":
            self.align(4)
            text = self.source.string(path, self.offset)
            self.strings[path] = text.decode("utf-8", errors="replace")
            self.constant(struct.pack(self.order + "I", len(text) + 1) + text + b"\0")
        elif type_name == "wstring":
            raise LayoutError(f"{path!r} is a wide string")
        else:
            self.nested(type_name, path, outermost)

    def nested(self, type_name: str, path: str, outermost: bool) -> None:
        fields = self.definition.fields[type_name]
        folded = _FOLDED.get(fields)
        if folded is not None:
            self.number(path, "f8", (folded,))
        elif type_name == TIME and (outermost or path == "header_stamp"):
            self.stamped = True
            self.number(STAMP_SEC, "i4", None)
            self.number(STAMP_NANOSEC, "u4", None)
        else:
            for item in fields:
                self.add(item, f"{path}_{item.name}")

    def number(self, name: str, code: str, shape: tuple[int, ...] | None) -> None:
        base = np.dtype(self.order + code)
        count = 1 if shape is None else shape[0]
        if count * base.itemsize > _MAX_BYTES - self.offset:
            raise LayoutError(f"{name!r} makes the message too large for columns")
        if count:
            self.align(base.itemsize)
        if len(self.names) >= _MAX_LEAVES or name in self.names:
            raise LayoutError(f"{name!r} is one field too many for columns")
        self.names.append(name)
        self.formats.append(base if shape is None else (base, shape))
        self.offsets.append(4 + self.offset)
        self.extend(bytes(base.itemsize * count), fixed=False)

    def constant(self, data: bytes) -> None:
        self.extend(data, fixed=True)

    def align(self, size: int) -> None:
        self.extend(bytes(-self.offset % size), fixed=False)

    def extend(self, data: bytes, fixed: bool) -> None:
        self.template += data
        self.fixed += [fixed] * len(data)
        self.offset += len(data)
