"""Where compiled code is kept between runs."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def cache_home() -> Path:
    """Return the user's cache folder for this project (``XDG_CACHE_HOME``, else ``~/.cache``); it may not exist yet."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "deckfix"


def cache_of(sources: Iterable[Path]) -> Path | None:
    """Return the folder for code compiled from exactly these source files, or None where nothing can be written.

    Named after their content, so that edited sources never meet code of their earlier selves.
    """
    digest = hashlib.sha256()
    for source in sources:
        digest.update(source.read_bytes())
    folder = cache_home() / digest.hexdigest()[:16]
    return folder if writable(folder) else None


def writable(folder: Path) -> bool:
    """True where the folder, or the nearest folder above it that exists, can be written."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return os.access(folder, os.W_OK)


def jitted(function: Callable[..., Any], sources: Iterable[Path]) -> Callable[..., Any]:
    """Return ``function`` compiled by numba at its first call, and kept where ``cache_of`` its sources says."""
    import numba

    folder = cache_of(sources)
    compiled: Callable[..., Any]
    if folder is None:
        compiled = numba.njit(error_model="numpy")(function)
        return compiled
    with _cached_in(folder):
        compiled = numba.njit(cache=True, error_model="numpy")(function)
    return compiled


@contextmanager
def _cached_in(folder: Path) -> Iterator[None]:
    """Let numba cache what is defined within in a folder; it reads its setting when a function is decorated."""
    import numba

    settings: Any = numba.config
    before = settings.CACHE_DIR
    settings.CACHE_DIR = str(folder)
    try:
        yield
    finally:
        settings.CACHE_DIR = before
