"""What a person at a terminal sees: progress (none in a pipe), and text that cannot steer the terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")


@contextmanager
def working(text: str) -> Iterator[None]:
    """Show that work is going on while the block runs."""
    if not sys.stderr.isatty():
        yield
        return
    from rich.console import Console
    from rich.markup import escape

    with Console(stderr=True).status(escape(text)):
        yield


def tracked(items: Iterable[T], text: str, total: int) -> Iterator[T]:
    """Yield the items with a progress bar."""
    if not sys.stderr.isatty():
        yield from items
        return
    from rich.console import Console
    from rich.progress import track

    yield from track(items, description=text, total=total, console=Console(stderr=True), transient=True)


def printable(line: str) -> str:
    """Return a line with control characters made visible, since text from a log may hold any."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in line)
