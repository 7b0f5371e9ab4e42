"""One finding of a result: a symptom with its likely cause and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Severity(IntEnum):
    """How much a finding matters."""

    NOTE = 0
    WARNING = 1
    SERIOUS = 2


@dataclass(frozen=True, slots=True)
class Finding:
    """One symptom with its likely cause and remedy, in the user's words (plain text, not escaped)."""

    severity: Severity
    symptom: str
    cause: str
    remedy: str
