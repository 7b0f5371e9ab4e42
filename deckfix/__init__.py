"""deckfix: state estimation for landing a multirotor, from flight logs.

    import deckfix
    result = deckfix.replay("flight.mcap")
    result.summary(); result.to_pandas(); result.figure().show()

What is named here is loaded when it is first used, so that importing the package costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from deckfix._version import __version__

if TYPE_CHECKING:
    from deckfix.replaying import open, replay
    from deckfix.result import Result

__all__ = ["Result", "__version__", "open", "replay"]

_HOMES = {"open": "deckfix.replaying", "replay": "deckfix.replaying", "Result": "deckfix.result"}


def __getattr__(name: str) -> Any:
    """Load a public name from its module."""
    if name not in _HOMES:
        raise AttributeError(f"module 'deckfix' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
