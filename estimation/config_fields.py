"""What the tables of the configuration are made of: fields with unit, meaning and bound, and the strict table."""

from __future__ import annotations

import msgspec
from msgspec import Meta


def positive(description: str, unit: str) -> Meta:
    """Return the field of a value above zero."""
    return Meta(gt=0.0, description=description, extra={"unit": unit})


def number(description: str, unit: str) -> Meta:
    """Return the field of any number."""
    return Meta(description=description, extra={"unit": unit})


def not_negative(description: str, unit: str) -> Meta:
    """Return the field of a value that may be zero."""
    return Meta(ge=0.0, description=description, extra={"unit": unit})


def share(description: str) -> Meta:
    """Return the field of a value between 0 and 1, both excluded."""
    return Meta(gt=0.0, lt=1.0, description=description, extra={"unit": "-"})


def choice(description: str) -> Meta:
    """Return the field of a choice or a text."""
    return Meta(description=description, extra={"unit": "-"})


Vector3 = tuple[float, float, float]


class Table(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """A table of the file."""
