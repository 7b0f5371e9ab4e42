"""What the benchmarks share: targets, baselines, consistency of a run, and where the numbers come from.

A baseline is what a benchmark wrote with ``--json`` once, committed in ``benchmarks/baselines``. A number of it is
missed where it has become worse by more than its spread: the one that the benchmark gave with it (over its
repetitions), or else ``TOLERANCE`` of the baseline.
"""

from __future__ import annotations

import datetime
import json
import platform
import subprocess
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deckfix.result import nis_band
from estimation.output import Run

BASELINES = Path(__file__).parent / "baselines"
TOLERANCE = 0.1


@dataclass(frozen=True, slots=True)
class Target:
    """A number and its bound: at most, or with ``at_least`` at least, the bound; ``spread`` over the repetitions."""

    name: str
    value: float | None
    bound: float
    at_least: bool = False
    spread: float | None = None

    @property
    def met(self) -> bool:
        """Whether the number is there and keeps its bound."""
        if self.value is None or not np.isfinite(self.value):
            return False
        return bool(self.value >= self.bound if self.at_least else self.value <= self.bound)


@dataclass(slots=True)
class Targets:
    """All targets of a benchmark."""

    all: list[Target] = field(default_factory=list)

    def add(self, target: Target) -> None:
        """Take a target."""
        self.all.append(target)

    def report(self) -> bool:
        """Print what is missed; return whether nothing is."""
        missed = [t for t in self.all if not t.met]
        print(f"\ntargets: {len(self.all) - len(missed)} of {len(self.all)} met")
        for t in missed:
            print(f"  MISSED {t.name}: {t.value} (wanted {'>=' if t.at_least else '<='} {t.bound:g})")
        return not missed

    def as_rows(self) -> list[dict[str, Any]]:
        """Return the targets as they are written to JSON."""
        return [
            {
                "name": t.name,
                "value": t.value,
                "bound": t.bound,
                "at_least": t.at_least,
                "spread": t.spread,
                "met": t.met,
            }
            for t in self.all
        ]


def missed_baselines(found: dict[str, Any], baseline: dict[str, Any]) -> list[str]:
    """Return a line for each number of a baseline that is missed by more than its spread, or is not there any more."""
    now = {t["name"]: t for t in found["targets"]}
    out = []
    for then in baseline["targets"]:
        name, old = then["name"], then["value"]
        if old is None:
            continue
        if name not in now or now[name]["value"] is None:
            out.append(f"{name}: was {old:.6g}, and is not measured any more")
            continue
        new = now[name]["value"]
        spread = then.get("spread")
        allowed = TOLERANCE * abs(old) if spread is None else spread
        worse = old - new if now[name]["at_least"] else new - old
        if worse > allowed + 1e-12:
            out.append(f"{name}: was {old:.6g}, is {new:.6g}; a spread of {allowed:.3g} is allowed")
    return out


def load_baseline(name: str) -> dict[str, Any] | None:
    """Return the committed baseline of a benchmark, or None where there is none with targets."""
    path = BASELINES / f"{name}.json"
    if not path.is_file():
        return None
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return found if found.get("targets") else None


def nis_row(records: NDArray[np.void]) -> dict[str, Any]:
    """Return count, mean NIS over degrees of freedom, and the shares inside and above the two-sided 95 % band."""
    dof = records["dof"].astype(np.float64)
    low, high = nis_band(dof)
    nis = records["nis"]
    return {
        "count": len(records),
        "mean_over_dof": float(np.mean(nis / dof)),
        "inside_95": float(np.mean((nis >= low) & (nis <= high))),
        "above_95": float(np.mean(nis > high)),
    }


def nis_rows(run: Run) -> dict[str, dict[str, Any]]:
    """Return ``nis_row`` of every sensor that was fused or rejected by its innovation."""
    out = {}
    for index, name in enumerate(run.sensors):
        tried = run.records[(run.records["sensor"] == index) & (run.records["dof"] > 0)]
        if len(tried):
            out[name] = nis_row(tried)
    return out


def provenance() -> dict[str, Any]:
    """Return date, commit (with a mark where the tree differs from it) and machine."""
    root = Path(__file__).parents[1]

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, check=False)
        return done.stdout.strip()

    changed = git("status", "--porcelain", "--untracked-files=no", "--", "estimation", "logs", "deckfix")
    return {
        "date": datetime.date.today().isoformat(),
        "commit": (git("rev-parse", "--short", "HEAD") or "unknown") + ("+changes" if changed else ""),
        "machine": f"{platform.machine()}, {_processor()}, Python {platform.python_version()}",
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next(
        (line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.processor()
    )
