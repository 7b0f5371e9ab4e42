"""How much of the computer this process takes."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Load:
    """Processor time since it was made, and memory now."""

    begin_s: float = field(default_factory=time.monotonic)
    used_s: float = field(default_factory=time.process_time)

    def share(self) -> float:
        """Return the processor time of all threads over the time that has gone by: 1 is one core."""
        gone = time.monotonic() - self.begin_s
        return (time.process_time() - self.used_s) / gone if gone > 0.0 else 0.0

    @property
    def words(self) -> str:
        """Processor and memory in a few words."""
        resident = resident_mb()
        memory = "" if resident is None else f", resident {resident:.0f} MB"
        return f"cpu {100.0 * self.share():.0f} % of a core{memory}"


def resident_mb() -> float | None:
    """Return the memory that this process holds [MB], or None where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except (OSError, ValueError, IndexError):
        return None
    return pages * os.sysconf("SC_PAGE_SIZE") * 1e-6
