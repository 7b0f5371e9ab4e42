"""One message of any layout to CDR (little-endian), from a mapping or an object with the message's fields.

For the few messages that have no fixed layout: images, texts, transforms. Numbers in bulk go through
``logs.cdr``.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from logs.cdr import LayoutError
from logs.definition import PRIMITIVES, Definition, Field


def encode(definition: Definition, message: object) -> bytes:
    """Return the CDR of a message; fields that it lacks are zero, empty or ''.

    Raises:
        LayoutError: a field of the mapping is not in the definition, or a value does not fit its type.
    """
    out = bytearray(4)
    out[1] = 1
    _add_message(out, definition, definition.name, message, "")
    return bytes(out)


def _add_message(out: bytearray, definition: Definition, name: str, message: object, path: str) -> None:
    fields = definition.fields[name]
    if isinstance(message, Mapping):
        unknown = set(message) - {f.name for f in fields}
        if unknown:
            raise LayoutError(f"{definition.name} has no field {path + sorted(unknown)[0]!r}")
    for item in fields:
        value = message.get(item.name) if isinstance(message, Mapping) else getattr(message, item.name, None)
        try:
            _add_field(out, definition, item, value, path + item.name)
        except (TypeError, struct.error, OverflowError) as error:
            raise LayoutError(f"{definition.name}: {path + item.name!r} cannot hold {value!r:.60}") from error


def _add_field(out: bytearray, definition: Definition, item: Field, value: Any, path: str) -> None:
    if item.length is None:
        _add_single(out, definition, item.type, value, path)
        return
    given: Sequence[Any] = () if value is None else value
    count = len(given)
    if item.length >= 0:
        if value is None and item.type in PRIMITIVES:
            given, count = np.zeros(item.length), item.length  # type: ignore[assignment]
        elif count != item.length:
            raise LayoutError(f"{definition.name}: {path!r} has {count} elements instead of {item.length}")
    else:
        _align(out, 4)
        out += struct.pack("<I", count)
    if item.type in PRIMITIVES:
        code = np.dtype("<" + PRIMITIVES[item.type])
        if count:
            _align(out, code.itemsize)
        raw = isinstance(given, bytes | bytearray | memoryview) and code.itemsize == 1
        if raw:
            out += bytes(given)
        elif isinstance(given, np.ndarray):
            out += given.astype(code).tobytes()
        else:  # of the field's own type at once: between small and large integers NumPy would go through floats
            out += np.array(given, dtype=code).tobytes()
        return
    for index, element in enumerate(given):
        _add_single(out, definition, item.type, element, f"{path}[{index}]")


def _add_single(out: bytearray, definition: Definition, type_name: str, value: Any, path: str) -> None:
    if type_name in PRIMITIVES:
        code = np.dtype("<" + PRIMITIVES[type_name])
        _align(out, code.itemsize)
        number = 0 if value is None else value
        if code.kind == "f":
            out += struct.pack("<d" if code.itemsize == 8 else "<f", number)
        else:
            out += int(number).to_bytes(code.itemsize, "little", signed=code.kind == "i")
    elif type_name == "string":
        text = ("" if value is None else str(value)).encode()
        _align(out, 4)
        out += struct.pack("<I", len(text) + 1) + text + b"\0"
    elif type_name == "wstring":
        raise LayoutError(f"{definition.name}: {path!r} is a wide string, which is not supported")
    else:
        _add_message(out, definition, type_name, {} if value is None else value, path + ".")


def _align(out: bytearray, size: int) -> None:
    out += bytes(-(len(out) - 4) % size)
