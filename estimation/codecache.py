"""Where compiled code is kept between runs."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from pathlib import Path


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
