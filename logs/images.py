"""Images in a log: read as they were recorded, encoded, one after the other."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from logs.errors import LogError
from logs.reader import Flight

TOPIC = "/camera/image/compressed"
INFO_TOPIC = "/camera/camera_info"


@dataclass(frozen=True, slots=True)
class LoggedImage:
    """An image: its stamp in ``clock``, its arrival (UTC), the camera's sensor name, and its file (JPEG, PNG).

    ``data`` is empty where the message itself is damaged.
    """

    stamp_ns: int
    arrival_ns: int
    clock: str
    sensor: str
    data: bytes


def count(flight: Flight) -> int:
    """Return how many images a log holds."""
    return sum(info.count for info in flight.topics.get(TOPIC, ()))


def images(flight: Flight, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[LoggedImage]:
    """Yield the images in the order of their arrival, ``start_ns`` included, ``end_ns`` not; they stream."""
    for message in flight.messages([TOPIC], start_ns, end_ns):
        channel = message.channel
        sensor = channel.metadata.get("sensor", "vision")
        encoded = file_of(message.data)
        yield LoggedImage(message.stamp_ns, message.log_time_ns, channel.clock, sensor, encoded)


def first_size(flight: Flight) -> tuple[int, int] | None:
    """Return the width and height [px] of the first image, or None where it cannot be decoded."""
    first = next(images(flight), None)
    return None if first is None else size_of(first.data)


def size_of(data: bytes) -> tuple[int, int] | None:
    """Return the width and height [px] of an encoded picture, or None where it cannot be decoded."""
    import cv2

    packed = np.frombuffer(data, dtype=np.uint8)
    try:
        picture = cv2.imdecode(packed, cv2.IMREAD_COLOR) if packed.size else None
    except cv2.error:
        return None
    return None if picture is None else (int(picture.shape[1]), int(picture.shape[0]))


def file_of(message: bytes) -> bytes:
    """Return the image's file in a sensor_msgs/CompressedImage; nothing where the message is damaged."""
    order = "<" if len(message) > 1 and message[1] & 1 else ">"
    place = 12
    try:
        for _ in range(2):  # frame_id, format
            place += -(place - 4) % 4
            (size,) = struct.unpack_from(order + "I", message, place)
            place += 4 + size
        place += -(place - 4) % 4
        (size,) = struct.unpack_from(order + "I", message, place)
    except struct.error:
        return b""
    data = message[place + 4 : place + 4 + size]
    return data if len(data) == size else b""


def camera_info(flight: Flight) -> dict[str, Any] | None:
    """Return the fields of the first camera_info that can be read, or None."""
    if INFO_TOPIC not in flight.topics:
        return None
    for message in flight.messages([INFO_TOPIC]):
        try:
            told = message.decoded
        except LogError:
            continue
        names = ("width", "height", "distortion_model", "d", "k")
        return {name: getattr(told, name, None) for name in names}
    return None
