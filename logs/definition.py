"""ROS 2 message definitions (schema encoding ``ros2msg``): parsed into the fields that CDR lays out.

A concatenated definition is the text of one message, then each dependency behind a line of ``=`` and a line
``MSG: package/Type``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

PRIMITIVES: Mapping[str, str] = {
    "bool": "u1",
    "byte": "u1",
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}
"""ROS 2 primitive types and their NumPy type codes (without byte order)."""

TIME = "builtin_interfaces/Time"
_SEPARATOR = re.compile(r"^=+\s*$", re.MULTILINE)
_FIELD = re.compile(
    r"^(?P<type>[A-Za-z][\w/]*)(?:<=(?P<text_bound>\d+))?"
    r"(?P<array>\[(?:(?P<bounded><=)?(?P<size>\d+))?\])?\s+(?P<name>[A-Za-z]\w*)\b\s*(?P<rest>.*)$"
)
_TIME_FIELDS = "int32 sec\nuint32 nanosec"


class DefinitionError(ValueError):
    """A message definition is not a ROS 2 message definition, or lacks one of its dependencies."""


@dataclass(frozen=True, slots=True)
class Field:
    """One field: ``type`` is a primitive, ``string``, ``wstring`` or the name ``package/Type`` of a message.

    ``length`` is None for a single value, -1 for a sequence, else the size of the fixed array.
    """

    name: str
    type: str
    length: int | None = None


@dataclass(frozen=True, slots=True)
class Definition:
    """A message and everything it is built of: ``fields[name]`` for ``name`` and each of its dependencies."""

    name: str
    fields: Mapping[str, tuple[Field, ...]]


def short_name(name: str) -> str:
    """Return ``package/Type`` for ``package/msg/Type``; other names are returned as they are."""
    parts = name.split("/")
    return f"{parts[0]}/{parts[2]}" if len(parts) == 3 and parts[1] == "msg" else name


@lru_cache(maxsize=256)
def parse(name: str, text: str) -> Definition:
    """Parse a concatenated definition of the message ``name``.

    Raises:
        DefinitionError: a line is no field, or a type is neither primitive nor defined in the text.
    """
    root = short_name(name)
    parts = _SEPARATOR.split(text)
    fields = {
        "builtin_interfaces/Time": _fields("builtin_interfaces", _TIME_FIELDS),
        "builtin_interfaces/Duration": _fields("builtin_interfaces", _TIME_FIELDS),
        root: _fields(root.split("/")[0], parts[0]),
    }
    for part in parts[1:]:
        head, _, body = part.strip().partition("\n")
        if not head.startswith("MSG:"):
            raise DefinitionError(f"{root}: a dependency does not start with 'MSG: package/Type'")
        dependency = short_name(head[4:].strip())
        fields[dependency] = _fields(dependency.split("/")[0], body)
    _check_complete(root, fields)
    return Definition(root, fields)


def _fields(package: str, text: str) -> tuple[Field, ...]:
    found = []
    for line in text.splitlines():
        content = line.split("#", 1)[0].strip()
        if not content:
            continue
        match = _FIELD.match(content)
        if match is None:
            raise DefinitionError(f"not a field of a ROS 2 message: {content[:60]!r}")
        if match["rest"].startswith("="):
            continue  # a constant takes no room in the message
        length = None
        if match["array"]:
            length = -1 if match["bounded"] or not match["size"] else int(match["size"])
        found.append(Field(match["name"], _qualified(match["type"], package), length))
    # rosidl gives an empty message one byte.
    return tuple(found) or (Field("structure_needs_at_least_one_member", "uint8"),)


def _qualified(type_name: str, package: str) -> str:
    if type_name in PRIMITIVES or type_name in ("string", "wstring"):
        return type_name
    if type_name in ("time", "duration"):
        return f"builtin_interfaces/{type_name.capitalize()}"
    if "/" in type_name:
        return short_name(type_name)
    return "std_msgs/Header" if type_name == "Header" else f"{package}/{type_name}"


def _check_complete(root: str, fields: Mapping[str, tuple[Field, ...]]) -> None:
    """Refuse a definition that lacks a dependency or contains itself."""
    done: set[str] = set()

    def visit(name: str, above: tuple[str, ...]) -> None:
        if name in above:
            raise DefinitionError(f"{root}: {name} contains itself")
        if name in done:
            return
        if name not in fields:
            raise DefinitionError(f"{root}: the definition of {name} is missing")
        for field in fields[name]:
            if "/" in field.type:
                visit(field.type, (*above, name))
        done.add(name)

    visit(root, ())
