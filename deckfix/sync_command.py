"""What ``deckfix sync`` does beside the profile: reading the log, the text, the JSON and the configuration."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import msgspec

from deckfix.commands import finite, write_text
from deckfix.files import InputError, check_output, existing
from deckfix.sync import LatencyProfile, LatencyStatus, latency_profile
from deckfix.terminal import printable, working
from estimation.config import Config, dump_config

if TYPE_CHECKING:
    from estimation.clockbank import ClockSummary
    from estimation.estimator import EngineName

CONVENTION = "latency >= 0: the content is older than its stamp; t_content = map(t_stamp) - latency"
RECIPE = (
    "to make it observable: hover 4 to 8 m over the target, keep it in view, and rock the vehicle for 20 s by "
    "6 deg to each side, to and fro, first in roll and then in pitch, each way in about 0.6 s (not in circles, where "
    "a camera turned about its axis looks late); log it, and run deckfix sync again"
)


def sync_command(
    file: str, *, config: str | None, write: str | None, json_path: str | None, arrivals: bool, jobs: int | None,
    engine: str, force: bool,
) -> str:  # fmt: skip
    """Find the latency of a log, write what was asked for, and return the text to show.

    Raises ``InputError`` where the log has nothing to find it from, or where ``write`` is asked for and it was not
    found; ``OutputError`` where a file may not be written.
    """
    from deckfix.replaying import configuration, facts, open

    existing(file)
    inputs = [file, *([config] if config else [])]
    to_stdout = json_path == "-"
    for path in (write, None if to_stdout else json_path):
        if path:
            check_output(path, force=force, inputs=inputs)
    if write and json_path and not to_stdout and Path(write).resolve() == Path(json_path).resolve():
        raise InputError(f"{write}: is named for two outputs; give each its own file")
    flight = open(file)
    settings, source = configuration(flight, config)
    known = facts(flight)
    by_arrival = arrivals or known.vision_by_arrival
    events = flight.events()
    with working(f"replaying {Path(file).name} with many latencies"):
        try:
            found = latency_profile(
                events, settings, known, cast("EngineName", engine), by_arrival=by_arrival, jobs=jobs
            )
        except ValueError as error:
            raise InputError(f"{file}: {error}") from None
    document = json.dumps(finite(summary(found, Path(file).name)), indent=1) + "\n"
    if json_path and not to_stdout:
        write_text(json_path, document, force=force, inputs=inputs)
    if write:
        if found.status is not LatencyStatus.ESTIMATED:
            raise InputError(
                f"{file}: the latency is {found.status} ({found.reason}), so that {write} is not written; {RECIPE}"
            )
        write_text(write, dump_config(with_latency(settings, found)), force=force, inputs=inputs)
    if to_stdout:
        return document.rstrip("\n")
    written = [p for p in (json_path, write) if p]
    return "\n".join([digest(found, Path(file).name, source), *(f"wrote {p}" for p in written)])


def with_latency(config: Config, found: LatencyProfile) -> Config:
    """Return the configuration with the latency found, for fixes with stamps of their own or for those without."""
    if found.by_arrival:
        values = {"arrival_latency_s": max(found.latency_s, 0.0), "arrival_latency_sigma_s": found.sigma_s}
    else:
        values = {"latency_s": found.latency_s, "latency_sigma_s": found.sigma_s}
    rounded = {name: round(value, 6) for name, value in values.items()}
    return msgspec.structs.replace(config, vision=msgspec.structs.replace(config.vision, **rounded))


def summary(found: LatencyProfile, name: str) -> dict[str, Any]:
    """Return the result as ``--json`` writes it (docs/json.md)."""
    return {
        "flight": name,
        "status": str(found.status),
        "reason": found.reason,
        "latency_ms": found.latency_s * 1e3,
        "latency_sigma_ms": found.sigma_s * 1e3,
        "latency_convention": CONVENTION,
        "stamps": "arrival" if found.by_arrival else "own",
        "fixes": found.fixes,
        "rotation_dps": math.degrees(found.rotation_radps),
        "halves_ms": [[a * 1e3, s * 1e3] for a, s in found.halves],
        "profile": [[a * 1e3, v] for a, v in zip(found.grid_s, found.log_likelihood, strict=True)],
        "clock": {
            c.clock: {
                "offset_ms": c.offset_ns * 1e-6,
                "sigma_ms": c.sigma_ns * 1e-6,
                "skew_ppm": c.skew_ppm,
                "skew_sigma_ppm": c.skew_sigma_ppm,
                "status": str(c.status),
                "source": c.source,
            }
            for c in found.clocks
        },
    }


def digest(found: LatencyProfile, name: str, source: str) -> str:
    """Return the result in a few lines of plain text."""
    stamps = "arrival (their own stamps are not used)" if found.by_arrival else "stamp"
    turned = f"{found.fixes} fixes, the vehicle turned by {math.degrees(found.rotation_radps):.1f} deg/s rms"
    lines = [
        f"{name}: latency of the vision fixes at their {stamps}: {found.latency_s * 1e3:.2f} ms, "
        f"1-sigma {found.sigma_s * 1e3:.2f} ms: {found.status}",
        f"  {CONVENTION}",
        f"  {found.reason}; {turned}; {source}",
    ]
    if found.status is not LatencyStatus.ESTIMATED:
        lines.append(f"  {RECIPE}")
    return "\n".join(printable(line) for line in [*lines, *(_clock_line(c) for c in found.clocks)])


def _clock_line(c: ClockSummary) -> str:
    """Return one clock against the inertial one, in words."""
    sigma = f" ± {c.sigma_ns * 1e-6:.3f}" if math.isfinite(c.sigma_ns) else ""
    skew = (
        f"skew {c.skew_ppm:.2f} ± {c.skew_sigma_ppm:.2f} ppm"
        if math.isfinite(c.skew_sigma_ppm)
        else "skew unknown"
    )
    bound = c.asymmetry_bound_ns * 1e-6
    hidden = f"; unequal ways can hide {bound:.3f} ms" if math.isfinite(bound) else ""
    offset = f"{c.offset_ns * 1e-6:.3f}{sigma} ms"
    return f"  clock {c.clock} less the inertial one: {offset}, {skew} (from {c.source}{hidden})"
