"""Comparison of the detector's numbers with those committed under ``baselines``: worse by more than chance is a miss.

What chance does follows from the counts: three standard errors of the difference for a detection rate (binomial), for
the logarithm of an error's rms (normal errors) and for a mean NEES of 3 degrees of freedom; for times, which are
ratios to a marker detector in the same process, the spread over frames that both runs state.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from targets import Target, Targets

FOLDER = Path(__file__).parent / "baselines"
FILES = {
    "accuracy": "vision_accuracy.json",
    "nees": "vision_conditions.json",
    "time": "vision_time.json",
}


def compare(part: str, results: dict[str, Any], targets: Targets) -> None:
    """Add a target for each number of a part that the committed baseline has too."""
    path = FOLDER / FILES[part]
    if not path.exists():
        print(f"no baseline {path.name} to compare with")
        return
    baseline = json.loads(path.read_text(encoding="utf-8"))
    before = dict(_numbers(part, baseline[part]))
    count = 0
    for name, (value, bound, at_least) in _bounds(before, dict(_numbers(part, results))):
        targets.add(Target(f"against {path.name} of {baseline['commit']}: {name}", value, bound, at_least))
        count += 1
    print(f"compared with {path.name} ({baseline['date']}, {baseline['commit']}): {count} numbers")


Number = tuple[str, float, float]
"""Kind (rate, rms, nees or ratio), value, and count (of a ratio its relative spread)."""


def _numbers(part: str, results: dict[str, Any]) -> Iterator[tuple[str, Number]]:
    for at, row in results.items():
        if part == "nees":
            if row:
                yield f"{at}: NEES", ("nees", row["mean"], row["n"])
        elif part == "time":
            for name, value in row.items():
                if isinstance(value, float) and name.startswith("rings"):
                    spread = math.hypot(row["spread"][name], row["spread"]["ArUco"])
                    yield f"{at} m, {name} over ArUco", ("ratio", value / row["ArUco"], spread)
        else:
            for name, cell in row.items():
                if name.startswith("rings") and cell["z_percent"]:
                    yield f"{at} m, {name}: detection", ("rate", cell["detected"], cell["n"])
                    seen = cell["detected"] * cell["n"]
                    yield f"{at} m, {name}: Z rms %", ("rms", cell["z_percent"]["rms"], seen)
                    yield f"{at} m, {name}: NEES", ("nees", cell["nees"], seen)


def _bounds(
    before: dict[str, Number], now: dict[str, Number]
) -> Iterator[tuple[str, tuple[float, float, bool]]]:
    """Yield the names that both have, with the value now, its bound, and whether that is a lower one."""
    for name, (kind, value, count) in now.items():
        if name not in before:
            continue
        _, base, base_count = before[name]
        if kind == "ratio":
            yield name, (value, base * (1.0 + max(count, base_count)), False)
            continue
        per = 1.0 / count + 1.0 / base_count
        if kind == "rate":
            rate = min(base, (base_count + 1.0) / (base_count + 2.0))
            yield name, (value, base - 3.0 * math.sqrt(rate * (1.0 - rate) * per), True)
        elif kind == "rms":
            yield name, (value, base * math.exp(3.0 * math.sqrt(0.5 * per)), False)
        else:
            yield name, (value, base + 3.0 * math.sqrt(6.0 * per), False)
