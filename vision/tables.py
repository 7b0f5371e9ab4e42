"""Dataclasses from TOML, strictly: what is unknown, missing or of another type is an error that names the field."""

from __future__ import annotations

import dataclasses
import tomllib
from pathlib import Path
from typing import TypeVar

import msgspec

T = TypeVar("T")


def from_toml(text: str, kind: type[T], what: str) -> T:
    """Return the dataclass ``kind`` of a text; ``ValueError`` begins with ``what``."""
    try:
        table = tomllib.loads(text)
        known = {field.name for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
        unknown = sorted(set(table) - known)
        if unknown:
            raise ValueError(f"unknown field {unknown[0]!r}; there are {', '.join(sorted(known))}")
        return msgspec.convert(table, type=kind, strict=True)
    except (tomllib.TOMLDecodeError, msgspec.ValidationError, ValueError) as error:
        raise ValueError(f"{what}: {error}") from error


def load(path: str | Path, kind: type[T], what: str) -> T:
    """Return the dataclass ``kind`` of a file; ``ValueError`` begins with the file's name."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not a {what} file: {error}") from error
    return from_toml(text, kind, f"{path}: not a {what} file")
