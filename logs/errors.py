"""The one exception of logs that users see."""

from __future__ import annotations

from pathlib import Path


class LogError(ValueError):
    """A log cannot be read or written; the message reads ``FILE: what is wrong; what to do``."""

    def __init__(self, path: str | Path, problem: str, remedy: str) -> None:
        super().__init__(f"{path}: {problem}; {remedy}")
        self.path = str(path)
        self.problem = problem
        self.remedy = remedy
