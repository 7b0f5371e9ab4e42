"""Flight logs: MCAP files of ROS 2 messages as columns, and importers of autopilots' logs."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from logs.errors import LogError
    from logs.reader import Flight, open_flight
    from logs.recording import Recording, Series
    from logs.topics import TOPICS
    from logs.writer import FlightWriter

_HOMES = {
    "Flight": "logs.reader",
    "FlightWriter": "logs.writer",
    "LogError": "logs.errors",
    "Recording": "logs.recording",
    "Series": "logs.recording",
    "TOPICS": "logs.topics",
    "open_flight": "logs.reader",
}

__all__ = [
    "TOPICS",
    "Flight",
    "FlightWriter",
    "LogError",
    "Recording",
    "Series",
    "open_flight",
]


def __getattr__(name: str) -> object:
    """Import a public name when it is first used: importing the package alone costs nothing."""
    if name not in _HOMES:
        raise AttributeError(f"module 'logs' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
